"""The one place that calls cv2's estimator, and the names of its methods."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cv_densityf._epipolar import Rule

try:
    #: Bound once, so that a later patch of ``cv2.findFundamentalMat`` cannot call itself.
    original = cv2.findFundamentalMat
except AttributeError:
    raise ImportError(
        "this cv2 has no findFundamentalMat; install a full build of OpenCV: "
        "python -m pip install opencv-contrib-python-headless"
    ) from None

METHODS: dict[str, int] = {
    "7point": cv2.FM_7POINT,
    "8point": cv2.FM_8POINT,
    "lmeds": cv2.FM_LMEDS,
    "ransac": cv2.FM_RANSAC,
    "usac_default": cv2.USAC_DEFAULT,
    "usac_parallel": cv2.USAC_PARALLEL,
    "usac_fm_8pts": cv2.USAC_FM_8PTS,
    "usac_fast": cv2.USAC_FAST,
    "usac_accurate": cv2.USAC_ACCURATE,
    "usac_prosac": cv2.USAC_PROSAC,
    "usac_magsac": cv2.USAC_MAGSAC,
}

#: cv2's graph cut takes seconds above a few tens of thousands of matches, and OpenCV 5.0 dies.
GRAPH_CUT_MAX = 30_000

_USAC_FLAGS = range(cv2.USAC_DEFAULT, cv2.USAC_MAGSAC + 1)


def method_flag(method: str | int) -> int:
    """Turn a method's name, or its cv2 constant, into the cv2 constant.

    Raises
    ------
    ValueError
        If the name or the constant is not one of cv2's.
    """
    if isinstance(method, str):
        name = method.lower().removeprefix("fm_")
        if name in METHODS:
            return METHODS[name]
    elif isinstance(method, Integral) and method in METHODS.values():
        return int(method)
    raise ValueError(f"unknown method {method!r}; choose one of {', '.join(METHODS)}")


def method_name(robust: Robust) -> str:
    """Name of the method that cv2 will run."""
    if robust.params is not None:
        return "usac"
    names = {flag: name for name, flag in METHODS.items()}
    return names.get(robust.flag, "lmeds")


def is_usac(flag: int) -> bool:
    """Whether cv2 sends this method to its USAC framework."""
    return flag in _USAC_FLAGS


@dataclass(frozen=True, slots=True)
class Robust:
    """What the caller asked of cv2: a method and its numbers, or a ``cv2.UsacParams``."""

    flag: int
    threshold: float
    confidence: float
    max_iters: int
    params: cv2.UsacParams | None = None

    @property
    def rule(self) -> Rule:
        """The rule by which cv2 makes this method's mask."""
        if self.params is not None or is_usac(self.flag):
            return "usac"
        return "ransac" if self.flag & ~3 == cv2.FM_RANSAC else "lmeds"

    @property
    def best_first(self) -> bool:
        """Whether the method takes the order of the rows for their quality."""
        if self.params is not None:
            return bool(self.params.sampler == cv2.SAMPLING_PROSAC)
        return self.flag == cv2.USAC_PROSAC

    def plain(
        self, points1: Any, points2: Any
    ) -> tuple[NDArray[np.float64] | None, NDArray[np.uint8] | None]:
        """Make cv2's own call; (None, None) where its solver raises or finds nothing.

        Where cv2 would cut graphs over more than `GRAPH_CUT_MAX` matches, USAC_DEFAULT answers.
        """
        flag, params = self.flag, self.params
        if len(points1) > GRAPH_CUT_MAX and (
            flag == cv2.USAC_ACCURATE
            or (params is not None and params.loMethod == cv2.LOCAL_OPTIM_GC)
        ):
            flag, params = cv2.USAC_DEFAULT, None
        try:
            if params is not None:
                F, mask = original(points1, points2, params)
            else:
                F, mask = original(
                    points1, points2, flag, self.threshold, self.confidence, self.max_iters
                )
        except cv2.error:
            return None, None
        return (F, mask) if F is not None else (None, None)


def draw(
    points: NDArray[np.float32],
    threshold: float,
    confidence: float,
    max_iters: int,
    seed: int,
    best_first: bool = False,
) -> NDArray[np.float64] | None:
    """Make one quick, seeded draw with cv2's USAC: MSAC score, inner local optimisation.

    Samples are uniform, or PROSAC's if the points come best first.

    Returns
    -------
    array, shape (3, 3), or None
        None where cv2 raises or finds no finite matrix.
    """
    params = cv2.UsacParams()
    params.threshold = threshold
    params.confidence = confidence
    params.maxIterations = max_iters
    params.randomGeneratorState = (seed + 2**31) % 2**32 - 2**31  # a signed 32-bit field
    params.sampler = cv2.SAMPLING_PROSAC if best_first else cv2.SAMPLING_UNIFORM
    params.score = cv2.SCORE_METHOD_MSAC
    params.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    params.loIterations = 5
    params.loSampleSize = 20
    params.final_polisher = cv2.NONE_POLISHER  # the caller polishes
    try:
        F, _ = original(points[:, :2], points[:, 2:], params)
    except cv2.error:
        return None
    if F is None or not np.isfinite(F).all():
        return None
    return np.asarray(F, dtype=np.float64)
