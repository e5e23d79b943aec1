"""Locality preserving matching: which matches keep their neighbours.

Ma, Zhao, Jiang, Zhou, Guo: Locality preserving matching, IJCV 127 (2019) 512-531, written from the
paper. A true match keeps its neighbours: those in image 1 are its neighbours in image 2 too, and
they move alike. The cost of a match is the share of neighbours that it loses or that move
otherwise, averaged over a few neighbourhood sizes; a second round takes neighbours among the
first's survivors.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

#: Neighbourhood sizes the cost is averaged over.
SIZES = (4, 6, 8)
#: Largest cost of a survivor, first and second round.
MAX_COST = (0.8, 0.5)
#: Two motions are alike if cosine times ratio of lengths is at least this.
MIN_ALIKE = 0.2


def locality_preserving_matches(X: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which matches x, y, x', y' of X (n, 4) survive, (n,) bool."""
    survivors = np.ones(len(X), dtype=bool)
    for max_cost in MAX_COST:
        if np.count_nonzero(survivors) <= max(SIZES):
            break
        survivors = _cost(X, survivors) <= max_cost
    return survivors


def _cost(X: NDArray[np.float64], among: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Share of neighbours lost or moving otherwise, mean over `SIZES`, in [0, 1], (n,)."""
    near1, near2 = _neighbours(X[:, :2], among), _neighbours(X[:, 2:], among)
    motion = X[:, 2:] - X[:, :2]
    length = np.linalg.norm(motion, axis=1)
    alike = _alike(motion, length, near1)
    shared = near1[:, :, None] == near2[:, None, :]
    kept = [(shared[:, :k, :k].any(axis=2) & alike[:, :k]).mean(axis=1) for k in SIZES]
    return np.asarray(1.0 - np.mean(kept, axis=0))


def _neighbours(points: NDArray[np.float64], among: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Nearest other rows that are in ``among``, (n, max(SIZES))."""
    candidates = np.flatnonzero(among)
    k = max(SIZES)
    near = candidates[cKDTree(points[candidates]).query(points, k + 1)[1]]
    # A row is its own neighbour, and not always the first: points may coincide.
    own = near == np.arange(len(points))[:, None]
    order = np.argsort(own, axis=1, kind="stable")
    return np.take_along_axis(near, order, axis=1)[:, :k]


def _alike(
    motion: NDArray[np.float64], length: NDArray[np.float64], near: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """Whether each neighbour moves like its match, (n, k)."""
    own, other = length[:, None], length[near]
    longer = np.maximum(own, other)
    # Cosine times the shorter over the longer length: the inner product over the longer squared.
    with np.errstate(divide="ignore", invalid="ignore"):
        value = np.einsum("ij,ikj->ik", motion, motion[near]) / longer**2
    return np.asarray((value >= MIN_ALIKE) | (longer == 0))
