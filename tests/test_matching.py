from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from cv_densityf import InputError, matching
from cv_densityf._epipolar import sampson_distance
from cv_densityf.datasets import motorcycle
from cv_densityf.matching import Features, detect, match_features, match_images, read_image


@pytest.fixture(scope="module")
def pair():
    return motorcycle()


@pytest.fixture(scope="module")
def grey(pair):
    return cv2.cvtColor(pair.image1, cv2.COLOR_BGR2GRAY)


def random_features(n, seed, points=None):
    rng = np.random.default_rng(seed)
    descriptors = np.abs(rng.normal(size=(n, 128))).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    points = rng.uniform(0, 100, (n, 2)) if points is None else points
    return Features(points, descriptors, (100, 100))


def same_place(matches, tolerance=1.0):
    """Share of matches that join a place with itself."""
    assert len(matches) > 100
    return np.mean(np.linalg.norm(matches.points1 - matches.points2, axis=1) < tolerance)


class TestOnRealImages:
    def test_most_matches_fit_the_known_geometry(self, pair):
        matches = match_images(pair.image1, pair.image2)
        good = sampson_distance(pair.F, matches.X) < 1
        assert len(matches) > 500
        assert good.mean() > 0.5
        # A chance match would be right with a probability of some hundredths.

    def test_scores_tell_right_from_wrong(self, pair):
        matches = match_images(pair.image1, pair.image2)
        good = sampson_distance(pair.F, matches.X) < 1
        assert matches.scores.min() >= 0
        assert matches.scores.max() <= 1
        better = matches.scores[good][:, None] > matches.scores[~good]
        assert better.mean() > 0.8

    def test_ratio_keeps_what_scores_above_it(self, pair):
        everything = match_images(pair.image1, pair.image2)
        cut = match_images(pair.image1, pair.image2, ratio=0.8)
        expected = everything.X[everything.scores > 1 - 0.8]
        assert 0 < len(cut) < len(everything)
        assert {tuple(row) for row in cut.X} == {tuple(row) for row in expected}

    def test_no_match_is_given_twice(self, pair):
        matches = match_images(pair.image1, pair.image2)
        assert len(np.unique(matches.X, axis=0)) == len(matches)

    def test_points_are_where_the_features_are(self, grey):
        # Turned by 180 degrees, pixel x becomes width - 1 - x; a shift of all points would
        # count twice.
        height, width = grey.shape
        matches = match_images(grey, grey[::-1, ::-1])
        total = matches.points1 + matches.points2
        assert np.abs(np.median(total, axis=0) - (width - 1, height - 1)).max() < 0.05

    def test_sizes_are_width_and_height(self, grey):
        matches = match_images(grey, grey[:300])
        assert matches.size1 == (741, 500)
        assert matches.size2 == (741, 300)


def test_descriptors_are_rootsift(grey):
    # The Hellinger kernel of SIFT histograms is the inner product of RootSIFT's descriptors.
    sift = cv2.SIFT.create(enable_precise_upscale=True)
    _, histograms = sift.detectAndCompute(grey, None)
    histograms = histograms[:50].astype(float)
    histograms /= histograms.sum(axis=1, keepdims=True)
    hellinger = np.sqrt(histograms[:, None] * histograms).sum(axis=2)
    found = detect(grey, max_features=None).descriptors[:50].astype(float)
    np.testing.assert_allclose(found @ found.T, hellinger, atol=1e-5)


class TestLimits:
    def test_max_size_gives_points_in_pixels_of_the_image(self, grey):
        image = grey[:400, :600]
        half = cv2.resize(image, (300, 200), interpolation=cv2.INTER_AREA)
        shrunk, reference = detect(image, max_size=300), detect(half, max_size=None)
        np.testing.assert_allclose(shrunk.points, (reference.points + 0.5) * 2 - 0.5)
        assert shrunk.size == (600, 400)

    def test_max_size_never_enlarges(self, grey):
        np.testing.assert_array_equal(
            detect(grey, max_size=10_000).points, detect(grey, max_size=None).points
        )

    def test_max_features_keeps_about_that_many(self, grey):
        assert len(detect(grey, max_features=None).points) > 1000
        assert 100 <= len(detect(grey, max_features=100).points) <= 110

    @pytest.mark.parametrize("option", ["max_size", "max_features"])
    def test_must_be_positive(self, grey, option):
        with pytest.raises(ValueError, match=option):
            detect(grey, **{option: 0})


class TestKindsOfImages:
    @pytest.mark.parametrize(
        "convert",
        [
            lambda image: image[:, :, None],
            lambda image: np.dstack([image, np.zeros_like(image)]),
            np.asfortranarray,
            lambda image: np.repeat(image, 2, axis=1)[:, ::2],
        ],
        ids=["one channel", "grey and alpha", "Fortran order", "strided"],
    )
    def test_same_pixels_same_features(self, grey, convert):
        expected, found = detect(grey), detect(convert(grey))
        np.testing.assert_array_equal(found.points, expected.points)
        np.testing.assert_array_equal(found.descriptors, expected.descriptors)

    def test_alpha_is_ignored(self, pair):
        alpha = np.random.default_rng(0).integers(0, 255, pair.image1.shape[:2], dtype=np.uint8)
        expected, found = detect(pair.image1), detect(np.dstack([pair.image1, alpha]))
        np.testing.assert_array_equal(found.points, expected.points)

    @pytest.mark.parametrize(
        "convert",
        [
            lambda image: image.astype(np.uint16) * 257,
            lambda image: image.astype(np.uint16) * 16,
            lambda image: image.astype(np.int32) * 1000 - 5000,
            lambda image: image / 255,
            lambda image: (image / 255).astype(np.float16),
            lambda image: image * 1e6 - 1e5,
        ],
        ids=["16 bit", "12 bit", "int32", "float", "half", "float of any range"],
    )
    @pytest.mark.parametrize("colour", [False, True])
    def test_other_depths_match_8_bits(self, pair, grey, convert, colour):
        image = pair.image1 if colour else grey
        assert same_place(match_images(image, convert(image))) > 0.9

    def test_read_only(self, grey):
        image = grey.copy()
        image.flags.writeable = False
        assert len(detect(image).points) > 1000

    def test_not_finite_pixels_do_no_harm(self, grey):
        image = grey / 255
        image[:20, :20] = np.nan
        image[-20:, :20] = np.inf
        image[-20:, -20:] = -np.inf
        assert same_place(match_images(grey, image)) > 0.9

    @pytest.mark.parametrize("value", [0, 1, 255])
    @pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float64, bool])
    def test_nothing_to_see(self, grey, value, dtype):
        matches = match_images(np.full((50, 60), value, dtype=dtype), grey)
        assert len(matches) == 0
        assert matches.X.shape == (0, 4)
        assert matches.scores.shape == (0,)

    def test_a_few_bright_pixels_in_the_dark_are_seen(self):
        image = np.zeros((200, 200), dtype=np.uint8)
        image[90:93, 60:64] = 255  # fewer than one in a thousand
        dark = image.astype(np.uint16) * 50
        expected, found = detect(image), detect(dark)
        assert len(expected.points) > 0
        np.testing.assert_array_equal(found.points, expected.points)

    @pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
    def test_no_number_to_see(self, value):
        assert len(detect(np.full((50, 60), value)).points) == 0

    @pytest.mark.parametrize("shape", [(1, 1), (1, 300), (5, 5, 3)])
    def test_tiny(self, grey, shape):
        assert len(match_images(np.zeros(shape, dtype=np.uint8), grey)) == 0

    @pytest.mark.parametrize("shape", [(), (5,), (0, 5), (5, 5, 0), (5, 5, 5), (1, 5, 5, 3)])
    def test_not_an_images_shape(self, shape):
        with pytest.raises(ValueError, match="must have the shape"):
            detect(np.zeros(shape, dtype=np.uint8))

    @pytest.mark.parametrize(
        "image", [[[0, 1]], "left.png", None, np.zeros((5, 5), complex), np.full((5, 5), "a")]
    )
    def test_not_an_image(self, image):
        with pytest.raises(TypeError, match="an image must"):
            detect(image)


class TestMatchFeatures:
    @pytest.fixture(params=[7, 1024])
    def features(self, request, monkeypatch):
        monkeypatch.setattr(matching, "_CHUNK", request.param)
        return random_features(60, 0), random_features(45, 1)

    def test_against_all_distances(self, features):
        distance = cdist(features[0].descriptors, features[1].descriptors)
        nearest = distance.argmin(axis=1)
        mutual = distance.argmin(axis=0)[nearest] == np.arange(60)
        first, second = np.sort(distance, axis=1)[:, :2].T
        found = match_features(*features)
        np.testing.assert_array_equal(found.points1, features[0].points[mutual])
        np.testing.assert_array_equal(found.points2, features[1].points[nearest[mutual]])
        np.testing.assert_allclose(found.scores, 1 - (first / second)[mutual], atol=1e-4)

    def test_one_way(self, features):
        distance = cdist(features[0].descriptors, features[1].descriptors)
        found = match_features(*features, mutual=False)
        np.testing.assert_array_equal(found.points1, features[0].points)
        np.testing.assert_array_equal(found.points2, features[1].points[distance.argmin(axis=1)])

    def test_swapped_images_swap_the_matches(self, features):
        there, back = match_features(*features), match_features(*features[::-1])
        expected = {tuple(row) for row in there.X}
        assert {tuple(row) for row in back.X[:, [2, 3, 0, 1]]} == expected

    def test_of_equal_rows_the_best_score_stays(self):
        # Two features at each place, as SIFT has it for two orientations.
        features = random_features(20, 0, points=np.repeat(np.arange(20.0).reshape(10, 2), 2, 0))
        noisy = features.descriptors + np.float32(0.05) * random_features(20, 1).descriptors
        noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
        other = Features(features.points, noisy, features.size)
        distance = np.sort(cdist(features.descriptors, other.descriptors), axis=1)
        scores = 1 - distance[:, 0] / distance[:, 1]
        found = match_features(features, other)
        assert len(found) == 10
        np.testing.assert_allclose(found.scores, scores.reshape(10, 2).max(axis=1), atol=1e-4)

    @pytest.mark.parametrize(("n1", "n2"), [(0, 0), (0, 5), (5, 0)])
    def test_nothing_to_match(self, n1, n2):
        assert len(match_features(random_features(n1, 0), random_features(n2, 1))) == 0

    def test_one_candidate_has_no_rival(self):
        found = match_features(random_features(1, 0), random_features(1, 1))
        assert found.scores.tolist() == [1.0]

    def test_exact_copies_are_not_to_be_trusted(self):
        feature = random_features(1, 0)
        twice = Features(
            np.array([[1.0, 2.0], [3.0, 4.0]]), np.repeat(feature.descriptors, 2, 0), (9, 9)
        )
        assert match_features(feature, twice).scores[0] == pytest.approx(0, abs=1e-3)

    @pytest.mark.parametrize("ratio", [0, -1, 1.1, float("nan")])
    def test_ratio_out_of_range(self, ratio):
        with pytest.raises(ValueError, match="ratio"):
            match_features(random_features(5, 0), random_features(5, 1), ratio=ratio)


class TestReadImage:
    @pytest.mark.parametrize(
        ("dtype", "channels", "expected"), [(np.uint8, 1, 2), (np.uint16, 1, 2), (np.uint16, 3, 3)]
    )
    def test_keeps_depth_and_colour(self, tmp_path, dtype, channels, expected):
        image = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (20, 30, channels), dtype)
        path = tmp_path / "Bäume 木.png"
        path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
        found = read_image(path)
        assert found.dtype == dtype
        assert found.ndim == expected
        np.testing.assert_array_equal(found.reshape(image.shape), image)

    def test_drops_alpha(self, tmp_path):
        image = np.random.default_rng(0).integers(0, 255, (20, 30, 4), dtype=np.uint8)
        path = tmp_path / "image.png"
        path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
        np.testing.assert_array_equal(read_image(path), image[:, :, :3])

    @pytest.mark.parametrize("share", [0.3, 0.98, 1])
    def test_a_jpeg_file_without_its_end_is_read_as_far_as_it_goes(self, tmp_path, pair, share):
        content = cv2.imencode(".jpg", pair.image1)[1].tobytes()
        path = tmp_path / "image.jpg"
        path.write_bytes(content[: int(share * len(content))])
        found = read_image(path)
        np.testing.assert_array_equal(found, cv2.imread(str(path)))
        rows = int(0.7 * share * len(found))
        assert np.abs(found[:rows] - pair.image1[:rows].astype(float)).mean() < 5

    @pytest.mark.parametrize("content", [b"", b"hello", b"\x89PNG\r\n\x1a\n", b"\xff\xd8"])
    def test_not_an_image(self, tmp_path, content, capfd):
        path = tmp_path / "image.png"
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"image\.png: not an image"):
            read_image(path)

    @pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes")
    def test_a_pipe(self, tmp_path):
        image = np.random.default_rng(0).integers(0, 255, (20, 30), dtype=np.uint8)
        path = tmp_path / "pipe"
        os.mkfifo(path)
        content = cv2.imencode(".png", image)[1].tobytes()
        with ThreadPoolExecutor(1) as writer:
            writer.submit(path.write_bytes, content)
            np.testing.assert_array_equal(read_image(path), image)

    def test_missing(self, tmp_path):
        with pytest.raises(FileNotFoundError):
            read_image(tmp_path / "image.png")

    def test_folder(self, tmp_path):
        with pytest.raises(OSError, match="directory"):
            read_image(tmp_path)
