"""How wrong a fundamental matrix is, and one row of numbers for many pairs.

A failure (no F, or one that is not finite) has an infinite error everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import trapezoid

Floats = NDArray[np.float64]

#: Mean average accuracy: the mean share of pairs below each of these errors, pixels.
ACCURACY_LEVELS = (0.25, 0.5, 1.0, 2.0, 5.0)
#: A pair with a larger error counts as lost, pixels.
LOST = 5.0
#: A difference this small, relative to the smaller error, is a tie in a paired comparison.
TIE = 0.02


def usable(F: ArrayLike | None) -> Floats | None:
    """Return F as a finite, non-zero (3, 3) array, else None. Of stacked solutions the first."""
    if F is None:
        return None
    F = np.asarray(F, dtype=np.float64)
    if F.ndim != 2 or F.shape[1] != 3 or len(F) < 3:
        return None
    F = F[:3]
    norm = np.linalg.norm(F)
    return F / norm if np.isfinite(norm) and norm > 0 else None


def epipolar_distance(F: Floats, X: Floats) -> Floats:
    """Mean of the two point-to-epipolar-line distances of each match, pixels, (n,)."""
    algebraic, norm1, norm2 = _algebraic(F, X)
    with np.errstate(divide="ignore", invalid="ignore"):
        return (algebraic / norm1 + algebraic / norm2) / 2


def sampson_distance(F: Floats, X: Floats) -> Floats:
    """First-order distance of each match to the epipolar geometry, pixels, (n,)."""
    algebraic, norm1, norm2 = _algebraic(F, X)
    with np.errstate(divide="ignore", invalid="ignore"):
        return algebraic / np.hypot(norm1, norm2)


def _algebraic(F: Floats, X: Floats) -> tuple[Floats, Floats, Floats]:
    """|x2' F x1|, and the norms of the normals of the epipolar lines in image 1 and 2."""
    one = np.ones((len(X), 1))
    x1, x2 = np.hstack([X[:, :2], one]), np.hstack([X[:, 2:], one])
    line2, line1 = x1 @ F.T, x2 @ F
    return (
        np.abs((x2 * line2).sum(axis=1)),
        np.hypot(line1[:, 0], line1[:, 1]),
        np.hypot(line2[:, 0], line2[:, 1]),
    )


def epipolar_error(F: ArrayLike | None, truth: Floats) -> float:
    """Mean symmetric epipolar distance over the truth points, pixels.

    Parameters
    ----------
    F : (3, 3) array_like or None
        Estimate, ``[x', y', 1] @ F @ [x, y, 1] == 0``.
    truth : (m, 4) ndarray
        True matches x, y, x', y', pixels.

    Returns
    -------
    float
        Infinite for a failure.
    """
    F = usable(F)
    if F is None:
        return np.inf
    error = float(epipolar_distance(F, truth).mean())
    return error if np.isfinite(error) else np.inf


def pose_error(
    F: ArrayLike | None,
    K1: Floats,
    K2: Floats,
    R: Floats,
    t: Floats,
    truth: Floats,
) -> float:
    """Larger of the rotation's and the translation direction's angular error, degrees.

    E = K2' F K1 is cut into its four poses; the one with most truth points in front of both
    cameras counts.
    """
    F = usable(F)
    if F is None:
        return np.inf
    try:
        U, _, Vt = np.linalg.svd(K2.T @ F @ K1)
    except np.linalg.LinAlgError:
        return np.inf
    U, Vt = U * np.sign(np.linalg.det(U)), Vt * np.sign(np.linalg.det(Vt))
    W = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    one = np.ones((len(truth), 1))
    ray1 = np.hstack([truth[:, :2], one]) @ np.linalg.inv(K1).T
    ray2 = np.hstack([truth[:, 2:], one]) @ np.linalg.inv(K2).T
    poses = [(U @ w @ Vt, sign * U[:, 2]) for w in (W, W.T) for sign in (1.0, -1.0)]
    best_R, best_t = max(poses, key=lambda pose: _n_in_front(pose[0], pose[1], ray1, ray2))
    cos_R = np.clip((np.trace(R.T @ best_R) - 1) / 2, -1, 1)
    cos_t = np.clip(t @ best_t / np.linalg.norm(t), -1, 1)
    return float(np.degrees(max(np.arccos(cos_R), np.arccos(cos_t))))


def _n_in_front(R: Floats, t: Floats, ray1: Floats, ray2: Floats) -> int:
    """Count the points with both depths positive; depths solve z1 R ray1 + t = z2 ray2."""
    a, b = ray1 @ R.T, ray2
    aa, bb, ab = (a * a).sum(axis=1), (b * b).sum(axis=1), (a * b).sum(axis=1)
    at, bt = a @ t, b @ t
    z1, z2 = ab * bt - bb * at, aa * bt - ab * at  # both times a positive determinant
    return int(np.count_nonzero((z1 > 0) & (z2 > 0)))


def mean_average_accuracy(errors: Sequence[float] | Floats) -> float:
    """Mean over `ACCURACY_LEVELS` of the share of errors below, in [0, 1]."""
    e = np.asarray(errors, dtype=float)
    return float(np.mean([np.mean(e < level) for level in ACCURACY_LEVELS]))


def pose_auc(errors: Sequence[float] | Floats, limit: float) -> float:
    """Area under the recall curve of pose errors up to ``limit`` degrees, in [0, 1]."""
    e = np.sort(np.asarray(errors, dtype=float))
    n = len(e)
    below = e[e < limit]
    x = np.concatenate([[0.0], below, [limit]])
    y = np.concatenate([[0.0], np.arange(1, len(below) + 1) / n, [len(below) / n]])
    return float(trapezoid(y, x) / limit)


def summarise(
    errors: Sequence[float] | Floats,
    pose_errors: Sequence[float] | Floats | None = None,
    times: Sequence[float] | Floats | None = None,
) -> dict[str, float]:
    """One row of the tables.

    Parameters
    ----------
    errors : (n,) pixels
        `epipolar_error` of each pair.
    pose_errors : (m,) degrees, optional
        `pose_error` of the pairs with known cameras; NaN entries (unknown) are left out.
    times : (n,) ms, optional

    Returns
    -------
    dict
        n, median, p90 (px), lost (share above 5 px), mAA; auc5, auc10, n_pose; ms_median,
        ms_total. NaN where nothing is known.
    """
    e = np.asarray(errors, dtype=float)
    pose = np.asarray([] if pose_errors is None else pose_errors, dtype=float)
    pose = pose[~np.isnan(pose)]
    row = {
        "n": float(len(e)),
        "median": float(np.quantile(e, 0.5, method="inverted_cdf")) if len(e) else np.nan,
        "p90": float(np.quantile(e, 0.9, method="inverted_cdf")) if len(e) else np.nan,
        "lost": float(np.mean(~(e <= LOST))) if len(e) else np.nan,
        "mAA": mean_average_accuracy(e) if len(e) else np.nan,
        "n_pose": float(len(pose)),
        "auc5": pose_auc(pose, 5.0) if len(pose) else np.nan,
        "auc10": pose_auc(pose, 10.0) if len(pose) else np.nan,
    }
    ms = np.asarray([] if times is None else times, dtype=float)
    row["ms_median"] = float(np.median(ms)) if len(ms) else np.nan
    row["ms_total"] = float(ms.sum()) if len(ms) else np.nan
    return row


def wins_and_losses(ours: ArrayLike, theirs: ArrayLike) -> tuple[int, int]:
    """On how many pairs ``ours`` is clearly smaller, and on how many clearly larger.

    Clearly: by more than 2 % of the smaller error; failures on both sides tie.
    """
    a, b = np.asarray(ours, dtype=float), np.asarray(theirs, dtype=float)
    return (
        int(np.count_nonzero(a * (1 + TIE) < b)),
        int(np.count_nonzero(b * (1 + TIE) < a)),
    )
