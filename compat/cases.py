"""One table of calls: what people write, what cv2 accepts or refuses, and where it has nothing."""

from __future__ import annotations

import enum
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from typing import Any

import cv2
import numpy as np

from compat import versions
from compat.rules import USAC, rule_of
from compat.scenes import DEGENERATE, degenerate, scene

METHODS = {
    "FM_7POINT": 1,
    "FM_8POINT": 2,
    "FM_LMEDS": 4,
    "FM_RANSAC": 8,
    "USAC_DEFAULT": 32,
    "USAC_PARALLEL": 33,
    "USAC_FM_8PTS": 34,
    "USAC_FAST": 35,
    "USAC_ACCURATE": 36,
    "USAC_PROSAC": 37,
    "USAC_MAGSAC": 38,
    "UsacParams": None,
}
#: One of each code path in cv2.
PATHS = {name: METHODS[name] for name in ("FM_8POINT", "FM_LMEDS", "FM_RANSAC", "USAC_FAST")}
#: Its result depends on the timing of threads.
PARALLEL = cv2.USAC_PARALLEL

N = 60


@dataclass(frozen=True, eq=False)
class Case:
    """A call. ``build`` makes fresh arguments each time: calls may write into them."""

    id: str
    build: Callable[[], tuple[tuple[Any, ...], dict[str, Any]]]
    #: cv2 raises.
    refused: bool = False
    #: cv2 answers differently from run to run, or by luck: only the form is compared.
    unstable: bool = False
    #: Solved without sampling: the same F is due.
    direct: bool = False
    #: The points as rows, where the mask can be worked out from F.
    X: np.ndarray | None = None
    rule: str | None = None
    threshold: float = 3.0


def params(**settings):
    made = cv2.UsacParams()
    made.maxIterations = 300
    for name, value in settings.items():
        setattr(made, name, value)
    return made


def halves(X, kind=np.float32):
    return np.ascontiguousarray(X[:, :2], kind), np.ascontiguousarray(X[:, 2:], kind)


def call(*args, **kwargs):
    """Build the same arguments each time: for calls that write nowhere."""
    return lambda: (args, kwargs)


def with_method(X, method, threshold=None, confidence=0.99, max_iters=300):
    """Call a method with its numbers, in whichever overload takes them."""
    p1, p2 = halves(X)
    if method is None:
        numbers = {} if threshold is None else {"threshold": threshold}
        made = params(confidence=confidence, maxIterations=max_iters, **numbers)
        return call(p1, p2, made)
    threshold = 3.0 if threshold is None else threshold
    return call(p1, p2, method, threshold, confidence, max_iters)


# -------------------------------------------------------------------------------------- the calls


def overload_forms() -> Iterator[Case]:
    """Positions, keywords, defaults, and what belongs to no overload."""
    p1, p2 = halves(scene(N)[0])
    names = ("method", "ransacReprojThreshold", "confidence", "maxIters")
    values = (8, 2.0, 0.9, 30)
    for k in range(5):
        for by_name in range(5):
            # k numbers by position, then by_name of the rest by keyword
            rest = dict(list(zip(names, values, strict=True))[k : k + by_name])
            if len(rest) == by_name:
                id_ = f"forms/{k} by position, then {' '.join(rest) or 'nothing'}"
                yield Case(id_, call(p1, p2, *values[:k], **rest))
    accepted = {
        "all by keyword": ((), dict(zip(names, values, strict=True), points1=p1, points2=p2)),
        "keywords in another order": ((), {"points2": p2, "method": 4, "points1": p1}),
        "points2 by keyword": ((p1,), {"points2": p2}),
        "confidence alone": ((p1, p2), {"confidence": 0.5}),
        "threshold alone": ((p1, p2), {"ransacReprojThreshold": 0.5}),
        "mask=None": ((p1, p2), {"mask": None}),
        "mask=None, maxIters": ((p1, p2, *values), {"mask": None}),
        "mask None by position": ((p1, p2, 8, 2.0, 0.9, 30, None), {}),
        "None for maxIters": ((p1, p2, 8, 2.0, 0.9, None), {}),
        "maxIters=None": ((p1, p2, 8, 2.0, 0.9), {"maxIters": None}),
        "float for maxIters": ((p1, p2, 8, 2.0, 0.9, 30.0), {}),
        "bool for maxIters": ((p1, p2, 8, 2.0, 0.9, True), {}),
        "numpy float for maxIters": ((p1, p2, 8, 2.0, 0.9, np.float64(30)), {}),
        "None for method": ((p1, p2, None), {}),
        "None for all numbers but maxIters": ((p1, p2, None, None, None), {}),
        "None for all numbers": ((p1, p2, None, None, None, None), {}),
        "UsacParams by position": ((p1, p2, params()), {}),
        "UsacParams by keyword": ((p1, p2), {"params": params()}),
        "params=None": ((p1, p2), {"params": None}),
        "UsacParams and mask=None": ((p1, p2, params()), {"mask": None}),
        "UsacParams and None": ((p1, p2, params(), None), {}),
        "everything by keyword with UsacParams": (
            (),
            {"points1": p1, "points2": p2, "params": params(), "mask": None},
        ),
    }
    for name, (args, kwargs) in accepted.items():
        yield Case(f"forms/{name}", call(*args, **kwargs))
    refused = {
        "no arguments": ((), {}),
        "one argument": ((p1,), {}),
        "points2 only": ((), {"points2": p2}),
        "points1 twice": ((p1, p2), {"points1": p1}),
        "method twice": ((p1, p2, 8), {"method": 8}),
        "maxIters without the rest": ((p1, p2), {"maxIters": 30}),
        "maxIters without threshold and confidence": ((p1, p2, 8), {"maxIters": 30}),
        "maxIters without confidence": ((p1, p2, 8, 2.0), {"maxIters": 30}),
        "maxIters without method": (
            (p1, p2),
            {"maxIters": 30, "confidence": 0.9, "ransacReprojThreshold": 2.0},
        ),
        "float for maxIters by keyword": ((p1, p2, 8, 2.0, 0.9), {"maxIters": 30.0}),
        "method and UsacParams": ((p1, p2, 8), {"params": params()}),
        "UsacParams and a threshold": ((p1, p2, params()), {"ransacReprojThreshold": 2.0}),
        "UsacParams as method by keyword": ((p1, p2), {"method": params()}),
        "a number as params": ((p1, p2), {"params": 8}),
        "a string as params": ((p1, p2), {"params": "USAC_MAGSAC"}),
        "a dict as params": ((p1, p2), {"params": {}}),
        "camera matrix third": ((p1, p2, np.eye(3), 8, 1.0), {}),
        "eight arguments": ((p1, p2, 8, 2.0, 0.9, 30, None, None), {}),
        "mask twice": ((p1, p2, 8, 2.0, 0.9, 30, None), {"mask": None}),
        **{
            f"unknown keyword {name}": ((p1, p2, 8), {name: 1.0})
            for name in ("threshold", "param1", "param2", "prob", "max_iters", "ransac", "dtype")
        },
    }
    for name, (args, kwargs) in refused.items():
        yield Case(f"forms/{name}", call(*args, **kwargs), refused=True)


class _Method(enum.IntEnum):
    RANSAC = 8


class _Flags(enum.IntFlag):
    RANSAC = 8


class _Integer(int):
    pass


class _Double(float):
    pass


class _Convertible:
    def __index__(self):
        return 8

    __int__ = __index__

    def __float__(self):
        return 8.0


INTEGERS = {
    "int": 8,
    "IntEnum": _Method.RANSAC,
    "IntFlag": _Flags.RANSAC,
    "subclass of int": _Integer(8),
    **{t: np.dtype(t).type(8) for t in ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8")},
    "None": None,
    "largest": 2**31 - 1,
    "smallest": -(2**31),
}
NO_INTEGERS = {
    "True": True,
    "numpy bool": np.bool_(True),
    "float": 8.0,
    "numpy float": np.float64(8),
    "float32": np.float32(8),
    "str": "8",
    "bytes": b"8",
    "__index__": _Convertible(),
    "array 0-d": np.array(8),
    "array of one": np.array([8]),
    "list": [8],
    "too large": 2**31,
    "too small": -(2**31) - 1,
    "huge": 10**30,
    "complex": 8j,
    "Decimal": Decimal(8),
}
DOUBLES = {
    "float": 0.5,
    "subclass of float": _Double(0.5),
    "int": 1,
    "large int": 10**30,
    "numpy float64": np.float64(0.5),
    "numpy float32": np.float32(0.5),
    "numpy float16": np.float16(0.5),
    **{t: np.dtype(t).type(1) for t in ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8")},
    "None": None,
    "IntEnum": _Method.RANSAC,
}
NO_DOUBLES = {
    "True": True,
    "numpy bool": np.bool_(True),
    "str": "0.5",
    "__float__": _Convertible(),
    "longdouble": np.longdouble(0.5),
    "complex": 0.5j,
    "Decimal": Decimal("0.5"),
    "Fraction": Fraction(1, 2),
    "array 0-d": np.array(0.5),
    "array of one": np.array([0.5]),
    "list": [0.5],
    "tuple": (0.5,),
    "too large": 10**400,
}


def scalars() -> Iterator[Case]:
    """Every kind of number in every number's place."""
    p1, p2 = halves(scene(N)[0])
    for good, values in ((True, INTEGERS), (False, NO_INTEGERS)):
        for name, value in values.items():
            refused = not good
            yield Case(f"scalars/method {name}", call(p1, p2, value), refused)
            yield Case(f"scalars/method= {name}", call(p1, p2, method=value), refused)
            yield Case(f"scalars/method {name}, 6", call(p1, p2, value, 1.0, 0.9, 30), refused)
            # By keyword only: in the sixth place what is no integer is a mask, which it may be.
            if name != "largest":  # of iterations: nobody would wait for the last
                yield Case(
                    f"scalars/maxIters= {name}",
                    call(p1, p2, 8, 1.0, 0.9, maxIters=value),
                    refused,
                )
    for good, values in ((True, DOUBLES), (False, NO_DOUBLES)):
        for name, value in values.items():
            refused = not good
            yield Case(f"scalars/threshold {name}", call(p1, p2, 8, value), refused)
            yield Case(f"scalars/threshold {name}, 6", call(p1, p2, 8, value, 0.9, 30), refused)
            yield Case(
                f"scalars/threshold= {name}", call(p1, p2, ransacReprojThreshold=value), refused
            )
            yield Case(f"scalars/confidence {name}", call(p1, p2, 8, 1.0, value), refused)
            yield Case(f"scalars/confidence {name}, 6", call(p1, p2, 8, 1.0, value, 30), refused)
            yield Case(f"scalars/confidence= {name}", call(p1, p2, confidence=value), refused)
    for name, value in {"str": "30", "list": [30], "bytes": b"30", "object": object()}.items():
        yield Case(f"scalars/sixth {name}", call(p1, p2, 8, 1.0, 0.9, value), refused=True)


def inputs() -> Iterator[Case]:
    """Arrays that cv2 reads, bends, or refuses; classic methods and USAC differ."""
    X = scene(N)[0]
    p1, p2 = halves(X)
    weight = np.linspace(0.5, 2, N, dtype=np.float32)[:, None]
    both: dict[str, Callable[[np.ndarray], Any]] = {
        "float32": lambda p: p,
        "float64": lambda p: p.astype(np.float64),
        "int8": lambda p: (p % 120).astype(np.int8),
        "uint8": lambda p: (p % 250).astype(np.uint8),
        "int16": lambda p: p.astype(np.int16),
        "uint16": lambda p: p.clip(0).astype(np.uint16),
        "int32": lambda p: p.astype(np.int32),
        "int64": lambda p: p.astype(np.int64),
        "uint64": lambda p: p.clip(0).astype(np.uint64),
        "int64 beyond int32": lambda p: p.astype(np.int64) + 2**33,
        "(N, 1, 2)": lambda p: p[:, None],
        "(1, N, 2)": lambda p: p[None],
        "(N, 2, 1)": lambda p: p[:, :, None],
        "(N, 3)": lambda p: np.hstack([p * weight, weight]),
        "(N, 1, 3)": lambda p: np.hstack([p * weight, weight])[:, None],
        "(N, 3) float64": lambda p: np.hstack([p * weight, weight]).astype(np.float64),
        "(N, 3) a weight of 0": lambda p: np.hstack([p, np.arange(N, dtype="f4")[:, None]]),
        "Fortran order": np.asfortranarray,
        "transposed view": lambda p: np.ascontiguousarray(p.T).T,
        "every second row": lambda p: np.repeat(p, 2, axis=0)[::2],
        "reversed view": lambda p: p[::-1].copy()[::-1],
        "columns of a table": lambda p: np.hstack([p, p, p])[:, 2:4],
        "read-only": _read_only,
        "matrix": lambda p: p.view(np.matrix),
        "masked array": lambda p: np.ma.array(p, mask=p > 500),
        "UMat": cv2.UMat,
        "UMat of two channels": lambda p: cv2.UMat(p[:, None]),
    }
    usac_only: dict[str, Callable[[np.ndarray], Any]] = {
        "(2, N)": lambda p: np.ascontiguousarray(p.T),
        "(2, N) view": lambda p: p.T,
        "(N, 4)": lambda p: np.hstack([p, p]),
        "(N/2, 2, 2)": lambda p: p.reshape(-1, 2, 2),
    }
    neither: dict[str, Callable[[np.ndarray], Any]] = {
        "list": lambda p: p.tolist(),
        "list of tuples": lambda p: [tuple(row) for row in p.tolist()],
        "list of arrays": list,
        "empty list": lambda p: [],
        "tuple of tuples": lambda p: tuple(map(tuple, p.tolist())),
        "tuple of numbers": lambda p: tuple(p.ravel().tolist()[:4]),
        "memoryview": memoryview,
        "str": lambda p: "points",
        "None": lambda p: None,
        "number": lambda p: 3.0,
        "object array": lambda p: p.astype(object),
        "complex": lambda p: p.astype(complex),
        "longdouble": lambda p: p.astype(np.longdouble),
        "datetime": lambda p: p.astype("i8").astype("M8[s]"),
        "(N,)": lambda p: p[:, 0].copy(),
        "(2N,)": lambda p: p.ravel(),
        "(N, 1)": lambda p: p[:, :1].copy(),
        "(N, 1, 2, 1)": lambda p: p[:, None, :, None],
        "0-d": lambda p: np.array(1.0),
        "(0,)": lambda p: np.array([]),
    }
    for table, classic_ok, usac_ok in (
        (both, True, True),
        (usac_only, False, True),
        (neither, False, False),
    ):
        for name, convert in table.items():
            for method_name, method in {**PATHS, "USAC_MAGSAC": 38, "UsacParams": None}.items():
                ok = usac_ok if method is None or method in USAC else classic_ok
                third = method if method is not None else params()
                yield Case(
                    f"inputs/{name}/{method_name}",
                    call(convert(p1), convert(p2), third, mask=None),
                    refused=not ok,
                )
    version_dependent = {
        "float16": (np.float16, versions.READS_FLOAT16),
        "uint32": (np.uint32, versions.READS_UINT32_AND_BOOL),
        "bool": (np.bool_, versions.READS_UINT32_AND_BOOL),
        "big endian": (">f4", True),
    }
    for (name, (kind, ok)), (method_name, method) in itertools.product(
        version_dependent.items(), PATHS.items()
    ):
        # Bits of the other byte order and truth values are hardly points: what comes out is luck.
        luck = name in ("bool", "big endian")
        points = p1.clip(0).astype(kind), p2.clip(0).astype(kind)
        yield Case(
            f"inputs/{name}/{method_name}", call(*points, method), refused=not ok, unstable=luck
        )
    mixed = {
        "float32, float64": (p1, p2.astype(np.float64)),
        "int32, float32": (p1.astype(np.int32), p2),
        "(N, 2), (N, 1, 2)": (p1, p2[:, None]),
        "(N, 3), (N, 2)": (np.hstack([p1 * weight, weight]), p2),
        "UMat, array": (cv2.UMat(p1), p2),
        "array, UMat": (p1, cv2.UMat(p2)),
    }
    unequal = {
        "one short": (p1, p2[:-1]),
        "one long": (p1[:-1], p2),
        "second empty": (p1, p2[:0]),
        "second of one": (p1, p2[:1]),
    }
    for method_name, method in {**PATHS, "UsacParams": None}.items():
        third = method if method is not None else params()
        for name, points in mixed.items():
            yield Case(f"inputs/{name}/{method_name}", call(*points, third))
        for name, points in unequal.items():
            yield Case(f"inputs/{name}/{method_name}", call(*points, third), refused=True)
    for n, method in itertools.product((2, 3), (cv2.FM_8POINT, cv2.FM_LMEDS, cv2.FM_RANSAC)):
        points = p1[:n].T.copy()  # as well n rows of two or three numbers
        yield Case(f"inputs/(2, {n}) of {n} points/{method}", call(points, points, method))
    nothing = np.full((N // 2, 2, 2), np.nan, np.float32)
    for method in (cv2.USAC_FAST, cv2.USAC_MAGSAC):
        # The mask of a failure has as many rows as the array, half of the points.
        yield Case(f"inputs/(N/2, 2, 2) of NaN/{method}", call(nothing, nothing, method))
    empties = {"(0, 2)": (0, 2), "(0, 1, 2)": (0, 1, 2), "(0, 3)": (0, 3)}
    for (name, shape), (method_name, method) in itertools.product(empties.items(), PATHS.items()):
        points = np.zeros(shape, np.float32)
        yield Case(f"inputs/{name}/{method_name}", call(points, points, method), method in USAC)


def _read_only(points):
    copy = points.copy()
    copy.flags.writeable = False
    return copy


def method_numbers() -> Iterator[Case]:
    """Any integer is a method to cv2: what it does not know is LMEDS."""
    for n in (N, 15, 14, 12, 7, 6):
        X = scene(n)[0]
        for method in (*range(-10, 70), 100, 1000, 2**31 - 1, -(2**31)):
            if n in (14, 15) and method not in range(20):
                continue  # RANSAC is LMEDS below 15 points
            yield Case(
                f"methods/{method}, n={n}",
                with_method(X, method, 2.0),
                refused=n < 7 and method in USAC,
                unstable=method == PARALLEL or (n == 7 and method in USAC),
                direct=method not in USAC and n >= 7 and (n == 7 or method == 2),
                X=X,
                rule=rule_of(method, n),
                threshold=2.0,
            )


def numbers() -> Iterator[Case]:
    """Thresholds, confidences and iterations inside and outside of their range."""
    X = scene(N)[0]
    nan, inf = float("nan"), float("inf")
    thresholds = (0.0, -1.0, 1e-4, 0.01, 0.5, 1, 10.0, 1e9, inf, -inf, nan)
    confidences = (-1.0, 0.0, 1e-300, 1e-3, 0.5, 0.999999, 1.0, 99.0, inf, nan)
    iterations = (-(2**31), -1, 0, 1, 2, 100, 2**31 - 1)
    for name, method in METHODS.items():
        usac = method is None or method in USAC
        magsac = method == cv2.USAC_MAGSAC
        loose = {"unstable": method == PARALLEL}
        rule = {"X": X, "rule": rule_of(method, N)}
        for t in thresholds:
            # MAGSAC's own sampler finds too few points within a small threshold.
            refused = magsac and abs(t) <= 1e-3
            yield Case(
                f"numbers/threshold {t}/{name}",
                with_method(X, method, t),
                refused=refused,
                **loose,
                **rule,
                threshold=t,
            )
        for c in confidences:
            refused = c != c and not usac and method != cv2.FM_8POINT
            yield Case(
                f"numbers/confidence {c}/{name}",
                with_method(X, method, 2.0, c),
                refused=refused,
                **loose,
                **rule,
                threshold=2.0,
            )
        for i in iterations:
            if usac and i == 2**31 - 1:
                continue  # without a confident end that is hours
            yield Case(
                f"numbers/maxIters {i}/{name}",
                with_method(X, method, 2.0, 0.99, i),
                # One or two samples find a model by luck.
                unstable=method == PARALLEL or (usac and i in (1, 2)),
                **rule,
                threshold=2.0,
            )
    settings = {
        "sampler": range(4),
        "score": range(4),
        "loMethod": range(5),
        "neighborsSearch": range(3),
        "randomGeneratorState": (0, 1, 7, -1, 2**31 - 1),
        "loIterations": (0, 1, 50),
        "loSampleSize": (8, 14, 50),
    }
    for name, values in settings.items():
        for value in values:
            yield Case(
                f"numbers/UsacParams {name} {value}",
                call(*halves(X), params(threshold=2.0, **{name: value})),
                X=X,
                rule="usac",
                threshold=2.0,
            )
    for name, value in (("sampler", 99), ("score", 99), ("loMethod", 99), ("loSampleSize", -1)):
        made = params(**{name: value})
        yield Case(f"numbers/UsacParams {name} {value}", call(*halves(X), made), refused=True)
    made = params(isParallel=True)
    yield Case("numbers/UsacParams isParallel", call(*halves(X), made), unstable=True)


def counts() -> Iterator[Case]:
    """From no point at all to the first that are sampled."""
    for n in range(21):
        for (name, method), good in itertools.product(METHODS.items(), (True, False)):
            X = scene(n, inlier_ratio=1.0 if good else 0.5, seed=n)[0]
            usac = method is None or method in USAC
            yield Case(
                f"counts/{n} {'good' if good else 'half wrong'}/{name}",
                with_method(X, method),
                refused=usac and n < (8 if method == cv2.USAC_FM_8PTS else 7),
                unstable=method == PARALLEL,
                direct=not usac and (n == 7 or (n > 7 and method == cv2.FM_8POINT)),
                X=X,
                rule=rule_of(method, n),
                threshold=1.5 if method is None else 3.0,
            )


def degenerate_points() -> Iterator[Case]:
    """Geometry that fixes no F, and coordinates that are no numbers."""
    hopeless = ("one point", "two points", "zeros", "huge", "NaN", "infinity")
    # cv2's classic methods refuse samples on a line, USAC makes something up.
    lines = ("line in both", "line in one")
    classic = (cv2.FM_7POINT, cv2.FM_8POINT, cv2.FM_LMEDS, cv2.FM_RANSAC)
    for kind, n in itertools.product(DEGENERATE, (7, 8, 12, 15, N)):
        X = degenerate(kind, n)
        for name, method in METHODS.items():
            if method == PARALLEL or (method == cv2.USAC_FM_8PTS and n < 8):
                continue
            rule = rule_of(method, n)
            if not np.isfinite(X).all() and rule == "lmeds":
                rule = None
            yield Case(
                f"degenerate/{kind}, n={n}/{name}",
                with_method(X, method),
                unstable=n >= 15
                and not (kind in hopeless or (kind in lines and method in classic)),
                X=X,
                rule=rule,
                threshold=1.5 if method is None else 3.0,
            )


def far_away() -> Iterator[Case]:
    """Good matches at large coordinates, where float32 cannot hold USAC's residuals any more."""
    for offset in (1e4, 1e5, 1e6):
        X = scene(200, 0.8, 0.3)[0] + np.float32(offset)
        for name, method in METHODS.items():
            yield Case(
                f"far away/{offset:g}/{name}",
                with_method(X, method, 2.0),
                unstable=True,
                X=X,
                rule=rule_of(method, len(X)),
                threshold=2.0,
            )


def stacked_solutions() -> Iterator[Case]:
    """Seven points with one, two and three matrices through them."""
    rng = np.random.default_rng(0)
    for number, size in enumerate((3,) * 20 + (4,) * 20 + (1000,) * 5):
        X = rng.integers(0, size, (7, 4)).astype(np.float32)
        for name, method in (("FM_7POINT", 1), ("FM_RANSAC", 8)):
            yield Case(
                f"solutions/{number} of {size} x {size} pixels/{name}",
                with_method(X, method),
                direct=True,
                X=X,
                rule="all",
            )


def not_numbers() -> Iterator[Case]:
    """Some coordinates that are NaN or infinite: those points are no inliers."""
    for value, share in itertools.product((np.nan, np.inf, -np.inf), (0.05, 0.3)):
        X = scene(N, inlier_ratio=0.9)[0]
        rng = np.random.default_rng(1)
        rows = rng.permutation(N)[: round(share * N)]
        X[rows, rng.integers(0, 4, len(rows))] = value
        for name, method in METHODS.items():
            rule = rule_of(method, N)
            yield Case(
                f"not numbers/{value} in {len(rows)} rows/{name}",
                with_method(X, method),
                unstable=method == PARALLEL,
                direct=method == cv2.FM_8POINT,
                X=X,
                rule=None if rule == "lmeds" else rule,
                threshold=1.5 if method is None else 3.0,
            )


def _masks(n: int) -> dict[str, Callable[[], Any]]:
    def filled(shape, kind=np.uint8):
        return np.full(shape, 9, kind)

    return {
        "(N, 1)": lambda: filled((n, 1)),
        "(N,)": lambda: filled(n),
        "(1, N)": lambda: filled((1, n)),
        "column of a table": lambda: filled((n, 2))[:, :1],
        "every second row": lambda: filled((2 * n, 1))[::2],
        "transposed row": lambda: filled((1, n)).T,
        "upside down, int32": lambda: filled((n, 1), np.int32)[::-1],
        "by columns, float32": lambda: np.asfortranarray(filled((n, 2), np.float32)),
        "without axes": lambda: filled(()),
        "too long": lambda: filled((n + 1, 1)),
        "too short": lambda: filled((n - 1, 1)),
        "empty": lambda: filled((0, 1)),
        "(N, 2)": lambda: filled((n, 2)),
        "int8": lambda: filled((n, 1), np.int8),
        "int32": lambda: filled((n, 1), np.int32),
        "float32": lambda: filled((n, 1), np.float32),
        "float64": lambda: filled((n, 1), np.float64),
        "int": lambda: 1,
        "float": lambda: 1.0,
        "bool": lambda: np.ones((n, 1), bool),
        "read-only": lambda: _read_only(filled((n, 1))),
        "UMat": lambda: cv2.UMat(filled((n, 1))),
        "empty UMat": lambda: cv2.UMat(),
        "list": lambda: [0] * n,
        "str": lambda: "mask",
        "object array": lambda: filled((n, 1)).astype(object),
    }


def masks() -> Iterator[Case]:
    """``mask=`` in every state, with and without a model to report."""
    numbers = (8, 3.0, 0.99)
    scenes = {
        "found": (scene(N)[0], {**PATHS, "USAC_MAGSAC": 38, "UsacParams": None}),
        "seven points": (scene(7, 1.0)[0], {"FM_RANSAC": 8, "FM_7POINT": 1}),
        "six points": (scene(6, 1.0)[0], {"FM_RANSAC": 8, "FM_LMEDS": 4}),
        "twelve points": (scene(12, 1.0)[0], {"FM_RANSAC": 8, "USAC_FAST": 35}),
        "nothing found": (
            degenerate("NaN", N),
            {"FM_LMEDS": 4, "FM_RANSAC": 8, "USAC_FAST": 35, "UsacParams": None},
        ),
    }
    for situation, (X, methods) in scenes.items():
        n = len(X)
        p1, p2 = halves(X)
        for (name, make), (method_name, method) in itertools.product(
            _masks(n).items(), methods.items()
        ):
            refused = name in ("list", "str", "object array")
            refused |= name in ("transposed row", "upside down, int32", "by columns, float32")
            refused |= name == "bool" and versions.REFUSES_BOOL_MASK
            refused |= name == "read-only" and versions.REFUSES_READ_ONLY_MASK
            sampled = n > 7 and method in (cv2.FM_LMEDS, cv2.FM_RANSAC)
            refused |= name in ("column of a table", "every second row") and (
                sampled and situation != "nothing found"
            )
            third = params() if method is None else method
            # Nobody but cv2 before 4.9 writes to a read-only one.
            untouched = situation == "nothing found" and name == "read-only"
            yield Case(
                f"masks/{name}, {situation}/{method_name}",
                lambda make=make, p1=p1, p2=p2, third=third: ((p1, p2, third), {"mask": make()}),
                refused=refused,
                X=X,
                rule=None if untouched else rule_of(method, n),
                threshold=1.5 if method is None else 3.0,
            )
        for name in ("(N, 1)", "(N,)", "int32"):
            make = _masks(n)[name]
            yield Case(
                f"masks/{name} seventh, {situation}",
                lambda p1=p1, p2=p2, make=make: ((p1, p2, *numbers, 1000, make()), {}),
                X=X,
                rule=rule_of(cv2.FM_RANSAC, n),
            )
            yield Case(
                f"masks/{name} sixth, {situation}",
                lambda p1=p1, p2=p2, make=make: ((p1, p2, *numbers, make()), {}),
                X=X,
                rule=rule_of(cv2.FM_RANSAC, n),
            )
    p1, p2 = (cv2.UMat(p) for p in halves(scene(N)[0]))
    for method_name, method in PATHS.items():
        yield Case(
            f"masks/UMat with UMat points/{method_name}",
            lambda method=method: (
                (p1, p2, method),
                {"mask": cv2.UMat(np.full((N, 1), 9, np.uint8))},
            ),
            X=scene(N)[0],
            rule=rule_of(method, N),
        )


def sizes() -> Iterator[Case]:
    """More points than people have, where an implementation could fall over."""
    for n in (2_000, 60_000):
        X = scene(n)[0]
        for name, method in METHODS.items():
            if method in (cv2.FM_RANSAC, cv2.FM_LMEDS, cv2.FM_7POINT) and n > 2_000:
                continue  # seconds of cv2's own time for nothing new
            yield Case(
                f"sizes/{n}/{name}",
                with_method(X, method, 2.0, 0.9, 30),
                unstable=method == PARALLEL
                or (versions.GRAPH_CUT_DIES and method == cv2.USAC_ACCURATE and n > 46_340),
                X=X,
                rule=rule_of(method, n),
                threshold=2.0,
            )
        cut = params(threshold=2.0, loMethod=cv2.LOCAL_OPTIM_GC, neighborsSearch=cv2.NEIGH_GRID)
        yield Case(
            f"sizes/{n}/UsacParams, graph cut",
            call(*halves(X), cut),
            unstable=versions.GRAPH_CUT_DIES and n > 46_340,
            X=X,
            rule="usac",
            threshold=2.0,
        )


GROUPS = (
    overload_forms,
    scalars,
    inputs,
    method_numbers,
    numbers,
    counts,
    degenerate_points,
    far_away,
    stacked_solutions,
    not_numbers,
    masks,
    sizes,
)


def _by_id() -> dict[str, Case]:
    table: dict[str, Case] = {}
    for case in itertools.chain.from_iterable(group() for group in GROUPS):
        if case.id in table:
            raise AssertionError(f"two cases are called {case.id}")
        table[case.id] = case
    return table


CASES = _by_id()
