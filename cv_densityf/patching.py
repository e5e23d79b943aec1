"""Put `cv_densityf.findFundamentalMat` in the place of cv2's function, and take it back.

For programs that cannot be edited. What was imported by name before the patch
(``from cv2 import findFundamentalMat``) keeps cv2's function, and so do other processes: worker
processes that import cv2 afresh have to patch it themselves; threads share the patch.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from typing import Any

import cv2
import numpy as np

from cv_densityf import cv2_api
from cv_densityf._arguments import Density, DensityRule
from cv_densityf._engine import CV2S_OWN, original


@dataclass(frozen=True)
class CallSite:
    """What the patched function did for one line of a program.

    Attributes
    ----------
    filename : str
        File of the calling line, ``"<no file>"`` for calls from C without any Python below.
    line : int
        Its number, or 0.
    calls : int
        Calls that came from there, errors included.
    passed_on : int
        Calls that cv2 answered: at once, see `cv_densityf.findFundamentalMat` for which, or because
        the search had no answer.
    errors : int
        Calls that raised.
    no_model : int
        Calls that found no fundamental matrix; all of them are passed on, too.
    matches, inliers : int
        Over all calls that found a fundamental matrix and answered with an array for a mask.
    seconds : float
        Over all calls, by the clock.
    """

    filename: str
    line: int
    calls: int = 0
    passed_on: int = 0
    errors: int = 0
    no_model: int = 0
    matches: int = 0
    inliers: int = 0
    seconds: float = 0.0


_lock = threading.RLock()
if hasattr(os, "register_at_fork"):
    # A process forked while another thread holds it would wait for ever.
    os.register_at_fork(
        before=_lock.acquire, after_in_parent=_lock.release, after_in_child=_lock.release
    )
#: The last one counts. `patch_cv2` has at most one in it, every open `patched` has its own, which
#: is found again by identity.
_patches: list[DensityRule] = []
_lasting: DensityRule | None = None
_before: Any = original
_sites: dict[tuple[str, int], CallSite] = {}


def findFundamentalMat(*args: Any, **kwargs: Any) -> Any:
    """Stand in for cv2's function as long as a patch is in force."""
    with _lock:
        rule = _patches[-1] if _patches else None
    if rule is None:  # somebody kept this function beyond the patch
        return original(*args, **kwargs)
    caller = sys._getframe().f_back
    site = ("<no file>", 0) if caller is None else (caller.f_code.co_filename, caller.f_lineno)
    # The extras are no parameters of cv2's function, but a patched program may know of us.
    options = {field.name: kwargs.pop(field.name) for field in fields(rule) if field.name in kwargs}
    scores = kwargs.pop("scores", None)
    start = time.perf_counter()
    try:
        answer, estimate = cv2_api.find(args, kwargs, replace(rule, **options), scores)
    except BaseException:
        _count(site, errors=1, seconds=time.perf_counter() - start)
        raise
    seconds = time.perf_counter() - start
    F, mask = answer
    passed_on = estimate is None or estimate.engine != "density"
    told = F is not None and isinstance(mask, np.ndarray)
    _count(
        site,
        passed_on=int(passed_on),
        no_model=int(F is None),
        matches=mask.size if told else 0,
        inliers=int(np.count_nonzero(mask)) if told else 0,
        seconds=seconds,
    )
    return answer


findFundamentalMat.__doc__ = cv2_api.findFundamentalMat.__doc__
setattr(findFundamentalMat, CV2S_OWN, original)


def _count(site: tuple[str, int], **more: float) -> None:
    with _lock:
        old = _sites.get(site) or CallSite(*site)
        new = {name: getattr(old, name) + n for name, n in more.items()}
        _sites[site] = replace(old, calls=old.calls + 1, **new)


def patch_cv2(
    *, density: Density = "contrast", alpha: float = 0.011, dc_percent: float = 2.0
) -> None:
    """Replace ``cv2.findFundamentalMat`` until `unpatch_cv2`.

    A second call replaces the options of the first; one `unpatch_cv2` ends both.

    Parameters
    ----------
    density, alpha, dc_percent
        As in `cv_densityf.findFundamentalMat`, for all calls.

    Raises
    ------
    ValueError
        For options that `cv_densityf.findFundamentalMat` refuses.

    Examples
    --------
    >>> import cv2
    >>> from cv_densityf.patching import is_patched, patch_cv2, unpatch_cv2
    >>> patch_cv2()
    >>> is_patched()
    True
    >>> unpatch_cv2()
    >>> is_patched()
    False
    """
    global _lasting
    rule = DensityRule(density, alpha, dc_percent)
    with _lock:
        if _lasting is not None:
            _patches.remove(_lasting)
        _lasting = rule
        _patches.append(rule)
        _install()


def unpatch_cv2() -> None:
    """Undo `patch_cv2`; without one, do nothing. An open `patched` stays in force."""
    global _lasting
    with _lock:
        if _lasting is not None:
            _patches.remove(_lasting)
            _lasting = None
        _uninstall()


def is_patched() -> bool:
    """Whether ``cv2.findFundamentalMat`` is ours at the moment.

    Returns
    -------
    bool
        False, too, where somebody has patched over us.

    Examples
    --------
    >>> from cv_densityf.patching import is_patched, patched
    >>> with patched():
    ...     is_patched()
    True
    >>> is_patched()
    False
    """
    return cv2.findFundamentalMat is findFundamentalMat


@contextmanager
def patched(
    *, density: Density = "contrast", alpha: float = 0.011, dc_percent: float = 2.0
) -> Iterator[None]:
    """Replace ``cv2.findFundamentalMat`` inside a ``with`` block, for all threads.

    Blocks may be nested and may overlap between threads: the options of the one entered last are
    in force, and cv2's function is back when the last one is left.

    Parameters
    ----------
    density, alpha, dc_percent
        As in `cv_densityf.findFundamentalMat`.

    Yields
    ------
    None

    Raises
    ------
    ValueError
        For options that `cv_densityf.findFundamentalMat` refuses.

    Examples
    --------
    >>> import cv2
    >>> from cv_densityf import findFundamentalMat
    >>> from cv_densityf.datasets import two_view_scene
    >>> from cv_densityf.patching import patched
    >>> scene = two_view_scene(200, random_state=0)
    >>> with patched(density="paper"):
    ...     F, mask = cv2.findFundamentalMat(scene.points1, scene.points2)
    >>> expected, _ = findFundamentalMat(scene.points1, scene.points2, density="paper")
    >>> bool((F == expected).all())
    True
    """
    rule = DensityRule(density, alpha, dc_percent)
    try:  # from here on, for Ctrl-C may come at any time
        with _lock:
            _patches.append(rule)
            _install()
        yield
    finally:
        with _lock:
            if rule in _patches:  # a reload forgets it
                _patches.remove(rule)
            _uninstall()


def call_sites() -> list[CallSite]:
    """Count what the patched function did, since `reset_call_sites`.

    Returns
    -------
    list of CallSite
        One for each calling line, most calls first.

    Examples
    --------
    >>> import cv2
    >>> from cv_densityf.datasets import two_view_scene
    >>> from cv_densityf.patching import call_sites, patched, reset_call_sites
    >>> reset_call_sites()
    >>> scene = two_view_scene(200, random_state=0)
    >>> with patched():
    ...     for _ in range(3):
    ...         F, mask = cv2.findFundamentalMat(scene.points1, scene.points2)
    >>> [(site.calls, site.passed_on, site.matches) for site in call_sites()]
    [(3, 0, 600)]
    """
    with _lock:
        return sorted(_sites.values(), key=lambda site: -site.calls)


def reset_call_sites() -> None:
    """Forget all counts."""
    with _lock:
        _sites.clear()


def _install() -> None:
    global _before
    if not is_patched():
        _before = cv2.findFundamentalMat
        setattr(cv2, "findFundamentalMat", findFundamentalMat)  # noqa: B010 - a function to mypy


def _uninstall() -> None:
    # If somebody has patched over us, theirs stays; ours passes calls on to cv2 from now on.
    if not _patches and is_patched():
        setattr(cv2, "findFundamentalMat", _before)  # noqa: B010


# Loaded anew, this module knows of no patch, so none may be left in force; somebody else's wrapper
# around ours has our attributes, and stays.
if hasattr(cv2.findFundamentalMat, CV2S_OWN) and not hasattr(cv2.findFundamentalMat, "__wrapped__"):
    setattr(cv2, "findFundamentalMat", original)  # noqa: B010
