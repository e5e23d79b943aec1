"""Patching cv2 changes what programs call, and nothing stays behind."""

from __future__ import annotations

import _thread
import os
import subprocess
import sys
import textwrap
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from cv_densityf import findFundamentalMat, patching
from cv_densityf._engine import original
from cv_densityf.datasets import two_view_scene
from cv_densityf.patching import (
    call_sites,
    is_patched,
    patch_cv2,
    patched,
    reset_call_sites,
    unpatch_cv2,
)

SCENE = two_view_scene(200, inlier_ratio=0.4, random_state=3)
P1, P2 = SCENE.points1, SCENE.points2
LINE = np.arange(100.0)[:, None] * [1, 2]


@pytest.fixture(autouse=True)
def _clean():
    reset_call_sites()
    yield
    unpatch_cv2()
    assert cv2.findFundamentalMat is original


def assert_same(one, two):
    np.testing.assert_array_equal(one[0], two[0])
    np.testing.assert_array_equal(one[1], two[1])


def test_a_patched_cv2_answers_as_we_do():
    ours = findFundamentalMat(P1, P2, cv2.USAC_ACCURATE, 1.0)
    cv2s = original(P1, P2, cv2.USAC_ACCURATE, 1.0)
    assert not np.array_equal(ours[0], cv2s[0])
    patch_cv2()
    assert_same(cv2.findFundamentalMat(P1, P2, cv2.USAC_ACCURATE, 1.0), ours)
    unpatch_cv2()
    assert_same(cv2.findFundamentalMat(P1, P2, cv2.USAC_ACCURATE, 1.0), cv2s)


def test_options_are_those_of_all_calls():
    with patched(density="off"):
        assert_same(cv2.findFundamentalMat(P1, P2, 36), original(P1, P2, 36))
        # Unless a call has its own.
        assert_same(
            cv2.findFundamentalMat(P1, P2, 36, density="contrast"), findFundamentalMat(P1, P2, 36)
        )
    with patched(density="paper", alpha=0.05, dc_percent=4.0):
        expected = findFundamentalMat(P1, P2, 36, density="paper", alpha=0.05, dc_percent=4.0)
        assert_same(cv2.findFundamentalMat(P1, P2, 36), expected)


@pytest.mark.parametrize("patch", [patch_cv2, lambda **options: patched(**options).__enter__()])
def test_wrong_options_patch_nothing(patch):
    with pytest.raises(ValueError, match="density is"):
        patch(density="dense")
    assert not is_patched()


def test_patching_twice_needs_one_undoing():
    patch_cv2()
    patch_cv2(density="off")
    assert is_patched()
    assert_same(cv2.findFundamentalMat(P1, P2, 36), original(P1, P2, 36))
    unpatch_cv2()
    assert not is_patched()
    unpatch_cv2()
    assert cv2.findFundamentalMat is original


def test_blocks_nest():
    with patched():
        with patched(density="off"):
            assert_same(cv2.findFundamentalMat(P1, P2, 36), original(P1, P2, 36))
        assert_same(cv2.findFundamentalMat(P1, P2, 36), findFundamentalMat(P1, P2, 36))
        unpatch_cv2()
        assert is_patched()
    assert not is_patched()


def test_a_block_inside_a_lasting_patch():
    patch_cv2(density="off")
    with patched():
        assert_same(cv2.findFundamentalMat(P1, P2, 36), findFundamentalMat(P1, P2, 36))
    assert is_patched()
    assert_same(cv2.findFundamentalMat(P1, P2, 36), original(P1, P2, 36))


def test_an_error_leaves_the_block_unpatched():
    with pytest.raises(cv2.error, match="Overload resolution failed"), patched():
        cv2.findFundamentalMat(P1)
    assert not is_patched()


def test_an_interrupt_on_the_way_into_a_block_leaves_nothing_behind(monkeypatch):
    def install_and_interrupt():
        install()
        raise KeyboardInterrupt

    install = patching._install
    monkeypatch.setattr(patching, "_install", install_and_interrupt)
    with pytest.raises(KeyboardInterrupt), patched():
        pytest.fail("inside")
    assert cv2.findFundamentalMat is original
    assert not patching._patches


def test_blocks_overlap_between_threads():
    inside, leave = threading.Event(), threading.Event()

    def other():
        with patched():
            inside.set()
            leave.wait(10)

    thread = threading.Thread(target=other)
    with patched(density="off"):
        thread.start()
        inside.wait(10)
    # The block entered first is left first: the other thread's is still in force.
    assert is_patched()
    leave.set()
    thread.join()
    assert not is_patched()


def test_threads_calling_and_patching_at_once():
    expected = findFundamentalMat(P1, P2, 38)

    def work(_):
        with patched():
            return cv2.findFundamentalMat(P1, P2, 38)

    with ThreadPoolExecutor(4) as pool:
        for answer in pool.map(work, range(24)):
            assert_same(answer, expected)
    assert not is_patched()
    assert sum(site.calls for site in call_sites()) == 24


def test_somebody_elses_patch_survives(monkeypatch):
    def spy(*args, **kwargs):
        return ours(*args, **kwargs)

    patch_cv2()
    ours = cv2.findFundamentalMat
    monkeypatch.setattr(cv2, "findFundamentalMat", spy)
    unpatch_cv2()
    assert cv2.findFundamentalMat is spy
    # Our function, wrapped in theirs, is cv2's again.
    assert_same(cv2.findFundamentalMat(P1, P2, 36), original(P1, P2, 36))
    monkeypatch.setattr(cv2, "findFundamentalMat", original)


def test_an_earlier_patch_comes_back(monkeypatch):
    def spy(*args, **kwargs):
        raise AssertionError("never called")

    monkeypatch.setattr(cv2, "findFundamentalMat", spy)
    with patched():
        # The pipeline calls cv2's function as it was at import, so nothing recurses.
        assert cv2.findFundamentalMat(P1, P2, 36)[0] is not None
    assert cv2.findFundamentalMat is spy
    monkeypatch.undo()


def test_counts_per_calling_line():
    with patched():
        for _ in range(3):
            cv2.findFundamentalMat(P1, P2, 36)
        cv2.findFundamentalMat(P1, P2, cv2.FM_8POINT)
        cv2.findFundamentalMat(P1 * np.nan, P2, 36)
        cv2.findFundamentalMat(LINE, LINE, 36)
        with pytest.raises(cv2.error):
            cv2.findFundamentalMat(P1.tolist(), P2)
    sites = call_sites()
    assert [site.calls for site in sites] == [3, 1, 1, 1, 1]
    assert {site.filename for site in sites} == {__file__}
    first, eight_point, nan, line, refused = sorted(sites, key=lambda site: site.line)
    assert (first.passed_on, first.no_model, first.errors) == (0, 0, 0)
    inliers = np.count_nonzero(findFundamentalMat(P1, P2, 36)[1])
    assert (first.matches, first.inliers) == (600, 3 * inliers)
    assert (eight_point.passed_on, eight_point.matches, eight_point.inliers) == (1, 200, 200)
    assert (nan.passed_on, nan.no_model, nan.matches) == (1, 1, 0)
    # Not at once: the pipeline looks at these, and leaves them to cv2.
    assert (line.passed_on, line.errors) == (1, 0)
    assert (refused.passed_on, refused.errors, refused.matches) == (0, 1, 0)
    assert all(site.seconds > 0 for site in sites)
    reset_call_sites()
    assert call_sites() == []


def test_a_call_from_no_line_at_all():
    """A thread that is started in C has our function for its first frame."""
    with patched():
        _thread.start_new_thread(cv2.findFundamentalMat, (P1, P2, 36))
        for _ in range(1000):
            if call_sites():
                break
            time.sleep(0.01)
    (site,) = call_sites()
    assert (site.filename, site.line, site.calls, site.errors) == ("<no file>", 0, 1, 0)


def test_looks_like_cv2s_function():
    with patched():
        assert cv2.findFundamentalMat.__name__ == "findFundamentalMat"
        assert "ransacReprojThreshold" in cv2.findFundamentalMat.__doc__


def run_python(code):
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=60
    )


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes cannot be forked here")
def test_a_process_forked_while_another_thread_calls_goes_on():
    done = run_python(
        """
        import os, sys, threading, time
        import cv2, numpy as np
        from cv_densityf import patching

        patching.patch_cv2()
        held = threading.Event()

        def hold():
            with patching._lock:
                held.set()
                time.sleep(0.2)

        threading.Thread(target=hold).start()
        held.wait()
        child = os.fork()
        if not child:
            points = np.random.default_rng(0).uniform(0, 500, (8, 2))
            cv2.findFundamentalMat(points, points[::-1].copy(), cv2.FM_8POINT)
            os._exit(0)
        for _ in range(200):
            if os.waitpid(child, os.WNOHANG)[0]:
                sys.exit(0)
            time.sleep(0.05)
        os.kill(child, 9)
        sys.exit("it hangs")
        """
    )
    assert done.returncode == 0, done.stderr


def test_limits_names_imported_before_and_worker_processes():
    """Both are documented: an earlier import by name and a new process have cv2's function."""
    done = run_python(
        """
        import multiprocessing
        from cv2 import findFundamentalMat as early
        from cv_densityf._engine import original
        from cv_densityf.patching import is_patched, patched

        if __name__ == "__main__":
            with patched():
                from cv2 import findFundamentalMat as late
                assert early is original
                assert late is not original
                with multiprocessing.get_context("spawn").Pool(1) as pool:
                    assert pool.apply(is_patched) is False
                assert is_patched()
        """
    )
    assert done.returncode == 0, done.stderr


AGAIN = {
    "reload": """
        for name in ("_engine", "cv2_api", "patching"):
            importlib.reload(sys.modules[f"cv_densityf.{name}"])
    """,
    "import": """
        for name in [name for name in sys.modules if name.startswith("cv_densityf")]:
            del sys.modules[name]
    """,
}


@pytest.mark.parametrize("again", AGAIN)
@pytest.mark.parametrize("inside", [False, True])
def test_loading_the_package_while_cv2_is_patched(again, inside):
    code = f"""
import cv2, importlib, sys
import numpy as np
cv2s = cv2.findFundamentalMat
from cv_densityf.datasets import two_view_scene
from cv_densityf.patching import patch_cv2, patched
scene = two_view_scene(100, random_state=3)
block = patched()
block.__enter__() if {inside} else patch_cv2()
assert cv2.findFundamentalMat is not cv2s
{textwrap.dedent(AGAIN[again])}
import cv_densityf
from cv_densityf import _engine
assert _engine.original is cv2s
F, mask = cv_densityf.findFundamentalMat(scene.points1, scene.points2, 36, density="off")
assert np.array_equal(F, cv2s(scene.points1, scene.points2, 36)[0])
cv_densityf.unpatch_cv2()
assert cv2.findFundamentalMat is cv2s
cv_densityf.patch_cv2()
assert cv_densityf.is_patched()
assert not np.array_equal(cv2.findFundamentalMat(scene.points1, scene.points2, 36)[0], F)
cv_densityf.unpatch_cv2()
if {inside}:
    block.__exit__(None, None, None)
assert cv2.findFundamentalMat is cv2s
"""
    done = run_python(code)
    assert done.returncode == 0, done.stderr


def test_loading_anew_leaves_a_wrapper_around_ours():
    done = run_python(
        """
        import cv2, functools, importlib
        from cv_densityf import patching
        patching.patch_cv2()
        spy = cv2.findFundamentalMat = functools.wraps(cv2.findFundamentalMat)(lambda *_: None)
        importlib.reload(patching)
        assert cv2.findFundamentalMat is spy
        """
    )
    assert done.returncode == 0, done.stderr


def test_a_patched_program_may_give_scores():
    scores = np.where(SCENE.inliers, 2.0, 1.0) + np.arange(200) / 1000
    expected, _ = findFundamentalMat(P1, P2, cv2.USAC_MAGSAC, 1.0, 0.999, 1000, scores=scores)
    without, _ = findFundamentalMat(P1, P2, cv2.USAC_MAGSAC, 1.0, 0.999, 1000)
    with patched():
        F, _ = cv2.findFundamentalMat(P1, P2, cv2.USAC_MAGSAC, 1.0, 0.999, 1000, scores=scores)
    np.testing.assert_array_equal(F, expected)
    assert not np.array_equal(F, without)
