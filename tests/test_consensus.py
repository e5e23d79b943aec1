"""The search finds known geometry, ends by its rules, and its vote counts as it says."""

from __future__ import annotations

import re

import numpy as np
import pytest

from cv_densityf import _consensus, _engine, _stopwatch
from cv_densityf._consensus import (
    _Ballot,
    _doubt,
    _noise,
    _Pool,
    search,
)
from cv_densityf._epipolar import (
    Frame,
    eight_point,
    essential_ratio,
    middle,
    polish,
    sampson_distance,
    shift,
)
from cv_densityf._prefilter import Support, contrast_support
from cv_densityf._stopwatch import Stopwatch
from cv_densityf.datasets import two_view_scene

SEEDS = range(4)
ASKED = {"threshold": 1.0, "confidence": 0.999, "max_iters": 5000}


def told(reliability, *, together=True, right=1.0):
    return Support(reliability, reliability >= 0.5, together, right)


def find(X, reliability=None, *, together=True, right=1.0, seed=0, **asked):
    if reliability is None:
        reliability = contrast_support(X)[0]
    support = told(reliability, together=together, right=right)
    return search(X, [support], seed=seed, watch=Stopwatch(), **{**ASKED, **asked})


def true_matches(seed, n=400):
    """Exact matches all over a scene with the seed's geometry."""
    return two_view_scene(n, inlier_ratio=1.0, noise=0.0, random_state=seed).X


def scene_of(seed, n=600, inlier_ratio=0.3, noise=0.5):
    return two_view_scene(n, inlier_ratio=inlier_ratio, noise=noise, random_state=seed)


def mostly_one_plane(seed, n=500, inlier_ratio=0.6, share=0.9, noise=0.5):
    """Matches, and exact ones off the plane that ``share`` of the right ones lie on."""
    rng = np.random.default_rng(seed)
    K = np.array([[1000.0, 0, 640], [0, 1000, 480], [0, 0, 1]])
    angle = rng.uniform(-0.1, 0.1)
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    t = np.array([1.0, rng.uniform(-0.3, 0.3), rng.uniform(-0.2, 0.2)])

    def project(pixels, depth):
        rays = np.hstack([pixels, np.ones((len(pixels), 1))]) @ np.linalg.inv(K).T
        second = (rays * depth[:, None] @ R.T + t) @ K.T
        return np.hstack([pixels, second[:, :2] / second[:, 2:]])

    size = np.array([1280, 960])
    n_true = round(n * inlier_ratio)
    pixels = rng.uniform(0, size, (n_true, 2))
    depth = 8 + 0.003 * pixels[:, 0]
    off = np.arange(n_true) >= share * n_true
    depth[off] = rng.uniform(4, 7, off.sum())
    X = project(pixels, depth) + rng.normal(0, noise, (n_true, 4))
    wrong = rng.uniform(0, np.tile(size, 2), (n - n_true, 4))
    judges = project(rng.uniform(0, size, (300, 2)), rng.uniform(4, 12, 300))
    return rng.permutation(np.vstack([X, wrong])), judges


@pytest.mark.parametrize("seed", range(8))
def test_finds_f_among_thirty_per_cent_right_matches(seed):
    found = find(scene_of(seed).X)
    assert found.F.shape == (3, 3)
    assert sampson_distance(found.F, true_matches(seed)).mean() < 0.5
    assert abs(np.linalg.det(found.F / np.linalg.norm(found.F))) < 1e-12


def least_squares(X, F):
    """Refine F on all of X alike, from where it is."""
    frame = Frame(X)
    return frame.leave(polish(frame, frame.enter(F[None]), [1e4] * 10))[0]


def errors_beside_least_squares(threshold, *, inlier_ratio, noise, n):
    """Mean errors of the search, and of least squares on the right matches alone."""
    errors = []
    for seed in range(15):
        scene = scene_of(seed, n=n, inlier_ratio=inlier_ratio, noise=noise)
        F = find(scene.X, threshold=threshold).F
        best = least_squares(scene.X[scene.inliers], F)
        errors.append([sampson_distance(f, true_matches(seed)).mean() for f in (F, best)])
    return np.array(errors).T


def test_is_as_good_as_least_squares_where_all_matches_are_right():
    """Noise near the threshold included: the right matches beyond it still say where F is."""
    search, best = errors_beside_least_squares(1.0, inlier_ratio=1.0, noise=0.8, n=300)
    assert search.mean() < 1.15 * best.mean()


def test_wrong_matches_cost_little():
    search, best = errors_beside_least_squares(1.0, inlier_ratio=0.5, noise=0.5, n=600)
    assert np.exp(np.log(search / best).mean()) < 1.15


def test_a_generous_threshold_costs_little():
    """The threshold is for the mask; how far matches scatter shows in the matches."""
    search, best = errors_beside_least_squares(10.0, inlier_ratio=0.3, noise=0.3, n=600)
    assert np.median(search) < 3 * np.median(best)


def test_the_same_call_gives_the_same_answer_and_another_seed_other_draws():
    X = scene_of(1, inlier_ratio=0.2, noise=1.0).X
    first, again, other = find(X), find(X), find(X, seed=1000)
    np.testing.assert_array_equal(first.F, again.F)
    assert (first.votes, first.n_draws, first.reason) == (again.votes, again.n_draws, again.reason)
    assert first.votes != other.votes


def test_arguments_are_left_as_they_are():
    X = scene_of(0).X
    reliability = contrast_support(X)[0]
    copies = X.copy(), reliability.copy()
    find(X, reliability)
    np.testing.assert_array_equal(X, copies[0])
    np.testing.assert_array_equal(reliability, copies[1])


def test_ends_when_two_draws_agree():
    """On clean matches the first rounds are enough; few right ones take more draws."""
    n_clean, n_poor = [], []
    for seed in SEEDS:
        clean = find(scene_of(seed, inlier_ratio=0.9, noise=0.2).X)
        n_clean.append(clean.n_draws)
        n_poor.append(find(scene_of(seed, n=300, inlier_ratio=0.05).X).n_draws)
    assert max(n_clean) <= 4
    assert np.mean(n_poor) > 1.5 * np.mean(n_clean)


def test_draws_from_the_same_matches_are_no_agreement(monkeypatch):
    """Of 30 matches every part is all of them, so that agreement says nothing."""
    scene = scene_of(0, n=30, inlier_ratio=0.9)
    sizes = []
    draw = _consensus.draw

    def spied(points, *args, **kwargs):
        sizes.append(len(points))
        return draw(points, *args, **kwargs)

    monkeypatch.setattr(_consensus, "draw", spied)
    find(scene.X)
    assert len(sizes) > 2
    assert sizes[:2] == [30, 30]


def impossible(rng, X):
    """Find an F that no two cameras can have, and move the second points onto its lines."""
    low, high = X.min(axis=0), X.max(axis=0)
    middle, size = X.mean(axis=0), float((high - low).max())
    zoom = np.diag([1 / size, 1 / size, 1])
    while True:
        U, S, Vt = np.linalg.svd(rng.normal(size=(3, 3)))
        F = zoom @ (U * [S[0], S[1], 0.0]) @ Vt @ zoom
        if essential_ratio(F[None], size)[0] > 0.5:
            continue
        F = shift(-middle[2:]).T @ F @ shift(-middle[:2])
        lines = np.hstack([X[:, :2], np.ones((len(X), 1))]) @ F.T
        offset = (X[:, 2:] * lines[:, :2]).sum(axis=1) + lines[:, 2]
        moved = X[:, 2:] - lines[:, :2] * (offset / (lines[:, :2] ** 2).sum(axis=1))[:, None]
        Y = np.hstack([X[:, :2], moved])
        return F, Y[((low < Y) & (high > Y)).all(axis=1)]


@pytest.mark.parametrize("seed", SEEDS)
def test_cameras_that_can_exist_win_over_a_few_more_votes(seed, monkeypatch):
    scene = two_view_scene(100, inlier_ratio=1.0, noise=0.0, random_state=seed)
    rng = np.random.default_rng(seed)
    low, high = scene.X.min(axis=0), scene.X.max(axis=0)
    while True:
        F, others = impossible(rng, rng.uniform(low, high, (500, 4)))
        if len(others) > 105:
            break
    # Strays, so that neither has the majority.
    X = np.vstack([scene.X, others[:105], rng.uniform(low, high, (60, 4))])
    everyone = np.arange(len(X))

    def winner():
        pool = _Pool(X, np.ones(len(X)), everyone, 1.0, rng)
        pool.add(np.stack([scene.F, F]), [50, 100])
        return pool.best

    assert winner() == 0
    monkeypatch.setattr(_consensus, "essential_ratio", lambda F: np.ones(len(F)))
    assert winner() == 1


def test_votes_are_for_the_root_of_how_nearly_cameras_can_exist(monkeypatch):
    scene = scene_of(0)
    pool = _Pool(scene.X, np.ones(600), np.arange(600), 1.0, np.random.default_rng(0))
    for ratio in (1.0, 0.49):
        monkeypatch.setattr(_consensus, "essential_ratio", lambda F, r=ratio: np.full(len(F), r))
        pool.add(scene.F[None], [50])
    np.testing.assert_allclose(pool.votes[1], 0.7 * pool.votes[0])


@pytest.mark.parametrize("seed", SEEDS)
def test_local_optimisation_finds_more_votes_near_a_poor_hypothesis(seed):
    """A hypothesis that only a few crowded matches fixed gets better; it never gets worse."""
    scene = scene_of(seed, inlier_ratio=0.3)
    X = scene.X - scene.X.mean(axis=0)
    right = X[scene.inliers]
    crowd = np.argsort(np.linalg.norm(right - right[0], axis=1))[:25]
    everyone = np.arange(len(X))
    pool = _Pool(X, np.ones(len(X)), everyone, 1.0, np.random.default_rng(seed))
    pool.add(eight_point(right[None, crowd]), [25])
    before = pool.votes.max()
    for _ in range(5):
        most = pool.votes.max()
        pool.optimise()
        assert pool.votes.max() >= most
    assert pool.votes.max() > before
    assert not pool.agrees()


def test_the_winner_is_optimised_within_its_noise():
    """From beside the minimum it gets more votes of this width; from there hardly less."""
    for seed in SEEDS:
        scene = scene_of(seed, inlier_ratio=0.6, noise=0.1)
        X = scene.X - scene.X.mean(axis=0)
        pool = _Pool(X, np.ones(600), np.arange(600), 1.0, np.random.default_rng(seed))

        def votes(G, pool=pool):
            return pool._ballot.count(pool._frame.sampson(G[None]), 0.3)[0]

        def optimised(G, pool=pool):
            return pool._optimised(G, pool._frame.sampson(G[None])[0], 0.3, 24, 8)

        start = pool._frame.enter(eight_point(X[None, np.flatnonzero(scene.inliers)[:40]]))[0]
        once = optimised(start)
        assert votes(once) > 1.01 * votes(start)
        assert votes(optimised(once)) > 0.99 * votes(once)


def test_local_optimisation_of_many_looks_at_some(monkeypatch):
    X = true_matches(0, n=3000)
    pool = _Pool(X - X.mean(axis=0), np.ones(3000), np.arange(3000), 1.0, np.random.default_rng(0))
    pool.add(eight_point(pool._X[None]), [3000])
    sizes = set()

    def spy(frame, *rest, **more):
        sizes.add(frame.products.shape[1])
        return polish(frame, *rest, **more)

    monkeypatch.setattr(_consensus, "polish", spy)
    pool._optimised(pool._G[0], pool._squared[0], 1.0, 24, 8)
    assert sizes == {1000}


@pytest.mark.parametrize("seed", SEEDS)
def test_of_the_samples_the_best_are_polished(monkeypatch, seed):
    """They have more right matches near their lines than half of all."""
    scene = scene_of(seed)
    pool = _Pool(
        scene.X, np.ones(len(scene.X)), np.arange(len(scene.X)), 1.0, np.random.default_rng(0)
    )
    pool.add(scene.F[None], [50])
    seen = []

    def spy(frame, G, scales, samples=None):
        made = polish(frame, G, scales, samples)
        seen.append((frame.leave(G), frame.leave(made)))
        return made

    monkeypatch.setattr(_consensus, "polish", spy)
    pool._optimised(pool._G[0], pool._squared[0], 1.0, 32, 8)
    (_, sampled), (polished, _) = seen
    assert (len(sampled), len(polished)) == (32, 1 + 8)
    right = scene.X[scene.inliers]
    chosen, all_ = (
        [np.mean(sampson_distance(F, right) < 1) for F in made] for made in (polished[1:], sampled)
    )
    assert np.min(chosen) > np.median(all_)


def test_with_too_few_near_matches_to_optimise_nothing_joins():
    """A hypothesis would be there twice, and its vote."""
    X = true_matches(0, n=15)
    pool = _Pool(X, np.ones(15), np.arange(15), 1.0, np.random.default_rng(0))
    pool.add(eight_point(X[None]), [15])
    pool.optimise()
    assert len(pool) == 1


def test_rivals_of_other_inliers_are_optimised(monkeypatch):
    sizes_of = zip((0, 50, 100, 150), (250, 150, 99, 60), strict=True)
    motions = [true_matches(seed, n=n) for seed, n in sizes_of]
    X = np.vstack(motions)
    F = np.concatenate([eight_point(motion[None]) for motion in motions])
    pool = _Pool(X, np.ones(len(X)), np.arange(len(X)), 1.0, np.random.default_rng(0))
    pool.add(F[[0, 0, 1, 2, 3]], [60, 60, 100, 100, 100])
    starts = []

    def spy(pool, G, *_):
        starts.append(G)
        return G

    monkeypatch.setattr(_Pool, "_optimised", spy)
    pool.optimise()
    # Of two copies rounding tells which is the better one.
    assert any(np.array_equal(starts, pool._G[[copy, 2]]) for copy in (0, 1))


def test_in_doubt_another_hypothesis_than_the_best_is_optimised_as_well():
    """A poor one of the larger motion, fixed by eight matches, gets ahead of the smaller motion."""
    behind = ahead = 0
    for seed in range(20):
        larger = scene_of(seed, n=250, inlier_ratio=1.0, noise=0.3).X
        X = np.vstack([larger, true_matches(seed + 50, n=150)])
        X -= X.mean(axis=0)
        pool = _Pool(X, np.ones(400), np.arange(400), 1.0, np.random.default_rng(seed))
        pool.add(np.concatenate([eight_point(X[None, 250:]), eight_point(X[None, :8])]), [150, 8])
        if pool.best == 0:
            behind += 1
            pool.optimise()
            ahead += pool.near_best(2.0)[:250].all()
    assert behind >= 8
    assert ahead > behind / 2


@pytest.mark.parametrize("seed", range(6))
def test_a_denser_motion_does_not_win_over_the_larger_one(seed):
    """Draws on the densest agree on it; what it leaves has a say before they end."""
    rng = np.random.default_rng(seed)
    larger = true_matches(seed, 300)
    denser = 300 + 0.3 * true_matches(seed + 50, 240)
    X = np.vstack([larger, denser])
    reliability = np.r_[rng.uniform(0.0, 0.8, 300), rng.uniform(0.3, 1.0, 240)]
    assert np.median(sampson_distance(find(X, reliability).F, larger)) < 0.1


@pytest.mark.parametrize(("wrong", "made"), [(0.05, 2), (0.4, 3)])
def test_only_much_that_is_unexplained_is_drawn_from(wrong, made, monkeypatch):
    draws = spied_draws(monkeypatch, _engine.draw)
    right = true_matches(0, 400)
    n = round(400 * wrong / (1 - wrong))
    X = np.vstack([right, np.random.default_rng(0).uniform(0, [1280, 960] * 2, (n, 4))])
    order = np.random.default_rng(1).permutation(len(X))
    reliability = np.empty(len(X))
    reliability[order] = np.linspace(0.0, 1.0, len(X))  # tells nothing
    assert find(X, reliability).n_draws == len(draws) == made
    if made == 3:
        assert 0.8 * n < len(draws[2][0]) <= n
        assert draws[2][2] < draws[0][2]


def test_what_most_agree_on_gets_a_draw_at_its_noise(monkeypatch):
    X = scene_of(0, n=2000, inlier_ratio=0.8, noise=0.1).X
    draws = spied_draws(monkeypatch, _engine.draw)
    assert find(X, threshold=4.0).n_draws == len(draws)
    n = len(draws)
    assert find(X, threshold=4.0, majority=True).n_draws == len(draws) - n == n + 1
    points, threshold, iters, _ = draws[-1]
    assert len(points) == 300
    # They are near its lines, not any; a fifth of all are wrong.
    points = points + middle(X)[0]
    assert sampson_distance(scene_of(0).F, points).max() < 1.1 * _consensus._NEAR_WIDTH * 4.0
    assert threshold < 0.25
    assert iters < draws[0][2]


@pytest.mark.parametrize("noise", [0.0, 1e-9])
def test_no_noise_is_still_some(noise, monkeypatch):
    """Widths of nothing would leave nothing within them, and cv2's draws nothing to find."""
    X = scene_of(0, noise=noise, inlier_ratio=0.8).X
    draws = spied_draws(monkeypatch, _engine.draw)
    widths = []
    optimised = _Pool._optimised

    def spy(pool, G, squared, width, *rest):
        widths.append(width)
        return optimised(pool, G, squared, width, *rest)

    monkeypatch.setattr(_Pool, "_optimised", spy)
    found = find(X, threshold=4.0, majority=True)
    assert draws[-1][1] > 0.1
    assert widths[-1] > 0.1
    assert sampson_distance(found.F, true_matches(0)).max() < 1e-4


def test_what_the_winner_becomes_is_agreed_on_only_where_it_keeps_its_inliers(monkeypatch):
    X = scene_of(0).X
    found = find(X)
    assert found.agreed
    assert found.reason.endswith("found again by another")
    centre = middle(X)[0]
    another = shift(centre[2:]).T @ scene_of(1).F @ shift(centre[:2])
    monkeypatch.setattr(
        _Pool, "optimised_best", lambda pool, drawn: pool._frame.enter(another[None])[0]
    )
    for others in (None, true_matches(1)):
        found = find(X, others=others)
        assert not found.agreed
        assert found.reason.endswith("found by no other")


def test_what_is_optimised_is_what_more_matches_settle_on(monkeypatch):
    made, given = [], []
    optimised_best, settled_by = _Pool.optimised_best, _Pool.settled_by

    def optimise(pool, drawn):
        made.append(optimised_best(pool, drawn))
        return made[0]

    def settle(pool, others, scores, G):
        given.append(G)
        return settled_by(pool, others, scores, G)

    monkeypatch.setattr(_Pool, "optimised_best", optimise)
    monkeypatch.setattr(_Pool, "settled_by", settle)
    X = scene_of(0).X
    find(X[:300], others=X[300:])
    assert len(given) == 1
    assert given[0] is made[0]


def test_what_is_unreliable_may_stay_unexplained(monkeypatch):
    right = true_matches(0, 400)
    X = np.vstack([right, np.random.default_rng(0).uniform(0, [1280, 960] * 2, (270, 4))])
    draws = spied_draws(monkeypatch, _engine.draw)
    find(X, np.linspace(1.0, 0.0, 670))
    assert len(draws) == 2
    # If so few seem right, the others are unreliable.
    draws.clear()
    reliability = np.linspace(1.0, 0.0, 670)
    reliability[400:] += 0.3
    find(X, reliability, right=0.6)
    assert len(draws) == 2
    draws.clear()
    find(X, reliability, right=1.0)
    assert len(draws) == 3
    # Of the few that are ranked, not of all, and some at least.
    draws.clear()
    find(X, np.where(np.arange(670) % 2, reliability, np.nan), right=0.6)
    assert len(draws) == 2


def test_some_are_asked_what_is_unexplained_however_few_seem_right(monkeypatch):
    right = true_matches(0, 400)
    X = np.vstack([right, np.random.default_rng(0).uniform(0, [1280, 960] * 2, (100, 4))])
    reliability = np.linspace(0.8, 0.0, 500)
    reliability[400:410] = 0.9
    reliability[0] = 1.0
    draws = spied_draws(monkeypatch, _engine.draw)
    find(X, reliability, right=0.0)
    assert len(draws) == 3


def test_what_is_not_ranked_has_half_a_vote(monkeypatch):
    told = []

    class Spied(_Ballot):
        def __init__(self, X, reliability):
            told.append(reliability)
            super().__init__(X, reliability)

    monkeypatch.setattr(_consensus, "_Ballot", Spied)
    rank = np.where(np.arange(600) < 300, np.linspace(0, 1, 600), np.nan)
    find(scene_of(0).X, rank)
    np.testing.assert_array_equal(told[0], np.where(np.isnan(rank), 0.5, rank))


def test_two_different_answers_are_no_agreement(monkeypatch):
    """The search goes through all its rounds when no two draws are of the same geometry."""
    X = scene_of(0).X
    answers = iter(np.random.default_rng(0).normal(size=(99, 3, 3)) * [1e-6, 1e-6, 1e-3])
    monkeypatch.setattr(_consensus, "draw", lambda *_, **__: next(answers))
    monkeypatch.setattr(_Pool, "_optimised", lambda pool, G, *_: G.copy())
    monkeypatch.setattr(_consensus, "polish", lambda frame, G, scales: G)
    found = find(X)
    assert found.n_draws >= 2 * len(_consensus.ROUNDS) - 1
    assert len(found.votes) == found.n_draws + _consensus._LOCAL_STARTS_IN_DOUBT
    assert "chance" not in found.reason


def test_where_all_lies_together_only_as_by_chance_the_search_ends_early(monkeypatch):
    wrong = scene_of(0).X
    wrong[:, 2:] = np.random.default_rng(2).permutation(wrong[:, 2:])
    draws = spied_draws(monkeypatch, _engine.draw)
    optimised = []
    monkeypatch.setattr(_Pool, "optimise", lambda pool: optimised.append(pool))
    found = find(wrong, together=False)
    assert found.n_draws == len(draws) == 4
    assert found.reason.endswith("lie together only as by chance, and so do the inliers")
    # Nor are there rivals to optimise.
    assert not optimised
    # Not where one of both does: the matches,
    assert find(wrong).n_draws > 4
    # or the inliers of a hypothesis on which no two draws agree.
    monkeypatch.setattr(_Pool, "agrees", lambda *_, **__: False)
    assert find(scene_of(0).X, together=False).n_draws > 4
    assert len(optimised) == 2


def test_another_ranking_is_not_asked_for_where_it_is_hopeless():
    wrong = scene_of(0).X
    wrong[:, 2:] = np.random.default_rng(0).permutation(wrong[:, 2:])
    rankings = iter([told(contrast_support(wrong)[0], together=False), None])
    search(wrong, rankings, seed=0, watch=Stopwatch(), **ASKED)
    assert next(rankings) is None


def test_more_than_the_reliable_part_counts():
    """Where the reliable half is wrong as a whole, the other half still gives F."""
    for seed in SEEDS:
        scene = scene_of(seed, inlier_ratio=0.5)
        # Reliability is 0.6 for wrong matches and 0.4 for right ones.
        found = find(scene.X, np.where(scene.inliers, 0.4, 0.6))
        assert sampson_distance(found.F, true_matches(seed)).mean() < 1.0


def test_reliability_finds_what_is_lost_without():
    """Ten per cent right matches, known to be: hopeless in any order, easy in the right one."""
    known, unknown = [], []
    for seed in range(6):
        scene = scene_of(seed, n=500, inlier_ratio=0.1)
        truth = true_matches(seed)
        rank = np.random.default_rng(seed).permutation(500) / 500
        for r, errors in ((scene.inliers * 0.9 + 0.1 * rank, known), (rank, unknown)):
            found = find(scene.X, r, max_iters=300)
            errors.append(sampson_distance(found.F, truth).mean())
    assert np.median(known) < 1.0
    assert np.median(unknown) > 3 * np.median(known)


@pytest.mark.parametrize(("inlier_ratio", "share"), [(0.6, 0.9), (1.0, 0.9), (0.9, 0.95)])
@pytest.mark.parametrize("seed", range(8))
def test_one_plane_does_not_win(seed, inlier_ratio, share):
    """Nearly all right matches on a plane: F must hold off it."""
    X, judges = mostly_one_plane(seed, inlier_ratio=inlier_ratio, share=share)
    assert np.median(sampson_distance(find(X).F, judges)) < 1.5


@pytest.mark.parametrize(("more", "votes", "best"), [(1, 98, 0), (3, 98, 1), (8, 95, 0)])
def test_on_a_plane_clearly_more_off_it_are_better_than_a_few_votes(more, votes, best):
    """They may be of no reliability, but a crowd of wrong ones costs votes elsewhere."""
    squared = np.full((2, 60), 9.0)
    squared[0, :40] = squared[1, : 40 + more] = 0.0
    pool = elected(squared, votes, off_plane=np.arange(60) >= 38)
    assert pool.best == best
    more = "more matches near it, off a dominant plane, than the one with the most votes"
    assert pool.virtue == ("the most votes", more)[best]
    assert elected(squared, votes, off_plane=None).best == 0


def test_on_a_plane_what_differs_on_it_does_not_count():
    squared = np.full((2, 60), 9.0)
    squared[0, 4:44] = squared[1, :40] = squared[1, 44:52] = 0.0
    assert elected(squared, 98, off_plane=np.arange(60) >= 44).best == 1


@pytest.mark.parametrize(("more", "best"), [(3, 0), (8, 1)])
def test_of_what_is_optimised_it_takes_more_off_the_plane(more, best):
    squared = np.full((2, 60), 9.0)
    squared[0, :40] = squared[1, : 40 + more] = 0.0
    pool = elected(squared, 98, off_plane=np.arange(60) >= 38)
    assert pool.best == 1
    deviations = _consensus._CLEARLY_OF_MANY
    assert pool._elected(pool.votes, pool._squared, 1.0, deviations) == best


@pytest.mark.parametrize(("fewer", "best"), [(6, 1), (12, 0)])
def test_what_fewer_matches_are_near_in_all_does_not_win_off_the_plane(fewer, best):
    """Where the parallax is no larger than the noise, that is what is off the plane."""
    squared = np.full((2, 60), 9.0)
    squared[0, :40] = squared[1, fewer:40] = squared[1, 44:52] = 0.0
    assert elected(squared, 98, off_plane=np.arange(60) >= 44).best == best


def test_of_the_same_inliers_off_the_plane_those_with_more_votes_win():
    squared = np.full((2, 60), 9.0)
    squared[:, :40] = 0.0
    pool = elected(squared, 101, off_plane=np.arange(60) >= 38)
    assert pool.best == 1


def test_what_has_lost_off_the_plane_is_no_finalist():
    squared = np.full((2, 60), 9.0)
    squared[0, :40] = squared[1, :48] = 0.0
    assert elected(squared, 98, off_plane=np.arange(60) >= 38)._finalists(2, 0.9) == [1]


def test_a_search_for_planes_that_fails_costs_nothing_else(monkeypatch):
    def fail(*_):
        raise np.linalg.LinAlgError

    monkeypatch.setattr(_consensus, "plane_and_parallax", fail)
    scene = scene_of(0)
    assert sampson_distance(find(scene.X).F, true_matches(0)).mean() < 1.0


def elected(squared, votes, off_plane):
    """Pool of two hypotheses of 100 and of so many votes, by their residuals."""
    pool = _Pool(true_matches(0, 60), np.ones(60), np.arange(60), 1.0, np.random.default_rng(0))
    pool._off_plane = off_plane
    pool._append(np.ones((2, 3, 3)), squared, np.array([100.0, votes]), [30, 60])
    return pool


def test_no_draw_no_answer(monkeypatch):
    monkeypatch.setattr(_consensus, "draw", lambda *_, **__: None)
    assert find(scene_of(0).X) is None


def test_draws_get_the_callers_bounds(monkeypatch):
    asked = []

    def recorded(points, threshold, confidence, max_iters, seed, **_):
        asked.append((threshold, confidence, max_iters, seed, len(points)))

    monkeypatch.setattr(_consensus, "draw", recorded)
    find(scene_of(0).X, threshold=2.5, confidence=0.9, max_iters=17, seed=5)
    thresholds, confidences, iterations, seeds, sizes = zip(*asked, strict=True)
    assert set(thresholds) == {2.5}
    assert set(confidences) == {0.9}
    assert max(iterations) <= 17
    assert len(set(seeds)) == len(seeds), "each draw has a seed of its own"
    assert min(sizes) < max(sizes) == 600, "some draws are from all matches, some from a part"


def test_draws_are_from_the_most_reliable(monkeypatch):
    seen = []
    monkeypatch.setattr(_consensus, "draw", lambda points, *_, **__: seen.append(points))
    X = scene_of(0).X
    reliability = np.random.default_rng(0).permutation(600) / 600
    find(X, reliability)
    best_first = X[np.argsort(-reliability)]
    _, spread, *_ = seen
    for points in seen:
        if points is spread:
            continue
        # Where the origin is does not matter.
        expected = best_first[: len(points)] - best_first[0]
        np.testing.assert_allclose(points - points[0], expected, atol=1e-3)


def spied_draws(monkeypatch, answer=lambda *_, **__: None):
    """Record the arguments of each draw, which is then answered by ``answer``."""
    seen = []

    def draw(points, threshold, confidence, max_iters, seed, best_first=False, planes=True):
        seen.append((points, threshold, max_iters, best_first))
        return answer(points, threshold, confidence, max_iters, seed, best_first, planes)

    monkeypatch.setattr(_consensus, "draw", draw)
    return seen


@pytest.mark.parametrize(
    ("right", "top", "size"), [(1.0, 450, 300), (0.5, 337, 224), (0.1, 300, 200)]
)
def test_the_second_draw_takes_the_cells_of_the_first_image_in_turn(right, top, size, monkeypatch):
    """The most reliable of each, then the second of each; what is mostly wrong is out."""
    seen = spied_draws(monkeypatch)
    rng = np.random.default_rng(0)
    X = rng.uniform(0, 800, (600, 4))
    X[:300, :2] = 200 + X[:300, :2] / 50  # a crowd
    X[-2:, :2] = (0, 0), (800, 800)
    reliability = rng.permutation(600) / 600
    find(X, reliability, right=right)
    order = np.argsort(-reliability)[:top]
    cells = [tuple(cell) for cell in np.minimum(X[order, :2] // 50, 15)]
    turns = [cells[:i].count(cell) for i, cell in enumerate(cells)]
    expected = X[order[sorted(range(top), key=lambda i: turns[i])[:size]]]
    points = seen[1][0]
    np.testing.assert_allclose(points - points[0], expected - expected[0], atol=1e-3)
    assert np.mean(np.ptp(expected[:100, :2], axis=0)) > 700


@pytest.mark.parametrize(
    ("right", "sizes"),
    [
        (1.0, [150, 300, 450, 75, 600, 300, 150, 600]),
        (0.1, [100, 200, 300, 50, 600, 200, 100, 600]),
    ],
)
def test_where_few_seem_right_all_parts_but_the_whole_are_smaller(right, sizes, monkeypatch):
    seen = spied_draws(monkeypatch)
    find(scene_of(0).X, right=right)
    assert [len(points) for points, *_ in seen] == sizes
    # Not so small that their draws would not be independent.
    seen.clear()
    find(scene_of(0, 100).X, right=right)
    quarter, half = (len(points) for points, *_ in seen[:2])
    assert quarter == _consensus.MIN_DRAW
    assert half >= _consensus._DISTINCT * quarter


def test_only_dense_parts_are_not_asked_for_planes(monkeypatch):
    asked = {}

    def draw(points, *_, best_first, planes):
        asked[len(points)] = planes

    monkeypatch.setattr(_consensus, "draw", draw)
    find(scene_of(0).X)
    assert asked == {150: False, 75: False, 300: True, 450: True, 600: True}
    asked.clear()
    find(scene_of(0, 50).X)
    assert all(asked.values()), "thirty of fifty are no dense part"


def test_scores_give_three_more_draws_in_their_order(monkeypatch):
    X = scene_of(0).X
    scores = np.random.default_rng(1).permutation(600) / 600
    seen = spied_draws(monkeypatch)
    assert find(X) is None
    assert not any(best_first for *_, best_first in seen)
    n = len(seen)
    seen.clear()
    assert find(X, scores=scores, threshold=2.5, max_iters=17) is None
    assert len(seen) == n + 3
    # First two by density, which may well agree.
    assert not any(best_first for *_, best_first in seen[:2])
    ranked = X[np.argsort(-scores)]
    for points, threshold, max_iters, best_first in seen:
        if best_first:
            assert (threshold, max_iters) == (2.5, 17)
            np.testing.assert_allclose(points - points[0], ranked - ranked[0], atol=1e-3)
    assert sum(best_first for *_, best_first in seen) == 3


def test_a_draw_by_scores_has_the_iterations_of_one_from_all(monkeypatch):
    """However few of the matches are ranked."""
    X = scene_of(0).X
    seen = spied_draws(monkeypatch)
    reliability = np.where(np.arange(600) < 100, 1.0, np.nan)
    find(X, reliability, scores=np.arange(600))
    assert {max_iters for _, _, max_iters, best_first in seen if best_first} == {500}


def test_equal_matches_keep_the_order_of_their_rows(monkeypatch):
    """Numpy's default sort would order them by what the processor can do."""
    seen = spied_draws(monkeypatch)
    X = scene_of(0).X
    level = np.random.default_rng(0).integers(3, size=600)
    find(X, level / 2, scores=level)
    ranked = X[sorted(range(600), key=lambda i: -level[i])]
    del seen[1]  # is spread over the image
    for points, *_ in seen:
        expected = ranked[: len(points)] - ranked[0]
        np.testing.assert_allclose(points - points[0], expected, atol=1e-3)


def test_the_draw_by_scores_is_a_hypothesis_like_the_others(monkeypatch):
    scene = scene_of(0)
    centre = scene.X.mean(axis=0)
    F = shift(centre[2:]).T @ scene.F @ shift(centre[:2])
    seen = spied_draws(monkeypatch, lambda *arguments: F if arguments[5] else None)
    found = find(scene.X, scores=np.ones(600))
    assert sampson_distance(found.F, true_matches(0)).mean() < 0.5
    assert found.n_draws == len(seen)


def test_larger_parts_get_fewer_iterations(monkeypatch):
    seen = spied_draws(monkeypatch)
    find(scene_of(0).X, max_iters=10**6)
    iterations = {len(points): max_iters for points, _, max_iters, _ in seen}
    assert iterations[150] == iterations[75] == _consensus.MAX_DRAW_ITERS
    assert iterations[600] == _consensus.MAX_DRAW_ITERS / 2
    assert iterations[600] < iterations[450] < iterations[300] < iterations[150]


@pytest.mark.parametrize(
    ("noise", "threshold", "low", "high"),
    [(0.1, 10.0, 5.0, 5.0), (1.6, 10.0, 5.1, 9.0), (0.9, 1.0, 1.0, 1.0)],
)
def test_the_noise_narrows_later_draws(monkeypatch, noise, threshold, low, high):
    """To four standard deviations, down to half of the threshold, and never beyond it."""
    seen = spied_draws(monkeypatch, _consensus.draw)
    monkeypatch.setattr(_Pool, "agrees", lambda *_, **__: False)
    find(scene_of(0, inlier_ratio=0.6, noise=noise).X, threshold=threshold)
    first, second, *later = [call[1] for call in seen]
    assert first == second == threshold
    assert len(set(later)) == 1
    assert low <= later[0] <= high


def test_the_noise_is_told_by_the_reliable_half(monkeypatch):
    """Of which the first thirty matches are more exact, while the other half is less."""
    seen = spied_draws(monkeypatch, _consensus.draw)
    monkeypatch.setattr(_Pool, "agrees", lambda *_, **__: False)
    row = np.arange(600)
    noise = np.select([row < 30, row < 300], [0.8, 1.6], 4.0)
    X = true_matches(0, n=600) + np.random.default_rng(0).normal(size=(600, 4)) * noise[:, None]
    find(X, 1.0 - row / 600, threshold=10.0)
    # Four standard deviations, but for what falls beyond 2.5 of them: not 3.2, and not 7 or more.
    assert 4.6 < seen[-1][1] < 6.5


def test_near_the_best_is_within_so_many_working_thresholds():
    scene = scene_of(0)
    X = scene.X - scene.X.mean(axis=0)
    pool = _Pool(X, np.ones(600), np.arange(600), 2.0, np.random.default_rng(0))
    pool.add(eight_point(X[None, scene.inliers]), [50])
    F = pool._frame.leave(pool._G)[0]
    distance = sampson_distance(F, X)
    for width in (1.0, 8.0):
        np.testing.assert_array_equal(pool.near_best(width), distance < 2.0 * width)


def test_matches_near_the_best_are_drawn_from_however_unreliable(monkeypatch):
    scene = scene_of(0, inlier_ratio=0.5)
    rank = np.random.default_rng(0).uniform(0, 0.1, 600)
    # Half of the right matches come first, the others last.
    unreliable = scene.inliers & (np.arange(600) % 2 == 1)
    reliability = 0.5 + 0.4 * (scene.inliers & ~unreliable) - 0.4 * unreliable + rank
    seen = spied_draws(monkeypatch, _consensus.draw)
    monkeypatch.setattr(_Pool, "agrees", lambda *_, **__: False)
    find(scene.X, reliability)
    X = (scene.X - scene.X.mean(axis=0)).astype(np.float32)
    row_of = {row.tobytes(): i for i, row in enumerate(X)}
    parts = [{row_of[row.tobytes()] for row in points} for points, *_ in seen]
    wanted = set(np.flatnonzero(unreliable))
    near = [part for part in parts if len(part) < 550 and len(part & wanted) > 0.8 * len(wanted)]
    assert len(near) >= 2
    for part in near:
        assert scene.inliers[list(part)].mean() > 0.7


@pytest.mark.parametrize("factor", [0.01, 300.0])
def test_the_unit_of_length_hardly_matters_to_the_search(factor):
    errors = []
    for seed in SEEDS:
        X, truth = scene_of(seed).X, true_matches(seed)
        here = sampson_distance(find(X).F, truth).mean()
        there = sampson_distance(find(factor * X, threshold=factor).F, factor * truth).mean()
        errors.append([here, there / factor])
    here, there = np.median(errors, axis=0)
    assert there < 1.5 * here


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("factor", [2.0**-7, 2.0**8])
def test_the_unit_of_length_does_not_matter_to_what_is_made_of_the_draws(factor, seed, monkeypatch):
    """A power of two leaves every rounding as it is, but those of some of BLAS's kernels."""

    def fit(points, threshold, confidence, max_iters, seed, **_):
        rows = np.random.default_rng(seed).permutation(min(len(points), 60))[:12]
        return eight_point(points[None, rows].astype(np.float64))[0]

    monkeypatch.setattr(_consensus, "draw", fit)
    monkeypatch.setattr(_Pool, "agrees", lambda *_, **__: False)
    X = scene_of(seed, inlier_ratio=0.6).X
    reliability = contrast_support(X[:300])[0]
    zoom = np.diag([factor, factor, 1.0])
    for others in (None, X[300:]):
        here = find(X[:300], reliability, threshold=3.0, others=others)
        scaled = None if others is None else factor * others
        there = find(factor * X[:300], reliability, threshold=3.0 * factor, others=scaled)
        np.testing.assert_allclose(there.votes, here.votes, rtol=1e-6)
        back = zoom @ there.F @ zoom
        np.testing.assert_allclose(
            back / np.linalg.norm(back), here.F / np.linalg.norm(here.F), rtol=1e-6
        )


def test_only_where_no_two_draws_agree_rivals_are_optimised(monkeypatch):
    X = scene_of(0, inlier_ratio=0.9, noise=0.2).X
    assert find(X).n_draws == len(find(X).votes) == 2
    monkeypatch.setattr(_Pool, "agrees", lambda *_, **__: False)
    found = find(X)
    assert found.n_draws == 12
    assert len(found.votes) == 12 + 1  # the others are of its inliers


def test_local_optimisation_is_no_second_opinion():
    scene = scene_of(0, inlier_ratio=0.6)
    X = scene.X - scene.X.mean(axis=0)
    pool = _Pool(X, np.ones(600), np.arange(600), 1.0, np.random.default_rng(0))
    pool.add(eight_point(X[None, scene.inliers]), [50])
    for _ in range(3):
        pool.optimise()
    assert len(pool) == 1 + 3
    assert not pool.agrees()


@pytest.mark.parametrize(("n", "stays"), [(15, True), (16, False)])
def test_local_optimisation_takes_half_of_the_near_matches_and_no_fewer_than_eight(n, stays):
    X = true_matches(0, n=n)
    pool = _Pool(X - X.mean(axis=0), np.ones(n), np.arange(n), 1.0, np.random.default_rng(0))
    pool.add(eight_point(pool._X[None]), [n])
    G = pool._G[0]
    assert np.array_equal(pool._optimised(G, pool._squared[0], 1.0, 32, 8), G) == stays


def test_other_matches_give_f_what_a_part_cannot():
    """Nearly what least squares makes of the right ones of them all."""
    errors = []
    for seed in range(10):
        scene = scene_of(seed, n=4000, inlier_ratio=0.5, noise=0.8)
        part, others = scene.X[:400], scene.X[400:]
        F = find(part, others=others).F
        best = least_squares(scene.X[scene.inliers], F)
        errors.append([sampson_distance(f, true_matches(seed)).mean() for f in (F, best)])
    searched, best = np.median(errors, axis=0)
    assert searched < 2 * best


def test_where_the_winner_of_many_settles_is_not_where_it_came_from():
    """Fitted to forty right matches or to forty others, it ends at nearly the same F."""
    apart = []
    for seed in range(8):
        scene = scene_of(seed, n=1000, inlier_ratio=0.5, noise=0.8)
        centre = scene.X.mean(axis=0)
        X, truth = scene.X - centre, true_matches(seed) - centre
        right = X[scene.inliers]
        ends = []
        for start in (right[:40], right[40:80]):
            pool = _Pool(X, np.ones(1000), np.arange(1000), 1.0, np.random.default_rng(0))
            pool.add(least_squares(start, eight_point(start[None])[0])[None], [40])
            G = pool._G[0]
            matrices = pool._frame.leave(np.stack([G, pool._settled(G, pool._squared[0])]))
            ends.append([sampson_distance(F, truth) for F in matrices])
        apart.append(np.abs(np.subtract(*ends)).mean(axis=1))
    before, settled = np.median(apart, axis=0)
    assert settled < 0.1 * before


def test_a_winner_at_rest_takes_no_more_strides(monkeypatch):
    scene = scene_of(0, n=1500, inlier_ratio=0.8)
    X = scene.X - scene.X.mean(axis=0)
    pool = _Pool(X, np.ones(1500), np.arange(1500), 1.0, np.random.default_rng(0))
    F = least_squares(X[scene.inliers], eight_point(X[None, scene.inliers])[0])
    noise = _noise(pool._frame.sampson(pool._frame.enter(F[None]))[0], 1.0)
    rest = polish(pool._frame, pool._frame.enter(F[None]), [_consensus._STRIDE_SIGMAS * noise] * 50)
    steps = []

    def spied(*args):
        steps.append(0)
        return polish(*args)

    monkeypatch.setattr(_consensus, "polish", spied)
    made = []
    for start in (rest, polish(pool._frame, pool._frame.enter(eight_point(X[None, :60])), [50.0])):
        steps.clear()
        pool._settled(start[0], pool._frame.sampson(start)[0])
        made.append(len(steps))
    assert made[0] == 1 < made[1] <= _consensus._STRIDES


@pytest.mark.parametrize("seed", SEEDS)
def test_finalists_are_the_best_three_of_different_inliers(seed, monkeypatch):
    """No two of them share .93 of the matches that either has."""
    rng = np.random.default_rng(seed)
    pool = _Pool(scene_of(0).X, np.ones(600), np.arange(600), 3.0, rng)
    F = rng.normal(size=(24, 3, 3))
    inliers = np.zeros((24, 600), dtype=bool)
    for i, row in enumerate(inliers):
        row[100 * (i % 4) : 100 * (i % 4) + rng.integers(100, 110)] = True
    votes = rng.uniform(size=24)
    pool._append(pool._frame.enter(F), np.where(inliers, 8.9, 9.1), votes, np.ones(24))
    both, either = inliers[:, None] & inliers, inliers[:, None] | inliers
    share = both.sum(axis=2) / either.sum(axis=2)
    expected = []
    for i in np.argsort(-votes):
        if len(expected) < 3 and (share[i, expected] < 0.93).all():
            expected.append(i)
    assert pool._finalists(3, 0.93) == expected
    # The others are put to more matches beside what has become of the best.
    asked = []

    def spy(wider, G):
        asked.append(wider._frame.leave(wider._G))
        assert wider.working == 1.0
        return G

    monkeypatch.setattr(_Pool, "refined", spy)
    pool.working = 1.0
    pool.settled_by(scene_of(1).X, None, pool._frame.enter(scene_of(0).F[None])[0])
    (finalists,) = asked
    F = np.concatenate([scene_of(0).F[None], F])
    expected = [0, *(i + 1 for i in expected[1:])]
    unit = finalists / np.linalg.norm(finalists, axis=(1, 2), keepdims=True)
    wanted = F[expected] / np.linalg.norm(F[expected], axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(unit, wanted, atol=1e-9)


@pytest.mark.parametrize(
    ("common", "more", "sizes", "agree"),
    [
        (100, 0, [50, 100], True),
        (96, 0, [50, 100], True),
        (100, 4, [50, 100], True),
        (90, 0, [50, 100], False),
        (100, 10, [50, 100], False),
        (96, 4, [50, 100], False),
        (100, 0, [50, 51], False),
        (100, 0, [50, 0], False),
    ],
)
def test_agreement_is_of_inliers_from_parts_of_other_sizes(common, more, sizes, agree, monkeypatch):
    """Of two sets of 100 and of ``common`` and ``more``, by what they share of their union."""
    X = scene_of(0, n=300).X
    pool = _Pool(X, np.ones(300), np.arange(300), 3.0, np.random.default_rng(0))
    residuals = np.full((2, 300), 3.1)
    residuals[0, :100] = 2.9
    residuals[1, 100 - common : 100 + more] = 2.9
    pool._append(np.zeros((2, 3, 3)), residuals**2, np.array([2.0, 1.0]), sizes)
    assert pool.agrees() == agree
    overlap = common / (100 + more)
    if agree:
        monkeypatch.setattr(_consensus, "_AGREEMENT", overlap - 0.001)
        assert pool.agrees()
    monkeypatch.setattr(_consensus, "_AGREEMENT", overlap + 0.001)
    assert not pool.agrees()


def test_the_next_ranking_is_asked_for_where_no_two_draws_agree(monkeypatch):
    scene = scene_of(0, inlier_ratio=0.6, noise=0.2)
    led = 0.5 + 0.5 * scene.inliers
    misled = np.where(scene.inliers, np.nan, 1.0)
    asked = []

    def rankings(*tried):
        for reliability in tried:
            asked.append(reliability)
            yield told(reliability)

    options = {"seed": 0, "watch": Stopwatch(), **ASKED}
    easy = search(scene.X, rankings(led, misled), **options)
    assert len(asked) == 1
    seeds = []

    def draw(points, threshold, confidence, max_iters, seed, **how):
        seeds.append(seed)
        return _engine.draw(points, threshold, confidence, max_iters, seed, **how)

    monkeypatch.setattr(_consensus, "draw", draw)
    agrees = _Pool.agrees
    monkeypatch.setattr(
        _Pool, "agrees", lambda pool, *how, **more: len(asked) > 2 and agrees(pool, *how, **more)
    )
    found = search(scene.X, rankings(misled, led), **options)
    assert len(seeds) == len(set(seeds)) == found.n_draws
    assert len(asked) == 3
    assert found.n_draws > 10
    np.testing.assert_array_equal(found.reliability, led)
    np.testing.assert_array_equal(easy.reliability, led)
    assert sampson_distance(found.F, true_matches(0)).mean() < 0.2
    alone = search(scene.X, [told(misled)], **options)
    assert sampson_distance(alone.F, true_matches(0)).mean() > 1.0


def test_a_ranking_without_any_draw_leaves_what_the_one_before_found(monkeypatch):
    X = scene_of(0, inlier_ratio=0.3).X
    first, second = contrast_support(X)[0], np.linspace(0.0, 1.0, len(X))
    monkeypatch.setattr(_Pool, "agrees", lambda *_, **__: False)
    options = {"watch": Stopwatch(), **ASKED}
    alone = search(X, [told(first)], seed=0, **options)

    def draw(points, threshold, confidence, max_iters, seed, **how):
        if seed < alone.n_draws:
            return _engine.draw(points, threshold, confidence, max_iters, seed, **how)
        return None

    monkeypatch.setattr(_consensus, "draw", draw)
    found = search(X, [told(first), told(second)], seed=0, **options)
    assert found.n_draws > alone.n_draws
    np.testing.assert_array_equal(found.F, alone.F)
    assert found.reliability is first


def test_the_reason_tells_of_agreement(monkeypatch):
    X = scene_of(0, inlier_ratio=0.9, noise=0.2).X
    found = find(X)
    assert found.reason.endswith(f" {found.n_draws} draws, found again by another")
    assert found.agreed
    monkeypatch.setattr(_Pool, "agrees", lambda *_, **__: False)
    assert find(X).reason.endswith(" draws, found by no other")


def turntable(seed, n=400, share=0.75):
    """Matches of an object in the middle that turns, and of a background that stays; and judges."""
    rng = np.random.default_rng(seed)
    K = np.array([[1000.0, 0, 640], [0, 1000, 480], [0, 0, 1]])
    n_object = round(n * share)
    points = rng.normal([0, 0, 10], 0.7, (n_object + 200, 3))
    angle = rng.uniform(0.2, 0.4)
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    turned = (points - [0, 0, 10]) @ R.T + [0, rng.uniform(-0.2, 0.2), 10]
    images = [p @ K.T for p in (points, turned)]
    X = np.hstack([p[:, :2] / p[:, 2:] for p in images])
    judges, X = X[n_object:], X[:n_object] + rng.normal(0, 0.5, (n_object, 4))
    still = np.tile(rng.uniform(0, [1280, 960], (n - n_object, 2)), 2)
    still += rng.normal(0, 0.1, still.shape)
    return rng.permutation(np.vstack([X, still])), judges


@pytest.mark.parametrize("majority", [False, True])
def test_most_matches_win_over_fewer_that_are_spread(majority):
    """Cell by cell the background has more votes; but it is a quarter of the matches."""
    errors, told = [], 0
    for seed in range(12):
        X, judges = turntable(seed)
        found = find(X, majority=majority)
        errors.append(sampson_distance(found.F, judges).mean())
        told += "more matches near it than the one with the most votes" in found.reason
    assert max(errors) < 1.0
    assert told > 6


@pytest.mark.parametrize(("n", "best"), [(38, 0), (60, 1)])
def test_a_rival_is_not_better_for_being_tighter(n, best):
    """Another motion with more votes has 40 matches at four times its noise."""
    rng = np.random.default_rng(0)
    squared = np.full((2, 100), 100.0)
    squared[0, :40] = rng.normal(0, 0.4, 40) ** 2
    squared[1, 40 : 40 + n] = rng.normal(0, 0.1, n) ** 2
    pool = _Pool(true_matches(0, 100), np.ones(100), np.arange(100), 2.0, rng)
    pool._append(np.ones((2, 3, 3)), squared, np.array([100.0, 80.0]), [30, 60])
    assert pool.best == best


@pytest.mark.parametrize("wrong", [0, 200])
@pytest.mark.parametrize("seed", SEEDS)
def test_the_reason_tells_of_matches_that_leave_f_open(seed, wrong):
    """Those of one homography do, those of a scene of many depths do not."""
    rng = np.random.default_rng(seed)
    H = np.array([[1.1, 0.1, 30.0], [-0.1, 1.0, -20.0], [rng.uniform(-1e-4, 1e-4), 1e-4, 1.0]])
    first = rng.uniform(0, [1280, 960], (400, 2))
    second = np.hstack([first, np.ones((400, 1))]) @ H.T
    plane = np.hstack([first, second[:, :2] / second[:, 2:]])
    stray = rng.uniform(0, [1280, 960] * 2, (wrong, 4))
    for X, open_ in ((plane, True), (true_matches(seed), False)):
        X = np.vstack([X + rng.normal(0, 0.3, (400, 4)), stray])
        found = find(X)
        assert ("leaves F open" in found.reason) == (not found.agreed) == open_


def test_a_few_matches_off_the_plane_do_not_leave_f_open():
    """Of one in twenty, moved towards one point: more than chance has. So F rests on these."""
    told = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        first = rng.uniform(0, [1280, 960], (600, 2))
        H = np.array([[1.1, 0.1, 30.0], [-0.1, 1.0, -20.0], [1e-4, -1e-4, 1.0]])
        second = np.hstack([first, np.ones((600, 1))]) @ H.T
        second[:30] += rng.uniform(0.1, 0.3, (30, 1)) * [900.0, 300.0, 1.0]
        X = np.hstack([first, second[:, :2] / second[:, 2:]]) + rng.normal(0, 0.2, (600, 4))
        reason = find(X).reason
        told += "F open" in reason
        assert re.search(r"9[4-6]\.\d% .* (F open|F rests on the other [4-6]\.\d%)$", reason)
    assert told <= 1


@pytest.mark.parametrize("n", [20, 40, 80])
def test_draws_hardly_ever_agree_by_chance(n):
    """One that is from around the best hypothesis confirms it, and does not count."""
    agreed = 0
    for seed in range(20):
        X = np.random.default_rng(seed).uniform(0, [1280, 960] * 2, (n, 4))
        agreed += find(X, seed=seed).agreed
    assert agreed <= 1


def test_the_reason_says_what_the_winner_has_most_of(monkeypatch):
    monkeypatch.setattr(_Pool, "virtue", property(lambda pool: "the most of all"))
    found = find(scene_of(0).X)
    assert found.reason.startswith(f"the hypothesis with the most of all of {found.n_draws} draws")


def test_the_watch_tells_draws_from_the_rest(monkeypatch):
    """On a clock that a draw moves by a second, and a polish by a thousand."""
    now = 0.0

    def lasting(seconds, function):
        def timed(*args, **kwargs):
            nonlocal now
            now += seconds
            return function(*args, **kwargs)

        return timed

    monkeypatch.setattr(_consensus, "draw", lasting(1, _consensus.draw))
    monkeypatch.setattr(_consensus, "polish", lasting(1000, _consensus.polish))
    monkeypatch.setattr(_stopwatch, "perf_counter", lambda: now)
    monkeypatch.setattr(_Pool, "agrees", lambda *_, **__: False)
    watch = Stopwatch()
    X = scene_of(0).X
    found = search(X, [contrast_support(X)], seed=0, watch=watch, **ASKED)
    draws = 1000 * found.n_draws
    assert watch.laps == {"draws": draws, "polish": 1000 * now - draws}


# The vote


def test_cells_are_those_of_a_square_grid():
    """Sixteen to the longer side, however long the other, and wherever the points are."""
    rng = np.random.default_rng(0)
    for size, offset in (((900, 300), (5, -2000)), ((0.1, 0.7), (3, 3))):
        points = rng.uniform(0, size, (500, 2)) + offset
        order, starts = _consensus._groups(_consensus._cells(points)[None])
        assert sorted(order) == list(range(500))
        low = points.min(axis=0)
        place = np.floor((points - low) * 16 / (points.max(axis=0) - low).max()).clip(max=15)
        groups = np.split(order, starts[1:])
        assert starts[0] == 0
        assert len(groups) == len(np.unique(place, axis=0))
        for group in groups:
            assert len(np.unique(place[group], axis=0)) == 1


def test_each_width_and_image_has_the_root_of_a_cells_votes():
    ballot = _Ballot(np.ones((30, 4)), np.ones(30))
    widths, images = len(_consensus._VOTE_WIDTHS), 2
    votes = ballot.count(np.zeros((1, 30)), 1.0)
    np.testing.assert_allclose(votes, widths * images * np.sqrt(30))


def test_votes_end_at_the_largest_width():
    X = spread_and_crowd()
    squared = np.array([[(1.29 * 2.0) ** 2], [(1.31 * 2.0) ** 2]]) * np.ones(26)
    inside, outside = _Ballot(X, np.ones(26)).count(squared, 2.0)
    assert inside > 0
    assert outside == 0


def spread_and_crowd():
    """Twelve matches all over both images, twelve that share a spot, and two far corners."""
    rng = np.random.default_rng(0)
    grid = np.array([(x, y) for x in range(0, 1000, 250) for y in range(0, 750, 250)], float)
    crowd = 100 + rng.uniform(0, 2, (12, 4))
    return np.vstack([np.hstack([grid, grid]), crowd, np.zeros((1, 4)), np.full((1, 4), 1000.0)])


def votes_for(X, reliability, *sets):
    """Votes for hypotheses that each fit exactly the given rows, and miss the others by far."""
    squared = np.full((len(sets), len(X)), 1e4)
    for row, inliers in zip(squared, sets, strict=True):
        row[inliers] = 0.0
    return _Ballot(X, reliability).count(squared, 1.0)


def test_a_crowd_counts_less_than_as_many_spread_matches():
    X = spread_and_crowd()
    spread, crowd = votes_for(X, np.ones(26), np.arange(12), np.arange(12, 24))
    assert spread > 2 * crowd


def test_a_crowd_in_one_image_counts_less_too():
    X = spread_and_crowd()
    mixed = X.copy()
    mixed[:12, 2:] = X[12:24, 2:]
    spread, crowd = votes_for(X, np.ones(26), np.arange(12), np.arange(12, 24))
    half = votes_for(mixed, np.ones(26), np.arange(12))[0]
    assert crowd < half < spread


def test_every_inlier_adds_to_the_vote_and_reliable_ones_more():
    X = spread_and_crowd()
    less, more = votes_for(X, np.ones(26), np.arange(18), np.arange(19))
    assert more > less
    reliability = np.where(np.arange(26) % 2, 0.9, 0.3)
    low, high = votes_for(X, reliability, np.arange(0, 12, 2), np.arange(1, 12, 2))
    assert high > low


def test_votes_fall_with_the_residual_to_nothing():
    X = spread_and_crowd()
    residuals = np.array([0.0, 0.1, 0.2, 0.4, 50.0])
    votes = _Ballot(X, np.ones(26)).count(np.tile(residuals[:, None] ** 2, 26), 1.0)
    assert (np.diff(votes) < 0).all()
    assert votes[-1] == 0.0
    wider = _Ballot(X, np.ones(26)).count(np.full((1, 26), 0.25), 2.0)
    assert wider > votes[3]


def test_a_part_of_a_ballot_has_the_votes_of_its_matches():
    X = scene_of(0, n=100).X
    rng = np.random.default_rng(0)
    reliability, squared = rng.uniform(size=100), rng.uniform(0, 2, (3, 100))
    ballot, rows = _Ballot(X, reliability), np.flatnonzero(X[:, 0] < 400)
    squared[:, X[:, 0] >= 400] = np.inf
    np.testing.assert_allclose(
        ballot.part(rows).count(squared[:, rows], 1.0), ballot.count(squared, 1.0)
    )


def test_what_lies_far_out_leaves_the_others_their_cells():
    scene = scene_of(0)
    F = eight_point(scene.X[None, scene.inliers])
    votes = []
    for n_far in (0, 10):
        X = np.vstack([scene.X, np.full((n_far, 4), 1e6)])
        X -= scene.X.mean(axis=0)
        pool = _Pool(X, np.ones(len(X)), np.arange(600), 1.0, np.random.default_rng(0))
        centre = scene.X.mean(axis=0)
        pool.add(shift(centre[2:]).T @ F @ shift(centre[:2]), [50])
        votes.append(pool.votes[0])
    # Their cells are larger, but by far not one.
    assert votes[1] > 0.5 * votes[0]


def test_vote_does_not_change_with_the_place_order_and_unit_of_the_matches():
    X = scene_of(0, n=100).X
    rng = np.random.default_rng(0)
    reliability, squared = rng.uniform(size=100), rng.uniform(0, 2, (3, 100))
    votes = _Ballot(X, reliability).count(squared, 1.0)
    order = rng.permutation(100)
    shuffled = _Ballot(X[order], reliability[order]).count(squared[:, order], 1.0)
    np.testing.assert_allclose(shuffled, votes)
    scaled = _Ballot(4 * X + 64, reliability).count(16 * squared, 4.0)
    np.testing.assert_allclose(scaled, votes)
    swapped = _Ballot(X[:, [2, 3, 0, 1]], reliability).count(squared, 1.0)
    np.testing.assert_allclose(swapped, votes)


# The noise


@pytest.mark.parametrize("sigma", [0.05, 0.2, 0.5, 0.9])
@pytest.mark.parametrize("n_wrong", [0, 500])
def test_noise_is_the_standard_deviation_of_the_right_ones_residuals(sigma, n_wrong):
    rng = np.random.default_rng(0)
    r = np.concatenate([rng.normal(0, sigma, 1000), rng.uniform(-100, 100, n_wrong)])
    assert _noise(r**2, 1.0) == pytest.approx(sigma, rel=0.15)


def test_noise_of_next_to_no_residuals_is_of_the_order_of_the_threshold():
    for squared in (np.array([]), np.full(30, 1e6)):
        for threshold in (0.3, 1.0, 7.0):
            assert 0.1 < _noise(squared, threshold) / threshold <= 1.0


def test_noise_among_wrong_matches_nearby():
    """As many of them as of right ones, within a few deviations on average."""
    rng = np.random.default_rng(0)
    r = np.concatenate([rng.normal(0, 0.2, 2000), rng.uniform(-3, 3, 2000)])
    assert _noise(r**2, 1.0) == pytest.approx(0.2, rel=0.25)


@pytest.mark.parametrize("sigma", [0.1, 0.5])
def test_doubt_is_how_much_likelier_a_match_on_its_line_is_wrong_than_right(sigma):
    """Right matches have normal noise, wrong ones lie anywhere up to 300 px off."""
    rng = np.random.default_rng(0)
    n = 20_000
    reliability = rng.permutation(n) / n
    is_right = rng.random(n) < 0.1 + 0.8 * (reliability > 0.5)
    r = np.where(is_right, rng.normal(0, sigma, n), rng.uniform(-300, 300, n))
    doubt = _doubt(r**2, sigma, reliability)
    for share, those in ((0.1, reliability < 0.5), (0.9, reliability > 0.5)):
        # Densities at 0 of either kind.
        expected = (1 - share) / 600 / (share / (np.sqrt(2 * np.pi) * sigma))
        assert np.exp(np.log(doubt[those]).mean()) == pytest.approx(expected, rel=0.6)
    assert np.median(doubt[reliability < 0.5]) > 20 * np.median(doubt[reliability > 0.5])


def test_wrong_matches_beside_the_lines_hardly_pull_where_they_are_unreliable(monkeypatch):
    """Those on one side of their lines pull F there, unless it is known that most are wrong."""
    errors = []
    for doubt in (_doubt, lambda *_: 0.1):
        monkeypatch.setattr(_consensus, "_doubt", doubt)
        for seed in range(4):
            rng = np.random.default_rng(seed)
            exact = true_matches(seed, 600)
            X = exact + rng.normal(0, 0.3, exact.shape)
            X[300:, 3] += rng.uniform(0, 6, 300)
            reliability = np.where(np.arange(600) < 300, 0.9, 0.1)
            pool = _Pool(X, reliability, np.arange(300), 1.0, rng)
            pool.add(eight_point(exact[None]), [50])
            errors.append(np.median(sampson_distance(pool.refined(pool._G[0]), exact)))
    assert np.mean(errors[:4]) < 0.7 * np.mean(errors[4:])


def test_doubt_of_matches_of_one_reliability_is_the_same_in_any_order():
    rng = np.random.default_rng(0)
    r = np.concatenate([rng.normal(0, 0.5, 300), rng.uniform(0, 300, 300)])
    doubt, mixed = (_doubt(x**2, 0.5, np.ones(600)) for x in (r, rng.permutation(r)))
    np.testing.assert_array_equal(doubt, mixed)
    assert np.ptp(doubt) == 0


def test_doubt_is_finite_and_not_0_where_there_is_nothing_to_count():
    for squared in (np.zeros(40), np.full(40, 1e300)):
        doubt = _doubt(squared, 0.5, np.zeros(40))
        assert (doubt > 0).all()
        assert np.isfinite(doubt).all()


def test_noise_is_of_residuals_within_three_thresholds():
    """Wrong matches all over have a median at 1.5 thresholds, and no more."""
    r = np.linspace(0, 100, 10_000)
    assert _noise(r**2, 1.0) == pytest.approx(1.4826 * 1.5, rel=0.15)
    assert _noise((7 * r) ** 2, 7.0) == pytest.approx(7 * _noise(r**2, 1.0), rel=0.02)


def test_noise_of_exact_matches_is_nothing():
    assert _noise(np.zeros(50), 1.0) == 0.0


@pytest.mark.parametrize("n", [12, 16, 30])
def test_few_residuals_of_a_fit_do_not_tell_too_small_a_noise(n):
    """Of n residuals seven degrees of freedom are spent; the median makes up for it."""
    told = []
    for seed in range(400):
        rng = np.random.default_rng(seed)
        A = np.linalg.qr(rng.normal(size=(n, 7)))[0]
        r = rng.normal(size=n)
        told.append(_noise((r - A @ (A.T @ r)) ** 2, 3.0))
    assert 0.75 < np.median(told) < 1.35
