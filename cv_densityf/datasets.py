"""Matches and image pairs whose fundamental matrix is known."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from numbers import Integral, Real
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cv_densityf._arguments import check

_SIZE = (1280, 960)
_FOCAL = 1000.0


@dataclass(frozen=True, eq=False)
class Scene:
    """Matches of a made-up scene.

    Attributes
    ----------
    points1, points2 : (n, 2) float64
        Positions x, y in the two images, pixels.
    inliers : (n,) bool
        True where the match is of one point of the scene.
    F : (3, 3) float64
        The exact fundamental matrix, unit norm, ``[x', y', 1] @ F @ [x, y, 1] == 0``.
    size : tuple of int
        Width and height of both images, pixels.
    """

    points1: NDArray[np.float64]
    points2: NDArray[np.float64]
    inliers: NDArray[np.bool_]
    F: NDArray[np.float64]
    size: tuple[int, int]

    @property
    def X(self) -> NDArray[np.float64]:
        """The matches as rows x, y, x', y', (n, 4) float64."""
        return np.hstack([self.points1, self.points2])

    def __repr__(self) -> str:
        n_right = np.count_nonzero(self.inliers)
        return f"<Scene: {len(self.inliers)} matches, {n_right} of them right>"


@dataclass(frozen=True, eq=False)
class ImagePair:
    """Two photographs with known geometry.

    Attributes
    ----------
    image1, image2 : (h, w, 3) uint8
        Blue, green, red, as OpenCV has it.
    F : (3, 3) float64
        The exact fundamental matrix, unit norm, ``[x', y', 1] @ F @ [x, y, 1] == 0``.
    points1, points2 : (n, 2) float64
        True correspondences on a grid of the first image, pixels.
    """

    image1: NDArray[np.uint8]
    image2: NDArray[np.uint8]
    F: NDArray[np.float64]
    points1: NDArray[np.float64]
    points2: NDArray[np.float64]

    def __repr__(self) -> str:
        (h1, w1), (h2, w2) = self.image1.shape[:2], self.image2.shape[:2]
        return f"<ImagePair: {w1} x {h1} and {w2} x {h2} pixels>"

    def error(self, F: ArrayLike | None) -> float:
        """Mean distance of the true correspondences to the epipolar lines of ``F``.

        Parameters
        ----------
        F : (3, 3) array, or None
            An estimate of the fundamental matrix.

        Returns
        -------
        float
            Pixels, over both images; infinite for None.
        """
        if F is None:
            return float("inf")
        F = np.asarray(F, dtype=np.float64)
        one = np.ones((len(self.points1), 1))
        x1, x2 = np.hstack([self.points1, one]), np.hstack([self.points2, one])
        line1, line2 = x2 @ F, x1 @ F.T
        algebraic = np.abs((x2 * line2).sum(axis=1))
        distances = [algebraic / np.hypot(line[:, 0], line[:, 1]) for line in (line1, line2)]
        return float(np.mean(distances))


def two_view_scene(
    n: int = 500,
    *,
    inlier_ratio: float = 0.4,
    noise: float = 0.5,
    random_state: int | np.random.Generator | None = 0,
) -> Scene:
    """Draw matches of a scene of several objects before a wall, and wrong matches among them.

    Four fifths of the true matches sit in tight groups on ten small curved patches, the rest is
    spread over the wall behind: texture is never spread evenly over an image. Wrong matches pair
    two places drawn uniformly.

    Parameters
    ----------
    n : int
        Number of matches.
    inlier_ratio : float
        Share of true matches, in [0, 1].
    noise : float
        Standard deviation of the Gaussian noise on each coordinate of the true matches, pixels.
    random_state : int, numpy.random.Generator or None
        Seed; None draws a fresh scene each time.

    Returns
    -------
    Scene
        Its rows are shuffled.

    Raises
    ------
    ValueError
        If ``n`` is negative, ``inlier_ratio`` is not in [0, 1], or ``noise`` is negative or not
        finite.

    Examples
    --------
    >>> from cv_densityf.datasets import two_view_scene
    >>> scene = two_view_scene(200, inlier_ratio=0.3, noise=0)
    >>> scene.X.shape, int(scene.inliers.sum())
    ((200, 4), 60)
    >>> from cv_densityf import estimate_fundamental
    >>> estimate = estimate_fundamental(scene.points1, scene.points2)
    >>> bool(estimate.mask[scene.inliers].all())
    True
    """
    check("n", n, Integral, lambda v: v >= 0, "an integer of 0 and more")
    check("inlier_ratio", inlier_ratio, Real, lambda v: 0 <= v <= 1, "a number from 0 to 1")
    check("noise", noise, Real, lambda v: 0 <= v < np.inf, "finite, of 0 and more, in pixels")
    rng = np.random.default_rng(random_state)
    size = np.array(_SIZE, dtype=np.float64)
    K = np.array([[_FOCAL, 0, size[0] / 2], [0, _FOCAL, size[1] / 2], [0, 0, 1]])
    R, t = _motion(rng)

    X = rng.uniform(0, np.tile(size, 2), (n, 4))
    inliers = np.zeros(n, dtype=bool)
    n_true = round(n * inlier_ratio)
    inliers[:n_true] = True
    X[inliers] = _true_matches(n_true, K, R, t, rng)
    X[inliers] += rng.normal(0, noise, (n_true, 4))

    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    K_inverse = np.linalg.inv(K)
    F = K_inverse.T @ cross @ R @ K_inverse
    order = rng.permutation(n)
    return Scene(
        X[order, :2], X[order, 2:], inliers[order], F / np.linalg.norm(F), (_SIZE[0], _SIZE[1])
    )


def _motion(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation of up to some 10 degrees, and a mostly sideways step of a tenth of the depth."""
    R = np.asarray(cv2.Rodrigues(rng.uniform(-0.1, 0.1, 3))[0], dtype=np.float64)
    direction = np.array([rng.choice([-1.0, 1.0]), rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5)])
    return R, 0.8 * direction / np.linalg.norm(direction)


def _true_matches(
    n: int,
    K: NDArray[np.float64],
    R: NDArray[np.float64],
    t: NDArray[np.float64],
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Project points of the scene that both cameras see, (n, 4)."""
    size = np.array(_SIZE)
    centers = rng.uniform(0.1 * size, 0.9 * size, (10, 2))
    depths = rng.uniform(4, 10, 10)
    slopes = rng.uniform(-0.01, 0.01, (10, 2))
    spreads = rng.uniform(20, 60, 10)
    found = np.empty((0, 4))
    while len(found) < n:
        # More than are missing: some fall outside an image.
        count = 2 * (n - len(found)) + 16
        group = rng.integers(0, 10, count)
        offset = rng.normal(0, 1, (count, 2)) * spreads[group, None]
        points1 = centers[group] + offset
        depth = depths[group] + np.einsum("ij,ij->i", offset, slopes[group])
        wall = rng.random(count) < 0.2
        points1[wall] = rng.uniform(0, size, (int(wall.sum()), 2))
        depth[wall] = 12 + 0.002 * (points1[wall, 0] - size[0] / 2)
        rays = np.hstack([points1, np.ones((count, 1))]) @ np.linalg.inv(K).T
        projected = (rays * depth[:, None] @ R.T + t) @ K.T
        points2 = projected[:, :2] / projected[:, 2:]
        matches = np.hstack([points1, points2])
        seen = (matches >= 0).all(axis=1) & (matches <= np.tile(size, 2)).all(axis=1)
        seen &= (depth > 1) & (projected[:, 2] > 1)
        found = np.vstack([found, matches[seen]])
    return found[:n]


def motorcycle() -> ImagePair:
    """Load the Middlebury stereo pair "motorcycle", with the second image turned.

    The pair is rectified; the second image is turned here by a known homography, so that epipolar
    lines are no longer rows and the fundamental matrix is still known (to a tenth of a pixel, the
    accuracy of Middlebury's own rectification). The images and their disparity are those
    in the wheel of scikit-image; nothing is downloaded.

    Returns
    -------
    ImagePair
        741 x 500 pixels each; the true correspondences come from the measured disparity.

    Raises
    ------
    ImportError
        If scikit-image is not installed.
    FileNotFoundError
        If its installation lacks the images.

    References
    ----------
    Scharstein et al., High-resolution stereo datasets with subpixel-accurate ground truth,
    GCPR 2014. https://vision.middlebury.edu/stereo/data/scenes2014/

    Examples
    --------
    >>> from cv_densityf.datasets import motorcycle
    >>> pair = motorcycle()
    >>> pair.image1.shape, pair.F.shape
    ((500, 741, 3), (3, 3))
    """
    folder = _skimage_data()
    left, right = (_load(folder / f"motorcycle_{side}.png") for side in ("left", "right"))
    with np.load(folder / "motorcycle_disp.npz", allow_pickle=False) as archive:
        disparity = archive["arr_0"].astype(np.float64)
    height, width = disparity.shape

    H = _turn(width, height)
    image2 = cv2.warpPerspective(right, H, (width, height), flags=cv2.INTER_CUBIC)
    H_inverse = np.linalg.inv(H)
    rectified = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    F = H_inverse.T @ rectified

    y, x = (axis.ravel()[::7] for axis in np.mgrid[0:height, 0:width])
    shift = disparity[y, x]
    known = np.isfinite(shift)
    x, y, shift = x[known], y[known], shift[known]
    points2 = np.stack([x - shift, y, np.ones(len(x))], axis=1) @ H.T
    points2 = points2[:, :2] / points2[:, 2:]
    inside = ((points2 >= 0) & (points2 <= (width - 1, height - 1))).all(axis=1)
    return ImagePair(
        left,
        np.asarray(image2, dtype=np.uint8),
        F / np.linalg.norm(F),
        np.stack([x, y], axis=1).astype(np.float64)[inside],
        points2[inside],
    )


def _turn(width: int, height: int) -> NDArray[np.float64]:
    """Homography of a view turned by 12 degrees and tilted, about the centre of the image."""
    c, s = 0.9 * np.cos(np.deg2rad(12)), 0.9 * np.sin(np.deg2rad(12))
    center = np.array([[1, 0, width / 2], [0, 1, height / 2], [0, 0, 1]])
    turn = np.array([[c, -s, 0], [s, c, 0], [1.5e-4, -1e-4, 1]])
    return np.asarray(center @ turn @ np.linalg.inv(center))


def _skimage_data() -> Path:
    spec = find_spec("skimage")
    if spec is None or not spec.submodule_search_locations:
        raise ImportError(
            "the motorcycle pair comes with scikit-image: "
            "python -m pip install scikit-image (or the extra cv-densityf[demo])"
        )
    return Path(spec.submodule_search_locations[0]) / "data"


def _load(path: Path) -> NDArray[np.uint8]:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None
    if image is None:
        raise FileNotFoundError(
            f"{path} is missing or damaged; reinstall scikit-image: "
            "python -m pip install --force-reinstall scikit-image"
        )
    return np.asarray(image, dtype=np.uint8)
