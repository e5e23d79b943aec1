"""Rendered pairs as files for ``python -m benchmarks real``: every scene under four motions.

A drive ahead, two pictures of a video, an ordinary and a wide baseline, each with F known from the
cameras and truth points from the depth buffer, so that nothing in the truth comes from matches.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.data import Pair
from benchmarks.dense import dense_matches
from benchmarks.rendered import SCENES, camera_axes, facade, pair_of, photograph

Floats = NDArray[np.float64]

#: From the first camera to the second one: right, up and ahead, in metres, of which a typical
#: scene is ten deep; and how far the point it looks at moves, at random.
MOTIONS: dict[str, tuple[Callable[[np.random.Generator], Any], float]] = {
    "ahead": (lambda r: (0.05 * r.normal(), 0.03 * r.normal(), r.uniform(0.4, 1.6)), 0.1),
    "video": (lambda r: (r.uniform(0.05, 0.2), 0.05 * r.normal(), 0.05 * r.normal()), 0.15),
    "apart": (lambda r: (r.uniform(1.5, 3.0), 0.3 * r.normal(), 0.4 * r.normal()), 0.3),
    "wide": (lambda r: (r.uniform(3.5, 6.5), r.uniform(-0.8, 1.2), r.uniform(-0.5, 2.0)), 0.3),
}
#: Where the first camera stands before the facade, and what it looks at.
_BEFORE_FACADE = ((-1.5, -7.0, 2.6), (0.0, 4.0, 4.0))
#: Truth points kept of each pair, evenly.
_TRUTH = 400


def write_pairs(
    folder: str | Path, repeats: int = 3, dense: bool = False, progress: bool = True
) -> list[Path]:
    """Render, match and write the pairs, a file each; the same ones whenever called.

    Parameters
    ----------
    folder : path
        Is made if it does not exist.
    repeats : int
        Of each scene, with other textures and places.
    dense : bool
        With `dense_matches` in place of SIFT's, and no scores.
    progress : bool
        Whether to show a bar.

    Returns
    -------
    list of Path
        ``MOTION__SCENEREPEAT.npz``, in the form of `benchmarks.data`. They hold no ``F_gt``, so
        that the truth points are those of the depth buffer.

    Raises
    ------
    ValueError
        If pyvista is not installed.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    scenes = {name: (scene.build, scene.places[0], scene.target) for name, scene in SCENES.items()}
    scenes["facade"] = (facade, *_BEFORE_FACADE)
    written = []
    cells = [(repeat, name) for repeat in range(repeats) for name in scenes]
    for repeat, name in tqdm(cells, desc="rendering", unit="scene", disable=not progress):
        build, place, target = scenes[name]
        rng = np.random.default_rng([repeat, list(scenes).index(name)])
        first = (np.add(place, 0.3 * rng.normal(size=3)), np.array(target))
        moved = [_moved(*first, *motion, rng) for motion in MOTIONS.values()]
        view1, *others = photograph(build, [first, *moved], rng)
        for motion, view2 in zip(MOTIONS, others, strict=True):
            path = folder / f"{motion}__{name}{repeat}.npz"
            X = dense_matches(view1, view2, rng) if dense else None
            _write(path, pair_of(path.stem, view1, view2, X))
            written.append(path)
    return written


def _moved(
    place: Floats,
    target: Floats,
    step: Callable[[np.random.Generator], Any],
    wander: float,
    rng: np.random.Generator,
) -> tuple[Floats, Floats]:
    right, up, ahead = step(rng)
    moved = place + (right, -up, ahead) @ camera_axes(place, target)
    return moved, target + wander * rng.normal(size=3)


def _write(path: Path, pair: Pair) -> None:
    assert pair.cameras is not None
    ratio = np.ones(len(pair.X)) if pair.scores is None else 1.0 - pair.scores
    order = np.argsort(ratio, kind="stable")
    truth = pair.truth[np.linspace(0, len(pair.truth) - 1, _TRUTH).astype(int)]
    np.savez_compressed(
        path,
        pts1=pair.X[order, :2],
        pts2=pair.X[order, 2:],
        score=ratio[order],
        score_kind="none" if pair.scores is None else "sift_ratio",
        size1=np.array(pair.size1),
        size2=np.array(pair.size2),
        val1=truth[:, :2],
        val2=truth[:, 2:],
        **{name: getattr(pair.cameras, name) for name in ("K1", "K2", "R", "t")},
    )
