"""The list of known differences is neither stale nor mistyped."""

from __future__ import annotations

import pytest

from compat import versions
from compat.differences import load_known, matching_ids, read_known

KNOWN = load_known()


@pytest.mark.parametrize("line", KNOWN, ids=str)
def test_matches_a_case(line):
    assert matching_ids(line), "no case has such an id"


@pytest.mark.whole_table
@pytest.mark.parametrize("line", KNOWN, ids=str)
def test_still_differs(run, line):
    if not versions.applies(line.condition):
        pytest.skip(f"only on OpenCV {line.condition}")
    assert run.by_line()[line], "no call differs in this way any more"


def test_a_mistyped_line_is_an_error():
    with pytest.raises(ValueError, match="line 2"):
        read_known("# comment\nmasks/* | mask= | * | 5551\n")
