"""The measurements of scale measure what they say."""

from __future__ import annotations

import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from benchmarks import scale, sfm
from benchmarks.__main__ import main
from benchmarks.rendered import View
from benchmarks.scenes import make_scene
from cv_densityf import density_peaks

DOCS = Path(__file__).parents[1] / "docs"


def tables(page):
    return [line for line in Path(page).read_text("utf-8").splitlines() if line.startswith("|")]


def test_exponents_of_known_powers():
    series = scale.Series(ms={n: [3e-4 * n**1.5] for n in (1_000, 5_000, 100_000)})
    assert series.exponent == pytest.approx(1.5)
    # Beyond the fitted sizes anything goes.
    series.ms |= {10: [1e9], 1_000_000: [1.0]}
    assert series.exponent == pytest.approx(1.5)
    assert np.isnan(scale.Series(ms={1_000: [1.0]}).exponent)


def test_the_matrix_version_clusters_as_ours():
    X = np.random.default_rng(0).normal(size=(400, 4))
    rho, delta = scale.matrix_density_peaks(X)
    peaks = density_peaks(X)
    # The cut-off is an order statistic of all distances with ours, of the matrix with theirs.
    assert np.corrcoef(rho, peaks.rho)[0, 1] > 0.99
    top = np.argsort(-delta)[:5]
    assert set(top) == set(np.argsort(-peaks.delta)[:5])


def test_tables_hold_every_method_and_size(capsys, tmp_path, monkeypatch):
    # Starts a process per method, which takes its time.
    monkeypatch.setattr(scale, "measure_memory", lambda n, kind: {"density_peaks": 12.0})
    monkeypatch.setattr(scale, "measure_workers", lambda kind: {"two processes": 1.75})
    monkeypatch.setattr(scale, "measure_costs", lambda kind: {"a pair": 0.123})
    monkeypatch.setattr(scale, "STRIDES", (20,))
    monkeypatch.setattr(scale, "RATIOS", (0.3,))
    monkeypatch.setattr(scale._estimate, "MAX_SEARCHED", 400)
    plot, page = tmp_path / "scale.png", shutil.copy(DOCS / "scale.md", tmp_path)
    numbers = ["--n", "1000", "--cluster-n", "300", "600", "--scenes", "1"]
    assert main(["scale", *numbers, "--plot", str(plot), "--page", page]) == 0
    text = capsys.readouterr().out
    assert set(tables(page)) - set(text.splitlines()) <= set(tables(DOCS / "scale.md"))
    assert "| a pair | 0.12 |" in tables(page)
    times = text.split("## Time, ms")[1].split("##")[0]
    for name in (*scale.CALLS, scale.FILTER):
        (row,) = [line for line in times.splitlines() if line.startswith(f"| {name} |")]
        assert float(row.split("|")[2]) > 0
    for title in (f"## Time / {scale.RIVAL}\n", f"## Time / {scale.RIVAL}, no match right\n"):
        section = text.split(title)[1].split("##")[0]
        (rival,) = [line for line in section.splitlines() if line.startswith(f"| {scale.RIVAL} |")]
        assert rival.split("|")[2:-1] == [" 1.0 ", "  "]
    assert "| density_peaks |" in text.split("## Clustering")[1]
    assert "| two processes | 1.75 |" in text
    assert "| a pair | 0.12 |" in text
    title = f"## Clustering, time / {scale.EXACT}"
    (matrix,) = [
        line for line in text.split(title)[1].splitlines() if line.startswith(f"| {scale.MATRIX} |")
    ]
    assert all(float(cell) > 0 for cell in matrix.split("|")[2:4])
    assert plot.stat().st_size > 10_000


def test_a_part_is_held_against_all(monkeypatch):
    monkeypatch.setattr(scale._estimate, "MAX_SEARCHED", 400)
    monkeypatch.setattr(scale, "RATIOS", (0.3, 0.6))
    found = scale.measure_parts([300, 6000], 2, "clusters")
    assert {ratio: list(row) for ratio, row in found.items()} == {0.3: [6000], 0.6: [6000]}
    # A fifteenth of the matches alone measures F worse than all of them do.
    assert all(alone > max(1.3, whole) for row in found.values() for whole, alone in row.values())
    table = scale._parts_table(found)
    assert f"| all vote, 30% inliers | {found[0.3][6000][0]:.2f} |" in table


def test_optical_flow_is_of_the_stereo_pair():
    pytest.importorskip("skimage")
    pair = scale.dense_pair(10)
    rectified = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    assert pair.error(rectified) == 0
    assert len(pair.X) == 75 * 50
    # Most of what is not shuffled is right.
    assert 0.5 < np.mean(np.abs(pair.X[:, 1] - pair.X[:, 3]) < 1) < 0.65
    leftwards = pair.X[:, 0] - pair.X[:, 2]
    assert np.mean(leftwards[np.abs(pair.X[:, 1] - pair.X[:, 3]) < 1] > 0) > 0.9


def test_workers_are_timed_by_the_clock(monkeypatch):
    clock = [0.0]
    runs = []

    def estimate_many(pairs, *, n_jobs, **_):
        runs.append(len(pairs))
        # The first run of all, which starts the workers, is slow and does not count.
        clock[0] += 100.0 if len(runs) <= 3 else 3.0 / n_jobs
        return []

    monkeypatch.setattr(scale, "time", SimpleNamespace(perf_counter=lambda: clock[0]))
    monkeypatch.setattr(scale, "estimate_many", estimate_many)
    found = scale.measure_workers("clusters")
    assert set(runs) == {scale.N_PAIRS}
    assert found == pytest.approx({"two processes": 2, "two threads": 2})


def test_costs_are_multiples_of_a_pairs(monkeypatch):
    clock = [0.0]

    def takes(seconds, result=None):
        clock[0] += seconds
        return result

    photographs = SimpleNamespace(X=np.zeros((7, 4)))
    monkeypatch.setattr(scale, "time", SimpleNamespace(process_time=lambda: clock[0]))
    monkeypatch.setattr(scale, "estimate_fundamental", lambda one, two: takes(2 * len(one)))
    monkeypatch.setattr(scale, "estimate_many", lambda pairs, **_: takes(50 * len(pairs), []))
    monkeypatch.setattr(scale, "match_images", lambda *images: takes(9000, photographs))
    assert list(scale.measure_costs("clusters").values()) == [0.5, 1, 10, 0.025, 4.5]


def test_times_that_were_not_run_are_extrapolated_in_brackets_or_left_out():
    series = {
        scale.EXACT: scale.Series({1_000: [10.0], 4_000: [100.0], 20_000: [500.0]}),
        scale.MATRIX: scale.Series({1_000: [30.0], 4_000: [400.0]}),
    }
    table = scale._times(series, [1_000, 4_000, 20_000, 40_000], scale.EXACT)
    exact, matrix = ([c.strip() for c in row.split("|")[2:6]] for row in table.splitlines()[2:])
    assert exact == ["1.0", "1.0", "1.0", ""]
    assert matrix == ["3.0", "4.0", "(20)", ""]
    assert "| 30.0 | 400.0 | (10000.0) | (40000.0) |" in scale._times(
        series, [1_000, 4_000, 20_000, 40_000]
    )


def test_sampled_densities_are_measured_beside_exact_ones(monkeypatch):
    monkeypatch.setattr(scale, "SAMPLE_SIZE", 500)
    found = scale.measure_clustering([300, 600], 1, "clusters")
    assert list(found["density_peaks"].ms) == [300, 600]
    assert list(found[scale.SAMPLED].ms) == list(found[scale.SAMPLED].errors) == [600]
    assert 0 < found[scale.SAMPLED].error(600) < 0.5


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_peak_memory_sees_what_is_allocated_and_freed(tmp_path):
    """In a process of its own, as the benchmark does: others leave memory that is used again."""
    path = tmp_path / "X.npy"
    np.save(path, np.zeros((1000, 4)))
    program = f"""
import numpy as np
from benchmarks import scale

def hungry(X, sample_size):
    np.ones((len(X), 12_500)).sum()  # 100 MB for the 1,000 rows

scale.density_peaks = hungry
print(scale._peak("density_peaks", {str(path)!r}))
"""
    done = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True, cwd=DOCS.parent
    )
    assert float(done.stdout) == pytest.approx(95.4, abs=8)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_million_matches_are_answered_in_bounded_memory(tmp_path):
    pair = make_scene("clusters", 1_000_000, scale.INLIER_RATIO, scale.NOISE)
    path = tmp_path / "X.npy"
    np.save(path, pair.X)
    assert scale._peak("ours:USAC_MAGSAC", str(path)) < 300
    assert pair.error(scale.METHODS["ours:USAC_MAGSAC"].estimate(pair, scale.Settings())) < 0.1


def test_nothing_to_measure_is_refused(capsys):
    assert main(["scale", "--n", "1"]) == 2
    assert "start at 2" in capsys.readouterr().err


def test_the_page_holds_what_the_mapper_made(tmp_path, monkeypatch, capsys):
    models = {
        "pycolmap": sfm.Model(66, 900, 12, 70, 0.5, 0.25, 4.0),
        "cv-densityf": sfm.Model(65, 800, 11, 60, np.inf, 0.125, 1.0),
    }
    monkeypatch.setattr(sfm, "compare", lambda *arguments: models)
    mixtures = {"pycolmap": sfm.Mixture(132, 99, 4.0), "cv-densityf": sfm.Mixture(131, 7, 1.0)}
    monkeypatch.setattr(sfm, "mix", lambda *arguments: mixtures)
    page = shutil.copy(DOCS / "sfm.md", tmp_path)
    assert sfm.main(["--scenes", "table", "city", "columns", "--page", page]) == 0
    assert "| no ratio test | cv-densityf | 131 | 7 | 0.25 |" in tables(page)
    row = "| columns | ratio 0.8 | cv-densityf | 65 | 800 | 11 | 60 | inf | 0.125 | 0.25 |"
    assert row in tables(page)
    assert row in capsys.readouterr().out
    assert not any(line.startswith("| gallery") for line in tables(page))
    assert any(line.startswith("| `--resume`") for line in tables(page))


def test_pairs_of_two_scenes_are_told_by_the_images_names(tmp_path, monkeypatch):
    """Whatever their numbers in the database."""

    def match_views(views, folder, ratio):
        assert views == list("abcdefghijkl" * 2)
        with closing(sqlite3.connect(tmp_path / "matched.db")) as connection:
            connection.execute("CREATE TABLE images (image_id, name)")
            connection.execute("CREATE TABLE two_view_geometries (pair_id, rows)")
            names = [(100 - i, f"{i:02d}.png") for i in range(24)]
            connection.executemany("INSERT INTO images VALUES (?, ?)", names)
            connection.commit()
        return tmp_path / "matched.db"

    def verify(path):
        pairs = [(0, 11, 20), (12, 13, 15), (3, 14, 16), (11, 12, 0)]
        geometries = [((100 - j) * (2**31 - 1) + 100 - i, rows) for i, j, rows in pairs]
        with closing(sqlite3.connect(path)) as connection:
            connection.executemany("INSERT INTO two_view_geometries VALUES (?, ?)", geometries)
            connection.commit()

    monkeypatch.setattr(sfm, "render_views", lambda name: list("abcdefghijkl"))
    monkeypatch.setattr(sfm, "match_views", match_views)
    monkeypatch.setattr(sfm, "verifiers", lambda seed: {"ours": verify})
    found = sfm.mix(["table", "city"], 1.0, tmp_path)["ours"]
    assert (found.right, found.wrong) == (2, 1)


class _Pose:
    def __init__(self, R, t):
        self.translation = t
        self.rotation = self
        self._R = R

    def matrix(self):
        return self._R


class _Image:
    def __init__(self, name, R, t):
        self.name = name
        self.cam_from_world = lambda: _Pose(R, t)


class _Model:
    def __init__(self, images):
        self.images = dict(enumerate(images))


def test_pose_errors_do_not_depend_on_the_world_but_on_the_poses():
    rng = np.random.default_rng(1)
    views = []
    for _ in range(7):
        R = cv2.Rodrigues(rng.normal(size=3))[0]
        views.append(View(np.zeros(0, np.uint8), np.zeros(0), R, rng.normal(size=3)))
    turn, scale_, shift = cv2.Rodrigues(rng.normal(size=3))[0], 2.5, rng.normal(size=3)

    def image(i, extra=None):
        # world' = scale * turn @ world + shift
        R = (np.eye(3) if extra is None else extra) @ views[i].R @ turn.T
        centre = scale_ * turn @ (-views[i].R.T @ views[i].t) + shift
        return _Image(f"{i:02d}.png", R, -R @ centre)

    exact = sfm.pose_errors(_Model([image(i) for i in range(7)]), views)
    assert exact == pytest.approx((0, 0), abs=1e-4)
    tilt = cv2.Rodrigues(np.deg2rad([0.0, 3.0, 0.0]))[0]
    position, rotation = sfm.pose_errors(_Model([image(i, tilt) for i in range(7)]), views)
    assert position == pytest.approx(0, abs=1e-4)
    assert rotation == pytest.approx(3, abs=1e-4)
    few = sfm.pose_errors(_Model([image(i) for i in range(3)]), views)
    assert few == (np.inf, np.inf)
