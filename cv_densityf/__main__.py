"""The command line: ``cv-densityf`` and ``python -m cv_densityf``."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import metadata
from pathlib import Path
from typing import Any, NoReturn

import cv2
import numpy as np
from numpy.typing import NDArray

import cv_densityf
from cv_densityf._arguments import DENSITIES, THRESHOLDS, DensityRule
from cv_densityf._engine import METHODS, Robust, has_threshold, method_flag, short_name
from cv_densityf._epipolar import Floats, residuals
from cv_densityf._estimate import (
    MIN_FILTERED,
    MINIMAL,
    Estimate,
    estimate_fundamental,
    finite_in_cv2,
)
from cv_densityf._files import InputError, read_matches, replacing
from cv_densityf._prefilter import COHERENT
from cv_densityf._run_script import add_run, run_script
from cv_densityf.matching import (
    MAX_FEATURES,
    MAX_SIZE,
    detect,
    match_features,
    match_images,
    read_image,
)

FOUND, NOT_FOUND, WRONG_USE = 0, 1, 2
#: Each method is timed this often, unless that takes longer than so many milliseconds.
_TIMED_TURNS = 3
_LONG = 1000.0
#: More points than this make a decision graph neither clearer nor quickly.
_MAX_GRAPH_POINTS = 10_000
_DEMO_ORDERS = 10


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    arguments : sequence of str, optional
        By default those the process was started with.

    Returns
    -------
    int
        Exit code: 0 found, 1 no fundamental matrix found, 2 wrong use.
    """
    options, unknown = _parser().parse_known_args(arguments)
    if options.run == _run_match and not any(word.startswith("-") for word in unknown):
        # Of images with options between them argparse takes the first only.
        options.images += unknown
    elif unknown:
        # By the command's own parser, whose help has the options.
        options.error(f"unknown: {' '.join(unknown)}")
    if options.run == run_script:
        # Outside of the handlers: what the program raises is not ours to explain.
        return run_script(options)
    try:
        return int(options.run(options))
    except OSError as error:
        where = f"{error.filename}: " if error.filename is not None else ""
        return _complain(f"{where}{error.strerror or error}", WRONG_USE)
    except (InputError, ImportError) as error:
        return _complain(str(error), WRONG_USE)
    except MemoryError:
        return _complain("not enough memory for this input", WRONG_USE)
    except KeyboardInterrupt:
        return _complain("interrupted", 130)


def _complain(message: str, code: int) -> int:
    _warn(f"cv-densityf: {message}\n")
    return code


def _warn(text: str) -> None:
    # To print into None would be to print to standard output.
    if sys.stderr is not None:
        with suppress(OSError):
            print(text, end="", file=sys.stderr, flush=True)


def _say(*words: object, sep: str = " ") -> None:
    """Print, and do without where the reader, such as `head`, has had enough."""
    text = sep.join(map(str, words))
    try:
        print(text, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except UnicodeEncodeError:  # such as a path of other letters than the terminal's
        encoding = sys.stdout.encoding
        print(text.encode(encoding, "backslashreplace").decode(encoding), flush=True)


class _Parser(argparse.ArgumentParser):
    """A parser that complains in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(WRONG_USE, f"{self.prog}: {message} (see {self.prog} --help)\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="cv-densityf",
        description="Fundamental matrices from the density of matches.",
        epilog="Exit code: 0 found, 1 no fundamental matrix found, 2 wrong use.",
    )
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    _add_match(commands)
    _add_demo(commands)
    add_run(commands)
    _add_verify(commands)
    version = commands.add_parser("version", help="print versions, for a bug report")
    version.set_defaults(run=_run_version, error=version.error)
    parser.add_argument(
        "--version", action="version", version=f"cv-densityf {cv_densityf.__version__}"
    )
    return parser


def _number(
    kind: Callable[[str], float], accepts: Callable[[float], bool], meaning: str
) -> Callable[[str], float]:
    """Make an argparse type that accepts some numbers and names them where it refuses."""

    def parse(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = float("nan")
        if not accepts(value):
            raise argparse.ArgumentTypeError(f"{text!r} is not {meaning}")
        return value

    return parse


_THRESHOLD = _number(
    float,
    lambda v: THRESHOLDS[0] < v < THRESHOLDS[1],
    "a positive number between {:g} and {:,.0f}".format(*THRESHOLDS),
)
_POSITIVE_INT = _number(int, lambda v: 0 < v < 2**31, "a whole number from 1 to 2147483647")
_JOBS = _number(int, lambda v: 0 < abs(v) < 2**31, "a whole number of pairs, or -1 for all cores")
_SEED = _number(int, lambda v: 0 <= v < 2**31, "a whole number from 0 to 2147483647")
_SHARE = _number(float, lambda v: 0 < v < 1, "a number between 0 and 1")
_RATIO = _number(float, lambda v: 0 < v <= 1, "a number above 0 and up to 1")
_ALPHA = _number(float, lambda v: 0 <= v <= 1, "a number from 0 to 1")


def _output(*suffixes: str) -> Callable[[str], Path]:
    def parse(text: str) -> Path:
        path = Path(text)
        if path.suffix.lower() not in suffixes:
            raise argparse.ArgumentTypeError(f"{text!r} does not end in {' or '.join(suffixes)}")
        if not path.parent.is_dir():
            raise argparse.ArgumentTypeError(f"the folder of {text!r} does not exist")
        return path

    return parse


def _add_method(parser: argparse._ActionsContainer, threshold: float, remark: str = "") -> None:
    parser.add_argument(
        "--method",
        type=short_name,
        choices=METHODS,
        default="usac_accurate",
        metavar="NAME",
        help=f"cv2's method: {', '.join(METHODS)} (%(default)s)",
    )
    parser.add_argument(
        "--threshold",
        metavar="PX",
        type=_THRESHOLD,
        default=threshold,
        help=f"for inliers, pixels (%(default)s{remark})",
    )


def _add_match(commands: argparse._SubParsersAction[Any]) -> None:
    match = commands.add_parser(
        "match",
        help="match two images, or take matches from a file, and estimate F",
        description="Match two images, or take matches from a file, and estimate the fundamental "
        "matrix F with [x', y', 1] F [x, y, 1]' = 0. Plain cv2's result stands beside it.",
    )
    match.add_argument("images", nargs="*", metavar="LEFT RIGHT", help="the two images")
    match.add_argument(
        "--points",
        metavar="FILE",
        help=".npz with points1 and points2 (or pts1 and pts2), (n, 2), and optionally scores "
        "(n,), or .csv with the columns x,y,x',y' and optionally score; instead of images",
    )
    estimate = match.add_argument_group("estimate")
    _add_method(estimate, 1.0)
    estimate.add_argument(
        "--confidence",
        metavar="P",
        type=_SHARE,
        default=0.999,
        help="of each draw to have found the best F (%(default)s)",
    )
    estimate.add_argument(
        "--max-iters",
        metavar="N",
        type=_POSITIVE_INT,
        default=5000,
        help="most samples of a draw, of which the default rule's takes 1000 (%(default)s)",
    )
    estimate.add_argument(
        "--density",
        choices=DENSITIES,
        default="contrast",
        help="how the dense matches are chosen (%(default)s; paper is there for comparison: slower "
        "and less accurate)",
    )
    estimate.add_argument(
        "--alpha", metavar="A", type=_ALPHA, help=f"of --density paper ({DensityRule.alpha})"
    )
    estimate.add_argument(
        "--seed", metavar="N", type=_SEED, default=0, help="of the random samples (%(default)s)"
    )
    matching = match.add_argument_group("matching, for images")
    matching.add_argument(
        "--ratio",
        metavar="R",
        type=_RATIO,
        help="Lowe's ratio test, such as 0.8 (keep all matches)",
    )
    matching.add_argument(
        "--max-features", metavar="N", type=_POSITIVE_INT, help=f"per image ({MAX_FEATURES})"
    )
    matching.add_argument(
        "--max-size",
        metavar="PX",
        type=_POSITIVE_INT,
        help=f"shrink images to this longer side, pixels ({MAX_SIZE})",
    )
    output = match.add_argument_group("output")
    output.add_argument("--json", action="store_true", help="print JSON, and nothing else")
    output.add_argument(
        "-o",
        "--output",
        type=_output(".npz", ".json"),
        metavar="OUT",
        help="write F, mask and matches to OUT.npz or OUT.json",
    )
    output.add_argument(
        "--plot",
        type=_output(".png"),
        metavar="OUT.png",
        help="draw matches, epipolar lines and the decision graph",
    )
    match.set_defaults(run=_run_match, error=match.error)


def _add_demo(commands: argparse._SubParsersAction[Any]) -> None:
    demo = commands.add_parser(
        "demo",
        help="compare with cv2 on a real pair whose F is known",
        description="Estimate F of a real pair whose F is known, print its error beside cv2's and "
        "draw what was done. Needs no network.",
    )
    demo.add_argument(
        "--out",
        type=Path,
        default=Path("cv-densityf-demo"),
        metavar="DIR",
        help="folder for the pictures (%(default)s)",
    )
    demo.set_defaults(run=_run_demo, error=demo.error)


def _add_verify(commands: argparse._SubParsersAction[Any]) -> None:
    verify = commands.add_parser(
        "verify",
        help="verify the matches of a COLMAP database",
        description="Estimate F for every matched image pair of a COLMAP database and write the "
        "two-view geometries, in place of COLMAP's own geometric verification.",
    )
    verify.add_argument("database", metavar="DATABASE", help="with keypoints and matches")
    _add_method(verify, 4.0, ", as COLMAP")
    verify.add_argument(
        "--min-inliers",
        metavar="N",
        type=_number(int, lambda v: 8 <= v < 2**31, "a whole number from 8 to 2147483647"),
        default=15,
        help="a pair with fewer is degenerate (%(default)s, as COLMAP)",
    )
    verify.add_argument(
        "--min-coherence",
        metavar="SHARE",
        type=_number(float, lambda v: v <= 1, "a number up to 1"),
        default=COHERENT,
        help="so is a pair whose inliers keep fewer of their neighbours (%(default)s)",
    )
    verify.add_argument(
        "--jobs",
        metavar="N",
        type=_JOBS,
        default=-1,
        help="pairs at a time, -1 for one per core (%(default)s)",
    )
    verify.add_argument(
        "--resume", action="store_true", help="leave pairs alone that are verified already"
    )
    verify.add_argument("--dry-run", action="store_true", help="estimate, and write nothing")
    verify.set_defaults(run=_run_verify, error=verify.error)


@contextmanager
def _stage(name: str, timings: dict[str, float]) -> Iterator[None]:
    """Time a stage in milliseconds, and name it on the terminal as long as it runs."""
    shown = sys.stderr is not None and sys.stderr.isatty()
    if shown:
        print(f"{name} ...", end="", file=sys.stderr, flush=True)
    start = time.perf_counter()
    try:
        yield
    finally:
        timings[name] = 1e3 * (time.perf_counter() - start)
        if shown:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)


@contextmanager
def _held_back() -> Iterator[list[str]]:
    """Hold back what image decoders print on their own, next to what we are about to say."""
    words: list[str] = []
    try:
        terminal = os.dup(2)
    except OSError:  # there is no standard error
        yield words
        return
    with tempfile.TemporaryFile() as said:
        os.dup2(said.fileno(), 2)
        try:
            yield words
        finally:
            os.dup2(terminal, 2)
            os.close(terminal)
        said.seek(0)
        words.append(said.read().decode(errors="replace"))


def _run_match(options: argparse.Namespace) -> int:
    image_options = ("ratio", "max_features", "max_size")
    if options.points is None and len(options.images) != 2:
        options.error("give two images, or --points FILE")
    if options.points is not None:
        given = [name for name in image_options if getattr(options, name) is not None]
        if options.images or given:
            name = "images" if options.images else f"--{given[0].replace('_', '-')}"
            options.error(f"--points and {name} exclude each other")
    if options.alpha is not None and options.density != "paper":
        options.error("--alpha is of --density paper")
    alpha = DensityRule.alpha if options.alpha is None else options.alpha
    if options.plot is not None:
        from cv_densityf import plotting

        plotting.require_matplotlib()

    timings: dict[str, float] = {}
    images: tuple[NDArray[Any] | None, NDArray[Any] | None] = (None, None)
    words: list[str] = []
    bare: list[str] = []
    scores: Floats | None
    if options.points is not None:
        with _stage("reading", timings):
            X, scores = read_matches(options.points)
    else:
        with _stage("reading", timings), _held_back() as words:
            images = (read_image(options.images[0]), read_image(options.images[1]))
        limits = {
            "max_size": options.max_size or MAX_SIZE,
            "max_features": options.max_features or MAX_FEATURES,
        }
        with _stage("features", timings):
            features = [detect(image, **limits) for image in images if image is not None]
        with _stage("matching", timings):
            matches = match_features(*features, ratio=options.ratio)
        bare = [
            p for p, found in zip(options.images, features, strict=True) if not len(found.points)
        ]
        X, scores = matches.X, matches.scores
    robust = Robust(
        method_flag(options.method), options.threshold, options.confidence, options.max_iters
    )
    calls: dict[str, Callable[[], Any]] = {
        "estimating": lambda: estimate_fundamental(
            X[:, :2],
            X[:, 2:],
            method=options.method,
            threshold=options.threshold,
            confidence=options.confidence,
            max_iters=options.max_iters,
            density=options.density,
            alpha=alpha,
            scores=scores,
            random_state=options.seed,
        )
    }
    n_finite = int(finite_in_cv2(X).sum())
    same_call = n_finite == len(X) and (
        options.density == "off" or robust.direct or n_finite < MIN_FILTERED
    )
    compared = robust.for_size(len(X)) is robust
    if compared and not same_call:
        calls["plain cv2"] = lambda: robust.plain(X[:, :2], X[:, 2:], scores)
    with _stage("estimating", timings):
        results, processor = _timed(calls)
    timings.update(processor)
    estimate = results["estimating"]
    plain = None
    if compared and same_call:
        plain = _plain_report(X, robust, estimate.F, estimate.mask)
    elif compared:
        plain = _plain_report(X, robust, *results["plain cv2"])
    if options.plot is not None and estimate.F is not None and len(estimate.F) > 3:
        raise InputError("seven matches fit several matrices, and --plot draws the lines of one")
    report = {
        "method": options.method,
        "threshold": options.threshold,
        "scores": scores is not None,
        **_report(X, robust, estimate, plain, timings),
    }
    _say(json.dumps(report, allow_nan=False) if options.json else _for_people(report, robust))
    if report["F"] is None:
        reason = "cv2's numbers are not finite" if estimate else estimate.reason
        if n_finite < MINIMAL:
            source = options.points or " and ".join(options.images)
            finite = "" if n_finite == len(X) else "finite "
            reason = f"{source}: {n_finite} {finite}matches, at least {MINIMAL} are needed"
        if bare:
            reason = f"no features in {' and '.join(dict.fromkeys(bare))}"
        return _complain(f"no fundamental matrix found: {reason}", NOT_FOUND)
    if options.output is not None:
        _write(options.output, X, scores, estimate, report)
    if options.plot is not None:
        with _stage("drawing", timings):
            _draw(options.plot, images, X, estimate, alpha if options.density == "paper" else None)
    written = [str(path) for path in (options.output, options.plot) if path is not None]
    if written and not options.json:
        _say(f"\nWritten: {', '.join(written)}")
    # Such as that a JPEG file is damaged, but was of use.
    _warn("".join(words))
    return FOUND


def _timed(calls: dict[str, Callable[[], Any]]) -> tuple[dict[str, Any], dict[str, float]]:
    """Results of the calls, and the processor time of each in milliseconds.

    They take turns, so that a busy moment hits all. The first turn pays for what is set up only
    once, and counts only where it takes so long that this does not matter.
    """
    results: dict[str, Any] = {}
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(1 + _TIMED_TURNS):
        for name, call in calls.items():
            start = time.process_time()
            results[name] = call()
            times[name].append(1e3 * (time.process_time() - start))
        if sum(map(sum, times.values())) > _LONG:
            break
    return results, {name: float(np.median(each[1:] or each)) for name, each in times.items()}


def _report(
    X: Floats,
    robust: Robust,
    estimate: Estimate,
    plain: dict[str, Any] | None,
    timings: dict[str, float],
) -> dict[str, Any]:
    """Everything `match` says, as JSON can hold it."""
    return {
        "F": _usable(estimate.F),
        "reason": estimate.reason,
        "n_matches": len(X),
        "n_ranked": int(np.isfinite(estimate.reliability).sum()),
        "n_kept": int(estimate.kept.sum()),
        "n_inliers": estimate.n_inliers,
        "coherence": _coherence(X[estimate.mask]),
        "median_residual": _median_residual(estimate.F, X[estimate.mask], robust),
        "engine": estimate.engine,
        "n_draws": estimate.n_draws,
        "agreed": estimate.agreed,
        "cv2": plain,
        "timings_ms": {
            **{name: round(value, 3) for name, value in timings.items()},
            "estimating_stages": {
                name: round(float(value), 3) for name, value in estimate.timings.items()
            },
        },
        "versions": {"cv-densityf": cv_densityf.__version__, "opencv": cv2.__version__},
    }


def _plain_report(X: Floats, robust: Robust, F: Floats | None, mask: Any) -> dict[str, Any]:
    inliers = np.zeros(len(X), dtype=bool) if F is None else mask.ravel() > 0
    return {
        "F": _usable(F),
        "n_inliers": int(inliers.sum()),
        "coherence": _coherence(X[inliers]),
        "median_residual": _median_residual(F, X[inliers], robust),
    }


def _usable(F: Floats | None) -> list[list[float]] | None:
    """Rows of ``F``; None as well where cv2 answers with a matrix of NaN."""
    return None if F is None or not np.isfinite(F).all() else F.tolist()


def _coherence(X: Floats) -> float | None:
    value = cv_densityf.coherence(X[:, :2], X[:, 2:])
    return None if np.isnan(value) else value


def _median_residual(F: Floats | None, X: Floats, robust: Robust) -> float | None:
    if F is None or len(X) == 0 or F.shape != (3, 3):
        return None
    with np.errstate(over="ignore"):  # cv2 calls even a point beyond float32 an inlier
        median = float(np.median(residuals(F, X, robust.rule)))
    return median if np.isfinite(median) else None


def _for_people(report: dict[str, Any], robust: Robust) -> str:
    by_threshold = has_threshold(robust.flag)
    times = report["timings_ms"]
    kept, ranked, n = (report[name] for name in ("n_kept", "n_ranked", "n_matches"))
    kept = kept if ranked == n else f"{kept} of {ranked}"
    ours = [kept, *_result(report), f"{times['estimating']:.1f}"]
    names = ["kept as dense", "inliers", "coherence", "median residual, px", "processor time, ms"]
    threshold = f", threshold {report['threshold']:g} px" if by_threshold else ""
    scored = " with scores" if report["scores"] else ""
    lines = [f"{n} match{'es' if n != 1 else ''}{scored}, {report['method']}{threshold}", ""]
    if report["cv2"] is not None and "plain cv2" not in times:
        lines.append(f"{'':<22}{'plain cv2':>12}")
        lines += [f"{name:<22}{a:>12}" for name, a in zip(names[1:], ours[1:], strict=True)]
    else:
        plain = ["-", "not run", "-", "-", "-"]
        if report["cv2"] is not None:
            plain = ["-", *_result(report["cv2"]), f"{times['plain cv2']:.1f}"]
        lines.append(f"{'':<22}{'cv-densityf':>12}{'plain cv2':>12}")
        rows = zip(names, ours, plain, strict=True)
        lines += [f"{name:<22}{a:>12}{b:>12}" for name, a, b in rows]
    stages = {
        **{name: times[name] for name in ("reading", "features", "matching") if name in times},
        **times["estimating_stages"],
    }
    named = ", ".join(f"{name} {value:.1f}" for name, value in stages.items())
    for name, text in (("elapsed, ms", named), ("how", report["reason"])):
        start, indent = f"{name:<22}  ", " " * 24
        lines.append(textwrap.fill(text, 79, initial_indent=start, subsequent_indent=indent))
    coherence, n_inliers = report["coherence"], report["n_inliers"]
    # Without a threshold inliers are many whatever F is.
    trusted = 2 * n_inliers > n if by_threshold else report["agreed"]
    if report["F"] is not None and n_inliers <= MINIMAL + 1:
        lines += ["", f"Some F fits any {MINIMAL} matches: so few inliers say nothing."]
    elif coherence is not None and coherence < COHERENT and not trusted:
        lines += ["", "Images that have nothing in common have inliers of such coherence."]
    if report["F"] is not None:
        rows_of_F = ["  " + "".join(f"{value:>18.9e}" for value in row) for row in report["F"]]
        for first in range(0, len(rows_of_F), 3):
            lines += ["", "F", *rows_of_F[first : first + 3]]
    return "\n".join(lines)


def _result(side: dict[str, Any]) -> tuple[str, str, str]:
    if side["F"] is None:
        return "no F", "-", "-"
    coherence, residual = side["coherence"], side["median_residual"]
    return (
        str(side["n_inliers"]),
        "-" if coherence is None else f"{round(coherence, 2) + 0.0:.2f}",
        "-" if residual is None else f"{residual:.3f}",
    )


def _write(
    path: Path, X: Floats, scores: Floats | None, estimate: Estimate, report: dict[str, Any]
) -> None:
    arrays: dict[str, Any] = {
        "points1": X[:, :2],
        "points2": X[:, 2:],
        "mask": estimate.mask,
        "kept": estimate.kept,
        "reliability": estimate.reliability,
    }
    if scores is not None:
        arrays["scores"] = scores
    with replacing(path) as temporary:
        if path.suffix.lower() == ".npz":
            # To a stream, for to a name that ends in .NPZ it would add another .npz.
            with temporary.open("wb") as stream:
                np.savez(stream, F=np.asarray(estimate.F), **arrays)
        else:
            lists = {name: _finite_or_none(array) for name, array in arrays.items()}
            text = json.dumps({**report, **lists}, allow_nan=False)
            temporary.write_text(text + "\n", encoding="utf-8")


def _finite_or_none(values: NDArray[Any]) -> list[Any]:
    """Nested lists in which None stands for what JSON has no number for."""
    objects = values.astype(object)
    objects[~np.isfinite(values)] = None
    return list(objects.tolist())


def _draw(
    path: Path,
    images: tuple[NDArray[Any] | None, NDArray[Any] | None],
    X: Floats,
    estimate: Estimate,
    alpha: float | None,
) -> None:
    from cv_densityf import plotting
    from cv_densityf._density import density_peaks
    from cv_densityf._paper import relative_gamma

    rows = np.flatnonzero(finite_in_cv2(X))
    n_finite = len(rows)
    step = max(1, -(-len(rows) // _MAX_GRAPH_POINTS))
    rows = rows[::step]
    peaks = density_peaks(X[rows])
    by_rule = np.allclose(estimate.reliability[rows], relative_gamma(peaks))
    figure = plotting.summary_figure(
        *images,
        X[rows],
        np.asarray(estimate.F),
        kept=estimate.kept[rows],
        mask=estimate.mask[rows],
        reliability=estimate.reliability[rows],
        peaks=peaks,
        # Where the rule looked at others than these, its curve does not part them.
        alpha=alpha if by_rule else None,
    )
    if step > 1:
        figure.suptitle(f"1 in {step} of {n_finite} matches shown", fontsize=13)
    with replacing(path) as temporary:
        figure.savefig(temporary)


def _run_demo(options: argparse.Namespace) -> int:
    from cv_densityf import datasets, plotting
    from cv_densityf._density import density_peaks

    if options.out.exists() and not options.out.is_dir():
        options.error(f"--out takes a folder, and {options.out} is a file")
    timings: dict[str, float] = {}
    # Its message names the extra that has all the demo needs.
    with _stage("reading", timings):
        pair = datasets.motorcycle()
    plotting.require_matplotlib()
    options.out.mkdir(parents=True, exist_ok=True)
    with _stage("matching", timings):
        matches = match_images(pair.image1, pair.image2)
    X = matches.X
    right = np.mean(residuals(pair.F, X, "usac") <= 1)
    _say(
        f"Middlebury's pair 'motorcycle', the second image turned by a known homography:\n"
        f"{len(X)} SIFT matches, mutual nearest neighbours, no ratio test. Threshold 1 px.\n"
        f"An easy pair: {right:.0%} of the matches are right.\n"
        f"Error: mean distance of {len(pair.points1)} true correspondences to the epipolar lines,\n"
        f"over {_DEMO_ORDERS} orders of the matches (cv2's results depend on the order).\n"
        f"The truth is known to a tenth of a pixel: smaller errors are as good as each other.\n"
    )
    _say(f"{'':<26}{'error, px':>20}{'inliers':>10}{'processor time, ms':>20}")
    _say(f"{'':<26}{'median':>10}{'worst':>10}{'median':>10}{'median':>20}")
    estimators = dict(_demo_estimators())
    results: dict[str, list[tuple[float, int, float]]] = {name: [] for name in estimators}
    with _stage("comparing", timings):
        for estimate in estimators.values():
            estimate(X, matches.scores)  # what is set up only once is nobody's time
        # In turn, so that a busy moment hits all.
        for seed in range(_DEMO_ORDERS):
            order = np.random.default_rng(seed).permutation(len(X))
            for name, estimate in estimators.items():
                start = time.process_time()
                F, mask = estimate(X[order], matches.scores[order])
                elapsed = 1e3 * (time.process_time() - start)
                results[name].append((pair.error(F), int(np.sum(mask)), elapsed))
    for name, each in results.items():
        errors, inliers, times = np.array(each).T
        _say(
            f"{name:<26}{np.median(errors):>10.3f}{errors.max():>10.3f}"
            f"{np.median(inliers):>10.0f}{np.median(times):>20.1f}"
        )
    found = estimate_fundamental(matches.points1, matches.points2, scores=matches.scores)
    if found.F is None:
        return _complain(f"no fundamental matrix found: {found.reason}", NOT_FOUND)
    F = found.F
    with _stage("drawing", timings):
        images = (pair.image1, pair.image2)
        peaks = density_peaks(X)
        classes: dict[str, Any] = {
            "kept": found.kept,
            "mask": found.mask,
            "reliability": found.reliability,
        }
        drawings: dict[str, tuple[float, Callable[[Any], object]]] = {
            "matches": (
                6,
                lambda ax: plotting.plot_matches(*images, X, **classes, ax=ax),
            ),
            "epipolar_lines": (
                6,
                lambda ax: plotting.plot_epipolar_lines(*images, X, F, found.mask, ax=ax),
            ),
            "decision_graph": (
                7,
                lambda ax: plotting.plot_decision_graph(peaks, **classes, ax=ax),
            ),
        }
        for name, (height, draw) in drawings.items():
            figure = plotting.new_figure(16, height)
            draw(figure.subplots())
            with replacing(options.out / f"{name}.png") as temporary:
                figure.savefig(temporary)
    _say("\nPlots:", *(options.out / f"{name}.png" for name in drawings), sep="\n  ")
    return FOUND


def _demo_estimators() -> Iterator[tuple[str, Callable[[Floats, Floats], tuple[Any, Any]]]]:
    """Names and functions of matches and scores that give F and mask."""

    def ours(X: Floats, scores: Floats | None = None) -> tuple[Any, Any]:
        found = estimate_fundamental(X[:, :2], X[:, 2:], scores=scores)
        return found.F, found.mask

    yield "cv-densityf", lambda X, scores: ours(X)
    yield "cv-densityf, with scores", ours
    for name in ("ransac", "usac_magsac", "usac_accurate"):
        robust = Robust(method_flag(name), 1.0, 0.999, 5000)

        def plain(X: Floats, scores: Floats, robust: Robust = robust) -> tuple[Any, Any]:
            F, mask = robust.plain(X[:, :2], X[:, 2:])
            return F, 0 if mask is None else mask

        yield f"cv2, {name}", plain


def _run_verify(options: argparse.Namespace) -> int:
    from cv_densityf.colmap import verify_matches

    done = verify_matches(
        options.database,
        method=options.method,
        threshold=options.threshold,
        min_inliers=options.min_inliers,
        min_coherence=options.min_coherence,
        n_jobs=options.jobs,
        resume=options.resume,
        dry_run=options.dry_run,
    )
    now = done.n_pairs - done.n_before
    before = f", {done.n_before} more were done before" if options.resume else ""
    _say(
        f"{done.n_verified} of {now} image pairs verified{before}; "
        f"{done.n_inliers} of {done.n_matches} matches are inliers"
    )
    if done.n_few or done.n_incoherent:
        _say(
            f"left out: {done.n_few} with fewer than {options.min_inliers} inliers, "
            f"{done.n_incoherent} whose inliers are incoherent"
        )
    if options.dry_run:
        _say("dry run: nothing was written")
    for image_id1, image_id2, reason in done.failures:
        _complain(f"images {image_id1} and {image_id2}: {reason}", NOT_FOUND)
    return FOUND if done.n_verified or (done.n_before and not done.failures) else NOT_FOUND


def _opencv_packages() -> list[str]:
    """Name the packages that bring a ``cv2``: of two, the last one installed has it."""
    return sorted(set(metadata.packages_distributions().get("cv2", ())))


def _run_version(options: argparse.Namespace) -> int:
    _say(f"cv-densityf {cv_densityf.__version__}")
    _say(f"opencv {cv2.__version__}, from {' and '.join(_opencv_packages()) or 'no package'}")
    for name in ("numpy", "scipy", "scikit-learn", "joblib", "matplotlib", "scikit-image"):
        try:
            _say(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            _say(f"{name} not installed")
    _say(f"python {platform.python_version()} on {platform.platform()}")
    return FOUND


if __name__ == "__main__":
    sys.exit(main())
