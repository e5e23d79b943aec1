"""Matches of a made-up dense matcher: right where both images see, crowded and wrong elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import dense, rendered
from benchmarks.dense import dense_matches
from benchmarks.rendered import OVERSAMPLING, SIZE, TRUTH_STEP, View
from cv_densityf import coherence

WIDTH, HEIGHT = SIZE
SHIFT = 2.0


def walls():
    """Two views of a wall, a nearer one before it: the camera moves along x, so y stays."""
    views = []
    for moved in (0.0, SHIFT):
        depth = np.full((OVERSAMPLING * HEIGHT, OVERSAMPLING * WIDTH), 10.0)
        left = OVERSAMPLING * (200 - moved * rendered.intrinsics()[0, 0] / 5.0)
        depth[200:800, int(left) : int(left) + 500] = 5.0
        image = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
        views.append(View(image, depth, np.eye(3), np.array([-moved, 0.0, 0.0])))
    return views


@pytest.mark.parametrize("seed", range(3))
def test_right_ones_are_as_exact_as_said_and_wrong_ones_crowd(seed):
    X = dense_matches(*walls(), np.random.default_rng(seed))
    assert (X >= 0).all()
    assert (np.array([WIDTH, HEIGHT, WIDTH, HEIGHT]) > X).all()
    off = X[:, 3] - X[:, 1]
    sigma = np.hypot(dense.SHARED, dense.OWN)
    right = np.abs(off) < 4 * sigma
    assert 0.6 < right.mean() < 0.9
    assert 1.4826 * np.median(np.abs(off[right])) == pytest.approx(sigma, rel=0.25)
    wrong = X[~right]
    shuffled = np.random.default_rng(0).permutation(wrong[:, 2:])
    assert coherence(wrong[:, :2], wrong[:, 2:]) > coherence(wrong[:, :2], shuffled) + 0.2


def test_hidden_places_move_as_what_is_near():
    """Two shifts there are, of either wall; a hidden place has one of them, and its neighbours'."""
    X = dense_matches(*walls(), np.random.default_rng(0))
    shift = np.full((HEIGHT // TRUTH_STEP, WIDTH // TRUTH_STEP, 2), np.nan)
    column, row = (X[:, :2] // TRUTH_STEP).astype(int).T
    shift[row, column] = X[:, 2:] - X[:, :2]
    focal = rendered.intrinsics()[0, 0]
    known = -SHIFT * focal / np.array([5.0, 10.0])
    astray = np.abs(shift[..., 1]) > 6 * dense.OWN
    near = np.abs(shift[..., :1] - known).min(axis=-1) < 3 * dense.ASTRAY
    assert near[astray].mean() > 0.7
    apart = np.abs(np.diff(shift[..., 1], axis=1))[astray[:, 1:] & astray[:, :-1]]
    assert np.nanmedian(apart) < 0.5 * dense.ASTRAY
    some = np.abs(X[:, 3] - X[:, 1])
    assert 0.01 < ((some > 4 * dense.OWN) & (some < 3 * dense.TAIL)).mean() < 0.2
    assert 0.005 < (some > 5 * dense.ASTRAY).mean() < 0.1


def test_a_cell_has_one_match_at_most():
    X = dense_matches(*walls(), np.random.default_rng(0))
    cells = np.unique(X[:, :2] // TRUTH_STEP, axis=0)
    assert len(cells) == len(X) > 1000


def test_errors_are_partly_shared_by_neighbours():
    """Half of the variance: it is the same in the next cell, and independent far away."""
    X = dense_matches(*walls(), np.random.default_rng(1))
    errors = np.full((HEIGHT // TRUTH_STEP, WIDTH // TRUTH_STEP), np.nan)
    column, row = (X[:, :2] // TRUTH_STEP).astype(int).T
    errors[row, column] = X[:, 3] - X[:, 1]
    errors[np.abs(errors) > 2.0] = np.nan

    def alike(step):
        product = errors[:, step:] * errors[:, :-step]
        return np.nanmean(product) / np.nanmean(errors**2)

    assert 0.3 < alike(1) < 0.7
    assert abs(alike(25)) < 0.2
