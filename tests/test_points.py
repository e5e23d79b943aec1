"""What we read in an array is what cv2 reads in it: cv2 answers alike on both, bit for bit."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from cv_densityf._engine import original
from cv_densityf._points import as_array, as_matches, n_points
from cv_densityf.datasets import two_view_scene

N = 120
SCENE = two_view_scene(N, inlier_ratio=0.7, random_state=3)
POINTS = SCENE.points1.astype(np.float32)
OTHER = SCENE.points2.astype(np.float32)
WEIGHTS = np.random.default_rng(0).uniform(0.3, 3, (N, 1))
WEIGHTS[[5, 6, 7, 8], 0] = 0, -1, np.nan, np.inf
HOMOGENEOUS = np.c_[POINTS * np.where(WEIGHTS == 0, 1, WEIGHTS), WEIGHTS]


class NamedArray(np.ndarray):
    pass


READ = {
    "float32": POINTS,
    "float64": SCENE.points1,
    "float64 between two float32": POINTS + 1e-9,
    "float64 beyond float32": np.where(np.arange(N)[:, None] == 3, 1e300, SCENE.points1),
    "float16": POINTS.astype(np.float16),
    "int8": (POINTS % 120).astype(np.int8),
    "uint8": (POINTS % 250).astype(np.uint8),
    "int16": POINTS.astype(np.int16),
    "uint16": POINTS.astype(np.uint16),
    "int32": POINTS.astype(np.int32),
    "int32 beyond float32": POINTS.astype(np.int32) + 2**24,
    "int64": POINTS.astype(np.int64),
    "int64 beyond int32": POINTS.astype(np.int64) + 2**33,
    "uint64": POINTS.astype(np.uint64),
    "uint64 beyond int32": POINTS.astype(np.uint64) + np.uint64(2**31),
    "(N, 1, 2)": POINTS[:, None],
    "(1, N, 2)": POINTS[None],
    "(N, 2, 1)": POINTS[:, :, None],
    "(N, 3)": HOMOGENEOUS,
    "(N, 3) float32": HOMOGENEOUS.astype(np.float32),
    "(N, 1, 3)": HOMOGENEOUS[:, None],
    "(1, N, 3) float32": HOMOGENEOUS[None].astype(np.float32),
    "Fortran order": np.asfortranarray(POINTS),
    "strided": np.repeat(POINTS, 2, axis=0)[::2],
    "reversed": POINTS[::-1].copy()[::-1],
    "columns of a wider table": np.c_[OTHER, POINTS, OTHER][:, 2:4],
    "matrix": POINTS.view(np.matrix),
    "masked": np.ma.array(POINTS, mask=POINTS > 500),
    "subclass": POINTS.view(NamedArray),
    "UMat": cv2.UMat(POINTS),
    "UMat of two channels": cv2.UMat(POINTS[:, None]),
    "NaN and infinity": np.where(np.arange(N)[:, None] % 9 == 4, [np.nan, np.inf], POINTS),
}
USAC_ONLY = {
    "(2, N)": np.ascontiguousarray(POINTS.T),
    "(2, N) view": POINTS.T,
    "(N, 3) int32": np.c_[POINTS.astype(np.int32), np.arange(N, dtype=np.int32)],
}
LEFT_TO_CV2 = {
    "list": POINTS.tolist(),
    "tuple": tuple(map(tuple, POINTS.tolist())),
    "None": None,
    "number": 3.0,
    "big endian": POINTS.astype(">f4"),
    "uint32": POINTS.astype(np.uint32),
    "bool": POINTS > 500,
    "longlong": POINTS.astype("q") if np.dtype("q").num != np.dtype("i8").num else None,
    "longdouble": POINTS.astype(np.longdouble),
    "complex": POINTS.astype(complex),
    "object": POINTS.astype(object),
    "cv2.Mat": cv2.Mat(POINTS),
    "packed records": np.zeros(N, dtype=[("octave", "u1"), ("point", "f4", 2)])["point"],
}
WRONG_SHAPE = {
    "(N,)": POINTS[:, 0],
    "(N, 1)": POINTS[:, :1],
    "(N, 4)": np.c_[POINTS, POINTS],
    "(N/2, 2, 2)": POINTS.reshape(-1, 2, 2),
    "(3, N)": HOMOGENEOUS.T,
    "(1, N, 2, 1)": POINTS[None, :, :, None],
    "0-d": np.array(1.0),
}


def same_answer(one, two):
    if one[0] is None or two[0] is None:
        return one[0] is two[0]
    return np.array_equal(one[0], two[0], equal_nan=True) and np.array_equal(
        mask_of(one), mask_of(two)
    )


def mask_of(answer):
    mask = answer[1].get() if isinstance(answer[1], cv2.UMat) else answer[1]
    return mask.ravel()


def read(points, usac):
    array = as_array(points)
    n = n_points(array, usac)
    return as_matches(array, OTHER, n, usac)


@pytest.mark.parametrize(
    "method", [cv2.FM_8POINT, cv2.FM_RANSAC, cv2.FM_LMEDS, cv2.USAC_ACCURATE, cv2.USAC_MAGSAC]
)
@pytest.mark.parametrize("name", [*READ, *USAC_ONLY])
def test_reads_what_cv2_reads(name, method):
    usac = method >= cv2.USAC_DEFAULT
    if name in USAC_ONLY and not usac:
        assert n_points(as_array(USAC_ONLY[name]), usac) is None
        return
    points = {**READ, **USAC_ONLY}[name]
    X = read(points, usac)
    assert X.shape == (N, 4)
    assert X.flags.c_contiguous
    ours = X.astype(np.float32)
    np.testing.assert_array_equal(ours, X)
    if method == cv2.FM_8POINT and "NaN" in name:
        return
    answer = original(points, OTHER, method, 2.0, 0.99, 300)
    assert answer[0] is not None or name.startswith(("int8", "uint8", "int32 beyond", "uint64 b"))
    assert same_answer(answer, original(ours[:, :2], ours[:, 2:], method, 2.0, 0.99, 300))


@pytest.mark.parametrize("name", LEFT_TO_CV2)
def test_leaves_doubtful_types_to_cv2(name):
    assert as_array(LEFT_TO_CV2[name]) is None


@pytest.mark.parametrize("usac", [False, True])
@pytest.mark.parametrize("name", WRONG_SHAPE)
def test_leaves_doubtful_shapes_to_cv2(name, usac):
    assert n_points(WRONG_SHAPE[name], usac) is None


def test_does_not_touch_the_input():
    points = HOMOGENEOUS.copy()
    points.flags.writeable = False
    read(points, usac=False)
    read(points, usac=True)
    np.testing.assert_array_equal(points, HOMOGENEOUS)


def test_homogeneous_points_are_divided_by_the_classic_methods_only():
    points = np.c_[2.0 * POINTS, np.full(N, 2.0)]
    np.testing.assert_array_equal(read(points, usac=False)[:, :2], POINTS)
    np.testing.assert_array_equal(read(points, usac=True)[:, :2], 2 * POINTS)
