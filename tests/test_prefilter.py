"""Reliability of matches: against slow definitions, invariances, and known right matches."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import rankdata

from cv_densityf import _prefilter
from cv_densityf._prefilter import (
    CLEAN,
    best_scored,
    beyond_chance,
    contrast_support,
    density_contrast,
    place_numbers,
    ranks,
)
from cv_densityf.datasets import two_view_scene

SEEDS = range(4)


def scene_of(seed, n=400, inlier_ratio=0.3):
    return two_view_scene(n, inlier_ratio=inlier_ratio, noise=0.5, random_state=seed)


def auc(values, positive):
    """Chance that a right match ranks above a wrong one."""
    rank = rankdata(values)[positive].sum()
    n, m = positive.sum(), (~positive).sum()
    return (rank - n * (n + 1) / 2) / (n * m)


def contrast_by_definition(X, k, among=None):
    """Each neighbour in both images counts 1 / its place in the list where it stands later."""
    n = len(X)
    among = range(n) if among is None else among
    contrast = np.zeros(n)
    for i in range(n):
        others = [j for j in among if j != i]
        places = []
        for Y in (X[:, :2], X[:, 2:]):
            near = sorted(others, key=lambda j, Y=Y: np.hypot(*(Y[j] - Y[i])))[:k]
            places.append({j: place for place, j in enumerate(near, start=1)})
        for j in places[0].keys() & places[1].keys():
            contrast[i] += 1 / max(places[0][j], places[1][j])
    return contrast


@pytest.fixture
def neighbors(monkeypatch):
    """Sets how many neighbours are looked at."""
    return lambda k: monkeypatch.setattr(_prefilter, "N_NEIGHBORS", k)


@pytest.mark.parametrize("k", [1, 3, 10, 200])
@pytest.mark.parametrize("n", [2, 3, 12, 90])
def test_contrast_is_the_definition(n, k, neighbors):
    neighbors(k)
    X = two_view_scene(n, inlier_ratio=0.5, random_state=n).X
    expected = contrast_by_definition(X, min(k, n - 1))
    np.testing.assert_allclose(density_contrast(X), expected, rtol=1e-12)


def test_only_those_among_count_as_neighbours(neighbors):
    """Outsiders have as many as the others, although they do not find themselves there."""
    X = scene_of(6, 90).X
    among = np.random.default_rng(0).permutation(90)[:60]
    for k in (1, 8, 59):
        neighbors(k)
        np.testing.assert_allclose(
            density_contrast(X, among=among),
            contrast_by_definition(X, k, among),
            rtol=1e-12,
        )


@pytest.mark.parametrize("also_near", [False, True])
@pytest.mark.parametrize("columns", [slice(0, 2), slice(2, 4)])
def test_contrast_is_the_definition_where_two_matches_share_a_point(columns, also_near, neighbors):
    """As a keypoint with two orientations may: neither is then sure to stand first in its list."""
    neighbors(7)
    X = scene_of(8, 80).X
    if also_near:
        X[40] = X[0] + 1.0
    X[40, columns] = X[0, columns]
    # For all others these two are equally near, in either order.
    two = [0, 40]
    np.testing.assert_allclose(
        density_contrast(X)[two], contrast_by_definition(X, 7)[two], rtol=1e-12
    )


@pytest.mark.parametrize("columns", [slice(0, 2), slice(2, 4)])
def test_copies_of_a_point_beyond_the_neighbours_looked_at_are_not_searched(columns, monkeypatch):
    """What is far from them has the same contrast all the same."""
    X = two_view_scene(300, inlier_ratio=1.0, random_state=0).X
    copies = np.random.default_rng(0).uniform(0, 900, (600, 4))
    copies[:, columns] = 5000.0
    X = np.vstack([copies, X])
    sizes = []
    index = _prefilter.cv2.flann.Index

    def spy(points, params):
        sizes.append(len(points))
        return index(points, params)

    monkeypatch.setattr(_prefilter.cv2.flann, "Index", spy)
    contrast = density_contrast(X)
    assert sorted(sizes) == [300 + 17, 900]
    monkeypatch.setattr(_prefilter, "place_numbers", lambda points: None)
    np.testing.assert_array_equal(density_contrast(X)[600:], contrast[600:])
    assert sizes[2:] == [900, 900]


@pytest.mark.parametrize(("inlier_ratio", "looked_at"), [(0.8, 100), (0.3, 600)])
def test_where_most_are_right_few_tell(inlier_ratio, looked_at):
    X = scene_of(0, 600, inlier_ratio).X
    rows = np.random.default_rng(0).permutation(600)
    expected = density_contrast(X)[rows]
    assert (expected[:100].mean() > CLEAN) == (looked_at == 100)
    np.testing.assert_array_equal(density_contrast(X, rows, few=100), expected[:looked_at])
    reliability, kept, *_ = contrast_support(X, rows=rows, few=100)
    seen = rows[:looked_at]
    np.testing.assert_array_equal(reliability[seen], ranks(expected[:looked_at]))
    assert np.isnan(np.delete(reliability, seen)).all()
    assert not np.delete(kept, seen).any()


@pytest.mark.parametrize("seed", SEEDS)
def test_a_contrast_by_which_few_tell_is_that_of_right_ones(seed):
    for inlier_ratio in (0.1, 0.3, 0.5):
        assert density_contrast(scene_of(seed, 600, inlier_ratio).X).mean() < CLEAN
    assert density_contrast(scene_of(seed, 600, 0.75).X).mean() > CLEAN


def test_a_place_is_where_both_coordinates_are_the_same():
    """Points that share one, as at the border that an image was cut at, are at many places."""
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 900, (200, 2))
    points[:100, 0] = 0.0
    points[50:150, 1] = 7.0
    number = place_numbers(points)
    np.testing.assert_array_equal(
        number[:, None] == number, (points[:, None] == points).all(axis=2)
    )
    assert np.count_nonzero(number == number[60]) == 50
    assert place_numbers(points[100:]) is None


@pytest.mark.parametrize(("n", "most"), [(15, 2), (500, 22)])
def test_copies_are_looked_for_where_one_in_25_may_be_some(n, most):
    points = np.random.default_rng(0).uniform(0, 900, (n, 2))
    points[:most] = points[0]
    assert place_numbers(points) is None
    points[: most + 1] = points[0]
    assert np.bincount(place_numbers(points)).max() == most + 1


def test_contrast_does_not_depend_on_how_the_work_is_cut(monkeypatch):
    X = scene_of(1, 100).X
    whole = density_contrast(X)
    monkeypatch.setattr(_prefilter, "_CHUNK", 7)
    np.testing.assert_array_equal(density_contrast(X), whole)


def paired_at_random(seed, n):
    """A scene's points, wherever there is texture, each with any point of the other image."""
    X = scene_of(seed, n).X
    return np.hstack([X[:, :2], np.random.default_rng(seed).permutation(X[:, 2:])])


@pytest.mark.parametrize(("n", "part"), [(40, 1), (300, 1), (1200, 3)])
def test_what_chance_makes_of_the_contrast_is_known(n, part, monkeypatch):
    """Its mean over a third of the matches, or all, and how far that strays."""
    monkeypatch.setattr(_prefilter, "_EXCESS", np.inf)
    beyond = {}
    pairings = [density_contrast(paired_at_random(seed, n))[::part] for seed in range(80)]
    for deviations in (-0.7, 0, 0.7, 3):
        monkeypatch.setattr(_prefilter, "_SIGNIFICANT", deviations * part)
        beyond[deviations] = np.mean([beyond_chance(c, n, n) for c in pairings])
    assert 0.3 < beyond[0] < 0.7
    # A quarter each, if the deviation is the true one; it may be a little too large.
    assert 0.08 < 1 - beyond[-0.7] < 0.4
    assert 0.08 < beyond[0.7] < 0.4
    assert beyond[3] < 0.03


def test_chance_by_hand():
    """Of sixteen matches each has the other fifteen for neighbours, in either image."""
    mean = sum(1 / max(a, b) for a in range(1, 16) for b in range(1, 16)) / 15
    for more, beyond in ((0.101, True), (0.099, False)):
        assert beyond_chance(np.full(16, mean + more), 16, 16) == beyond


@pytest.mark.parametrize(("n", "limit"), [(100, 0.1), (1000, 6 * 3.2 / 1000)])
def test_the_excess_that_counts_is_a_tenth_or_six_deviations_if_that_is_less(n, limit):
    mean = sum(1 / max(a, b) for a in range(1, 17) for b in range(1, 17)) / (n - 1)
    for factor, beyond in ((1.03, True), (0.97, False)):
        assert beyond_chance(np.full(n, mean + factor * limit), n, n) == beyond
    assert beyond_chance(np.full(n // 10, mean + 0.7 * limit), n, n)


@pytest.mark.parametrize("n", [60, 300, 1500])
@pytest.mark.parametrize("scored", [False, True])
def test_right_matches_lie_together_more_than_by_chance(n, scored):
    scores = np.random.default_rng(n).uniform(size=n) if scored else None
    for seed in SEEDS:
        assert contrast_support(scene_of(seed, n).X, scores).beyond_chance
        assert not contrast_support(paired_at_random(seed, n), scores).beyond_chance


@pytest.mark.parametrize("n", [3, 40, 300])
def test_contrast_of_some_rows_is_theirs_among_all(n):
    X = scene_of(4, n).X
    rows = np.random.default_rng(n).permutation(n)[: n // 2]
    np.testing.assert_array_equal(density_contrast(X, rows=rows), density_contrast(X)[rows])


def test_rows_that_are_not_looked_at_are_neither_reliable_nor_kept():
    X = scene_of(5).X
    rows = np.arange(0, 400, 3)
    reliability, kept, *_ = contrast_support(X, rows=rows)
    np.testing.assert_array_equal(reliability[rows], ranks(density_contrast(X)[rows]))
    others = np.delete(np.arange(400), rows)
    assert np.isnan(reliability[others]).all()
    assert not kept[others].any()
    scores = np.random.default_rng(0).uniform(size=400)
    among = np.argsort(scores)[80:]  # but the worst fifth
    np.testing.assert_array_equal(
        contrast_support(X, scores, rows)[0][rows],
        ranks(4 * ranks(density_contrast(X, rows=rows, among=among)) + ranks(scores[rows])),
    )


@pytest.mark.parametrize("far", [1e9, 1e19, 3e38])
def test_a_match_however_far_out_changes_nothing_for_the_others(far):
    X = scene_of(6).X
    contrast = density_contrast(X)
    with_far = density_contrast(np.vstack([X, np.full(4, far), np.full(4, -far)]))
    np.testing.assert_array_equal(with_far[:-2], contrast)
    # In float32, as the search for neighbours has it, so far from the origin steps are 64 px.
    moved = density_contrast(X.round() + 1e9)
    np.testing.assert_array_equal(moved, density_contrast(X.round()))


def test_no_contrast_exceeds_that_of_shared_neighbourhoods_even_with_duplicates(neighbors):
    neighbors(5)
    X = scene_of(2, 100, inlier_ratio=0.0).X
    X[:30] = X[0]
    X[30:35, :2] = X[30, :2]
    contrast = density_contrast(X)
    assert contrast.min() >= 0
    assert contrast.max() <= (1 / np.arange(1, 6)).sum() + 1e-12


def test_copies_of_a_match_do_not_vouch_for_it(neighbors):
    """Features with two orientations give the same match twice, right or wrong."""
    neighbors(5)
    rng = np.random.default_rng(0)
    X = rng.uniform(0, 1000, (200, 4))
    X[100:] = X[:100]
    assert density_contrast(X).mean() < 0.1


def test_all_matches_equal_is_no_error():
    for n in (2, 5, 40):
        contrast = density_contrast(np.ones((n, 4)))
        assert contrast.shape == (n,)
        assert np.isfinite(contrast).all()


def test_right_pairs_share_all_their_neighbours_and_random_pairs_few(neighbors):
    """Identical images give the harmonic number; chance pairing shares k^2 / n neighbours."""
    neighbors(10)
    rng = np.random.default_rng(0)
    Y = rng.uniform(0, 1000, (2000, 2))
    same = density_contrast(np.hstack([Y, Y]))
    np.testing.assert_allclose(same, (1 / np.arange(1, 11)).sum())
    chance = density_contrast(np.hstack([Y, rng.permutation(Y)]))
    assert chance.mean() < 10 * 10 / 2000


@pytest.mark.parametrize("seed", SEEDS)
def test_contrast_does_not_change_with_the_scale_and_place_of_an_image(seed):
    X = scene_of(seed).X
    contrast = density_contrast(X)
    # Powers of two leave the order of distances as it is to the last bit.
    np.testing.assert_array_equal(density_contrast(X * [4, 4, 0.5, 0.5]), contrast)
    np.testing.assert_allclose(density_contrast(3.3 * X + [50, -7, 1000, 1]), contrast, rtol=1e-12)
    turned = X[:, [1, 0, 2, 3]] * [-1, 1, 1, 1]
    np.testing.assert_allclose(density_contrast(turned), contrast, rtol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_contrast_does_not_care_which_image_comes_first_nor_for_the_order(seed):
    X = scene_of(seed).X
    order = np.random.default_rng(seed).permutation(len(X))
    contrast = density_contrast(X)
    np.testing.assert_allclose(density_contrast(X[:, [2, 3, 0, 1]]), contrast, rtol=1e-12)
    np.testing.assert_allclose(density_contrast(X[order]), contrast[order], rtol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_right_matches_rank_above_wrong_ones(seed):
    scene = scene_of(seed, 600, inlier_ratio=0.3)
    reliability, kept, *_ = contrast_support(scene.X)
    assert auc(reliability, scene.inliers) > 0.8
    top = np.argsort(-reliability)[:90]
    assert scene.inliers[top].mean() > 0.8
    assert scene.inliers[kept].mean() > 1.3 * 0.3


def test_chance_ranks_nothing():
    """Where no match is right, what happens to be wrong in a crowd is not preferred."""
    rng = np.random.default_rng(0)
    crowd = np.vstack([rng.normal(500, 20, (200, 2)), rng.uniform(0, 1000, (200, 2))])
    X = np.hstack([crowd, crowd[rng.permutation(400)]])
    assert abs(auc(density_contrast(X), np.arange(400) < 200) - 0.5) < 0.1


def test_ranks_run_from_zero_to_one_and_ties_share_one():
    for seed in SEEDS:
        values = np.random.default_rng(seed).integers(0, 5, 30).astype(float)
        expected = (rankdata(values) - 1) / 29
        np.testing.assert_allclose(ranks(values), expected)
    assert ranks(np.array([3.0])).tolist() == [0.0]


def test_reliability_is_the_rank_of_the_contrast_and_the_better_half_is_kept():
    X = scene_of(3, 101).X
    reliability, kept, *_ = contrast_support(X)
    np.testing.assert_array_equal(reliability, ranks(density_contrast(X)))
    assert kept.dtype == bool
    assert kept.sum() == 51
    assert reliability[kept].min() > reliability[~kept].max()


def test_a_better_score_raises_the_reliability_of_its_match():
    scene = scene_of(0, 200)
    scores = np.random.default_rng(0).uniform(size=200)
    before = contrast_support(scene.X, scores)[0]
    # Among the better four fifths, so that the same ones bear witness before and after.
    for row in np.argsort(scores)[[45, 100, 150]]:
        raised = scores.copy()
        raised[row] = 2.0
        after = contrast_support(scene.X, raised)[0]
        assert after[row] > before[row]
        # The others keep their order.
        rest = np.arange(200) != row
        moved = np.abs(ranks(after[rest]) - ranks(before[rest]))
        assert moved.max() < 0.02


def test_equal_scores_say_nothing():
    X = scene_of(0, 200).X
    np.testing.assert_array_equal(contrast_support(X, np.ones(200))[0], contrast_support(X)[0])


def test_the_best_scores_are_found_with_those_as_good():
    scores = np.array([3.0, 1.0, 2.0, 2.0, -np.inf, 5.0])
    assert best_scored(scores, 2).tolist() == [0, 5]
    assert best_scored(scores, 3).tolist() == [0, 2, 3, 5]
    assert best_scored(scores, 6).tolist() == [0, 1, 2, 3, 4, 5]


def test_only_the_order_of_scores_counts():
    scene = scene_of(0, 200)
    scores = np.random.default_rng(0).uniform(size=200)
    for same in (np.exp(9 * scores), scores - 1e6, rankdata(scores)):
        np.testing.assert_array_equal(
            contrast_support(scene.X, same)[0], contrast_support(scene.X, scores)[0]
        )


@pytest.mark.parametrize("seed", SEEDS)
def test_good_scores_help_and_bad_ones_do_not_overrule_the_contrast(seed):
    scene = scene_of(seed, 600)
    rng = np.random.default_rng(seed)
    alone = auc(contrast_support(scene.X)[0], scene.inliers)
    good = np.where(scene.inliers, rng.beta(4, 2, 600), rng.beta(2, 4, 600))
    assert auc(contrast_support(scene.X, good)[0], scene.inliers) > alone
    assert auc(contrast_support(scene.X, rng.uniform(size=600))[0], scene.inliers) > 0.75
    assert auc(contrast_support(scene.X, -good)[0], scene.inliers) > 0.5


@pytest.mark.parametrize("n", [60, 400, 3000])
@pytest.mark.parametrize("ratio", [0.0, 0.1, 0.3, 0.5, 0.7, 0.9])
def test_the_contrast_tells_how_many_are_right(n, ratio):
    shares = [
        contrast_support(
            two_view_scene(n, inlier_ratio=ratio, noise=0.5, random_state=seed).X
        ).share_right
        for seed in range(3)
    ]
    assert abs(np.median(shares) - ratio) < 0.15


def test_of_fewer_neighbours_more_are_shared_by_chance():
    """With scores these are the better ones, and it is to be taken off all the same."""
    shares = [
        contrast_support(
            np.random.default_rng(seed).uniform(0, 1000, (30, 4)), np.arange(30.0)
        ).share_right
        for seed in range(20)
    ]
    assert np.median(shares) < 0.1
