"""Calls that mean the same to cv2 have the same answer, to the last bit, from any implementation.

This holds what numbers and arrays mean without comparing one implementation's F with another's.
"""

from __future__ import annotations

import sys
import threading

import cv2
import numpy as np
import pytest

from compat import versions
from compat.cases import N, call, halves, params
from compat.implementation import under_test
from compat.scenes import scene

X = scene(N, seed=5)[0]
P1, P2 = halves(X)
FEW1, FEW2 = P1[:12], P2[:12]
SEVEN1, SEVEN2 = P1[:7], P2[:7]
#: Powers of two, so that weighting and dividing are exact.
WEIGHT = np.exp2(np.arange(N) % 3 - 1).astype(np.float32)[:, None]
WHOLE1, WHOLE2 = np.rint(P1.clip(0)), np.rint(P2.clip(0))
NAN, INF = float("nan"), float("inf")


def weighted(points):
    return np.hstack([points * WEIGHT, WEIGHT])


def with_third(points, column):
    return np.hstack([points, np.full((N, 1), column, np.float32)])


def mask():
    return np.full((N, 1), 9, np.uint8)


def preset(**settings):
    return params(threshold=2.0, maxIterations=300, **settings)


SAME = {
    # numbers
    "None for maxIters is 0": (call(P1, P2, 8, 3.0, 0.99, None), call(P1, P2, 8, 3.0, 0.99, 0)),
    "maxIters below 0 is 0": (call(P1, P2, 8, 3.0, 0.99, -1), call(P1, P2, 8, 3.0, 0.99, 0)),
    "a float for maxIters is dropped": (call(P1, P2, 8, 3.0, 0.99, 30.0), call(P1, P2, 8)),
    "True for maxIters is dropped": (call(P1, P2, 8, 3.0, 0.99, True), call(P1, P2, 8)),
    "a sixth array is the mask": (
        call(P1, P2, 8, 2.0, 0.9, mask()),
        call(P1, P2, 8, 2.0, 0.9, 1000),
    ),
    "None for method is RANSAC": (call(P1, P2, None), call(P1, P2, 8)),
    "None is the default": (call(P1, P2, None, None, None), call(P1, P2, 8, 3.0, 0.99)),
    "with maxIters None is 0": (
        call(P1, P2, None, None, None, None),
        call(P1, P2, 0, 0.0, 0.0, 0),
    ),
    "with maxIters, None for method is 0": (
        call(P1, P2, None, 3.0, 0.99, 100),
        call(P1, P2, 0, 3.0, 0.99, 100),
    ),
    "params=None is the default params": (
        call(P1, P2, params=None),
        call(P1, P2, cv2.UsacParams()),
    ),
    "LMEDS ignores the threshold": (call(P1, P2, 4, 0.1), call(P1, P2, 4, 77.0)),
    "LMEDS ignores NaN for a threshold": (call(P1, P2, 4, NAN), call(P1, P2, 4)),
    "RANSAC of 12 points is LMEDS": (call(FEW1, FEW2, 8, 0.1), call(FEW1, FEW2, 4)),
    "7 points have one solver": (call(SEVEN1, SEVEN2, 8, 0.1), call(SEVEN1, SEVEN2, 2)),
    "7 points, unknown method": (call(SEVEN1, SEVEN2, 77), call(SEVEN1, SEVEN2, 1)),
    "FM_7POINT is as any unknown method": (call(P1, P2, 1), call(P1, P2, 16)),
    "unknown methods are one": (call(P1, P2, -3), call(P1, P2, 12)),
    # points
    "(N, 3) is divided": (call(weighted(P1), weighted(P2), 8), call(P1, P2, 8)),
    "(N, 3) is divided for LMEDS": (call(weighted(P1), weighted(P2), 4), call(P1, P2, 4)),
    "a weight of 0 is 1": (call(with_third(P1, 0), with_third(P2, 0), 8), call(P1, P2, 8)),
    "USAC drops a third column": (call(with_third(P1, 2), with_third(P2, 3), 36), call(P1, P2, 36)),
    "USAC takes (2, N)": (call(P1.T.copy(), P2.T.copy(), 36), call(P1, P2, 36)),
    "the mask of a masked array is nothing": (
        call(np.ma.array(P1, mask=P1 > 500), P2, 8),
        call(P1, P2, 8),
    ),
    "float64 is rounded to float32": (call(P1.astype("f8") + 1e-9, P2, 8), call(P1, P2, 8)),
    "int32 is those numbers": (
        call(WHOLE1.astype("i4"), WHOLE2.astype("i4"), 8),
        call(WHOLE1, WHOLE2, 8),
    ),
    "int64 wraps to int32": (
        call(
            (WHOLE1.astype("f8") + 2.0**33).astype("i8"),
            (WHOLE2.astype("f8") - 2.0**33).astype("i8"),
            8,
        ),
        call(WHOLE1, WHOLE2, 8),
    ),
    "uint64 wraps to int32": (
        call((WHOLE1.astype("f8") + 2.0**33).astype("u8"), WHOLE2, 8),
        call(WHOLE1, WHOLE2, 8),
    ),
    "one UMat is as two arrays": (call(cv2.UMat(P1), P2, 8), call(P1, P2, 8)),
    # Not swapped, so what comes of them is anybody's guess.
    "the other byte order is read as ours": (
        call(WHOLE1.astype(">u2"), WHOLE2.astype(">u2"), 2),
        call(WHOLE1.astype(">u2").view("<u2"), WHOLE2.astype(">u2").view("<u2"), 2),
    ),
    # params
    "the polisher does nothing": (
        call(P1, P2, preset(final_polisher=cv2.NONE_POLISHER)),
        call(P1, P2, preset(final_polisher=cv2.COV_POLISHER, final_polisher_iterations=30)),
    ),
    "params of USAC_DEFAULT": (
        call(
            P1,
            P2,
            preset(loMethod=cv2.LOCAL_OPTIM_INNER_AND_ITER_LO, loIterations=20, loSampleSize=12),
        ),
        call(P1, P2, cv2.USAC_DEFAULT, 2.0, 0.99, 300),
    ),
    "params of USAC_ACCURATE": (
        call(P1, P2, preset(loMethod=cv2.LOCAL_OPTIM_GC, loIterations=20, loSampleSize=25)),
        call(P1, P2, cv2.USAC_ACCURATE, 2.0, 0.99, 300),
    ),
}
if versions.READS_FLOAT16:
    HALF1, HALF2 = P1.astype("f2"), P2.astype("f2")
    SAME["float16 is those numbers"] = (
        call(HALF1, HALF2, 8),
        call(HALF1.astype("f4"), HALF2.astype("f4"), 8),
    )

#: Numbers and columns that must not be ignored.
DIFFERENT = {
    "maxIters counts": (call(P1, P2, 8, 3.0, 0.99, 0), call(P1, P2, 8, 3.0, 0.99, 1000)),
    "the threshold counts": (call(P1, P2, 8, 0.5), call(P1, P2, 8, 3.0)),
    "the threshold of params counts": (
        call(P1, P2, params(threshold=0.3)),
        call(P1, P2, params(threshold=3.0)),
    ),
    "(N, 3) of USAC is not divided": (
        call(weighted(P1), weighted(P2), 36),
        call(P1, P2, 36),
    ),
}


def answer(build):
    args, kwargs = build()
    F, mask = under_test(*args, **kwargs)
    return F, mask.get() if isinstance(mask, cv2.UMat) else mask


def equal(one, two):
    return one is two or (one is not None and two is not None and np.array_equal(one, two, True))


@pytest.mark.parametrize("name", SAME)
def test_has_the_same_answer(name):
    one, two = (answer(build) for build in SAME[name])
    assert equal(one[0], two[0])
    if one[0] is not None:
        assert equal(one[1], two[1])


def test_has_an_answer_mostly():
    """Two calls that find nothing would be equal, too."""
    without = [name for name, (build, _) in SAME.items() if answer(build)[0] is None]
    assert len(without) <= 2


@pytest.mark.parametrize("name", DIFFERENT)
def test_has_another_answer(name):
    one, two = (answer(build) for build in DIFFERENT[name])
    assert not (equal(one[0], two[0]) and equal(one[1], two[1]))


@pytest.mark.parametrize("method", [4, 8, 36, 38, None])
def test_draws_nothing_from_the_generators_of_others(method):
    third = params() if method is None else method

    def drawn(call_it):
        cv2.setRNGSeed(7)
        np.random.seed(7)  # noqa: NPY002
        if call_it:
            under_test(P1, P2, third)
        return cv2.randu(np.zeros(3), 0, 1).tolist(), np.random.rand()  # noqa: NPY002

    assert drawn(True) == drawn(False)


@pytest.mark.parametrize("method", [8, 38])
def test_other_threads_go_on_during_a_call(method):
    """cv2 releases the interpreter's lock."""
    p1, p2 = halves(scene(2_000, 0.3)[0])
    gate, passed = threading.Lock(), threading.Event()
    gate.acquire()

    def other():
        with gate:
            passed.set()

    thread = threading.Thread(target=other)
    thread.start()
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1_000)  # nobody is asked to give the lock up
    try:
        gate.release()
        before = passed.is_set()
        for _ in range(100):  # a short call may be over before the other thread wakes up
            under_test(p1, p2, method, 1.0, 0.999, 1000)
            after = passed.is_set()
            if after:
                break
    finally:
        sys.setswitchinterval(interval)
        thread.join()
    assert (before, after) == (False, True)
