"""Many pairs at once give what one at a time gives, and survive what a single pair does."""

from __future__ import annotations

import os
import signal
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import cv2
import joblib
import numpy as np
import pytest

from cv_densityf import estimate_fundamental
from cv_densityf.batch import estimate_many, progress_bar
from cv_densityf.datasets import two_view_scene
from cv_densityf.matching import Matches


@pytest.fixture(scope="module")
def pairs():
    scenes = [two_view_scene(200 + 20 * seed, random_state=seed) for seed in range(6)]
    return [(scene.points1, scene.points2) for scene in scenes]


def same(a, b):
    """Whether two estimates agree in everything but the time they took."""
    return (
        np.array_equal(a.F, b.F)
        and np.array_equal(a.mask, b.mask)
        and np.array_equal(a.kept, b.kept)
        and np.array_equal(a.reliability, b.reliability, equal_nan=True)
        and (a.n_draws, a.engine, a.reason, a.votes) == (b.n_draws, b.engine, b.reason, b.votes)
    )


def collect(found, estimates):
    # Unlike extend, keeps what came before an error.
    for estimate in estimates:
        found.append(estimate)


class Deadly:
    """Points that kill the process that reads them, unless it is the one that made them."""

    def __init__(self):
        self.home = os.getpid()

    def __len__(self):
        return 7

    def __array__(self, dtype=None, copy=None):
        if os.getpid() == self.home:
            raise AssertionError("read at home")
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize("jobs", [{}, {"n_jobs": 2}, {"n_jobs": 3, "backend": "threading"}])
def test_the_same_as_one_at_a_time(pairs, jobs):
    options = {"method": "usac_magsac", "threshold": 2.0, "random_state": 5}
    found = list(estimate_many(pairs, **jobs, **options))
    alone = [estimate_fundamental(*pair, **options) for pair in pairs]
    assert len({len(estimate.mask) for estimate in alone}) == len(pairs)
    assert all(map(same, found, alone))
    assert len(found) == len(pairs)


def test_scores_belong_to_the_pair(pairs):
    points1, points2 = pairs[0]
    scores = np.random.default_rng(0).random(len(points1))
    (found,) = estimate_many([(points1, points2, scores)])
    assert same(found, estimate_fundamental(points1, points2, scores=scores))
    assert not np.array_equal(found.kept, estimate_fundamental(points1, points2).kept)
    with pytest.raises(TypeError, match="scores belong to a pair"):
        estimate_many(pairs, scores=scores)


def test_what_match_images_returns_is_a_pair(pairs):
    points1, points2 = pairs[0]
    scores = np.random.default_rng(0).random(len(points1))
    (found,) = estimate_many([Matches(points1, points2, scores, (640, 480), (640, 480))])
    assert same(found, estimate_fundamental(points1, points2, scores=scores))
    (failed,) = estimate_many([Matches(points1, points2[1:], scores, (640, 480), (640, 480))])
    assert not failed
    assert len(failed.mask) == len(points1)


@pytest.mark.parametrize("n_jobs", [1, 2])
def test_a_bad_pair_fails_alone(pairs, n_jobs):
    points1, points2 = pairs[1]
    bad = [
        (cv2.UMat(points1.astype(np.float32)), points2),
        (points1, points2[:-1]),
        (points1[:3], points2[:3]),
        (points1,),
        ("left.jpg", "right.jpg"),
        (points1, points2, np.ones(len(points1)), "surplus"),
        None,
        7,
    ]
    found = list(estimate_many([pairs[0], *bad, pairs[2]], n_jobs=n_jobs))
    assert [bool(estimate) for estimate in found] == [True, *[False] * len(bad), True]
    assert same(found[-1], estimate_fundamental(*pairs[2]))
    assert ("cannot be pickled" in found[1].reason) == (n_jobs == 2)
    assert found[2].reason.startswith("ValueError: points1 has")
    assert found[2].mask.shape == (len(points1),)
    assert found[3].mask.shape == found[3].kept.shape == (3,)
    assert not any(np.shares_memory(estimate.mask, estimate.kept) for estimate in found)
    assert all(estimate.n_inliers == 0 and estimate.reason for estimate in found[1:-1])
    for estimate, items in zip(found[-4:-1], ("4 items", "NoneType", "int"), strict=True):
        assert estimate.reason.endswith(f"(points1, points2, scores), not {items}")


def test_a_pair_that_kills_its_worker_is_named_and_the_rest_goes_on(pairs):
    mixed = [pairs[0], (Deadly(), pairs[1][1]), *pairs[2:], (Deadly(), pairs[1][1]), pairs[1]]
    found = list(estimate_many(mixed, n_jobs=2))
    dead = [not estimate for estimate in found]
    assert dead == [isinstance(pair[0], Deadly) for pair in mixed]
    assert "worker process died" in found[1].reason
    assert found[1].mask.shape == (7,)
    assert all(
        same(estimate, estimate_fundamental(*pair))
        for estimate, pair in zip(found, mixed, strict=True)
        if estimate
    )


def test_wrong_options_are_refused_at_once():
    def never():
        raise AssertionError("read a pair")
        yield

    with pytest.raises(ValueError, match="threshold"):
        estimate_many(never(), threshold=-1)
    with pytest.raises(ValueError, match="unknown method"):
        estimate_many(never(), method="magic")
    with pytest.raises(TypeError, match="treshold"):
        estimate_many(never(), treshold=1)
    for wrong in ({"n_jobs": 0}, {"n_jobs": "two"}, {"backend": "nonsense"}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            estimate_many(never(), **wrong)


def test_joblib_s_settings_are_those_of_the_call(pairs):
    names = set()

    class Named:
        def __array__(self, dtype=None, copy=None):
            names.add(threading.current_thread().name)
            return pairs[0][0]

    with joblib.parallel_config(backend="threading", n_jobs=2):
        estimates = estimate_many([(Named(), pairs[0][1])] * 3)
    assert all(estimates)
    assert threading.current_thread().name not in names


@pytest.mark.parametrize("n_jobs", [1, 2])
def test_errors_of_the_source_are_raised_after_what_came_before(pairs, n_jobs):
    def broken():
        yield from pairs[:3]
        raise OSError("disk on fire")

    found = []
    with pytest.raises(OSError, match="disk on fire"):
        collect(found, estimate_many(broken(), n_jobs=n_jobs))
    assert len(found) == 3


def test_pairs_are_read_a_little_ahead_only(pairs):
    read = 0

    def counted():
        nonlocal read
        for _ in range(1000):
            read += 1
            yield pairs[0]

    estimates = estimate_many(counted(), n_jobs=1)
    next(estimates)
    assert read < 10
    estimates.close()


# As of joblib 1.6, loky's own thread may trip over pairs that are just being taken back.
@pytest.mark.filterwarnings(
    "ignore:Exception in thread ExecutorManagerThread:pytest.PytestUnhandledThreadExceptionWarning"
)
@pytest.mark.parametrize("n_jobs", [1, 2])
def test_leaving_early_is_no_reason_to_warn(pairs, n_jobs):
    estimates = estimate_many(pairs * 5, n_jobs=n_jobs)
    assert next(estimates)
    estimates.close()
    assert len(list(estimate_many(pairs, n_jobs=n_jobs))) == len(pairs)


def test_nothing_in_nothing_out():
    assert list(estimate_many([])) == []


@pytest.mark.parametrize("method", ["usac_accurate", "usac_magsac", "ransac", "lmeds"])
def test_threads_do_not_disturb_each_other(pairs, method):
    expected = [estimate_fundamental(*pair, method=method) for pair in pairs]
    stop = threading.Event()

    def disturb():
        # Others in the process use cv2, its random numbers and numpy's as well.
        rng = np.random.default_rng(1)
        while not stop.is_set():
            cv2.setRNGSeed(int(rng.integers(2**31)))
            np.random.seed(int(rng.integers(2**31)))  # noqa: NPY002
            cv2.findFundamentalMat(*pairs[1], cv2.USAC_FAST, 1.0, 0.99, 200)

    nuisance = threading.Thread(target=disturb)
    nuisance.start()
    try:
        for n_threads in range(1, 9):
            with ThreadPoolExecutor(n_threads) as pool:
                found = list(pool.map(lambda p: estimate_fundamental(*p, method=method), pairs))
            assert all(map(same, found, expected)), f"{n_threads} threads"
    finally:
        stop.set()
        nuisance.join()


@pytest.mark.filterwarnings("default")
def test_a_dask_cluster_takes_it_unchanged(pairs):
    distributed = pytest.importorskip("distributed")
    here = os.getpid()
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
    )
    with cluster, distributed.Client(cluster) as client:
        assert here not in client.run(os.getpid).values()
        with joblib.parallel_config(backend="dask"):
            found = list(estimate_many(pairs))
        tasks = client.run(lambda dask_worker: dask_worker.state.executed_count)
    assert sum(tasks.values()) >= len(pairs) / 2
    assert all(map(same, found, (estimate_fundamental(*pair) for pair in pairs)))


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize(
    ("make", "reason"), [(Deadly, "worker process died"), (cv2.UMat, "cannot be pickled")]
)
def test_a_pair_that_dask_gives_up_or_cannot_send_fails_alone(pairs, make, reason):
    distributed = pytest.importorskip("distributed")
    dask = pytest.importorskip("dask")
    mixed = [pairs[0], (make(), pairs[1][1]), *pairs[2:]]
    with dask.config.set({"distributed.scheduler.allowed-failures": 0}):
        # To joblib the one worker is one job, which need not leave this process.
        cluster = distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, dashboard_address=None, silence_logs=50
        )
        with cluster, distributed.Client(cluster), joblib.parallel_config(backend="dask"):
            found = list(estimate_many(mixed))
    assert [bool(estimate) for estimate in found] == [True, False, *[True] * len(pairs[2:])]
    assert reason in found[1].reason
    assert same(found[-1], estimate_fundamental(*pairs[-1]))


class Terminal:
    """Standard error that says it is a terminal."""

    encoding = "utf-8"

    def __init__(self):
        self.text = ""

    def write(self, text):
        self.text += text

    def flush(self):
        pass

    def isatty(self):
        return True


def test_progress_on_terminals_only(pairs, monkeypatch, capsys):
    list(estimate_many(pairs[:2]))
    assert capsys.readouterr().err == ""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    list(estimate_many(pairs[:2]))
    assert "2/2" in terminal.text
    terminal.text = ""
    list(estimate_many(pairs[:2], progress=False))
    assert terminal.text == ""


def test_no_bar_without_tqdm(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setitem(sys.modules, "tqdm", None)
    with progress_bar(3) as update:
        update()
    assert terminal.text == ""
