"""How far apart two fundamental matrices are, in pixels."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cv_densityf._arguments import check, real

Floats = NDArray[np.float64]

#: Points drawn for each one wanted, before lines that miss the image are given up.
_MAX_REDRAWS = 200


def epipolar_distance(
    F0: ArrayLike,
    F1: ArrayLike,
    size1: Sequence[float],
    size2: Sequence[float],
    *,
    n: int = 1000,
    random_state: int | np.random.Generator | None = 0,
) -> float:
    """Zhang's distance between two fundamental matrices.

    A point is drawn in one image, and a point on the part of its epipolar line under one matrix
    that crosses the other image. The two correspond exactly under that matrix; their distances to
    each other's epipolar lines under the other matrix are averaged. A point whose line misses the
    image is drawn again. Both matrices and both images take both parts, so neither the order of
    the matrices nor that of the images matters.

    Parameters
    ----------
    F0, F1 : array-like, shape (3, 3)
        Fundamental matrices, ``[x', y', 1] @ F @ [x, y, 1] = 0``; scale and sign do not matter.
    size1, size2 : pair of float
        Width and height of the first and second image, pixels.
    n : int
        Points drawn for each matrix in each image, at least 1.
    random_state : int, numpy.random.Generator or None
        Seed; None draws other points each time.

    Returns
    -------
    float
        Pixels: 0 (but for rounding) for matrices equal up to scale. Infinite if a matrix is zero
        or not finite, or if its epipolar lines miss the images. The distances have no upper bound:
        an unrelated matrix, such as the transposed one, is some hundred pixels away.

    Raises
    ------
    ValueError
        If a matrix is not (3, 3), a size is not two positive numbers, or ``n`` is no integer of 1
        and more.

    References
    ----------
    Zhengyou Zhang, "Determining the epipolar geometry and its uncertainty: a review", IJCV 1998.

    Examples
    --------
    >>> import numpy as np
    >>> from cv_densityf import epipolar_distance
    >>> rows_match = np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0]])
    >>> two_rows_lower = np.array([[0, 0, 0], [0, 0, -1], [0, 1, -2]])
    >>> round(epipolar_distance(rows_match, two_rows_lower, (640, 480), (640, 480)), 6)
    2.0
    """
    F0, F1 = _matrix(F0, "F0"), _matrix(F1, "F1")
    whole1, whole2 = _size(size1, "size1"), _size(size2, "size2")
    check("n", n, Integral, lambda v: v >= 1, "an integer of 1 and more")
    scales = [float(np.abs(F).max()) for F in (F0, F1)]
    if not all(0 < scale < np.inf for scale in scales):
        return np.inf
    F0, F1 = F0 / scales[0], F1 / scales[1]
    # All four parts draw the same places relative to the image: symmetric to the last digits.
    seed = int(np.random.default_rng(random_state).integers(2**63))
    distances = [
        _one_way(F, G, *ends, n, np.random.default_rng(seed))
        for A, B, ends in ((F0, F1, (whole1, whole2)), (F0.T, F1.T, (whole2, whole1)))
        for F, G in ((A, B), (B, A))
    ]
    return float(np.mean(distances))


def _one_way(
    F: Floats, G: Floats, size1: Floats, size2: Floats, n: int, rng: np.random.Generator
) -> float:
    """Mean distance under G of n pairs that correspond under F; the first point is drawn."""
    total, found = 0.0, 0
    for _ in range(_MAX_REDRAWS):
        draws = rng.random((n, 3))
        one = np.ones((n, 1))
        m1 = np.hstack([draws[:, :2] * size1, one])
        on_line, meets = points_inside(m1 @ F.T, size2, draws[:, 2])
        m1, m2 = m1[meets], np.hstack([on_line, one])[meets]
        lines2, lines1 = m1 @ G.T, m2 @ G
        algebraic = np.abs((m2 * lines2).sum(axis=1))
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = algebraic / np.hypot(lines1[:, 0], lines1[:, 1])
            distance += algebraic / np.hypot(lines2[:, 0], lines2[:, 1])
        # NaN where a point is the epipole itself, which has no line.
        distance = distance[~np.isnan(distance)][: n - found]
        total, found = total + float(distance.sum()) / 2, found + len(distance)
        if found == n:
            break
    return total / found if found else np.inf


def points_inside(lines: Floats, size: Floats, shares: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Points at the given shares of the lines' parts inside the image, and which lines meet it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        lines = lines / np.hypot(lines[:, 0], lines[:, 1])[:, None]
        normal, half = lines[:, :2], size / 2
        foot = -normal * (normal @ half + lines[:, 2])[:, None]  # from the centre of the image
        direction = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
        # One way along the line, whatever the sign of F.
        backwards = (direction[:, 0] < 0) | ((direction[:, 0] == 0) & (direction[:, 1] < 0))
        direction[backwards] *= -1
        ends = np.sort([(-half - foot) / direction, (half - foot) / direction], axis=0)
        # NaN: the line runs along a border, which does not bound it.
        start, stop = np.fmax(*ends[0].T), np.fmin(*ends[1].T)
        points = half + foot + (start + shares * (stop - start))[:, None] * direction
    return points, (start <= stop) & np.isfinite(points).all(axis=1)


def _matrix(F: ArrayLike, name: str) -> Floats:
    if F is None:
        raise ValueError(f"{name} is None: there is no fundamental matrix to compare")
    F = real(F, name)
    if F.shape != (3, 3):
        raise ValueError(
            f"{name} has shape {F.shape}; it must be one fundamental matrix, (3, 3). "
            "Of the solutions cv2 stacks for seven matches, pass one"
        )
    return F


def _size(size: Sequence[float], name: str) -> Floats:
    array = real(size, name)
    if array.shape != (2,) or not ((array > 0) & np.isfinite(array)).all():
        given = size if array.size <= 4 else f"of shape {array.shape}"
        raise ValueError(f"{name} is {given}; it must be (width, height), pixels, above 0")
    return array
