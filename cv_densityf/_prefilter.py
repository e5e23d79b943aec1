"""From the density of the matches to a reliability per match and the rows to draw from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cv_densityf._density import density_peaks

Floats = NDArray[np.floating]
Bools = NDArray[np.bool_]

#: Neighbours looked at around each match, in each image.
N_NEIGHBORS = 12
#: Rows compared at a time, so that the comparison table stays in the cache.
_CHUNK = 4096


def density_contrast(X: Floats, n_neighbors: int | None = None) -> NDArray[np.float64]:
    """How much denser the matches lie around each match in 4-D than chance would put them.

    A neighbour of a match in the first image and in the second one is a neighbour in 4-D. If points
    were paired at random, two neighbourhoods of k matches out of n would share k^2 / n; around a
    right match most neighbours are shared. Each shared neighbour counts 1 / rank, rank being its
    place (1, 2, ...) in the list where it stands later, which averages the density over all
    neighbourhood sizes up to ``n_neighbors``. Copies of a match do not count. Locality preserving
    matching (Ma et al., IJCV 2019) counts shared neighbours, too.

    Parameters
    ----------
    X : array, shape (n, 4)
        Finite matches x, y, x', y', n >= 2.
    n_neighbors : int, optional
        Largest neighbourhood, `N_NEIGHBORS` by default.

    Returns
    -------
    array, shape (n,)
        Sum over the shared neighbours, 0 for a match that shares none.
    """
    n = len(X)
    k = min(n_neighbors or N_NEIGHBORS, n - 1)
    near1 = _neighbors(X[:, :2], k)
    near2 = _neighbors(X[:, 2:], k)
    weight = 1.0 / np.arange(1, k + 1)
    contrast = np.empty(n)
    for start in range(0, n, _CHUNK):
        rows = slice(start, start + _CHUNK)
        shared = near1[rows, :, None] == near2[rows, None, :]
        row, rank1, rank2 = np.nonzero(shared)
        # A copy of a match, such as SIFT's second orientation, says nothing for it.
        other = (X[rows][row] != X[near1[rows][row, rank1]]).any(axis=1)
        counts = weight[np.maximum(rank1, rank2)] * other
        contrast[rows] = np.bincount(row, counts, minlength=len(shared))
    return contrast


def _neighbors(points: Floats, k: int) -> NDArray[np.intp]:
    """Rows of the k nearest other points, nearest first, (n, k)."""
    near = cKDTree(points).query(points, k + 1)[1]
    # Among duplicates the point itself need not come first.
    own = near == np.arange(len(points))[:, None]
    own[~own.any(axis=1), -1] = True
    return np.asarray(near[~own].reshape(len(points), k))


def ranks(values: Floats) -> NDArray[np.float64]:
    """Rank of each value, from 0 for the smallest to 1 for the largest; equal values share one."""
    ordered = np.sort(values)
    twice = ordered.searchsorted(values, "left") + ordered.searchsorted(values, "right") - 1
    return twice / (2.0 * max(len(values) - 1, 1))


def contrast_reliability(X: Floats) -> NDArray[np.float64]:
    """Rank in [0, 1] of each match's density contrast, 1 for the most reliable, (n,)."""
    return ranks(density_contrast(X))


def with_scores(reliability: Floats, scores: Floats) -> NDArray[np.float64]:
    """Rank of a sum in which a rank by density, which tells more, counts twice that by score."""
    return ranks(2 * reliability + ranks(scores))


def contrast_support(X: Floats, scores: Floats | None = None) -> tuple[NDArray[np.float64], Bools]:
    """Reliability of each match, and the denser half.

    With ``scores`` (n,), higher for more trusted matches, both count: see `with_scores`.
    """
    reliability = contrast_reliability(X)
    if scores is not None:
        reliability = with_scores(reliability, scores)
    return reliability, reliability >= 0.5


def paper_support(X: Floats, alpha: float, dc_percent: float) -> tuple[NDArray[np.float64], Bools]:
    """Reliability gamma / (rho_max * delta_max), and the rows that reach ``alpha``.

    The rule of Wu and Wan, section 2.6: a match whose rho * delta is lower than
    alpha * rho_max * delta_max is an outlier.
    """
    peaks = density_peaks(X, dc_percent=dc_percent)
    scale = float(peaks.rho.max() * peaks.delta.max())
    reliability = peaks.gamma / scale if scale > 0 else np.ones(len(X))
    return reliability, reliability >= alpha
