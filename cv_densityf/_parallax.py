"""Fundamental matrices that share a dominant plane and differ in what lies off it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cv_densityf._epipolar import Frame

Floats = NDArray[np.floating]
Bools = NDArray[np.bool_]

#: A plane is dominant with at least this share of the inliers, and so many: six are always on one.
_DOMINANT = 0.7
FEWEST = 12
#: Steps to the plane of most inliers, each with little weight for what is off the last one's.
_STEPS = 3
#: Pairs of matches tried, and how many of the hypotheses through them are worth a polish.
_PAIRS = 512
_BEST = 2
#: Matches off the plane that are asked which these are, and in how many parts, for the residuals of
#: all pairs at once would not stay in the cache.
_JUDGES = 128
_PARTS = 4


def plane_and_parallax(
    frame: Frame,
    G: Floats,
    inliers: Bools,
    width: float,
    rng: np.random.Generator,
) -> tuple[Floats, Bools]:
    """Look for fundamental matrices with the dominant plane of one, and other epipoles.

    If nearly all inliers are on a plane, F is any of the three-dimensional family ``[e']_x H``, and
    a wrong one of these has nearly as many inliers as the right one. The family is what the plane's
    matches leave free: the three smallest eigenvectors of the sum of their outer squares. Two more
    matches off the plane fix F. Chum, Werner and Matas, "Two-view geometry estimation unaffected
    by a dominant plane" (CVPR 2005), who draw the pairs with the homography of a minimal sample.

    Parameters
    ----------
    frame : Frame
        The matches.
    G : array, shape (3, 3)
        A matrix in the frame.
    inliers : array, shape (n,)
        Its inliers.
    width : float
        Pixels within which a match is on the plane, and for a hypothesis.
    rng : numpy.random.Generator
        Of the pairs.

    Returns
    -------
    hypotheses : array, shape (m, 3, 3)
        The best ones in the frame; none if there is no dominant plane.
    off_plane : array, shape (n,)
        The matches that are not on it.
    """
    norm = frame.errors(G[None])[1]
    half = norm.shape[1] // 2
    # The norm is 0 for a match of the two epipoles.
    norm = np.maximum(norm, 0.01 * np.partition(norm, half)[:, half])

    def fit(plane: Floats) -> tuple[Floats, Floats, Floats]:
        family = np.linalg.eigh(frame.gram(plane / norm))[1][0, :, :3]
        coordinates = family.T @ frame.products  # of so few matches that BLAS starts no threads
        return family, coordinates, (coordinates**2).sum(axis=0) / (frame.scale * width) ** 2

    family, coordinates, squared = fit(inliers.astype(np.float64))
    for _ in range(_STEPS - 1):
        family, coordinates, squared = fit(inliers / (1.0 + squared / norm[0]) ** 2)
    # By the norm of one matrix, what is near its epipoles would be far off the plane; the mean over
    # the family is small nowhere.
    off_plane = squared > frame.errors(family.T.reshape(3, 3, 3))[1].mean(axis=0)
    on_plane = np.count_nonzero(inliers & ~off_plane)
    n = np.count_nonzero(off_plane)
    if on_plane < max(FEWEST, _DOMINANT * np.count_nonzero(inliers)) or n < 2:
        return np.empty((0, 3, 3)), off_plane
    first = rng.integers(n, size=_PAIRS)
    second = (first + rng.integers(1, n, size=_PAIRS)) % n
    through = coordinates[:, off_plane].T
    hypotheses = (np.cross(through[first], through[second]) @ family.T).reshape(-1, 3, 3)
    with np.errstate(invalid="ignore"):
        hypotheses /= np.linalg.norm(hypotheses, axis=(1, 2), keepdims=True)
    judges = rng.permutation(np.flatnonzero(off_plane))[:_JUDGES]
    jury = frame.part(judges)
    votes = np.concatenate(
        [
            np.maximum(0.0, 1.0 - jury.sampson(part) / width**2).sum(axis=1)
            for part in np.split(hypotheses, _PARTS)
        ]
    )
    best = np.argsort(-votes, kind="stable")[:_BEST]
    return hypotheses[best[votes[best] > 0]], off_plane  # copies of one match fix no F
