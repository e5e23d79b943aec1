"""Epipolar residuals, cv2's inlier rules, and the least-squares fits of a fundamental matrix.

A set of matches is an array ``X`` of shape (n, 4) with the columns x, y, x', y'; a fundamental
matrix satisfies ``[x', y', 1] @ F @ [x, y, 1] == 0``.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cv_densityf._blas import parts, solved

Rule = Literal["ransac", "lmeds", "usac"]
Floats = NDArray[np.floating]

#: cv2 turns the median residual into a noise scale with these (Rousseeuw and Leroy, 1987).
_LMEDS_SCALE = 2.5 * 1.4826
_LMEDS_MIN_SIGMA = 0.001


def _sampson_squared(F: Floats, X: Floats) -> Floats:
    """Squared Sampson distance in the precision of the arguments, (n,)."""
    x, y, u, v = X.T
    a = F[0, 0] * x + F[0, 1] * y + F[0, 2]
    b = F[1, 0] * x + F[1, 1] * y + F[1, 2]
    d = F[0, 0] * u + F[1, 0] * v + F[2, 0]
    e = F[0, 1] * u + F[1, 1] * v + F[2, 1]
    # The order of cv2's sum: the last bit decides ties at the threshold.
    algebraic = u * a + v * b + F[2, 0] * x + F[2, 1] * y + F[2, 2]
    return np.asarray(algebraic * algebraic / (a * a + b * b + d * d + e * e))


def point_line_squared(F: Floats, X: Floats) -> Floats:
    """Larger of the two squared point-to-line distances under each of F (..., 3, 3), (..., n)."""
    x, y, u, v = X.astype(np.float32).astype(np.float64).T
    F = F[..., None]
    a = F[..., 0, 0, :] * x + F[..., 0, 1, :] * y + F[..., 0, 2, :]
    b = F[..., 1, 0, :] * x + F[..., 1, 1, :] * y + F[..., 1, 2, :]
    c = F[..., 2, 0, :] * x + F[..., 2, 1, :] * y + F[..., 2, 2, :]
    in_second = u * a + v * b + c
    d = F[..., 0, 0, :] * u + F[..., 1, 0, :] * v + F[..., 2, 0, :]
    e = F[..., 0, 1, :] * u + F[..., 1, 1, :] * v + F[..., 2, 1, :]
    f = F[..., 0, 2, :] * u + F[..., 1, 2, :] * v + F[..., 2, 2, :]
    in_first = x * d + y * e + f
    # cv2 multiplies by the reciprocal.
    squared1 = in_first * in_first * (1.0 / (d * d + e * e))
    squared2 = in_second * in_second * (1.0 / (a * a + b * b))
    return np.asarray(np.maximum(squared1, squared2))


def sampson_distance(F: Floats, X: Floats) -> Floats:
    """Sampson distance of each match, pixels, (n,)."""
    with np.errstate(all="ignore"):
        return np.sqrt(_sampson_squared(F, X))


def residuals(F: Floats, X: Floats, rule: Rule) -> Floats:
    """Return the distance in pixels that ``rule`` compares with its threshold, (n,)."""
    if rule == "usac":
        return sampson_distance(F, X)
    with np.errstate(all="ignore"):
        return np.sqrt(point_line_squared(F, X))


def inlier_mask(F: Floats, X: Floats, rule: Rule, threshold: float) -> NDArray[np.bool_]:
    """Inliers of ``F`` by cv2's own rule, bit for bit.

    ``"usac"``: Sampson distance in float32, strictly below the threshold. ``"ransac"``: the larger
    point-to-line distance, at most the threshold. ``"lmeds"``: the same distance against 2.5 robust
    standard deviations, estimated from the median over the finite rows; ``threshold`` is unused.
    Rows with a non-finite residual are no inliers.
    """
    return mask_and_threshold(F, X, rule, threshold)[0]


def mask_and_threshold(
    F: Floats, X: Floats, rule: Rule, threshold: float
) -> tuple[NDArray[np.bool_], float]:
    """`inlier_mask`, and the threshold: for ``"lmeds"`` the one that follows from the residuals."""
    with np.errstate(all="ignore"):
        if rule == "usac":
            error = _sampson_squared(F.astype(np.float32), X.astype(np.float32))
            return np.asarray(error.astype(np.float64) < threshold * threshold), threshold
        error = point_line_squared(F, X).astype(np.float32)
        if rule == "lmeds":
            threshold = _lmeds_threshold(error)
        return np.asarray(error <= np.float32(threshold * threshold)), threshold


def lmeds_threshold(F: Floats, X: Floats) -> float:
    """Largest residual of an inlier by the rule ``"lmeds"``, pixels."""
    with np.errstate(all="ignore"):
        return _lmeds_threshold(point_line_squared(F, X).astype(np.float32))


def _lmeds_threshold(error: Floats) -> float:
    error = error[np.isfinite(error)]
    n = len(error)
    if n <= 7:
        return _LMEDS_MIN_SIGMA
    median = float(np.partition(error, n // 2)[n // 2])
    return max(_LMEDS_SCALE * (1 + 5.0 / (n - 7)) * float(np.sqrt(median)), _LMEDS_MIN_SIGMA)


#: A symmetric 9 x 9 matrix from its upper triangle, which is summed once per match.
_ROWS, _COLUMNS = np.triu_indices(9)
_SQUARE = np.empty((9, 9), dtype=np.intp)
_SQUARE[_ROWS, _COLUMNS] = _SQUARE[_COLUMNS, _ROWS] = np.arange(45)
#: Rows of the triangle with x_i x_j of the first image, which is x'_3 x_i x'_3 x_j, and x'_i x'_j
#: of the second one; and the two 3 x 3 matrices from these rows.
_MOMENT_ROWS, _MOMENTS = np.unique(
    np.stack([_SQUARE[6:, 6:], _SQUARE[2::3, 2::3]]), return_inverse=True
)
_MOMENTS = _MOMENTS.reshape(2, 3, 3)
#: Adds up what belongs to the same of these rows, (18, 11).
_GATHERED = np.equal.outer(_MOMENTS.ravel(), np.arange(len(_MOMENT_ROWS))).astype(np.float64)


class Frame:
    """Matches in coordinates that keep least squares well conditioned.

    Both images are centred and divided by the *same* scale, so that a residual in this frame is a
    residual in pixels times ``scale``. Hartley, "In defense of the eight-point algorithm" (1997);
    here without what lies far out, or ``about`` a given centroid and standard deviation.
    """

    __slots__ = (
        *("_first", "_from_first", "_from_second", "_outer", "_second", "_squares"),
        *("products", "scale"),
    )

    def __init__(self, X: Floats, about: tuple[Floats, float] | None = None) -> None:
        centre, spread = about or middle(X)
        self.scale = 1.0 / spread if spread > 0 else 1.0
        Z = (X - centre).T * self.scale
        ones = np.ones((1, len(X)))
        first, second = np.concatenate([Z[:2], ones]), np.concatenate([Z[2:], ones])
        self.products = (second[:, None] * first).reshape(9, -1)
        self._outer = np.empty((45, len(X)))
        row = 0
        for i in range(9):
            np.multiply(self.products[i], self.products[i:], out=self._outer[row : row + 9 - i])
            row += 9 - i
        self._squares = self._outer[_MOMENT_ROWS]
        zoom, unzoom = (np.diag([s, s, 1.0]) for s in (self.scale, 1.0 / self.scale))
        self._first, self._from_first = zoom @ shift(-centre[:2]), shift(centre[:2]) @ unzoom
        self._second, self._from_second = zoom @ shift(-centre[2:]), shift(centre[2:]) @ unzoom

    def part(self, rows: NDArray[np.intp]) -> Frame:
        """Return the same frame, holding only the matches of the given rows."""
        part = copy(self)
        for name in ("_outer", "_squares", "products"):
            setattr(part, name, getattr(self, name).take(rows, axis=1))
        return part

    def enter(self, F: Floats) -> Floats:
        """Fundamental matrices (m, 3, 3) in pixels, in this frame and of unit norm."""
        G = self._from_second.T @ F @ self._from_first
        return np.asarray(G / _norms(G))

    def leave(self, G: Floats) -> Floats:
        """Fundamental matrices (m, 3, 3) of this frame, in pixels."""
        return np.asarray(self._second.T @ G @ self._first)

    def errors(self, G: Floats) -> tuple[Floats, Floats]:
        """Algebraic error and squared gradient norm of each match under each matrix, (m, n)."""
        rows, columns = G[:, :2], G[:, :, :2]
        # The norm is a quadratic form of the points of either image.
        forms = [rows.transpose(0, 2, 1) @ rows, columns @ columns.transpose(0, 2, 1)]
        factors = np.concatenate(forms, axis=1).reshape(-1, 18) @ _GATHERED
        norm = self._combined(factors, self._squares)
        return self._combined(G.reshape(-1, 9), self.products), np.maximum(norm, _EPSILON, out=norm)

    def gram(self, weights: Floats) -> Floats:
        """Weighted sums (m, 9, 9) of the outer squares of `products`, for weights (m, n)."""
        return self._sums(weights, self._outer).take(_SQUARE, axis=1)

    def moments(self, weights: Floats) -> Floats:
        """Weighted sums (m, 2, 3, 3) of x x^T of either image, for weights (m, n)."""
        return self._sums(weights, self._squares).take(_MOMENTS, axis=1)

    def _sums(self, weights: Floats, rows: Floats) -> Floats:
        """Weighted sums (m, r) of ``rows`` (r, n), for weights (m, n)."""
        first, *others = parts(rows.shape[1], len(weights), len(rows))
        total = weights[:, first] @ rows[:, first].T
        for part in others:
            total += weights[:, part] @ rows[:, part].T
        return total

    def _combined(self, factors: Floats, rows: Floats) -> Floats:
        """Sum up ``rows`` (r, n) with ``factors`` (m, r), (m, n)."""
        products = [factors @ rows[:, part] for part in parts(rows.shape[1], *factors.shape)]
        return products[0] if len(products) == 1 else np.concatenate(products, axis=1)

    def sampson(self, G: Floats) -> Floats:
        """Squared Sampson distances in squared pixels, (m, n)."""
        algebraic, norm = self.errors(G)
        return algebraic * algebraic / (norm * self.scale**2)


def middle(X: Floats) -> tuple[Floats, float]:
    """Centroid (4,) of the matches and standard deviation about it, but for matches far out."""
    # Along rows: numpy takes several times as long across columns so few.
    columns = np.ascontiguousarray(X.T)
    half = len(X) // 2
    away = np.abs(columns - np.partition(columns, half, axis=1)[:, half, None]).max(axis=0)
    # Three quarters and not half, since half may be copies of one match.
    most = 3 * len(X) // 4
    reach = FAR * np.partition(away, most)[most]
    near = columns[:, away <= reach] if reach > 0 else columns
    centre = near.mean(axis=1)
    return centre, float(np.sqrt(((near - centre[:, None]) ** 2).mean()))


def shift(by: Floats) -> NDArray[np.float64]:
    """Matrix that moves homogeneous points by a vector (2,)."""
    return np.array([[1.0, 0.0, by[0]], [0.0, 1.0, by[1]], [0.0, 0.0, 1.0]])


_TINY = 1e-300
#: Of a sum of terms of size 1, what rounding may have left.
_EPSILON = 1e-15
#: Matches this many times as far out as three quarters of them cannot be in the image.
FAR = 5.0
#: How stiff a direction is in which a step should not go, and how stiff all are at least, in units
#: of the Hessian's trace.
_STIFFNESS = 1e2
_DAMPING = 1e-9 * np.eye(9)
#: D, which leaves of a line's three coefficients the two that make its normal.
_NORMAL = np.diag([1.0, 1.0, 0.0])
#: How far the essential ratio of a right matrix may well fall short of 1, and from where on this
#: tells little, for the camera may be of another kind.
_SHORTFALL = 0.01
_FOREIGN = 0.03
#: Degrees of freedom of Student's distribution of right residuals, whose density is then as
#: (1 + z^2 / 5)^-3.
_DEGREES = 5.0
#: By which slopes are taken, of a matrix of unit norm: none, each entry more, each entry less.
_NUDGE = 1e-4
_NUDGES = _NUDGE * np.concatenate([np.zeros((1, 9)), np.eye(9), -np.eye(9)]).reshape(19, 3, 3)
#: Of a matrix's entries, row by row, those whose products make its cofactors: the first ones times
#: the second less the third times the fourth.
_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])
_MINORS = np.stack(
    [
        np.add.outer(3 * row, column).ravel()
        for row, column in ((_NEXT, _NEXT), (_LAST, _LAST), (_NEXT, _LAST), (_LAST, _NEXT))
    ]
)
#: Squared focal lengths, in sizes of the image: from wide angle to telephoto.
_FOCAL_SQUARED = np.geomspace(0.5, 4.0, 16) ** 2
_ONES = np.ones_like(_FOCAL_SQUARED)
#: What a focal length multiplies the squares of a matrix's rows by, and of its cofactors' rows;
#: and what a pair of them does those of the entries, row by row, for all pairs, (9, 256).
_ROW_GAIN = np.stack([_FOCAL_SQUARED, _FOCAL_SQUARED, _ONES])
_COFACTOR_ROW_GAIN = np.stack([_FOCAL_SQUARED, _FOCAL_SQUARED, _FOCAL_SQUARED**2])
_ENTRY_GAIN = np.kron(_ROW_GAIN, _ROW_GAIN)
_COFACTOR_GAIN = np.kron(_COFACTOR_ROW_GAIN, _COFACTOR_ROW_GAIN)


def essential_ratio(F: Floats, image_size: float = np.sqrt(12.0)) -> NDArray[np.float64]:
    """How nearly two ordinary cameras can have these fundamental matrices, in [0, 1].

    With square pixels and the principal point in the middle of the image, ``K'^T F K`` is an
    essential matrix for the right focal lengths: its two singular values are equal. Returned is
    the smaller over the larger one, for the focal lengths that bring them closest, each between
    half the image size and four times as much. Those of a wrong matrix are often imaginary, or
    absurd. Hartley and Zisserman, "Multiple view geometry" (2004), sections 9.6 and 19.4.

    Parameters
    ----------
    F : array, shape (m, 3, 3)
        Matrices of rank 2, in pixels from the middle of either image.
    image_size : float
        Pixels. The default is that of points spread evenly, in a `Frame`.
    """
    zoom = np.array([image_size, image_size, 1.0])
    entries = F * np.outer(zoom, zoom)
    cofactors = _cofactors(entries).reshape(-1, 9)
    # Of K'^T F K: the sum of the squares of the singular values s >= t, and that of the product.
    total = entries.reshape(-1, 9) ** 2 @ _ENTRY_GAIN
    squared = cofactors**2 @ _COFACTOR_GAIN
    # The largest square of 2 s t / (s^2 + t^2), which grows with t / s and tells it.
    largest = np.minimum(4.0 * (squared / (total * total)).max(axis=1), 1.0)
    return np.asarray(np.sqrt(largest) / (1.0 + np.sqrt(1.0 - largest)))


def eight_point(samples: Floats) -> NDArray[np.float64]:
    """Fundamental matrices of sets of eight or more matches each.

    Hartley's normalised eight-point algorithm: least squares for F in normalised coordinates,
    then the nearest matrix of rank 2; equations (3) to (8) of Wu and Wan.

    Parameters
    ----------
    samples : array, shape (m, k, 4)
        m sets of k >= 8 matches.

    Returns
    -------
    array, shape (m, 3, 3)
        Matrices of rank 2 and unit norm, in pixels.
    """
    m, k, _ = samples.shape
    transforms, points = [], []
    for Y in (samples[..., :2], samples[..., 2:]):
        centre = Y.mean(axis=1, keepdims=True)
        scale = np.sqrt(2.0) / (np.linalg.norm(Y - centre, axis=2).mean(axis=1) + _TINY)
        T = np.zeros((m, 3, 3))
        T[:, 0, 0] = T[:, 1, 1] = scale
        T[:, :2, 2] = -scale[:, None] * centre[:, 0]
        T[:, 2, 2] = 1.0
        transforms.append(T)
        Z = np.ones((m, k, 3))
        Z[..., :2] = (Y - centre) * scale[:, None, None]
        points.append(Z)
    A = (points[1][..., :, None] * points[0][..., None, :]).reshape(m, k, 9)
    G = np.linalg.svd(A, full_matrices=True)[2][:, 8].reshape(m, 3, 3)
    F = transforms[1].transpose(0, 2, 1) @ _rank_two(G) @ transforms[0]
    return np.asarray(F / np.linalg.norm(F, axis=(1, 2), keepdims=True))


def polish(
    frame: Frame,
    G: Floats,
    scales: Sequence[float],
    samples: NDArray[np.bool_] | None = None,
) -> Floats:
    """Step from fundamental matrices towards the least squares of all matches near their lines.

    One weighted Gauss-Newton step per scale: minimises the Sampson distances under Geman-McClure
    weights ``1 / (1 + (r / scale)^2)^2`` over the seven degrees of freedom of a matrix of rank 2.

    Parameters
    ----------
    frame : Frame
        The matches.
    G : array, shape (m, 3, 3)
        Starting matrices in the frame.
    scales : sequence of float
        Width of the weights in pixels, step by step.
    samples : array, shape (k, n), bool, optional
        The matches that the first step is restricted to: k matrices come of one. An infinite scale
        gives them all the same weight.

    Returns
    -------
    array, shape (m, 3, 3), or (k, 3, 3)
        Matrices of unit norm in the frame, of rank 2 but for what a long last step has left.
    """
    for scale in scales:
        at = _Linearized(frame, G)
        weight = 1.0 / (1.0 + at.squared / (scale * frame.scale) ** 2)
        weight *= weight
        if samples is not None:
            weight, samples = weight * samples, None
        G = at.moved(*at.normal_equations(weight))
    return _towards_rank_two(G)[0]


def refine(
    frame: Frame, G: Floats, sigma: float, doubt: Floats | float, noise: float, steps: int
) -> Floats:
    """Step from a matrix near the right one towards the most likely one, given all matches.

    Residuals of right matches have Student's distribution with five degrees of freedom, for noise
    has tails; those of wrong ones are even near the lines. A match counts as far as it is likely to
    be right. The cameras weigh in: how far `essential_ratio` falls short of 1 is one more
    residual, of standard deviation ``_SHORTFALL`` and with Cauchy's weights of width ``_FOREIGN``.
    It tells where the matches do not, and loses its say where the cameras seem to be of another
    kind.

    Parameters
    ----------
    frame : Frame
        The matches.
    G : array, shape (3, 3)
        Starting matrix in the frame.
    sigma : float
        Scale of Student's distribution, pixels.
    doubt : array, shape (n,), or float
        How much more likely, at a residual of 0, a match is wrong than right.
    noise : float
        Standard deviation of right residuals, pixels: how strong the cameras are beside them.
    steps : int
        How many to take.

    Returns
    -------
    array, shape (3, 3)
        Matrix of rank 2 and unit norm, in the frame.
    """
    G = G[None]
    for _ in range(steps):
        at = _Linearized(frame, G)
        near = 1.0 / (1.0 + at.squared / (_DEGREES * (sigma * frame.scale) ** 2))
        # The density of right ones is as near ** 3.
        density = near * near * near
        hessian, gradient = at.normal_equations(near * density / (density + doubt))
        lack = 1.0 - essential_ratio(at.G + _NUDGES)
        slope = (lack[1:10] - lack[10:]) / (2.0 * _NUDGE)
        pull = np.square(noise * frame.scale / _SHORTFALL) / (1.0 + (lack[0] / _FOREIGN) ** 2)
        hessian += pull * slope[:, None] * slope
        gradient += (pull * lack[0] * slope)[:, None]
        G = at.moved(hessian, gradient)
    return np.asarray(_rank_two(G)[0])


class _Linearized:
    """Residuals at matrices of rank 2, and how they change with these: a Gauss-Newton step.

    The unknowns are all nine entries. The two directions in which norm and rank would change, along
    G and its cofactors, are made stiff, so that a step goes along the tangent space of the matrices
    of rank 2 (Absil, Mahony and Sepulchre, "Optimization algorithms on matrix manifolds", 2008).
    The gradient is exact: to hold the denominator of the Sampson distance fixed, as iteratively
    reweighted least squares do, would end beside the minimum, far beside it where the baseline is
    short (Chojnacki, Brooks, van den Hengel and Gawley, "On the fitting of surfaces to data with
    covariances", PAMI 2000).

    Attributes
    ----------
    G : array, shape (m, 3, 3)
        The matrices, a step nearer to rank 2.
    squared : array, shape (m, n)
        Squared Sampson distances, in the frame.
    """

    __slots__ = ("G", "_frame", "_norm", "_stiff", "squared")

    def __init__(self, frame: Frame, G: Floats) -> None:
        self.G, across = _towards_rank_two(G)
        self._stiff = np.concatenate([self.G, across], axis=1).reshape(-1, 2, 9)
        algebraic, self._norm = frame.errors(self.G)
        self.squared = algebraic * algebraic / self._norm
        self._frame = frame

    def normal_equations(self, weight: Floats) -> tuple[Floats, Floats]:
        """Hessian (m, 9, 9) and gradient (m, 9, 1) of least squares with weights (m, n)."""
        weight = weight / self._norm
        hessian = self._frame.gram(weight)
        # The denominator's part, half the derivative of x^T G^T D G x + x'^T G D G^T x'.
        moments = self._frame.moments(weight * self.squared)
        drift = _NORMAL @ self.G @ moments[:, 0] + moments[:, 1] @ self.G @ _NORMAL
        return hessian, hessian @ self.G.reshape(-1, 9, 1) - drift.reshape(-1, 9, 1)

    def moved(self, hessian: Floats, gradient: Floats) -> Floats:
        """Matrices (m, 3, 3) a step further, of rank 2 and unit norm but for the second order."""
        trace = hessian.trace(axis1=1, axis2=2)[:, None, None] + _TINY
        stiff = (_STIFFNESS * self._stiff.transpose(0, 2, 1)) @ self._stiff + _DAMPING
        step = solved(hessian + trace * stiff, gradient).reshape(-1, 3, 3)
        return np.asarray(self.G - step * np.minimum(1.0, 0.5 / (_norms(step) + _TINY)))


def _towards_rank_two(G: Floats) -> tuple[Floats, Floats]:
    """Step from matrices (m, 3, 3) near rank 2 towards it: one of Newton's, to a determinant of 0.

    Returns them, of unit norm, and the directions in which their determinants change.
    """
    across = _cofactors(G)
    across /= _norms(across) + _TINY
    # Three times the determinant is the sum of the entries times their cofactors.
    G = G - _dots(across, G) / 3.0 * across
    G /= _norms(G)
    return G, across


def _norms(G: Floats) -> Floats:
    """Frobenius norms of matrices (m, 3, 3), (m, 1, 1)."""
    return np.asarray(np.sqrt(_dots(G, G)))


def _dots(G: Floats, H: Floats) -> Floats:
    """Sum up the products of the entries of matrices (m, 3, 3), (m, 1, 1)."""
    return np.asarray(G.reshape(-1, 1, 9) @ H.reshape(-1, 9, 1))


def _cofactors(G: Floats) -> Floats:
    """Cofactors of matrices (m, 3, 3), the determinant's gradient; of the same shape."""
    factors = G.reshape(-1, 9).take(_MINORS, axis=1)
    return (factors[:, 0] * factors[:, 1] - factors[:, 2] * factors[:, 3]).reshape(-1, 3, 3)


def _rank_two(G: Floats) -> Floats:
    """Nearest matrices (m, 3, 3) of rank 2 and of unit norm."""
    U, S, Vt = np.linalg.svd(G)
    S = S[:, :2] / np.hypot(S[:, :1], S[:, 1:2])
    return np.asarray((U[:, :, :2] * S[:, None]) @ Vt[:, :2])
