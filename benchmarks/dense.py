"""A model of matchers without a detector, such as LoFTR: a match on every cell of a grid.

Where both images show the place, it is right but for errors that neighbours partly share, a few of
them large. Where the second one does not, the matcher often answers all the same, and much as it
does nearby: wrong matches that crowd, which density takes for right ones.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter

from benchmarks.rendered import SIZE, TRUTH_STEP, View, seen_by_both

Floats = NDArray[np.float64]

#: Standard deviations of right matches, pixels: what neighbours share, each one's own, and that of
#: so large a share of them.
SHARED, OWN = 0.5, 0.5
TAIL, TAIL_SHARE = 4.0, 0.05
#: Of wrong ones about what is nearby, which neighbours share, too.
ASTRAY = 15.0
#: Neighbours are within so many cells.
SMOOTH = 3.0
#: Shares of the cells that are matched, where the place is seen and where it is hidden; and of the
#: matches that are anywhere.
SEEN, HIDDEN, ANYWHERE = 0.7, 0.5, 0.05


def dense_matches(view1: View, view2: View, rng: np.random.Generator) -> Floats:
    """Match two views as a dense matcher might, (n, 4), n up to 4,800."""
    seen = seen_by_both(view1, view2)
    width, height = (side // TRUTH_STEP for side in SIZE)
    cell = tuple((seen[:, 1::-1] // TRUTH_STEP).astype(int).T)
    hidden = np.ones((height, width), dtype=bool)
    hidden[cell] = False
    flow = np.zeros((height, width, 2))
    flow[cell] = seen[:, 2:] - seen[:, :2]
    # A hidden place is taken to move as the nearest one that is seen.
    flow = flow[tuple(distance_transform_edt(hidden, return_distances=False, return_indices=True))]
    own = np.where(rng.random((height, width, 1)) < TAIL_SHARE, TAIL, OWN)
    right = SHARED * _smooth(rng, flow.shape) + own * rng.normal(size=flow.shape)
    flow += np.where(hidden[..., None], ASTRAY * _smooth(rng, flow.shape), right)
    points1 = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1) * TRUTH_STEP
    points1 = points1 + seen[0, :2] % TRUTH_STEP
    X = np.concatenate([points1, points1 + flow], axis=-1)
    X = X[rng.random(hidden.shape) < np.where(hidden, HIDDEN, SEEN)]
    anywhere = rng.random(len(X)) < ANYWHERE
    X[anywhere, 2:] = rng.uniform((0, 0), SIZE, (np.count_nonzero(anywhere), 2))
    return X[((X[:, 2:] >= 0) & (X[:, 2:] < SIZE)).all(axis=1)]


def _smooth(rng: np.random.Generator, shape: tuple[int, ...]) -> Floats:
    """Noise that neighbours share, of standard deviation 1."""
    noise = gaussian_filter(rng.normal(size=shape), (SMOOTH, SMOOTH, 0))
    return np.asarray(noise / noise.std())
