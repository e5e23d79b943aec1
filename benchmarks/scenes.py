"""Made-up scenes with a known fundamental matrix, each hard in its own way.

Surfaces are planes (inverse depth linear in the image): small patches at many depths, and a wall
behind them. Matches of a surface crowd where its texture is; wrong matches pair two places at
random, unless the kind of scene says otherwise.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.data import Cameras, Pair

Floats = NDArray[np.float64]

SIZE = (1280, 960)
FOCAL = 1000.0
N_PATCHES = 10
N_TRUTH = 200
#: Texture that repeats does so after this many pixels.
PERIOD = 60.0
#: What moves on its own: so many patches, by pixels of this standard deviation across and down.
N_MOVING = 3
STRIDE = (40.0, 12.0)


@dataclass(frozen=True)
class Kind:
    """What a kind of scene is made of.

    Attributes
    ----------
    wall : float
        Share of the true matches on the wall.
    truth_wall : float
        Share of the truth points on the wall: what leaves the wall must fit as well.
    motion : {"sideways", "forward", "video", "none"}
        Of the second camera; "video" is a short step, "none" only turns it.
    coherent : float
        Share of the wrong matches that pair the wall with itself one period further down. An F
        with its epipole in that direction explains them together with the true ones on the wall;
        few enough are on it that the truth still has the majority.
    moving : float
        Share of the wrong matches that are on patches which move on their own.
    still : float
        Share of the wrong matches that stay where they are in the image, all over it.
    patches : int
        Number of patches that the true matches are on.
    unique : bool
        Whether the matches fix F. If not, any F that explains them is right.
    """

    wall: float = 0.2
    truth_wall: float = 0.2
    motion: str = "sideways"
    coherent: float = 0.0
    moving: float = 0.0
    still: float = 0.0
    patches: int = N_PATCHES
    unique: bool = True


KINDS: dict[str, Kind] = {
    "clusters": Kind(),
    "dominant_plane": Kind(wall=0.9, truth_wall=0.5),
    "repeated_texture": Kind(wall=0.3, coherent=0.25),
    "forward": Kind(motion="forward"),
    "one_plane": Kind(wall=1.0, truth_wall=1.0, unique=False),
    "rotation": Kind(motion="none", unique=False),
    "moving_objects": Kind(wall=0.7, motion="video", moving=0.9),
    "turntable": Kind(wall=0.0, truth_wall=0.0, still=0.9, patches=4),
}

#: Numbers of matches, inlier ratios and noise (px) of each kind, unless asked otherwise.
FULL_GRID = ((200, 500, 2000, 8000), (0.1, 0.15, 0.2, 0.3, 0.5, 0.8), (0.5, 1.0))
SMALL_GRID = ((500, 2000), (0.3, 0.6, 0.9), (0.5, 1.0))


def scenes(
    kinds: Sequence[str],
    repeats: int,
    seed: int = 0,
    *,
    numbers: Sequence[int] | None = None,
    ratios: Sequence[float] | None = None,
    noises: Sequence[float] | None = None,
) -> Iterator[tuple[str, Pair]]:
    """Yield the kind and the scene for each cell of the grid, ``repeats`` times."""
    for kind in kinds:
        default = FULL_GRID if kind == "clusters" else SMALL_GRID
        cells = product(numbers or default[0], ratios or default[1], noises or default[2])
        for n, ratio, noise in cells:
            for i in range(repeats):
                yield kind, make_scene(kind, n, ratio, noise, seed + i)


def make_scene(kind: str, n: int, inlier_ratio: float, noise: float, seed: int = 0) -> Pair:
    """Draw a scene.

    Parameters
    ----------
    kind : str
        A key of `KINDS`.
    n : int
        Number of matches.
    inlier_ratio : float
        Share of true matches, in [0, 1].
    noise : float
        Standard deviation per coordinate of the true matches, pixels.
    seed : int

    Returns
    -------
    Pair
        Rows shuffled; the truth points are other points of the scene, without noise. ``F_gt`` and
        ``cameras`` are None where the matches do not fix F.

    Raises
    ------
    ValueError
        If there is no such kind.
    """
    if kind not in KINDS:
        raise ValueError(f"no scene {kind!r}; choose from {', '.join(KINDS)}")
    spec = KINDS[kind]
    rng = np.random.default_rng([list(KINDS).index(kind), seed])
    K = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]])
    R, t = _motion(spec.motion, rng)
    world = _World(K, R, t, rng)

    n_true = round(n * inlier_ratio)
    n_coherent = round((n - n_true) * spec.coherent)
    n_moving = round((n - n_true) * spec.moving)
    n_still = round((n - n_true) * spec.still)
    patches = (0, spec.patches)
    true = world.matches(n_true, spec.wall, rng, patches=patches)
    n_random = n - n_true - n_coherent - n_moving - n_still
    wrong = rng.uniform(0, np.tile(SIZE, 2), (n_random, 4))
    coherent = world.matches(n_coherent, 1.0, rng, period=PERIOD)
    moving = world.moving_matches(n_moving, rng)
    still = np.tile(rng.uniform(0, SIZE, (n_still, 2)), 2)
    noisy = [x + rng.normal(0, noise, x.shape) for x in (true, coherent, moving, still)]
    X = np.vstack([*noisy, wrong])
    # SIFT ratios: true matches are lower, with a wide overlap.
    ratio = np.concatenate([rng.beta(5, 3, n_true), rng.beta(12, 2, n - n_true)])
    order = rng.permutation(n)
    return Pair(
        name=f"{kind}/{n}/{inlier_ratio:g}/{noise:g}/{seed}",
        group=f"n={n}, ratio={inlier_ratio:g}, noise={noise:g}",
        X=np.ascontiguousarray(X[order]),
        scores=1.0 - ratio[order],
        truth=world.matches(N_TRUTH, spec.truth_wall, rng, patches=patches),
        size1=SIZE,
        size2=SIZE,
        cameras=Cameras(K, K, R, t) if spec.unique else None,
        F_gt=_fundamental(K, R, t) if spec.unique else None,
    )


def _motion(motion: str, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Rotation of up to some 10 degrees, and a step."""
    largest = 0.02 if motion in ("forward", "video") else 0.1
    angles = rng.uniform(-largest, largest, 3)
    R = np.asarray(cv2.Rodrigues(angles)[0], dtype=np.float64)
    if motion == "none":
        return R, np.zeros(3)
    if motion == "forward":
        return R, np.array([*rng.uniform(-0.1, 0.1, 2), -1.0])
    t = np.array([rng.choice([-1.0, 1.0]), *rng.uniform(-0.5, 0.5, 2)])
    return R, (0.08 if motion == "video" else 0.8) * t / np.linalg.norm(t)


def _fundamental(K: Floats, R: Floats, t: Floats) -> Floats:
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    K_inverse = np.linalg.inv(K)
    F = K_inverse.T @ cross @ R @ K_inverse
    return np.asarray(F / np.linalg.norm(F))


class _World:
    """Two cameras, the patches and the wall; inverse depths are as the first camera sees them."""

    def __init__(self, K: Floats, R: Floats, t: Floats, rng: np.random.Generator) -> None:
        self.K, self.R, self.t = K, R, t
        size = np.array(SIZE)
        self.centers = rng.uniform(0.1 * size, 0.9 * size, (N_PATCHES, 2))
        self.spreads = rng.uniform(20, 60, N_PATCHES)
        self.inverse_depths = 1 / rng.uniform(4, 10, N_PATCHES)
        self.slopes = rng.uniform(-2e-4, 2e-4, (N_PATCHES, 2))
        self.wall_slope = rng.uniform(-3e-5, 3e-5, 2)

    def matches(
        self,
        n: int,
        wall: float,
        rng: np.random.Generator,
        period: float = 0.0,
        patches: tuple[int, int] = (0, N_PATCHES),
    ) -> Floats:
        """Project points that both cameras see, ``wall`` of them on the wall, (n, 4).

        The others are on the patches from the first up to the second number. With a ``period`` the
        second camera's point is the one that many pixels further down.
        """
        found = np.empty((0, 4))
        while len(found) < n:
            # More than are missing: some fall outside an image.
            count = 2 * (n - len(found)) + 16
            points1, inverse_depth, slope = self._surface_points(count, wall, rng, patches)
            step = np.array([0.0, period])
            points2, depth2 = self._project(points1 + step, inverse_depth + slope @ step)
            X = np.hstack([points1, points2])
            seen = (inverse_depth > 0) & (depth2 > 0)
            seen &= (np.clip(X, 0, [*SIZE, *SIZE]) == X).all(axis=1)
            found = np.vstack([found, X[seen]])
        return found[:n]

    def moving_matches(self, n: int, rng: np.random.Generator) -> Floats:
        """Return matches of patches that are elsewhere in the second image, (n, 4)."""
        if not n:
            return np.empty((0, 4))
        parts = [n // N_MOVING + (i < n % N_MOVING) for i in range(N_MOVING)]
        found = [self.matches(size, 0.0, rng, patches=(i, i + 1)) for i, size in enumerate(parts)]
        for X in found:
            X[:, 2:] += rng.normal(0, STRIDE)
        return np.vstack(found)

    def _surface_points(
        self, count: int, wall: float, rng: np.random.Generator, patches: tuple[int, int]
    ) -> tuple[Floats, Floats, Floats]:
        """Image points, their inverse depths and their surfaces' slopes."""
        patch = rng.integers(*patches, count)
        offset = rng.normal(0, 1, (count, 2)) * self.spreads[patch, None]
        points = self.centers[patch] + offset
        slope = self.slopes[patch]
        inverse_depth = self.inverse_depths[patch] + (offset * slope).sum(axis=1)
        on_wall = rng.random(count) < wall
        points[on_wall] = rng.uniform(0, SIZE, (np.count_nonzero(on_wall), 2))
        slope[on_wall] = self.wall_slope
        inverse_depth[on_wall] = 1 / 12 + (points[on_wall] - np.array(SIZE) / 2) @ self.wall_slope
        return points, inverse_depth, slope

    def _project(self, points1: Floats, inverse_depth: Floats) -> tuple[Floats, Floats]:
        """Project what the first camera sees into the second, with its depth there."""
        rays = np.hstack([points1, np.ones((len(points1), 1))]) @ np.linalg.inv(self.K).T
        projected = ((rays / inverse_depth[:, None]) @ self.R.T + self.t) @ self.K.T
        return projected[:, :2] / projected[:, 2:], projected[:, 2]
