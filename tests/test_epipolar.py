"""Residuals against cv2 and the textbook, least-squares fits against cv2, scipy and known F."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from cv_densityf import _epipolar
from cv_densityf._engine import original
from cv_densityf._epipolar import (
    Frame,
    eight_point,
    essential_ratio,
    inlier_mask,
    middle,
    point_line_squared,
    polish,
    refine,
    residuals,
    sampson_distance,
)
from cv_densityf.datasets import two_view_scene

SEEDS = range(5)


def unit(F):
    """The same matrix with norm 1 and its largest entry positive."""
    F = F / np.linalg.norm(F)
    return F * np.sign(F.flat[np.abs(F).argmax()])


def exact_scene(seed, n=60):
    return two_view_scene(n, inlier_ratio=1.0, noise=0.0, random_state=seed)


def noisy_scene(seed, n=200, inlier_ratio=1.0, noise=0.7):
    return two_view_scene(n, inlier_ratio=inlier_ratio, noise=noise, random_state=seed)


def perturbed(frame, F, seed, size=0.01):
    """A matrix near F, of rank 3, in the frame."""
    G = frame.enter(F[None])
    return G + size * np.random.default_rng(seed).normal(size=(1, 3, 3))


def robust_cost(frame, G, scale):
    """Geman and McClure's, of the Sampson distances in pixels."""
    squared = frame.sampson(G)[0] / scale**2
    return (squared / (1 + squared)).sum()


def singular_values(frame, F):
    """Of F where its entries are of like size: rank is no matter of pixels."""
    return np.linalg.svd(frame.enter(F))[1]


@pytest.mark.parametrize("seed", SEEDS)
def test_sampson_distance_is_cv2s(seed):
    scene = noisy_scene(seed, inlier_ratio=0.5)
    expected = [
        np.sqrt(cv2.sampsonDistance(np.append(p, 1.0), np.append(q, 1.0), scene.F))
        for p, q in zip(scene.points1, scene.points2, strict=True)
    ]
    np.testing.assert_allclose(sampson_distance(scene.F, scene.X), expected, rtol=1e-9)
    np.testing.assert_array_equal(
        residuals(scene.F, scene.X, "usac"), sampson_distance(scene.F, scene.X)
    )


def test_sampson_distance_is_the_way_to_the_nearest_exact_match():
    scene = noisy_scene(0, noise=0.5)
    exact1, exact2 = cv2.correctMatches(scene.F, scene.points1[None], scene.points2[None])
    way = np.linalg.norm(scene.X - np.hstack([exact1[0], exact2[0]]), axis=1)
    np.testing.assert_allclose(sampson_distance(scene.F, scene.X), way, rtol=0.02, atol=1e-4)


@pytest.mark.parametrize("seed", SEEDS)
def test_point_line_distance_is_the_larger_one_to_cv2s_lines(seed):
    scene = noisy_scene(seed, inlier_ratio=0.5)
    points = [p.astype(np.float32).astype(float) for p in (scene.points1, scene.points2)]
    distances = []
    for image in (1, 2):
        lines = cv2.computeCorrespondEpilines(points[image - 1], image, scene.F)[:, 0]
        other = points[2 - image]
        distances.append(
            np.abs(lines[:, 0] * other[:, 0] + lines[:, 1] * other[:, 1] + lines[:, 2])
        )
    expected = np.maximum(*distances)
    for rule in ("ransac", "lmeds"):
        np.testing.assert_allclose(residuals(scene.F, scene.X, rule), expected, atol=1e-6)
    np.testing.assert_allclose(point_line_squared(scene.F, scene.X), expected**2, rtol=1e-4)


def test_residuals_are_in_pixels_and_know_no_scale_of_f():
    """Images four times as large have residuals four times as large."""
    scene = noisy_scene(1)
    grow = np.diag([0.25, 0.25, 1.0])
    for rule in ("usac", "ransac", "lmeds"):
        small = residuals(scene.F, scene.X, rule)
        large = residuals(grow @ scene.F @ grow, 4 * scene.X, rule)
        np.testing.assert_allclose(large, 4 * small, rtol=1e-9)
        np.testing.assert_allclose(residuals(-7 * scene.F, scene.X, rule), small, rtol=1e-9)


def test_lmeds_takes_two_and_a_half_robust_deviations():
    """A threshold from the median residual, which the caller's threshold does not move."""
    between = 0
    for seed in range(20):
        scene = noisy_scene(seed, n=31)
        distance = residuals(scene.F, scene.X, "lmeds")
        large_sample = 2.5 * 1.4826 * np.median(distance)
        cut = (1 + 5 / 24) * large_sample
        between += np.count_nonzero((distance > large_sample) & (distance <= cut))
        for threshold in (0.1, 30.0):
            np.testing.assert_array_equal(
                inlier_mask(scene.F, scene.X, "lmeds", threshold), distance <= cut
            )
    assert between > 0  # or the correction for small samples would not show


@pytest.mark.parametrize("n", [7, 8, 60])
def test_lmeds_of_exact_matches_takes_a_thousandth_of_a_pixel(n):
    """As cv2, whose noise is never less than that; and of seven matches there is no deviation."""
    F = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    X = np.random.default_rng(0).integers(0, 900, (n, 4)).astype(float)
    X[:, 3] = X[:, 1]
    for gap, inside in ((0.0009, True), (0.0011, False), (0.0019, False)):
        X[0, 1], X[0, 3] = 0.0, gap
        mask = inlier_mask(F, X, "lmeds", 3.0)
        assert mask[0] == inside
        assert mask[1:].all()
    X[:, 3] += 1.0
    assert inlier_mask(F, X, "lmeds", 3.0).all() == (n > 7)


def test_a_distance_from_no_line_is_said_without_a_warning():
    X = noisy_scene(0, n=20).X
    infinitely_far = np.diag([0.0, 0.0, 1.0])
    for rule in ("usac", "ransac", "lmeds"):
        assert np.isnan(residuals(np.zeros((3, 3)), X, rule)).all()
        assert np.isinf(residuals(infinitely_far, X, rule)).all()
        assert not inlier_mask(np.zeros((3, 3)), X, rule, 1e9).any()
        assert not inlier_mask(infinitely_far, X, rule, 1e9).any()
    assert (Frame(X).sampson(infinitely_far[None]) > 1e15).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_frame_and_back(seed):
    scene = noisy_scene(seed)
    frame = Frame(scene.X)
    G = frame.enter(np.stack([scene.F, -3 * scene.F.T]))
    np.testing.assert_allclose(np.linalg.norm(G, axis=(1, 2)), 1)
    there = frame.leave(G)
    np.testing.assert_allclose(unit(there[0]), unit(scene.F), atol=1e-12)
    np.testing.assert_allclose(unit(there[1]), unit(-scene.F.T), atol=1e-12)


def test_distances_in_the_frame_are_pixels():
    scene = noisy_scene(0, inlier_ratio=0.5)
    X = scene.X + np.array([300.0, -200.0, 1000.0, 5.0])
    back1 = np.array([[1.0, 0, -300], [0, 1, 200], [0, 0, 1]])
    back2 = np.array([[1.0, 0, -1000], [0, 1, -5], [0, 0, 1]])
    F = back2.T @ scene.F @ back1
    frame = Frame(X)
    np.testing.assert_allclose(
        np.sqrt(frame.sampson(frame.enter(np.stack([F, 2 * F])))),
        np.stack([sampson_distance(F, X)] * 2),
        rtol=1e-6,
    )


@pytest.mark.parametrize("unit", [1.0, 1e-4])
def test_frame_is_centred_with_one_scale_for_both_images(unit):
    X = unit * np.random.default_rng(0).uniform(0, [100, 50, 4000, 3000], (50, 4))
    frame = Frame(X)
    # Where the other image's coordinate is 1.
    Z = np.vstack([frame.products[6:8], frame.products[[2, 5]]])
    np.testing.assert_allclose(Z.mean(axis=1), 0, atol=1e-12)
    assert np.sqrt((Z**2).mean()) == pytest.approx(1)
    np.testing.assert_allclose(Z, (X - X.mean(axis=0)).T * frame.scale, atol=1e-12)


@pytest.mark.parametrize("n", [40, 9000])  # in one part and in several
def test_frame_sums_outer_squares_and_moments(n):
    frame = Frame(np.random.default_rng(n).uniform(0, 900, (n, 4)))
    weights = np.random.default_rng(0).uniform(size=(3, n))
    x, y = frame.products[6:], frame.products[2::3]
    A = np.einsum("in,jn->ijn", y, x).reshape(9, n)
    for w, gram, (first, second) in zip(
        weights, frame.gram(weights), frame.moments(weights), strict=True
    ):
        np.testing.assert_allclose(gram, (A * w) @ A.T, rtol=1e-9, atol=1e-9 * n)
        np.testing.assert_allclose(first, (x * w) @ x.T, rtol=1e-9, atol=1e-9 * n)
        np.testing.assert_allclose(second, (y * w) @ y.T, rtol=1e-9, atol=1e-9 * n)


def test_the_number_of_blas_threads_changes_no_bit():
    scene = noisy_scene(0, n=20_000, inlier_ratio=0.8)
    frame = Frame(scene.X)
    start = perturbed(frame, scene.F, 0, 1e-3)
    with threadpool_limits(1):
        alone = polish(frame, start, [2.0])
    with threadpool_limits(4):
        np.testing.assert_array_equal(polish(frame, start, [2.0]), alone)


def test_frame_of_one_spot_is_finite():
    frame = Frame(np.full((20, 4), 7.0))
    assert np.isfinite(frame.scale)
    assert np.isfinite(frame.leave(frame.enter(np.eye(3)[None]))).all()


def test_middle_is_the_mean_and_the_deviation_about_it():
    X = np.random.default_rng(0).normal([5.0, -40, 300, 2e4], [1.0, 20, 3, 9], (150, 4))
    centre, spread = middle(X)
    np.testing.assert_allclose(centre, X.mean(axis=0), rtol=1e-12)
    assert spread == pytest.approx(np.sqrt(X.var(axis=0).mean()), rel=1e-12)


@pytest.mark.parametrize("column", range(4))
def test_nearly_a_quarter_far_out_in_one_coordinate_does_not_move_the_middle(column):
    X = np.random.default_rng(column).uniform(0, 0.1, (160, 4))
    away = X[:50].copy()
    away[:, column] += 1e9
    expected = middle(X)
    for both in (np.vstack([X, away]), np.vstack([away, X])):
        centre, spread = middle(both)
        np.testing.assert_allclose(centre, expected[0], rtol=1e-12)
        assert spread == pytest.approx(expected[1], rel=1e-12)


@pytest.mark.parametrize(("copies", "jitter"), [(50, 1e-3), (74, 1e-3), (80, 0.0)])
def test_copies_of_one_match_do_not_turn_the_others_out(copies, jitter):
    """Up to three quarters of nearly the same, or any number of exactly the same."""
    rng = np.random.default_rng(copies)
    X = rng.uniform(0, 900, (100, 4))
    X[:copies] = 450 + jitter * rng.normal(size=(copies, 4))
    centre, spread = middle(X)
    np.testing.assert_allclose(centre, X.mean(axis=0), rtol=1e-12)
    assert spread == pytest.approx(np.sqrt(X.var(axis=0).mean()), rel=1e-12)


@pytest.mark.parametrize(("reach", "counts"), [(4.9, True), (5.0, True), (5.1, False)])
def test_far_out_is_more_than_five_times_as_far_as_three_quarters(reach, counts):
    X = np.repeat([[-1.0] * 4, [1.0] * 4, [0.0] * 4], 5, axis=0)
    far = np.diag([reach, 0, 0, 0])[:1]
    anywhere = np.array([1000.0, -2000.0, 0.0, 64.0])
    spread = middle(np.vstack([X, far, -far]) + anywhere)[1]
    assert spread == pytest.approx(np.sqrt((40 + 2 * counts * reach**2) / (60 + 8 * counts)))


def test_a_part_of_a_frame_is_the_frame_of_fewer_matches():
    scene = noisy_scene(0)
    rng = np.random.default_rng(0)
    # Others about the same middle, or the frame of the part alone would be another.
    centre, spread = middle(scene.X)
    others = rng.normal(size=(100, 4))
    others -= others.mean(axis=0)
    others = centre + others * spread / np.sqrt((others**2).mean())
    rows = np.isin(np.arange(300), rng.choice(300, 200, replace=False))
    X = np.empty((300, 4))
    X[rows], X[~rows] = scene.X, others
    whole, alone = Frame(X), Frame(scene.X)
    part = whole.part(np.flatnonzero(rows))
    F = scene.F[None]
    start = perturbed(alone, scene.F, 0, 1e-3)
    for frame in (part, whole):
        np.testing.assert_allclose(frame.enter(F), alone.enter(F), atol=1e-12)
        np.testing.assert_allclose(frame.leave(start), alone.leave(start), rtol=1e-9)
    np.testing.assert_allclose(part.sampson(start), alone.sampson(start), rtol=1e-6)
    polished, expected = polish(part, start, [3.0] * 3), polish(alone, start, [3.0] * 3)
    np.testing.assert_allclose(unit(polished[0]), unit(expected[0]), atol=1e-9)
    assert whole.sampson(start).shape == (1, 300)
    otherwise = polish(whole, start, [3.0] * 3)
    assert np.abs(unit(otherwise[0]) - unit(polished[0])).max() > 1e-5


@pytest.mark.parametrize("k", [8, 9, 30])
def test_eight_point_is_cv2s(k):
    sets = np.stack([noisy_scene(seed, n=k, noise=1.0).X for seed in range(20)])
    sets = sets.astype(np.float32).astype(np.float64)
    for mine, X in zip(eight_point(sets), sets, strict=True):
        theirs, _ = original(X[:, :2], X[:, 2:], cv2.FM_8POINT)
        frame = Frame(X)
        mine, theirs = unit(frame.enter(mine[None])[0]), unit(frame.enter(theirs[None])[0])
        np.testing.assert_allclose(mine, theirs, atol=1e-5)


@pytest.mark.parametrize("k", [8, 20])
def test_eight_point_of_exact_matches_is_exact_and_of_rank_two(k):
    for seed in SEEDS:
        scene = exact_scene(seed, 60)
        rng = np.random.default_rng(seed)
        samples = scene.X[np.stack([rng.choice(60, k, replace=False) for _ in range(4)])]
        F = eight_point(samples)
        np.testing.assert_allclose(np.linalg.norm(F, axis=(1, 2)), 1)
        assert (singular_values(Frame(scene.X), F)[:, 2] < 1e-12).all()
        # A sample on one plane fixes no F; the median one is not.
        assert np.median([sampson_distance(f, scene.X).max() for f in F]) < 1e-4


def test_eight_point_solves_each_set_on_its_own():
    sets = np.stack([noisy_scene(seed, n=12).X for seed in SEEDS])
    alone = np.concatenate([eight_point(one[None]) for one in sets])
    for together, single in zip(eight_point(sets), alone, strict=True):
        np.testing.assert_allclose(unit(together), unit(single), atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_polish_finds_the_exact_f_again(seed):
    scene = exact_scene(seed)
    frame = Frame(scene.X)
    start = perturbed(frame, scene.F, seed, 1e-3)
    G = polish(frame, start, [50.0] * 3 + [5.0] * 20)
    assert np.sqrt(frame.sampson(start)).max() > 0.1
    assert np.sqrt(frame.sampson(G)).max() < 1e-6


@pytest.mark.parametrize("seed", SEEDS)
def test_polished_matrices_have_norm_one_and_soon_rank_two(seed):
    scene = noisy_scene(seed, inlier_ratio=0.5)
    frame = Frame(scene.X)
    start = np.concatenate([perturbed(frame, scene.F, s, 0.05) for s in range(8)])
    assert (np.linalg.svd(start)[1][:, 2] > 1e-3).any()
    for steps, least in ((1, 1e-4), (2, 1e-6), (10, 1e-12)):
        G = polish(frame, start, [2.0] * steps)
        np.testing.assert_allclose(np.linalg.norm(G, axis=(1, 2)), 1)
        assert (np.linalg.svd(G)[1][:, 2] < least).all()
    refined = refine(frame, start[0], 2.0, 1e-3, 1.0, 1)
    np.testing.assert_allclose(np.linalg.norm(refined), 1)
    assert np.linalg.svd(refined)[1][2] < 1e-15


@pytest.mark.parametrize("seed", range(12))
def test_a_step_of_polish_lowers_the_robust_cost(seed):
    scene = noisy_scene(seed, n=300, inlier_ratio=0.4)
    frame = Frame(scene.X)
    G = polish(frame, perturbed(frame, scene.F, seed, 2e-4), [3.0])
    costs = [robust_cost(frame, G, 3.0)]
    for _ in range(8):
        G = polish(frame, G, [3.0])
        costs.append(robust_cost(frame, G, 3.0))
    assert (np.diff(costs) < 1e-9 * costs[0]).all()
    assert costs[-1] <= costs[0]


@pytest.mark.parametrize("strip", [False, True])
@pytest.mark.parametrize("seed", SEEDS)
def test_polish_ends_in_a_minimum_of_the_robust_cost(seed, strip):
    """No matrix of rank 2 near by is better, where the denominators differ from match to match."""
    X = noisy_scene(seed, n=300, inlier_ratio=1.0, noise=0.5).X
    if strip:  # all that is within twenty rows
        rng = np.random.default_rng(seed)
        F = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # moved along the rows
        x, y, move = rng.uniform(0, [1280, 20, 60], (300, 3)).T
        X = np.stack([x, y, x + move, y], axis=1) + rng.normal(0, 0.5, (300, 4))
    else:
        F = noisy_scene(seed).F
    frame = Frame(X)
    G = polish(frame, frame.enter(F[None]), [2.0] * 200)
    least = robust_cost(frame, G, 2.0)
    rng = np.random.default_rng(seed)
    for size in (1e-3, 1e-4, 1e-5):
        U, S, Vt = np.linalg.svd(G[0] + size * rng.normal(size=(40, 3, 3)))
        S[:, 2] = 0
        for near in (U * S[:, None]) @ Vt:
            assert robust_cost(frame, near[None] / np.linalg.norm(near), 2.0) > least * (1 - 1e-9)


def unlikeliness(frame, G, sigma, doubt, noise):
    """Minus the log likelihood of residuals and cameras, in squared noise."""
    density = (1 + frame.sampson(G) / (5 * sigma**2)) ** -3.0
    matches = -np.log(density + doubt).sum(axis=1) * (5 / 3) * sigma**2
    lack = 1 - essential_ratio(G)
    short, foreign = _epipolar._SHORTFALL, _epipolar._FOREIGN
    return matches + (noise * foreign / short) ** 2 * np.log1p((lack / foreign) ** 2)


@pytest.mark.parametrize("seed", SEEDS)
def test_refinement_ends_where_no_matrix_nearby_is_likelier(seed):
    scene = noisy_scene(seed, n=300, inlier_ratio=0.5)
    frame = Frame(scene.X)
    doubt = np.random.default_rng(seed).uniform(0.01, 0.3, 300)
    G = refine(frame, frame.enter(scene.F[None])[0], 0.5, doubt, 0.0, 200)
    assert np.linalg.norm(G) == pytest.approx(1)
    assert np.linalg.svd(G)[1][2] < 1e-14
    least = unlikeliness(frame, G[None], 0.5, doubt, 0.0)
    rng = np.random.default_rng(seed)
    for size in (1e-4, 1e-5):
        U, S, Vt = np.linalg.svd(G + size * rng.normal(size=(40, 3, 3)))
        S[:, 2] = 0
        near = (U * S[:, None]) @ Vt
        near /= np.linalg.norm(near, axis=(1, 2), keepdims=True)
        assert (unlikeliness(frame, near, 0.5, doubt, 0.0) > least - 1e-9 * abs(least)).all()


@pytest.mark.parametrize("seed", range(12))
def test_with_the_cameras_refinement_is_likelier(seed):
    """Few and noisy matches, so that the cameras have a say."""
    scene = noisy_scene(seed, n=40, noise=2.0)
    frame = Frame(scene.X)
    without = refine(frame, frame.enter(scene.F[None])[0], 2.0, 1e-3, 0.0, 30)
    both = refine(frame, without, 2.0, 1e-3, 2.0, 8)
    before, after = unlikeliness(frame, np.stack([without, both]), 2.0, 1e-3, 2.0)
    assert after < before
    ratios = essential_ratio(np.stack([without, both]))
    assert ratios[1] > ratios[0]


def refined_errors(n, noise, doubt, camera_noise, seeds=range(40)):
    """Errors of refinement from the true F; half of the matches are wrong and fill the images."""
    errors = []
    for seed in seeds:
        scene = noisy_scene(seed, n=n, inlier_ratio=0.5, noise=noise)
        frame = Frame(scene.X)
        G = refine(
            frame,
            frame.enter(scene.F[None])[0],
            noise,
            np.where(scene.inliers, *doubt),
            camera_noise,
            4,
        )
        errors.append(sampson_distance(frame.leave(G[None])[0], exact_scene(seed, 300).X).mean())
    return np.log(errors)


@pytest.mark.parametrize(("n", "noise"), [(200, 2.0), (500, 1.0), (2000, 0.5)])
def test_cameras_hardly_move_what_matches_tell(n, noise):
    without, both = (refined_errors(n, noise, (0.02, 0.02), told) for told in (0.0, noise))
    assert np.exp((both - without).mean()) < 1.05


def test_doubtful_matches_hardly_move_refinement():
    trusted, doubted = (
        refined_errors(1000, 1.0, doubt, 0.0) for doubt in ((1e-9, 1e-9), (1e-9, 1e3))
    )
    assert np.exp((doubted - trusted).mean()) < 0.9


@pytest.mark.parametrize("seed", SEEDS)
def test_polish_without_outliers_is_scipys_least_squares(seed):
    """With weights much wider than the noise: the minimum of the squared Sampson distances."""
    scene = noisy_scene(seed, n=80)
    frame = Frame(scene.X)
    start = perturbed(frame, scene.F, seed, 2e-3)
    U, S, Vt = np.linalg.svd(start[0])

    def matrix(p):
        left, right = Rotation.from_rotvec([p[:3], p[3:6]]).as_matrix()
        return U @ left @ np.diag([S[0], S[1] * (1 + p[6]), 0]) @ right @ Vt

    best = least_squares(
        lambda p: sampson_distance(frame.leave(matrix(p)[None])[0], scene.X),
        np.zeros(7),
        xtol=1e-12,
        ftol=1e-12,
    )
    G = polish(frame, start, [1e3] * 15)
    assert frame.sampson(G).sum() == pytest.approx(2 * best.cost, rel=1e-3)
    assert frame.sampson(start).sum() > 2.5 * best.cost


@pytest.mark.parametrize("seed", SEEDS)
def test_polish_follows_when_the_images_are_moved_turned_and_scaled(seed):
    """Sampson distances do not change when an image is moved or turned, and scale with it."""
    scene = noisy_scene(seed, n=150, inlier_ratio=0.6)
    rng = np.random.default_rng(seed)
    scale = 2.5
    moved, maps = [], []
    for points in (scene.points1, scene.points2):
        a, shift = rng.uniform(0, 2 * np.pi), rng.uniform(-900, 900, 2)
        turn = scale * np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        moved.append(points @ turn.T + shift)
        H = np.eye(3)
        H[:2, :2], H[:2, 2] = turn, shift
        maps.append(np.linalg.inv(H))
    X = np.hstack(moved)
    here, there = Frame(scene.X), Frame(X)
    start = polish(here, perturbed(here, scene.F, seed, 1e-3), [20.0])
    F = here.leave(polish(here, start, [3.0, 2.0, 1.0]))[0]
    start_there = there.enter(maps[1].T @ here.leave(start) @ maps[0])
    F_there = there.leave(polish(there, start_there, [scale * s for s in (3.0, 2.0, 1.0)]))[0]
    np.testing.assert_allclose(
        sampson_distance(F_there, X), scale * sampson_distance(F, scene.X), rtol=1e-5, atol=1e-7
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_polish_of_the_swapped_images_is_the_transpose(seed):
    scene = noisy_scene(seed, inlier_ratio=0.6)
    here, there = Frame(scene.X), Frame(scene.X[:, [2, 3, 0, 1]])
    start = perturbed(here, scene.F, seed, 1e-3)
    scales = [5.0, 3.0, 1.0, 1.0]
    G = polish(here, start, scales)[0]
    swapped = polish(there, start.transpose(0, 2, 1), scales)[0]
    np.testing.assert_allclose(unit(swapped.T), unit(G), atol=1e-9)


def test_polish_takes_each_matrix_alone():
    scene = noisy_scene(0, inlier_ratio=0.5)
    frame = Frame(scene.X)
    starts = np.concatenate([perturbed(frame, scene.F, s, 1e-3) for s in range(4)])
    together = polish(frame, starts, [2.0, 1.0])
    for start, G in zip(starts, together, strict=True):
        alone = polish(frame, start[None], [2.0, 1.0])[0]
        np.testing.assert_allclose(unit(G), unit(alone), atol=1e-10)


def test_the_first_step_of_polish_may_be_on_samples():
    """As it would be if there were no other matches; the second is on all."""
    scene = noisy_scene(0, inlier_ratio=0.5)
    frame = Frame(scene.X)
    start = perturbed(frame, scene.F, 0, 1e-3)
    rng = np.random.default_rng(0)
    samples = rng.random((4, len(scene.X))) < 0.1
    first = polish(frame, start, [np.inf], samples=samples)
    second = polish(frame, start, [np.inf, 2.0], samples=samples)
    on_all = polish(frame, first, [2.0])
    for i, sample in enumerate(samples):
        part = frame.part(np.flatnonzero(sample))
        alone = polish(part, start, [np.inf])
        np.testing.assert_allclose(unit(first[i]), unit(alone[0]), atol=1e-9)
        way = np.linalg.norm(unit(on_all[i]) - unit(polish(part, alone, [2.0])[0]))
        # In between the matrix comes nearer to rank 2 once more.
        assert np.linalg.norm(unit(second[i]) - unit(on_all[i])) < 0.05 * way


def test_polish_stays_where_nothing_tells_it_to_go():
    """Of one spot no matrix is better; and a match at both epipoles tells nothing."""
    start = np.diag([1.0, 1.0, 0.0])[None] / np.sqrt(2)
    G = polish(Frame(np.full((20, 4), 7.0)), start, [1.0, 2.0])
    np.testing.assert_allclose(G @ G.transpose(0, 2, 1), start @ start, atol=1e-12)
    X = np.array([[0, 0, 0, 0], [1, 0, 2, 0], [-1, 0, -2, 0], [0, 3, 0, 4], [0, -3, 0, -4.0]])
    forward = np.array([[[0.0, -1, 0], [1, 0, 0], [0, 0, 0]]])
    frame = Frame(X)
    np.testing.assert_array_equal(frame.sampson(frame.enter(forward)), np.zeros((1, 5)))
    G = polish(frame, frame.enter(forward), [1.0])
    np.testing.assert_allclose(unit(G[0]), unit(forward[0]), atol=1e-12)


def test_a_step_of_polish_is_never_long():
    """Six angles of rotation and one of the singular values: half a radian in all."""
    frame = Frame(noisy_scene(0, n=30, inlier_ratio=0.3).X)
    start = random_rank_two(np.random.default_rng(0), 500)
    before = polish(frame, start, [])
    way = np.linalg.norm(polish(frame, start, [1e4]) - before, axis=(1, 2))
    # A rotation by a small angle on either side moves a matrix of norm 1 by no more than that.
    assert way.max() < 0.5
    assert np.quantile(way, 0.5) > 0.2


def test_wrong_matches_hardly_move_polish():
    """A third of wrong matches, far from their lines, changes less than the noise does."""
    for seed in SEEDS:
        scene = noisy_scene(seed, n=300, inlier_ratio=0.7)
        true = exact_scene(seed, 300).X
        right, whole = Frame(scene.X[scene.inliers]), Frame(scene.X)
        start = whole.leave(perturbed(whole, scene.F, seed, 1e-4))
        scales = [4.0, 2.0, 2.0, 2.0, 2.0]
        alone = right.leave(polish(right, right.enter(start), scales))[0]
        among = whole.leave(polish(whole, whole.enter(start), scales))[0]
        error = [sampson_distance(F, true).mean() for F in (alone, among)]
        assert error[1] < error[0] + 0.35
        flat = whole.leave(polish(whole, whole.enter(start), [1e4] * 5))[0]
        assert sampson_distance(flat, true).mean() > 3 * error[1]


def random_rank_two(rng, count):
    U, S, Vt = np.linalg.svd(rng.normal(size=(count, 3, 3)))
    S[:, 2] = 0
    return (U * S[:, None]) @ Vt


def test_essential_ratio_is_the_best_ratio_of_singular_values_over_focal_lengths():
    zoom = np.diag([1 / 640, 1 / 640, 1])
    F = zoom @ random_rank_two(np.random.default_rng(0), 50) @ zoom
    focal = 640 * np.geomspace(0.5, 4, 16)
    expected = np.zeros(50)
    for f1, f2 in itertools.product(focal, focal):
        K1, K2 = np.diag([f1, f1, 1]), np.diag([f2, f2, 1])
        S = np.linalg.svd(K2.T @ F @ K1, compute_uv=False)
        expected = np.maximum(expected, S[:, 1] / S[:, 0])
    np.testing.assert_allclose(essential_ratio(F, 640.0), expected, rtol=1e-9)


def two_cameras(rng, f1, f2):
    """F of cameras with these focal lengths, in pixels from the middle of the images."""
    R = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    E = np.cross(rng.normal(size=3), R, axisb=0, axisc=0)
    return np.diag([1 / f2, 1 / f2, 1]) @ E @ np.diag([1 / f1, 1 / f1, 1])


@pytest.mark.parametrize("size", [1.0, 2000.0])
def test_essential_ratio_is_one_for_two_cameras_and_doubts_chance(size):
    rng = np.random.default_rng(1)
    listed = size * np.geomspace(0.5, 4, 16)
    F = np.stack([two_cameras(rng, *pair) for pair in itertools.product(listed, listed)])
    np.testing.assert_allclose(essential_ratio(F, size), 1, atol=1e-6)
    between = size * rng.uniform(0.5, 4, (300, 2))
    F = np.stack([two_cameras(rng, *pair) for pair in between])
    real = essential_ratio(F, size)
    assert real.min() > 0.9
    assert np.median(real) > 0.95
    zoom = np.diag([1 / size, 1 / size, 1])
    wrong = zoom @ random_rank_two(rng, 300) @ zoom
    chance = essential_ratio(wrong, size)
    assert np.median(chance) < 0.85
    # Neither the order of the images, nor the scale and the sign of F, nor the unit matters.
    for same in (
        essential_ratio(wrong.transpose(0, 2, 1), size),
        essential_ratio(-1e-9 * wrong, size),
        essential_ratio(np.diag([0.01, 0.01, 1]) @ wrong @ np.diag([0.01, 0.01, 1]), 100 * size),
    ):
        np.testing.assert_allclose(same, chance, rtol=1e-6)


def test_essential_ratio_knows_the_size_of_the_image_in_a_frame():
    """That of a square evenly covered with matches."""
    rng = np.random.default_rng(2)
    frame = Frame(rng.uniform(-400, 400, (20_000, 4)))
    F = np.stack([two_cameras(rng, *pair) for pair in rng.uniform(100, 9000, (200, 2))])
    in_frame = essential_ratio(frame.enter(F))
    np.testing.assert_allclose(in_frame, essential_ratio(F, 800.0), atol=0.02)
    assert in_frame.max() - in_frame.min() > 0.3
