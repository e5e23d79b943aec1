"""Any point array that cv2 takes, as rows x, y, x', y'.

Only arrays whose meaning to cv2 is certain are read; the rest answer None, and the caller leaves
them to cv2.
"""

from __future__ import annotations

from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

#: Type numbers that every release reads. Not dtypes: cv2 refuses ``longlong``, which equals int64.
_NUMBERS = frozenset(
    np.dtype(name).num for name in ("f2", "f4", "f8", "i1", "u1", "i2", "u2", "i4", "i8", "u8")
)
#: cv2 has no 64-bit integers: it drops their upper half.
_WRAPPED = frozenset((np.dtype("i8"), np.dtype("u8")))
_FLOATS = frozenset((np.dtype("f4"), np.dtype("f8")))


def as_array(points: Any) -> NDArray[Any] | None:
    """Return the array in ``points``, or None if cv2 may read something else in it."""
    if isinstance(points, cv2.UMat):
        points = points.get()
    if not isinstance(points, np.ndarray) or isinstance(points, cv2.Mat):
        return None
    # cv2 does not swap the bytes of the other byte order.
    if points.dtype.num not in _NUMBERS or not points.dtype.isnative:
        return None
    # Fields of packed records, which cv2 refuses before OpenCV 5.
    if any(step % points.itemsize for step in points.strides):
        return None
    return np.asarray(points)


def as_umat(array: NDArray[Any]) -> cv2.UMat:
    """Copy an array into a UMat: cv2's stub does not know that constructor."""
    constructor: Any = cv2.UMat
    return cast(cv2.UMat, constructor(array))


def n_points(points: NDArray[Any], usac: bool) -> int | None:
    """Count the points of an array the way cv2 does; None for a shape it refuses or bends."""
    shape = points.shape
    if len(shape) == 3:
        if shape[2] == 1:
            shape = shape[:2]
        elif 1 in shape[:2]:
            shape = (shape[0] * shape[1], shape[2])
    if len(shape) != 2:
        return None
    if shape[1] == 2 or (shape[1] == 3 and (usac or points.dtype in _FLOATS)):
        return int(shape[0])
    return int(shape[1]) if usac and shape[0] == 2 and points.ndim == 2 else None


def as_columns(points: NDArray[Any], n: int, usac: bool) -> NDArray[np.float32]:
    """Turn the ``n`` points of an array into (n, 2) float32, rounded as cv2 rounds them.

    A third column is a homogeneous weight that the classic methods divide by, once rounded to the
    array's own precision, and that USAC ignores.
    """
    table = points.T if points.shape == (2, n) else points.reshape(n, -1)
    if table.dtype in _WRAPPED:
        table = table.astype(np.int32)
    with np.errstate(all="ignore"):
        if table.shape[1] == 3 and not usac:
            w = table[:, 2:]
            table = table[:, :2] * (1 / np.where(w != 0, w, table.dtype.type(1)))
        return np.asarray(table[:, :2].astype(np.float32))


def as_matches(
    points1: NDArray[Any], points2: NDArray[Any], n: int, usac: bool
) -> NDArray[np.float64]:
    """Join two arrays of ``n`` points to the rows x, y, x', y', (n, 4)."""
    X = np.empty((n, 4))
    X[:, :2] = as_columns(points1, n, usac)
    X[:, 2:] = as_columns(points2, n, usac)
    return X
