"""`inlier_mask` of the F that cv2 returns is the mask that cv2 returns, bit for bit."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from cv_densityf._engine import METHODS, Robust, original
from cv_densityf._epipolar import inlier_mask
from cv_densityf.datasets import two_view_scene

ROBUST = {name: flag for name, flag in METHODS.items() if name not in ("7point", "8point")}


def scenes():
    for seed in range(25):
        rng = np.random.default_rng(seed)
        scene = two_view_scene(
            int(rng.integers(15, 900)),
            inlier_ratio=rng.uniform(0.2, 0.95),
            noise=(0.1, 0.7, 2.0)[seed % 3],
            random_state=seed,
        )
        offset = (0.0, 0.0, 0.0, 1e3, 1e4)[seed % 5]
        X = (scene.X + offset).astype(np.float32).astype(np.float64)
        if seed % 4 == 0:
            X[::11, seed % 3] = np.nan
        yield X, (1.0, 3.0, 0.5, 0.1, 10.0)[seed % 5]


def wrong_flags(X, robust):
    try:
        if robust.params is not None:
            F, mask = original(X[:, :2], X[:, 2:], robust.params)
        else:
            F, mask = original(
                X[:, :2], X[:, 2:], robust.flag, robust.threshold, robust.confidence, 300
            )
    except cv2.error:  # MAGSAC's sampler on few inliers
        return None
    if F is None:
        return None
    mine = inlier_mask(F, X, robust.rule, robust.threshold)
    return int(np.count_nonzero(mine != mask.ravel().astype(bool)))


@pytest.mark.parametrize("name", ROBUST)
def test_equals_cv2s_mask(name):
    if name == "lmeds":
        # The rank of the median among residuals that are not numbers is cv2's secret.
        cases = [(X[np.isfinite(X).all(axis=1)], t) for X, t in scenes()]
    else:
        cases = list(scenes())
    wrong = [wrong_flags(X, Robust(ROBUST[name], t, 0.99, 300)) for X, t in cases]
    compared = [w for w in wrong if w is not None]
    assert len(compared) > 15
    assert sum(compared) == 0


@pytest.mark.parametrize("score", range(4))
def test_equals_cv2s_mask_for_params(score):
    wrong = []
    for X, threshold in scenes():
        params = cv2.UsacParams()
        params.threshold, params.score, params.maxIterations = threshold, score, 300
        wrong.append(wrong_flags(X, Robust(cv2.USAC_DEFAULT, threshold, 0.99, 300, params)))
    compared = [w for w in wrong if w is not None]
    assert len(compared) > 15
    assert sum(compared) == 0


def test_a_residual_on_the_threshold_is_in_for_ransac_and_out_for_usac():
    """The second image is squeezed to 3/4, so that every distance below is exact in binary."""
    rng = np.random.default_rng(0)
    X = rng.integers(0, 256, (200, 4)) * 4.0
    F = np.array([[0.0, 0, 0], [0, 0, 1], [0, -0.75, 0]])
    X[:, 3] = 0.75 * X[:, 1]
    shifted = np.arange(200) >= 150
    ransac = X + np.outer(shifted, [0, 0, 0, 1.5])  # 1.5 from the line, in the first image 2
    assert inlier_mask(F, ransac, "ransac", 2.0).all()
    below = float(np.nextafter(np.float32(2), np.float32(0)))
    np.testing.assert_array_equal(inlier_mask(F, ransac, "ransac", below), ~shifted)
    usac = X + np.outer(shifted, [0, 0, 0, 1.25])  # Sampson: 1.25 / hypot(1, 0.75)
    np.testing.assert_array_equal(inlier_mask(F, usac, "usac", 1.0), ~shifted)
    assert inlier_mask(F, usac, "usac", np.nextafter(1.0, 2.0)).all()


@pytest.mark.parametrize("rule", ["ransac", "lmeds", "usac"])
def test_rows_that_are_not_numbers_are_out(rule):
    X = two_view_scene(100, inlier_ratio=1.0, noise=0.0, random_state=1).X
    F = two_view_scene(100, inlier_ratio=1.0, noise=0.0, random_state=1).F
    X[[3, 7, 50], [0, 1, 3]] = np.nan, np.inf, -np.inf
    mask = inlier_mask(F, X, rule, 1.0)
    assert not mask[[3, 7, 50]].any()
    assert mask.sum() == 97
