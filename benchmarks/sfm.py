"""Structure from motion on our verification of the matches, and on COLMAP's own.

``python -m benchmarks.sfm`` renders scenes from a dozen places, lets pycolmap find and match
features, verifies the same matches twice, and lets COLMAP's mapper build a model on each.
"""

from __future__ import annotations

import argparse
import contextlib
import shutil
import sqlite3
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.rendered import SCENES, SIZE, View, intrinsics, photograph
from benchmarks.report import fill, table
from cv_densityf.colmap import image_ids, verify_matches

Floats = NDArray[np.float64]

N_VIEWS = 12
#: Views spread over this angle around the scene, degrees.
ARC = 100.0
#: The corridor's walls would stand between the arc and the scene.
ARC_SCENES = tuple(name for name in SCENES if name != "corridor")
#: SIFT ratio below which COLMAP keeps a match: its default, and no ratio test.
RATIOS = {"ratio 0.8": 0.8, "no ratio test": 1.0}


@dataclass(frozen=True)
class Model:
    """What the mapper made of one verification.

    Attributes
    ----------
    pairs, inliers : int
        Verified image pairs, and their inlier matches.
    registered, points : int
        Of the largest model.
    position : float
        Median error of the camera centres after alignment by a similarity, per cent of their mean
        distance from their centroid. Views that are not registered count as infinitely wrong.
    rotation : float
        Median error of the orientations, degrees, likewise.
    seconds : float
        Verification, by the clock.
    """

    pairs: int
    inliers: int
    registered: int
    points: int
    position: float
    rotation: float
    seconds: float


@dataclass(frozen=True)
class Mixture:
    """Verified pairs of views of one scene, and of two, and the time by the clock, seconds."""

    right: int
    wrong: int
    seconds: float


def compare(name: str, ratio: float, folder: Path, seed: int = 0) -> dict[str, Model]:
    """Map one rendered scene on both verifications of the same matches."""
    views = render_views(name)
    matched = match_views(views, folder, ratio)
    # Starts the worker processes, which a long run does not notice.
    verify_matches(matched, n_jobs=-1, dry_run=True)
    return {
        verifier: map_images(database, folder / "images", folder / verifier, views, seconds, seed)
        for verifier, database, seconds in verified(matched, folder, seed)
    }


def mix(names: Sequence[str], ratio: float, folder: Path, seed: int = 0) -> dict[str, Mixture]:
    """Verify the matches between all views of several scenes, those of different ones all wrong."""
    views = [view for name in names for view in render_views(name)]
    matched = match_views(views, folder, ratio)
    found = {}
    for verifier, database, seconds in verified(matched, folder, seed):
        with contextlib.closing(sqlite3.connect(database)) as connection:
            name_of = dict(connection.execute("SELECT image_id, name FROM images"))
            pairs = connection.execute("SELECT pair_id FROM two_view_geometries WHERE rows > 0")
            scenes = [
                {int(name_of[i][:-4]) // N_VIEWS for i in image_ids(pair_id)}
                for (pair_id,) in pairs
            ]
        right = sum(len(scene) == 1 for scene in scenes)
        found[verifier] = Mixture(right, len(scenes) - right, seconds)
    return found


def verified(matched: Path, folder: Path, seed: int) -> Iterator[tuple[str, Path, float]]:
    """Verify copies of a database in every way; name, copy, and seconds by the clock."""
    for verifier, verify in verifiers(seed).items():
        database = folder / f"{verifier}.db"
        shutil.copy(matched, database)
        start = time.perf_counter()
        verify(database)
        yield verifier, database, time.perf_counter() - start


def verifiers(seed: int) -> dict[str, Callable[[Path], object]]:
    """Give the two ways to verify the matches of a database, each with its defaults."""
    import pycolmap

    geometry = pycolmap.TwoViewGeometryOptions()
    geometry.ransac.random_seed = seed
    return {
        "pycolmap": lambda path: pycolmap.geometric_verification(
            path, two_view_geometry_options=geometry
        ),
        "cv-densityf": lambda path: verify_matches(path, n_jobs=-1, random_state=seed),
    }


def match_views(views: Sequence[View], folder: Path, ratio: float) -> Path:
    """Write the images, let pycolmap find and match their features; return its database."""
    import pycolmap

    images = folder / "images"
    images.mkdir(parents=True)
    for i, view in enumerate(views):
        cv2.imwrite(str(images / f"{i:02d}.png"), view.image)
    matched = folder / "matched.db"
    K = intrinsics()
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "PINHOLE"
    # COLMAP counts from the corner of the first pixel, not from its centre.
    reader.camera_params = f"{K[0, 0]},{K[1, 1]},{K[0, 2] + 0.5},{K[1, 2] + 0.5}"
    pycolmap.extract_features(
        matched, images, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader
    )
    options = pycolmap.FeatureMatchingOptions()
    options.skip_geometric_verification = True
    options.sift.max_ratio = ratio
    if ratio >= 1:
        options.sift.max_distance = 2.0
    pycolmap.match_exhaustive(matched, options)
    return matched


def render_views(name: str) -> list[View]:
    """Render a scene from all its `places`."""
    scene = SCENES[name]
    rng = np.random.default_rng(list(SCENES).index(name))
    return photograph(scene.build, [(place, scene.target) for place in places(name)], rng)


def places(name: str) -> list[tuple[float, float, float]]:
    """Camera places on an arc about the scene's target, at two heights in turn."""
    scene = SCENES[name]
    target, (first, second) = np.array(scene.target), np.array(scene.places)
    radius = np.hypot(*(first - target)[:2])
    angles = np.deg2rad(np.linspace(-ARC / 2, ARC / 2, N_VIEWS))
    return [
        (
            float(target[0] + radius * np.sin(angle)),
            float(target[1] - radius * np.cos(angle)),
            float((first, second)[i % 2][2]),
        )
        for i, angle in enumerate(angles)
    ]


def map_images(
    database: Path, images: Path, output: Path, views: Sequence[View], seconds: float, seed: int
) -> Model:
    """Run COLMAP's incremental mapper, cameras known, and hold its poses against the true ones."""
    import pycolmap

    output.mkdir()
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = seed
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.multiple_models = False
    options.min_model_size = 3
    found = pycolmap.incremental_mapping(database, images, output, options)
    with contextlib.closing(sqlite3.connect(database)) as connection:
        pairs, inliers = connection.execute(
            "SELECT count(*), ifnull(sum(rows), 0) FROM two_view_geometries WHERE rows > 0"
        ).fetchone()
    if not found:
        return Model(pairs, inliers, 0, 0, np.inf, np.inf, seconds)
    model = max(found.values(), key=lambda m: m.num_reg_images())
    position, rotation = pose_errors(model, views)
    return Model(
        pairs, inliers, model.num_reg_images(), model.num_points3D(), position, rotation, seconds
    )


def pose_errors(model: Any, views: Sequence[View]) -> tuple[float, float]:
    """Median errors of centres, per cent of the cameras' spread, and orientations, degrees."""
    poses = {int(image.name[:2]): image.cam_from_world() for image in model.images.values()}
    rows = sorted(poses)
    if len(rows) < 3:
        return np.inf, np.inf
    true = np.array([-views[i].R.T @ views[i].t for i in rows])
    R = np.array([poses[i].rotation.matrix() for i in rows])
    own = np.array(
        [-r.T @ poses[i].translation for i, r in zip(rows, R, strict=True)], dtype=np.float64
    )
    scale, turn, shift = similarity(own, true)
    spread = np.linalg.norm(true - true.mean(axis=0), axis=1).mean()
    position = np.full(len(views), np.inf)
    rotation = np.full(len(views), np.inf)
    moved = scale * own @ turn.T + shift
    position[rows] = 100 * np.linalg.norm(moved - true, axis=1) / spread
    for i, r in zip(rows, R, strict=True):
        between = cv2.Rodrigues(r @ turn.T @ views[i].R.T)[0]
        rotation[i] = np.rad2deg(np.linalg.norm(between))
    return float(np.median(position)), float(np.median(rotation))


def similarity(source: Floats, target: Floats) -> tuple[float, Floats, Floats]:
    """Scale, rotation and shift that move ``source`` (n, 3) nearest to ``target`` (Umeyama)."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ D @ Vt
    scale = float(np.trace(np.diag(S) @ D) / np.square(a).sum())
    return scale, R, target.mean(axis=0) - scale * R @ source.mean(axis=0)


def main(argv: Sequence[str] | None = None) -> int:
    """Print tables of every scene, and of two together, with and without a ratio test."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.sfm", description=__doc__)
    parser.add_argument("--scenes", nargs="+", choices=ARC_SCENES, default=ARC_SCENES)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--page", metavar="FILE", help="bring the table of this page up to date")
    args = parser.parse_args(argv)
    header = (
        "scene", "matches", "verification", "pairs", "inlier matches", "registered", "points",
        "position, %", "rotation, deg", "time / COLMAP's",
    )  # fmt: skip
    body = []
    for name, (kind, ratio) in tqdm(list(product(args.scenes, RATIOS.items())), unit="scene"):
        with tempfile.TemporaryDirectory() as folder:
            models = compare(name, ratio, Path(folder) / "sfm", args.seed)
        own = models["pycolmap"].seconds
        for verifier, m in models.items():
            cells = (
                name, kind, verifier, m.pairs, m.inliers, m.registered, m.points,
                f"{m.position:.2f}", f"{m.rotation:.3f}", f"{m.seconds / own:.2f}",
            )  # fmt: skip
            body.append([str(cell) for cell in cells])
    n_pairs = N_VIEWS * (N_VIEWS - 1) // 2
    title = f"{N_VIEWS} views of {SIZE[0]} x {SIZE[1]}, {n_pairs} pairs"
    text = f"## {title}\n\n{table(header, body)}"
    if len(args.scenes) > 1:
        two = args.scenes[:2]
        text += f"\n\n## Views of {' and '.join(two)} together\n\n{_mixtures(two, args.seed)}"
    print(text)
    if args.page:
        fill(args.page, text)
    return 0


def _mixtures(names: Sequence[str], seed: int) -> str:
    n_right = len(names) * N_VIEWS * (N_VIEWS - 1) // 2
    n_wrong = len(names) * N_VIEWS * (len(names) * N_VIEWS - 1) // 2 - n_right
    body = []
    for kind, ratio in tqdm(RATIOS.items(), unit="mixture"):
        with tempfile.TemporaryDirectory() as folder:
            found = mix(names, ratio, Path(folder) / "sfm", seed)
        own = found["pycolmap"].seconds
        for verifier, m in found.items():
            cells = (kind, verifier, m.right, m.wrong, f"{m.seconds / own:.2f}")
            body.append([str(cell) for cell in cells])
    header = (
        "matches", "verification", f"pairs of one scene, of {n_right}",
        f"pairs of two scenes, of {n_wrong}", "time / COLMAP's",
    )  # fmt: skip
    return table(header, body)


if __name__ == "__main__":
    sys.exit(main())
