"""The method of Wu and Wan to the letter: density peaks pass, RANSAC with samples of eight."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cv_densityf._consensus import Consensus
from cv_densityf._density import DensityPeaksResult, density_peaks
from cv_densityf._epipolar import eight_point, point_line_squared

Floats = NDArray[np.floating]
Ints = NDArray[np.intp]

#: Samples solved at a time.
_BATCH = 64


def paper_support(
    X: Floats, alpha: float, dc_percent: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Reliability gamma / (rho_max * delta_max), and the rows that reach ``alpha``.

    The rule of Wu and Wan, section 2.6: a match whose rho * delta is lower than
    alpha * rho_max * delta_max is an outlier.
    """
    reliability = relative_gamma(density_peaks(X, dc_percent=dc_percent))
    return reliability, reliability >= alpha


def relative_gamma(peaks: DensityPeaksResult) -> NDArray[np.float64]:
    """Return gamma / (rho_max * delta_max), all ones where that is 0, (n,)."""
    scale = float(peaks.rho.max() * peaks.delta.max())
    return peaks.gamma / scale if scale > 0 else np.ones(len(peaks.gamma))


def eight_point_ransac(
    X: Floats, *, threshold: float, confidence: float, max_iters: int, seed: int
) -> Consensus | None:
    """RANSAC with samples of eight matches, as step 5 of Wu and Wan has it.

    The best sample's matrix is returned as it is, without a fit to its inliers. The number of
    samples k follows ``1 - confidence = (1 - (d / n)^8)^k`` for d inliers among n matches, and a
    match is an inlier if it is within ``threshold`` of its epipolar line in both images.

    Parameters
    ----------
    X : array, shape (n, 4)
        Finite matches.
    threshold : float
        Pixels.
    confidence : float
        Probability of one sample without outliers.
    max_iters : int
        Most samples.
    seed : int
        Of the samples.

    Returns
    -------
    Consensus or None
        None with fewer than eight matches, or if no sample has eight inliers.
    """
    n = len(X)
    if n < 8:
        return None
    rng = np.random.default_rng(abs(seed))
    best, most, drawn = None, 7, 0
    needed: float = max_iters
    while drawn < needed:
        size = min(_BATCH, max_iters - drawn)
        F = eight_point(X[_samples(rng, n, size)])
        counts = np.count_nonzero(point_line_squared(F, X) <= threshold * threshold, axis=1)
        for candidate, inliers in zip(F, counts.tolist(), strict=True):
            drawn += 1
            if inliers > most:
                best, most = candidate, inliers
                needed = min(max_iters, _samples_needed(inliers / n, confidence))
            if drawn >= needed:
                break
    if best is None:
        return None
    reason = f"{most} of the {n} matches that passed the paper's rule agree"
    return Consensus(best, np.ones(n), (float(most),), drawn, False, reason)


def _samples_needed(inlier_ratio: float, confidence: float) -> float:
    """Count the samples of eight until one is clean with the given confidence; at least one."""
    clean = min(inlier_ratio**8, 1.0 - 1e-12)
    return max(1.0, float(np.log1p(-confidence) / np.log1p(-clean)))


def _samples(rng: np.random.Generator, n: int, size: int) -> Ints:
    """Draw sets of eight different rows, (size, 8)."""
    if n < 64:
        return rng.random((size, n)).argpartition(7, axis=1)[:, :8]
    samples = rng.integers(n, size=(size, 8))
    while True:
        ordered = np.sort(samples, axis=1)
        repeated = (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)
        if not repeated.any():
            return samples
        samples[repeated] = rng.integers(n, size=(int(repeated.sum()), 8))
