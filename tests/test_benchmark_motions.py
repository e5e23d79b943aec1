"""Rendered pairs written for the real benchmark are read as they were rendered."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest

from benchmarks import motions, rendered
from benchmarks.data import load_pairs


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("name", "least", "most"),
    [("ahead", 0.3, 1.9), ("video", 0.0, 0.4), ("apart", 1.0, 3.5), ("wide", 3.0, 7.5)],
)
def test_cameras_move_as_the_motion_says(name, least, most, seed):
    place, target = np.array([1.0, -6.0, 2.0]), np.array([0.0, 3.0, 1.0])
    rng = np.random.default_rng(seed)
    second, aim = motions._moved(place, target, *motions.MOTIONS[name], rng)
    move = second - place
    assert least < np.linalg.norm(move) < most
    assert np.linalg.norm(aim - target) < 2
    ahead = move @ (target - place) / np.linalg.norm(target - place)
    assert (abs(ahead) > 0.8 * np.linalg.norm(move)) == (name == "ahead")


@pytest.mark.skipif(not find_spec("pyvista"), reason="pyvista is not installed")
def test_a_written_pair_is_read_with_the_truth_of_the_depth_buffer(tmp_path):
    pair = rendered.render_pair("gallery")[0]
    motions._write(tmp_path / "wide__gallery0.npz", pair)
    (read,) = load_pairs(tmp_path)
    assert (read.group, read.name) == ("wide", "wide__gallery0")
    rows = [np.lexsort(X.T) for X in (pair.X, read.X)]
    np.testing.assert_array_equal(pair.X[rows[0]], read.X[rows[1]])
    np.testing.assert_allclose(pair.scores[rows[0]], read.scores[rows[1]], atol=1e-12)
    assert len(read.truth) == motions._TRUTH
    assert read.error(pair.F_gt) < 1e-6
    assert read.pose_error(pair.F_gt) < 0.1


def test_windows_repeat_with_their_period():
    image = rendered.windows(np.random.default_rng(0), 1000).astype(np.float64)

    def alike(shift):
        return np.corrcoef(image[:, shift:].ravel(), image[:, :-shift].ravel())[0, 1]

    assert alike(100) > 0.9
    assert alike(100) > alike(90)
    assert alike(100) > alike(50)


@pytest.mark.skipif(not find_spec("pyvista"), reason="pyvista is not installed")
def test_dense_pairs_have_many_matches_and_no_scores(tmp_path, monkeypatch):
    monkeypatch.setattr(motions, "SCENES", {"gallery": rendered.SCENES["gallery"]})
    motions.write_pairs(tmp_path, repeats=1, dense=True, progress=False)
    pairs = [pair for pair in load_pairs(tmp_path) if "gallery" in pair.name]
    assert [pair.group for pair in pairs] == sorted(motions.MOTIONS)
    assert all(len(pair.X) > 1500 and pair.scores is None for pair in pairs)
