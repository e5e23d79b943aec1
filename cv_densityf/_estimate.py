"""The pipeline: matches and options in, one `Estimate` out."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cv_densityf._engine import Robust, method_flag
from cv_densityf._epipolar import inlier_mask, sampson_distance
from cv_densityf._prefilter import contrast_support, paper_support

MIN_FILTERED = 15


@dataclass(frozen=True, eq=False)
class Estimate:
    """Fundamental matrix, its inliers and how they were found."""

    F: NDArray[np.float64] | None
    mask: NDArray[np.bool_]
    kept: NDArray[np.bool_]
    reliability: NDArray[np.float64]
    n_draws: int
    engine: str
    reason: str
    timings: dict[str, float] = field(default_factory=dict)
    votes: tuple[float, ...] = ()

    def __bool__(self) -> bool:
        return self.F is not None

    @property
    def n_inliers(self) -> int:
        """Number of inliers."""
        return int(np.count_nonzero(self.mask))


def run(
    X: NDArray[np.float64],
    robust: Robust,
    *,
    density: str = "contrast",
    alpha: float = 0.011,
    dc_percent: float = 2.0,
    scores: NDArray[np.float64] | None = None,
    seed: int = 0,
) -> Estimate:
    n = len(X)
    finite = np.isfinite(X).all(axis=1)
    kept = finite.copy()
    reliability = finite.astype(float)
    if density != "off" and finite.sum() >= MIN_FILTERED:
        r, k = (
            contrast_support(X[finite])
            if density == "contrast"
            else paper_support(X[finite], alpha, dc_percent)
        )
        reliability[finite], kept[finite] = r, k
    best, votes = None, []
    for rows in (kept, finite):
        F, _ = Robust(cv2.USAC_MAGSAC, robust.threshold, robust.confidence, robust.max_iters).plain(
            X[rows, :2], X[rows, 2:]
        )
        if F is not None:
            d = sampson_distance(F, X[finite])
            votes.append(float(np.maximum(0, 1 - (d / robust.threshold) ** 2).sum()))
            if votes[-1] == max(votes):
                best = F
    mask = (
        np.zeros(n, bool) if best is None else inlier_mask(best, X, robust.rule, robust.threshold)
    )
    return Estimate(
        F=best, mask=mask, kept=kept, reliability=reliability, n_draws=len(votes),
        engine="usac_magsac", reason="found" if best is not None else "no F", votes=tuple(votes),
    )


def estimate_fundamental(
    points1: ArrayLike,
    points2: ArrayLike,
    *,
    method: str | int = "usac_accurate",
    threshold: float = 1.0,
    confidence: float = 0.999,
    max_iters: int = 5000,
    density: str = "contrast",
    alpha: float = 0.011,
    dc_percent: float = 2.0,
    scores: ArrayLike | None = None,
    random_state: int = 0,
) -> Estimate:
    X = np.hstack([np.asarray(points1, float).reshape(-1, 2), np.asarray(points2, float).reshape(-1, 2)])
    return run(
        np.ascontiguousarray(X),
        Robust(method_flag(method), threshold, confidence, max_iters),
        density=density, alpha=alpha, dc_percent=dc_percent,
        scores=None if scores is None else np.asarray(scores, float), seed=random_state,
    )
