"""Every accepted call answers as cv2 does, but for the numbers: None, types, shapes, ``mask=``."""

from __future__ import annotations

import pytest

from compat import implementation
from compat.cases import CASES


@pytest.mark.parametrize("id_", [id_ for id_, case in CASES.items() if not case.refused])
def test_same_form_as_cv2(run, id_):
    run.hold(id_)


@pytest.mark.whole_table
def test_nothing_crashes_or_hangs(run):
    died = {id_: o.kind for id_, o in run.ours.items() if o.kind in ("crash", "timeout")}
    if implementation.IS_CV2:
        died = {id_: kind for id_, kind in died.items() if not id_.startswith("sizes/")}
    assert not died


@pytest.mark.whole_table
def test_many_points_get_an_answer(run):
    """Also from graph cut in OpenCV 5.0, which dies of them."""
    if implementation.IS_CV2:
        pytest.skip("cv2 dies of graph cut with many points")
    sizes = [o for id_, o in run.ours.items() if id_.startswith("sizes/")]
    assert {o.kind for o in sizes} == {"answer"}
    assert all(o.F is not None for o in sizes)
