"""Run every method on the same pairs in turn, in one process and one thread."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from benchmarks.data import Pair
from benchmarks.peers import Method, Settings
from benchmarks.scenes import make_scene


@dataclass(frozen=True)
class Record:
    """One method on one pair.

    Attributes
    ----------
    section : str
        The table it belongs to, such as a cut of the real pairs or a kind of scene.
    group, pair, method : str
    seed : int
        Of the order of the rows and of the method, or of the method alone.
    n : int
        Number of matches.
    threshold : float
        Pixels.
    error : float
        Pixels, infinite for a failure.
    pose_error : float
        Degrees; NaN where the cameras are unknown.
    ms : float
        Processor time of the call, the fastest of its repeats.
    """

    section: str
    group: str
    pair: str
    method: str
    seed: int
    n: int
    threshold: float
    error: float
    pose_error: float
    ms: float


def measure(
    section: str, pair: Pair, methods: Sequence[Method], settings: Settings, repeats: int = 1
) -> list[Record]:
    """Estimate one pair with every method in turn; see `Record`. Call it within `one_thread`."""
    records = []
    for method in methods:
        F, ms = _timed(method, pair, settings, repeats)
        records.append(
            Record(
                section=section,
                group=pair.group,
                pair=pair.name,
                method=method.name,
                seed=settings.seed,
                n=len(pair.X),
                threshold=settings.threshold,
                error=pair.error(F),
                pose_error=pair.pose_error(F),
                ms=ms,
            )
        )
    return records


def warm_up(methods: Sequence[Method], settings: Settings) -> None:
    """Call each method once, so that no pair pays for an import."""
    pair = make_scene("clusters", 200, 0.5, 0.5)
    for method in methods:
        method.estimate(pair, settings)


def _timed(
    method: Method, pair: Pair, settings: Settings, repeats: int
) -> tuple[NDArray[np.float64] | None, float]:
    best = np.inf
    F = None
    for _ in range(max(1, repeats)):
        # Processor time: on one thread it is the time by the clock of an idle machine.
        start = time.process_time()
        F = method.estimate(pair, settings)
        best = min(best, 1e3 * (time.process_time() - start))
    return F, best


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep BLAS, OpenMP and cv2 on one thread, so that times compare work and not cores."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(limits=1):
            yield
    finally:
        cv2.setNumThreads(before)
