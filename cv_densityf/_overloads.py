"""Which of ``cv2.findFundamentalMat``'s three overloads a call means, and with what values."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np

#: Parameter names of the overloads in the order cv2 tries them.
WITH_MAX_ITERS = (
    "points1",
    "points2",
    "method",
    "ransacReprojThreshold",
    "confidence",
    "maxIters",
    "mask",
)
WITH_DEFAULTS = ("points1", "points2", "method", "ransacReprojThreshold", "confidence", "mask")
WITH_PARAMS = ("points1", "points2", "params", "mask")
KEYWORDS = frozenset((*WITH_MAX_ITERS, *WITH_PARAMS))

_INT32 = range(-(2**31), 2**31)
_FLOATS: tuple[type[Any], ...] = (float, int, np.integer, np.float32, np.float16)


class Call(NamedTuple):
    """A call as cv2 understands it. Points and mask are still whatever the caller gave."""

    points1: Any
    points2: Any
    method: int
    threshold: float
    confidence: float
    max_iters: int
    params: cv2.UsacParams | None
    mask: Any


def resolve(args: tuple[Any, ...], kwargs: dict[str, Any]) -> Call | None:
    """Bind a call the way cv2 binds it; None for a call that cv2 refuses.

    The point arrays and the mask are not looked at: they do not decide the overload, except that a
    sixth positional argument which is no integer is a mask and not ``maxIters``.
    """
    # The second one has defaults, which stand for None as well.
    for names, n_required, if_none in (
        (WITH_MAX_ITERS, 6, (0, 0.0, 0.0, 0)),
        (WITH_DEFAULTS, 2, (cv2.FM_RANSAC, 3.0, 0.99, 1000)),
    ):
        bound = _bind(names, n_required, args, kwargs)
        if bound is None:
            continue
        method = _as_int(bound.get("method"), if_none[0])
        threshold = _as_float(bound.get("ransacReprojThreshold"), if_none[1])
        confidence = _as_float(bound.get("confidence"), if_none[2])
        max_iters = _as_int(bound.get("maxIters"), if_none[3])
        if not (method is None or threshold is None or confidence is None or max_iters is None):
            return Call(
                bound["points1"],
                bound["points2"],
                method,
                threshold,
                confidence,
                max_iters,
                None,
                bound.get("mask"),
            )
    bound = _bind(WITH_PARAMS, 3, args, kwargs)
    if bound is not None:
        params = bound["params"]
        if params is None:
            params = cv2.UsacParams()
        if isinstance(params, cv2.UsacParams):
            return Call(
                bound["points1"],
                bound["points2"],
                cv2.USAC_DEFAULT,
                params.threshold,
                params.confidence,
                params.maxIterations,
                params,
                bound.get("mask"),
            )
    return None


def _bind(
    names: tuple[str, ...], n_required: int, args: tuple[Any, ...], kwargs: dict[str, Any]
) -> dict[str, Any] | None:
    if len(args) > len(names):
        return None
    bound = dict(zip(names, args, strict=False))
    for name, value in kwargs.items():
        if name in bound or name not in names:
            return None
        bound[name] = value
    return bound if bound.keys() >= set(names[:n_required]) else None


def _as_int(value: Any, if_none: int) -> int | None:
    """Return the value of cv2's ``int`` slot, or None where cv2 refuses ``value``."""
    if value is None:
        return if_none
    if isinstance(value, (bool, np.timedelta64)) or not isinstance(value, (int, np.integer)):
        return None
    number = int(value)
    return number if number in _INT32 else None


def _as_float(value: Any, if_none: float) -> float | None:
    """Return the value of cv2's ``double`` slot, or None where cv2 refuses ``value``."""
    if value is None:
        return if_none
    if isinstance(value, (bool, np.timedelta64)) or not isinstance(value, _FLOATS):
        return None
    try:
        return float(value)
    except OverflowError:
        return None
