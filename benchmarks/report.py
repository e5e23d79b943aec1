"""Tables in markdown, the records in JSON, and the plots."""

from __future__ import annotations

import json
import platform
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.metrics import ACCURACY_LEVELS, LOST, summarise, wins_and_losses
from benchmarks.peers import CV2_METHODS
from benchmarks.run import Record

#: Times are given as multiples of this method's, in the same run.
REFERENCE = "cv2:USAC_ACCURATE"
OURS = "ours:"
#: Ours that are held against every peer, pair by pair; any others only if none of these ran.
HEADLINES = tuple(
    f"{OURS}{name}{suffix}"
    for name in ("USAC_ACCURATE", "USAC_MAGSAC")
    for suffix in ("", "+scores")
)
PACKAGES = (
    "cv-densityf",
    "numpy",
    "scipy",
    "opencv-contrib-python-headless",
    "opencv-python",
    "poselib",
    "pycolmap",
    "pydegensac",
    "pymagsac",
    "pygcransac",
    "pysuperansac",
)

#: In a table, an error that is infinite.
INFINITE = "lost"
_TABLE = re.compile(r"^\|.*(?:\n\|.*)*", re.MULTILINE)

Rows = list[Record]


def markdown(records: Rows, skipped: Sequence[str] = ()) -> str:
    """Return all tables: per section and threshold, and over thresholds where there are several."""
    parts = []
    if skipped:
        parts.append(f"Not installed, left out: {', '.join(skipped)}.")
    for section in _values(records, "section"):
        in_section = [r for r in records if r.section == section]
        thresholds = _values(in_section, "threshold")
        for threshold in thresholds:
            rows = [r for r in in_section if r.threshold == threshold]
            parts.append(f"## {section}, threshold {threshold:g} px")
            parts.append(_overall(rows))
            parts.append("mAA / share above 5 px per set:\n\n" + _per_group(rows))
            parts += [*_against_cv2(rows), *_paired(rows), *_worst(rows)]
        if len(thresholds) > 1:
            parts.append(f"## {section}, over the thresholds\n\n" + _spread(in_section))
    return "\n\n".join(parts) + "\n"


def write_json(path: str | Path, records: Rows, settings: dict[str, Any]) -> None:
    """Write what was run, on what, and every record; null for an infinite error or no pose."""
    document = {
        "settings": settings,
        "machine": {"platform": platform.platform(), "python": platform.python_version()},
        "packages": {name: v for name in PACKAGES if (v := _version(name))},
        "summary": [
            {"section": section, "threshold": threshold, "method": method, **finite(summary)}
            for (section, threshold, method), summary in _summaries(records).items()
        ],
        "records": [finite(asdict(record)) for record in records],
    }
    Path(path).write_text(json.dumps(document, indent=1) + "\n")


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def finite(row: dict[str, Any]) -> dict[str, Any]:
    """Put None, which JSON can hold, for numbers that are not finite."""
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in row.items()}


def _summaries(records: Rows) -> dict[tuple[str, float, str], dict[str, float]]:
    keys = dict.fromkeys((r.section, r.threshold, r.method) for r in records)
    return {
        key: _summary([r for r in records if (r.section, r.threshold, r.method) == key])
        for key in keys
    }


def _summary(rows: Rows) -> dict[str, float]:
    return summarise([r.error for r in rows], [r.pose_error for r in rows], [r.ms for r in rows])


def _values(records: Iterable[Record], name: str) -> list[Any]:
    return list(dict.fromkeys(getattr(r, name) for r in records))


def _by_method(rows: Rows) -> dict[str, Rows]:
    return {m: [r for r in rows if r.method == m] for m in _values(rows, "method")}


def table(header: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    """Figures to the right, the first column and words to the left."""
    body = list(body)
    columns = [[row[k] for row in body] for k in range(1, len(header))]
    marks = ["---", *("---" if any(map(_is_words, column)) else "--:" for column in columns)]
    return "\n".join(f"| {' | '.join(line)} |" for line in (header, marks, *body))


def _is_words(cell: str) -> bool:
    return cell[:1].isalpha() and cell != "inf" and not cell.startswith(INFINITE)


def fill(page: str | Path, report: str) -> None:
    """Bring the tables of a page up to date, each below a comment with its title in a report.

    Parameters
    ----------
    page : path
        Markdown; ``<!-- table: TITLE -->`` stands before each table to be replaced.
    report : str
        Markdown; ``## TITLE`` stands somewhere before its table.

    Raises
    ------
    ValueError
        If the report has no table of that title, or the page none below the comment.
    """
    tables = {}
    for section in f"\n{report}".split("\n## ")[1:]:
        if found := _TABLE.search(section):
            tables[section.splitlines()[0]] = found[0]
    # From comment to comment: what comes before the first has none.
    text, *parts = re.split(r"(?m)^(?=<!-- table: )", Path(page).read_text("utf-8"))
    for part in parts:
        title = part.splitlines()[0].removeprefix("<!-- table: ").removesuffix(" -->")
        if title not in tables:
            raise ValueError(f"{page}: no table {title!r} in the report; it has {list(tables)}")
        if not _TABLE.search(part):
            raise ValueError(f"{page}: there is no table below {part.splitlines()[0]}")
        text += _TABLE.sub(lambda _, new=tables[title]: new, part, count=1)
    Path(page).write_text(text, encoding="utf-8")


def _share(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.3f}"


def _pixels(value: float) -> str:
    return INFINITE if np.isinf(value) else f"{value:.2f}"


def _overall(rows: Rows) -> str:
    summaries = {method: _summary(rs) for method, rs in _by_method(rows).items()}
    reference = summaries.get(REFERENCE, {}).get("ms_total", np.nan)
    columns: dict[str, Callable[[dict[str, float]], str]] = {
        "mAA": lambda s: _share(s["mAA"]),
        "> 5 px": lambda s: _share(s["lost"]),
        "AUC5": lambda s: _share(s["auc5"]),
        "AUC10": lambda s: _share(s["auc10"]),
        "median px": lambda s: _pixels(s["median"]),
        "p90 px": lambda s: _pixels(s["p90"]),
        "median ms": lambda s: f"{s['ms_median']:.1f}",
        "total ms": lambda s: f"{s['ms_total']:.0f}",
        f"time / {REFERENCE}": lambda s: _share(s["ms_total"] / reference),
    }
    n, seeds = len(_values(rows, "pair")), _values(rows, "seed")
    methods = table(
        ["method", *columns],
        ([method, *(show(s) for show in columns.values())] for method, s in summaries.items()),
    )
    times = f", {len(seeds)} times each, with seeds {_listed(seeds)}" if len(seeds) > 1 else ""
    return f"{n} pairs{times}.\n\n{methods}"


def _listed(seeds: Sequence[int]) -> str:
    if list(seeds) == list(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]} to {seeds[-1]}"
    return ", ".join(map(str, seeds))


def _per_group(rows: Rows) -> str:
    """Methods down and sets across, or the other way round if there are more sets."""
    methods, groups = _values(rows, "method"), _values(rows, "group")
    cells = {}
    for method in methods:
        for group in groups:
            s = _summary([r for r in rows if r.method == method and r.group == group])
            cells[method, group] = f"{_share(s['mAA'])} / {_share(s['lost'])}"
    if len(groups) > len(methods):
        return table(["set", *methods], ([g, *(cells[m, g] for m in methods)] for g in groups))
    return table(["method", *groups], ([m, *(cells[m, g] for g in groups)] for m in methods))


def _against_cv2(rows: Rows) -> list[str]:
    """Ours against cv2's own method of the same name."""
    by_method = _by_method(rows)
    body = []
    for name in CV2_METHODS:
        theirs = by_method.get(f"cv2:{name}")
        for suffix in ("", "+scores"):
            ours = by_method.get(f"{OURS}{name}{suffix}")
            if ours is None or theirs is None:
                continue
            a, b = _summary(theirs), _summary(ours)
            wins, losses = _wins_and_losses(ours, theirs)
            body.append(
                [
                    name + suffix,
                    f"{a['mAA']:.3f} → {b['mAA']:.3f}",
                    f"{a['lost']:.3f} → {b['lost']:.3f}",
                    f"{_share(a['auc5'])} → {_share(b['auc5'])}",
                    f"{wins} : {losses}",
                    f"{b['ms_total'] / a['ms_total']:.2f}",
                ]
            )
    if not body:
        return []
    header = ["method", "mAA", "> 5 px", "AUC5", "wins : losses", "time ratio"]
    return ["cv2's own → ours:\n\n" + table(header, body)]


def _wins_and_losses(ours: Rows, theirs: Rows) -> tuple[int, int]:
    return wins_and_losses([r.error for r in ours], [r.error for r in theirs])


def _paired(rows: Rows) -> list[str]:
    """Count the calls that each of ours wins and loses against each peer."""
    by_method = _by_method(rows)
    ours = [m for m in HEADLINES if m in by_method]
    ours = ours or [m for m in by_method if m.startswith(OURS)]
    peers = [m for m in by_method if not m.startswith(OURS)]
    if not ours or not peers:
        return []
    body = []
    for peer in peers:
        counts = (_wins_and_losses(by_method[m], by_method[peer]) for m in ours)
        body.append([peer, *(f"{wins} : {losses}" for wins, losses in counts)])
    return ["Calls won : lost (errors within 2 % tie):\n\n" + table(["against", *ours], body)]


def _worst(rows: Rows, count: int = 10) -> list[str]:
    """List the pairs on which ours is worst, and who does best there, in the median over seeds."""
    by_method = _by_method(rows)
    preferred = (f"{OURS}USAC_ACCURATE", *(m for m in by_method if m.startswith(OURS)))
    ours = next((m for m in preferred if m in by_method), None)
    if ours is None:
        return []
    errors = {method: _by_pair(own) for method, own in by_method.items()}
    n = {r.pair: r.n for r in rows}
    worst = sorted(errors[ours], key=lambda pair: errors[ours][pair], reverse=True)[:count]
    body = []
    for pair in worst:
        best = min(errors, key=lambda method: errors[method][pair])
        shown = (_pixels(errors[method][pair]) for method in (ours, best))
        body.append([pair, str(n[pair]), *shown, best])
    header = ["pair", "matches", "error px", "best px", "by"]
    return [f"Worst pairs of {ours}:\n\n" + table(header, body)]


def _by_pair(rows: Rows) -> dict[str, float]:
    """Error of one method on each pair, the median over the seeds."""
    errors: dict[str, list[float]] = defaultdict(list)
    for r in rows:
        errors[r.pair].append(r.error)
    return {pair: float(np.median(values)) for pair, values in errors.items()}


def _spread(rows: Rows) -> str:
    """Return mAA at each threshold, and the largest less the smallest."""
    thresholds = _values(rows, "threshold")
    body = []
    for method, own in _by_method(rows).items():
        maa = [_summary([r for r in own if r.threshold == t])["mAA"] for t in thresholds]
        body.append([method, *(f"{value:.3f}" for value in maa), f"{max(maa) - min(maa):.3f}"])
    header = ["mAA of", *(f"{t:g} px" for t in thresholds), "largest less smallest"]
    return table(header, body)


def write_plots(folder: str | Path, records: Rows) -> list[Path]:
    """Draw the cumulated errors and time against accuracy of each section; return the files."""
    from matplotlib.figure import Figure

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for section in _values(records, "section"):
        for threshold in _values((r for r in records if r.section == section), "threshold"):
            rows = [r for r in records if r.section == section and r.threshold == threshold]
            stem = f"{section}-{threshold:g}px".replace(" ", "_").replace("<", "below")
            for kind, draw in (("errors", _draw_errors), ("time", _draw_time)):
                figure = Figure(figsize=(9, 5.5), layout="constrained")
                draw(figure.add_subplot(), rows)
                figure.suptitle(f"{section}, threshold {threshold:g} px")
                files.append(folder / f"{stem}-{kind}.png")
                figure.savefig(files[-1], dpi=130)
    return files


def _styles(methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Ours solid and heavy, peers thin and dashed; no two alike."""
    import matplotlib

    colors = matplotlib.color_sequences["tab10"]
    styles: dict[str, dict[str, Any]] = {}
    for kind, lines, width in ((True, ("-", "-."), 2.2), (False, ("--", ":"), 1.3)):
        names = [m for m in methods if m.startswith(OURS) == kind]
        for i, method in enumerate(names):
            line = lines[i // len(colors) % len(lines)]
            styles[method] = {"color": colors[i % len(colors)], "ls": line, "lw": width}
    return styles


def _draw_errors(ax: Any, rows: Rows) -> None:
    by_method = _by_method(rows)
    styles = _styles(list(by_method))
    ranked = sorted(by_method, key=lambda m: -_summary(by_method[m])["mAA"])
    x = np.geomspace(0.05, 20, 300)
    for method in ranked:
        errors = np.sort([r.error for r in by_method[method]])
        share = np.searchsorted(errors, x, side="left") / len(errors)
        maa = _summary(by_method[method])["mAA"]
        ax.plot(x, share, label=f"{maa:.3f}  {method}", **styles[method])
    for level in ACCURACY_LEVELS:
        ax.axvline(level, color="0.85", lw=0.8, zorder=0)
    ax.set_xscale("log")
    ax.set_xlim(x[0], x[-1])
    ax.set_ylim(0, 1)
    ticks = (0.1, *ACCURACY_LEVELS, 10, 20)
    ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
    ax.set_xticks([], minor=True)
    ax.set_xlabel("mean symmetric epipolar distance of the truth points, px")
    ax.set_ylabel("share of pairs below")
    # Beside the axes: two dozen curves leave no corner free.
    ax.legend(title="mAA", loc="upper left", bbox_to_anchor=(1.01, 1), fontsize=7.5, frameon=False)


def _draw_time(ax: Any, rows: Rows) -> None:
    from matplotlib.ticker import LogLocator, NullLocator

    by_method = _by_method(rows)
    styles = _styles(list(by_method))
    for method, own in by_method.items():
        s = _summary(own)
        style = styles[method]
        ours = method.startswith(OURS)
        ax.scatter(
            s["ms_total"] / s["n"],
            s["mAA"],
            s=60 if ours else 35,
            marker="o" if style["ls"] in ("-", "--") else "s",
            edgecolors=[style["color"]],
            facecolors=[style["color"]] if ours else "none",
            label=f"{s['lost']:.3f}  {method}",
        )
    ax.set_xscale("log")
    ax.xaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
    ax.xaxis.set_major_formatter("{x:g}")
    ax.xaxis.set_minor_locator(NullLocator())
    ax.set_xlabel("mean time per call, ms")
    ax.set_ylabel("mean average accuracy")
    ax.grid(color="0.9")
    ax.set_axisbelow(True)
    ax.legend(
        title=f"share above {LOST:g} px",
        loc="upper left",
        bbox_to_anchor=(1.01, 1),
        fontsize=7.5,
        frameon=False,
    )
