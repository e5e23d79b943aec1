"""Arguments of the public functions: which are taken, and what to do about the others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

Density = Literal["contrast", "paper", "off"]
DENSITIES = get_args(Density)

#: Between these a threshold is one, pixels: no image is as wide as the second, so that every match
#: would be an inlier, and there would be nothing to estimate.
THRESHOLDS = (1e-12, 1e6)


@dataclass(frozen=True, eq=False)
class DensityRule:
    """The rule for the dense part, and the two numbers of the paper's.

    Raises
    ------
    ValueError
        With what to do, for options out of range.
    """

    density: Density = "contrast"
    alpha: float = 0.011
    dc_percent: float = 2.0

    def __post_init__(self) -> None:
        known = f"one of {', '.join(DENSITIES)}"
        check("density", self.density, str, DENSITIES.__contains__, known)
        check("alpha", self.alpha, Real, lambda v: 0 <= v <= 1, "a number from 0 to 1")
        check("dc_percent", self.dc_percent, Real, lambda v: 0 < v <= 100, "a number in (0, 100]")


def check(name: str, value: Any, kind: type, holds: Callable[[Any], bool], wanted: str) -> None:
    """Raise ValueError, with what is wanted, unless the value is of this kind and in range."""
    if isinstance(value, bool) or not isinstance(value, kind) or not holds(value):
        raise ValueError(f"{name} is {value!r}; it must be {wanted}")


#: The default, and cv2's own call.
CONTRAST, OFF = DensityRule(), DensityRule("off")


def check_matches(points1: ArrayLike, points2: ArrayLike) -> NDArray[np.float64]:
    """Return matched points as rows x, y, x', y', (n, 4), or raise ValueError."""
    first = _points(points1, "points1")
    second = _points(points2, "points2")
    if len(first) != len(second):
        raise ValueError(
            f"points1 has {len(first)} points and points2 {len(second)}; "
            "row i of both must be one match"
        )
    return np.hstack([first, second])


def check_scores(scores: ArrayLike, n: int | None) -> NDArray[np.float64]:
    """Return the scores of n matches as (n,), or raise ValueError; n is None where unknown.

    A column or a row will do, and so will infinities, since only the order counts.
    """
    trust = real(scores, "scores")
    if trust.ndim not in (1, 2) or trust.size not in trust.shape:
        raise ValueError(f"scores has shape {trust.shape}; it must be (n,): one number a match")
    if n is not None and trust.size != n:
        raise ValueError(f"scores has {trust.size} entries for {n} matches")
    if np.isnan(trust).any():
        raise ValueError("scores has NaN; give matches of unknown trust the lowest score")
    return trust.ravel()


def check_mask(mask: ArrayLike, n: int, name: str) -> NDArray[np.bool_]:
    """Return the mask of n matches as (n,) bool, False for what is masked, or raise ValueError."""
    given = real(np.ma.filled(mask, 0), name)
    if given.shape not in ((n,), (n, 1)):
        raise ValueError(f"{name} has shape {given.shape}; it must be ({n},): one entry a match")
    if not (given >= 0).all():
        raise ValueError(f"{name} has negative numbers or NaN; of -1 and 1, pass `{name} > 0`")
    return np.asarray(given.ravel() > 0)


def real(values: ArrayLike, name: str) -> NDArray[np.float64]:
    """Return an array of float64, NaN for what is masked, or raise ValueError."""
    try:
        given = np.asarray(values)
    except ValueError:
        raise ValueError(f"{name} has rows of different length") from None
    try:
        if given.dtype.kind not in "biufO":
            raise TypeError
        array = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is of type {given.dtype}; it must be real numbers") from None
    hidden = np.ma.getmask(values)
    return array if hidden is np.ma.nomask else np.where(hidden, np.nan, array)


def _points(points: ArrayLike, name: str) -> NDArray[np.float64]:
    array = real(points, name)
    if array.shape == (0,):
        return np.empty((0, 2))
    if array.ndim == 3 and 1 in array.shape[:2] and array.shape[2] == 2:
        array = array.reshape(-1, 2)
    if array.ndim != 2 or array.shape[1] != 2:
        raise ValueError(f"{name} has shape {array.shape}; it must be (n, 2): one x, y a row")
    return array
