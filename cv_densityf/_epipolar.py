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
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(_sampson_squared(F, X))


def residuals(F: Floats, X: Floats, rule: Rule) -> Floats:
    """Return the distance in pixels that ``rule`` compares with its threshold, (n,)."""
    if rule == "usac":
        return sampson_distance(F, X)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(point_line_squared(F, X))


def inlier_mask(F: Floats, X: Floats, rule: Rule, threshold: float) -> NDArray[np.bool_]:
    """Inliers of ``F`` by cv2's own rule, bit for bit.

    ``"usac"``: Sampson distance in float32, strictly below the threshold. ``"ransac"``: the larger
    point-to-line distance, at most the threshold. ``"lmeds"``: the same distance against 2.5 robust
    standard deviations, estimated from the median over the finite rows; ``threshold`` is unused.
    Rows with a non-finite residual are no inliers.
    """
    with np.errstate(all="ignore"):
        if rule == "usac":
            error = _sampson_squared(F.astype(np.float32), X.astype(np.float32))
            return np.asarray(error.astype(np.float64) < threshold * threshold)
        error = point_line_squared(F, X).astype(np.float32)
        if rule == "lmeds":
            threshold = _lmeds_threshold(error[np.isfinite(error)])
        return np.asarray(error <= np.float32(threshold * threshold))


def _lmeds_threshold(error: Floats) -> float:
    n = len(error)
    if n <= 7:
        return _LMEDS_MIN_SIGMA
    median = float(np.partition(error, n // 2)[n // 2])
    return max(_LMEDS_SCALE * (1 + 5.0 / (n - 7)) * float(np.sqrt(median)), _LMEDS_MIN_SIGMA)


#: A symmetric 9 x 9 matrix from its upper triangle, which is summed once per match.
_ROWS, _COLUMNS = np.triu_indices(9)
_SQUARE = np.empty((9, 9), dtype=np.intp)
_SQUARE[_ROWS, _COLUMNS] = _SQUARE[_COLUMNS, _ROWS] = np.arange(45)


class Frame:
    """Matches in coordinates that keep least squares well conditioned.

    Both images are centred and divided by the *same* scale, so that a residual in this frame is a
    residual in pixels times ``scale``. Hartley, "In defense of the eight-point algorithm" (1997);
    here without what lies far out, or ``about`` a given centroid and standard deviation.
    """

    __slots__ = (
        *("_first", "_from_first", "_from_second", "_second"),
        *("homogeneous1", "homogeneous2", "outer", "products", "scale"),
    )

    def __init__(self, X: Floats, about: tuple[Floats, float] | None = None) -> None:
        centre, spread = about or middle(X)
        self.scale = 1.0 / spread if spread > 0 else 1.0
        Z = (X - centre).T * self.scale
        ones = np.ones((1, len(X)))
        self.homogeneous1 = np.concatenate([Z[:2], ones])
        self.homogeneous2 = np.concatenate([Z[2:], ones])
        self.products = (self.homogeneous2[:, None] * self.homogeneous1[None]).reshape(9, -1)
        self.outer = np.empty((45, len(X)))
        row = 0
        for i in range(9):
            np.multiply(self.products[i], self.products[i:], out=self.outer[row : row + 9 - i])
            row += 9 - i
        zoom = np.diag([self.scale, self.scale, 1.0])
        self._first = zoom @ shift(-centre[:2])
        self._second = zoom @ shift(-centre[2:])
        self._from_first, self._from_second = np.linalg.inv([self._first, self._second])

    def part(self, rows: NDArray[np.bool_]) -> Frame:
        """Return the same frame, holding only the matches marked in ``rows`` (n,)."""
        part = copy(self)
        for name in ("homogeneous1", "homogeneous2", "outer", "products"):
            setattr(part, name, getattr(self, name)[:, rows])
        return part

    def enter(self, F: Floats) -> Floats:
        """Fundamental matrices (m, 3, 3) in pixels, in this frame and of unit norm."""
        G = self._from_second.T @ F @ self._from_first
        return np.asarray(G / np.sqrt(np.einsum("mij,mij->m", G, G))[:, None, None])

    def leave(self, G: Floats) -> Floats:
        """Fundamental matrices (m, 3, 3) of this frame, in pixels."""
        return np.asarray(self._second.T @ G @ self._first)

    def errors(self, G: Floats) -> tuple[Floats, Floats]:
        """Algebraic error and squared gradient norm of each match under each matrix, (m, n)."""
        lines2 = G[:, :2] @ self.homogeneous1
        lines1 = G.transpose(0, 2, 1)[:, :2] @ self.homogeneous2
        norm = np.einsum("mkn,mkn->mn", lines2, lines2)
        norm += np.einsum("mkn,mkn->mn", lines1, lines1)
        return G.reshape(-1, 9) @ self.products, norm

    def sampson(self, G: Floats) -> Floats:
        """Squared Sampson distances in squared pixels, (m, n)."""
        algebraic, norm = self.errors(G)
        return algebraic * algebraic / (norm * self.scale**2 + _TINY)


def middle(X: Floats) -> tuple[Floats, float]:
    """Centroid (4,) of the matches and standard deviation about it, but for matches far out."""
    half = len(X) // 2
    away = np.abs(X - np.partition(X, half, axis=0)[half]).max(axis=1)
    # Three quarters and not half, since half may be copies of one match.
    most = 3 * len(X) // 4
    reach = FAR * np.partition(away, most)[most]
    near = X[away <= reach] if reach > 0 else X
    centre = near.mean(axis=0)
    return centre, float(np.sqrt(((near - centre) ** 2).mean()))


def shift(by: Floats) -> NDArray[np.float64]:
    """Matrix that moves homogeneous points by a vector (2,)."""
    return np.array([[1.0, 0.0, by[0]], [0.0, 1.0, by[1]], [0.0, 0.0, 1.0]])


_TINY = 1e-300
#: Matches this many times as far out as three quarters of them cannot be in the image.
FAR = 5.0
#: Generators of the rotations about the three axes.
_SKEW = np.zeros((3, 3, 3))
_SKEW[0, 2, 1] = _SKEW[1, 0, 2] = _SKEW[2, 1, 0] = 1.0
_SKEW[0, 1, 2] = _SKEW[1, 2, 0] = _SKEW[2, 0, 1] = -1.0
_HALF_SKEW = 0.5 * _SKEW.reshape(3, 9)
_EYE = np.eye(3)


#: Squared focal lengths, in sizes of the image: from wide angle to telephoto.
_FOCAL_SQUARED = np.geomspace(0.5, 4.0, 8) ** 2
_ONES = np.ones_like(_FOCAL_SQUARED)
#: What the focal length multiplies the squares of a matrix's rows by, and of its cofactors' rows.
_ENTRY_GAIN = np.stack([_FOCAL_SQUARED, _FOCAL_SQUARED, _ONES])
_COFACTOR_GAIN = np.stack([_FOCAL_SQUARED, _FOCAL_SQUARED, _FOCAL_SQUARED**2])


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
    F = F * np.outer(zoom, zoom)
    U, S, Vt = np.linalg.svd(F)
    # Of K'^T F K: the sum of the squared singular values, and twice their product.
    total = _ENTRY_GAIN.T @ F**2 @ _ENTRY_GAIN
    epipole2, epipole1 = U[:, :, 2] ** 2 @ _COFACTOR_GAIN, Vt[:, 2] ** 2 @ _COFACTOR_GAIN
    twice = (
        2.0
        * (S[:, 0] * S[:, 1])[:, None, None]
        * np.sqrt(epipole2[:, :, None] * epipole1[:, None, :])
    )
    difference = np.sqrt(np.maximum(total - twice, 0.0))
    both = np.sqrt(total + twice)
    return np.asarray(((both - difference) / (both + difference)).max(axis=(1, 2)))


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
    U, S, Vt = np.linalg.svd(G)
    S[:, 2] = 0.0
    F = transforms[1].transpose(0, 2, 1) @ ((U * S[:, None]) @ Vt) @ transforms[0]
    return np.asarray(F / np.linalg.norm(F, axis=(1, 2), keepdims=True))


def polish(frame: Frame, G: Floats, scales: Sequence[float | Floats]) -> Floats:
    """Refine fundamental matrices on all matches, one weighted Gauss-Newton step per scale.

    Minimises the Sampson distances under Geman-McClure weights ``1 / (1 + (r / scale)^2)^2`` over
    the seven degrees of freedom of a rank-2 matrix ``U diag(cos a, sin a, 0) V^T`` (Bartoli and
    Sturm, "Nonlinear estimation of the fundamental matrix with minimal parameters", 2004). The
    gradient norm in the Sampson distance is held fixed within a step, as in iteratively reweighted
    least squares.

    Parameters
    ----------
    frame : Frame
        The matches.
    G : array, shape (m, 3, 3)
        Starting matrices in the frame.
    scales : sequence of float or of arrays of shape (m,)
        Width of the weights in pixels, step by step.

    Returns
    -------
    array, shape (m, 3, 3)
        Refined matrices of rank 2 and unit norm, in the frame.
    """
    U, S, Vt = np.linalg.svd(G)
    angle = np.arctan2(S[:, 1], S[:, 0])
    m = len(G)
    D = np.zeros((m, 3, 3))
    for scale in scales:
        c, s = np.cos(angle), np.sin(angle)
        D[:, 0, 0], D[:, 1, 1] = c, s
        G = U @ D @ Vt
        algebraic, norm = frame.errors(G)
        norm += _TINY
        width = np.asarray(scale, dtype=float).reshape(-1, 1) * frame.scale
        weight = 1.0 / (1.0 + algebraic * algebraic / (norm * width**2))
        weight *= weight / norm
        gram = (weight @ frame.outer.T)[:, _SQUARE]
        W = np.empty((m, 7, 3, 3))
        W[:, :3] = _SKEW @ D[:, None]
        W[:, 3:6] = D[:, None] @ _SKEW
        W[:, 6] = 0.0
        W[:, 6, 0, 0], W[:, 6, 1, 1] = -s, c
        tangent = (U[:, None] @ W @ Vt[:, None]).reshape(m, 7, 9)
        half = tangent @ gram
        hessian = half @ tangent.transpose(0, 2, 1)
        gradient = half @ G.reshape(m, 9, 1)
        damping = 1e-9 * np.einsum("mkk->m", hessian) + _TINY
        np.einsum("mkk->mk", hessian)[...] += damping[:, None]
        step = -np.linalg.solve(hessian, gradient)[:, :, 0]
        length = np.sqrt(np.einsum("mk,mk->m", step, step))
        step *= np.minimum(1.0, 0.5 / (length + _TINY))[:, None]
        rotation = _rotation(step[:, :6].reshape(-1, 3)).reshape(m, 2, 3, 3)
        U = U @ rotation[:, 0]
        Vt = rotation[:, 1] @ Vt
        angle = angle + step[:, 6]
    D[:, 0, 0], D[:, 1, 1] = np.cos(angle), np.sin(angle)
    return np.asarray(U @ D @ Vt)


def _rotation(axis: Floats) -> Floats:
    """Cayley's rotation for small axis vectors (m, 3); equal to the exponential to second order."""
    K = (axis @ _HALF_SKEW).reshape(-1, 3, 3)
    shrink = 2.0 / (1.0 + 0.25 * np.einsum("mk,mk->m", axis, axis))
    return np.asarray(_EYE + (K + K @ K) * shrink[:, None, None])
