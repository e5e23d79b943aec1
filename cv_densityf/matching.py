"""Two images in, SIFT matches and a score for each match out."""

from __future__ import annotations

import os
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cv_densityf._arguments import check
from cv_densityf._files import InputError

#: Longer side, pixels, and number of features: enough for a precise F within about a second.
MAX_SIZE = 1600
MAX_FEATURES = 8000

#: Largest file that OpenCV decodes.
_MAX_BYTES = 2**31 - 1
#: How a JPEG file begins, and end marks to fill the longest segment there is.
_JPEG, _JPEG_END = b"\xff\xd8", 2**15 * b"\xff\xd9"
#: Rows of the similarity matrix held in memory at a time.
_CHUNK = 1024


@dataclass(frozen=True, eq=False)
class Features:
    """Features of one image.

    Attributes
    ----------
    points : (n, 2) float64
        Positions x, y in pixels of the image as it was given.
    descriptors : (n, 128) float32
        RootSIFT descriptors, unit length.
    size : tuple of int
        Width and height of the image, pixels.
    """

    points: NDArray[np.float64]
    descriptors: NDArray[np.float32]
    size: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Matches:
    """Matches of two images, in the order of the features of the first.

    Attributes
    ----------
    points1, points2 : (n, 2) float64
        Matched positions x, y in the first and second image, pixels.
    scores : (n,) float64
        Higher means more trusted: 1 minus the ratio of the descriptor's distance to its nearest
        and to its second nearest neighbour, in [0, 1].
    size1, size2 : tuple of int
        Width and height of the images, pixels.
    """

    points1: NDArray[np.float64]
    points2: NDArray[np.float64]
    scores: NDArray[np.float64]
    size1: tuple[int, int]
    size2: tuple[int, int]

    @property
    def X(self) -> NDArray[np.float64]:
        """The matches as rows x, y, x', y', (n, 4) float64."""
        return np.hstack([self.points1, self.points2])

    def __len__(self) -> int:
        return len(self.points1)

    def __repr__(self) -> str:
        (width1, height1), (width2, height2) = self.size1, self.size2
        return f"<Matches: {len(self)} of {width1} x {height1} and {width2} x {height2} pixels>"


def read_image(path: str | os.PathLike[str]) -> NDArray[Any]:
    """Read an image file as ``cv2.imread`` does, but keep its bit depth and say what is wrong.

    Parameters
    ----------
    path : str or path-like
        Any format that OpenCV reads.

    Returns
    -------
    (h, w) or (h, w, 3) array
        Grey, or colour in OpenCV's order (blue, green, red); turned as its EXIF tag says; an alpha
        channel is dropped.

    Raises
    ------
    OSError
        If the file cannot be read.
    cv_densityf.InputError
        A ``ValueError``: OpenCV cannot decode the file.
    """
    path = os.fspath(path)
    # Read whole, this would only be refused by OpenCV.
    if os.path.getsize(path) > _MAX_BYTES:
        raise InputError(f"{path}: larger than the 2 GB that OpenCV can decode")
    # Not cv2.imread: it writes its own warnings, and cannot tell a missing file from a bad one.
    with open(path, "rb") as stream:  # which may be a pipe
        data = stream.read()
    if data.startswith(_JPEG):
        # As libjpeg does with a file that is cut off, for imread but not for imdecode.
        data += _JPEG_END
    try:
        image = cv2.imdecode(
            np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR
        )
    except cv2.error:
        image = None
    if image is None:
        raise InputError(f"{path}: not an image that OpenCV can read")
    return image


def detect(
    image: NDArray[Any], *, max_size: int | None = MAX_SIZE, max_features: int | None = MAX_FEATURES
) -> Features:
    """Find SIFT features and describe them with RootSIFT.

    Parameters
    ----------
    image : (h, w), (h, w, 1), (h, w, 2), (h, w, 3) or (h, w, 4) array
        Grey, grey and alpha, colour in OpenCV's order, or colour and alpha; alpha is ignored.
        uint8 is taken as it is; any other real type is stretched linearly so that the range from
        its 0.1 to its 99.9 percentile fills 8 bits.
    max_size : int or None
        Larger images are shrunk until their longer side has this many pixels. The points are
        still given in pixels of ``image``.
    max_features : int or None
        At most about this many of the strongest features are kept (ties stay in).

    Returns
    -------
    Features

    Raises
    ------
    TypeError
        If ``image`` is not an array of real numbers.
    ValueError
        If its shape is not an image's, or an option is no positive integer.

    References
    ----------
    Lowe, Distinctive image features from scale-invariant keypoints, IJCV 2004.
    Arandjelovic and Zisserman, Three things everyone should know to improve object retrieval,
    CVPR 2012 (RootSIFT).
    """
    for name, value in (("max_size", max_size), ("max_features", max_features)):
        if value is not None:
            check(name, value, Integral, lambda v: v >= 1, "an integer of 1 and more, or None")
    pixels: NDArray[Any] = grey(image)
    height, width = pixels.shape
    scale = 1.0 if max_size is None else min(1.0, max_size / max(height, width))
    if scale < 1:
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    # Without precise upscaling every point is off by a quarter of a pixel.
    sift = cv2.SIFT.create(nfeatures=max_features or 0, enable_precise_upscale=True)
    keypoints, descriptors = sift.detectAndCompute(pixels, None)
    if not keypoints:
        empty = np.empty((0, 128), dtype=np.float32)
        return Features(np.empty((0, 2)), empty, (width, height))
    points = np.asarray(cv2.KeyPoint.convert(keypoints), dtype=np.float64)
    shrunk = np.array([width / pixels.shape[1], height / pixels.shape[0]])
    points = (points + 0.5) * shrunk - 0.5
    descriptors = descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12)
    return Features(points, np.sqrt(descriptors, dtype=np.float32), (width, height))


def match_features(
    features1: Features, features2: Features, *, ratio: float | None = None, mutual: bool = True
) -> Matches:
    """Match two images' features by their nearest descriptors.

    Parameters
    ----------
    features1, features2 : Features
        From `detect`.
    ratio : float or None
        Keep only matches whose nearest descriptor is closer than ``ratio`` times the second
        nearest (Lowe's ratio test, in (0, 1]). By default all are kept, and the ratio becomes the
        score.
    mutual : bool
        Keep only matches that are each other's nearest neighbour.

    Returns
    -------
    Matches
        Equal rows, which SIFT makes where a feature has several orientations, are given once,
        with their best score.

    Raises
    ------
    ValueError
        If ``ratio`` is not in (0, 1].
    """
    if ratio is not None:
        check("ratio", ratio, Real, lambda v: 0 < v <= 1, "a number in (0, 1], or None")
    nearest, ratios, is_mutual = _nearest(features1.descriptors, features2.descriptors)
    chosen = is_mutual if mutual else np.ones(len(nearest), dtype=bool)
    if ratio is not None:
        chosen = chosen & (ratios < ratio)
    rows = np.flatnonzero(chosen)
    rows = rows[np.argsort(ratios[rows], kind="stable")]
    X = np.hstack([features1.points[rows], features2.points[nearest[rows]]])
    first = np.unique(X, axis=0, return_index=True)[1]
    rows = np.sort(rows[first])
    return Matches(
        features1.points[rows],
        features2.points[nearest[rows]],
        1 - ratios[rows],
        features1.size,
        features2.size,
    )


def match_images(
    image1: NDArray[Any],
    image2: NDArray[Any],
    *,
    max_size: int | None = MAX_SIZE,
    max_features: int | None = MAX_FEATURES,
    ratio: float | None = None,
    mutual: bool = True,
) -> Matches:
    """Match two images: SIFT features, RootSIFT descriptors, mutual nearest neighbours.

    No match is thrown away by its ratio unless ``ratio`` is given: the estimators of this package
    look at the density of all matches, and take the scores beside it.

    Parameters
    ----------
    image1, image2 : (h, w) or (h, w, channels) array
        Grey or colour images with or without alpha, of any real type; see `detect`.
    max_size : int or None
        Images are shrunk until their longer side has this many pixels before features are
        sought. The points are still given in pixels of the images.
    max_features : int or None
        At most about this many of the strongest features per image.
    ratio : float or None
        Lowe's ratio test, in (0, 1]; None keeps all.
    mutual : bool
        Keep only matches that are each other's nearest neighbour.

    Returns
    -------
    Matches
        ``points1`` and ``points2`` (n, 2) in pixels, ``scores`` (n,), higher = more trusted.

    Raises
    ------
    TypeError, ValueError
        If an argument is no image, or an option is out of range.

    Examples
    --------
    >>> import cv2, numpy as np
    >>> from cv_densityf.matching import match_images
    >>> rng = np.random.default_rng(0)
    >>> image = cv2.resize(rng.integers(0, 255, (60, 80), dtype=np.uint8), (640, 480))
    >>> moved = np.roll(image, 20, axis=1)
    >>> matches = match_images(image, moved)
    >>> bool(len(matches) > 100)
    True
    >>> np.median(matches.points2 - matches.points1, axis=0).round().tolist()
    [20.0, 0.0]
    """
    features1, features2 = (
        detect(image, max_size=max_size, max_features=max_features) for image in (image1, image2)
    )
    return match_features(features1, features2, ratio=ratio, mutual=mutual)


def grey(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Return any image that `detect` takes as (h, w) uint8, or raise TypeError or ValueError."""
    if not isinstance(image, np.ndarray):
        raise TypeError(
            f"an image must be a NumPy array, not {type(image).__name__}; "
            "read_image makes one of a file"
        )
    if image.dtype.kind not in "buif":
        raise TypeError(f"an image must hold real numbers, not {image.dtype}")
    channels = image.shape[2] if image.ndim == 3 else 1
    if image.ndim not in (2, 3) or image.size == 0 or channels > 4:
        raise ValueError(
            "an image must have the shape (height, width) or (height, width, 1 to 4 channels), "
            f"not {image.shape}"
        )
    if image.ndim == 3:
        image = image[:, :, 0] if channels < 3 else image[:, :, :3]
    if image.dtype != np.uint8:
        image = _stretched(image)
    image = np.ascontiguousarray(image)
    shades = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return np.asarray(shades, dtype=np.uint8)


def _stretched(image: NDArray[Any]) -> NDArray[np.uint8]:
    # 12-bit data in 16-bit files are common, and floats have no range of their own.
    with np.errstate(over="ignore"):
        values = image.astype(np.float32)
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return np.zeros(image.shape, dtype=np.uint8)
    low, high = (float(bound) for bound in np.percentile(finite, [0.1, 99.9]))
    if high <= low:
        low, high = float(finite.min()), float(finite.max())
    if high <= low:
        return np.zeros(image.shape, dtype=np.uint8)
    values = np.clip(np.nan_to_num(values, nan=low, posinf=high, neginf=low), low, high)
    return np.asarray(np.rint((values - low) * (255 / (high - low))), dtype=np.uint8)


def _nearest(
    descriptors1: NDArray[np.float32], descriptors2: NDArray[np.float32]
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.bool_]]:
    """Nearest row of the second set, ratio to the second nearest, and whether it is mutual."""
    n1, n2 = len(descriptors1), len(descriptors2)
    nearest = np.zeros(n1, dtype=np.intp)
    ratios = np.ones(n1)
    if n1 == 0 or n2 == 0:
        return nearest[:0], ratios[:0], np.zeros(0, dtype=bool)
    column_best = np.full(n2, -np.inf, dtype=np.float32)
    column_row = np.zeros(n2, dtype=np.intp)
    for start in range(0, n1, _CHUNK):
        similarity = descriptors1[start : start + _CHUNK] @ descriptors2.T
        rows = np.arange(len(similarity))
        best_row = similarity.argmax(axis=0)
        best = similarity[best_row, np.arange(n2)]
        better = best > column_best
        column_best[better] = best[better]
        column_row[better] = best_row[better] + start

        first = similarity.argmax(axis=1)
        first_value = similarity[rows, first]
        similarity[rows, first] = -np.inf
        second_value = similarity.max(axis=1)
        nearest[start : start + _CHUNK] = first
        ratios[start : start + _CHUNK] = _ratio(first_value, second_value)
    return nearest, ratios, column_row[nearest] == np.arange(n1)


def _ratio(
    similarity1: NDArray[np.float32], similarity2: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Ratio of the distances of unit vectors with these inner products, in [0, 1]."""
    squared1, squared2 = (
        np.maximum(2 - 2 * s.astype(np.float64), 0) for s in (similarity1, similarity2)
    )
    with np.errstate(invalid="ignore"):
        ratios = np.sqrt(squared1 / np.where(squared2 > 0, squared2, np.nan))
    # Two neighbours at no distance: neither is to be preferred. No second one: infinitely far.
    return np.where(np.isnan(ratios), 1.0, np.minimum(ratios, 1.0))
