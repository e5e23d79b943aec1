"""The whole pipeline: what holds for every method, every input, and every answer."""

from __future__ import annotations

import logging
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import FrozenInstanceError
from itertools import cycle

import cv2
import numpy as np
import pytest
from scipy.stats import spearmanr

from benchmarks.scenes import make_scene
from cv_densityf import (
    Estimate,
    FundamentalMatrixEstimator,
    _estimate,
    estimate_fundamental,
    findFundamentalMat,
)
from cv_densityf._arguments import OFF
from cv_densityf._consensus import _Pool, search
from cv_densityf._engine import METHODS, Robust, original
from cv_densityf._epipolar import eight_point, inlier_mask, middle, sampson_distance
from cv_densityf._estimate import MIN_FILTERED, _some, run
from cv_densityf._prefilter import contrast_support
from cv_densityf.datasets import two_view_scene

ROBUST = [name for name in METHODS if name not in ("7point", "8point")]
#: One method for each rule of the mask.
RULES = ["usac_accurate", "ransac", "lmeds"]
DENSITIES = ["contrast", "paper"]


def scene_of(seed=0, n=400, inlier_ratio=0.4, noise=0.5):
    return two_view_scene(n, inlier_ratio=inlier_ratio, noise=noise, random_state=seed)


def true_matches(seed):
    return two_view_scene(400, inlier_ratio=1.0, noise=0.0, random_state=seed).X


def estimate(X, **options):
    return estimate_fundamental(X[:, :2], X[:, 2:], **options)


def rule_of(method):
    return Robust(METHODS[method], 1.0, 0.99, 1).rule


def assert_whole(result, n):
    """What every estimate has, whatever went in."""
    assert isinstance(result, Estimate)
    assert bool(result) == (result.F is not None)
    for flags in (result.mask, result.kept):
        assert flags.shape == (n,)
        assert flags.dtype == bool
    assert result.reliability.shape == (n,)
    known = result.reliability[~np.isnan(result.reliability)]
    assert ((known >= 0) & (known <= 1)).all()
    assert result.reason
    assert result.n_inliers == result.mask.sum()
    assert all(ms >= 0 for ms in result.timings.values())
    if result:
        assert result.F.dtype == np.float64
        assert result.F.shape[1:] == (3,)
        assert np.isfinite(result.F).all()
    else:
        assert not result.mask.any()


def assert_same(first, second):
    np.testing.assert_array_equal(first.F, second.F)
    np.testing.assert_array_equal(first.mask, second.mask)
    np.testing.assert_array_equal(first.kept, second.kept)
    np.testing.assert_array_equal(first.reliability, second.reliability)
    assert (first.n_draws, first.engine, first.reason) == (
        second.n_draws,
        second.engine,
        second.reason,
    )
    assert first.votes == second.votes


# What an estimate is


def test_an_estimate_is_truthy_with_f_and_cannot_be_changed():
    result = estimate(scene_of().X)
    assert result
    assert_whole(result, 400)
    with pytest.raises(FrozenInstanceError):
        result.F = None
    assert f"{result.n_inliers} inliers of 400" in repr(result)
    assert result.reason in repr(result)


def test_no_f_is_falsy_with_a_reason():
    result = estimate(np.ones((40, 4)))
    assert not result
    assert_whole(result, 40)
    assert "on a line" in result.reason
    assert "degenerate" in result.reason
    assert "no F" in repr(result)


def test_timings_are_of_the_stages_that_ran():
    searched = estimate(scene_of().X).timings
    assert set(searched) == {"density", "draws", "polish", "mask"}
    assert set(estimate(scene_of().X, density="off").timings) == {"draws"}


def test_votes_and_draws_are_told():
    result = estimate(scene_of().X)
    assert result.engine == "density"
    assert result.votes
    assert estimate(scene_of().X, density="off").n_draws == 0


def test_arguments_are_left_as_they_are():
    scene = scene_of()
    points = scene.points1.copy(), scene.points2.copy()
    scores = np.random.default_rng(0).uniform(size=400)
    kept = scores.copy()
    estimate_fundamental(scene.points1, scene.points2, scores=scores)
    np.testing.assert_array_equal(scene.points1, points[0])
    np.testing.assert_array_equal(scene.points2, points[1])
    np.testing.assert_array_equal(scores, kept)


# What it tells a logger


def test_one_line_per_call_for_whoever_listens(caplog):
    X = scene_of().X
    with caplog.at_level("DEBUG", "cv_densityf"):
        found = estimate(X)
        findFundamentalMat(X[:, :2], X[:, 2:], cv2.USAC_MAGSAC, 1.0, 0.999, 1000)
        FundamentalMatrixEstimator(method="ransac").fit(X)
        estimate(X[:12], method="ransac")
    lines = [record.getMessage() for record in caplog.records]
    assert {record.name for record in caplog.records} == {"cv_densityf"}
    assert len(lines) == 4
    head = f"400 matches, {found.kept.sum()} kept, {found.n_draws} draws, {found.n_inliers} inliers"
    assert lines[0].startswith(f"{head}, engine density, ")
    ms = float(re.search(r"([\d.]+) ms: ", lines[0])[1])
    assert ms == pytest.approx(sum(found.timings.values()), abs=0.1)
    assert lines[0].endswith(found.reason)
    assert all(line.startswith("400 matches, ") for line in lines[1:3])
    assert "12 kept, 0 draws" in lines[3]
    assert "engine ransac" in lines[3]
    assert "fewer than 15 finite matches" in lines[3]


def test_nobody_listens_by_default(capfd, monkeypatch):
    assert any(
        isinstance(h, logging.NullHandler) for h in logging.getLogger("cv_densityf").handlers
    )

    def never(*_, **__):
        raise AssertionError("made a record that nobody reads")

    monkeypatch.setattr(logging.Logger, "makeRecord", never)
    assert estimate(scene_of().X)
    assert capfd.readouterr() == ("", "")


# What it finds


@pytest.mark.parametrize("method", ROBUST)
def test_every_robust_method_finds_the_geometry(method):
    errors = []
    for seed in range(3):
        # The median's method takes half of the matches for right, come what may.
        scene = scene_of(seed, 500, 0.6 if method == "lmeds" else 0.35)
        result = estimate(scene.X, method=method)
        assert_whole(result, 500)
        errors.append(sampson_distance(result.F, true_matches(seed)).mean())
        assert result.mask[scene.inliers].mean() > 0.6
        assert result.mask[~scene.inliers].mean() < 0.1
    assert np.median(errors) < 0.5


def test_finds_more_than_cv2_where_few_matches_are_right():
    """Fifteen per cent: cv2's RANSAC is lost, and its USAC often."""
    ours, ransac = [], []
    for seed in range(8):
        scene = scene_of(seed, 500, 0.15)
        truth = true_matches(seed)
        ours.append(sampson_distance(estimate(scene.X).F, truth).mean())
        plain = estimate(scene.X, method="ransac", density="off")
        ransac.append(sampson_distance(plain.F, truth).mean() if plain else np.inf)
    assert np.median(ours) < 1.0
    assert np.median(ransac) > 3 * np.median(ours)


@pytest.mark.parametrize("method", RULES)
@pytest.mark.parametrize("density", DENSITIES)
def test_the_mask_is_the_rule_on_all_rows_dropped_ones_too(method, density):
    for seed in range(3):
        scene = scene_of(seed, 500, 0.5)
        for threshold in (0.7, 3.0):
            result = estimate(
                scene.X, method=method, threshold=threshold, density=density, max_iters=500
            )
            expected = inlier_mask(result.F, scene.X, rule_of(method), threshold)
            np.testing.assert_array_equal(result.mask, expected)
            assert (result.mask & ~result.kept).any()


def test_scores_find_what_density_alone_does_not():
    """Five per cent right, which the scores know about."""
    found = {True: 0, False: 0}
    for seed in range(12):
        scene = scene_of(seed, 600, 0.05)
        rng = np.random.default_rng(seed)
        scores = np.where(scene.inliers, rng.beta(8, 2, 600), rng.beta(2, 8, 600))
        for known in found:
            result = estimate(scene.X, scores=scores if known else None)
            found[known] += sampson_distance(result.F, true_matches(seed)).mean() < 2
    assert found[True] > found[False] + 1


def test_paper_rule_keeps_and_draws_as_the_paper_says():
    X = scene_of(0, 400, 0.6).X
    result = estimate(X, density="paper", method="ransac")
    assert result.engine == "density"
    assert result.reliability.max() <= 1.0
    np.testing.assert_array_equal(result.kept, result.reliability >= 0.011)
    assert f"of the {result.kept.sum()} matches" in result.reason
    less = estimate(X, density="paper", method="ransac", alpha=0.02)
    assert less.engine == "density"
    assert less.kept.sum() < result.kept.sum()
    coarse = estimate(X, density="paper", method="ransac", dc_percent=20.0)
    assert not np.array_equal(coarse.reliability, result.reliability)


# When cv2 answers


@pytest.mark.parametrize("method", METHODS)
def test_density_off_is_cv2s_own_answer(method):
    X = scene_of(1).X
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # USAC_PARALLEL answers the same twice on one thread only
    try:
        result = estimate(X, method=method, density="off", threshold=1.5, max_iters=300)
        F, mask = original(X[:, :2], X[:, 2:], METHODS[method], 1.5, 0.999, 300)
    finally:
        cv2.setNumThreads(threads)
    np.testing.assert_array_equal(result.F, F)
    np.testing.assert_array_equal(result.mask, mask.ravel().astype(bool))
    assert result.engine == method
    assert "density is off" in result.reason


@pytest.mark.parametrize("method", ["7point", "8point"])
def test_direct_methods_are_never_filtered(method):
    X = scene_of(1).X
    result = estimate(X, method=method)
    F, mask = original(X[:, :2], X[:, 2:], METHODS[method], 1.0, 0.999, 5000)
    np.testing.assert_array_equal(result.F, F)
    np.testing.assert_array_equal(result.mask, mask.ravel().astype(bool))
    assert method in result.reason


@pytest.mark.parametrize("n", range(21))
def test_any_small_number_of_matches_has_an_answer(n):
    X = scene_of(0, 60, 0.8).X[:n]
    for method in ("usac_accurate", "usac_fm_8pts", "ransac", "lmeds", "8point"):
        for density in DENSITIES:
            result = estimate(X, method=method, density=density)
            assert_whole(result, n)
            if n >= MIN_FILTERED:
                continue
            assert result.engine == method
            F, mask = Robust(METHODS[method], 1.0, 0.999, 5000).plain(X[:, :2], X[:, 2:])
            np.testing.assert_array_equal(result.F, F)
            if F is not None:
                np.testing.assert_array_equal(result.mask, mask.ravel().astype(bool))
            assert (n >= 7) or not result


def test_seven_matches_have_up_to_three_matrices_below_each_other():
    X = true_matches(0)[:7]
    F = estimate(X, method="ransac").F
    assert F.shape == (9, 3)
    for one in F.reshape(3, 3, 3):
        assert sampson_distance(one, X).max() < 1e-2


def test_where_no_draw_holds_cv2_answers(monkeypatch):
    X = scene_of().X
    monkeypatch.setattr("cv_densityf._consensus.draw", lambda *_, **__: None)
    result = estimate(X, method="ransac")
    F, mask = original(X[:, :2], X[:, 2:], cv2.FM_RANSAC, 1.0, 0.999, 5000)
    np.testing.assert_array_equal(result.F, F)
    np.testing.assert_array_equal(result.mask, mask.ravel().astype(bool))
    assert (result.engine, result.n_draws) == ("ransac", 0)
    assert "no draw" in result.reason


def test_a_singular_least_squares_problem_is_no_exception(monkeypatch):
    def singular(*_, **__):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr("cv_densityf._consensus.polish", singular)
    result = estimate(scene_of().X)
    assert result.engine == "usac_accurate"
    assert_whole(result, 400)


# Inputs of every kind


@pytest.mark.parametrize("method", RULES)
@pytest.mark.parametrize("density", [*DENSITIES, "off"])
def test_rows_that_are_not_numbers_change_nothing_for_the_others(method, density):
    scene = scene_of(2, 300, 0.6)
    bad = np.random.default_rng(0).choice(340, 40, replace=False)
    finite = np.ones(340, dtype=bool)
    finite[bad] = False
    X = np.empty((340, 4))
    X[finite] = scene.X
    X[bad] = 100.0
    X[bad, np.arange(40) % 4] = np.resize([np.nan, np.inf, -np.inf], 40)
    options = {"method": method, "density": density, "max_iters": 300}
    whole, alone = estimate(X, **options), estimate(scene.X, **options)
    assert_whole(whole, 340)
    np.testing.assert_array_equal(whole.F, alone.F)
    np.testing.assert_array_equal(whole.mask[finite], alone.mask)
    np.testing.assert_array_equal(whole.kept[finite], alone.kept)
    assert not whole.mask[bad].any()
    assert not whole.kept[bad].any()


def test_scores_of_rows_that_are_not_numbers_do_not_matter():
    scene = scene_of(2, 300, 0.3)
    scores = np.random.default_rng(0).uniform(size=300)
    X, trust = scene.X.copy(), scores.copy()
    X[:50, 1] = np.nan
    trust[:50] = 1e9
    whole = estimate(X, scores=trust)
    np.testing.assert_array_equal(whole.F, estimate(scene.X[50:], scores=scores[50:]).F)


def test_nothing_but_bad_rows_is_no_f():
    assert_whole(result := estimate(np.full((50, 4), np.nan)), 50)
    assert not result


HOMOGRAPHY = np.array([[1.05, 0.1, 5.0], [-0.1, 1.1, 3.0], [1e-4, 0.0, 1.0]])


def one_plane():
    first = np.random.default_rng(0).uniform(0, 1000, (200, 2))
    second = cv2.perspectiveTransform(first[None], HOMOGRAPHY)[0]
    return np.hstack([first, second])


def degenerate():
    rng = np.random.default_rng(0)
    first = rng.uniform(0, 1000, (200, 2))
    line = np.c_[first[:, 0], 2 * first[:, 0] + 7]
    return {
        "all equal": np.full((200, 4), 5.0),
        "all zero": np.zeros((200, 4)),
        "line in both": np.hstack([line, line + 3]),
        "line in the first": np.hstack([line, first]),
        "line in the second": np.hstack([first, line]),
        "equal in the second": np.hstack([first, np.ones((200, 2))]),
        "same points": np.hstack([first, first]),
        "translation": np.hstack([first, first + np.array([30, 7])]),
        "one plane": one_plane(),
        "three places": np.repeat(rng.uniform(0, 1000, (3, 4)), 60, axis=0),
        "eight places": np.repeat(rng.uniform(0, 1000, (8, 4)), 30, axis=0),
        "half equal": np.vstack([rng.uniform(0, 1000, (100, 4)), np.zeros((100, 4))]),
        "chance": rng.uniform(0, 1000, (200, 4)),
        "tiny": rng.uniform(0, 1e-30, (200, 4)),
        "huge": rng.uniform(0, 1e30, (200, 4)),
        "beyond float32": rng.uniform(0, 1e200, (200, 4)),
    }


@pytest.mark.parametrize("kind", degenerate())
@pytest.mark.parametrize("method", [*RULES, "usac_magsac"])
def test_degenerate_matches_raise_nothing(kind, method):
    X = degenerate()[kind]
    for density in DENSITIES:
        result = estimate(X, method=method, density=density, max_iters=200)
        assert_whole(result, len(X))


@pytest.mark.parametrize("method", RULES)
@pytest.mark.parametrize("kind", ["same points", "translation", "one plane"])
def test_all_matches_of_one_homography_are_inliers(kind, method):
    """Many F explain them, and any that does is right."""
    X = degenerate()[kind]
    result = estimate(X, method=method)
    assert result
    assert result.mask.mean() > (0.9 if method == "lmeds" else 0.999)


def test_classic_methods_find_no_f_on_a_line_as_cv2_does():
    for kind in ("all equal", "line in both", "line in the first", "line in the second"):
        X = degenerate()[kind]
        assert original(X[:, :2], X[:, 2:], cv2.FM_RANSAC, 1.0, 0.99, 500)[0] is None
        assert not estimate(X, method="ransac")


@pytest.mark.parametrize("offset", [1e4, 1e6])
def test_large_coordinates_cost_no_accuracy(offset):
    back = np.array([[1, 0, offset], [0, 1, offset], [0, 0, 1]])
    errors = []
    for seed in range(4):
        result = estimate(scene_of(seed).X + offset, method="ransac")
        errors.append(sampson_distance(back.T @ result.F @ back, true_matches(seed)).mean())
    assert np.median(errors) < 0.4


def test_very_large_coordinates_are_no_error():
    X = scene_of().X + 1e6
    for method in ROBUST:
        assert_whole(estimate(X, method=method, max_iters=200), 400)


def test_float16_and_integers_are_points_too():
    scene = scene_of(0, 500, 0.5)
    for dtype in (np.float16, np.float32, np.int16, np.int64, np.uint16):
        first, second = (p.round().astype(dtype) for p in (scene.points1, scene.points2))
        result = estimate_fundamental(first, second, threshold=2.0)
        same = estimate_fundamental(first.astype(float), second.astype(float), threshold=2.0)
        assert_same(result, same)
        assert sampson_distance(result.F, true_matches(0)).mean() < 2


def test_lists_and_cv2s_shapes_are_points_too():
    scene = scene_of()
    expected = estimate(scene.X)
    p, q = scene.points1, scene.points2
    for shaped in ((p[:, None], q[:, None]), (p[None], q[None]), (p.tolist(), q[:, None].tolist())):
        assert_same(estimate_fundamental(*shaped), expected)
    fortran = np.asfortranarray(scene.X)
    result = estimate_fundamental(fortran[:, :2], fortran[:, 2:])
    np.testing.assert_allclose(result.F, expected.F, rtol=1e-6)
    np.testing.assert_array_equal(result.mask, expected.mask)
    assert_same(estimate_fundamental(p[::-1][::-1], q.copy()), expected)


@pytest.mark.parametrize("method", METHODS)
def test_very_many_matches(method):
    scene = scene_of(0, 20_000, 0.5)
    result = estimate(scene.X, method=method, max_iters=100)
    assert_whole(result, 20_000)
    if method in ROBUST:
        assert sampson_distance(result.F, true_matches(0)).mean() < 0.3
        expected = inlier_mask(result.F, scene.X, rule_of(method), 1.0)
        np.testing.assert_array_equal(result.mask, expected)


def test_a_searched_part_is_told_by_the_reliability():
    """Rows the search did not look at have no reliability, and their place in the mask."""
    scene = scene_of(0, 20_000, 0.5)
    result = estimate(scene.X)
    unseen = np.isnan(result.reliability)
    assert unseen.any()
    assert not result.kept[unseen].any()
    assert result.mask[unseen & scene.inliers].mean() > 0.5
    other = estimate(scene.X, random_state=1)
    assert not np.array_equal(unseen, np.isnan(other.reliability))


def test_of_many_matches_few_are_looked_at_where_most_are_right(monkeypatch):
    scene = scene_of(0, 3_000, 0.8)
    rows = [
        np.flatnonzero(~np.isnan(estimate(scene.X, random_state=seed).reliability))
        for seed in (0, 0, 1)
    ]
    assert [len(r) for r in rows] == [250] * 3
    assert np.array_equal(rows[0], rows[1])
    assert not np.array_equal(rows[0], rows[2])
    # They are of all, not of those that come first.
    assert rows[0].min() < 200 < 2_800 < rows[0].max()
    assert sampson_distance(estimate(scene.X).F, true_matches(0)).mean() < 0.1
    # The better half by score would not tell.
    with_scores = estimate(scene.X, scores=np.arange(3_000.0))
    assert np.count_nonzero(np.isfinite(with_scores.reliability)) == 1_000
    monkeypatch.setattr(_Pool, "agrees", lambda *_, **__: False)
    assert not np.isnan(estimate(scene.X).reliability).any()


@pytest.mark.parametrize(("n", "n_better"), [(1_200, 1_000), (4_000, 2_000)])
def test_of_many_matches_those_with_the_better_scores_are_looked_at(n, n_better):
    X = scene_of(0, n, 0.5).X
    scores = np.random.default_rng(0).uniform(size=n)
    seen = [
        np.flatnonzero(~np.isnan(estimate(X, scores=scores, random_state=seed).reliability))
        for seed in range(2)
    ]
    # Where two draws do not agree it is all, and so mostly where the right ones are few.
    of_all = [
        not np.isnan(estimate(scene_of(seed, n, 0.05).X, scores=scores).reliability).any()
        for seed in range(5)
    ]
    assert sum(of_all) > 2
    better = np.argsort(-scores)[:n_better]
    for rows in seen:
        assert len(rows) == 1_000
        assert np.isin(rows, better).all()
    assert np.array_equal(*seen) == (n_better == 1_000)


@pytest.mark.parametrize("n_nan", [0, 40])
def test_the_order_of_prosac_is_that_of_scores(n_nan):
    X = scene_of(3, 300, 0.3).X
    X[:n_nan] = np.nan
    in_order = estimate(X, method="usac_prosac")
    assert_same(in_order, estimate(X, method="usac_default", scores=-np.arange(300)))
    finite = X[n_nan:]
    expected = contrast_support(finite, -np.arange(len(finite)))[0]
    np.testing.assert_array_equal(in_order.reliability[n_nan:], expected)
    assert not np.array_equal(expected, contrast_support(finite)[0])


def test_cv2s_own_prosac_gets_the_best_scores_first():
    X = scene_of(3, 300, 0.3).X
    X[7] = np.nan
    scores = np.random.default_rng(0).permutation(300)
    order = np.argsort(-scores)
    order = order[order != 7]
    F, mask = cv2.findFundamentalMat(X[order, :2], X[order, 2:], cv2.USAC_PROSAC, 1.0, 0.999, 5000)
    found = estimate(X, method="usac_prosac", density="off", scores=scores)
    np.testing.assert_array_equal(found.F, F)
    np.testing.assert_array_equal(found.mask[order], mask.ravel() == 1)
    assert not found.mask[7]
    # No other method minds the order.
    assert_same(*(estimate(X, density="off", scores=s) for s in (scores, None)))


@pytest.mark.parametrize("n", [1, 99, 100, 101, 150, 199, 100_000])
def test_a_part_has_each_match_once_and_in_order(n):
    rows = _some(n, 100, np.random.default_rng(1))
    assert len(rows) == min(n, 100)
    assert (np.diff(rows) > 0).all()
    assert 0 <= rows[0] <= rows[-1] < n


# Symmetries and repetition


@pytest.mark.parametrize("method", [*RULES, "usac_parallel"])
@pytest.mark.parametrize("density", DENSITIES)
def test_the_same_call_gives_the_same_answer(method, density):
    X = scene_of(3, 300, 0.3).X
    options = {"method": method, "density": density, "max_iters": 300}
    assert_same(estimate(X, **options), estimate(X, **options))


def test_the_seed_is_random_state_and_nothing_else():
    X = scene_of(3, 300, 0.15, noise=1.0).X
    first = estimate(X, random_state=3)
    np.random.seed(1)  # noqa: NPY002
    cv2.setRNGSeed(7)
    assert_same(estimate(X, random_state=3), first)
    others = [estimate(X, random_state=seed).votes for seed in range(4)]
    assert len(set(others)) == 4


def test_the_largest_seed_is_a_seed():
    X = scene_of(3, 300, 0.05).X
    for density in DENSITIES:
        result = estimate(X, random_state=2**31 - 1, density=density, max_iters=100)
        assert_whole(result, 300)


def test_threads_get_the_same_answers():
    Xs = [scene_of(seed, 300, 0.3).X for seed in range(8)]
    with ThreadPoolExecutor(4) as pool:
        parallel = list(pool.map(estimate, Xs * 2))
    for one, other in zip(parallel, [estimate(X) for X in Xs] * 2, strict=True):
        assert_same(one, other)


@pytest.mark.parametrize("method", RULES)
def test_swapped_images_have_the_transposed_matrix(method):
    for seed in range(4):
        scene = scene_of(seed, 500, 0.5)
        there = estimate(scene.X, method=method)
        back = estimate(scene.X[:, [2, 3, 0, 1]], method=method)
        gap = [sampson_distance(F, true_matches(seed)) for F in (there.F, back.F.T)]
        assert np.abs(gap[0] - gap[1]).mean() < 0.3
        assert (there.mask & back.mask).sum() > 0.9 * (there.mask | back.mask).sum()


def test_the_order_of_the_matches_hardly_matters():
    """Draws differ, the geometry does not; reliability goes with its match."""
    scene = scene_of(1, 500, 0.3)
    rng = np.random.default_rng(0)
    first = estimate(scene.X)
    errors, overlaps = [], []
    for _ in range(8):
        order = rng.permutation(500)
        result = estimate(scene.X[order])
        errors.append(sampson_distance(result.F, true_matches(1)).mean())
        mask = np.empty(500, dtype=bool)
        mask[order] = result.mask
        overlaps.append((mask & first.mask).sum() / (mask | first.mask).sum())
        # Matches that share no neighbour tie, and ties are broken by row.
        assert spearmanr(result.reliability, first.reliability[order]).statistic > 0.6
    assert np.median(errors) < 0.5
    assert np.median(overlaps) > 0.85


# Refusals


GOOD = np.zeros((20, 2))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"threshold": 0}, "threshold is 0; it must be .*above 1e-12"),
        ({"threshold": -1.0}, "threshold is -1.0"),
        ({"threshold": np.nan}, "threshold is nan"),
        ({"threshold": np.inf}, "threshold is inf"),
        ({"confidence": 0.0}, "confidence is 0.0; it must be "),
        ({"confidence": 1.0}, "confidence is 1.0"),
        ({"confidence": np.nan}, "confidence is nan"),
        ({"max_iters": 0}, "max_iters is 0; it must be .*from 1 to"),
        ({"threshold": "1"}, "threshold is '1'; it must be "),
        ({"max_iters": 100.5}, "max_iters is 100.5; it must be "),
        ({"density": "on"}, "density is 'on'; it must be .*contrast, paper"),
        ({"max_iters": 2**31}, r"max_iters is 2147483648; it must be .* to 2\^31 - 1"),
        ({"max_iters": np.int64(2**40)}, "max_iters is "),
        ({"density": None}, "density is None"),
        ({"alpha": -0.1}, "alpha is -0.1; it must be .*from 0 to 1"),
        ({"alpha": 1.5}, "alpha is 1.5"),
        ({"alpha": np.nan}, "alpha is nan"),
        ({"dc_percent": 0}, "dc_percent is 0; it must be "),
        ({"dc_percent": 101}, "dc_percent is 101"),
        ({"random_state": -1}, "random_state is -1; it must be an integer from 0"),
        ({"random_state": 2**31}, "random_state is 2147483648"),
        ({"random_state": 0.5}, "random_state is 0.5"),
        ({"random_state": None}, "random_state is None"),
        ({"method": "magsac"}, "unknown method 'magsac'; choose one of .*usac_magsac"),
        ({"method": 77}, "unknown method 77; choose one of"),
        ({"method": 8.0}, "unknown method 8.0; choose one of"),
        ({"method": None}, "unknown method None; choose one of"),
        ({"method": True}, "unknown method True; choose one of"),
        ({"threshold": True}, "threshold is True; it must be "),
        ({"scores": np.zeros(19)}, "scores has 19 entries for 20 matches"),
        ({"scores": np.full(20, np.nan)}, "scores has NaN; give .* the lowest score"),
        ({"scores": np.ones(20, complex)}, "scores is of type complex128; .* real numbers"),
        ({"scores": [1j] * 20}, "scores is of type complex128"),
    ],
)
def test_wrong_options_are_named_with_what_to_do(options, message):
    with pytest.raises(ValueError, match=message):
        estimate_fundamental(GOOD, GOOD, **options)


@pytest.mark.parametrize(
    ("first", "second", "message"),
    [
        (GOOD, GOOD[:19], "points1 has 20 points and points2 19; row i .* one match"),
        (GOOD.T, GOOD.T, r"points1 has shape \(2, 20\); it must be \(n, 2\)"),
        (GOOD, np.zeros((20, 3)), r"points2 has shape \(20, 3\)"),
        (np.zeros((20, 4)), GOOD, r"points1 has shape \(20, 4\)"),
        (GOOD.ravel(), GOOD, r"points1 has shape \(40,\)"),
        (GOOD.astype(np.complex64), GOOD, "points1 is of type complex64; .* real numbers"),
        (GOOD, GOOD.astype(str), "points2 is of type <U.*; .* real numbers"),
        (GOOD.astype("datetime64[s]"), GOOD, "points1 is of type datetime64.*; .* real numbers"),
        ([["a", {}]] * 20, GOOD, "points1 is of type object; .* real numbers"),
        ([[1, 2], [3]], GOOD, "points1 has rows of different length"),
        (np.zeros((5, 4, 2)), GOOD, r"points1 has shape \(5, 4, 2\)"),
    ],
)
def test_wrong_points_are_named_with_what_to_do(first, second, message):
    with pytest.raises(ValueError, match=message):
        estimate_fundamental(first, second)


@pytest.mark.timeout(20)
def test_a_seed_of_numpys_is_checked_at_once():
    """A range is searched number by number for what is no int."""
    largest = np.int64(2**31 - 1)
    found, same = (estimate_fundamental(GOOD, GOOD, random_state=s) for s in (largest, 2**31 - 1))
    assert found.reason == same.reason
    with pytest.raises(ValueError, match="random_state is"):
        estimate_fundamental(GOOD, GOOD, random_state=largest + 1)


def test_run_takes_params_and_their_rule():
    """The inner entry, as the drop-in calls it with ``cv2.UsacParams``."""
    params = cv2.UsacParams()
    params.threshold = 2.0
    X = scene_of().X
    result = run(X, Robust(cv2.USAC_DEFAULT, 2.0, 0.99, 1000, params))
    np.testing.assert_array_equal(result.mask, inlier_mask(result.F, X, "usac", 2.0))
    plain = run(X, Robust(cv2.USAC_DEFAULT, 2.0, 0.99, 1000, params), OFF)
    np.testing.assert_array_equal(plain.F, original(X[:, :2], X[:, 2:], params)[0])
    assert plain.engine == "usac"


@pytest.mark.parametrize("method", ["lmeds", "7point", "8point"])
@pytest.mark.parametrize("n", [10, 60])
def test_seven_numbers_among_more_rows_make_one_matrix(method, n):
    """Of seven rows alone cv2 would stack all matrices through them."""
    X = scene_of().X[:n].copy()
    X[7:] = np.nan
    found = estimate(X, method=method)
    assert found.F.shape == (3, 3)
    assert np.isfinite(found.F).all()
    assert not found.mask[7:].any()


@pytest.mark.parametrize(("scale", "asked"), [(1.0, False), (1e-2, True)])
def test_a_threshold_as_wide_as_the_points_is_asked_about(scale, asked):
    assert ("are they in pixels?" in estimate(scale * scene_of().X).reason) == asked
    assert "are they in pixels?" not in estimate(scale * scene_of().X, method="lmeds").reason


def test_what_is_masked_is_no_number():
    scene = scene_of()
    hidden = np.flatnonzero(scene.inliers)[:20]
    X = np.ma.masked_array(scene.X, np.isin(np.arange(len(scene.X)), hidden)[:, None].repeat(4, 1))
    assert not estimate(X).mask[hidden].any()
    with pytest.raises(ValueError, match="scores has NaN"):
        estimate(scene.X, scores=X[:, 0])


def test_matches_beyond_the_search_refine_the_result(monkeypatch):
    searched, all_rows = [], []
    for seed in range(6):
        scene = two_view_scene(3000, inlier_ratio=0.5, noise=1.0, random_state=seed)
        exact = two_view_scene(3000, inlier_ratio=0.5, noise=0.0, random_state=seed)
        X = np.hstack([exact.points1, exact.points2])[exact.inliers]
        for errors, refined in ((searched, 500), (all_rows, 100_000)):
            monkeypatch.setattr("cv_densityf._estimate.MAX_SEARCHED", 500)
            monkeypatch.setattr("cv_densityf._estimate.MAX_REFINED", refined)
            estimate = estimate_fundamental(scene.points1, scene.points2)
            errors.append(np.median(sampson_distance(estimate.F, X)))
    assert np.mean(all_rows) < 0.7 * np.mean(searched)


def test_all_matches_vote_on_what_a_part_has_found(monkeypatch):
    """Most matches of the part that is searched are of a wrong scene, most of all of the right."""
    right = two_view_scene(2000, inlier_ratio=1.0, noise=0.3, random_state=0)
    wrong = two_view_scene(300, inlier_ratio=1.0, noise=0.3, random_state=1)
    X = np.vstack([wrong.X, right.X])
    searched = np.arange(500)
    centre, _ = middle(X[searched])
    both = cycle(eight_point((scene.X - centre)[None])[0] for scene in (wrong, right))
    monkeypatch.setattr("cv_densityf._consensus.draw", lambda *_, **__: next(both))
    monkeypatch.setattr("cv_densityf._estimate.MAX_SEARCHED", 500)
    monkeypatch.setattr(
        "cv_densityf._estimate._some",
        lambda n, size, rng: searched if size == 500 else np.arange(n),
    )
    assert np.median(sampson_distance(estimate(X).F, right.X)) < 1.0
    monkeypatch.setattr("cv_densityf._consensus._FINALISTS", 1)
    assert np.median(sampson_distance(estimate(X).F, right.X)) > 5.0


@pytest.mark.parametrize("n", [200, 1500])
def test_a_pair_without_a_common_scene_mostly_gets_few_draws(n):
    """Half of those of a hard pair, and no second search among all of more than a thousand."""
    scene = two_view_scene(n, inlier_ratio=0.3, random_state=0)
    ended = 0
    for seed in range(6):
        wrong = np.random.default_rng(seed).permutation(scene.points2)
        estimate = estimate_fundamental(scene.points1, wrong)
        if "by chance" in estimate.reason:
            ended += 1
            assert estimate.n_draws <= 5
            assert np.isnan(estimate.reliability).sum() == max(n - 1000, 0)
    assert ended > 3
    assert "by chance" not in estimate_fundamental(scene.points1, scene.points2).reason


def test_few_right_matches_among_many_are_not_given_up():
    """One in twenty of 3,000, which are hardly denser than chance: most scenes are solved."""
    solved = 0
    for seed in range(6):
        scene = two_view_scene(3000, inlier_ratio=0.05, noise=0.5, random_state=seed)
        estimate = estimate_fundamental(scene.points1, scene.points2)
        solved += scene.inliers[estimate.mask].mean() > 0.5
    assert solved >= 5


def test_copies_of_a_match_do_not_end_the_search():
    """Samples of the local optimisation may be copies of one match, which fix no F."""
    for seed in range(8):
        scene = two_view_scene(60, inlier_ratio=0.35, noise=1.0, random_state=seed)
        copies = np.tile(np.round(scene.X[scene.inliers][0]), (120, 1))
        assert estimate(np.vstack([scene.X, copies])).engine == "density"


@pytest.mark.parametrize("far", [1e6, 1e9, 1e20, 1e30])
def test_one_match_far_out_does_not_make_a_line_of_the_others(far):
    """Nor does its place in float32 count: the search takes it for what it is."""
    X = scene_of(2, 300, 0.5).X
    for row in ([far, far, 300, 300], [300, 300, -far, far]):
        found = estimate(np.vstack([X, row]))
        assert found.engine == "density"
        assert not found.mask[-1]
        assert np.median(sampson_distance(found.F, X[estimate(X).mask])) < 1.0


@pytest.mark.parametrize("n_finite", [7, 12, 14])
def test_ransac_stays_ransac_where_few_rows_are_finite(n_finite):
    """cv2 would take seven rows for a minimal sample, and fewer than 15 to LMEDS."""
    scene = scene_of(0, 20, 0.9)
    X = scene.X.copy()
    X[n_finite:, 0] = np.nan
    found = estimate_fundamental(X[:, :2], X[:, 2:], method="ransac", threshold=3.0)
    F, mask = original(X[:, :2], X[:, 2:], cv2.FM_RANSAC, 3.0, 0.999, 5000)
    assert (found.F is None) == (F is None)
    if F is not None:
        np.testing.assert_array_equal(found.F, F)
        np.testing.assert_array_equal(found.mask, mask.ravel() == 1)


def test_the_threshold_rules_the_mask_and_not_the_search():
    """Within a factor of two of what the spread of the points says, which is 2 to 3 px here."""
    scene = two_view_scene(400, inlier_ratio=0.5, noise=1.0, random_state=0)
    X = np.hstack([scene.points1, scene.points2])
    narrow, wide = (run(X, Robust(cv2.USAC_DEFAULT, t, 0.999, 5000)) for t in (1.6, 4.0))
    np.testing.assert_array_equal(narrow.F, wide.F)
    assert narrow.n_inliers < wide.n_inliers
    np.testing.assert_array_equal(wide.mask, inlier_mask(wide.F, X, "usac", 4.0))


@pytest.mark.parametrize(("noise", "inlier_ratio"), [(0.02, 0.4), (20.0, 0.6)])
def test_the_search_is_within_a_factor_of_the_threshold(noise, inlier_ratio):
    """Where the noise is far from an ordinary photograph's, the caller may say so."""
    fit = []
    for seed in range(5):
        scene = two_view_scene(400, inlier_ratio=inlier_ratio, noise=noise, random_state=seed)
        exact = two_view_scene(400, inlier_ratio=inlier_ratio, noise=0.0, random_state=seed)
        X = np.hstack([exact.points1, exact.points2])[exact.inliers]
        told = estimate_fundamental(scene.points1, scene.points2, threshold=3 * noise)
        fit.append(np.median(sampson_distance(told.F, X)))
    assert np.median(fit) < 0.25 * noise


def test_an_f_that_fits_next_to_nothing_is_not_ours():
    scene = scene_of(seed=3)
    estimate = estimate_fundamental(
        scene.points1, scene.points2, method="usac_default", threshold=1e-7
    )
    assert estimate.engine == "usac_default"
    assert "too few matches fit" in estimate.reason


def test_empty_lists_are_no_matches():
    found = estimate_fundamental([], [])
    assert not found
    assert found.mask.shape == (0,)
    assert "0 finite matches" in found.reason


def test_the_search_gets_confidence_and_iterations(monkeypatch):
    asked = []

    def recorded(*args, **kwargs):
        asked.append(kwargs)
        return search(*args, **kwargs)

    monkeypatch.setattr(_estimate, "search", recorded)
    scene = scene_of()
    for confidence, max_iters, seed in ((0.9, 70, 0), (0.99, 700, 5)):
        estimate_fundamental(
            scene.points1,
            scene.points2,
            confidence=confidence,
            max_iters=max_iters,
            random_state=seed,
        )
        got = asked[-1]
        assert (got["confidence"], got["max_iters"], got["seed"]) == (confidence, max_iters, seed)


@pytest.mark.parametrize(
    ("threshold", "searched", "of_25"), [(0.1, 1.5, 3), (1.0, 2.0, 3), (4, 3, 6), (10, 5, 6)]
)
def test_the_searchs_threshold_is_a_hundredth_of_the_spread_near_the_callers(
    threshold, searched, of_25
):
    """Of few matches more."""
    robust = Robust(cv2.USAC_DEFAULT, threshold, 0.99, 1000)
    for n, expected in ((10**9, searched), (25, of_25)):
        found = _estimate._search_threshold(300.0, n, robust, "contrast")
        assert found == pytest.approx(expected)
        assert _estimate._search_threshold(300.0, n, robust, "paper") == threshold


@pytest.mark.parametrize(("spread", "searched"), [(9_000.0, 3.0), (20_000.0, 200.0)])
def test_the_searchs_threshold_is_a_few_pixels_if_these_are_pixels(spread, searched):
    """LMEDS takes none from the caller."""
    robust = Robust(cv2.FM_LMEDS, 3.0, 0.99, 1000)
    assert _estimate._search_threshold(spread, 10**9, robust, "contrast") == pytest.approx(searched)


@pytest.mark.parametrize("method", ["lmeds", "usac_accurate"])
def test_in_large_images_near_misses_are_wrong_matches(method):
    """Two in five are 2 to 6 px beside their line, where the others are a fifth of a pixel off."""
    errors = []
    for seed in range(6):
        scene = scene_of(seed, 500, 1.0, 0.0)
        rng = np.random.default_rng(seed)
        lines = np.hstack([scene.points1, np.ones((500, 1))]) @ scene.F.T
        normals = lines[:, :2] / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
        truth = 4.0 * scene.X
        X = truth + rng.normal(0, 0.2, (500, 4))
        X[:200, 2:] += rng.uniform(2, 6, (200, 1)) * normals[:200]
        errors.append(sampson_distance(estimate(X, method=method).F, truth).mean())
    assert np.median(errors) < 0.15


@pytest.mark.parametrize("times", [1, 20])
@pytest.mark.parametrize("by", ["scores", "order"])
def test_of_two_motions_the_more_trusted_one_wins(by, times):
    """Of 210 matches, not of 270 others: their scores are a standard deviation higher."""
    errors = {True: [], False: []}
    for seed in range(8):
        rng = np.random.default_rng(seed)
        right = scene_of(seed, 210 * times, 1.0)
        X = np.vstack([right.X, scene_of(50 + seed, 390 * times, 270 / 390).X])
        scores = rng.normal(0, 1, len(X))
        for told in (True, False):
            scores[: 210 * times] += told
            order = np.argsort(-scores) if by == "order" else rng.permutation(len(X))
            asked = {"method": "usac_prosac"} if by == "order" else {"scores": scores[order]}
            errors[told].append(sampson_distance(estimate(X[order], **asked).F, right.X).mean())
            scores[: 210 * times] -= told
    assert np.mean(np.array(errors[True]) < 1.0) > 0.7
    assert np.mean(np.array(errors[False]) < 1.0) < 0.3


@pytest.mark.parametrize(("n", "n_mark"), [(1_000, 250), (12_000, 2_000)])
def test_a_mark_that_both_images_bear_does_not_win_by_its_scores(n, n_mark):
    """Its matches are exact, and the best; three in five of all are right."""
    errors = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        scene = scene_of(seed, n - n_mark, 0.6 * n / (n - n_mark))
        mark = np.tile(rng.uniform([100, 800], [1180, 950], (n_mark, 2)), 2)
        scores = rng.normal(0, 1, n) + np.where(np.arange(n) < n_mark, 2.0, 0.0)
        found = estimate(np.vstack([mark, scene.X]), scores=scores)
        errors.append(np.median(sampson_distance(found.F, scene.X[scene.inliers])))
    assert np.count_nonzero(np.array(errors) > 1.0) <= 1


def test_texture_that_repeats_does_not_win_with_fewer_matches():
    """It has more votes: there are 350 such matches, dense and all over the wall, for 600 right."""
    errors = []
    for seed in range(12):
        pair = make_scene("repeated_texture", 2000, 0.3, 0.5, seed)
        errors.append(pair.error(estimate(pair.X).F))
    assert np.count_nonzero(np.array(errors) > 1.0) <= 1


@pytest.mark.parametrize("step", [8.0, 8 / 3])
@pytest.mark.parametrize("n", [60, 400])
def test_a_lattice_is_known_by_its_step(n, step):
    X = np.random.default_rng(0).uniform(0, [640, 480] * 2, (n, 4))
    whole = np.rint(X / step) * step
    assert _estimate._lattice_step(whole, 2.0, 20.0) == pytest.approx(step)
    assert _estimate._lattice_step(whole, 10.0, 20.0) == 0.0
    assert _estimate._lattice_step(whole, 0.5, 2.0) == 0.0
    # Of all matches: other ones may come later.
    assert _estimate._lattice_step(np.vstack([whole.repeat(8, axis=0), X]), 2.0, 20.0) == 0.0
    # A grid in one image alone is where the matcher asked, not what it rounded to.
    for columns in (slice(0, 2), slice(2, 4)):
        mixed = X.copy()
        mixed[:, columns] = whole[:, columns]
        assert _estimate._lattice_step(mixed, 2.0, 20.0) == 0.0
    assert _estimate._lattice_step(X, 2.0, 20.0) == 0.0
    assert _estimate._lattice_step(np.ones((300, 4)), 2.0, 20.0) == 0.0


@pytest.mark.parametrize("method", ["lmeds", "usac_accurate"])
def test_points_on_a_lattice_cost_less_than_in_cv2(method):
    """Wrong matrices suit many of them exactly."""
    errors = []
    for seed in range(12):
        X = np.rint(scene_of(seed, n=500, inlier_ratio=0.7, noise=0.3).X / 16) * 16
        F, _ = original(X[:, :2], X[:, 2:], METHODS[method], 3.0, 0.999, 5000)
        Fs = estimate(X, method=method, threshold=3.0).F, F
        errors.append([sampson_distance(F, true_matches(seed)).mean() for F in Fs])
    ours, cv2s = np.array(errors).T
    assert ours.max() < 5.0
    assert np.median(ours) < 0.6 * np.median(cv2s)


def test_only_lmeds_draws_for_what_most_agree_on():
    scene = two_view_scene(400, inlier_ratio=0.8, noise=0.3, random_state=0)
    draws = {
        method: estimate_fundamental(scene.points1, scene.points2, method=method).n_draws
        for method in ("lmeds", "ransac", "usac_accurate", "usac_prosac")
    }
    assert draws == {"lmeds": 3, "ransac": 2, "usac_accurate": 2, "usac_prosac": 2}


@pytest.mark.parametrize("method", ["lmeds", "usac_accurate"])
def test_objects_that_move_on_their_own_pull_less_than_in_cv2(method):
    """Three in five of the wrong matches suit some F that is nearly right."""
    pairs = [make_scene("moving_objects", 500, 0.7, 0.3, seed) for seed in range(48)]
    ours, cv2s = [], []
    for pair in pairs:
        points = pair.X[:, :2], pair.X[:, 2:]
        ours.append(pair.error(estimate_fundamental(*points, method=method).F))
        cv2s.append(pair.error(original(*points, METHODS[method], 1.0, 0.999, 5000)[0]))
    assert np.mean(ours) < 0.6 * np.mean(cv2s)
    assert np.median(ours) < 0.4 * np.median(cv2s)
