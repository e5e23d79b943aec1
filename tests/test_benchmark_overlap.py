"""The benchmark of overlapping images takes pairs of one scene and of two for what they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import overlap, paper
from benchmarks.overlap import Found
from benchmarks.report import fill
from benchmarks.scenes import make_scene
from cv_densityf.datasets import motorcycle

TITLES = [f"Threshold {threshold:g} px" for threshold in overlap.THRESHOLDS]


@pytest.fixture(scope="module")
def report():
    """Of two scenes: the motorcycle, and its mirror image, which SIFT takes for something else."""
    images = motorcycle()
    mirror = np.diag([-1.0, 1.0, 1.0])
    mirror[0, 2] = images.image1.shape[1] - 1
    # cv2's images have to be contiguous.
    turned = [np.ascontiguousarray(i[:, ::-1]) for i in (images.image1, images.image2)]
    points = [p * (-1, 1) + (mirror[0, 2], 0) for p in (images.points1, images.points2)]
    F = mirror.T @ images.F @ mirror
    other = paper._photographed("mirrored", *turned, F, np.hstack(points))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(overlap, "real_pairs", lambda data: [paper.motorcycle(), other])
        patch.setattr(overlap, "rendered_pairs", list)
        return overlap.overlap()


@pytest.mark.parametrize("title", TITLES)
@pytest.mark.parametrize("cut", paper.CUTS)
def test_all_pairs_of_one_scene_are_found_and_coherent(report, title, cut):
    section = report[report.index(f"## {title}") :]
    row = next(line for line in section.splitlines() if line.startswith(f"| {cut} |"))
    one, two, coherent = (cell.strip() for cell in row.split("|")[2:5])
    assert (one, coherent) == ("2 of 2", "2")
    assert two.endswith(" of 2")


def test_the_report_fills_its_page(report, tmp_path):
    page = tmp_path / "page.md"
    page.write_text("".join(f"<!-- table: {t} -->\n\n| old |\n| --- |\n\n" for t in TITLES))
    fill(page, report)
    assert "| old |" not in page.read_text()


def test_wrong_estimates_of_known_pairs_do_not_count():
    pair = make_scene("clusters", 200, 0.6, 0.5)
    assert overlap.look(pair.X, 1.0, pair) == overlap.look(pair.X, 1.0)
    elsewhere = replace(pair, truth=np.random.default_rng(0).uniform(0, 900, (50, 4)))
    assert overlap.look(pair.X, 1.0, elsewhere) is None


def test_cells_count_pairs_with_enough_inliers():
    one = [Found(0.9, 100), Found(0.6, 30), Found(0.1, 20), Found(0.9, 14)]
    two = [Found(0.2, 15), Found(0.3, 25), Found(0.5, 10)]
    cells = list(overlap._cells(one, two))
    assert cells[:4] == ["3 of 4", "2 of 3", "2", "0"]
    assert cells[5] == "0.25, 0.29, 0.30"
    # Of the six ways to take one of each, those in which that of one scene has more.
    assert cells[-1] == f"{4 / 6:.3f}, {5 / 6:.3f}"


def test_no_pair_of_two_scenes_leaves_their_cells_empty():
    assert list(overlap._cells([Found(0.9, 100)], []))[1:4:2] == ["0 of 0", "0"]
