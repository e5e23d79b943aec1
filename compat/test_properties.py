"""What must not matter does not: layout, type, repetition, order, place, which image is first."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from compat.cases import halves, params
from compat.implementation import under_test
from compat.scenes import scene

#: USAC_PARALLEL depends on the timing of threads.
METHODS = (4, 8, 32, 34, 35, 36, 37, 38)
ROBUST = (8, 36, 38)

some = settings(
    max_examples=25,
    deadline=None,
    derandomize=True,
)
seeds = st.integers(0, 10_000)
counts = st.integers(8, 250)

LAYOUTS = {
    "float64": lambda p: p.astype(np.float64),
    "(N, 1, 2)": lambda p: p[:, None],
    "(1, N, 2)": lambda p: p[None],
    "(N, 2, 1)": lambda p: p[:, :, None],
    "Fortran": np.asfortranarray,
    "strided": lambda p: np.repeat(np.hstack([p, p]), 3, axis=0)[::3, 2:],
    "backwards": lambda p: p[::-1].copy()[::-1],
    "homogeneous, weight 1": lambda p: np.hstack([p, np.ones((len(p), 1), p.dtype)]),
    "UMat": cv2.UMat,
}


def array(value):
    return value.get() if isinstance(value, cv2.UMat) else value


def same(one, two):
    for a, b in zip(one, two, strict=True):
        if a is None or b is None:
            assert a is b
        else:
            np.testing.assert_array_equal(array(a), array(b))


@some
@given(seeds, counts, st.sampled_from(METHODS), st.sampled_from(sorted(LAYOUTS)))
def test_layout_and_type_do_not_matter(seed, n, method, layout):
    p1, p2 = halves(scene(n, seed=seed)[0])
    plain = under_test(p1, p2, method, 1.5, 0.99, 200)
    assume(plain[0] is not None)  # the mask of a failed call is not defined by cv2
    convert = LAYOUTS[layout]
    same(under_test(convert(p1), convert(p2), method, 1.5, 0.99, 200), plain)


@some
@given(seeds, counts, st.sampled_from((np.int16, np.int32, np.int64, np.uint16)))
def test_integers_are_those_numbers(seed, n, kind):
    p1, p2 = (p.clip(0).astype(kind) for p in halves(scene(n, seed=seed)[0]))
    plain = under_test(p1.astype(np.float32), p2.astype(np.float32), 8, 2.0)
    assume(plain[0] is not None)
    same(under_test(p1, p2, 8, 2.0), plain)


@some
@given(seeds, counts, st.sampled_from((*METHODS, None)))
def test_the_same_call_has_the_same_answer(seed, n, method):
    p1, p2 = halves(scene(n, seed=seed)[0])
    third = params() if method is None else method
    first = under_test(p1, p2, third)
    cv2.setRNGSeed(seed)
    np.random.seed(seed)  # noqa: NPY002
    second = under_test(p1, p2, third)
    assert (first[0] is None) == (second[0] is None)
    assume(first[0] is not None)
    same(first, second)


@some
@given(seeds, st.sampled_from(METHODS))
def test_the_number_of_threads_does_not_matter(seed, method):
    p1, p2 = halves(scene(100, seed=seed)[0])
    threads = cv2.getNumThreads()
    try:
        answers = []
        for count in (1, 2):
            cv2.setNumThreads(count)
            answers.append(under_test(p1, p2, method, 1.5, 0.99, 200))
    finally:
        cv2.setNumThreads(threads)
    assume(answers[0][0] is not None)
    same(*answers)


def flags(X, method):
    _, mask = under_test(*halves(X), method, 2.0, 0.9999, 3000)
    return mask.ravel() == 1


@some
@given(seeds, st.sampled_from(ROBUST))
def test_the_order_of_matches_hardly_matters(seed, method):
    """cv2 draws other samples: on clean scenes they must find the same matches."""
    X, inliers, _ = scene(200, 0.8, 0.05, seed)
    order = np.random.default_rng(seed).permutation(len(X))
    assert flags(X, method)[inliers].mean() > 0.95
    assert flags(X[order], method)[inliers[order]].mean() > 0.95


@some
@given(
    seeds,
    st.sampled_from(ROBUST),
    st.integers(-500, 500),
    st.integers(-500, 500),
    st.sampled_from((0.5, 1.0, 2.0)),
)
def test_the_place_and_scale_of_the_images_hardly_matter(seed, method, dx, dy, scale):
    X, inliers, _ = scene(200, 0.8, 0.05, seed)
    moved = X * np.float32(scale) + np.array([dx, dy, -dy, dx], np.float32)
    assert flags(moved, method)[inliers].mean() > 0.95


@some
@given(seeds, st.sampled_from(ROBUST))
def test_swapped_images_have_the_transposed_matrix(seed, method):
    X, inliers, _ = scene(200, 0.8, 0.05, seed)
    p1, p2 = halves(X)
    F, _ = under_test(p2, p1, method, 2.0, 0.9999, 3000)
    right = X[inliers].astype(np.float64)
    one, two = np.c_[right[:, :2], np.ones(len(right))], np.c_[right[:, 2:], np.ones(len(right))]
    lines = one @ F
    distance = np.abs((two * lines).sum(1)) / np.hypot(lines[:, 0], lines[:, 1])
    assert np.mean(distance < 2.0) > 0.95


@some
@given(seeds, counts, st.sampled_from((*METHODS, 33, None)))
def test_neither_points_nor_params_are_written_to(seed, n, method):
    p1, p2 = halves(scene(n, seed=seed)[0])
    one, two = p1.copy(), p2.copy()
    third = params(randomGeneratorState=seed) if method is None else method
    before = settings_of(third)
    under_test(one, two, third)
    np.testing.assert_array_equal(one, p1)
    np.testing.assert_array_equal(two, p2)
    assert settings_of(third) == before


def settings_of(third):
    if not isinstance(third, cv2.UsacParams):
        return third
    return {name: getattr(third, name) for name in dir(third) if not name.startswith("_")}


@pytest.mark.parametrize("method", [8, 36])
def test_threads_may_call_it_together(method):
    from concurrent.futures import ThreadPoolExecutor

    scenes = [halves(scene(120, seed=seed)[0]) for seed in range(12)]
    alone = [under_test(*points, method) for points in scenes]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda points: under_test(*points, method), scenes))
    for one, two in zip(alone, together, strict=True):
        same(one, two)
