"""Run the table once for the session, and say at the end what held."""

from __future__ import annotations

import json
import platform
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np
import pytest

from compat import implementation, versions
from compat.cases import CASES
from compat.differences import differences, is_known, load_known
from compat.outcomes import observe_both


def pytest_addoption(parser):
    parser.addoption(
        "--compat-json", metavar="FILE", help="write what held, for `python -m compat.table`"
    )


class Run:
    """Outcomes of all selected cases, and how they differ."""

    def __init__(self, ids):
        self.known = load_known()
        self.ours, self.cv2s = observe_both(ids)
        self.differences = {
            id_: differences(CASES[id_], self.ours[id_], self.cv2s[id_]) for id_ in ids
        }

    def unexpected(self, id_):
        return {
            aspect: text
            for aspect, text in self.differences[id_].items()
            if is_known(self.known, id_, aspect) is None
        }

    def hold(self, id_):
        """Fail, in the words of the difference, if the outcome is not cv2's."""
        found = self.unexpected(id_)
        if found:
            pytest.fail("; ".join(f"[{aspect}] {text}" for aspect, text in found.items()), False)

    def by_line(self):
        """Cases that each line of the known differences covers."""
        covered = {line: [] for line in self.known if versions.applies(line.condition)}
        for id_, found in self.differences.items():
            for aspect in found:
                line = is_known(self.known, id_, aspect)
                if line is not None:
                    covered[line].append(id_)
        return covered


_RUN = pytest.StashKey[Run]()


@pytest.fixture(scope="session")
def run(request):
    made = Run(request.config.stash[_SELECTED])
    request.config.stash[_RUN] = made
    return made


_SELECTED = pytest.StashKey[list[str]]()


def pytest_collection_modifyitems(session, config, items):
    """Make only the calls that a selected test looks at."""
    wanted = {
        item.callspec.params["id_"]
        for item in items
        if hasattr(item, "callspec") and "id_" in item.callspec.params
    }
    if any(item.get_closest_marker("whole_table") for item in items):
        wanted = set(CASES)
    config.stash[_SELECTED] = [id_ for id_ in CASES if id_ in wanted]
    for item in items:
        # The first test waits for all calls. Each of these has a limit of its own.
        item.add_marker(pytest.mark.timeout(func_only=True))


def pytest_configure(config):
    config.addinivalue_line("markers", "whole_table: needs the outcome of every case")


def grouped(pairs):
    """Collect the ids of each text, the most frequent text first."""
    groups = defaultdict(list)
    for text, id_ in pairs:
        groups[text].append(id_)
    return sorted(groups.items(), key=lambda group: -len(group[1]))


def some(ids, limit=3):
    more = f"; and {len(ids) - limit:,} more" if len(ids) > limit else ""
    return "; ".join(ids[:limit]) + more


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_terminal_summary(terminalreporter, config):
    """Have the last word, after pytest's own list of failures."""
    yield
    made = config.stash.get(_RUN, None)
    if made is not None:
        summarize(terminalreporter, config, made)


def summarize(terminalreporter, config, made):
    stats = terminalreporter.stats
    failed = stats.get("failed", []) + stats.get("error", [])
    n_passed = len(stats.get("passed", []))
    total = len(made.differences)
    unexpected = {id_: found for id_ in made.differences if (found := made.unexpected(id_))}
    known = {line: ids for line, ids in made.by_line().items() if ids}
    n_known = len({id_ for ids in known.values() for id_ in ids} - set(unexpected))
    write = terminalreporter.write_line
    terminalreporter.section("compat")
    write(f"{implementation.NAME} against OpenCV {cv2.__version__}")
    write(f"Python {platform.python_version()}, numpy {np.__version__}, {platform.machine()}")
    write(
        f"{total:,} calls: {total - len(unexpected) - n_known:,} answered as cv2 does, "
        f"{n_known:,} known differences, {len(unexpected):,} unexpected differences"
    )
    groups = grouped((id_.split("/")[0], id_) for id_ in made.differences)
    write("  " + ", ".join(f"{group} {len(ids)}" for group, ids in groups))
    write(f"{n_passed + len(failed):,} checks: {n_passed:,} hold, {len(failed):,} fail")
    for line, ids in known.items():
        issue = "" if line.issue == "-" else f" (OpenCV issue {line.issue})"
        write(f"known difference, {len(ids)} calls: {line.reason}{issue}")
        for id_ in ids:
            write(f"    {id_} [{line.aspect}]")
    for text, ids in grouped(
        (f"[{aspect}] {text}", id_)
        for id_, found in unexpected.items()
        for aspect, text in found.items()
    ):
        write(f"UNEXPECTED {text}")
        write(f"    {len(ids):,} calls: {some(ids)}")
    for test, names in grouped(report.nodeid.partition("[")[::2] for report in failed):
        names = [name.removesuffix("]") for name in names if name]
        write(f"FAILS {test}" + (f"\n    {len(names):,} times: {some(names)}" if names else ""))
    target = config.getoption("--compat-json")
    if target:
        record = {
            "implementation": implementation.NAME,
            "opencv": cv2.__version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
            "calls": total,
            "known": n_known,
            "unexpected": len(unexpected),
            "tests": n_passed,
            "failed": len(failed),
        }
        Path(target).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
