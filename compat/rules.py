"""Which points cv2 calls inliers of a fundamental matrix, written down from its behaviour.

Kept apart from any implementation: a suite that borrows its rule from what it tests holds nothing.
"""

from __future__ import annotations

import cv2
import numpy as np

from compat.versions import EXACT_ARITHMETIC

USAC = range(cv2.USAC_DEFAULT, cv2.USAC_MAGSAC + 1)

RULES = {
    "all": "all matches",
    "ransac": "matches whose larger squared distance from the two epipolar lines, rounded to "
    "float32, is at most the squared threshold (3 for a threshold of 0 or less)",
    "lmeds": "matches whose larger squared distance from the two epipolar lines, rounded to "
    "float32, is at most the square of 2.5 * 1.4826 * (1 + 5 / (n - 7)) * sqrt(their median), "
    "whatever the threshold",
    "usac": "matches whose squared Sampson distance, in float32 throughout, is less than the "
    "squared threshold",
}


def rule_of(method: int | None, n: int) -> str | None:
    """Name the rule cv2 masks ``n`` points by; ``method`` is None for ``UsacParams``."""
    if method is None or method in USAC:
        return "usac"
    if n < 7:
        return None
    if n == 7 or method == cv2.FM_8POINT:
        return "all"
    return "ransac" if method & ~3 == cv2.FM_RANSAC and n >= 15 else "lmeds"


def squared_residuals(F, X, rule):
    """Squared distance that the rule compares, (n,) float32.

    USAC takes Sampson's distance, in float32 throughout. The classic methods take the larger of the
    two distances from the epipolar lines, in float64 from float32 points.
    """
    number = np.float32 if rule == "usac" else np.float64
    f = F.astype(number).ravel()
    x, y, u, v = X.astype(np.float32).astype(number).T
    with np.errstate(all="ignore"):
        a, b, c = f[0] * x + f[1] * y + f[2], f[3] * x + f[4] * y + f[5], f[6] * x + f[7] * y + f[8]
        d, e, g = f[0] * u + f[3] * v + f[6], f[1] * u + f[4] * v + f[7], f[2] * u + f[5] * v + f[8]
        if rule == "usac":
            algebraic = u * a + v * b + f[6] * x + f[7] * y + f[8]
            return algebraic * algebraic / (a * a + b * b + d * d + e * e)
        in_second = (u * a + v * b + c) ** 2 * (1 / (a * a + b * b))
        in_first = (x * d + y * e + g) ** 2 * (1 / (d * d + e * e))
        return np.maximum(in_first, in_second).astype(np.float32)


def wrong_flags(F, X, mask, rule, threshold):
    """Count the points whose flag is not the rule's."""
    flags = np.asarray(mask).ravel() == 1
    if rule == "all":
        return int(np.count_nonzero(~flags))
    error = squared_residuals(F, X, rule)
    if rule == "usac":
        limit = np.float64(threshold) * threshold
        inside = error.astype(np.float64) < limit
    else:
        if rule == "lmeds":
            sigma = 2.5 * 1.4826 * (1 + 5 / (len(X) - 7)) * np.sqrt(np.sort(error)[len(X) // 2])
            threshold = max(float(sigma), 0.001)
        elif threshold <= 0:
            threshold = 3.0
        with np.errstate(over="ignore"):
            limit = np.float32(np.float64(threshold) * threshold)
        inside = error <= limit
    wrong = flags != inside
    if not EXACT_ARITHMETIC:
        wrong &= np.abs(error - limit) > 1e-5 * limit
    return int(np.count_nonzero(wrong))
