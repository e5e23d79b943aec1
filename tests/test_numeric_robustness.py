"""Where the images lie, how large and how turned they are, and what was added, hardly matters."""

from __future__ import annotations

import numpy as np
import pytest

from cv_densityf import estimate_fundamental, findFundamentalMat
from cv_densityf._engine import METHODS
from cv_densityf._epipolar import sampson_distance
from cv_densityf.datasets import two_view_scene

SEEDS = range(4)
#: One method for each rule of the mask.
RULES = ["usac_accurate", "ransac", "lmeds"]
SIDES = ["first", "second", "both"]


def function(X, method, threshold):
    return estimate_fundamental(X[:, :2], X[:, 2:], method=method, threshold=threshold).F


def papers(X, method, threshold):
    return estimate_fundamental(
        X[:, :2], X[:, 2:], method=method, threshold=threshold, density="paper"
    ).F


def drop_in(X, method, threshold):
    first, second = X[:, :2].copy(), X[:, 2:].copy()
    return findFundamentalMat(first, second, METHODS[method], threshold, 0.999, 5000)[0]


WAYS = {"function": function, "drop-in": drop_in}


def scene_of(seed):
    return two_view_scene(500, inlier_ratio=0.6, noise=0.5, random_state=seed).X


def error_of(F, seed, first=None, second=None):
    """Mean error, pixels of the scene, of the F of images that were mapped by these matrices."""
    first, second = (np.eye(3) if T is None else T for T in (first, second))
    exact = two_view_scene(400, inlier_ratio=1.0, noise=0.0, random_state=seed).X
    return np.inf if F is None else sampson_distance(second.T @ F @ first, exact).mean()


def mapped(points, T):
    return points @ T[:2, :2].T + T[:2, 2]


def scaling(factor):
    return np.diag([factor, factor, 1.0])


def shift(x, y):
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def turn(degrees):
    a = np.deg2rad(degrees)
    return np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1.0]])


@pytest.fixture(scope="module")
def plain():
    """Errors on the scenes as they are."""
    ways = {**WAYS, "paper": papers}
    return {
        (way, method): [error_of(call(scene_of(seed), method, 1.0), seed) for seed in SEEDS]
        for way, call in ways.items()
        for method in [*RULES, "usac_magsac"]
    }


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("method", RULES)
@pytest.mark.parametrize("factor", [1e-3, 1e-2, 1e3, 1e6])
def test_the_unit_of_length_hardly_matters(plain, way, method, factor):
    """The threshold in the same unit; its upper bound is 1e6 of whatever unit."""
    T = scaling(factor)
    threshold = min(factor, 9e5)
    errors = [
        error_of(WAYS[way](factor * scene_of(seed), method, threshold), seed, T, T)
        for seed in SEEDS
    ]
    assert np.median(errors) < 1.2 * np.median(plain[way, method]) + 0.02
    assert max(errors) < 0.6


@pytest.mark.parametrize("factor", [1e-3, 1e-2, 1e3])
def test_the_unit_of_length_hardly_matters_to_the_papers_rule(plain, factor):
    T = scaling(factor)
    errors = [error_of(papers(factor * scene_of(s), "ransac", factor), s, T, T) for s in SEEDS]
    np.testing.assert_allclose(errors, plain["paper", "ransac"], rtol=0.05)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("method", RULES)
@pytest.mark.parametrize("side", SIDES)
def test_a_million_pixels_away_is_as_good(plain, way, method, side):
    """float32 has a step of 1/16 px there: what cv2 is told of the points holds 0.02 px of noise.

    USAC's inlier rule is float32 throughout, and noise where both images are that far away.
    """
    away = 1e5 if method == "usac_accurate" and side == "both" else 1e6
    first = shift(away, -away) if side != "second" else np.eye(3)
    second = shift(-away, away) if side != "first" else np.eye(3)
    errors = []
    for seed in SEEDS:
        X = scene_of(seed)
        X = np.hstack([mapped(X[:, :2], first), mapped(X[:, 2:], second)])
        errors.append(error_of(WAYS[way](X, method, 1.0), seed, first, second))
    assert np.median(errors) < 1.3 * np.median(plain[way, method]) + 0.05


SIMILARITIES = {
    "quarter turn": turn(90),
    "turn": turn(-37),
    "half the size": scaling(0.5),
    "three times the size": scaling(3.0),
    "moved": shift(-5000, 3000),
    "all of it": shift(-700, 90) @ turn(155) @ scaling(1.7),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("method", RULES)
@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("kind", SIMILARITIES)
def test_a_similarity_of_an_image_transforms_f(plain, way, method, side, kind):
    T = SIMILARITIES[kind]
    first, second = (np.eye(3) if side == other else T for other in ("second", "first"))
    threshold = np.sqrt(np.linalg.det(T[:2, :2])) if side == "both" else 1.0
    errors = []
    for seed in SEEDS:
        X = scene_of(seed)
        X = np.hstack([mapped(X[:, :2], first), mapped(X[:, 2:], second)])
        errors.append(error_of(WAYS[way](X, method, threshold), seed, first, second))
    assert np.median(errors) < 1.3 * np.median(plain[way, method]) + 0.05


@pytest.mark.parametrize("way", [*WAYS, "paper"])
@pytest.mark.parametrize("method", [*RULES, "usac_magsac"])
def test_swapped_images_have_the_transposed_matrix(plain, way, method):
    call = {**WAYS, "paper": papers}[way]
    errors = []
    for seed in SEEDS:
        F = call(scene_of(seed)[:, [2, 3, 0, 1]], method, 1.0)
        errors.append(error_of(F.T, seed))
    assert np.median(errors) < 1.2 * np.median(plain[way, method]) + 0.02


def wrong(seed, n, low=0.0, high=1000.0):
    return np.random.default_rng(seed).uniform(low, high, (n, 4))


ADDED = {
    "every match once more": lambda X, seed: X,
    "every match four times more": lambda X, seed: np.tile(X, (4, 1)),
    "a right match 500 times": lambda X, seed: np.tile(X[:1], (500, 1)),
    "a wrong match 500 times": lambda X, seed: np.tile(wrong(seed, 1), (500, 1)),
    "ten wrong matches 50 times": lambda X, seed: np.tile(wrong(seed, 10), (50, 1)),
    **{
        f"{n} up to {far:g} px away": lambda X, seed, n=n, far=far: wrong(seed, n, -far, far)
        for n, far in ((1, 1e4), (25, 1e4), (25, 1e5), (25, 1e6), (1, 1e8), (25, 1e9), (25, 1e30))
    },
    "25 far away in one image": lambda X, seed: np.hstack(
        [wrong(seed, 25)[:, :2], wrong(seed, 25, -1e6, 1e6)[:, 2:]]
    ),
    "25 matches at no place": lambda X, seed: np.full((25, 4), np.nan),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("method", RULES)
@pytest.mark.parametrize("kind", ADDED)
def test_more_of_the_same_and_of_the_impossible_breaks_nothing(plain, way, method, kind):
    errors = []
    for seed in SEEDS:
        X = scene_of(seed)
        Y = np.vstack([X, ADDED[kind](X, seed)])
        errors.append(error_of(WAYS[way](Y, method, 1.0), seed))
    assert np.median(errors) < 1.5 * np.median(plain[way, method]) + 0.1


@pytest.mark.parametrize("factor", [2.0**-10, 2.0**10])
def test_a_power_of_two_changes_no_digit(factor):
    """As long as cv2 draws the same samples, all that differs is the exponent."""
    X = scene_of(0)
    here = estimate_fundamental(X[:, :2], X[:, 2:], threshold=1.0)
    X = factor * X
    there = estimate_fundamental(X[:, :2], X[:, 2:], threshold=factor)
    assert (here.mask == there.mask).mean() > 0.99
    np.testing.assert_array_equal(here.reliability, there.reliability)
    np.testing.assert_array_equal(here.kept, there.kept)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("method", ["usac_magsac", *RULES])
@pytest.mark.parametrize("side", SIDES[:2])
@pytest.mark.parametrize("factor", [1 / 800, 40.0, 1e3])
def test_the_images_may_be_in_different_units(plain, way, method, side, factor):
    """Pixels beside normalised coordinates; the threshold is in the larger unit."""
    T = scaling(factor)
    first, second = (T, np.eye(3)) if side == "first" else (np.eye(3), T)
    errors = []
    for seed in SEEDS:
        X = scene_of(seed)
        X = np.hstack([mapped(X[:, :2], first), mapped(X[:, 2:], second)])
        errors.append(error_of(WAYS[way](X, method, max(factor, 1.0)), seed, first, second))
    assert np.median(errors) < 1.1 * np.median(plain[way, method]) + 0.02


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("method", ["usac_magsac", *RULES])
def test_a_mark_on_both_images_changes_little(plain, way, method):
    """Exact and dense, it has a smaller noise than what is right, which is twice as much."""
    errors = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        scene = two_view_scene(360, inlier_ratio=0.75, noise=0.5, random_state=seed)
        corner = rng.choice([[50, 30], [900, 30], [50, 800], [900, 800]], 140)
        mark = corner + rng.uniform(0, [150, 30], (140, 2))
        X = rng.permutation(np.vstack([scene.X, np.hstack([mark, mark])]))
        errors.append(error_of(WAYS[way](X, method, 1.0), seed))
    assert max(errors) < 5
    assert np.median(errors) < 2.0 * np.median(plain[way, method]) + 0.02


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("method", ["usac_magsac", *RULES])
@pytest.mark.parametrize("side", SIDES[:2])
def test_tracks_that_end_in_one_point_change_little(plain, way, method, side):
    """An F whose epipole is there suits all of them, twice as many as there are right ones."""
    lost = slice(0, 2) if side == "first" else slice(2, 4)
    errors = []
    for seed in SEEDS:
        scene = two_view_scene(500, inlier_ratio=0.3, noise=0.5, random_state=seed)
        X = scene.X.copy()
        X[~scene.inliers, lost] = -1.0
        errors.append(error_of(WAYS[way](X, method, 1.0), seed))
    assert np.median(errors) < 2.0 * np.median(plain[way, method]) + 0.02
