"""Many pairs at once: the same estimate for each, on all cores or on a cluster, through joblib."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from concurrent.futures import BrokenExecutor, Future
from contextlib import contextmanager
from copy import copy
from importlib.util import find_spec
from pickle import PicklingError
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cv_densityf._estimate import Estimate, estimate_fundamental
from cv_densityf.matching import Matches

Pair = Sequence[ArrayLike]


def estimate_many(
    pairs: Iterable[Pair | Matches],
    *,
    n_jobs: int | None = None,
    backend: str | None = None,
    progress: bool | None = None,
    **options: Any,
) -> Iterator[Estimate]:
    """Estimate the fundamental matrix of every pair of images, in parallel.

    Parameters
    ----------
    pairs : iterable of (points1, points2), (points1, points2, scores) or `Matches`
        What `estimate_fundamental` takes, pixels; `Matches` are taken with their scores. Read as
        results are wanted, a little ahead, so a generator that loads pairs keeps memory small.
    n_jobs : int, optional
        Pairs at a time; -1 for one per core. By default what ``joblib.parallel_config`` says, else
        1.
    backend : str, optional
        joblib's: ``"loky"`` (processes), ``"threading"``, ``"dask"``, ``"ray"`` ... By default what
        ``joblib.parallel_config`` says, else processes.
    progress : bool, optional
        Show a bar on standard error. By default if that is a terminal and tqdm is installed.
    **options
        Options of `estimate_fundamental` for all pairs.

    Returns
    -------
    iterator of Estimate
        In the order of ``pairs``. Each equals what `estimate_fundamental` makes of the pair with
        these options, whatever ``n_jobs`` and ``backend`` are. A pair that cannot be estimated or
        sent to a worker process, or whose worker process died of it, gets a falsy `Estimate` whose
        ``reason`` says so; the others go on.

    Raises
    ------
    TypeError, ValueError
        At once, if an option is wrong. What ``pairs`` itself raises is raised where it occurs.

    See Also
    --------
    estimate_fundamental : Does it for one pair.

    Notes
    -----
    When a worker process dies (``"loky"``), the pairs that were unfinished then are estimated one
    by one, each in a new process, which tells whose fault it was. ``"threading"`` and one job have
    no worker to lose. On ``"dask"`` the scheduler gives the pairs of a dead worker to others; when
    it gives up (``distributed.scheduler.allowed-failures``), the unfinished pairs are estimated one
    by one in processes on the machine that asks.

    Examples
    --------
    >>> from cv_densityf.batch import estimate_many
    >>> from cv_densityf.datasets import two_view_scene
    >>> scenes = [two_view_scene(300, random_state=seed) for seed in range(3)]
    >>> pairs = [(scene.points1, scene.points2) for scene in scenes]
    >>> [bool(estimate) for estimate in estimate_many(pairs, method="usac_magsac")]
    [True, True, True]
    """
    if "scores" in options:
        raise TypeError("scores belong to a pair: give (points1, points2, scores)")
    # Checks the options now, not in each worker.
    estimate_fundamental(np.empty((0, 2)), np.empty((0, 2)), **options)
    run = _runner(n_jobs, backend)
    total = len(pairs) if isinstance(pairs, Sized) else None
    estimates = _estimates(map(_unpacked, pairs), run, n_jobs, backend, options)
    return _with_progress(estimates, total, progress)


def _unpacked(pair: Pair | Matches) -> Pair:
    return (pair.points1, pair.points2, pair.scores) if isinstance(pair, Matches) else pair


def _estimates(
    pairs: Iterator[Pair],
    run: Any,
    n_jobs: int | None,
    backend: str | None,
    options: dict[str, Any],
) -> Iterator[Estimate]:
    source = _Source(pairs)
    while not source.empty:
        try:
            for estimate in _answers(run, source, options):
                source.pending.popleft()
                yield estimate
        except (BrokenExecutor, PicklingError):
            # Any of the unfinished pairs may be the one to blame.
            while source.pending:
                yield _alone(source.pending.popleft(), options)
            # The old one would still give what it had of these.
            run = _runner(n_jobs, backend)
        if source.error is not None:
            raise source.error


class _Source:
    """The pairs, and which of them were handed out and not answered yet."""

    def __init__(self, pairs: Iterator[Pair]) -> None:
        self.pending: deque[Pair] = deque()
        self.empty = False
        self.error: Exception | None = None
        self._pairs = pairs

    def __iter__(self) -> Iterator[Pair]:
        # joblib reads in its own threads, where an exception would be lost.
        try:
            for pair in self._pairs:
                self.pending.append(pair)
                yield pair
        except Exception as error:
            self.error = error
        self.empty = True


def _runner(n_jobs: int | None, backend: str | None) -> Any:
    """Make joblib's ``Parallel``, or raise what it says of its options."""
    from joblib import Parallel

    if n_jobs == 0:  # which joblib would find out with the first pair
        raise ValueError("n_jobs is 0; it must be a number of pairs at a time, or -1 for all cores")
    run = Parallel(n_jobs=n_jobs, backend=backend, return_as="generator")
    # Whoever takes the first results and leaves knows what is lost.
    run._warn_exit_early = lambda: None
    if type(run._backend).__name__ == "DaskDistributedBackend":
        run._backend = _with_losses_told(run._backend)
    return run


def _answers(run: Any, pairs: Iterable[Pair], options: dict[str, Any]) -> Iterator[Estimate]:
    from joblib import delayed

    estimates: Iterator[Estimate] = run(delayed(_one)(pair, options) for pair in pairs)
    return estimates


def _with_losses_told(backend: Any) -> Any:
    """Give a copy of joblib's dask backend that tells of tasks lost on the way or given up.

    As of joblib 1.6 nobody is called back for them, so that whoever waits for the result waits for
    ever.
    """
    from distributed.protocol import pickle
    from distributed.scheduler import KilledWorker

    dumps: Any = pickle.dumps

    class Telling(type(backend)):  # type: ignore[misc]
        def effective_n_jobs(self, n_jobs: Any) -> Any:
            # One job, where one worker is left, would not leave this process.
            return max(2, super().effective_n_jobs(n_jobs))

        async def _to_func_args(self, func: Any) -> Any:
            try:
                dumps(func.items, buffer_callback=lambda _: None)  # copies no array
            except Exception:
                func.items = [(_refuse, (), {})]
            return await super()._to_func_args(func)

        def submit(self, func: Any, callback: Callable[[Any], None]) -> Future[Any]:
            def tell(done: Future[Any]) -> None:
                if done.exception() is not None:
                    callback(done)

            future: Future[Any] = super().submit(func, callback)
            future.add_done_callback(tell)
            return future

        def retrieve_result_callback(self, out: Any) -> Any:
            if not isinstance(out, Future):
                return super().retrieve_result_callback(out)
            try:
                return out.result()
            except KilledWorker as error:
                raise BrokenExecutor(str(error)) from None

    telling = copy(backend)
    telling.__class__ = Telling
    return telling


def _refuse() -> None:
    raise PicklingError


def _one(pair: Pair, options: dict[str, Any]) -> Estimate:
    """Estimate one pair; whatever goes wrong is its own result."""
    try:
        items = tuple(pair) if isinstance(pair, Iterable) else None
        if items is None or not 2 <= len(items) <= 3:
            given = type(pair).__name__ if items is None else f"{len(items)} items"
            raise ValueError(
                f"a pair is (points1, points2) or (points1, points2, scores), not {given}"
            )
        points1, points2, *scores = items
        return estimate_fundamental(
            points1, points2, scores=scores[0] if scores else None, **options
        )
    except Exception as error:
        return _failure(pair, f"{type(error).__name__}: {error}")


def _alone(pair: Pair, options: dict[str, Any]) -> Estimate:
    """Estimate one pair in a process of its own, on this machine."""
    try:
        # One job would not leave this process.
        (estimate,) = _answers(_runner(2, "loky"), [pair], options)
    except PicklingError:
        return _failure(pair, "it cannot be pickled for a worker process; give NumPy arrays")
    except BrokenExecutor as error:
        return _failure(
            pair,
            f"the worker process died of it ({type(error).__name__}): out of memory, or a crash "
            "in compiled code",
        )
    return estimate


def _failure(pair: Pair, reason: str) -> Estimate:
    try:
        n = len(pair[0])  # type: ignore[arg-type]
    except Exception:
        n = 0
    return Estimate(
        F=None,
        mask=np.zeros(n, dtype=bool),
        kept=np.zeros(n, dtype=bool),
        reliability=np.full(n, np.nan),
        n_draws=0,
        agreed=False,
        engine="none",
        reason=reason,
    )


def _with_progress(
    estimates: Iterator[Estimate], total: int | None, progress: bool | None
) -> Iterator[Estimate]:
    with progress_bar(total, progress) as update:
        for estimate in estimates:
            update()
            yield estimate


@contextmanager
def progress_bar(total: int | None, shown: bool | None = None) -> Iterator[Any]:
    """Give a function that moves a bar of pairs by some; does nothing where tqdm is missing.

    Parameters
    ----------
    total : int, optional
        Number of pairs, if known.
    shown : bool, optional
        By default if standard error is a terminal.

    Yields
    ------
    callable
        ``update(n=1)``.
    """
    if shown is None:
        shown = sys.stderr is not None and sys.stderr.isatty()
    if shown and find_spec("tqdm") is not None:
        from tqdm import tqdm

        with tqdm(total=total, unit="pair", file=sys.stderr) as bar:
            yield bar.update
    else:
        yield lambda n=1: None
