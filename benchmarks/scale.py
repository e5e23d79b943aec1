"""How time, accuracy and memory grow with the number of matches, ours beside cv2 and others."""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from benchmarks.data import Pair
from benchmarks.peers import METHODS, Method, Settings, choose
from benchmarks.report import table
from benchmarks.run import one_thread, warm_up
from benchmarks.scenes import make_scene
from cv_densityf import _estimate
from cv_densityf._density import density_peaks
from cv_densityf._estimate import estimate_fundamental
from cv_densityf._prefilter import contrast_support
from cv_densityf.batch import estimate_many
from cv_densityf.datasets import motorcycle
from cv_densityf.matching import match_images

Floats = NDArray[np.float64]

RIVAL = "cv2:USAC_MAGSAC"
CALLS = ("cv2:FM_RANSAC", RIVAL, "ours:FM_RANSAC", "ours:USAC_MAGSAC", "ours:USAC_ACCURATE")
SEARCH_ALL = "ours:USAC_MAGSAC, searching all"
FILTER = "contrast, reliability, kept"
EXACT = "density_peaks"
MATRIX = "density peaks, distance matrix"
SAMPLE_SIZE = 20_000
SAMPLED = f"density_peaks, sample_size={SAMPLE_SIZE:,}"
#: Exponents are fitted to the sizes between these.
FIT = (1_000, 100_000)
#: A search on all matches is compared up to here.
MAX_SEARCH_ALL = 100_000
#: The matrix version of density peaks is run up to here, and extrapolated like n^2.
MAX_MATRIX = 4_000
#: Other clusterers are run up to here.
MAX_OTHERS = 20_000
INLIER_RATIO, NOISE = 0.3, 0.5
#: Pairs estimated by one worker and by two, by the clock, the faster of some runs.
N_PAIRS, PAIR_SIZE, RUNS = 200, 1_000, 5
#: Scenes over which the time of one pair is the median.
N_COSTED = 10
#: Calls on matches of which none is right are timed up to here: cv2's RANSAC takes all its samples.
MAX_HOPELESS = 10_000
#: Inlier ratios at which a search on a part is held against one on all matches.
RATIOS = (0.1, 0.2, 0.3, 0.5)
#: Pixels between the matches of a real pair's optical flow, and the share of them made wrong.
STRIDES = (7, 4, 2, 1)
WRONG = 0.4


@dataclass
class Series:
    """What was measured of one function: for each number of matches, over the scenes.

    Attributes
    ----------
    ms : dict of int to list of float
        Processor time, the faster of two calls.
    errors : dict of int to list of float
        Pixels; empty for what gives no fundamental matrix.
    """

    ms: dict[int, list[float]] = field(default_factory=dict)
    errors: dict[int, list[float]] = field(default_factory=dict)

    def time(self, n: int) -> float:
        """Median time, ms; NaN if not run."""
        return float(np.median(self.ms[n])) if n in self.ms else np.nan

    def error(self, n: int) -> float:
        """Median error, pixels; NaN if there is none."""
        return float(np.median(self.errors[n])) if self.errors.get(n) else np.nan

    @property
    def exponent(self) -> float:
        """Slope of log time over log n, by least squares, between the sizes of `FIT`."""
        n = np.array([n for n in self.ms if FIT[0] <= n <= FIT[1]])
        if len(n) < 2:
            return np.nan
        return float(np.polyfit(np.log(n), np.log([self.time(k) for k in n]), 1)[0])


def scale(
    numbers: Sequence[int],
    cluster_numbers: Sequence[int],
    scenes: int,
    kind: str = "clusters",
    plot: str | None = None,
) -> str:
    """Measure, and return the tables as markdown.

    Parameters
    ----------
    numbers : sequence of int
        Numbers of matches for the calls and the filter.
    cluster_numbers : sequence of int
        Numbers of matches for clustering.
    scenes : int
        Scenes per number of matches; one above the largest size of `FIT`.
    kind : str
        Of the scenes, see `benchmarks.scenes.KINDS`.
    plot : str, optional
        File for the log-log plot.
    """
    if min([*numbers, *cluster_numbers], default=2) < 2 or scenes < 1:
        raise ValueError("numbers of matches start at 2, scenes at 1")
    with one_thread():
        calls = measure_calls(numbers, scenes, kind)
        few = [n for n in numbers if n <= MAX_HOPELESS]
        hopeless = measure_calls(few, scenes, kind, inlier_ratio=0.0)
        parted = measure_parts([n for n in numbers if n <= FIT[1]], scenes, kind)
        dense = measure_dense()
        clustering = measure_clustering(cluster_numbers, scenes, kind)
    parts = [
        f"Scenes `{kind}`, {INLIER_RATIO:.0%} inliers, noise {NOISE:g} px, threshold 1 px, "
        f"{scenes} scenes per size; medians of processor time on one thread."
    ]
    if numbers:
        largest = max((n for n in numbers if n <= FIT[1]), default=max(numbers))
        memory = {n: measure_memory(n, kind) for n in sorted({largest, max(numbers)})}
        parts += [
            "## Time, ms\n\n" + _times(calls, numbers),
            f"## Time / {RIVAL}\n\n" + _times(calls, numbers, RIVAL),
            *(
                [f"## Time / {RIVAL}, no match right\n\n" + _times(hopeless, few, RIVAL)]
                if few
                else []
            ),
            "## Error, px\n\n" + _errors(calls, numbers),
            *(["## Error / searching all matches\n\n" + _parts_table(parted)] if parted else []),
            "## Error on optical flow, px\n\n" + _errors(dense, list(dense[RIVAL].ms)),
            "## Peak memory over the input, MB\n\n" + _memory(memory),
        ]
    if cluster_numbers:
        parts += [
            "## Clustering, ms\n\n" + _times(clustering, cluster_numbers),
            f"## Clustering, time / {EXACT}\n\n" + _times(clustering, cluster_numbers, EXACT),
        ]
        if clustering[SAMPLED].errors:
            title = "## Error of rho, |estimated / exact - 1|"
            parts.append(f"{title}\n\n{_errors(clustering, cluster_numbers)}")
    with one_thread():
        parts.append("## Pairs per second / one worker's\n\n" + _speedups(measure_workers(kind)))
        unit = f"estimating a pair of {PAIR_SIZE:,} matches"
        parts.append(f"## Time / {unit}\n\n" + _costs(measure_costs(kind)))
    if plot:
        draw(plot, calls, clustering)
    return "\n\n".join(parts) + "\n"


def measure_calls(
    numbers: Sequence[int], scenes: int, kind: str, inlier_ratio: float = INLIER_RATIO
) -> dict[str, Series]:
    """Time the whole call of each method, and the filter alone on all matches."""
    methods, _ = choose(list(CALLS))
    estimators = {m.name: _with_defaults(m) for m in methods}
    series = {name: Series() for name in (*estimators, SEARCH_ALL, FILTER)}
    warm_up(methods, Settings())
    for n in numbers:
        for pair in _scenes(kind, n, scenes, inlier_ratio):
            for name, estimate in estimators.items():
                _add(series[name], pair, estimate)
            if _estimate.MAX_SEARCHED < n <= MAX_SEARCH_ALL:
                with patch.object(_estimate, "MAX_SEARCHED", n):
                    _add(series[SEARCH_ALL], pair, estimators["ours:USAC_MAGSAC"])
            _add(series[FILTER], pair, lambda pair: contrast_support(pair.X), has_error=False)
    return series


def _with_defaults(method: Method) -> Callable[[Pair], Any]:
    return lambda pair: method.estimate(pair, Settings())


def measure_parts(
    numbers: Sequence[int], scenes: int, kind: str
) -> dict[float, dict[int, tuple[float, float]]]:
    """Hold a search on a part of the matches against one on all of them.

    Returns
    -------
    dict of float to dict of int to (float, float)
        For each inlier ratio and number of matches, geometric means over the scenes: of the error
        as a multiple of the error when all are searched, and likewise when only the part is known.
    """
    methods, _ = choose(["ours:USAC_MAGSAC"])
    estimate = _with_defaults(methods[0])
    found: dict[float, dict[int, tuple[float, float]]] = {}
    for ratio in RATIOS:
        for n in numbers:
            if n <= _estimate.MAX_SEARCHED:
                continue
            multiples = []
            for seed in range(scenes):
                pair = make_scene(kind, n, ratio, NOISE, seed)
                whole = pair.error(estimate(pair))
                with patch.object(_estimate, "MAX_REFINED", _estimate.MAX_SEARCHED):
                    alone = pair.error(estimate(pair))
                with patch.object(_estimate, "MAX_SEARCHED", n):
                    searched = pair.error(estimate(pair))
                multiples.append((whole / searched, alone / searched))
            mean = np.exp(np.log(multiples).mean(axis=0))
            found.setdefault(ratio, {})[n] = float(mean[0]), float(mean[1])
    return found


def dense_pair(stride: int) -> Pair:
    """Match scikit-image's stereo pair by optical flow, on every ``stride``-th pixel both ways.

    The second points of `WRONG` of the matches are shuffled. Truth is the pair's disparity.
    """
    from skimage.data import stereo_motorcycle

    left, right, disparity = stereo_motorcycle()
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right)]
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(*grey, None)
    height, width = grey[0].shape
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    X = np.dstack([pixels, pixels + flow])[::stride, ::stride].reshape(-1, 4)
    rng = np.random.default_rng(0)
    wrong = np.flatnonzero(rng.random(len(X)) < WRONG)
    X[wrong, 2:] = X[rng.permutation(wrong), 2:]
    known = np.isfinite(disparity) & (disparity > 0)
    truth = np.hstack([pixels[known], pixels[known]])[::997]
    truth[:, 2] -= disparity[known][::997]
    size = (width, height)
    return Pair(
        name=f"stride {stride}", group="optical flow", X=rng.permutation(X), scores=None,
        truth=truth, size1=size, size2=size,
    )  # fmt: skip


def measure_dense() -> dict[str, Series]:
    """Estimate F from a real pair's optical flow: as it is, with a part alone, searching all."""
    methods, _ = choose([RIVAL, "ours:USAC_MAGSAC"])
    rival, ours = (_with_defaults(method) for method in methods)
    series = {name: Series() for name in (RIVAL, "ours", "ours, the part alone", SEARCH_ALL)}
    for pair in map(dense_pair, STRIDES):
        n = len(pair.X)
        _add(series[RIVAL], pair, rival)
        _add(series["ours"], pair, ours)
        with patch.object(_estimate, "MAX_REFINED", _estimate.MAX_SEARCHED):
            _add(series["ours, the part alone"], pair, ours)
        if n <= MAX_SEARCH_ALL:
            with patch.object(_estimate, "MAX_SEARCHED", n):
                _add(series[SEARCH_ALL], pair, ours)
    return series


def measure_clustering(numbers: Sequence[int], scenes: int, kind: str) -> dict[str, Series]:
    """Time density peaks beside other ways to cluster matches."""
    from sklearn.cluster import HDBSCAN

    functions: dict[str, Callable[[Pair], object]] = {
        EXACT: lambda pair: density_peaks(pair.X),
        SAMPLED: lambda pair: density_peaks(pair.X, sample_size=SAMPLE_SIZE),
        MATRIX: lambda pair: matrix_density_peaks(pair.X),
        "sklearn HDBSCAN": lambda pair: HDBSCAN(min_cluster_size=10, copy=True).fit(pair.X),
    }
    if find_spec("pydpc") is not None:
        from pydpc import Cluster

        functions["pydpc"] = lambda pair: Cluster(pair.X, autoplot=False)
    # Others that keep all distances meet the memory's end as well.
    sizes = {EXACT: (0, FIT[1]), SAMPLED: (SAMPLE_SIZE + 1, np.inf)}
    sizes["sklearn HDBSCAN"] = (0, MAX_OTHERS)
    series = {name: Series() for name in functions}
    for n in numbers:
        for pair in _scenes(kind, n, scenes):
            for name, function in functions.items():
                low, high = sizes.get(name, (0, MAX_MATRIX))
                if low <= n <= high:
                    _add(series[name], pair, function, has_error=False)
            if SAMPLE_SIZE < n <= FIT[1]:
                estimated = density_peaks(pair.X, sample_size=SAMPLE_SIZE).rho
                exact = density_peaks(pair.X).rho
                some = exact > 0
                error = np.median(np.abs(estimated[some] / exact[some] - 1))
                series[SAMPLED].errors.setdefault(n, []).append(float(error))
    return series


def matrix_density_peaks(X: Floats) -> tuple[Floats, Floats]:
    """Return rho and delta in the obvious way, from the matrix of all distances."""
    D = cdist(X, X)
    n = len(X)
    dc = np.partition(D.ravel(), n + int(0.02 * n * n))[n + int(0.02 * n * n)]
    rho = np.less(D, dc).sum(axis=1) - 1.0
    order = np.argsort(-rho, kind="stable")
    ordered = D[np.ix_(order, order)]
    largest = ordered[0].max()
    ordered[np.triu_indices(n)] = np.inf
    delta = np.empty(n)
    delta[order] = ordered.min(axis=1)
    delta[order[0]] = largest
    return rho, delta


def measure_workers(kind: str) -> dict[str, float]:
    """Give the pairs per second of two workers, by the clock, as a multiple of one's."""
    scenes = [make_scene(kind, PAIR_SIZE, INLIER_RATIO, NOISE, seed).X for seed in range(20)]
    pairs = [(X[:, :2], X[:, 2:]) for X in scenes] * (N_PAIRS // len(scenes))
    workers: dict[str, dict[str, Any]] = {
        "one": {"n_jobs": 1},
        "two processes": {"n_jobs": 2, "backend": "loky"},
        "two threads": {"n_jobs": 2, "backend": "threading"},
    }
    best = dict.fromkeys(workers, np.inf)
    # The first run, not counted, starts the processes.
    for run in range(RUNS + 1):
        for name, options in workers.items():
            start = time.perf_counter()
            list(estimate_many(pairs, progress=False, **options))
            if run:
                best[name] = min(best[name], time.perf_counter() - start)
    return {name: best["one"] / seconds for name, seconds in best.items() if name != "one"}


def measure_costs(kind: str) -> dict[str, float]:
    """Give processor times as multiples of that of estimating a pair of `PAIR_SIZE` matches."""

    def estimate(pair: Pair) -> object:
        return estimate_fundamental(pair.X[:, :2], pair.X[:, 2:])

    numbers = (PAIR_SIZE // 2, PAIR_SIZE, 10 * PAIR_SIZE)
    pairs = Series()
    for n in numbers:
        for pair in _scenes(kind, n, N_COSTED):
            _add(pairs, pair, estimate, has_error=False)
    unit = pairs.time(PAIR_SIZE)
    costs = {f"estimating a pair of {n:,}": pairs.time(n) / unit for n in numbers}
    points = [(pair.X[:, :2], pair.X[:, 2:]) for pair in _scenes(kind, PAIR_SIZE, N_COSTED)]
    handed = points * (N_PAIRS // N_COSTED)
    # The first run, not counted, starts the processes.
    for _ in range(2):
        start = time.process_time()
        list(estimate_many(handed, progress=False, n_jobs=2, backend="loky"))
        ms = 1e3 * (time.process_time() - start)
    costs[f"handing a pair of {PAIR_SIZE:,} to another process"] = ms / len(handed) / unit
    photographs = motorcycle()
    # The first call touches cold memory.
    for _ in range(2):
        start = time.process_time()
        n = len(match_images(photographs.image1, photographs.image2).X)
        ms = 1e3 * (time.process_time() - start)
    costs[f"finding {n:,} matches of two photographs by SIFT"] = ms / unit
    return costs


def _scenes(kind: str, n: int, scenes: int, inlier_ratio: float = INLIER_RATIO) -> Iterable[Pair]:
    for seed in range(scenes if n <= FIT[1] else 1):
        yield make_scene(kind, n, inlier_ratio, NOISE, seed)


def _add(series: Series, pair: Pair, call: Callable[[Pair], Any], has_error: bool = True) -> None:
    n = len(pair.X)
    times = []
    for _ in range(2):
        start = time.process_time()
        result = call(pair)
        times.append(1e3 * (time.process_time() - start))
    series.ms.setdefault(n, []).append(min(times))
    if has_error:
        series.errors.setdefault(n, []).append(pair.error(result))


def measure_memory(n: int, kind: str) -> dict[str, float]:
    """Peak memory of each call over the process with its input, MB; NaN where unknown."""
    pair = make_scene(kind, n, INLIER_RATIO, NOISE, 0)
    context = multiprocessing.get_context("spawn")
    peaks = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "X.npy"
        np.save(path, pair.X)
        for name in (*CALLS, EXACT if n <= FIT[1] else SAMPLED):
            # A process of its own: memory that was freed before would hide a peak.
            with context.Pool(1) as pool:
                peaks[name] = pool.apply(_peak, (name, str(path)))
    return peaks


def _peak(name: str, path: str) -> float:
    def call(X: Floats) -> None:
        if name in (EXACT, SAMPLED):
            density_peaks(X, sample_size=SAMPLE_SIZE if name == SAMPLED else None)
            return
        pair = Pair(name="", group="", X=X, scores=None, truth=X, size1=(0, 0), size2=(0, 0))
        METHODS[name].estimate(pair, Settings())

    call(make_scene("clusters", 200, 0.5, 0.5).X)
    X = np.load(path)
    try:
        Path("/proc/self/clear_refs").write_text("5")
        before = _status("VmRSS")
        call(X)
        return (_status("VmHWM") - before) / 1024
    except OSError:
        return float("nan")


def _status(name: str) -> int:
    """Memory of this process as Linux has it, KiB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(name)).split()[1])


def _cell(value: float, form: str) -> str:
    return "" if np.isnan(value) else format(value, form)


def _times(
    series: Mapping[str, Series], numbers: Sequence[int], reference: str | None = None
) -> str:
    """Give ms, or multiples of another's; in brackets what the matrix would take."""
    header = ["", *(f"N = {n:,}" for n in numbers), "exponent"]
    body = []
    for name, s in series.items():
        row = [name]
        for n in numbers:
            ms, form = s.time(n), "{}"
            if name == MATRIX and s.ms and np.isnan(ms):
                last = max(s.ms)
                ms, form = s.time(last) * (n / last) ** 2, "({})"
            if reference is None:
                cell = _cell(ms, ".1f")
            else:
                cell = _two_digits(ms / series[reference].time(n))
            row.append(form.format(cell) if cell else "")
        body.append([*row, _cell(s.exponent, ".2f")])
    return table(header, body)


def _two_digits(ratio: float) -> str:
    """No more, for times differ that much from run to run."""
    return _cell(ratio, ".0f" if ratio >= 10 else ".1f" if ratio >= 1 else ".2f")


def _errors(series: Mapping[str, Series], numbers: Sequence[int]) -> str:
    body = (
        [name, *(_cell(s.error(n), ".3f") for n in numbers)]
        for name, s in series.items()
        if s.errors
    )
    return table(["median over the scenes", *(f"N = {n:,}" for n in numbers)], body)


def _parts_table(parted: Mapping[float, Mapping[int, tuple[float, float]]]) -> str:
    numbers = list(next(iter(parted.values())))
    body = []
    for k, name in enumerate(("all vote", "only the part that is searched votes")):
        for ratio, row in parted.items():
            body.append([f"{name}, {ratio:.0%} inliers", *(f"{row[n][k]:.2f}" for n in numbers)])
    header = ["geometric mean over the scenes", *(f"N = {n:,}" for n in numbers)]
    return table(header, body)


def _speedups(found: Mapping[str, float]) -> str:
    header = [f"{N_PAIRS} pairs of {PAIR_SIZE:,} matches", "by the clock"]
    return table(header, [[name, f"{ratio:.2f}"] for name, ratio in found.items()])


def _costs(costs: Mapping[str, float]) -> str:
    return table(["", "processor time"], [[name, _two_digits(x)] for name, x in costs.items()])


def _memory(memory: Mapping[int, Mapping[str, float]]) -> str:
    names = list(dict.fromkeys(name for peaks in memory.values() for name in peaks))
    body = (
        [name, *(_cell(peaks.get(name, np.nan), ".0f") for peaks in memory.values())]
        for name in names
    )
    return table(["", *(f"N = {n:,}" for n in memory)], body)


def draw(path: str, calls: Mapping[str, Series], clustering: Mapping[str, Series]) -> None:
    """Draw time over the number of matches, both logarithmic."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 6), layout="constrained")
    panels = [
        (title, series)
        for title, series in (("estimating F", calls), ("clustering", clustering))
        if any(s.ms for s in series.values())
    ]
    for ax, (title, series) in zip(
        np.atleast_1d(figure.subplots(1, len(panels))), panels, strict=True
    ):
        for name, s in series.items():
            if not s.ms:
                continue
            n = sorted(s.ms)
            ours = name.startswith(("ours", "density_peaks", FILTER))
            label = name if np.isnan(s.exponent) else f"{name} ({s.exponent:.2f})"
            ax.loglog(
                n,
                [s.time(k) for k in n],
                "o-" if ours else "s--",
                lw=2 if ours else 1.3,
                ms=4,
                label=label,
            )
        ax.set_title(f"{title} (exponent)")
        ax.set_xlabel("matches")
        ax.set_ylabel("time, ms")
        ax.grid(color="0.9", which="both")
        ax.set_axisbelow(True)
        # Below: curves rise through every corner.
        ax.legend(fontsize=8.5, frameon=False, loc="upper left", bbox_to_anchor=(0.0, -0.12))
    figure.savefig(path, dpi=100)
