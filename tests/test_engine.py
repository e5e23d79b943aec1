"""cv2's estimator behind names and flags: its own answers, and its failures as None."""

from __future__ import annotations

import subprocess
import sys

import cv2
import numpy as np
import pytest

from cv_densityf import _engine
from cv_densityf._engine import (
    GRAPH_CUT_MAX,
    METHODS,
    Robust,
    cuts_graph,
    draw,
    is_usac,
    method_flag,
    original,
    without_graph_cut,
)
from cv_densityf._epipolar import sampson_distance
from cv_densityf.datasets import two_view_scene


@pytest.fixture(scope="module")
def scene():
    return two_view_scene(300, inlier_ratio=0.6, noise=0.5, random_state=3)


@pytest.fixture
def one_thread():
    """USAC_PARALLEL answers the same twice on one thread only."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(threads)


def assert_same(answer, expected):
    for mine, theirs in zip(answer, expected, strict=True):
        np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize("name", METHODS)
def test_every_name_is_cv2s_constant(name):
    constant = name.upper() if name.startswith("usac") else f"FM_{name.upper()}"
    flag = getattr(cv2, constant)
    for spelling in (name, name.upper(), constant, constant.lower(), flag, np.int32(flag)):
        assert method_flag(spelling) == flag
    assert is_usac(flag) == name.startswith("usac")
    assert Robust(flag, 1.0, 0.99, 100).name == name


def test_each_method_has_its_rule():
    for name, flag in METHODS.items():
        expected = "usac" if name.startswith("usac") else "ransac" if name == "ransac" else "lmeds"
        assert Robust(flag, 1.0, 0.99, 100).rule == expected


def test_names_hold_all_of_cv2s_usac_methods():
    flags = {getattr(cv2, name) for name in dir(cv2) if name.startswith("USAC_")}
    assert flags <= set(METHODS.values())


@pytest.mark.parametrize("unknown", ["ransack", "", "fm_", "usac", 3, -1, 99])
def test_unknown_methods_are_refused_with_the_choice(unknown):
    with pytest.raises(ValueError, match=r"unknown method .*choose one of .*usac_magsac") as caught:
        method_flag(unknown)
    assert repr(unknown) in str(caught.value)


def test_params_have_the_rule_of_usac_whatever_the_flag():
    robust = Robust(cv2.FM_RANSAC, 1.0, 0.99, 100, cv2.UsacParams())
    assert robust.rule == "usac"
    assert robust.name == "usac"


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("name", METHODS)
def test_plain_is_cv2s_own_call(name, scene):
    robust = Robust(METHODS[name], 0.8, 0.97, 200)
    answer = robust.plain(scene.points1, scene.points2)
    expected = original(scene.points1, scene.points2, METHODS[name], 0.8, 0.97, 200)
    assert_same(answer, expected)
    assert answer[0].shape == (3, 3)
    assert answer[1].shape == (300, 1)


def test_plain_hands_on_every_number():
    """Each of the three matters: with it changed, cv2 answers otherwise on this scene."""
    noisy = two_view_scene(300, inlier_ratio=0.7, noise=1.0, random_state=0)
    base = (1.0, 0.999, 1000)
    for numbers in (base, (3.0, 0.999, 1000), (1.0, 0.1, 1000), (1.0, 0.999, 3)):
        answer = Robust(cv2.FM_RANSAC, *numbers).plain(noisy.points1, noisy.points2)
        assert_same(answer, original(noisy.points1, noisy.points2, cv2.FM_RANSAC, *numbers))
        if numbers == base:
            first = answer[0]
        else:
            assert not np.array_equal(answer[0], first), numbers


def test_plain_with_params_is_cv2s_own_call(scene):
    params = cv2.UsacParams()
    params.threshold, params.maxIterations, params.randomGeneratorState = 2.0, 50, 7
    answer = Robust(cv2.USAC_DEFAULT, 1.0, 0.99, 5000, params).plain(scene.points1, scene.points2)
    assert_same(answer, original(scene.points1, scene.points2, params))
    other = Robust(cv2.USAC_DEFAULT, 1.0, 0.99, 5000).plain(scene.points1, scene.points2)
    assert not np.array_equal(answer[0], other[0])


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("n", [0, 1, 5])
def test_too_few_matches_are_none_not_an_exception(name, n):
    points = np.random.default_rng(0).uniform(0, 100, (n, 4))
    assert Robust(METHODS[name], 1.0, 0.99, 100).plain(points[:, :2], points[:, 2:]) == (None, None)


def test_an_error_of_cv2s_solver_is_none(scene, monkeypatch):
    def fails(*_):
        raise cv2.error("solver")

    monkeypatch.setattr(_engine, "original", fails)
    assert Robust(cv2.USAC_MAGSAC, 1.0, 0.99, 100).plain(scene.points1, scene.points2) == (
        None,
        None,
    )
    assert draw(scene.X.astype(np.float32), 1.0, 0.99, 100, 0) is None


def test_a_mask_without_f_is_not_handed_on(monkeypatch):
    """cv2's mask is uninitialised memory there."""
    garbage = np.full((20, 1), 77, np.uint8)
    monkeypatch.setattr(_engine, "original", lambda *_: (None, garbage))
    points = np.zeros((20, 2))
    assert Robust(cv2.FM_RANSAC, 1.0, 0.99, 100).plain(points, points) == (None, None)


def test_other_errors_are_not_swallowed(scene, monkeypatch):
    def fails(*_):
        raise MemoryError

    monkeypatch.setattr(_engine, "original", fails)
    with pytest.raises(MemoryError):
        Robust(cv2.USAC_MAGSAC, 1.0, 0.99, 100).plain(scene.points1, scene.points2)


def graph_cut():
    params = cv2.UsacParams()
    params.loMethod = cv2.LOCAL_OPTIM_GC
    return params


@pytest.mark.parametrize("params", [None, graph_cut()], ids=["flag", "params"])
def test_graph_cut_is_replaced_above_its_bound_only(params):
    asked = Robust(cv2.USAC_ACCURATE if params is None else 0, 1.0, 0.99, 100, params)
    assert asked.for_size(GRAPH_CUT_MAX) is asked
    other = asked.for_size(GRAPH_CUT_MAX + 1)
    assert not cuts_graph(other.flag, other.params)
    assert (other.threshold, other.confidence, other.max_iters) == (1.0, 0.99, 100)


def test_params_without_graph_cut_keep_all_else():
    params = graph_cut()
    params.threshold, params.sampler, params.randomGeneratorState = 2.5, cv2.SAMPLING_PROSAC, 77
    _, other = without_graph_cut(0, params)
    assert other.loMethod == cv2.LOCAL_OPTIM_INNER_AND_ITER_LO
    assert params.loMethod == cv2.LOCAL_OPTIM_GC
    names = [name for name in dir(params) if not name.startswith("_") and name != "loMethod"]
    assert len(names) > 10
    assert all(getattr(other, name) == getattr(params, name) for name in names)


@pytest.mark.parametrize("name", ["usac_magsac", "ransac", "usac_default"])
def test_methods_without_graph_cut_are_never_replaced(name):
    asked = Robust(METHODS[name], 1.0, 0.99, 100)
    assert asked.for_size(10 * GRAPH_CUT_MAX) is asked


def test_accurate_answers_on_very_many_matches():
    big = two_view_scene(50_500, inlier_ratio=0.8, noise=0.5, random_state=0)
    asked = Robust(cv2.USAC_ACCURATE, 1.5, 0.99, 100).for_size(50_500)
    F, mask = asked.plain(big.points1, big.points2)
    assert F is not None
    assert mask.ravel()[big.inliers].mean() > 0.5


def test_the_original_survives_a_patched_cv2(scene, monkeypatch):
    def recursion(*_):
        raise AssertionError("the patched function was called")

    expected = original(scene.points1, scene.points2, cv2.USAC_FAST, 1.0, 0.99, 100)
    monkeypatch.setattr(cv2, "findFundamentalMat", recursion)
    answer = Robust(cv2.USAC_FAST, 1.0, 0.99, 100).plain(scene.points1, scene.points2)
    assert_same(answer, expected)
    assert draw(scene.X.astype(np.float32), 1.0, 0.99, 100, 0) is not None


def test_a_cv2_without_the_function_is_explained(tmp_path):
    (tmp_path / "cv2.py").write_text("")
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import cv_densityf._engine"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("ImportError: this cv2 has no findFundamentalMat; install")
    assert "During handling" not in done.stderr


def test_a_draw_finds_f_among_mostly_right_matches(scene):
    F = draw(scene.X.astype(np.float32), 1.0, 0.999, 1000, 0)
    true = two_view_scene(300, inlier_ratio=1.0, noise=0.0, random_state=3)
    assert np.median(sampson_distance(F, true.X)) < 1.0


@pytest.mark.parametrize("seed", range(4))
def test_small_thresholds_do_not_depend_on_the_unit_of_length(seed):
    """For cv2 they do: it takes a plane to be several pixels thick, whatever the threshold is."""
    rng = np.random.default_rng(seed)
    first = rng.uniform(-500, 500, (200, 2))
    X = np.hstack([first, 1.1 * first + rng.normal(0, 1.0, (200, 2))]).astype(np.float32)
    F, eighth = draw(X, 1.0, 0.999, 1000, seed), draw(X / 8, 1 / 8, 0.999, 1000, seed)
    np.testing.assert_array_equal(eighth, F * np.outer([8, 8, 1], [8, 8, 1]))


@pytest.mark.parametrize("zoom", [0.04, 1.0, 25.0])
def test_without_planes_the_second_image_is_the_larger_one_to_cv2(scene, zoom, monkeypatch):
    """And residuals compare with the threshold as they do without, whatever the images' sizes."""
    X = np.hstack([scene.points1 * zoom, scene.points2])
    X[0, :2] = 1e6
    told = []

    def spy(points1, points2, params):
        told.append((np.hstack([points1, points2]), params.threshold))
        return original(points1, points2, params)

    monkeypatch.setattr(_engine, "original", spy)
    F = draw(X.astype(np.float32), min(1.0, zoom), 0.999, 1000, 0, planes=False)
    ((points, threshold),) = told
    sizes = np.median(np.abs(points - np.median(points, axis=0)), axis=0).reshape(2, 2)
    assert np.hypot(*sizes[1]) / np.hypot(*sizes[0]) == pytest.approx(16.0, rel=0.2)
    factor = (points[2:] / X[2:]).mean(axis=0)
    to_cv2 = np.diag([1.0 / factor[2], 1.0 / factor[3], 1.0]) @ F
    of_cv2 = sampson_distance(to_cv2 @ np.diag([1.0 / factor[0], 1.0 / factor[1], 1.0]), points)
    ratio = of_cv2 / threshold / (sampson_distance(F, X) / min(1.0, zoom))
    assert np.median(ratio) == pytest.approx(1.0, rel=0.25)
    right = X[scene.inliers][1:]
    assert np.mean(sampson_distance(F, right) < 2.0 * min(1.0, zoom)) > 0.9


def test_without_planes_copies_of_one_match_are_no_error():
    assert draw(np.ones((40, 4), np.float32), 1.0, 0.99, 100, 0, planes=False) is None


def test_draws_depend_on_the_seed_alone():
    hard = two_view_scene(300, inlier_ratio=0.3, noise=1.0, random_state=0).X.astype(np.float32)
    draws = [draw(hard, 1.0, 0.99, 50, seed) for seed in (0, 1, 2, 0)]
    np.testing.assert_array_equal(draws[0], draws[3])
    assert len({F.tobytes() for F in draws}) == 3


@pytest.mark.parametrize("points", [np.zeros((40, 4)), np.tile(np.arange(40.0)[:, None], 4)])
def test_a_draw_from_degenerate_matches_is_none_or_finite(points):
    F = draw(points.astype(np.float32), 1.0, 0.99, 100, 0)
    assert F is None or np.isfinite(F).all()


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_a_draw_of_no_matrix_is_none(value, scene, monkeypatch):
    X = np.hstack([scene.points1, scene.points2]).astype(np.float32)
    monkeypatch.setattr(_engine, "original", lambda *_: (np.full((3, 3), value), None))
    assert draw(X, 1.0, 0.99, 100, 0) is None


def test_a_draw_from_matches_that_are_not_numbers_is_none():
    assert draw(np.full((40, 4), np.nan, np.float32), 1.0, 0.99, 100, 0) is None


@pytest.mark.parametrize("seed", range(4))
def test_a_draw_that_is_told_the_order_starts_with_the_best(seed):
    """Thirty right matches ahead of 570 wrong ones are found at once, and not by chance."""
    right = two_view_scene(30, inlier_ratio=1.0, noise=0.2, random_state=seed).X
    wrong = np.random.default_rng(seed).uniform(0, [1280, 960] * 2, (570, 4))
    points = np.vstack([right, wrong]).astype(np.float32)

    def fit(best_first):
        F = draw(points, 1.0, 0.999, 300, seed, best_first)
        return np.inf if F is None else np.median(sampson_distance(F, right))

    assert fit(best_first=True) < 1
    assert fit(best_first=False) > 5


def test_params_say_whether_the_best_rows_come_first():
    params = cv2.UsacParams()
    for sampler in (cv2.SAMPLING_UNIFORM, cv2.SAMPLING_PROSAC):
        params.sampler = sampler
        robust = Robust(cv2.FM_RANSAC, 1.0, 0.99, 100, params)
        assert robust.best_first == (sampler == cv2.SAMPLING_PROSAC)


def test_seeds_of_32_bits_are_all_different_states(monkeypatch):
    states = []

    def spy(points1, points2, params):
        states.append(params.randomGeneratorState)
        return None, None

    monkeypatch.setattr(_engine, "original", spy)
    for seed in (0, 2**31 - 1, 2**31, 2**32 - 1):
        _engine.draw(np.zeros((20, 4), dtype=np.float32), 1.0, 0.99, 10, seed)
    assert len(set(states)) == 4
