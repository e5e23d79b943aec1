"""The method of Wu and Wan: its rule against the formula, its RANSAC by the equation."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import reference_density
from scipy.stats import norm

from cv_densityf import _paper, estimate_fundamental
from cv_densityf._epipolar import inlier_mask, point_line_squared, sampson_distance
from cv_densityf._paper import _samples_needed, eight_point_ransac, paper_support
from cv_densityf.datasets import two_view_scene

SEEDS = range(4)


def true_matches(seed, n=400):
    """Exact matches all over a scene with the seed's geometry."""
    return two_view_scene(n, inlier_ratio=1.0, noise=0.0, random_state=seed).X


def scene_of(seed, n=600, inlier_ratio=0.3, noise=0.5):
    return two_view_scene(n, inlier_ratio=inlier_ratio, noise=noise, random_state=seed)


@pytest.mark.parametrize("alpha", [0.0, 0.011, 0.3, 1.0])
@pytest.mark.parametrize("percent", [2.0, 10.0])
def test_the_rule_is_the_formula(alpha, percent):
    X = scene_of(1, n=80, inlier_ratio=0.6).X
    reliability, kept = paper_support(X, alpha, percent)
    low, high = reference_density.cutoff_interval(X.tolist(), percent)
    rho = np.array(reference_density.density(X.tolist(), (low + high) / 2, "cutoff"), float)
    delta, _ = reference_density.delta_and_predecessor(X.tolist(), rho.tolist())
    gamma = rho * np.array(delta)
    np.testing.assert_allclose(reliability, gamma / (rho.max() * max(delta)), rtol=1e-9)
    clear = np.abs(gamma - alpha * rho.max() * max(delta)) > 1e-9
    np.testing.assert_array_equal(kept[clear], (gamma >= alpha * rho.max() * max(delta))[clear])


def test_the_rule_drops_more_with_larger_alpha_and_nothing_at_zero():
    X = scene_of(1, n=400).X
    supports = [paper_support(X, alpha, 2.0)[1] for alpha in (0.0, 0.005, 0.011, 0.1, 1.0)]
    assert supports[0].all()
    for larger, smaller in pairwise(supports):
        assert not (smaller & ~larger).any()
        assert smaller.sum() < larger.sum()


def test_the_rule_keeps_mostly_right_matches():
    for seed in SEEDS:
        scene = scene_of(seed)
        kept = paper_support(scene.X, 0.011, 2.0)[1]
        assert scene.inliers[kept].mean() > 1.2 * 0.3


def test_the_rule_keeps_all_of_equal_matches():
    reliability, kept = paper_support(np.ones((30, 4)), 0.011, 2.0)
    assert kept.all()
    assert np.isfinite(reliability).all()


@pytest.mark.parametrize("ratio", [0.1, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("confidence", [0.5, 0.99, 0.9999])
def test_number_of_samples_follows_the_papers_equation(ratio, confidence):
    k = _samples_needed(ratio, confidence)
    if k > 1:
        assert (1 - ratio**8) ** k == pytest.approx(1 - confidence, rel=1e-6)
    else:
        assert ratio**8 >= confidence * (1 - 1e-9)


def test_one_sample_is_enough_if_all_matches_agree_and_very_many_if_few_do():
    assert _samples_needed(1.0, 0.99) == 1.0
    assert _samples_needed(1e-3, 0.99) > 1e20


def recount(found, X, threshold):
    return int(np.count_nonzero(point_line_squared(found.F, X) <= threshold**2))


@pytest.mark.parametrize("seed", SEEDS)
def test_its_ransac_ends_by_its_equation(seed):
    X = scene_of(seed, n=300, inlier_ratio=0.55, noise=0.0).X
    found = eight_point_ransac(X, threshold=0.5, confidence=0.99, max_iters=100_000, seed=seed)
    inliers = recount(found, X, 0.5)
    assert found.votes == (inliers,)
    assert found.reason.startswith(f"{inliers} of the 300 matches ")
    assert inliers >= 160
    # The clean sample came before the number that it asks for had been drawn.
    assert found.n_draws == np.ceil(_samples_needed(inliers / 300, 0.99))


def test_its_ransac_ends_at_the_callers_bound():
    X = scene_of(0, inlier_ratio=0.2).X
    for bound in (1, 64, 65, 100):
        found = eight_point_ransac(X, threshold=1.0, confidence=0.999, max_iters=bound, seed=0)
        assert found is None or found.n_draws == bound


def test_its_ransac_needs_one_sample_of_exact_matches():
    found = eight_point_ransac(
        true_matches(0), threshold=1.0, confidence=0.99, max_iters=1000, seed=0
    )
    assert found.n_draws <= 3
    assert sampson_distance(found.F, true_matches(0)).max() < 1.0


def test_its_ransac_returns_a_samples_f_not_a_fit():
    """Eight matches are met much better than the other right ones."""
    scene = scene_of(0, n=100, inlier_ratio=1.0, noise=1.0)
    found = eight_point_ransac(scene.X, threshold=3.0, confidence=0.99, max_iters=100, seed=0)
    refined = estimate_fundamental(scene.points1, scene.points2)
    truth = true_matches(0)
    assert sampson_distance(found.F, truth).mean() > sampson_distance(refined.F, truth).mean()


def test_its_ransac_is_seeded():
    X = scene_of(0, inlier_ratio=0.5).X
    F = [
        eight_point_ransac(X, threshold=1.0, confidence=0.99, max_iters=70, seed=seed).F
        for seed in (0, 0, 1)
    ]
    np.testing.assert_array_equal(F[0], F[1])
    assert not np.array_equal(F[0], F[2])


def test_its_ransac_takes_eight_exact_matches_and_no_fewer_that_agree():
    X = true_matches(0)[:8]
    asked = {"threshold": 1.0, "confidence": 0.99, "max_iters": 200, "seed": 0}
    found = eight_point_ransac(X, **asked)
    assert found.votes == (8.0,)
    assert sampson_distance(found.F, X).max() < 1.0
    chance = np.random.default_rng(0).uniform(0, 1000, (20, 4))
    assert eight_point_ransac(chance, **{**asked, "threshold": 1e-6}) is None


@pytest.mark.parametrize("n_inliers", [7, 8, 30])
def test_its_ransac_takes_a_match_at_the_threshold_and_eight_of_them(n_inliers, monkeypatch):
    """As the mask of ``FM_RANSAC`` does; the lines here are the rows of the image."""
    F = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    monkeypatch.setattr(_paper, "eight_point", lambda samples: np.tile(F, (len(samples), 1, 1)))
    X = np.arange(120.0).reshape(30, 4)
    X[:, 3] = X[:, 1] + np.where(np.arange(30) < n_inliers, 2.0, 2.001)
    found = eight_point_ransac(X, threshold=2.0, confidence=0.99, max_iters=100, seed=0)
    if n_inliers < 8:
        assert found is None
    else:
        assert found.votes == (inlier_mask(F, X, "ransac", 2.0).sum(),) == (n_inliers,)
        assert found.n_draws == (1 if n_inliers == 30 else 100)


@pytest.mark.parametrize("n", [10, 70])
def test_its_ransac_draws_evenly_and_without_repetition(n, monkeypatch):
    seen = []

    def recorded(samples):
        seen.append(samples)
        return np.tile(np.eye(3), (len(samples), 1, 1))

    monkeypatch.setattr(_paper, "eight_point", recorded)
    X = np.arange(4.0 * n).reshape(n, 4)
    eight_point_ransac(X, threshold=1e-9, confidence=0.99, max_iters=500, seed=0)
    rows = np.concatenate(seen)[:500, :, 0] / 4
    assert rows.shape == (500, 8)
    assert all(len(set(row)) == 8 for row in rows)
    counts = np.bincount(rows.ravel().astype(int), minlength=n)
    spread = norm.ppf(1 - 1e-6) * np.sqrt(500 * 8 / n * (1 - 8 / n))
    np.testing.assert_allclose(counts, 500 * 8 / n, atol=spread)


@pytest.mark.parametrize("n", [0, 7])
def test_its_ransac_needs_eight_matches(n):
    assert (
        eight_point_ransac(
            true_matches(0)[:n], threshold=1.0, confidence=0.99, max_iters=10, seed=0
        )
        is None
    )
