"""Real pairs from a folder of ``.npz`` files, ready to be estimated and judged.

Arrays of a file: ``pts1, pts2 (N, 2)`` pixels; ``score (N,)`` the SIFT ratio where ``score_kind``
is ``"sift_ratio"``; ``F_gt``, and ``K1, K2, R, t``, where the cameras are known; ``labels (N,)``
hand-labelled inliers; ``val1, val2 (m, 2)`` hand-checked points. The file's name up to ``__`` names
its set.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchmarks import metrics

Floats = NDArray[np.float64]

#: Matches with a Sampson distance to the true F below this, pixels, become truth points.
TRUTH_BAND = 1.0
#: A shorter baseline, in the units of t, is rounding noise.
NO_BASELINE = 1e-9
#: Sets in which ``labels`` are the truth.
LABELLED = "adelaide"


@dataclass(frozen=True, eq=False)
class Cameras:
    """Calibration and relative pose, x2 ~ K2 (R X + t)."""

    K1: Floats
    K2: Floats
    R: Floats
    t: Floats


@dataclass(frozen=True, eq=False)
class Pair:
    """Matches of one image pair and its truth.

    Attributes
    ----------
    name, group : str
        File stem, and the set it belongs to.
    X : (n, 4) float64
        Matches x, y, x', y', pixels, in shuffled order.
    scores : (n,) float64 or None
        Trust in each match, higher is better: 1 - SIFT ratio.
    truth : (m, 4) float64
        True matches the error is measured on.
    size1, size2 : (int, int)
        Width and height of the images.
    cameras : Cameras or None
    F_gt : (3, 3) float64 or None
    """

    name: str
    group: str
    X: Floats
    scores: Floats | None
    truth: Floats
    size1: tuple[int, int]
    size2: tuple[int, int]
    cameras: Cameras | None = None
    F_gt: Floats | None = None

    def error(self, F: ArrayLike | None) -> float:
        """Mean symmetric epipolar distance of the truth points, pixels; inf for a failure."""
        return metrics.epipolar_error(F, self.truth)

    def pose_error(self, F: ArrayLike | None) -> float:
        """Angular pose error, degrees; inf for a failure, NaN where the cameras are unknown."""
        if self.cameras is None:
            return np.nan
        c = self.cameras
        return metrics.pose_error(F, c.K1, c.K2, c.R, c.t, self.truth)


def load_pairs(
    folder: str | Path,
    cut: float | str = "all",
    seed: int = 0,
    sets: Collection[str] | None = None,
    n: int | None = None,
) -> list[Pair]:
    """Read the pairs of a folder.

    Parameters
    ----------
    folder : path
        Folder of ``.npz`` files.
    cut : float or "all"
        Keep the matches with a SIFT ratio below this. Pairs without ratios count under "all" only.
    seed : int
        Of the shuffle of the rows: the files are sorted best match first, which would favour
        order-sensitive methods.
    sets : collection of str, optional
        Only these sets.
    n : int, optional
        Only so many matches of each pair, at random; pairs with fewer are left out.

    Raises
    ------
    ValueError
        If the folder holds no pair, or a set does not exist, or no pair has n matches.
    """
    paths = sorted(Path(folder).glob("*.npz"))
    if not paths:
        raise ValueError(f"{folder} holds no .npz file; give the folder of pairs with --data")
    groups = {_group(path) for path in paths}
    if unknown := set(sets or ()) - groups:
        raise ValueError(f"no set {sorted(unknown)} in {folder}; it has {sorted(groups)}")
    limit = None if cut == "all" else float(cut)
    pairs = (_load(path, limit, seed, n) for path in paths if not sets or _group(path) in sets)
    loaded = [pair for pair in pairs if pair is not None]
    if n is not None and not loaded:
        raise ValueError(f"no pair has {n} such matches")
    return loaded


def _group(path: Path) -> str:
    return path.stem.split("__")[0]


def _load(path: Path, limit: float | None, seed: int, n: int | None) -> Pair | None:
    with np.load(path) as file:
        d = dict(file)
    X = np.hstack([d["pts1"], d["pts2"]]).astype(np.float64)
    has_ratio = str(d["score_kind"]) == "sift_ratio"
    if limit is not None and not has_ratio:
        return None
    truth = _truth(_group(path), X, d)
    ratio = d["score"].astype(np.float64) if has_ratio else None
    rows = np.arange(len(X))
    if limit is not None and ratio is not None:
        rows = rows[ratio < limit]
    rows = np.random.default_rng(seed).permutation(rows)[:n]
    if n is not None and len(rows) < n:
        return None
    return Pair(
        name=path.stem,
        group=_group(path),
        X=np.ascontiguousarray(X[rows]),
        scores=None if ratio is None else 1.0 - ratio[rows],
        truth=truth,
        size1=tuple(d["size1"].tolist()),
        size2=tuple(d["size2"].tolist()),
        cameras=_cameras(d),
        F_gt=d.get("F_gt"),
    )


def _truth(group: str, X: Floats, d: dict[str, NDArray[Any]]) -> Floats:
    if group.startswith(LABELLED):
        return np.asarray(X[d["labels"]])
    if "F_gt" not in d:
        return np.hstack([d["val1"], d["val2"]]).astype(np.float64)
    F = d["F_gt"]
    return move_onto(F, X[metrics.sampson_distance(F, X) < TRUTH_BAND])


def move_onto(F: Floats, X: Floats) -> Floats:
    """Move each match the shortest way onto the epipolar geometry of F; (m, 4), m <= n."""
    points1, points2 = cv2.correctMatches(F, X[None, :, :2], X[None, :, 2:])
    moved = np.hstack([points1[0], points2[0]])
    return np.asarray(moved[np.isfinite(moved).all(axis=1)], dtype=np.float64)


def _cameras(d: dict[str, NDArray[Any]]) -> Cameras | None:
    if not {"K1", "K2", "R", "t"} <= d.keys():
        return None
    if np.linalg.norm(d["t"]) < NO_BASELINE:
        return None  # one and the same camera twice: no direction to compare with
    return Cameras(d["K1"], d["K2"], d["R"], d["t"].ravel())
