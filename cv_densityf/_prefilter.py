"""From the density of the matches to a reliability per match and the set to draw from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Floats = NDArray[np.floating]


def contrast_reliability(X: Floats, n_neighbors: int = 8) -> NDArray[np.float64]:
    """Rank in [0, 1] of each match's density contrast, 1 for the most reliable, (n,)."""
    n = len(X)
    k = min(n_neighbors, n - 1) + 1
    logs = [
        np.log(cKDTree(Y).query(Y, [k])[0][:, 0] + 1e-3) for Y in (X[:, :2], X[:, 2:], X)
    ]
    contrast = logs[0] + logs[1] - 2 * logs[2]
    ranks = np.empty(n)
    ranks[np.argsort(contrast, kind="stable")] = np.arange(n)
    return ranks / max(n - 1, 1)


def contrast_support(X: Floats) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Reliability of each match, and the half that hypotheses are drawn from."""
    reliability = contrast_reliability(X)
    return reliability, reliability >= 0.5


def paper_support(
    X: Floats, alpha: float, dc_percent: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Reliability gamma / (rho_max * delta_max), and the rows that reach ``alpha``."""
    from cv_densityf._density import density_peaks

    peaks = density_peaks(X, dc_percent=dc_percent)
    scale = peaks.rho.max() * peaks.delta.max()
    reliability = peaks.gamma / scale if scale > 0 else np.ones(len(X))
    return reliability, reliability >= alpha
