"""Clustering by density peaks: pure arrays in, pure arrays out, any number of columns."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from numbers import Integral, Real
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist, pdist

from cv_densityf._arguments import check, real

Kernel = Literal["cutoff", "gaussian"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

#: Up to here ``dc`` is an order statistic of all distances, beyond it of a sample of them.
_EXACT_DC_ROWS = 4_000
_DC_SAMPLE = 1_000_000
_SEED = 0
#: Distances this close, relatively, differ by rounding only.
_ROUNDING = 1e-9
#: Entries of the largest temporary array of the blockwise loops.
_BLOCK = 1 << 20
#: Leaves of this size make range counts about twice as fast as scipy's default of 16.
_LEAFSIZE = 64


@dataclass(frozen=True, eq=False)
class DensityPeaksResult:
    """The decision graph of a set of points, and the clusters that follow from it.

    Attributes
    ----------
    rho : ndarray of float64, shape (n,)
        Local density.
    delta : ndarray of float64, shape (n,)
        Distance to the nearest denser point; for the densest point the largest distance to any.
    gamma : ndarray of float64, shape (n,)
        ``rho * delta``: large for the centre of a cluster.
    dc : float
        Cut-off distance, in the units of the points.
    predecessor : ndarray of intp, shape (n,)
        Row of the nearest denser point, -1 for the densest point.
    X : ndarray of float64, shape (n, d)
        The points.
    """

    rho: Floats
    delta: Floats
    gamma: Floats
    dc: float
    predecessor: Ints
    X: Floats = field(repr=False)

    def centers(self, *, alpha: float | None = None, n: int | None = None) -> Ints:
        """Choose cluster centres, the largest ``gamma`` first.

        Parameters
        ----------
        alpha : float in [0, 1], optional
            Take the points with ``gamma >= alpha * rho.max() * delta.max()``, the rule of Wu and
            Wan, section 2.6. The densest point always qualifies.
        n : int in [1, number of points], optional
            Take the ``n`` points with the largest ``gamma``; equal ``gamma`` is ordered by row.

        Returns
        -------
        ndarray of intp
            Rows of the centres. The first is the densest point.

        Raises
        ------
        ValueError
            Unless exactly one of ``alpha`` and ``n`` is given, within its range.
        """
        if (alpha is None) == (n is None):
            raise ValueError("give exactly one of alpha (a threshold on gamma) and n (a number)")
        order = np.argsort(-self.gamma, kind="stable")
        if alpha is not None:
            if not 0 <= alpha <= 1:
                raise ValueError(f"alpha is a share of the largest gamma, in [0, 1]; got {alpha}")
            limit = alpha * (self.rho.max() * self.delta.max())
            # It is 0 where nothing stands out, as among copies of one point.
            nothing = limit == 0 < alpha
            chosen = self.predecessor < 0 if nothing else self.gamma >= limit
            return np.asarray(order[chosen[order]])
        if not (isinstance(n, Integral) and 1 <= n <= len(order)):
            raise ValueError(
                f"n must be a whole number between 1 and the {len(order)} points; got {n!r}"
            )
        return np.asarray(order[:n])

    def labels(self, centers: ArrayLike) -> Ints:
        """Give every point the cluster of its nearest denser point.

        Parameters
        ----------
        centers : array_like of int, shape (k,)
            Rows of the centres, each once, as `centers` returns them.

        Returns
        -------
        ndarray of intp, shape (n,)
            Position in ``centers`` of the first centre met when following predecessors, or -1
            where there is none, which happens only when ``centers`` lacks the densest point.

        Raises
        ------
        ValueError
            If a centre is not the number of a row of the points or is given twice.
        """
        rows, n = np.asarray(centers).ravel(), len(self.rho)
        if not rows.size:
            rows = rows.astype(np.intp)
        whole = rows.dtype.kind in "iu"
        if not whole or len(np.unique(rows[(rows >= 0) & (rows < n)])) < len(rows):
            raise ValueError(f"centers must be different row numbers between 0 and {n - 1}")
        root = np.flatnonzero(self.predecessor < 0)
        parent = self.predecessor.copy()
        parent[root] = root
        parent[rows] = rows
        # Each pass doubles the length of the chains followed.
        while not np.array_equal(grand := parent[parent], parent):
            parent = grand
        label = np.full(n, -1, dtype=np.intp)
        label[rows] = np.arange(len(rows))
        return np.asarray(label[parent])

    def halo(self, labels: ArrayLike) -> NDArray[np.bool_]:
        """Tell the rim of each cluster from its core.

        A cluster's border holds its points with a point of another cluster nearer than ``dc``;
        its points no denser than the densest of the border are its halo (Rodriguez and Laio).

        Parameters
        ----------
        labels : array_like of int, shape (n,)
            Cluster of each point, negative for none, as `labels` returns them.

        Returns
        -------
        ndarray of bool, shape (n,)
            True in the halo. Points without a cluster are in the halo.

        Raises
        ------
        ValueError
            If ``labels`` does not hold one label per point.
        """
        label = np.asarray(labels)
        if label.shape != self.rho.shape:
            raise ValueError(f"labels must have shape {self.rho.shape}; got {label.shape}")
        halo = label < 0
        rows = np.flatnonzero(~halo)
        if not rows.size:
            return halo
        clusters, member = np.unique(label[rows], return_inverse=True)
        on_border = _has_foreign_neighbor(self.X[rows], member, self.dc)
        border_rho = np.full(len(clusters), -np.inf)
        np.maximum.at(border_rho, member[on_border], self.rho[rows[on_border]])
        halo[rows] = self.rho[rows] <= border_rho[member]
        return halo


def density_peaks(
    X: ArrayLike,
    *,
    dc: float | None = None,
    dc_percent: float = 2.0,
    kernel: Kernel = "cutoff",
    sample_size: int | None = None,
) -> DensityPeaksResult:
    """Density and distance to a denser point, for clustering by density peaks.

    Parameters
    ----------
    X : array_like, shape (n, d)
        Finite points, n >= 1 and d >= 1; the four columns x, y, x', y' for matches.
    dc : float > 0, optional
        Cut-off distance, in the units of ``X``. Chosen from ``dc_percent`` when None.
    dc_percent : float in (0, 100], default=2.0
        Choose ``dc`` so that a point has on average ``dc_percent`` % of n points nearer than
        ``dc``: half way between the last distance that has to lie below it and the next larger
        one, where a relative difference below 1e-9 counts as none. Up to 4,000 points all
        distances are used. Beyond, a fixed pseudo-random sample of 1,000,000 pairs is: the mean
        number of neighbours then misses its target by a relative standard error of
        ``sqrt((100 / dc_percent - 1) / 1e6)``, 0.7 % at the default.
    kernel : {"cutoff", "gaussian"}, default="cutoff"
        ``"cutoff"``: rho is the number of other points strictly nearer than ``dc``.
        ``"gaussian"``: rho is the sum of ``exp(-(d / dc)**2)`` over the other points.
        Neither counts the point itself.
    sample_size : int >= 2, optional
        Estimate ``rho`` from this many of the points, a fixed pseudo-random choice, where counting
        all takes too long. See the notes for its error. All points by default.

    Returns
    -------
    DensityPeaksResult
        ``rho``, ``delta``, ``gamma``, ``dc``, ``predecessor``, with the methods ``centers``,
        ``labels`` and ``halo``.

    Raises
    ------
    ValueError
        If ``X`` is not a two-dimensional array of finite numbers with at least one row and one
        column, if its squared distances overflow, or if a parameter is out of its range.

    Notes
    -----
    ``rho`` and ``delta`` are exact for any n, unless ``sample_size`` is given. Points of equal
    density are ordered by row, the earlier row counts as denser; so there is one densest point, and
    every other has a predecessor. Of several denser points at the same distance the densest is the
    predecessor. The densest point's ``delta`` is the largest distance from it, 0 when all points
    coincide.

    Equation (11) of Wu and Wan prints ``delta`` as a maximum over the denser points; their text
    and Rodriguez and Laio define the minimum, as it is here.

    Memory grows like n, not n**2 (beyond the 4,000 points whose distances are all looked at). Time
    for ``"cutoff"`` is that of kd-tree counts, ``dc_percent`` % of n**2; ``"gaussian"`` sums over
    all n**2 / 2 pairs.

    With a ``sample_size`` of m < n, time grows like n * m. ``rho`` is unbiased, and its relative
    standard error is ``sqrt((1 - p) / p * (1 - m / n) / m)`` where ``rho = p * n``, 5 % at p = 2 %
    and m = 20,000; for ``"gaussian"`` at most that. ``delta`` and ``predecessor`` are exact for the
    estimated ``rho``.

    References
    ----------
    A. Rodriguez and A. Laio, "Clustering by fast search and find of density peaks", Science 344
    (2014) 1492-1496. H. Wu and Y. Wan, "Clustering assisted fundamental matrix estimation" (2015),
    equations (9)-(11).

    Examples
    --------
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> X = np.concatenate([rng.normal(0, 1, (60, 4)), rng.normal(20, 1, (40, 4))])
    >>> peaks = density_peaks(X)
    >>> centers = peaks.centers(n=2)
    >>> np.bincount(peaks.labels(centers))
    array([40, 60])
    """
    X = checked_points(X)
    if dc is not None:
        check("dc", dc, Real, lambda v: 0 < v < math.inf, "a distance, finite and above 0")
    check("dc_percent", dc_percent, Real, lambda v: 0 < v <= 100, "a percentage in (0, 100]")
    kernels = get_args(Kernel)
    check("kernel", kernel, str, kernels.__contains__, " or ".join(map(repr, kernels)))
    if sample_size is not None:
        wanted = "a number of points, at least 2"
        check("sample_size", sample_size, Integral, lambda v: v >= 2, wanted)

    n = len(X)
    if dc is None:
        distances = pdist(X) if n <= _EXACT_DC_ROWS else _sampled_distances(X)
        dc = _cutoff_distance(distances, n, dc_percent)
    # Copies of a point are equally dense, and the first is the nearest denser one of the others.
    Z, first, copy_of, copies = np.unique(
        X, axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    copy_of = copy_of.ravel()
    sampled = copies
    if sample_size is not None and sample_size < n:
        drawn = np.random.default_rng(_SEED).choice(n, sample_size, replace=False)
        sampled = np.bincount(copy_of[drawn], minlength=len(Z))
    near = _counts_of_others if kernel == "cutoff" else _gaussian_of_others
    # Copies are known, the density of all others is that of the others in the sample.
    others = np.maximum(sampled.sum() - sampled, 1)
    density = copies - 1 + (n - copies) * near(Z, sampled, dc) / others
    order = np.lexsort((first, -density))
    parent, to_parent = _nearest_earlier(Z[order])
    rho, delta, predecessor = density[copy_of], np.zeros(n), first[copy_of]
    ranked = first[order]
    delta[ranked], predecessor[ranked] = to_parent, ranked[parent]
    delta[ranked[0]] = cdist(Z[order[:1]], Z).max()
    predecessor[ranked[0]] = -1
    return DensityPeaksResult(rho, delta, rho * delta, float(dc), predecessor, X)


def checked_points(X: ArrayLike) -> Floats:
    """Return points (n, d) in float64, or raise ValueError where their distances are no numbers."""
    points = np.ascontiguousarray(real(X, "X"))
    if points.ndim != 2 or 0 in points.shape:
        raise ValueError(
            "X must be a two-dimensional array with at least one row (a point) and one column; "
            f"its shape is {np.shape(X)}"
        )
    if not np.isfinite(points).all():
        raise ValueError("X holds NaN or infinite values; drop those rows first")
    with np.errstate(over="ignore"):
        if not np.isfinite(np.square(np.ptp(points, axis=0)).sum()):
            raise ValueError("X spans so wide a range that squared distances overflow; rescale it")
    return points


def _cutoff_distance(distances: NDArray[np.floating], n: int, percent: float) -> float:
    """Distance below which the share of pairs lies that makes the mean density ``percent`` % of n.

    ``distances`` are those of all pairs, or of a sample of them.
    """
    if not distances.size:
        return float(np.nextafter(0.0, 1.0))
    share = min(percent / 100 * n / (n - 1), 1.0)
    last = max(math.ceil(round(share * distances.size, 6)), 1) - 1
    ranked = np.partition(distances, last)
    below, rest = ranked[last], ranked[last + 1 :]
    same = below * (1 + _ROUNDING)
    above = rest.min(initial=np.inf)
    if above <= same:
        above = rest[rest > same].min(initial=np.inf)
    # Half way, so that rounding of a distance decides about no pair.
    return float((below + above) / 2 if above < np.inf else max(same, np.nextafter(0.0, 1.0)))


def _sampled_distances(X: Floats) -> Floats:
    """Distances of ``_DC_SAMPLE`` pairs of different rows, drawn with replacement."""
    rng = np.random.default_rng(_SEED)
    i = rng.integers(0, len(X), _DC_SAMPLE)
    j = (i + rng.integers(1, len(X), _DC_SAMPLE)) % len(X)
    squared = np.zeros(_DC_SAMPLE)
    for column in X.T:
        squared += np.square(column[i] - column[j])
    return np.asarray(np.sqrt(squared))


def _counts_of_others(Z: Floats, copies: Ints, dc: float) -> Floats:
    """Count the copies of other points strictly nearer than ``dc`` to each distinct point."""
    tree = cKDTree(np.repeat(Z, copies, axis=0), leafsize=_LEAFSIZE)
    counts = np.empty(len(Z))
    # The tree counts distances up to its radius, the kernel those below dc. Asking for neighbours
    # one after the other keeps the tree's nodes in the cache.
    order = cKDTree(Z, leafsize=_LEAFSIZE).indices
    counts[order] = tree.query_ball_point(Z[order], np.nextafter(dc, 0.0), return_length=True)
    return counts - copies


def _gaussian_of_others(Z: Floats, copies: Ints, dc: float) -> Floats:
    """Sum the Gaussian kernel over the copies of all other distinct points, each pair once."""
    n, m = len(Z), int(np.count_nonzero(copies))
    # Points with copies to sum over come first.
    order = np.argsort(copies == 0, kind="stable")
    P, weight = Z[order], copies[order].astype(np.float64)
    total = np.zeros(n)
    rows = max(_BLOCK // n, 1)
    for start in range(0, m, rows):
        stop = min(start + rows, m)
        with np.errstate(over="ignore", under="ignore"):
            kernel = np.exp(-np.square(cdist(P[start:stop], P[start:]) / dc))
        np.fill_diagonal(kernel, 0)
        total[start:stop] += kernel[:, : m - start] @ weight[start:m]
        total[stop:] += weight[start:stop] @ kernel[:, stop - start :]
    result = np.empty(n)
    result[order] = total
    return result


def _nearest_earlier(P: Floats) -> tuple[Ints, Floats]:
    """Nearest of the rows before each of different rows, and its distance; row 0 is undefined."""
    n = len(P)
    nearest, distance = np.zeros(n, dtype=np.intp), np.zeros(n)
    tree = cKDTree(P, leafsize=_LEAFSIZE)
    # In the tree's own order, which keeps its nodes in the cache.
    pending = tree.indices[tree.indices > 0]
    k = 9
    # A small matrix is quicker than the tree.
    while pending.size * n > _BLOCK and k < n:
        unsettled = []
        for rows in _parts(pending, k):
            to_neighbor, neighbor = tree.query(P[rows], k)
            candidate = np.where(neighbor < rows[:, None], to_neighbor, np.inf)
            shortest = candidate.min(axis=1)
            # A tie with the last neighbour may go on among those not listed.
            settled = shortest < to_neighbor[:, -1]
            row = rows[settled]
            tied = candidate[settled] == shortest[settled, None]
            nearest[row] = np.where(tied, neighbor[settled], n).min(axis=1)
            distance[row] = shortest[settled]
            unsettled.append(rows[~settled])
        pending = np.concatenate(unsettled)
        k *= 4
    for rows in _parts(np.sort(pending), n):
        to_row = cdist(P[rows], P[: rows[-1]])
        to_row[np.arange(rows[-1]) >= rows[:, None]] = np.inf
        nearest[rows] = to_row.argmin(axis=1)
        distance[rows] = to_row[np.arange(len(rows)), nearest[rows]]
    return nearest, distance


def _parts(rows: Ints, width: int) -> Iterator[Ints]:
    """Split rows so that a table of ``width`` columns for them is no larger than a block."""
    step = max(_BLOCK // width, 1)
    return (rows[i : i + step] for i in range(0, len(rows), step))


def _has_foreign_neighbor(X: Floats, member: Ints, dc: float) -> NDArray[np.bool_]:
    """Whether a point of another cluster lies nearer than ``dc``; clusters count from 0."""
    _, first, copy_of = np.unique(X, axis=0, return_index=True, return_inverse=True)
    copy_of = copy_of.ravel()
    result = np.zeros(len(X), dtype=bool)
    # Numbers of two clusters differ in some bit; for each, the nearest with the other bit decides.
    for bit in range(int(member.max()).bit_length()):
        odd = (member >> bit) % 2 == 1
        for side in (odd, ~odd):
            rows = np.flatnonzero(side & ~result)
            others = first[np.unique(copy_of[~side])]
            to_other, _ = cKDTree(X[others], leafsize=_LEAFSIZE).query(
                X[rows], distance_upper_bound=dc * (1 + _ROUNDING)
            )
            result[rows] = to_other < dc
    return result
