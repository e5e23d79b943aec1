from __future__ import annotations

import cv2
import numpy as np
import pytest

from cv_densityf import datasets
from cv_densityf._epipolar import sampson_distance
from cv_densityf.datasets import ImagePair, motorcycle, two_view_scene
from cv_densityf.matching import Matches


class TestTwoViewScene:
    @pytest.mark.parametrize("seed", range(5))
    def test_true_matches_fit_F_exactly_without_noise(self, seed):
        scene = two_view_scene(300, inlier_ratio=0.5, noise=0, random_state=seed)
        assert sampson_distance(scene.F, scene.X[scene.inliers]).max() < 1e-6
        assert np.median(sampson_distance(scene.F, scene.X[~scene.inliers])) > 20

    @pytest.mark.parametrize("seed", range(5))
    def test_F_is_a_fundamental_matrix(self, seed):
        singular = np.linalg.svd(two_view_scene(10, random_state=seed).F, compute_uv=False)
        assert singular[2] < 1e-12 * singular[0]
        assert np.linalg.norm(singular) == pytest.approx(1)

    @pytest.mark.parametrize("noise", [0.3, 2.0])
    def test_noise_is_in_pixels(self, noise):
        # To first order the signed Sampson distance has the noise's own standard deviation.
        scene = two_view_scene(4000, inlier_ratio=1, noise=noise)
        rms = np.sqrt(np.mean(sampson_distance(scene.F, scene.X) ** 2))
        assert rms == pytest.approx(noise, rel=0.1)

    @pytest.mark.parametrize("seed", range(5))
    def test_no_plane_explains_it(self, seed):
        scene = two_view_scene(1000, inlier_ratio=1, noise=0.1, random_state=seed)
        _, mask = cv2.findHomography(scene.points1, scene.points2, cv2.RANSAC, 2.0)
        assert mask.mean() < 0.8

    def test_true_matches_crowd_together(self):
        scene = two_view_scene(1000, inlier_ratio=0.5)
        true, wrong = scene.X[scene.inliers], scene.X[~scene.inliers]

        def nearest(X):
            distance = np.linalg.norm(X[:, None] - X, axis=2)
            return np.median(np.partition(distance, 5, axis=1)[:, 5])

        assert nearest(true) < 0.5 * nearest(wrong)

    @pytest.mark.parametrize(
        ("n", "ratio", "true"), [(0, 0.5, 0), (1, 1, 1), (10, 0, 0), (101, 0.2, 20)]
    )
    def test_counts(self, n, ratio, true):
        scene = two_view_scene(n, inlier_ratio=ratio)
        assert scene.X.shape == (n, 4)
        assert scene.inliers.sum() == true

    def test_within_the_images(self):
        scene = two_view_scene(1000, noise=0)
        assert scene.X.min() >= 0
        assert (np.tile(scene.size, 2) >= scene.X).all()

    def test_rows_are_shuffled(self):
        inliers = two_view_scene(1000, inlier_ratio=0.5).inliers
        assert 200 < inliers[:500].sum() < 300

    def test_seed_decides(self):
        np.testing.assert_array_equal(two_view_scene(50).X, two_view_scene(50).X)
        assert not np.array_equal(two_view_scene(50).F, two_view_scene(50, random_state=1).F)

    @pytest.mark.parametrize(
        ("name", "value"),
        [("n", -1), ("inlier_ratio", 1.5), ("inlier_ratio", float("nan")), ("noise", -1.0)],
    )
    def test_options_out_of_range(self, name, value):
        with pytest.raises(ValueError, match=name):
            two_view_scene(**{"n": 10, name: value})


@pytest.fixture(scope="module")
def pair():
    return motorcycle()


class TestMotorcycle:
    def test_correspondences_fit_F(self, pair):
        X = np.hstack([pair.points1, pair.points2])
        assert len(X) > 10_000
        assert sampson_distance(pair.F, X).max() < 1e-9
        assert pair.error(pair.F) < 1e-9

    def test_correspondences_show_the_same(self, pair):
        grey1, grey2 = (
            cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), (5, 5), 1).astype(float)
            for image in (pair.image1, pair.image2)
        )
        values = [
            grey[tuple(points.round().astype(int).T[::-1])]
            for grey, points in ((grey1, pair.points1), (grey2, pair.points2))
        ]
        assert np.corrcoef(values)[0, 1] > 0.9

    def test_second_image_is_not_rectified(self, pair):
        # Rectified, epipolar lines would be rows and their epipole at infinity.
        assert np.linalg.svd(pair.F, compute_uv=False)[2] < 1e-12
        epipole = np.linalg.svd(pair.F.T)[2][2]
        assert abs(epipole[2]) > 1e-6
        lines = np.hstack([pair.points1, np.ones((len(pair.points1), 1))]) @ pair.F.T
        slopes = np.rad2deg(np.arctan(-lines[:, 0] / lines[:, 1]))
        assert np.abs(slopes).min() > 5
        assert np.ptp(slopes) > 1

    def test_no_matrix_is_infinitely_wrong(self, pair):
        assert pair.error(None) == np.inf

    def test_error_is_in_pixels(self):
        # F of a rectified pair compares rows; these are 3 px apart in every match.
        F = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
        points = np.random.default_rng(0).uniform(0, 100, (20, 2))
        image = np.zeros((1, 1, 3), np.uint8)
        moved = points + np.array([7, 3])
        rectified = ImagePair(image, image, F, points, moved)
        assert rectified.error(5 * F) == pytest.approx(3)

    def test_without_scikit_image(self, monkeypatch):
        monkeypatch.setattr(datasets, "find_spec", lambda name: None)
        with pytest.raises(ImportError, match="pip install scikit-image"):
            motorcycle()

    def test_without_its_images(self, monkeypatch, tmp_path):
        monkeypatch.setattr(datasets, "_skimage_data", lambda: tmp_path)
        with pytest.raises(FileNotFoundError, match="reinstall scikit-image"):
            motorcycle()


def test_the_console_shows_what_it_is_and_not_all_of_it():
    scene = two_view_scene(200, inlier_ratio=0.4)
    assert repr(scene) == "<Scene: 200 matches, 80 of them right>"
    black, grey = np.zeros((60, 80, 3), np.uint8), np.zeros((30, 40, 3), np.uint8)
    pair = ImagePair(black, grey, scene.F, scene.points1, scene.points2)
    assert repr(pair) == "<ImagePair: 80 x 60 and 40 x 30 pixels>"
    matches = Matches(scene.points1, scene.points2, np.ones(200), (80, 60), (40, 30))
    assert repr(matches) == "<Matches: 200 of 80 x 60 and 40 x 30 pixels>"
