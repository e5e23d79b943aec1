"""Inliers of a common scene keep their neighbours, those that wrong matches make do not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from cv_densityf import _prefilter, coherence, estimate_fundamental
from cv_densityf.datasets import two_view_scene

SEEDS = range(6)


def by_definition(X, k=16):
    """Mean over the matches of 1 / rank of each shared neighbour, from chance to the most."""
    n = len(X)
    k = min(k, n - 1)
    total = 0.0
    for i in range(n):
        places = []
        for Y in (X[:, :2], X[:, 2:]):
            near = [j for j in np.argsort(np.hypot(*(Y - Y[i]).T), kind="stable") if j != i][:k]
            places.append({j: place for place, j in enumerate(near, start=1)})
        total += sum(1 / max(p[j] for p in places) for j in places[0].keys() & places[1].keys())
    most = sum(1 / a for a in range(1, k + 1))
    chance = sum(1 / max(a, b) for a in range(1, k + 1) for b in range(1, k + 1)) / (n - 1)
    return (total / n - chance) / (most - chance)


@pytest.mark.parametrize("n", [3, 10, 16, 17, 18, 80])
def test_it_is_the_definition(n):
    X = two_view_scene(n, inlier_ratio=0.7, random_state=n).X
    assert coherence(X[:, :2], X[:, 2:]) == pytest.approx(by_definition(X), abs=1e-9)


def test_it_is_0_by_chance_and_1_where_nothing_moves():
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 1000, (200, 2))
    assert coherence(points, 2 * points + 50) == pytest.approx(1)
    chance = [coherence(points, rng.permutation(points)) for _ in range(30)]
    assert abs(np.mean(chance)) < 0.01
    assert np.std(chance) < 0.02


def test_of_very_many_it_is_that_of_some_among_all(monkeypatch):
    X = two_view_scene(500, inlier_ratio=0.7, random_state=0).X
    whole = coherence(X[:, :2], X[:, 2:])
    monkeypatch.setattr(_prefilter, "_COHERENCE_OF", 100)
    some = coherence(X[:, :2], X[:, 2:])
    assert some != whole
    assert some == pytest.approx(whole, abs=0.1)


@pytest.mark.parametrize("threshold", [1.0, 4.0])
def test_it_tells_right_estimates_from_wrong_ones(threshold):
    for seed in SEEDS:
        scene = two_view_scene(300, inlier_ratio=0.3, noise=0.5, random_state=seed)
        wrong = np.random.default_rng(seed).permutation(scene.points2)
        for points2, low, high in ((scene.points2, 0.5, 1.0), (wrong, -0.2, 0.35)):
            for find in (estimate_fundamental, None):
                if find:
                    mask = find(scene.points1, points2, threshold=threshold).mask
                else:
                    _, mask = cv2.findFundamentalMat(
                        scene.points1, points2, cv2.USAC_MAGSAC, threshold
                    )
                    if mask.sum() < 15:
                        continue
                assert low < coherence(scene.points1, points2, mask) < high


def test_rows_that_are_not_finite_and_outliers_do_not_count():
    scene = two_view_scene(60, inlier_ratio=0.5, random_state=0)
    points1, points2, mask = scene.points1.copy(), scene.points2, scene.inliers
    expected = coherence(points1[mask], points2[mask])
    assert coherence(points1, points2, mask) == expected
    assert coherence(points1, points2, mask[:, None].astype(np.uint8)) == expected
    for unclear in (np.where(mask, 1, -1), np.where(mask, 1, np.nan)):
        with pytest.raises(ValueError, match="pass `mask > 0`"):
            coherence(points1, points2, unclear)
    points1[~mask] = np.nan
    assert coherence(points1, points2) == expected
    assert coherence(points1.astype(np.float32), points2, mask) == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize("n", [0, 2])
def test_it_is_nan_for_fewer_than_three(n):
    points = np.random.default_rng(0).uniform(0, 100, (3, 2))
    assert np.isnan(coherence(points[:n], points[:n]))
    assert not np.isnan(coherence(points, points))


@pytest.mark.parametrize("times", [2, 20])
def test_copies_change_nothing(times):
    """SIFT gives a point of two orientations twice."""
    X = two_view_scene(100, inlier_ratio=0.7, random_state=0).X
    copies = np.repeat(X, times, axis=0)
    whole = coherence(X[:, :2], X[:, 2:])
    assert coherence(copies[:, :2], copies[:, 2:]) == pytest.approx(whole)


def test_what_is_masked_in_the_mask_is_no_inlier():
    scene = two_view_scene(200, inlier_ratio=0.6, random_state=0)
    masked = np.ma.array(np.ones(200, dtype=bool), mask=~scene.inliers)
    points = scene.points1, scene.points2
    assert coherence(*points, masked) == coherence(*points, scene.inliers) != coherence(*points)


def test_a_mask_of_another_length_is_refused():
    points = np.zeros((5, 2))
    with pytest.raises(ValueError, match=r"mask has shape \(4,\); it must be \(5,\)"):
        coherence(points, points, np.ones(4, dtype=bool))
    with pytest.raises(ValueError, match="points1 has 5 points and points2 4"):
        coherence(points, points[:4])
