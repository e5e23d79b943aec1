"""From the density of the matches to a reliability per match and the rows to draw from."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]

#: Neighbours looked at around each match, in each image.
N_NEIGHBORS = 16
#: cv2's exact search in few dimensions, KDTREE_SINGLE; on so few points twice as fast as scipy's.
_KD_TREE: dict[str, bool | int | float | str] = {"algorithm": 4}
_EXACT: dict[str, bool | int | float | str] = {"checks": -1}
#: Squared distances beyond would not fit in float32.
_FARTHEST = 1e18
#: Matches lie together more than by chance if their mean contrast exceeds its expectation by the
#: first, or by so many of its standard deviations, which is less from some 200 matches on. Texture
#: alone makes half of the first between photographs of two scenes.
_EXCESS = 0.1
_SIGNIFICANT = 6.0
#: With a mean contrast above it more than half of the matches are right, mostly three in five.
CLEAN = 1.2
#: From here on `coherence` tells inliers of a common scene: they have .4 and more, those that wrong
#: matches happen to make hardly ever .35.
COHERENT = 0.35
#: Of more matches than twice as many, it is looked at for every second, third, ... one.
_COHERENCE_OF = 5_000
#: Of this reliability and more, a match is kept.
KEPT = 0.5
#: Of the caller's scores the worst part, one match in so many, is no witness for others.
_WORST = 5
#: Where a place holds more than one point in so many, and a few, copies are looked for.
_MANY_COPIES = 25
_FEW_COPIES = 2
#: Rows compared at a time, so that the comparison table stays in the cache.
_CHUNK = 4096


def density_contrast(
    X: Floats, rows: Ints | None = None, among: Ints | None = None, few: int | None = None
) -> NDArray[np.float64]:
    """How much denser the matches lie around each match in 4-D than chance would put them.

    A neighbour of a match in the first image and in the second one is a neighbour in 4-D. If points
    were paired at random, two neighbourhoods of k matches out of n would share k^2 / n; around a
    right match most neighbours are shared. Each shared neighbour counts 1 / rank, rank being its
    place (1, 2, ...) in the list where it stands later, which averages the density over all
    neighbourhood sizes up to `N_NEIGHBORS`. Copies of a match do not count. Locality preserving
    matching (Ma et al., IJCV 2019) counts shared neighbours, too.

    Parameters
    ----------
    X : array, shape (n, 4)
        Finite matches x, y, x', y', n >= 2.
    rows : array of int, shape (m,), optional
        The matches to tell it of, by default all.
    among : array of int, shape (l,), optional
        The matches that count as neighbours, l >= 2, by default all.
    few : int, optional
        Tell it of no more rows than the first so many if most of these are right: if their mean is
        above `CLEAN`.

    Returns
    -------
    array, shape (m,) or (few,)
        Sum over the shared neighbours, 0 for a match that shares none.
    """
    n = len(X)
    among = np.arange(n) if among is None else among
    k = min(N_NEIGHBORS, len(among) - 1) + 1
    # In float32 what matters is how far the points are from each other, not from the origin.
    Y = X - np.partition(X, n // 2, axis=0)[n // 2]
    Y = Y.clip(-_FARTHEST, _FARTHEST).astype(np.float32)
    halves = [np.ascontiguousarray(half) for half in (Y[:, :2], Y[:, 2:])]
    # Among copies of a point the search for neighbours would look at all, each time.
    searched = [half[among] for half in halves]
    members = [_without_more_copies(points, k) for points in searched]
    indices = [
        cv2.flann.Index(points if some is None else points[some], _KD_TREE)
        for points, some in zip(searched, members, strict=True)
    ]
    # A match among them is its own first neighbour, at place 0, or a copy of it is. An outsider
    # sees one neighbour more, which does not count.
    outside = np.ones(n, dtype=np.intp)
    outside[among] = 0
    weight = 1.0 / np.maximum(np.arange(k + 1), 1)
    weight[k] = 0.0
    rows = np.arange(n) if rows is None else rows
    contrast, end = np.empty(len(rows)), 0
    for part in np.split(rows, range(few or _CHUNK, len(rows), _CHUNK)):
        (near1, squared1), (near2, squared2) = (
            index.knnSearch(half[part], k, params=_EXACT)
            for index, half in zip(indices, halves, strict=True)
        )
        # Long rows are compared faster.
        columns1, columns2 = (
            np.ascontiguousarray(near.T) if some is None else some[near.T.astype(np.intp)]
            for near, some in zip((near1, near2), members, strict=True)
        )
        shared = np.flatnonzero(columns1[:, None] == columns2)
        places, row = np.divmod(shared, len(part))
        place1, place2 = np.divmod(places, k)
        rank = np.maximum(place1, place2) + outside[part][row]
        # Neither itself nor a copy, such as SIFT's second orientation, says anything for a match.
        other = (squared1[row, place1] > 0) | (squared2[row, place2] > 0)
        counts = weight[rank] * other
        start, end = end, end + len(part)
        contrast[start:end] = np.bincount(row, counts, minlength=len(part))
        if end == few and contrast[:few].mean() > CLEAN:
            break
    return contrast[:end]


def place_numbers(points: Floats) -> Ints | None:
    """Give points (n, 2) the number of their place; None if none can have a good part of them."""
    n = len(points)
    x = np.sort(points[:, 0])
    many = _FEW_COPIES + n // _MANY_COPIES
    if not (x[many:] == x[: n - many]).any():
        return None
    # As complex numbers they are sorted several times as fast as by rows.
    number = np.unique(points[:, 0] + 1j * points[:, 1], return_inverse=True)[1]
    return np.asarray(number.ravel())


def grouped(labels: NDArray[np.integer]) -> tuple[Ints, Ints]:
    """Places (n,) sorted by label, and where in this order each label starts."""
    order = np.argsort(labels, kind="stable")
    labels = labels[order]
    return order, np.flatnonzero(np.concatenate([[True], labels[1:] != labels[:-1]]))


def turns(labels: NDArray[np.integer]) -> Ints:
    """How many before each one have the same label, (n,)."""
    order, starts = grouped(labels)
    turn = np.empty_like(order)
    turn[order] = np.arange(len(order)) - starts.repeat(np.diff(starts, append=len(order)))
    return turn


def _without_more_copies(points: Floats, most: int) -> Ints | None:
    """Rows of points (n, 2) without the copies of any beyond ``most``; None if they may stay."""
    place = place_numbers(points)
    return None if place is None else np.flatnonzero(turns(place) < most)


def beyond_chance(contrast: Floats, n: int, n_among: int) -> bool:
    """Whether n matches lie together more than those of two images without a common scene.

    Parameters
    ----------
    contrast : array, shape (m,)
        `density_contrast` of the n matches, or of m of them that stand for all.
    n : int
        Number of matches.
    n_among : int
        Number of those that count as neighbours.
    """
    rank, expected = _by_chance(n_among)
    excess = contrast.mean() - (expected / rank).sum()
    part = len(contrast) / n
    # Neighbourhood is mostly mutual, so two matches gain together where both are looked at.
    variance = (1 + part) * (expected / rank**2).sum() / len(contrast)
    # A part tells less: in doubt it does not say that there is nothing.
    return bool(excess > min(_EXCESS, _SIGNIFICANT * part * np.sqrt(variance)))


def coherence(X: Floats) -> float:
    """Mean contrast of matches (n, 4), on a scale from 0 by chance to 1 for the most there can be.

    NaN for fewer than three. Copies would take the places of neighbours, so one of them counts.
    """
    X = np.unique(X, axis=0) if len(X) else X
    if len(X) < 3:
        return np.nan
    some = np.arange(0, len(X), max(1, len(X) // _COHERENCE_OF))
    return _on_scale(density_contrast(X, rows=some), len(X))


def _on_scale(contrast: Floats, n_among: int) -> float:
    """Mean contrast on a scale from 0 by chance to 1 for the most there can be."""
    rank, expected = _by_chance(n_among)
    mean, most = (expected / rank).sum(), (1 / rank).sum()
    return float((contrast.mean() - mean) / (most - mean))


def share_right(contrast: Floats, n_among: int) -> float:
    """About how many matches are right, from 0 to 1, by the contrast of all or of some of them.

    Of a right match's neighbours as many are right, and only these are shared: its contrast is as
    their share, and the mean of all matches as its square. Where those that count as neighbours are
    better ones, it is between their share and that of the others; copies make it less.

    Parameters
    ----------
    contrast : array, shape (m,)
        `density_contrast` of the matches, or of some that stand for them.
    n_among : int
        Number of those that count as neighbours, 3 at least.
    """
    return float(np.sqrt(max(_on_scale(contrast, n_among), 0.0)))


def _by_chance(n: int) -> tuple[Ints, NDArray[np.float64]]:
    """Ranks 1, 2, ..., and the shared neighbours of each if n matches are paired at random.

    The a-th neighbour in one image is the b-th in the other with probability 1 / (n - 1), and has
    the rank max(a, b).
    """
    rank = np.arange(1, min(N_NEIGHBORS, n - 1) + 1)
    return rank, (2 * rank - 1) / (n - 1)


def ranks(values: Floats) -> NDArray[np.float64]:
    """Rank of each value, from 0 for the smallest to 1 for the largest; equal values share one."""
    ordered = np.sort(values)
    twice = ordered.searchsorted(values, "left") + ordered.searchsorted(values, "right") - 1
    return twice / (2.0 * max(len(values) - 1, 1))


def with_scores(reliability: Floats, scores: Floats) -> NDArray[np.float64]:
    """Rank of a sum in which the rank by density, which tells more, counts four times."""
    return ranks(4 * reliability + ranks(scores))


def best_scored(scores: Floats, size: int) -> Ints:
    """Rows of the ``size`` best scores, and of those as good as the last, in rising order."""
    worse = len(scores) - size
    return np.flatnonzero(scores >= np.partition(scores, worse)[worse])


class Support(NamedTuple):
    """Reliability of each match, the denser half, and what all of them tell together.

    That is whether they lie together beyond chance, and what share of them seems right.
    """

    reliability: NDArray[np.float64]
    kept: Bools
    beyond_chance: bool
    share_right: float


def contrast_support(
    X: Floats,
    scores: Floats | None = None,
    rows: Ints | None = None,
    few: int | None = None,
) -> Support:
    """Rank in [0, 1] of each match's density contrast, 1 for the most reliable; see `Support`.

    With ``scores`` (n,), higher for more trusted matches, both count: see `with_scores`; and the
    worst fifth by score does not count as neighbours. With ``rows`` (m,) only these are looked at,
    among all: the others have a reliability of NaN. So have those beyond the first ``few`` rows, if
    most of these are right.
    """
    n = len(X)
    if rows is None:
        rows = np.arange(n)
    among = None if scores is None else best_scored(scores, n - n // _WORST)
    contrast = density_contrast(X, rows=rows, among=among, few=few)
    rows = rows[: len(contrast)]
    n_among = n if among is None else len(among)
    ranked = ranks(contrast)
    if scores is not None:
        ranked = with_scores(ranked, scores[rows])
    reliability = np.full(n, np.nan)
    reliability[rows] = ranked
    return Support(
        reliability,
        reliability >= KEPT,
        beyond_chance(contrast, n, n_among),
        share_right(contrast, n_among),
    )
