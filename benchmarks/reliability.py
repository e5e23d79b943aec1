"""Does it hold: random calls beside cv2, under load, over many calls, and for odd coordinates."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.report import table
from benchmarks.scenes import make_scene
from compat.cases import DOUBLES, INTEGERS, METHODS, NO_DOUBLES, NO_INTEGERS, Case, halves, params
from compat.differences import differences
from compat.implementation import reference
from compat.outcomes import Outcome, observe
from compat.rules import USAC, rule_of, wrong_flags
from compat.scenes import DEGENERATE, degenerate, scene
from cv_densityf import estimate_fundamental, findFundamentalMat
from cv_densityf.estimators import FundamentalMatrixEstimator

Floats = NDArray[np.float64]

# ------------------------------------------------------------------------------ beside cv2

_LAYOUTS: dict[str, Callable[[NDArray[np.float32]], Any]] = {
    "float64": lambda p: p.astype(np.float64),
    "int32": lambda p: p.astype(np.int32),
    "(N, 1, 2)": lambda p: p[:, None],
    "(1, N, 2)": lambda p: p[None],
    "(2, N)": lambda p: np.ascontiguousarray(p.T),
    "(N, 3)": lambda p: np.hstack([p, np.ones_like(p[:, :1])]),
    "Fortran order": np.asfortranarray,
    "reversed view": lambda p: p[::-1].copy()[::-1],
    "UMat": cv2.UMat,
    "list": lambda p: p.tolist(),
}
_MASKS: dict[str, Callable[[int], Any]] = {
    "(N, 1)": lambda n: np.full((n, 1), 9, np.uint8),
    "(N,)": lambda n: np.full(n, 9, np.uint8),
    "(1, N)": lambda n: np.full((1, n), 9, np.uint8),
    "too long": lambda n: np.full((n + 1, 1), 9, np.uint8),
    "int32": lambda n: np.full((n, 1), 9, np.int32),
    "float64": lambda n: np.full((n, 1), 9, np.float64),
    "a number": lambda n: 1,
    "list": lambda n: [0] * n,
    "str": lambda n: "mask",
}
_NUMBERS = ("ransacReprojThreshold", "confidence", "maxIters")


def random_case(seed: int) -> Case:
    """Draw a call: most are ordinary, some are odd in one way, few in several."""
    rng = np.random.default_rng(seed)

    def pick(table: Any) -> Any:
        return table[int(rng.integers(len(table)))]

    def sometimes(share: float) -> bool:
        return bool(rng.random() < share)

    n = int(rng.integers(21)) if sometimes(0.2) else round(np.exp(rng.uniform(2.7, 6.7)))
    X = scene(n, rng.uniform(0.2, 1.0), rng.uniform(0.0, 1.5), seed)[0]
    about = ["scene"]
    if sometimes(0.15):
        about = [pick(DEGENERATE)]
        X = degenerate(about[0], n)
    if sometimes(0.1) and n:
        about.append("not finite")
        X[rng.random(n) < 0.2, rng.integers(4)] = pick((np.nan, np.inf, -np.inf))
    first, second = points = halves(X)
    plain = True
    if sometimes(0.3):
        layouts = list(_LAYOUTS)
        about.append(pick(layouts))
        plain = about[-1] not in ("int32", "list")
        with np.errstate(invalid="ignore"):
            first, second = (_LAYOUTS[about[-1]](p) for p in points)
    if sometimes(0.02):
        about.append("one point short")
        second = points[1][:-1]

    name = pick(list(METHODS))
    method = METHODS[name]
    if sometimes(0.05):
        method = int(rng.integers(-10, 70))
        name = str(method)
    threshold = float(pick((0.3, 1.0, 2.0, 3.0, 10.0)) if sometimes(0.9) else rng.normal(0, 1e3))
    confidence = float(rng.uniform(0.5, 0.999) if sometimes(0.95) else rng.uniform(-1, 2))
    iterations = int(rng.integers(50, 500) if sometimes(0.95) else rng.integers(-2, 50))
    keywords: dict[str, Any] = {}
    if method is None:
        made = params(threshold=threshold, confidence=confidence, maxIterations=iterations)
        made.randomGeneratorState = int(rng.integers(-(2**31), 2**31))
        made.sampler, made.score = int(rng.integers(4)), int(rng.integers(4))
        made.loMethod = int(rng.integers(5))
        arguments: list[Any] = [first, second, made]
    else:
        numbers: list[Any] = [threshold, confidence, iterations]
        third: Any = method
        if sometimes(0.1):
            odd = int(rng.integers(4))
            tables = (INTEGERS, DOUBLES) if sometimes(0.5) else (NO_INTEGERS, NO_DOUBLES)
            key = pick(list(tables[odd in (1, 2)]))
            value = tables[odd in (1, 2)][key]
            if not (odd == 3 and key in ("largest", "huge")):  # hours
                about.append(f"{('method', *_NUMBERS)[odd]} {key}")
                if odd:
                    numbers[odd - 1] = value
                else:
                    third = method = value
                plain = False
        given = int(rng.integers(4)) if sometimes(0.4) else 3
        by_name = int(rng.integers(given + 1)) if sometimes(0.3) else 0
        arguments = [first, second, third, *numbers[: given - by_name]]
        keywords = dict(
            zip(_NUMBERS[given - by_name : given], numbers[given - by_name :], strict=False)
        )
        if given < 1:
            threshold = 3.0
    if sometimes(0.25):
        key = pick(list(_MASKS))
        about.append(f"mask {key}")
        keywords["mask"] = None
    if sometimes(0.01):
        about.append("unknown keyword")
        keywords["prob"] = 0.5

    def build() -> tuple[tuple[Any, ...], dict[str, Any]]:
        fresh = {"mask": _MASKS[key](n)} if "mask" in keywords else {}
        return tuple(arguments), {**keywords, **fresh}

    integer = isinstance(method, int)
    usac = method is None or (integer and method in USAC)
    finite = bool(np.isfinite(X).all())
    rule = rule_of(method, n) if method is None or integer else None
    direct = integer and not usac and (n == 7 or (n > 7 and method == cv2.FM_8POINT))
    return Case(
        f"{seed}: {name}, n={n}, {', '.join(about)}",
        build,
        direct=direct and plain and finite,
        X=X if plain else None,
        # The rank of the median among residuals that are no numbers is cv2's secret.
        rule=None if not plain or (rule == "lmeds" and not finite) else rule,
        threshold=threshold,
    )


@dataclass
class Tally:
    """What came of the calls."""

    counts: Counter[str] = field(default_factory=Counter)
    unexpected: list[str] = field(default_factory=list)

    def add(self, case: Case, ours: Outcome, cv2s: Outcome) -> None:
        """Sort one pair of outcomes."""
        self.counts[cv2s.kind] += 1
        found = differences(case, ours, cv2s)
        reason = _explained(found, ours, cv2s)
        if reason:
            self.counts[reason] += 1
        elif found:
            self.counts["other"] += 1
            self.unexpected += [f"{case.id} [{name}] {text}" for name, text in found.items()]
        else:
            self.counts["same"] += 1
        if ours.F is not None and case.rule is not None and ours.F.shape == (3, 3):
            wrong = wrong_flags(ours.F, case.X, ours.mask, case.rule, case.threshold)
            self.counts["masks"] += 1
            self.counts["right masks"] += wrong == 0
            if wrong:
                self.unexpected.append(f"{case.id} [flags] {wrong} are not the rule's")


_MORE, _LESS = "F where cv2 finds none", "no F where cv2 finds one"
_SOLVED = "an answer where cv2's solver raises"
_ZEROED = "no F, and the given mask set to zero, which cv2 leaves as it was"


def _explained(found: dict[str, str], ours: Outcome, cv2s: Outcome) -> str:
    """Which of the differences that are meant to be this is."""
    if ours.kind == "answer" == cv2s.kind:
        if found.keys() == {"mask="} and ours.F is None and cv2s.F is None:
            return _ZEROED
        if "F" in found and (ours.F is None) != (cv2s.F is None):
            return _LESS if ours.F is None else _MORE
    if found.keys() == {"outcome"} and cv2s.code == cv2.Error.StsAssert:
        return _SOLVED
    return ""


def beside_cv2(n: int, seed: int = 0) -> str:
    """Make ``n`` random calls of both functions, and return what came of them as markdown."""
    tally = Tally()
    for i in tqdm(range(n), desc="calls", disable=None):
        case = random_case(seed + i)
        tally.add(case, observe(findFundamentalMat, case), observe(reference, case))
    count = tally.counts
    rows = [
        ("calls", n),
        ("which cv2 answers", count["answer"]),
        ("which cv2 refuses", count["error"]),
        ("same kind of answer, or the same refusal", count["same"]),
        *((reason, count[reason]) for reason in (_MORE, _LESS, _SOLVED, _ZEROED)),
        ("any other difference", count["other"]),
        ("masks that can be worked out from F", count["masks"]),
        ("masks that are so, bit for bit", count["right masks"]),
    ]
    text = table([f"beside cv2 {cv2.__version__}", ""], [[k, f"{v:,}"] for k, v in rows])
    return "\n".join([text, *(f"\n{line}" for line in tally.unexpected[:50])])


# ------------------------------------------------------------------------------ under load


def _jobs() -> list[Callable[[], Any]]:
    """Make a list of calls, of every entry and method, that answer the same each time."""
    jobs: list[Callable[[], Any]] = []
    for i, method in enumerate(m for m in METHODS.values() if m not in (1, None)):
        X = make_scene("clusters", 150 + 30 * i, 0.5, 0.5, i).X
        one, two = X[:, :2].copy(), X[:, 2:].copy()
        jobs += [
            lambda a=one, b=two, m=method: findFundamentalMat(a, b, m, 1.0, 0.99, 300),
            lambda a=one, b=two, m=method: _told(
                estimate_fundamental(a, b, method=m, density="paper", max_iters=100)
            ),
            lambda a=one, b=two, m=method: _told(estimate_fundamental(a, b, method=m)),
        ]
        jobs.append(lambda X=X, m=method: FundamentalMatrixEstimator(method=m).fit(X).F_)
    degenerate_points = degenerate("line in both", 60)
    jobs.append(lambda: findFundamentalMat(*halves(degenerate_points), cv2.FM_RANSAC))
    jobs.append(lambda: findFundamentalMat(one, two, params(randomGeneratorState=5)))
    jobs.append(lambda: findFundamentalMat(one, two[:-1], cv2.FM_RANSAC))
    return jobs


def _told(estimate: Any) -> tuple[Any, ...]:
    return estimate.F, estimate.mask, estimate.kept, estimate.votes, estimate.reason


def _digest(job: Callable[[], Any]) -> str:
    """Digest of an answer, or of the error's code."""
    try:
        answer = job()
    except cv2.error as error:
        return f"error {error.code}"
    parts = answer if isinstance(answer, tuple) else (answer,)
    content = b"|".join(
        p.tobytes() if isinstance(p, np.ndarray) else repr(p).encode() for p in parts
    )
    return hashlib.sha256(content).hexdigest()


def _load(expected: Sequence[str], seconds: float, n_threads: int, seed: int) -> tuple[int, int]:
    """Call from several threads at once; number of calls, and of answers not as expected."""
    jobs, end = _jobs(), time.monotonic() + seconds

    def work(number: int) -> tuple[int, int]:
        rng = np.random.default_rng((seed, number))
        calls = wrong = 0
        while time.monotonic() < end:
            i = int(rng.integers(len(jobs)))
            calls += 1
            wrong += _digest(jobs[i]) != expected[i]
        return calls, wrong

    with ThreadPoolExecutor(n_threads) as pool:
        done = list(pool.map(work, range(n_threads)))
    return sum(calls for calls, _ in done), sum(wrong for _, wrong in done)


def under_load(seconds: float, n_threads: int = 8, n_processes: int = 4) -> str:
    """Call from threads of several processes at once, and compare with what one alone answers."""
    expected = [_digest(job) for job in _jobs()]
    with multiprocessing.get_context("spawn").Pool(n_processes) as pool:
        # The processes start before the clock does.
        pool.starmap(_load, [(expected, 0.0, 1, 0)] * n_processes)
        done = pool.starmap(_load, [(expected, seconds, n_threads, i) for i in range(n_processes)])
    rows = [
        ("processes, of so many threads", f"{n_processes}, {n_threads}"),
        ("seconds", f"{seconds:g}"),
        ("different calls", f"{len(expected)}"),
        ("calls", f"{sum(calls for calls, _ in done):,}"),
        ("answers that differ in a bit from the same call alone", f"{sum(w for _, w in done):,}"),
    ]
    return table(["under load", ""], rows)


# ------------------------------------------------------------------------------ memory


def resident() -> float:
    """Memory of this process, MB; NaN where Linux does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return float("nan")
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def memory(n: int) -> str:
    """Make ``n`` calls, and say what the process holds on the way."""
    jobs, marks = _jobs(), {}
    wanted = {n * share // 100: share for share in (5, 10, 25, 50, 75, 100)}
    for i in tqdm(range(1, n + 1), desc="memory", disable=None):
        _digest(jobs[i % len(jobs)])
        if i in wanted:
            marks[i] = resident()
    header = ["calls", *(f"{i:,}" for i in marks)]
    return table(header, [["memory of the process, MB", *(f"{mb:.1f}" for mb in marks.values())]])


# ------------------------------------------------------------------------------ coordinates


def _similar(factor: float = 1.0, degrees: float = 0.0, x: float = 0.0, y: float = 0.0) -> Floats:
    c, s = factor * np.cos(np.deg2rad(degrees)), factor * np.sin(np.deg2rad(degrees))
    return np.array([[c, -s, x], [s, c, y], [0.0, 0.0, 1.0]])


_SAME = _similar()
#: Maps of the first and the second image, and the threshold.
MAPS: dict[str, tuple[Floats, Floats, float]] = {
    "as it is": (_SAME, _SAME, 1.0),
    **{
        f"times {text}": (_similar(float(text)), _similar(float(text)), min(float(text), 9e5))
        for text in ("1e-3", "1e3", "1e6")
    },
    "second image a million pixels away": (_SAME, _similar(x=1e6, y=-1e6), 1.0),
    "both images a million pixels away": (_similar(x=-1e6), _similar(x=1e6, y=-1e6), 1.0),
    "second image turned and twice as large": (_SAME, _similar(2.0, 130.0, 50.0, -900.0), 1.0),
    "second image in units of 800 px": (_SAME, _similar(1 / 800), 1.0),
}
#: Rows that are added.
ADDED: dict[str, Callable[[Floats, np.random.Generator], Floats]] = {
    "every match four times more": lambda X, rng: np.tile(X, (4, 1)),
    "one wrong match 500 times": lambda X, rng: np.tile(rng.uniform(0, 900, (1, 4)), (500, 1)),
    "one wrong match 2,000 times": lambda X, rng: np.tile(rng.uniform(0, 900, (1, 4)), (2000, 1)),
    "500 lost tracks that end in one point": lambda X, rng: np.hstack(
        [rng.uniform(0, 900, (500, 2)), np.full((500, 2), -1.0)]
    ),
    **{
        f"25 matches up to 1e{k} px away": lambda X, rng, k=k: rng.uniform(-(10**k), 10**k, (25, 4))
        for k in (4, 5, 6, 9)
    },
}
ESTIMATORS: dict[str, Callable[[Floats, Floats, float], Any]] = {
    f"{whose} {name}": (
        lambda one, two, t, call=call, name=name: call(one, two, METHODS[name], t, 0.999, 5000)[0]
    )
    for name in ("FM_RANSAC", "FM_LMEDS", "USAC_ACCURATE", "USAC_MAGSAC")
    for whose, call in (("cv2", reference), ("ours", findFundamentalMat))
}


def coordinates(scenes: int) -> str:
    """Median error of F, mapped back, for each change of the coordinates."""
    body = []
    pairs = [make_scene("clusters", 500, 0.6, 0.5, seed) for seed in range(scenes)]
    changes: list[tuple[str, Any]] = [*MAPS.items(), ("images swapped", None), *ADDED.items()]
    for name, change in tqdm(changes, desc="coordinates", disable=None):
        row = [name]
        for estimate in ESTIMATORS.values():
            errors = []
            for seed, pair in enumerate(pairs):
                X, first, second, threshold = pair.X, _SAME, _SAME, 1.0
                if change is None:
                    X = X[:, [2, 3, 0, 1]]
                elif callable(change):
                    X = np.vstack([X, change(X, np.random.default_rng(seed))])
                else:
                    first, second, threshold = change
                one = X[:, :2] @ first[:2, :2].T + first[:2, 2]
                two = X[:, 2:] @ second[:2, :2].T + second[:2, 2]
                try:
                    F = estimate(one, two, threshold)
                except cv2.error:
                    F = None
                if F is not None:
                    F = F.T if change is None else second.T @ F @ first
                errors.append(pair.error(F))
            error = float(np.median(errors))
            row.append("lost" if error > 20 else f"{error:.2f}")
        body.append(row)
    text = table(["median error, px", *ESTIMATORS], body)
    return f"{text}\n\n{scenes} scenes; lost: above 20 px, an exception, or no F."


def reliability(calls: int, seconds: float, repeats: int, scenes: int, seed: int = 0) -> str:
    """Run everything with these sizes, leaving out what has none, and return it as markdown.

    Parameters
    ----------
    calls : int
        Random calls beside cv2.
    seconds : float
        Of load.
    repeats : int
        Calls over which memory is watched.
    scenes : int
        Scenes for each change of the coordinates.
    seed : int
        Of the random calls.
    """
    if min(calls, seconds, repeats, scenes) < 0:
        raise ValueError("numbers of calls, seconds, repeats and scenes start at 0")
    parts = []
    if calls:
        parts.append("## Random calls beside cv2\n\n" + beside_cv2(calls, seed))
    if seconds:
        parts.append("## Threads and processes\n\n" + under_load(seconds))
    if repeats:
        parts.append("## Memory\n\n" + memory(repeats))
    if scenes:
        parts.append("## Coordinates\n\n" + coordinates(scenes))
    return "\n\n".join(parts) + "\n"
