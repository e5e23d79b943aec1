"""cv2's own function, the names and settings of its methods, and how it fails."""

from __future__ import annotations

from dataclasses import dataclass, replace
from numbers import Integral
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cv_densityf._epipolar import Rule

#: Attribute of our replacement of ``cv2.findFundamentalMat`` that holds cv2's function.
CV2S_OWN = "__cv2s_own__"

try:
    #: Bound once, so that a later patch of ``cv2.findFundamentalMat`` cannot call itself, nor an
    #: earlier one of ours, where this module is loaded anew while cv2 is patched.
    original = getattr(cv2.findFundamentalMat, CV2S_OWN, cv2.findFundamentalMat)
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
_NAMES = {flag: name for name, flag in METHODS.items()}

#: Pixels, of a draw's points. cv2 asks of a sample whether it lies on a plane, within the threshold
#: but at least within 2.8 px, and if so it tries nineteen focal lengths, which takes as long as the
#: rest. At a scale at which the threshold is no smaller than this, fewer samples do, and it is for
#: the caller to look for planes.
_LEAST_DRAW_THRESHOLD = 3.0
#: Where nearly all samples do, because they are close together, the second image is made so many
#: times as large as the first: it asks how far the plane is off in the second one alone, and then
#: hardly any sample passes.
_NO_PLANES = 16.0

#: cv2's graph cut takes seconds above a few tens of thousands of matches, and OpenCV 5.0 dies.
GRAPH_CUT_MAX = 30_000

_USAC_FLAGS = range(cv2.USAC_DEFAULT, cv2.USAC_MAGSAC + 1)


def short_name(method: str) -> str:
    """Write a method's name as the keys of `METHODS` are: ``"FM_RANSAC"`` is ``"ransac"``."""
    return method.lower().removeprefix("fm_")


def method_flag(method: str | int) -> int:
    """Turn a method's name, or its cv2 constant, into the cv2 constant.

    Raises
    ------
    ValueError
        If the name or the constant is not one of cv2's.
    """
    if isinstance(method, str):
        name = short_name(method)
        if name in METHODS:
            return METHODS[name]
    elif isinstance(method, Integral) and type(method) is not bool and method in METHODS.values():
        return int(method)
    raise ValueError(f"unknown method {method!r}; choose one of {', '.join(METHODS)}")


def is_usac(flag: int) -> bool:
    """Whether cv2 sends this method to its USAC framework."""
    return flag in _USAC_FLAGS


def has_threshold(flag: int) -> bool:
    """Whether the caller's threshold tells inliers; to other methods most matches always are."""
    return is_usac(flag) or flag == cv2.FM_RANSAC


def cuts_graph(flag: int, params: cv2.UsacParams | None) -> bool:
    """Whether cv2 optimises locally by graph cut."""
    if params is not None:
        return bool(params.loMethod == cv2.LOCAL_OPTIM_GC)
    return flag == cv2.USAC_ACCURATE


def without_graph_cut(
    flag: int, params: cv2.UsacParams | None
) -> tuple[int, cv2.UsacParams | None]:
    """Return the same settings with another local optimisation."""
    if params is None:
        return cv2.USAC_DEFAULT, None
    other = cv2.UsacParams()
    for name in dir(other):
        if not name.startswith("_"):
            setattr(other, name, getattr(params, name))
    other.loMethod = cv2.LOCAL_OPTIM_INNER_AND_ITER_LO
    return flag, other


@dataclass(frozen=True, slots=True)
class Robust:
    """What the caller asked of cv2: a method and its numbers, or a ``cv2.UsacParams``."""

    flag: int
    threshold: float
    confidence: float
    max_iters: int
    params: cv2.UsacParams | None = None

    @property
    def name(self) -> str:
        """Name of the method that cv2 will run."""
        return "usac" if self.params is not None else _NAMES[self.flag]

    @property
    def direct(self) -> bool:
        """Whether the method takes every match as true."""
        return self.params is None and self.flag in (cv2.FM_7POINT, cv2.FM_8POINT)

    @property
    def rule(self) -> Rule:
        """The rule by which cv2 makes this method's mask."""
        if self.params is not None or is_usac(self.flag):
            return "usac"
        return "ransac" if self.flag == cv2.FM_RANSAC else "lmeds"

    @property
    def best_first(self) -> bool:
        """Whether the method takes the order of the rows for their quality."""
        if self.params is not None:
            return bool(self.params.sampler == cv2.SAMPLING_PROSAC)
        return self.flag == cv2.USAC_PROSAC

    def for_size(self, n: int) -> Robust:
        """Return these settings, or those without graph cut if n matches are too many for it."""
        if n <= GRAPH_CUT_MAX or not cuts_graph(self.flag, self.params):
            return self
        flag, params = without_graph_cut(self.flag, self.params)
        return replace(self, flag=flag, params=params)

    def plain(
        self, points1: Any, points2: Any, scores: NDArray[np.float64] | None = None
    ) -> tuple[NDArray[np.float64] | None, NDArray[np.uint8] | None]:
        """Make cv2's own call; (None, None) where its solver raises or finds nothing.

        If the method wants the best first, and there are ``scores`` (n,), it gets them so; the mask
        is in the order of the points all the same.
        """
        if scores is not None and self.best_first:
            order = np.argsort(-scores, kind="stable")
            F, mask = self.plain(points1[order], points2[order])
            return F, None if mask is None else mask[np.argsort(order)]
        third: tuple[Any, ...] = (self.flag, self.threshold, self.confidence, self.max_iters)
        if self.params is not None:
            third = (self.params,)
        try:
            F, mask = original(points1, points2, *third)
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
    planes: bool = True,
) -> NDArray[np.float64] | None:
    """Make one quick, seeded draw with cv2's USAC: MSAC score, inner local optimisation.

    Samples are uniform, or PROSAC's if the points come best first. Without ``planes`` they are not
    asked whether they lie on one, and the residuals are distances in the first image.

    Returns
    -------
    array, shape (3, 3), or None
        None where cv2 raises, or finds no finite matrix other than zero.
    """
    scale, second = max(1.0, _LEAST_DRAW_THRESHOLD / threshold), 1.0
    if not planes:
        zoom = _zoom(points)
        # What Sampson's distance is in the first image, where those in both are as their sizes.
        threshold *= np.hypot(1.0, zoom)
        second = _NO_PLANES * zoom
    scales = scale * np.array([1.0, 1.0, second, second])
    points = points * scales.astype(np.float32)
    params = cv2.UsacParams()
    params.threshold = scale * threshold
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
    if F is None or not 0.0 < np.abs(F).max() < np.inf:  # nor is NaN
        return None
    return np.asarray(F * np.outer([*scales[2:], 1.0], [*scales[:2], 1.0]), dtype=np.float64)


def _zoom(points: NDArray[np.float32]) -> float:
    """Size of most of the first image's points (n, 4) in that of the second's."""
    n = len(points)
    quarters = np.partition(points.T, (n // 4, 3 * n // 4), axis=1)
    first, second = np.hypot(*(quarters[:, 3 * n // 4] - quarters[:, n // 4]).reshape(2, 2).T)
    return float(first / second) if first > 0.0 and second > 0.0 else 1.0
