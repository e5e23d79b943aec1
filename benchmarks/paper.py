"""The experiments of Wu and Wan, "Clustering assisted fundamental matrix estimation", again.

Real pairs come from installed packages, synthetic ones from a renderer; each trial draws about as
many matches as the paper has. Every table prints the paper's own figures beside ours.
"""

from __future__ import annotations

import json
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from io import BytesIO
from itertools import pairwise, product
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.data import TRUTH_BAND, Pair, load_pairs, move_onto
from benchmarks.metrics import LOST, epipolar_distance, sampson_distance, usable
from benchmarks.rendered import SCENES, render_pair
from benchmarks.report import INFINITE, finite, table
from benchmarks.run import one_thread
from benchmarks.scenes import make_scene
from cv_densityf import datasets
from cv_densityf._arguments import DensityRule
from cv_densityf._density import density_peaks
from cv_densityf._engine import Robust
from cv_densityf._estimate import run
from cv_densityf._paper import paper_support
from cv_densityf._zhang import epipolar_distance as zhang_distance
from cv_densityf.matching import match_images
from cv_densityf.plotting import plot_decision_graph, plot_matches

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

#: The paper's number of matches, and the fewest that a real pair must have to stand beside it.
N_PAPER, N_LEAST = 411, 200
#: What is drawn from: the nearest neighbours of the first image's features, those of them that are
#: mutual, and those of these that pass a ratio test. The paper does not say how it matched.
ONE_WAY, MUTUAL, RATIO = "one-way matches", "mutual matches", 0.8
#: With what `match_features` is told.
CUTS: dict[str, dict[str, Any]] = {
    ONE_WAY: {"mutual": False},
    MUTUAL: {},
    f"SIFT ratio < {RATIO}": {"ratio": RATIO},
}
#: The paper names neither.
CONFIDENCE, MAX_ITERS = 0.999, 5000
DC_PERCENT = 2.0

#: Threshold (px), alpha, and the paper's time (ms) and mean error (px) of RANSAC and of its own.
TABLE_1 = (
    (2.2, 0.011, (4.7, 0.841559), (9.9, 0.744619)),
    (1.0, 0.02, (10.3, 0.438181), (13.3, 0.412330)),
    (0.8, 0.025, (33.3, 0.370029), (14.3, 0.357731)),
    (0.5, 0.04, (126.0, 0.241158), (17.2, 0.224982)),
)
TABLE_2 = {
    "8-point": (1.3, 1.064726),
    "7-point": (23.6, 1.706590),
    "LMedS": (18.2, 0.833023),
    "proposed": (9.9, 0.744619),
}
TABLE_3 = {
    "8-point": 83.875023,
    "7-point": 42.706934,
    "LMedS": 1.300233,
    "RANSAC": 1.330434,
    "proposed": 1.077631,
}
SWEEP_ALPHAS = (0.001, 0.002, 0.005, 0.011, 0.02, 0.04, 0.08, 0.16, 0.32)
SWEEP_THRESHOLD = 1.0
#: The cut of the sweep and of the pictures.
SHOWN = MUTUAL
#: Width of the pictures, inches: that of a page, so that their letters are as large as its text.
PAGE = 10
#: Bounds of RANSAC's time in that of LMedS, which draws a fixed number of samples: how hard it had
#: to work. The paper's at its smallest threshold took 6.9 times as long.
WORK = (0.0, 0.2, 1.0, 5.0, np.inf)
#: A match this close to F_0, pixels, counts as right.
RIGHT = 2.2
PROPOSED, PROPOSED_CV2, DEFAULT = "proposed", "proposed, cv2's RANSAC", "default"
MAGSAC = "USAC_MAGSAC"


@dataclass(frozen=True, eq=False)
class Views:
    """A pair and, where there are any, its pictures and its one-way matches."""

    pair: Pair
    source: str
    images: tuple[NDArray[np.uint8] | None, NDArray[np.uint8] | None] = (None, None)
    one_way: Floats | None = None

    def matches(self, cut: str) -> Floats | None:
        """Return the matches (n, 4) of a cut; None where one-way matches are not known."""
        X, scores = self.pair.X, self.pair.scores
        if cut == ONE_WAY:
            return self.one_way
        return X if scores is None or cut == MUTUAL else X[1 - scores < RATIO]


@dataclass(frozen=True)
class Trial:
    """One method on one draw of a pair's matches.

    Attributes
    ----------
    source : str
        "real" or "synthetic", or the made-up scene.
    cut : str
        A key of `CUTS`.
    pair, method : str
    seed, n : int
    threshold : float
        Pixels.
    alpha : float
    ms : float
        Processor time.
    own : float
        Mean symmetric epipolar distance of the method's own inliers, pixels; NaN without any.
    truth : float
        The same of the truth points; infinite for a failure.
    zhang : float
        Zhang's distance to the true F, pixels; NaN where that is not known.
    inliers : int
        Own inliers.
    drawn_from : int
        Matches that hypotheses were drawn from.
    """

    source: str
    cut: str
    pair: str
    method: str
    seed: int
    n: int
    threshold: float
    alpha: float
    ms: float
    own: float
    truth: float
    zhang: float
    inliers: int
    drawn_from: int


@dataclass(frozen=True)
class Swept:
    """A trial, the share of the matches it drew from, and the share of those that are right."""

    trial: Trial
    kept: float
    right: float

    @property
    def fell_back(self) -> bool:
        """Whether the rule kept too few that agree, and cv2's own call on all answered."""
        return self.kept < 1 and self.trial.drawn_from == self.trial.n


class Solution(NamedTuple):
    """F, the method's own inliers (n,), and how many matches its hypotheses were drawn from."""

    F: Floats | None
    own: Bools
    drawn_from: int


# The methods: matches, threshold, alpha and seed in; F and the method's own inliers out.


def _cv2(flag: int) -> Callable[[Floats, float, float, int], Solution]:
    def solve(X: Floats, threshold: float, alpha: float, seed: int) -> Solution:
        F, mask = _robust(flag, threshold).plain(X[:, :2].copy(), X[:, 2:].copy())
        own = np.zeros(len(X), dtype=bool) if mask is None else mask.ravel() != 0
        return Solution(usable(F), own, len(X))

    return solve


def _robust(flag: int, threshold: float) -> Robust:
    return Robust(flag, threshold, CONFIDENCE, MAX_ITERS)


def _proposed(X: Floats, threshold: float, alpha: float, seed: int) -> Solution:
    """Take steps 1 to 5 literally; the inliers are among the matches that the rule keeps."""
    found = run(X, _robust(cv2.FM_RANSAC, threshold), DensityRule("paper", alpha), seed=seed)
    # The pipeline leaves it to cv2, and to all matches, where no sample of the kept ones agrees.
    return Solution(usable(found.F), found.mask & found.kept, int(found.kept.sum()))


def _proposed_cv2(X: Floats, threshold: float, alpha: float, seed: int) -> Solution:
    """Take steps 1 to 4, then cv2's RANSAC: compiled, with samples of seven."""
    rows = np.flatnonzero(paper_support(X, alpha, DC_PERCENT)[1])
    F, found, _ = RANSAC(X[rows], threshold, alpha, seed)
    own = np.zeros(len(X), dtype=bool)
    own[rows] = found
    return Solution(F, own, len(rows))


def _default(X: Floats, threshold: float, alpha: float, seed: int) -> Solution:
    found = run(X, _robust(cv2.FM_RANSAC, threshold), seed=seed)
    return Solution(usable(found.F), found.mask, len(X))


RANSAC = _cv2(cv2.FM_RANSAC)
METHODS: dict[str, Callable[[Floats, float, float, int], Solution]] = {
    "8-point": _cv2(cv2.FM_8POINT),
    "7-point": _cv2(cv2.FM_7POINT),
    "LMedS": _cv2(cv2.FM_LMEDS),
    "RANSAC": RANSAC,
    PROPOSED: _proposed,
    PROPOSED_CV2: _proposed_cv2,
    DEFAULT: _default,
    MAGSAC: _cv2(cv2.USAC_MAGSAC),
}
HEADLINE = (PROPOSED, PROPOSED_CV2, DEFAULT)
SEARCHES = ("RANSAC", PROPOSED, PROPOSED_CV2, DEFAULT, MAGSAC)

Cell = tuple[str, int, float]
#: Where the rule breaks: what varies, and the made-up scenes (kind, N, inlier ratio).
LIMITS: dict[str, list[Cell]] = {
    "N": [("clusters", n, 0.6) for n in (100, 200, 411, 1000, 3000)],
    "inlier ratio": [("clusters", N_PAPER, ratio) for ratio in (0.2, 0.3, 0.4, 0.6, 0.8)],
    "kind": [(kind, N_PAPER, 0.6) for kind in ("clusters", "dominant_plane", "repeated_texture")],
}
LIMITS_METHODS = ("RANSAC", PROPOSED, DEFAULT)
LIMITS_THRESHOLD, LIMITS_ALPHA, LIMITS_NOISE = TABLE_1[1][0], TABLE_1[1][1], 0.5


def _cell_name(cell: Cell) -> str:
    return "/".join(map(str, cell))


def reproduce(data: str | None, out: Path, seeds: int, quick: bool) -> str:
    """Run every experiment; return the report in markdown, and write it and the plots to ``out``.

    Parameters
    ----------
    data : str or None
        Folder of further real pairs.
    out : path
        Folder for paper.md, paper.json and the plots.
    seeds : int
        Draws of each pair's matches.
    quick : bool
        One real and one made-up pair, one draw, few settings.
    """
    views = quick_pairs() if quick else [*real_pairs(data), *rendered_pairs()]
    seeds = 1 if quick else seeds
    alphas = SWEEP_ALPHAS[2::3] if quick else SWEEP_ALPHAS
    repeats = 1 if quick else 3
    with one_thread():
        trials = _run_tables(views, range(seeds), repeats)
        sweep = _run_sweep(views, range(seeds), alphas, repeats)
        limits = _run_limits(1 if quick else 20)
    report = "\n\n".join(
        [
            "# The paper's experiments",
            f"OpenCV {cv2.__version__}, confidence {CONFIDENCE:g}, at most {MAX_ITERS} samples. "
            f"{seeds} draw(s) of at most {N_PAPER} matches from each pair. Cells are medians over "
            "pairs and draws, with the quartiles in brackets.",
            _pairs_table(views),
            _growth_table(trials),
            _work_table(trials),
            *(
                part([t for t in trials if t.cut == cut], cut)
                for part in (_headline, _table_1, _table_2, _table_3)
                for cut in CUTS
            ),
            _limits_table(limits),
        ]
    )
    out.mkdir(parents=True, exist_ok=True)
    (out / "paper.md").write_text(report + "\n", encoding="utf-8")
    records = [finite(asdict(t)) for t in trials]
    (out / "paper.json").write_text(json.dumps(records) + "\n", encoding="utf-8")
    _plot_sweep(out / "paper-alpha.png", sweep)
    for source in ("real", "synthetic"):
        _plot_pair(out, next(v for v in views if v.source == source))
    return report


# Pairs


def quick_pairs() -> list[Views]:
    """One photograph pair and one made-up scene: nothing to render, nothing to wait for."""
    scene = make_scene("clusters", N_PAPER, 0.7, 0.5)
    return [motorcycle(), Views(scene, "synthetic", one_way=scene.X)]


def real_pairs(data: str | None) -> list[Views]:
    """Pairs of photographs from installed packages, and those of a folder."""
    views = [motorcycle(), *_stereodemo()]
    if data is not None:
        views += [Views(pair, "real") for pair in load_pairs(data)]
    return [v for v in views if len(v.pair.X) >= N_LEAST]


def rendered_pairs() -> list[Views]:
    """Render every scene."""
    views = []
    for name in tqdm(SCENES, desc="render", unit="pair"):
        pair, image1, image2 = render_pair(name)
        views.append(Views(pair, "synthetic", (image1, image2), _one_way(image1, image2)))
    return views


def motorcycle() -> Views:
    """Take the pair of scikit-image's wheel, whose truth is its measured disparity."""
    images = datasets.motorcycle()
    truth = np.hstack([images.points1, images.points2])
    return _photographed("motorcycle", images.image1, images.image2, images.F, truth)


def _stereodemo() -> list[Views]:
    """Take the rectified pairs of stereodemo's wheel; rows match to about a third of a pixel."""
    spec = find_spec("stereodemo")
    if spec is None or not spec.submodule_search_locations:
        print(
            "stereodemo is not installed, its pairs are left out; "
            "python -m pip install --no-deps stereodemo",
            file=sys.stderr,
        )
        return []
    F = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    folder = Path(spec.submodule_search_locations[0]) / "datasets" / "oak-d"
    views = []
    for path in sorted(folder.glob("*_left.png")):
        name = path.stem.removesuffix("_left")
        image1, image2 = (cv2.imread(str(folder / f"{name}_{s}.png")) for s in ("left", "right"))
        if image1 is None or image2 is None:
            raise ValueError(f"{folder}: the images of {name} cannot be read; reinstall stereodemo")
        views.append(_photographed(name, image1, image2, F, None))
    return views


def _photographed(name: str, image1: Any, image2: Any, F: Floats, truth: Floats | None) -> Views:
    matches = match_images(image1, image2)
    if truth is None:
        truth = move_onto(F, matches.X[sampson_distance(F, matches.X) < TRUTH_BAND])
    pair = Pair(
        name=name,
        group="photographs",
        X=matches.X,
        scores=matches.scores,
        truth=truth,
        size1=matches.size1,
        size2=matches.size2,
        F_gt=F,
    )
    return Views(pair, "real", (image1, image2), _one_way(image1, image2))


def _one_way(image1: Any, image2: Any) -> Floats:
    return match_images(image1, image2, **CUTS[ONE_WAY]).X


def draw(X: Floats, seed: int) -> Floats:
    """Draw as many matches as the paper has, or shuffle the fewer there are."""
    rows = np.random.default_rng(seed).permutation(len(X))[:N_PAPER]
    return np.ascontiguousarray(X[rows])


# Trials


def attempt(
    views: Views,
    cut: str,
    X: Floats,
    method: str,
    threshold: float,
    alpha: float,
    seed: int,
    repeats: int = 1,
) -> Trial:
    """Run one method on matches of a pair; the fastest of ``repeats`` calls counts."""
    pair = views.pair
    ms = np.inf
    for _ in range(repeats):
        start = time.process_time()
        F, own, drawn_from = METHODS[method](X, threshold, alpha, seed)
        ms = min(ms, 1e3 * (time.process_time() - start))
    own_error, distance = np.nan, np.nan
    if F is not None and own.any():
        own_error = float(epipolar_distance(F, X[own]).mean())
    if pair.F_gt is not None:
        distance = np.inf
        if F is not None:
            distance = zhang_distance(pair.F_gt, F, pair.size1, pair.size2)
    return Trial(
        source=views.source,
        cut=cut,
        pair=pair.name,
        method=method,
        seed=seed,
        n=len(X),
        threshold=threshold,
        alpha=alpha,
        ms=ms,
        own=own_error,
        truth=pair.error(F),
        zhang=distance,
        inliers=int(np.count_nonzero(own)),
        drawn_from=drawn_from,
    )


def _run_tables(views: Sequence[Views], seeds: Sequence[int], repeats: int) -> list[Trial]:
    jobs = [
        (v, cut, draw(X, seed), method, threshold, alpha, seed, repeats)
        for cut in CUTS
        for v in views
        if (X := v.matches(cut)) is not None
        for seed in seeds
        for threshold, alpha, *_ in TABLE_1
        for method in METHODS
        # The direct methods take no threshold.
        if method in SEARCHES or threshold == TABLE_1[0][0]
    ]
    return [attempt(*job) for job in tqdm(jobs, desc="tables", unit="call")]


def _run_sweep(
    views: Sequence[Views], seeds: Sequence[int], alphas: Sequence[float], repeats: int
) -> list[Swept]:
    known = [(v, v.pair.F_gt, seed) for v in views for seed in seeds]
    swept = []
    for v, F, seed in tqdm(known, desc="alpha", unit="draw"):
        if F is None:
            continue
        X = draw(v.pair.X, seed)
        right = epipolar_distance(F, X) < RIGHT
        trial = attempt(v, SHOWN, X, "RANSAC", SWEEP_THRESHOLD, 0.0, seed, repeats)
        swept.append(Swept(trial, 1.0, float(right.mean())))
        for alpha in alphas:
            kept = paper_support(X, alpha, DC_PERCENT)[1]
            trial = attempt(v, SHOWN, X, PROPOSED, SWEEP_THRESHOLD, alpha, seed, repeats)
            swept.append(Swept(trial, float(kept.mean()), float(right[kept].mean())))
    return swept


def _run_limits(repeats: int) -> list[Trial]:
    cells = list(dict.fromkeys(cell for cells in LIMITS.values() for cell in cells))
    trials = []
    for cell, seed in tqdm(list(product(cells, range(repeats))), desc="limits", unit="scene"):
        kind, n, ratio = cell
        v = Views(make_scene(kind, n, ratio, LIMITS_NOISE, seed), _cell_name(cell))
        trials += [
            attempt(v, SHOWN, v.pair.X, method, LIMITS_THRESHOLD, LIMITS_ALPHA, seed)
            for method in LIMITS_METHODS
        ]
    return trials


# Tables


def _spread(values: Iterable[float], digits: int = 3) -> str:
    """Median and quartiles; failures are infinite, and sort last."""
    v = np.array([value for value in values if not np.isnan(value)])
    if len(v) == 0:
        return ""
    median, low, high = np.quantile(v, [0.5, 0.25, 0.75], method="inverted_cdf")
    return f"{_short(median, digits)} [{_short(low, digits)} to {_short(high, digits)}]"


def _short(value: float, digits: int) -> str:
    return INFINITE if np.isinf(value) else f"{value:.{digits}f}"


def _pick(trials: Iterable[Trial], source: str, method: str, threshold: float) -> list[Trial]:
    return [t for t in trials if (t.source, t.method, t.threshold) == (source, method, threshold)]


def _pairs_table(views: Sequence[Views]) -> str:
    header = ["pair", "kind", "truth points"]
    header += [f"{cut}: number, share right" for cut in CUTS]
    body = []
    for v in views:
        row = [v.pair.name, v.source, str(len(v.pair.truth))]
        for cut in CUTS:
            X = v.matches(cut)
            row.append("" if X is None else str(len(X)))
            if X is not None and v.pair.F_gt is not None:
                row[-1] += f", {np.mean(epipolar_distance(v.pair.F_gt, X) < RIGHT):.2f}"
        body.append(row)
    title = f"## Pairs\n\nA match within {RIGHT:g} px of F_0 counts as right.\n\n"
    return title + table(header, body)


def _growth_table(trials: Sequence[Trial]) -> str:
    """RANSAC's time over that at the largest threshold, in the paper and with each cut."""
    thresholds = [row[0] for row in TABLE_1]
    papers = [row[2][0] for row in TABLE_1]
    body = [["the paper", *(f"{ms / papers[0]:.1f}" for ms in papers), ""]]
    for cut in CUTS:
        rows = [
            _pick((t for t in trials if t.cut == cut), "real", "RANSAC", threshold)
            for threshold in thresholds
        ]
        growth = ([t.ms / first.ms for t, first in zip(r, rows[0], strict=True)] for r in rows)
        share = _spread((t.inliers / t.n for t in rows[0]), 2)
        body.append([cut, *(_spread(ratios, 1) for ratios in growth), share])
    header = ["", *(f"th {threshold:g}" for threshold in thresholds)]
    title = f"## RANSAC's time / that at {thresholds[0]:g} px, real pairs\n\n"
    return title + table([*header, f"share of inliers at {thresholds[0]:g} px"], body)


def _work_table(trials: Sequence[Trial]) -> str:
    """Tell times over RANSAC's, by how hard RANSAC had to work, on the same draws of any cut."""
    threshold, _, (ransac_ms, _), (papers_ms, _) = TABLE_1[-1]

    def times(method: str, threshold: float) -> Floats:
        return np.array([t.ms for t in _pick(trials, "real", method, threshold)])

    ransac = times("RANSAC", threshold)
    work = ransac / times("LMedS", TABLE_1[0][0])
    body = []
    for low, high in pairwise(WORK):
        within = (low <= work) & (work < high)
        papers = low <= ransac_ms / TABLE_2["LMedS"][0] < high
        body.append(
            [
                f"{low:g} and more" if np.isinf(high) else f"{low:g} to {high:g}",
                f"{np.count_nonzero(within)}",
                f"{papers_ms / ransac_ms:.2f}" if papers else "",
                *(_spread((times(m, threshold) / ransac)[within]) for m in (*HEADLINE, MAGSAC)),
            ]
        )
    header = ["RANSAC's time / LMedS's", "draws", "paper's", *HEADLINE, MAGSAC]
    title = f"## Time / RANSAC's, by RANSAC's work, real pairs, th {threshold:g} px\n\n"
    return title + table(header, body)


def _table_1(trials: Sequence[Trial], cut: str) -> str:
    header = ["th, px", "method", "time, ms", "paper's"]
    header += ["mean error of own inliers, px", "paper's", "error on truth points, px"]
    header += ["own inliers", "drawn from"]
    body = []
    for threshold, alpha, *figures in TABLE_1:
        papers = dict(zip(("RANSAC", PROPOSED), figures, strict=True))
        for method in SEARCHES:
            rows = _pick(trials, "real", method, threshold)
            ms, own = papers.get(method, ("", ""))
            name = f"{method}, alpha = {alpha:g}" if method in (PROPOSED, PROPOSED_CV2) else method
            drawn_from = _spread((float(t.drawn_from) for t in rows), 0)
            body.append([f"{threshold:g}", name, *_time_and_error(rows, ms, own), drawn_from])
    return f"## Table 1: thresholds, real pairs, {cut}\n\n" + table(header, body)


def _table_2(trials: Sequence[Trial], cut: str) -> str:
    header = ["method", "time, ms", "paper's"]
    header += [
        "mean error of own inliers, px",
        "paper's",
        "error on truth points, px",
        "own inliers",
    ]
    threshold = TABLE_1[0][0]
    body = []
    for method in METHODS:
        if method != "RANSAC":
            rows = _pick(trials, "real", method, threshold)
            body.append([method, *_time_and_error(rows, *TABLE_2.get(method, ("", "")))])
    title = f"## Table 2: other methods, real pairs, th {threshold:g} px, {cut}\n\n"
    return title + table(header, body)


def _time_and_error(rows: Sequence[Trial], papers_ms: Any, papers_own: Any) -> list[str]:
    return [
        _spread((t.ms for t in rows), 2),
        str(papers_ms),
        _spread(t.own for t in rows),
        str(papers_own),
        _spread(t.truth for t in rows),
        _spread((float(t.inliers) for t in rows), 0),
    ]


def _table_3(trials: Sequence[Trial], cut: str) -> str:
    header = ["method", "Zhang's distance to F_0, px", "paper's", "error on truth points, px"]
    header += ["time, ms"]
    threshold, alpha = TABLE_1[0][:2]
    body = []
    for method in METHODS:
        rows = _pick(trials, "synthetic", method, threshold)
        body.append(
            [
                method,
                _spread(t.zhang for t in rows),
                str(TABLE_3.get(method, "")),
                _spread(t.truth for t in rows),
                _spread((t.ms for t in rows), 2),
            ]
        )
    title = f"## Table 3: synthetic pairs, th {threshold:g} px, alpha {alpha:g}, {cut}\n\n"
    return title + table(header, body)


def _headline(trials: Sequence[Trial], cut: str) -> str:
    """Ratios to RANSAC on the same draw."""
    low, high = TABLE_1[-1], TABLE_1[0]
    (ransac_ms, ransac_own), (papers_ms, papers_own) = low[2:]
    rows: list[tuple[str, str, float, str, float | None]] = [
        ("time", "real", low[0], "ms", papers_ms / ransac_ms),
        ("mean error of own inliers", "real", low[0], "own", papers_own / ransac_own),
        ("error on truth points", "real", low[0], "truth", None),
        (
            "Zhang's distance (Table 3)",
            "synthetic",
            high[0],
            "zhang",
            TABLE_3[PROPOSED] / TABLE_3["RANSAC"],
        ),
    ]
    body = []
    for what, source, threshold, field, papers in rows:
        ratios = (_spread(_ratios(trials, source, threshold, field, method)) for method in HEADLINE)
        paper = "" if papers is None else f"{papers:.2f}"
        body.append([f"{what}, {source} pairs, th {threshold:g}", paper, *ratios])
    title = f"## Headline: ratios to RANSAC on the same draw, below 1 is better, {cut}\n\n"
    return title + table(["ratio", "paper's", *HEADLINE], body)


def _ratios(
    trials: Sequence[Trial], source: str, threshold: float, field: str, method: str
) -> list[float]:
    ours = _pick(trials, source, method, threshold)
    theirs = {(t.pair, t.seed): t for t in _pick(trials, source, "RANSAC", threshold)}
    with np.errstate(invalid="ignore"):
        return [
            float(np.divide(getattr(t, field), getattr(theirs[t.pair, t.seed], field)))
            for t in ours
        ]


def _limits_table(limits: Sequence[Trial]) -> str:
    body = []
    for what, cells in LIMITS.items():
        for cell in cells:
            row = [what, f"{cell[0]}, N = {cell[1]}, inlier ratio {cell[2]:g}"]
            for method in LIMITS_METHODS:
                own = _pick(limits, _cell_name(cell), method, LIMITS_THRESHOLD)
                errors = np.array([t.truth for t in own])
                lost = np.mean(~(errors <= LOST))
                ms = np.median([t.ms for t in own])
                row += [_spread(errors, 2), f"{lost:.0%}", f"{ms:.1f}"]
            body.append(row)
    title = (
        f"## Where the rule breaks: made-up scenes, th {LIMITS_THRESHOLD:g} px, "
        f"alpha {LIMITS_ALPHA:g}, noise {LIMITS_NOISE:g} px\n\n"
        f"Error on truth points, px; share of scenes lost (above {LOST:g} px); median time, ms.\n\n"
    )
    header = ["varies", "scene"]
    for method in LIMITS_METHODS:
        header += [f"{method}: error", "lost", "ms"]
    return title + table(header, body)


# Plots


def _plot_sweep(path: Path, swept: Sequence[Swept]) -> None:
    """Error, matches kept and time against alpha, real and synthetic; RANSAC dashed."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullLocator

    figure = Figure(figsize=(PAGE, 4.8), layout="constrained")
    error, share, speed = figure.subplots(1, 3)
    for source, color in (("real", "#0072B2"), ("synthetic", "#D55E00")):
        rows = [s for s in swept if s.trial.source == source]
        plain = [s for s in rows if s.trial.method == "RANSAC"]
        plain_ms = {(s.trial.pair, s.trial.seed): s.trial.ms for s in plain}
        by_alpha: dict[float, list[Swept]] = defaultdict(list)
        for s in rows:
            if s.trial.method == PROPOSED:
                by_alpha[s.trial.alpha].append(s)
        alphas = list(by_alpha)
        low, middle, high = (
            [_quantile((s.trial.truth for s in by_alpha[a]), q) for a in alphas]
            for q in (0.25, 0.5, 0.75)
        )
        error.plot(alphas, middle, "o-", color=color, label=f"{source}, proposed")
        error.fill_between(alphas, low, high, color=color, alpha=0.18, lw=0)
        reference = _quantile((s.trial.truth for s in plain), 0.5)
        error.axhline(reference, color=color, ls="--", label=f"{source}, RANSAC")
        for name, line, label in (
            ("kept", "o-", "matches kept"),
            ("right", "^:", "right ones among the kept"),
        ):
            values = [_quantile((getattr(s, name) for s in by_alpha[a]), 0.5) for a in alphas]
            share.plot(alphas, values, line, color=color, label=f"{source}, {label}")
        left = [np.mean([s.fell_back for s in by_alpha[a]]) for a in alphas]
        share.plot(alphas, left, "x--", color=color, label=f"{source}, draws left to cv2")
        ratios = [
            _quantile((s.trial.ms / plain_ms[s.trial.pair, s.trial.seed] for s in by_alpha[a]), 0.5)
            for a in alphas
        ]
        speed.plot(alphas, ratios, "o-", color=color, label=source)
    error.set(yscale="log", ylabel="error on truth points, px")
    share.set(ylim=(0, 1.03), ylabel="share")
    speed.axhline(1, color="black", ls="--", lw=1, label="RANSAC")
    speed.set(yscale="log", ylabel="time / RANSAC's")
    for ax in (error, speed):
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_locator(NullLocator())
    for ax in (error, share, speed):
        ax.set(xscale="log", xlabel="alpha")
        ax.xaxis.set_major_formatter("{x:g}")
        ax.grid(alpha=0.25)
        ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), fontsize=8.5, frameon=False)
    _save(figure, path)


def _save(figure: Any, path: Path) -> None:
    """Write a PNG of 256 colours: photographs make it half as large."""
    from PIL import Image

    buffer = BytesIO()
    figure.savefig(buffer, dpi=100)
    Image.open(buffer).convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE).save(path)


def _quantile(values: Iterable[float], q: float) -> float:
    return float(np.quantile(np.array(list(values)), q, method="inverted_cdf"))


def _plot_pair(folder: Path, views: Views) -> None:
    """Figures 4 and 5, or 7 and 8: decision graph with RANSAC's outliers, and the matches."""
    from matplotlib.figure import Figure

    threshold, alpha = TABLE_1[0][:2]
    X = draw(views.pair.X, 0)
    kept = paper_support(X, alpha, DC_PERCENT)[1]
    ransac_inliers = RANSAC(X, threshold, alpha, 0).own
    own = _proposed(X, threshold, alpha, 0).own
    for name, height in (("decision", 5.0), ("matches", 4.1)):
        figure = Figure(figsize=(PAGE, height), layout="constrained")
        ax = figure.add_subplot()
        if name == "decision":
            peaks = density_peaks(X, dc_percent=DC_PERCENT)
            plot_decision_graph(peaks, alpha=alpha, kept=kept, mask=ransac_inliers, ax=ax)
        else:
            plot_matches(*views.images, X[kept], mask=own[kept], ax=ax)
        _save(figure, folder / f"paper-{views.source}-{name}.png")
