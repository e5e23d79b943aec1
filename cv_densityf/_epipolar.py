"""Epipolar residuals, cv2's inlier rules, and the least-squares fits of a fundamental matrix.

A set of matches is an array ``X`` of shape (n, 4) with the columns x, y, x', y'; a fundamental
matrix satisfies ``[x', y', 1] @ F @ [x, y, 1] == 0``.
"""

from __future__ import annotations

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
    c = F[2, 0] * x + F[2, 1] * y + F[2, 2]
    d = F[0, 0] * u + F[1, 0] * v + F[2, 0]
    e = F[0, 1] * u + F[1, 1] * v + F[2, 1]
    algebraic = u * a + v * b + c
    return algebraic * algebraic / (a * a + b * b + d * d + e * e)


def _point_line_squared(F: Floats, X: Floats) -> Floats:
    """Larger of the two squared point-to-epipolar-line distances, (n,) float64."""
    x, y, u, v = X.astype(np.float32).astype(np.float64).T
    a = F[0, 0] * x + F[0, 1] * y + F[0, 2]
    b = F[1, 0] * x + F[1, 1] * y + F[1, 2]
    c = F[2, 0] * x + F[2, 1] * y + F[2, 2]
    in_second = u * a + v * b + c
    d = F[0, 0] * u + F[1, 0] * v + F[2, 0]
    e = F[0, 1] * u + F[1, 1] * v + F[2, 1]
    f = F[0, 2] * u + F[1, 2] * v + F[2, 2]
    in_first = x * d + y * e + f
    # cv2 multiplies by the reciprocal: the last bit decides ties at the threshold.
    return np.maximum(
        in_first * in_first * (1.0 / (d * d + e * e)),
        in_second * in_second * (1.0 / (a * a + b * b)),
    )


def sampson_distance(F: Floats, X: Floats) -> Floats:
    """Sampson distance of each match, pixels, (n,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(_sampson_squared(F, X))


def residuals(F: Floats, X: Floats, rule: Rule) -> Floats:
    """Return the distance in pixels that ``rule`` compares with its threshold, (n,)."""
    if rule == "usac":
        return sampson_distance(F, X)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(_point_line_squared(F, X))


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
        error = _point_line_squared(F, X).astype(np.float32)
        if rule == "lmeds":
            threshold = _lmeds_threshold(error[np.isfinite(error)])
        return np.asarray(error <= np.float32(threshold * threshold))


def _lmeds_threshold(error: Floats) -> float:
    n = len(error)
    if n <= 7:
        return _LMEDS_MIN_SIGMA
    median = float(np.partition(error, n // 2)[n // 2])
    return max(_LMEDS_SCALE * (1 + 5.0 / (n - 7)) * float(np.sqrt(median)), _LMEDS_MIN_SIGMA)
