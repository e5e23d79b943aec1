"""What differs between the releases of OpenCV, all in one place."""

from __future__ import annotations

import platform

import cv2

OPENCV: tuple[int, int] = tuple(int(part) for part in cv2.__version__.split(".")[:2])  # type: ignore[assignment]

#: float16 points are read.
READS_FLOAT16 = OPENCV >= (4, 8)
#: uint32 and bool points are read.
READS_UINT32_AND_BOOL = OPENCV >= (5, 0)
#: A read-only array as ``mask`` is an error; before, it was written.
REFUSES_READ_ONLY_MASK = OPENCV >= (4, 9)
#: A bool array as ``mask`` is an error; since, it is ignored.
REFUSES_BOOL_MASK = OPENCV < (5, 0)
#: Graph cut runs out of memory or kills the process above 46,340 points.
GRAPH_CUT_DIES = OPENCV >= (5, 0)
#: The stub that comes with cv2 lists the overloads.
STUB_HAS_OVERLOADS = OPENCV >= (4, 8)
#: Compilers for other processors may fuse multiplications and additions: the last bit of a residual
#: is only known here.
EXACT_ARITHMETIC = platform.machine().lower() in ("x86_64", "amd64")


def applies(condition: str) -> bool:
    """Whether a condition such as ``*``, ``4.13`` or ``>=4.8`` holds for the installed OpenCV."""
    if condition == "*":
        return True
    for sign, holds in (
        (">=", OPENCV.__ge__),
        ("<=", OPENCV.__le__),
        (">", OPENCV.__gt__),
        ("<", OPENCV.__lt__),
        ("", OPENCV.__eq__),
    ):
        if condition.startswith(sign):
            major, minor = condition.removeprefix(sign).split(".")
            return bool(holds((int(major), int(minor))))
    raise AssertionError(condition)
