"""Image pairs rendered by VTK, with F from the cameras and truth points from the depth buffer.

Needs pyvista (the extra ``bench``), which renders without a display.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.data import Cameras, Pair
from cv_densityf.matching import match_images

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
Point = tuple[float, float, float]

SIZE = (640, 480)
VIEW_ANGLE = 50.0
#: Rendered this much larger and averaged: smooth edges, and one depth for each small pixel.
OVERSAMPLING = 2
#: Standard deviation of the sensor's noise, grey levels.
SENSOR_NOISE = 5.0
#: Truth points lie this many pixels of the first image apart.
TRUTH_STEP = 8
#: A point is seen in the second image if the depth there is its own up to this share.
SAME_DEPTH = 0.01


@dataclass(frozen=True, eq=False)
class View:
    """A picture and the camera that took it, x ~ K (R X + t)."""

    image: Image
    depth: Floats
    R: Floats
    t: Floats


def intrinsics() -> Floats:
    """Camera matrix of every view; pixel centres are whole numbers."""
    focal = SIZE[1] / 2 / np.tan(np.deg2rad(VIEW_ANGLE) / 2)
    return np.array([[focal, 0, SIZE[0] / 2 - 0.5], [0, focal, SIZE[1] / 2 - 0.5], [0, 0, 1]])


def render_pair(name: str) -> tuple[Pair, Image, Image]:
    """Render a scene of `SCENES` twice, match the pictures, and keep the truth.

    Returns
    -------
    Pair
        SIFT matches; truth points on a grid of the first image, from its depth buffer, where the
        second one's depth buffer agrees that it sees them.
    image1, image2 : (480, 640, 3) uint8
        Blue, green, red.

    Raises
    ------
    ValueError
        If pyvista is not installed.
    """
    view1, view2 = render(name)
    return pair_of(name, view1, view2), view1.image, view2.image


def pair_of(name: str, view1: View, view2: View, X: Floats | None = None) -> Pair:
    """Match two views, unless the matches X (n, 4) are given, and keep the truth."""
    K = intrinsics()
    R = view2.R @ view1.R.T
    t = view2.t - R @ view1.t
    E = np.cross(np.eye(3), t).T @ R
    F = np.linalg.inv(K).T @ E @ np.linalg.inv(K)
    scores = None
    if X is None:
        matches = match_images(view1.image, view2.image)
        X, scores = matches.X, matches.scores
    return Pair(
        name=name,
        group="rendered",
        X=X,
        scores=scores,
        truth=seen_by_both(view1, view2),
        size1=SIZE,
        size2=SIZE,
        cameras=Cameras(K, K, R, t),
        F_gt=F / np.linalg.norm(F),
    )


def seen_by_both(view1: View, view2: View) -> Floats:
    """Project grid points of the first view into the second by their depth; (m, 4)."""
    K = intrinsics()
    height, width = view1.depth.shape
    step = TRUTH_STEP * OVERSAMPLING
    y, x = (axis.ravel() for axis in np.mgrid[step // 2 : height : step, step // 2 : width : step])
    depth = view1.depth[y, x]
    pixel = np.stack([x, y], axis=1).astype(np.float64)
    points1 = (pixel + 0.5) / OVERSAMPLING - 0.5
    rays = np.hstack([points1, np.ones((len(x), 1))]) @ np.linalg.inv(K).T
    space = (rays * depth[:, None] - view1.t) @ view1.R
    seen = space @ view2.R.T + view2.t
    with np.errstate(invalid="ignore"):
        points2 = (seen @ K.T)[:, :2] / seen[:, 2:]
        places = np.rint((points2 + 0.5) * OVERSAMPLING - 0.5)
        inside = ((places >= 0) & (places < (width, height))).all(axis=1) & (seen[:, 2] > 0)
    column, row = np.where(inside[:, None], places, 0).astype(int).T
    own = np.abs(view2.depth[row, column] - seen[:, 2]) < SAME_DEPTH * seen[:, 2]
    kept = inside & own
    return np.hstack([points1[kept], points2[kept]])


def render(name: str) -> tuple[View, View]:
    """Render both views of a scene; see `render_pair`."""
    scene = SCENES[name]
    rng = np.random.default_rng(list(SCENES).index(name))
    view1, view2 = photograph(scene.build, [(place, scene.target) for place in scene.places], rng)
    return view1, view2


def photograph(
    build: Callable[[_Stage], None],
    cameras: Sequence[tuple[Point, Point]],
    rng: np.random.Generator,
) -> list[View]:
    """Build a scene and take a picture from each place towards its target.

    Raises
    ------
    ValueError
        If pyvista is not installed.
    """
    try:
        import pyvista
    except ImportError as error:
        raise ValueError(
            "the rendered pairs need pyvista: python -m pip install pyvista "
            "(or the extra bench), or run with --quick"
        ) from error
    window = [SIZE[0] * OVERSAMPLING, SIZE[1] * OVERSAMPLING]
    plotter: Any = pyvista.Plotter(off_screen=True, window_size=window, lighting="none")
    plotter.set_background("lightsteelblue")
    plotter.add_light(pyvista.Light(position=(-6, -9, 14), focal_point=(0, 0, 0), intensity=0.8))
    plotter.add_light(pyvista.Light(position=(9, -5, 6), focal_point=(0, 0, 0), intensity=0.35))
    build(_Stage(plotter, pyvista, rng))
    views = [_look(plotter, place, target, rng) for place, target in cameras]
    plotter.close()
    return views


def _look(plotter: Any, place: Point, target: Point, rng: np.random.Generator) -> View:
    camera = plotter.camera
    camera.position, camera.focal_point, camera.up = place, target, (0, 0, 1)
    camera.view_angle = VIEW_ANGLE
    plotter.reset_camera_clipping_range()
    plotter.render()
    large = plotter.screenshot(return_img=True)[:, :, ::-1]
    depth = -np.asarray(plotter.get_image_depth(), dtype=np.float64)
    image = cv2.resize(large, SIZE, interpolation=cv2.INTER_AREA).astype(np.float64)
    image += rng.normal(0, SENSOR_NOISE, image.shape)
    R = camera_axes(place, target)
    return View(np.clip(np.rint(image), 0, 255).astype(np.uint8), depth, R, -R @ place)


def camera_axes(place: Any, target: Any) -> Floats:
    """Directions right, down and ahead of an upright camera that looks at a point, (3, 3)."""
    ahead = np.subtract(target, place)
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(ahead, right), ahead])


class _Stage:
    """Puts textured things into a scene. The ground is z = 0, the cameras look along +y."""

    def __init__(self, plotter: Any, pyvista: Any, rng: np.random.Generator) -> None:
        self._plotter, self._pv, self.rng = plotter, pyvista, rng

    def add(self, mesh: Any, texture: Image, turn: float = 0.0, at: Any = (0, 0, 0)) -> None:
        mesh = mesh.rotate_z(turn).translate(at)
        self._plotter.add_mesh(
            mesh,
            texture=self._pv.numpy_to_texture(texture),
            smooth_shading=False,
            ambient=0.45,
            diffuse=0.6,
            specular=0.1,
        )

    def ground(self, size: float, texture: Image, y: float = 0.0) -> None:
        self.add(self._pv.Plane(i_size=size, j_size=size), texture, at=(0, y, 0))

    def wall(self, y: float, width: float, height: float, texture: Image) -> None:
        plane = self._pv.Plane(direction=(0, -1, 0), i_size=height, j_size=width)
        self.add(plane, np.rot90(texture).copy(), at=(0, y, height / 2))

    def side(self, x: float, length: float, height: float, texture: Image, y: float) -> None:
        plane = self._pv.Plane(direction=(-np.sign(x), 0, 0), i_size=height, j_size=length)
        self.add(plane, np.rot90(texture).copy(), at=(x, y, height / 2))

    def box(self, x: float, y: float, size: Any, turn: float = 0.0, z: float = 0.0) -> None:
        cube = self._pv.Cube(x_length=size[0], y_length=size[1], z_length=size[2], clean=False)
        # Once around each face, however large: four points a face.
        faces = cube.active_texture_coordinates.reshape(6, 4, 2)
        faces = (faces - faces.min(axis=1, keepdims=True)) / np.ptp(faces, axis=1, keepdims=True)
        cube.active_texture_coordinates = faces.reshape(24, 2)
        self.add(cube, printed(self.rng, 512), turn, (x, y, z + size[2] / 2))

    def ball(self, x: float, y: float, radius: float) -> None:
        sphere = self._pv.Sphere(radius=radius, theta_resolution=90, phi_resolution=90)
        sphere = sphere.texture_map_to_sphere(prevent_seam=True)
        self.add(sphere, printed(self.rng, 768), 180 * self.rng.random(), (x, y, radius))

    def column(self, x: float, y: float, radius: float, height: float, texture: Image) -> None:
        column = self._pv.CylinderStructured(
            radius=radius, height=height, direction=(0, 0, 1), theta_resolution=120, z_resolution=2
        ).extract_surface(algorithm="dataset_surface")
        angle = np.arctan2(column.points[:, 1], column.points[:, 0]) / (2 * np.pi) + 0.5
        share = column.points[:, 2] / height + 0.5
        column.active_texture_coordinates = np.stack([angle, share], axis=1).astype(np.float32)
        self.add(column, texture, 180 * self.rng.random(), (x, y, height / 2))

    def hills(self, size: float, height: float, texture: Image, y: float) -> None:
        plane = self._pv.Plane(i_size=size, j_size=size, i_resolution=200, j_resolution=200)
        bumps = cv2.resize(self.rng.normal(size=(9, 9)), (201, 201), interpolation=cv2.INTER_CUBIC)
        plane.points[:, 2] = height * bumps.ravel()
        self.add(plane, texture, at=(0, y, 0))


def rough(rng: np.random.Generator, size: int) -> Image:
    """Make a texture of coloured noise with detail at every scale."""
    image = np.zeros((size, size, 3))
    octave = 4
    while octave <= size // 2:
        noise = rng.normal(size=(octave, octave, 3)) * 0.3 + rng.normal(size=(octave, octave, 1))
        image += cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC) / octave**0.1
        octave *= 2
    image = (image - image.mean()) / image.std()
    return np.asarray(np.clip(np.rint(128 + 45 * image), 0, 255), dtype=np.uint8)


def printed(rng: np.random.Generator, size: int) -> Image:
    """Make a texture of shapes and letters over noise."""
    image = rough(rng, size) // 2 + rng.integers(30, 100, 3).astype(np.uint8)
    for _ in range(size // 4):
        x, y = (int(v) for v in rng.integers(0, size, 2))
        extent = int(size * rng.uniform(0.005, 0.05))
        color = [int(v) for v in rng.integers(0, 256, 3)]
        kind = rng.integers(3)
        if kind == 0:
            cv2.circle(image, (x, y), extent, color, -1, cv2.LINE_AA)
        elif kind == 1:
            corner = (x + extent, y + int(extent * rng.uniform(0.3, 2)))
            cv2.rectangle(image, (x, y), corner, color, -1)
        else:
            letters = "".join(chr(65 + int(c)) for c in rng.integers(0, 26, 3))
            cv2.putText(image, letters, (x, y), 2, size / 800, color, 2, cv2.LINE_AA)
    return np.asarray(image, dtype=np.uint8)


def bricks(rng: np.random.Generator, size: int) -> Image:
    """Make a texture that repeats, but for a little dirt."""
    image = np.full((size, size, 3), (150, 160, 165), dtype=np.float64)
    width, height = size // 12, size // 30
    for row in range(31):
        for column in range(-1, 13):
            x, y = column * width + (row % 2) * width // 2, row * height
            tone = np.array([60, 75, 140]) + rng.normal(0, 9)
            image[y + 3 : y + height, max(x + 3, 0) : max(x + width, 0)] = tone
    image += 0.25 * (rough(rng, size).astype(np.float64) - 128)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def windows(rng: np.random.Generator, size: int) -> Image:
    """Make a front of equal windows in rows and columns, with hardly any dirt."""
    wall = np.array([120, 140, 170], dtype=np.float64)
    step = size // 10
    tile = np.full((step, step, 3), wall)
    frame, glass = (200, 200, 210), (60, 50, 40)
    tile[step // 5 - 6 : 4 * step // 5 + 8, step // 4 - 6 : 3 * step // 4 + 6] = frame
    tile[step // 5 : 4 * step // 5, step // 4 : 3 * step // 4] = glass
    tile[step // 5 : 4 * step // 5, step // 2 - 2 : step // 2 + 2] = frame
    tile[step // 2 - 2 : step // 2 + 2, step // 4 : 3 * step // 4] = frame
    image = np.full((size, size, 3), wall)
    image[: 10 * step, : 10 * step] = np.tile(tile, (10, 10, 1))
    image += 0.12 * (rough(rng, size).astype(np.float64) - 128)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def facade(stage: _Stage) -> None:
    """Build a front of equal windows, with two boxes and a ball before it."""
    stage.ground(24, rough(stage.rng, 1536), 3)
    stage.wall(6, 20, 12, windows(stage.rng, 2048))
    stage.box(-5, 4.5, (2.5, 2, 5))
    stage.box(4, 5.6, (2, 0.8, 3))
    stage.ball(0, 2, 0.6)


def _table(stage: _Stage) -> None:
    stage.ground(14, printed(stage.rng, 1536))
    stage.wall(6, 16, 8, rough(stage.rng, 1024))
    for x, y, edge in ((-2.6, 1.5, 1.3), (2.4, 2.4, 1.6), (-0.6, 3.4, 1.9), (1.2, -1.2, 0.7)):
        stage.box(x, y, (edge, edge, edge * stage.rng.uniform(0.7, 1.5)), 90 * stage.rng.random())
    for x, y, radius in ((0.2, 0.6, 0.6), (-1.9, -0.9, 0.45), (3.0, 0.1, 0.5)):
        stage.ball(x, y, radius)


def _city(stage: _Stage) -> None:
    stage.ground(24, rough(stage.rng, 1536), 3)
    for x in range(-6, 7, 2):
        for y in range(-2, 11, 2):
            if stage.rng.random() < 0.75:
                height = stage.rng.uniform(0.5, 2.6)
                stage.box(x, y, (1.2, 1.2, height), 12 * stage.rng.standard_normal())


def _corridor(stage: _Stage) -> None:
    stage.ground(24, rough(stage.rng, 1536), 6)
    for x in (-3.0, 3.0):
        stage.side(x, 20, 5, printed(stage.rng, 1536), 4)
    stage.wall(14, 6, 5, printed(stage.rng, 768))
    for y in (-1.5, 3, 7.5):
        for x in (-1.9, 1.9):
            stage.box(x, y, (0.6, 0.6, stage.rng.uniform(1.5, 4.5)))


def _hills(stage: _Stage) -> None:
    stage.hills(22, 0.8, rough(stage.rng, 2048), 4)
    for _ in range(9):
        x, y = stage.rng.uniform(-5, 5), stage.rng.uniform(-1, 9)
        stage.ball(x, y, stage.rng.uniform(0.6, 1.3))


def _columns(stage: _Stage) -> None:
    stage.ground(18, bricks(stage.rng, 2048), 2)
    stage.wall(6, 18, 8, bricks(stage.rng, 2048))
    for x, y in ((-3.5, 3), (-1.6, 0.5), (0.4, 3.5), (2.0, 1.0), (4.0, 3.2)):
        stage.column(x, y, 0.5, 5, printed(stage.rng, 768))


def _gallery(stage: _Stage) -> None:
    stage.wall(5, 18, 10, rough(stage.rng, 2048))
    for x in (-4.2, 0.0, 4.2):
        stage.box(x, 4.9, (3.2, 0.1, 4.0), z=1.0)
    for x, y in ((-2.1, 1.8), (2.6, 1.2)):
        stage.box(x, y, (0.7, 0.7, 1.6), 30)


@dataclass(frozen=True)
class Scene:
    """What stands there, where the camera stands twice, and what it looks at."""

    build: Callable[[_Stage], None]
    places: tuple[Point, Point]
    target: Point


SCENES: dict[str, Scene] = {
    "table": Scene(_table, ((-1.6, -6.5, 3.6), (1.4, -6.9, 3.1)), (0, 1, 0.8)),
    "city": Scene(_city, ((-2.0, -7.5, 6.0), (1.2, -8.0, 6.6)), (0, 2, 0.5)),
    "corridor": Scene(_corridor, ((-0.6, -7.0, 2.2), (0.5, -5.4, 2.6)), (0, 6, 2.0)),
    "hills": Scene(_hills, ((-1.9, -7.0, 4.6), (1.3, -7.4, 4.2)), (0, 2, 0.3)),
    "columns": Scene(_columns, ((-1.2, -6.5, 2.8), (1.2, -6.3, 2.4)), (0.2, 3, 2.2)),
    "gallery": Scene(_gallery, ((-1.6, -6.5, 2.6), (1.6, -6.2, 3.0)), (0, 4, 2.8)),
}
