"""Every call that cv2 refuses raises cv2.error with cv2's code and function."""

from __future__ import annotations

import cv2
import pytest

from compat.cases import CASES, halves
from compat.implementation import reference, under_test
from compat.scenes import scene


@pytest.mark.parametrize("id_", [id_ for id_, case in CASES.items() if case.refused])
def test_same_error_as_cv2(run, id_):
    assert run.cv2s[id_].kind == "error", "the table is wrong about this release"
    run.hold(id_)


def test_the_error_is_cv2s_class_with_cv2s_fields():
    p1, p2 = halves(scene(30)[0])
    with pytest.raises(cv2.error) as caught:
        under_test(p1.tolist(), p2.tolist())
    error = caught.value
    assert not isinstance(error, (TypeError, ValueError))
    assert error.code == cv2.Error.StsBadArg
    assert error.func == "findFundamentalMat"
    assert "Overload resolution failed" in error.err + error.msg
    assert str(error) == error.msg
    assert isinstance(error.file, str)
    assert isinstance(error.line, int)


def test_the_message_lists_the_overloads():
    p1, p2 = halves(scene(30)[0])
    with pytest.raises(cv2.error) as caught:
        under_test(p1, p2, unknown=1)
    bullets = "\n>  - findFundamentalMat() "
    with pytest.raises(cv2.error) as cv2s:
        reference(p1, p2, unknown=1)
    assert str(caught.value).count(bullets) == str(cv2s.value).count(bullets) >= 3
