"""Fundamental matrices from the density of matches: a drop-in for ``cv2.findFundamentalMat``."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from cv_densityf._coherence import coherence
from cv_densityf._estimate import Estimate, estimate_fundamental
from cv_densityf._zhang import epipolar_distance
from cv_densityf.cv2_api import findFundamentalMat

if TYPE_CHECKING:
    from cv_densityf._density import DensityPeaksResult, density_peaks
    from cv_densityf._files import InputError
    from cv_densityf.batch import estimate_many
    from cv_densityf.estimators import (
        DecisionGraphDisplay,
        DensityPeaks,
        DensityPeaksFilter,
        FundamentalMatrixEstimator,
    )
    from cv_densityf.matching import Matches, match_images, read_image
    from cv_densityf.patching import is_patched, patch_cv2, patched, unpatch_cv2

__version__ = "0.1.0"

#: Public names whose modules import more than cv2: loaded when first asked for.
_LAZY = {
    "DecisionGraphDisplay": "estimators",
    "DensityPeaks": "estimators",
    "DensityPeaksFilter": "estimators",
    "DensityPeaksResult": "_density",
    "FundamentalMatrixEstimator": "estimators",
    "InputError": "_files",
    "Matches": "matching",
    "density_peaks": "_density",
    "estimate_many": "batch",
    "is_patched": "patching",
    "match_images": "matching",
    "patch_cv2": "patching",
    "patched": "patching",
    "read_image": "matching",
    "unpatch_cv2": "patching",
}

__all__ = [
    "DecisionGraphDisplay",
    "DensityPeaks",
    "DensityPeaksFilter",
    "DensityPeaksResult",
    "Estimate",
    "FundamentalMatrixEstimator",
    "InputError",
    "Matches",
    "coherence",
    "density_peaks",
    "epipolar_distance",
    "estimate_fundamental",
    "estimate_many",
    "findFundamentalMat",
    "is_patched",
    "match_images",
    "patch_cv2",
    "patched",
    "read_image",
    "unpatch_cv2",
]


if not TYPE_CHECKING:  # which would take it for a promise of any name

    def __getattr__(name: str) -> Any:
        if name in _LAZY:
            return getattr(import_module(f"cv_densityf.{_LAZY[name]}"), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
