"""`findFundamentalMat`: cv2's function, call for call, with the density pipeline behind it."""

from __future__ import annotations

import logging
import math
from time import perf_counter
from typing import Any, NamedTuple, overload

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import ArrayLike, NDArray

from cv_densityf._arguments import THRESHOLDS, Density, DensityRule, check_scores
from cv_densityf._engine import Robust, cuts_graph, is_usac, original, without_graph_cut
from cv_densityf._epipolar import inlier_mask
from cv_densityf._estimate import LOG, MIN_FILTERED, Estimate, run
from cv_densityf._overloads import KEYWORDS, Call, resolve
from cv_densityf._points import as_array, as_matches, as_umat, n_points

_OPENCV_5 = int(cv2.__version__.split(".")[0]) >= 5

#: On more points graph cut runs out of memory or kills the process in OpenCV 5.0, as if it squared
#: their number in 32 bits.
_GRAPH_CUT_DIES_ABOVE = 46_340

#: cv2 takes no array of so many axes.
_CV_MAX_DIM = 32

#: Below this threshold cv2's MAGSAC raises whatever the points are.
_MAGSAC_MIN_THRESHOLD = 1e-3

#: cv2 calls a smaller F[2, 2] zero, and leaves the scale alone.
_FLOAT32_EPSILON = float(np.finfo(np.float32).eps)

#: cv2 leaves masks of these types alone, and answers with one of its own.
_IGNORED_MASKS = frozenset(np.dtype(t) for t in ("i1", "i2", "u2", "i4", "f4", "f8"))


@overload
def findFundamentalMat(
    points1: MatLike,
    points2: MatLike,
    method: int,
    ransacReprojThreshold: float,
    confidence: float,
    maxIters: int,
    mask: MatLike | None = ...,
    *,
    density: Density = ...,
    alpha: float = ...,
    dc_percent: float = ...,
    scores: ArrayLike | None = ...,
) -> tuple[MatLike, MatLike]: ...
@overload
def findFundamentalMat(
    points1: cv2.UMat,
    points2: cv2.UMat,
    method: int,
    ransacReprojThreshold: float,
    confidence: float,
    maxIters: int,
    mask: cv2.UMat | None = ...,
    *,
    density: Density = ...,
    alpha: float = ...,
    dc_percent: float = ...,
    scores: ArrayLike | None = ...,
) -> tuple[MatLike, cv2.UMat]: ...
@overload
def findFundamentalMat(
    points1: MatLike,
    points2: MatLike,
    method: int = ...,
    ransacReprojThreshold: float = ...,
    confidence: float = ...,
    mask: MatLike | None = ...,
    *,
    density: Density = ...,
    alpha: float = ...,
    dc_percent: float = ...,
    scores: ArrayLike | None = ...,
) -> tuple[MatLike, MatLike]: ...
@overload
def findFundamentalMat(
    points1: cv2.UMat,
    points2: cv2.UMat,
    method: int = ...,
    ransacReprojThreshold: float = ...,
    confidence: float = ...,
    mask: cv2.UMat | None = ...,
    *,
    density: Density = ...,
    alpha: float = ...,
    dc_percent: float = ...,
    scores: ArrayLike | None = ...,
) -> tuple[MatLike, cv2.UMat]: ...
@overload
def findFundamentalMat(
    points1: MatLike,
    points2: MatLike,
    params: cv2.UsacParams,
    mask: MatLike | None = ...,
    *,
    density: Density = ...,
    alpha: float = ...,
    dc_percent: float = ...,
    scores: ArrayLike | None = ...,
) -> tuple[MatLike, MatLike]: ...
@overload
def findFundamentalMat(
    points1: cv2.UMat,
    points2: cv2.UMat,
    params: cv2.UsacParams,
    mask: cv2.UMat | None = ...,
    *,
    density: Density = ...,
    alpha: float = ...,
    dc_percent: float = ...,
    scores: ArrayLike | None = ...,
) -> tuple[MatLike, cv2.UMat]: ...
def findFundamentalMat(
    *args: Any,
    density: Density = "contrast",
    alpha: float = 0.011,
    dc_percent: float = 2.0,
    scores: ArrayLike | None = None,
    **kwargs: Any,
) -> Any:
    """Fundamental matrix of two images from matched points, as ``cv2.findFundamentalMat``.

    Takes every call that ``cv2.findFundamentalMat`` takes, positional or by keyword::

        findFundamentalMat(points1, points2, method, ransacReprojThreshold, confidence, maxIters
                           [, mask])
        findFundamentalMat(points1, points2[, method[, ransacReprojThreshold[, confidence
                           [, mask]]]])
        findFundamentalMat(points1, points2, params[, mask])

    For the robust methods on 15 points or more, hypotheses are drawn where the matches are dense in
    (x, y, x', y'), refined on all matches, and chosen by a vote of all matches. Every other call,
    and every call with ``density="off"``, is cv2's own.

    Parameters
    ----------
    points1, points2 : array_like of cv2, shapes (N, 2), (N, 1, 2), (1, N, 2), ... or cv2.UMat
        Matched points in pixels, row i of one with row i of the other. cv2 rounds them to float32.
        (N, 3) is homogeneous: divided by the classic methods, its third column ignored by USAC.
        Rows with NaN or infinity are never inliers; but ``FM_8POINT`` is cv2's own answer, which is
        a matrix of NaN and a mask of ones for a single row with NaN.
    method : int, default cv2.FM_RANSAC
        ``cv2.FM_RANSAC``, ``cv2.FM_LMEDS`` or one of ``cv2.USAC_*``; any other is cv2's own call.
    ransacReprojThreshold : float, default 3.0
        Largest distance of an inlier from its epipolar line (``FM_RANSAC``) or Sampson distance
        (``USAC_*``), pixels. ``FM_LMEDS`` ignores it.
    confidence : float, default 0.99
        Confidence wanted, inside (0, 1); other values are cv2's own call.
    maxIters : int, default 1000
        Bound on the samples of each draw. cv2 takes it only together with the three before it.
    mask : array, optional
        Output array, used as cv2 uses it: a writable contiguous uint8 (N, 1) array is filled and
        returned.
    params : cv2.UsacParams
        All settings of USAC in one object, which is only read. ``randomGeneratorState`` is the
        seed.
    density : {"contrast", "paper", "off"}, default "contrast"
        Where hypotheses are drawn: where matches are denser in 4-D than chance pairing of their
        points explains; on the density peaks of [1]_; or no filter: cv2's own call.
    alpha : float, default 0.011
        Only for ``density="paper"``: a match is kept when its ``rho * delta`` reaches ``alpha``
        times the largest ``rho`` times the largest ``delta``. In [0, 1].
    dc_percent : float, default 2.0
        Only for ``density="paper"``: mean number of neighbours within the cut-off distance, in per
        cent of N. Inside (0, 100].
    scores : (N,) or (N, 1) array_like of float, optional
        Trust in each match, higher is better: 1 - SIFT ratio, or a matcher's confidence. Only the
        order counts, so infinities will do, but not NaN. ``density="paper"`` and cv2's own calls
        use none.

    Returns
    -------
    F : (3, 3) ndarray of float64, or None
        ``[x', y', 1] @ F @ [x, y, 1] == 0``; None when no model was found. As in cv2, the classic
        methods scale it to ``F[2, 2] == 1`` and USAC to nothing in particular, and exactly 7 points
        give a classic method up to three matrices below each other, (9, 3).
    mask : (N, 1) ndarray of uint8, cv2.UMat if the points were, or None
        1 for inliers: the method's own rule applied to ``F`` and all N matches. The classic methods
        have none for fewer than 7 points, nor has ``params`` where it finds no model: None then, or
        an empty UMat if the points were one, or the ``mask`` passed in, as it was for up to 7
        points, else in zeros.

    Raises
    ------
    cv2.error
        Where cv2 refuses the call: it is cv2's own error. ``USAC_*`` and ``params`` refuse fewer
        than 7 points, ``USAC_FM_8PTS`` fewer than 8. With a threshold of 1e-3 and less MAGSAC,
        which is cv2's own call then, mostly raises.
    ValueError
        For a wrong ``density``, ``alpha``, ``dc_percent`` or ``scores``.

    See Also
    --------
    cv_densityf.estimate_fundamental : the same with method names and a full account of the result.

    Notes
    -----
    On the default path the threshold, the confidence and the seed of ``params`` count, its
    sampler only as far as PROSAC's means that the rows come best first. The threshold rules the
    mask; the search has one of its own, a hundredth of the points' spread, up to 3 px, and of
    few matches more, brought to within a factor of two of it, but never below half of its own,
    nor below .8 steps of a lattice that all points are on. There are up to sixteen draws, twice
    as many for more than 1,000 matches, and one more for ``FM_LMEDS``; each ends after at most
    ``maxIters`` and a thousand samples.
    ``density="paper"`` draws at the threshold given, and up to ``maxIters`` samples.

    Of more than 1,000 matches density looks at a seeded 1,000, without ``scores`` at 250 if
    most of these are right, or at all if they lead to no agreement, and of more than 5,000 a
    seeded 5,000 are searched; up to 100,000 choose and refine the result, and the mask is over
    all.

    Deliberate differences from cv2: where ``FM_RANSAC`` and ``FM_LMEDS`` find no model cv2 returns
    uninitialised memory as the mask; there, and with ``cv2.UsacParams``, it leaves a given ``mask``
    as it was. Here both are zeros.
    Where cv2's solver raises on valid points (but for MAGSAC at so small a threshold), or would
    take the process down (graph cut on more than 46,340 points in OpenCV 5.0), this function goes
    on with another engine and answers ``None`` only when that finds no model either.

    References
    ----------
    .. [1] Hao Wu and Yi Wan, "Clustering assisted fundamental matrix estimation", 2015.

    Examples
    --------
    >>> import cv2
    >>> import numpy as np
    >>> from cv_densityf import findFundamentalMat
    >>> rng = np.random.default_rng(0)
    >>> points = rng.uniform((-2, -2, 4), (2, 2, 8), (100, 3))
    >>> points1 = 800 * points[:, :2] / points[:, 2:]
    >>> moved = points + [1, 0.2, 0.1]
    >>> points2 = 800 * moved[:, :2] / moved[:, 2:]
    >>> F, mask = findFundamentalMat(points1, points2, cv2.USAC_MAGSAC, 1.0, 0.999, 10000)
    >>> F.shape, mask.shape, int(mask.sum())
    ((3, 3), (100, 1), 100)
    """
    return find(args, kwargs, DensityRule(density, alpha, dc_percent), scores)[0]


def find(
    args: tuple[Any, ...],
    kwargs: dict[str, Any],
    rule: DensityRule,
    scores: ArrayLike | None = None,
) -> tuple[Any, Estimate | None]:
    """Answer a call of cv2's function, and say how: None where the answer is cv2's own."""
    start, density = perf_counter(), rule.density
    call = resolve(args, kwargs)
    if call is None:
        try:
            return _passed_on(original(*args, **kwargs), None, density, start)
        except cv2.error as error:
            if kwargs.keys() - KEYWORDS:
                error.add_note("cv_densityf adds density, alpha, dc_percent and scores to these.")
            raise
    usac = is_usac(call.method)
    points1, points2 = as_array(call.points1), as_array(call.points2)
    n = None if points1 is None or points2 is None else _common_length(points1, points2, usac)
    trust = None if scores is None else check_scores(scores, n)
    size = _longest_side(call.points1) if n is None else n
    if _OPENCV_5 and size > _GRAPH_CUT_DIES_ABOVE and cuts_graph(call.method, call.params):
        method, params = without_graph_cut(call.method, call.params)
        third = (method, *call[3:6]) if params is None else (params,)
        args, kwargs = (*call[:2], *third, call.mask), {}
    if points1 is None or points2 is None or n is None:
        answer = _cv2s_answer(call, size, args, kwargs)
        return _passed_on(answer, None, density, start)

    slot = _mask_slot(call, n, usac)
    ordinary = n >= MIN_FILTERED and _is_ordinary(call)
    if density == "off" or not ordinary or slot is None:
        try:
            answer = _cv2s_answer(call, n, args, kwargs)
            return _passed_on(answer, n, density, start)
        except cv2.error as error:
            if slot is None or not _is_solver_failure(error, call, n, usac):
                raise
        if not ordinary:
            return _passed_on(_no_model(call, n, usac, slot), n, density, start)
    X = as_matches(points1, points2, n, usac)
    robust = Robust(call.method, call.threshold, call.confidence, call.max_iters, call.params)
    estimate = run(
        X,
        robust,
        rule,
        scores=trust,
        seed=0 if call.params is None else call.params.randomGeneratorState,
    )
    if estimate.F is None:
        return _no_model(call, n, usac, slot), estimate
    F, mask = np.array(estimate.F, dtype=np.float64, order="C"), estimate.mask
    if not usac and abs(F[2, 2]) > _FLOAT32_EPSILON * np.abs(F).max():
        # The classic methods' scale, and the mask of exactly these numbers.
        F /= F[2, 2]
        mask = inlier_mask(F, X, robust.rule, robust.threshold)
    return (F, slot.deliver(mask)), estimate


def _passed_on(answer: Any, n: int | None, density: str, start: float) -> tuple[Any, None]:
    """Tell the log of an answer that is cv2's own; `run` tells of the others."""
    if LOG.isEnabledFor(logging.DEBUG):
        if n is None:
            why = "only cv2 can read its arguments"
        elif density == "off":
            why = "density is off"
        elif n < MIN_FILTERED:
            why = f"fewer than {MIN_FILTERED} matches"
        else:
            why = "its method, numbers or mask are not for the density pipeline"
        LOG.debug(
            "%s matches, engine cv2, %.1f ms: cv2's own call, since %s",
            "unread" if n is None else n,
            1e3 * (perf_counter() - start),
            why,
        )
    return answer, None


class _MaskSlot(NamedTuple):
    """Where the mask of a call goes: into ``given``, or else into a new array or UMat."""

    given: NDArray[np.uint8] | None
    as_umat: bool

    def deliver(self, mask: NDArray[Any]) -> NDArray[np.uint8] | cv2.UMat:
        if self.given is not None:
            self.given.reshape(-1)[:] = mask
            return self.given
        column = np.empty((len(mask), 1), dtype=np.uint8)
        column[:, 0] = mask
        return as_umat(column) if self.as_umat else column


def _mask_slot(call: Call, n: int, usac: bool) -> _MaskSlot | None:
    """Decide what cv2 does with the given mask; None where only cv2 can tell."""
    mask = call.mask
    as_umat = isinstance(call.points1, cv2.UMat) or isinstance(call.points2, cv2.UMat)
    if mask is None:
        return _MaskSlot(None, as_umat)
    if as_umat:
        return None
    if isinstance(mask, (int, float)) and call.params is None:
        # cv2 takes a number for an array of its own and drops it: the fate of maxIters=1000.0.
        return _MaskSlot(None, False)
    if type(mask) is not np.ndarray or not mask.flags.writeable or not _is_plain(mask):
        return None
    if mask.dtype in _IGNORED_MASKS or (mask.dtype == np.uint8 and mask.size != n):
        return _MaskSlot(None, False)
    if mask.dtype != np.uint8:
        return None
    if mask.shape == (n, 1) or (mask.shape == (n,) and not (usac and _OPENCV_5)):
        return _MaskSlot(mask, False)
    if mask.shape in ((1, n), (n,)):
        return _MaskSlot(None if usac else mask, False)
    return None


def _is_plain(array: NDArray[Any]) -> bool:
    """Whether cv2 takes the array for an output: it minds strides that numpy does not."""
    steps = (*array.strides, array.itemsize)
    descending = all(
        side < 2 or step >= inner
        for side, step, inner in zip(array.shape, steps, steps[1:], strict=False)
    )
    return 0 < array.ndim < _CV_MAX_DIM and array.flags.c_contiguous and descending


def _longest_side(points: Any) -> int:
    """Guess the number of points of what only cv2 can read."""
    array = points.get() if isinstance(points, cv2.UMat) else points
    return max(getattr(array, "shape", ()), default=0)


def _common_length(points1: NDArray[Any], points2: NDArray[Any], usac: bool) -> int | None:
    n = n_points(points1, usac)
    return n if n == n_points(points2, usac) else None


def _is_ordinary(call: Call) -> bool:
    """Whether this is a robust method with numbers that mean to cv2 what they say."""
    params = call.params
    if params is None:
        # The others are not robust estimators, and an unknown number is LMEDS to cv2.
        if not (is_usac(call.method) or call.method in (cv2.FM_LMEDS, cv2.FM_RANSAC)):
            return False
        magsac = call.method == cv2.USAC_MAGSAC
    else:
        if not (
            params.sampler in range(4)
            and params.score in range(4)
            and params.loMethod in range(5)
            and params.neighborsSearch in range(3)
            and params.loSampleSize >= 0
        ):
            return False
        magsac = params.score == cv2.SCORE_METHOD_MAGSAC
    lowest = _MAGSAC_MIN_THRESHOLD if magsac else THRESHOLDS[0]
    return (
        (lowest < call.threshold < THRESHOLDS[1] or call.method == cv2.FM_LMEDS)
        and 0.0 < call.confidence < 1.0
        and call.max_iters > 0
    )


def _cv2s_answer(call: Call, n: int, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Make cv2's own call, and put zeros where no model leaves old or uninitialised memory."""
    F, mask = original(*args, **kwargs)
    if F is not None or mask is None or call.method == cv2.FM_8POINT:
        return F, mask
    garbage = mask.get() if isinstance(mask, cv2.UMat) else mask
    # Fewer than 7 points leave the mask alone; exactly 7 are all inliers to cv2. An empty UMat
    # gets no array.
    if garbage is not None and n > 7:
        if isinstance(mask, cv2.UMat):
            no_mask: Any = None
            cv2.copyTo(as_umat(np.zeros_like(garbage)), no_mask, mask)
        elif mask.flags.writeable:
            mask[...] = 0
    return F, mask


def _is_solver_failure(error: cv2.error, call: Call, n: int, usac: bool) -> bool:
    """Whether cv2 failed on the points, and not for the way it was called."""
    # Its code may be that of an earlier error.
    if f"({cv2.Error.StsAssert}:" not in str(error):
        return False
    if not usac:
        return n >= 7 and not math.isnan(call.confidence)
    return n >= (8 if call.method == cv2.USAC_FM_8PTS else 7) and _is_ordinary(call)


def _no_model(call: Call, n: int, usac: bool, slot: _MaskSlot) -> tuple[None, Any]:
    """Give cv2's answer for "no model found"."""
    if call.params is not None:
        if isinstance(call.mask, np.ndarray):
            call.mask[...] = 0  # of any kind, since it is what comes back
        return None, cv2.UMat() if call.mask is None and slot.as_umat else call.mask
    # cv2's direct solvers count every point as an inlier, model or not.
    direct = not usac and (n == 7 or call.method == cv2.FM_8POINT)
    return None, slot.deliver(np.full(n, direct))
