"""``python -m benchmarks``: one command for each question, listed by ``--help``."""

from __future__ import annotations

import argparse
import shutil
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from tqdm import tqdm

from benchmarks import report
from benchmarks.data import Pair, load_pairs
from benchmarks.motions import write_pairs
from benchmarks.overlap import overlap
from benchmarks.paper import reproduce
from benchmarks.peers import METHODS, Method, Settings, choose
from benchmarks.run import Record, measure, one_thread, warm_up
from benchmarks.scale import scale
from benchmarks.scenes import KINDS, make_scene, scenes

#: A section of the report, the seed, and the pairs.
Run = tuple[str, int, list[Pair]]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; 2 for arguments that make no sense."""
    args = _parser().parse_args(argv)
    try:
        return int(args.run(args))
    except ValueError as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Estimators of the fundamental matrix side by side.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument(
        "--methods",
        nargs="+",
        default=["*"],
        metavar="NAME",
        help=f"names or shell patterns; default all. Known: {', '.join(METHODS)}",
    )
    shared.add_argument("--threshold", nargs="+", type=float, default=[1.0], metavar="PX")
    shared.add_argument("--confidence", type=float, default=0.999)
    shared.add_argument("--max-iters", type=int, default=5000)
    shared.add_argument(
        "--time-repeats", type=int, default=1, metavar="N", help="call N times, the fastest counts"
    )
    shared.add_argument("--json", metavar="FILE", help="write every record and the summaries")
    shared.add_argument("--plots", metavar="DIR", help="draw error cumulatives and time")

    real = commands.add_parser("real", parents=[shared], help="real pairs with ground truth")
    real.add_argument("--data", required=True, metavar="DIR", help="folder of .npz files")
    real.add_argument(
        "--cut",
        nargs="+",
        default=["all"],
        type=_cut,
        metavar="RATIO",
        help="keep SIFT ratios below this; 'all' keeps everything (default)",
    )
    real.add_argument(
        "--n",
        nargs="+",
        default=[None],
        type=_number,
        metavar="N",
        help="so many matches of each pair, at random; default all",
    )
    real.add_argument("--sets", nargs="+", metavar="SET", help="only these sets")
    real.add_argument(
        "--seed",
        nargs="+",
        type=int,
        default=[0],
        metavar="N",
        help="of the shuffle and of the methods; every pair runs with each of them",
    )
    real.set_defaults(run=_real)

    render = commands.add_parser("render", help="write rendered pairs, as data for real")
    render.add_argument("--out", required=True, metavar="DIR", help="folder of .npz files")
    render.add_argument("--repeats", type=int, default=3, metavar="N", help="of each scene")
    render.add_argument(
        "--dense", action="store_true", help="as a matcher without a detector would match them"
    )
    render.set_defaults(run=_render)

    synthetic = commands.add_parser("synthetic", parents=[shared], help="scenes with a known F")
    synthetic.add_argument("--scenes", nargs="+", choices=KINDS, default=list(KINDS))
    synthetic.add_argument("--n", nargs="+", type=int, metavar="N", help="numbers of matches")
    synthetic.add_argument("--inlier-ratio", nargs="+", type=float, metavar="SHARE")
    synthetic.add_argument("--noise", nargs="+", type=float, metavar="PX")
    synthetic.add_argument(
        "--repeats", type=int, default=10, metavar="N", help="scenes per cell (default 10)"
    )
    synthetic.add_argument("--seed", type=int, default=0, help="of the scenes and of the methods")
    synthetic.set_defaults(run=_synthetic)

    stages = commands.add_parser("stages", help="time of each stage of ours")
    stages.add_argument("--n", nargs="+", type=int, default=[500, 2000, 8000], metavar="N")
    stages.add_argument("--inlier-ratio", type=float, default=0.3, metavar="SHARE")
    stages.add_argument("--method", default="usac_accurate")
    stages.add_argument("--repeats", type=int, default=10, metavar="N")
    stages.set_defaults(run=_stages)

    growth = commands.add_parser("scale", help="time, accuracy and memory over N, and exponents")
    growth.add_argument(
        "--n", nargs="*", type=int, default=[1_000, 3_000, 10_000, 30_000, 100_000], metavar="N"
    )
    growth.add_argument(
        "--cluster-n", nargs="*", type=int, default=[1_000, 2_000, 4_000, 20_000], metavar="N"
    )
    growth.add_argument("--scene", choices=KINDS, default="clusters")
    growth.add_argument("--scenes", type=int, default=5, metavar="N", help="per size (default 5)")
    growth.add_argument("--plot", metavar="FILE", help="draw time over N, both logarithmic")
    growth.add_argument("--page", metavar="FILE", help="bring the tables of this page up to date")
    growth.set_defaults(run=_scale)

    paper = commands.add_parser("paper", help="the tables and figures of Wu and Wan")
    paper.add_argument("--quick", action="store_true", help="two pairs, nothing rendered")
    paper.add_argument("--data", metavar="DIR", help="folder of .npz files with more real pairs")
    paper.add_argument("--out", metavar="DIR", help="write the report, every trial and the plots")
    paper.add_argument(
        "--seeds", type=int, default=5, metavar="N", help="draws of each pair's matches (default 5)"
    )
    paper.add_argument(
        "--page", metavar="FILE", help="bring this page's tables, and images/ beside it, up to date"
    )
    paper.set_defaults(run=_paper)

    alike = commands.add_parser("overlap", help="pairs of one scene, and of two: what tells them")
    alike.add_argument("--data", metavar="DIR", help="folder of .npz files with more pairs")
    alike.add_argument("--page", metavar="FILE", help="bring the tables of this page up to date")
    alike.set_defaults(run=_overlap)

    reliability = commands.add_parser(
        "reliability", help="random calls beside cv2, load, memory, odd coordinates"
    )
    for name, default, about in (
        ("--calls", 10_000, "random calls beside cv2"),
        ("--seconds", 60, "of load from threads and processes"),
        ("--repeats", 20_000, "calls over which memory is watched"),
        ("--scenes", 20, "for each change of the coordinates"),
        ("--seed", 0, "of the random calls"),
    ):
        reliability.add_argument(
            name, type=int, default=default, metavar="N", help=f"{about} (default %(default)s)"
        )
    reliability.add_argument(
        "--page", metavar="FILE", help="bring the tables of this page up to date"
    )
    reliability.set_defaults(run=_reliability)
    return parser


def _cut(text: str) -> float | str:
    if text == "all":
        return text
    if not float(text) > 0:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a SIFT ratio nor 'all'")
    return float(text)


def _number(text: str) -> int:
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of matches")
    return int(text)


def _real(args: argparse.Namespace) -> int:
    runs = [
        (_section(cut, n), seed, load_pairs(args.data, cut, seed, args.sets, n))
        for cut in dict.fromkeys(args.cut)
        for n in dict.fromkeys(args.n)
        for seed in dict.fromkeys(args.seed)
    ]
    return _compare(args, runs)


def _section(cut: float | str, n: int | None) -> str:
    matches = "all matches" if cut == "all" else f"SIFT ratio < {cut:g}"
    return matches if n is None else f"{n} of {matches}"


def _render(args: argparse.Namespace) -> int:
    paths = write_pairs(args.out, args.repeats, args.dense)
    print(f"{len(paths)} pairs in {args.out}; now: python -m benchmarks real --data {args.out}")
    return 0


def _synthetic(args: argparse.Namespace) -> int:
    sections: dict[str, list[Pair]] = defaultdict(list)
    for kind, pair in scenes(
        args.scenes,
        args.repeats,
        args.seed,
        numbers=args.n,
        ratios=args.inlier_ratio,
        noises=args.noise,
    ):
        sections[kind].append(pair)
    return _compare(args, [(kind, args.seed, pairs) for kind, pairs in sections.items()])


def _compare(args: argparse.Namespace, runs: Sequence[Run]) -> int:
    methods, skipped = choose(args.methods)
    if not any(pairs for _, _, pairs in runs):
        raise ValueError(
            "there is no pair to compare: --cut takes pairs with SIFT ratios only, 'all' any; "
            "--repeats is 1 at least"
        )
    if skipped:
        print(f"not installed, left out: {', '.join(skipped)}", file=sys.stderr)
    records = _run(args, runs, methods)
    print(report.markdown(records, skipped))
    if args.json:
        settings = {k: v for k, v in vars(args).items() if k not in ("run", "json", "plots")}
        report.write_json(args.json, records, settings)
    if args.plots:
        for path in report.write_plots(args.plots, records):
            print(path, file=sys.stderr)
    return 0


def _run(args: argparse.Namespace, runs: Sequence[Run], methods: Sequence[Method]) -> list[Record]:
    records = []
    n = sum(len(pairs) for _, _, pairs in runs) * len(args.threshold)
    with tqdm(total=n, unit="pair") as progress, one_thread():
        warm_up(methods, Settings())
        for threshold in args.threshold:
            for section, seed, pairs in runs:
                settings = Settings(threshold, args.confidence, args.max_iters, seed)
                progress.set_description(f"{section}, {threshold:g} px")
                for pair in pairs:
                    records += measure(section, pair, methods, settings, args.time_repeats)
                    progress.update()
    return records


def _stages(args: argparse.Namespace) -> int:
    """Print the median time of each stage, ms."""
    from cv_densityf._estimate import estimate_fundamental

    print(f"| stage, ms | {' | '.join(f'N = {n}' for n in args.n)} |")
    print(f"| --- |{' --: |' * len(args.n)}")
    times: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    draws: dict[int, list[float]] = defaultdict(list)
    with one_thread():
        for n in args.n:
            for seed in range(args.repeats):
                X = make_scene("clusters", n, args.inlier_ratio, 0.5, seed).X
                # Twice, the second counts: the first touches cold memory.
                for _ in range(2):
                    estimate = estimate_fundamental(X[:, :2], X[:, 2:], method=args.method)
                draws[n].append(estimate.n_draws)
                for stage, ms in estimate.timings.items():
                    times[stage][n].append(ms)
    for stage, by_n in times.items():
        print(f"| {stage} | {' | '.join(_median(by_n[n], '.2f') for n in args.n)} |")
    print(f"| number of draws | {' | '.join(_median(draws[n], '.0f') for n in args.n)} |")
    return 0


def _show(text: str, page: str | None) -> None:
    """Print a report, and bring the tables of a page up to date with it."""
    print(text)
    if page:
        report.fill(page, text)


def _scale(args: argparse.Namespace) -> int:
    _show(scale(args.n, args.cluster_n, args.scenes, args.scene, args.plot), args.page)
    return 0


def _paper(args: argparse.Namespace) -> int:
    with TemporaryDirectory() as scratch:
        folder = Path(args.out or scratch)
        text = reproduce(args.data, folder, args.seeds, args.quick)
        _show(text, args.page)
        if args.page:
            images = Path(args.page).parent / "images"
            images.mkdir(exist_ok=True)
            for picture in folder.glob("paper-*.png"):
                shutil.copy(picture, images)
    return 0


def _overlap(args: argparse.Namespace) -> int:
    _show(overlap(args.data), args.page)
    return 0


def _reliability(args: argparse.Namespace) -> int:
    # The cases of the compat suite are made when it is imported.
    from benchmarks.reliability import reliability

    text = reliability(args.calls, args.seconds, args.repeats, args.scenes, args.seed)
    _show(text, args.page)
    return 0


def _median(values: Sequence[float], form: str) -> str:
    return format(float(np.median(values)), form) if values else ""


if __name__ == "__main__":
    sys.exit(main())
