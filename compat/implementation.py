"""The function under test, named by ``COMPAT_IMPLEMENTATION``, and cv2's own."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from typing import Any

import cv2

DEFAULT = "cv_densityf:findFundamentalMat"
NAME = os.environ.get("COMPAT_IMPLEMENTATION", DEFAULT)

#: Bound before anything can patch cv2.
reference = cv2.findFundamentalMat


def load(name: str) -> Callable[..., Any]:
    """Import ``module:function``."""
    module, _, function = name.partition(":")
    if not function:
        raise ValueError(f"COMPAT_IMPLEMENTATION must read module:function, not {name!r}")
    if module == "cv2" and function == "findFundamentalMat":
        return reference
    try:
        return getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"COMPAT_IMPLEMENTATION is {name!r}: {error}") from error


under_test = load(NAME)
IS_CV2 = under_test is reference
