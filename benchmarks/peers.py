"""Every estimator behind one call: a pair and settings in, F or None out.

F is (3, 3) with ``[x', y', 1] @ F @ [x, y, 1] == 0``. Adapters do not raise on hard data.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from importlib.util import find_spec
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.data import Pair
from benchmarks.lpm import locality_preserving_matches
from benchmarks.metrics import usable
from cv_densityf import _engine
from cv_densityf._arguments import Density
from cv_densityf._epipolar import Frame, polish
from cv_densityf._estimate import MIN_FILTERED
from cv_densityf.cv2_api import findFundamentalMat

Floats = NDArray[np.float64]
Matches = tuple[Floats, Floats | None]

#: Width of the polish's weights, in thresholds, and its steps: the best of a few tried.
POLISH_SCALE, POLISH_STEPS = 0.7, 8


@dataclass(frozen=True)
class Settings:
    """What every method is told: pixels, probability, iterations, seed."""

    threshold: float = 1.0
    confidence: float = 0.999
    max_iters: int = 5000
    seed: int = 0


Estimator = Callable[[Pair, Settings], Floats | None]


@dataclass(frozen=True)
class Method:
    """A named estimator, and the module it needs."""

    name: str
    estimate: Estimator
    needs: str = "cv2"

    @property
    def installed(self) -> bool:
        """Whether the module it needs can be imported."""
        return find_spec(self.needs) is not None


def _in_score_order(pair: Pair) -> Matches:
    if pair.scores is None:
        return pair.X, None
    order = np.argsort(-pair.scores, kind="stable")
    return pair.X[order], pair.scores[order]


def _rows(pair: Pair, progressive: bool) -> Floats:
    """Return the matches, best first for a sampler that takes them so."""
    return _in_score_order(pair)[0] if progressive else pair.X


def _split(X: Floats) -> tuple[Floats, Floats]:
    return np.ascontiguousarray(X[:, :2]), np.ascontiguousarray(X[:, 2:])


def _cv2(X: Floats, flag: int, s: Settings) -> Floats | None:
    if flag == cv2.USAC_ACCURATE and len(X) > _engine.GRAPH_CUT_MAX:
        return None
    F, _ = _engine.Robust(flag, s.threshold, s.confidence, s.max_iters).plain(*_split(X))
    return usable(F)


def _cv2_method(flag: int) -> Estimator:
    def estimate(pair: Pair, s: Settings) -> Floats | None:
        # PROSAC's callers hand the best match first; all others get the shuffled rows.
        return _cv2(_rows(pair, flag == cv2.USAC_PROSAC), flag, s)

    return estimate


def _cv2_magsac(X: Floats, s: Settings) -> Floats | None:
    return _cv2(X, cv2.USAC_MAGSAC, s)


def _cv2_prosac_magsac(X: Floats, s: Settings) -> Floats | None:
    """cv2's MAGSAC preset with PROSAC's sampler; the rows are in score order."""
    params = cv2.UsacParams()
    params.sampler = cv2.SAMPLING_PROSAC
    params.score = cv2.SCORE_METHOD_MAGSAC
    params.loMethod = cv2.LOCAL_OPTIM_SIGMA
    params.loIterations = 10
    params.loSampleSize = 50
    params.threshold = s.threshold
    params.confidence = s.confidence
    params.maxIterations = s.max_iters
    params.randomGeneratorState = s.seed
    robust = _engine.Robust(cv2.USAC_MAGSAC, s.threshold, s.confidence, s.max_iters, params)
    return usable(robust.plain(*_split(X))[0])


def _poselib(pair: Pair, s: Settings, progressive: bool) -> Floats | None:
    import poselib

    options = {
        "max_epipolar_error": s.threshold,
        "success_prob": s.confidence,
        "max_iterations": s.max_iters,
        "seed": s.seed,
        "progressive_sampling": progressive,
    }
    points = _split(_rows(pair, progressive))
    return usable(poselib.estimate_fundamental(*points, options, {})[0])


def _pycolmap(X: Floats, s: Settings) -> Floats | None:
    import pycolmap

    options = pycolmap.RANSACOptions()
    options.max_error = s.threshold
    options.confidence = s.confidence
    options.max_num_trials = s.max_iters
    options.min_num_trials = min(options.min_num_trials, s.max_iters)
    options.random_seed = s.seed
    found = pycolmap.estimate_fundamental_matrix(*_split(X), options)
    return usable(found["F"]) if found else None


def _pydegensac(X: Floats, s: Settings) -> Floats | None:
    import pydegensac

    F, _ = pydegensac.findFundamentalMatrix(
        *_split(X), px_th=s.threshold, conf=s.confidence, max_iters=s.max_iters, seed=s.seed
    )
    return usable(F)


def _pymagsac(pair: Pair, s: Settings) -> Floats | None:
    import pymagsac

    F, _ = pymagsac.findFundamentalMatrix(
        pair.X,
        *pair.size1,
        *pair.size2,
        probabilities=[],
        sampler=0,
        sigma_th=s.threshold,
        conf=s.confidence,
        max_iters=s.max_iters,
    )
    return usable(F)


def _pygcransac(pair: Pair, s: Settings, progressive: bool) -> Floats | None:
    import pygcransac

    F, _ = pygcransac.findFundamentalMatrix(
        np.ascontiguousarray(_rows(pair, progressive)),
        *(*pair.size1[::-1], *pair.size2[::-1]),
        np.empty(0),
        threshold=s.threshold,
        conf=s.confidence,
        max_iters=s.max_iters,
        sampler=1 if progressive else 0,
    )
    return usable(F)


def _pysuperansac(pair: Pair, s: Settings, progressive: bool) -> Floats | None:
    import pysuperansac

    # A call divides the threshold in its settings by the points' scale.
    settings = pysuperansac.RANSACSettings()
    settings.inlier_threshold = s.threshold
    settings.confidence = s.confidence
    settings.max_iterations = s.max_iters
    settings.min_iterations = min(settings.min_iterations, s.max_iters)
    if not progressive:
        settings.sampler = pysuperansac.SamplerType.Uniform
    X = np.ascontiguousarray(_rows(pair, progressive))
    sizes = [float(side) for side in (*pair.size1, *pair.size2)]
    try:
        F = pysuperansac.estimateFundamentalMatrix(X, sizes, [], config=settings)[0]
    except RuntimeError:
        return None
    return usable(F)


def _gms(pair: Pair, X: Floats) -> NDArray[np.bool_]:
    """Grid-based motion statistics, Bian et al. CVPR 2017, as cv2 has it."""
    # cv2 writes outside its grid for points outside the image.
    sizes = (pair.size1, pair.size2)
    inside = [np.clip(p, 0, np.array(size) - 1.0) for p, size in zip(_split(X), sizes, strict=True)]
    # cv2's stubs know neither of these calls.
    convert: Any = cv2.KeyPoint.convert
    match_gms: Any = cv2.xfeatures2d.matchGMS
    keypoints = [convert(p.astype(np.float32)) for p in inside]
    matches = [cv2.DMatch(i, i, 0.0) for i in range(len(X))]
    kept = np.zeros(len(X), dtype=bool)
    try:
        found = match_gms(*sizes, *keypoints, matches, withRotation=True, withScale=True)
    except cv2.error:
        return kept
    kept[[match.queryIdx for match in found]] = True
    return kept


def _lpm(pair: Pair, X: Floats) -> NDArray[np.bool_]:
    return locality_preserving_matches(X)


def _filtered(
    keep: Callable[[Pair, Floats], NDArray[np.bool_]],
    solve: Callable[[Floats, Settings], Floats | None],
    *,
    in_order: bool = False,
) -> Estimator:
    """Filter, then estimate on what is left."""

    def estimate(pair: Pair, s: Settings) -> Floats | None:
        X = _rows(pair, in_order)
        kept = keep(pair, X)
        return solve(X[kept] if np.count_nonzero(kept) >= MIN_FILTERED else X, s)

    return estimate


def _polished(estimate: Estimator) -> Estimator:
    """Refine on all matches what another estimator found.

    The steps are those of ours, but more of them, at one width, which follows from the caller's
    threshold.
    """

    def estimate_and_polish(pair: Pair, s: Settings) -> Floats | None:
        F = estimate(pair, s)
        if F is None:
            return None
        frame = Frame(pair.X)
        scales = [POLISH_SCALE * s.threshold] * POLISH_STEPS
        return usable(frame.leave(polish(frame, frame.enter(F[None]), scales))[0])

    return estimate_and_polish


def _ours(flag: int, with_scores: bool, density: Density = "contrast") -> Estimator:
    def estimate(pair: Pair, s: Settings) -> Floats | None:
        X, scores = _in_score_order(pair) if flag == cv2.USAC_PROSAC else (pair.X, pair.scores)
        F, _ = findFundamentalMat(
            *_split(X),
            flag,
            s.threshold,
            s.confidence,
            s.max_iters,
            density=density,
            scores=scores if with_scores else None,
        )
        return usable(F)

    return estimate


#: cv2's own methods that ours are held against, by their cv2 names.
CV2_METHODS = (
    "FM_RANSAC",
    "FM_LMEDS",
    "USAC_DEFAULT",
    "USAC_FAST",
    "USAC_ACCURATE",
    "USAC_MAGSAC",
    "USAC_PROSAC",
)


def _all_methods() -> list[Method]:
    methods = []
    for name in CV2_METHODS:
        flag = getattr(cv2, name)
        methods.append(Method(f"cv2:{name}", _cv2_method(flag)))
    methods += [
        Method("cv2:PROSAC+MAGSAC", lambda pair, s: _cv2_prosac_magsac(_rows(pair, True), s)),
        Method("poselib", lambda pair, s: _poselib(pair, s, False), "poselib"),
        Method("poselib:PROSAC", lambda pair, s: _poselib(pair, s, True), "poselib"),
        Method("pycolmap", lambda pair, s: _pycolmap(pair.X, s), "pycolmap"),
        Method("pydegensac", lambda pair, s: _pydegensac(pair.X, s), "pydegensac"),
        Method("pymagsac", _pymagsac, "pymagsac"),
        Method("pygcransac", lambda pair, s: _pygcransac(pair, s, False), "pygcransac"),
        Method("pygcransac:PROSAC", lambda pair, s: _pygcransac(pair, s, True), "pygcransac"),
        Method("pysuperansac", lambda pair, s: _pysuperansac(pair, s, False), "pysuperansac"),
        Method("pysuperansac:PROSAC", lambda pair, s: _pysuperansac(pair, s, True), "pysuperansac"),
    ]
    gms = _filtered(_gms, _cv2_magsac)
    lpm = _filtered(_lpm, _cv2_magsac)
    lpm_prosac = _filtered(_lpm, _cv2_prosac_magsac, in_order=True)
    methods += [
        Method("gms>USAC_MAGSAC", gms),
        Method("lpm>USAC_MAGSAC", lpm),
        Method("lpm>PROSAC+MAGSAC", lpm_prosac),
        # What the polish alone is worth, and the filters with it.
        Method("cv2:USAC_ACCURATE>polish", _polished(_cv2_method(cv2.USAC_ACCURATE))),
        Method("gms>USAC_MAGSAC>polish", _polished(gms)),
        Method("lpm>USAC_MAGSAC>polish", _polished(lpm)),
        Method("lpm>PROSAC+MAGSAC>polish", _polished(lpm_prosac)),
    ]
    for name in CV2_METHODS:
        flag = getattr(cv2, name)
        methods.append(Method(f"ours:{name}", _ours(flag, False)))
        methods.append(Method(f"ours:{name}+scores", _ours(flag, True)))
    methods.append(Method("ours:FM_RANSAC,paper", _ours(cv2.FM_RANSAC, False, density="paper")))
    return methods


METHODS: dict[str, Method] = {method.name: method for method in _all_methods()}


def choose(patterns: Sequence[str]) -> tuple[list[Method], list[str]]:
    """Pick methods by name or shell pattern; also name those that are not installed.

    Raises
    ------
    ValueError
        If a pattern matches no method.
    """
    chosen: dict[str, Method] = {}
    for pattern in patterns:
        found = {n: m for n, m in METHODS.items() if fnmatchcase(n, pattern)}
        if not found:
            raise ValueError(f"no method {pattern!r}; choose from {', '.join(METHODS)}")
        chosen |= found
    return (
        [m for m in chosen.values() if m.installed],
        [n for n, m in chosen.items() if not m.installed],
    )
