"""Whether inliers are those of a common scene, from how they lie."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cv_densityf import _prefilter
from cv_densityf._arguments import check_mask, check_matches


def coherence(points1: ArrayLike, points2: ArrayLike, mask: ArrayLike | None = None) -> float:
    """How far matches that are neighbours in one image are neighbours in the other one.

    A fundamental matrix always has some inliers: wrong matches that lie near their epipolar lines.
    Nothing says where on the lines, so they are strewn about, while those of a common scene keep
    their neighbours. Among the inliers of two images that have nothing in common it is hardly ever
    above .35, among those of a right estimate mostly .5 and more. It takes fifteen inliers and more
    to tell, and cannot tell a scene from a copy of it, such as another front of the same windows.

    Parameters
    ----------
    points1, points2 : array-like, shape (n, 2)
        Matched points, pixels. Rows with NaN or Inf do not count.
    mask : array-like, shape (n,) or (n, 1), optional
        The inliers, as of an `Estimate` or of cv2. All matches by default.

    Returns
    -------
    float
        0 for matches paired at random, 1 where all sixteen nearest neighbours of each are the same
        in the same order; a little below 0 by chance. NaN for fewer than three. Of 10,000 and more
        matches it is the mean over every second, third, ... one.

    Raises
    ------
    ValueError
        If shapes differ, or the mask holds negative numbers or NaN.

    See Also
    --------
    estimate_fundamental : Finds the inliers.

    References
    ----------
    J. Ma, J. Zhao, J. Jiang, H. Zhou, X. Guo, "Locality preserving matching", International Journal
    of Computer Vision 127 (2019), keeps matches that keep their neighbours.

    Examples
    --------
    >>> import numpy as np
    >>> from cv_densityf import coherence, estimate_fundamental
    >>> from cv_densityf.datasets import two_view_scene
    >>> scene = two_view_scene(400, inlier_ratio=0.3, random_state=0)
    >>> right = estimate_fundamental(scene.points1, scene.points2)
    >>> coherence(scene.points1, scene.points2, right.mask) > 0.7
    True
    >>> shuffled = np.random.default_rng(0).permutation(scene.points2)
    >>> wrong = estimate_fundamental(scene.points1, shuffled)
    >>> coherence(scene.points1, shuffled, wrong.mask) < 0.35
    True
    """
    X = check_matches(points1, points2)
    rows = np.isfinite(X).all(axis=1)
    if mask is not None:
        rows &= check_mask(mask, len(X), "mask")
    return _prefilter.coherence(X[rows])
