"""Whether two images show one scene: how well the inliers' coherence tells, and their number."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.metrics import roc_auc_score
from tqdm import tqdm

from benchmarks.data import Pair, load_pairs
from benchmarks.metrics import LOST
from benchmarks.paper import CUTS, Views, real_pairs, rendered_pairs
from benchmarks.report import table
from cv_densityf import coherence, estimate_fundamental
from cv_densityf._prefilter import COHERENT
from cv_densityf.matching import detect, match_features

Floats = NDArray[np.float64]

THRESHOLDS = (1.0, 4.0)
#: With fewer inliers COLMAP, and `verify`, drop a pair.
LEAST = 15
#: Photographs of one desk.
ALIKE = frozenset({"desk", "pov_controllers", "pov_hands"})


class Found(NamedTuple):
    """What the inliers of a pair say."""

    coherence: float
    number: int


@dataclass(frozen=True, eq=False)
class Candidates:
    """Matches (n, 4) of pairs of one scene, with their truth, and of pairs of two scenes."""

    one: list[tuple[Floats, Views]]
    two: list[Floats]


def overlap(data: str | Path | None = None) -> str:
    """Measure both kinds of pairs, and return the tables as markdown.

    Parameters
    ----------
    data : path or None
        Folder of further pairs of one scene; only their mutual matches are known.
    """
    views = [*real_pairs(None), *rendered_pairs()]
    more = [] if data is None else [Views(pair, "real") for pair in load_pairs(data)]
    candidates = _candidates(views, more)
    names = ", ".join(v.pair.name for v in views)
    about = (
        f"Pairs of one scene: {names}; {len(more)} of a folder. Those whose F is off by more than "
        f"{LOST:g} px do not count. Pairs of two: the first image of each with the second of each "
        "other."
    )
    return "\n\n".join([about, *(_section(candidates, threshold) for threshold in THRESHOLDS)])


def _candidates(views: Sequence[Views], more: Sequence[Views]) -> dict[str, Candidates]:
    features = [tuple(detect(image) for image in v.images if image is not None) for v in views]
    strangers = [
        (features[i][0], features[j][1])
        for i, j in permutations(range(len(views)), 2)
        if not {views[i].pair.name, views[j].pair.name} <= ALIKE
    ]
    return {
        cut: Candidates(
            [(X, v) for v in [*views, *more] if (X := v.matches(cut)) is not None],
            [match_features(*pair, **how).X for pair in strangers],
        )
        for cut, how in tqdm(CUTS.items(), desc="match", unit="kind")
    }


def _section(candidates: Mapping[str, Candidates], threshold: float) -> str:
    body = []
    for cut, c in tqdm(candidates.items(), desc=f"{threshold:g} px", unit="kind"):
        one = [found for X, v in c.one if (found := look(X, threshold, v.pair))]
        two = [found for X in c.two if (found := look(X, threshold))]
        body.append([cut, *_cells(one, two)])
    header = (
        "matches", f"with {LEAST} inliers: one scene", "two scenes",
        f"of these, {COHERENT:g} coherent: one scene", "two scenes",
        "coherence of one scene: least, 5 %, median", "of two: median, 95 %, most",
        "inliers of one scene", "of two", "AUC of coherence, of inliers",
    )  # fmt: skip
    return f"## Threshold {threshold:g} px\n\n{table(header, body)}"


def look(X: Floats, threshold: float, truth: Pair | None = None) -> Found | None:
    """Estimate F, and look at its inliers; None if the truth is given, and F is wrong."""
    estimate = estimate_fundamental(X[:, :2], X[:, 2:], threshold=threshold)
    if truth is not None and not truth.error(estimate.F) <= LOST:
        return None
    return Found(coherence(X[:, :2], X[:, 2:], estimate.mask), estimate.n_inliers)


def _cells(one: Sequence[Found], two: Sequence[Found]) -> Iterator[str]:
    kinds = [np.array(found, dtype=float).reshape(-1, 2) for found in (one, two)]
    enough = [found[found[:, 1] >= LEAST] for found in kinds]
    for found, rest in zip(kinds, enough, strict=True):
        yield f"{len(rest)} of {len(found)}"
    for rest in enough:
        yield str(np.sum(rest[:, 0] >= COHERENT))
    for column, form in ((0, ".2f"), (1, ".0f")):
        for rest, levels in zip(enough, ((0, 0.05, 0.5), (0.5, 0.95, 1)), strict=True):
            values = np.quantile(rest[:, column], levels) if len(rest) else []
            yield ", ".join(format(value, form) for value in values)
    is_one = np.repeat([1, 0], [len(rest) for rest in enough])
    areas = [roc_auc_score(is_one, v) for v in np.concatenate(enough).T] if len(enough[1]) else []
    yield ", ".join(f"{area:.3f}" for area in areas)
