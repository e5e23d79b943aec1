"""Hypotheses through what lies off a dominant plane, on planes whose geometry is known."""

from __future__ import annotations

import numpy as np
import pytest

from cv_densityf import estimate_fundamental
from cv_densityf._epipolar import Frame, sampson_distance
from cv_densityf._parallax import plane_and_parallax

SEEDS = range(6)
WIDTH = 2.0


def scene(seed, on=300, off=12, wrong=6, noise=0.0, to=(0.2, 1.0, 0.1)):
    """Matches of a plane, of a few other places and wrong ones, in this order, and two F's.

    The first F is the true one, the second one, of a motion ``to``, has the plane's matches alone.
    """
    rng = np.random.default_rng(seed)
    K = np.array([[1000.0, 0, 640], [0, 1000, 480], [0, 0, 1]])
    angle = rng.uniform(-0.1, 0.1)
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    t = np.array([1.0, rng.uniform(-0.3, 0.3), rng.uniform(-0.2, 0.2)])
    pixels = rng.uniform(0, [1280, 960], (on + off, 2))
    inverse = 1 / 8 - 5e-5 * pixels[:, 0]
    inverse[on:] = 1 / rng.uniform(3, 5, off)
    rays = np.hstack([pixels, np.ones((on + off, 1))]) @ np.linalg.inv(K).T
    second = (rays @ R.T + inverse[:, None] * t) @ K.T
    X = np.hstack([pixels, second[:, :2] / second[:, 2:]])
    X += rng.normal(0, noise, X.shape)
    X = np.vstack([X, rng.uniform(0, [1280, 960] * 2, (wrong, 4))])

    def cross(v):
        return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])

    normal = np.array([-5e-5 * 1000, 0, 1 / 8 - 5e-5 * 640])  # normal @ ray = inverse depth
    H = K @ (R + np.outer(t, normal)) @ np.linalg.inv(K)
    true = cross(K @ t) @ H
    other = cross(K @ np.array(to)) @ H
    return X, true / np.linalg.norm(true), other / np.linalg.norm(other)


def completed(X, F, seed=0):
    frame = Frame(X)
    G = frame.enter(F[None])
    inliers = frame.sampson(G)[0] < WIDTH**2
    hypotheses, off_plane = plane_and_parallax(
        frame, G[0], inliers, WIDTH, np.random.default_rng(seed)
    )
    return frame.leave(hypotheses), off_plane


@pytest.mark.parametrize("noise", [0.0, 0.3])
@pytest.mark.parametrize("seed", SEEDS)
def test_what_lies_off_the_plane_finds_the_epipole(seed, noise):
    X, _, other = scene(seed, noise=noise)
    assert np.median(sampson_distance(other, X[300:312])) > 5
    found, off_plane = completed(X, other)
    assert len(found) == 2
    assert off_plane[:300].mean() < 0.01
    assert off_plane[300:].mean() > 0.9
    assert np.median(sampson_distance(found[0], X[300:312])) < 1e-6 + WIDTH * (noise > 0)
    assert np.median(sampson_distance(found[0], X[:300])) < 1e-6 + WIDTH * (noise > 0)


@pytest.mark.parametrize("seed", SEEDS)
def test_matches_near_an_epipole_are_on_the_plane_as_well(seed):
    """Lines change fast there, and with them the error by the F that has the epipole."""
    X, _, other = scene(seed, on=2000, noise=0.3, to=(0.05, 0.05, 1.0))
    off_plane = completed(X, other)[1]
    assert off_plane[:2000].mean() < 0.001
    assert off_plane[2000:].mean() > 0.9


def on_lines(F, n, seed=0):
    """Matches of F in the second image's left part, wherever the plane is."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform([700, 0], [1280, 960], (n, 2))
    a, b, c = (np.hstack([pixels, np.ones((n, 1))]) @ F.T).T
    x = rng.uniform(0, 200, n)
    return np.column_stack([pixels, x, -(a * x + c) / b])


@pytest.mark.parametrize("seed", SEEDS)
def test_an_inlier_far_off_the_plane_does_not_hide_it(seed):
    """It moves the eigenvectors of least squares, but not those of what is on the plane."""
    X, _, other = scene(seed)
    X = np.vstack([X, on_lines(other, 1)])
    assert np.median(sampson_distance(completed(X, other)[0][0], X[300:312])) < 1e-6


@pytest.mark.parametrize("seed", SEEDS)
def test_without_a_dominant_plane_there_is_nothing(seed):
    X, true, _ = scene(seed, on=40, off=260, wrong=30)
    assert len(completed(X, true)[0]) == 0


@pytest.mark.parametrize("seed", SEEDS)
def test_half_of_the_inliers_are_no_dominant_plane(seed):
    X, true, _ = scene(seed, on=180, off=120)
    assert len(completed(X, true)[0]) == 0


def test_a_few_matches_are_always_on_a_plane():
    X, true, _ = scene(0, on=8, off=2, wrong=200)
    assert len(completed(X, true)[0]) == 0


@pytest.mark.parametrize("far", [1e9, 1e30])
@pytest.mark.parametrize("seed", SEEDS)
def test_a_match_far_out_is_no_matter(seed, far):
    X, _, other = scene(seed)
    expected = completed(X, other)[0]
    X = np.vstack([X, [[far, 0.7 * far, 300.0, 300.0]]])
    assert len(expected) == 2
    assert np.median(sampson_distance(completed(X, other)[0][0], X[300:312])) < 1e-6


def test_of_many_matches_too_the_plane_does_not_win():
    """The best hypothesis of a part mostly stays the best when all others are heard."""
    errors = []
    for seed in range(20):
        X, *_ = scene(seed, on=8100, off=60, wrong=900, noise=0.5)
        order = np.random.default_rng(seed).permutation(len(X))
        found = estimate_fundamental(X[order, :2], X[order, 2:])
        errors.append(np.median(sampson_distance(found.F, X[8100:8160])))
    assert np.quantile(errors, 0.6) < 1.0


@pytest.mark.parametrize("off", [0, 1])
def test_fewer_than_two_matches_off_the_plane_fix_nothing(off):
    X, _, other = scene(0, off=off, wrong=0)
    assert len(completed(X, other)[0]) == 0


def test_the_same_seed_tries_the_same_pairs():
    X, _, other = scene(0, off=40, wrong=200)
    first, again, otherwise = (completed(X, other, seed=seed)[0] for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, otherwise)


def test_copies_of_one_match_off_the_plane_fix_nothing():
    X, _, other = scene(0, off=1, wrong=0)
    X = np.vstack([X, np.repeat(X[-1:], 9, axis=0)])
    assert len(completed(X, other)[0]) == 0


def test_a_match_of_the_two_epipoles_is_no_matter():
    X, _, other = scene(0)
    ends = [np.linalg.svd(F)[2][2] for F in (other, other.T)]
    X = np.vstack([X, np.hstack([e[:2] / e[2] for e in ends])])
    assert np.median(sampson_distance(completed(X, other)[0][0], X[300:312])) < 1e-6


def test_draws_of_the_plane_do_not_confirm_what_completes_it():
    """They share nearly all inliers with it, and have missed what tells."""
    right = confirmed = 0
    for seed in range(20):
        X, *_ = scene(seed, on=3500, off=35, wrong=400, noise=0.5)
        order = np.random.default_rng(seed).permutation(len(X))
        found = estimate_fundamental(X[order, :2], X[order, 2:])
        right += np.median(sampson_distance(found.F, X[3500:3535])) < 1.5
        confirmed += found.agreed
    assert right > 10
    assert confirmed < 5
