"""Names, order, defaults and kinds of the parameters: by cv2's own stub, and by calling."""

from __future__ import annotations

import ast
import inspect
import typing
from pathlib import Path

import cv2
import numpy as np
import pytest

from compat import implementation, versions
from compat.cases import halves, params
from compat.implementation import under_test
from compat.scenes import scene

STUB = Path(cv2.__file__).with_name("__init__.pyi")
P1, P2 = halves(scene(60)[0])
VALUES = {
    "points1": P1,
    "points2": P2,
    "method": 8,
    "ransacReprojThreshold": 2.0,
    "confidence": 0.9,
    "maxIters": 50,
    "params": params(),
    # None in its place would be maxIters to the first overload.
    "mask": np.zeros((60, 1), np.uint8),
}


def stub_overloads():
    """Required and optional parameters of each overload in cv2's stub, in order."""
    tree = ast.parse(STUB.read_text(encoding="utf-8"))
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and node.name == "findFundamentalMat":
            names = [argument.arg for argument in node.args.args]
            n_required = len(names) - len(node.args.defaults)
            assert not node.args.kwonlyargs
            assert not node.args.posonlyargs
            yield names[:n_required], names[n_required:]


def our_overloads():
    for function in typing.get_overloads(under_test):
        parameters = inspect.signature(function).parameters.values()
        plain = [p for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD]
        extra = [p for p in parameters if p.kind is not p.POSITIONAL_OR_KEYWORD]
        yield plain, extra


OVERLOADS = list(stub_overloads()) if versions.STUB_HAS_OVERLOADS else []


def test_the_stub_has_three_overloads_for_arrays_and_three_for_umat():
    if not versions.STUB_HAS_OVERLOADS:
        pytest.skip("this cv2 has no typed overloads")
    assert len(OVERLOADS) == 6
    distinct = {(*required, "|", *optional) for required, optional in OVERLOADS}
    assert len(distinct) == 3


def test_declared_overloads_are_cv2s():
    declared = list(our_overloads())
    if not declared:
        pytest.skip("the implementation declares no overloads")
    assert [
        (
            [p.name for p in plain if p.default is p.empty],
            [p.name for p in plain if p.default is not p.empty],
        )
        for plain, _ in declared
    ] == OVERLOADS
    for _, extra in declared:
        assert all(p.kind is p.KEYWORD_ONLY and p.default is not p.empty for p in extra)


@pytest.mark.parametrize("number", range(len(OVERLOADS)))
def test_takes_each_overload_by_position_and_by_name(number):
    required, optional = OVERLOADS[number]
    for count in range(len(required), len(required) + len(optional) + 1):
        names = (required + optional)[:count]
        by_position = under_test(*(VALUES[name] for name in names))
        by_name = under_test(**{name: VALUES[name] for name in names})
        np.testing.assert_array_equal(by_name[0], by_position[0])
        np.testing.assert_array_equal(by_name[1], by_position[1])


@pytest.mark.parametrize("number", range(len(OVERLOADS)))
def test_misses_each_required_parameter(number):
    required, optional = OVERLOADS[number]
    others = [set(r) for r, _ in OVERLOADS]
    for missing in required:
        names = [name for name in required + optional if name != missing]
        if any(needed <= set(names) for needed in others if missing not in needed):
            continue  # another overload takes the rest
        with pytest.raises(cv2.error):
            under_test(**{name: VALUES[name] for name in names})


def test_defaults_are_ransac_3_pixels_99_percent_1000_samples():
    short = under_test(P1, P2)
    long = under_test(P1, P2, cv2.FM_RANSAC, 3.0, 0.99, 1000)
    np.testing.assert_array_equal(short[0], long[0])
    np.testing.assert_array_equal(short[1], long[1])
    for name, value in (("method", 8), ("ransacReprojThreshold", 3.0), ("confidence", 0.99)):
        np.testing.assert_array_equal(under_test(P1, P2, **{name: value})[0], short[0])


def test_params_none_is_the_default_params():
    np.testing.assert_array_equal(
        under_test(P1, P2, params=None)[0], under_test(P1, P2, cv2.UsacParams())[0]
    )


def test_extras_are_keyword_only():
    """The seventh position is the mask, and there is no eighth."""
    with pytest.raises(cv2.error):
        under_test(P1, P2, 8, 2.0, 0.9, 50, None, "off")


def test_is_called_findfundamentalmat():
    if not implementation.IS_CV2 and implementation.NAME != implementation.DEFAULT:
        pytest.skip("any name will do")
    assert under_test.__name__ == "findFundamentalMat"
    assert under_test.__doc__
