from __future__ import annotations

import json
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks import paper, rendered
from benchmarks.__main__ import main
from benchmarks.metrics import sampson_distance
from benchmarks.scenes import make_scene

PAGE = Path(__file__).parents[1] / "docs" / "paper.md"
needs_renderer = pytest.mark.skipif(not find_spec("pyvista"), reason="pyvista is not installed")


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    folder = tmp_path_factory.mktemp("paper")
    page = shutil.copy(PAGE, folder)
    assert main(["paper", "--quick", "--out", str(folder / "out"), "--page", page]) == 0
    return folder / "out"


def tables(text):
    """Turn the report into {title: (header, rows)}."""
    found = {}
    for section in text.split("\n## ")[1:]:
        lines = [line[2:-2].split(" | ") for line in section.splitlines() if line.startswith("|")]
        found[section.splitlines()[0]] = (lines[0], lines[2:])
    return found


def test_quick_tables_are_complete_and_finite(quick):
    found = tables((quick / "paper.md").read_text())
    for cut in paper.CUTS:
        n_thresholds = len(paper.TABLE_1)
        counts = {
            f"Table 1: thresholds, real pairs, {cut}": n_thresholds * len(paper.SEARCHES),
            f"Table 2: other methods, real pairs, th 2.2 px, {cut}": len(paper.METHODS) - 1,
            f"Table 3: synthetic pairs, th 2.2 px, alpha 0.011, {cut}": len(paper.METHODS),
        }
        for title, n in counts.items():
            header, rows = found[title]
            assert len(rows) == n
            assert all(len(row) == len(header) for row in rows)
            for row in rows:
                for name, cell in zip(header, row, strict=True):
                    if "px" in name or "ms" in name:
                        assert np.isfinite(float(cell.split()[0])), (title, row)
    records = json.loads((quick / "paper.json").read_text(), parse_constant=pytest.fail)
    assert {r["method"] for r in records} == set(paper.METHODS)
    # A high alpha keeps fewer matches than an F takes: the rule fails there.
    solvable = [r for r in records if r["drawn_from"] >= 8]
    assert len(solvable) > 0.9 * len(records)
    assert all(r[name] is not None for r in solvable for name in ("ms", "own", "truth", "zhang"))


def test_headline_holds_the_paper_s_ratios(quick):
    found = tables((quick / "paper.md").read_text())
    for title, (header, rows) in found.items():
        if title.startswith("Headline"):
            assert header[1] == "paper's"
            assert [row[1].strip() for row in rows] == ["0.14", "0.93", "", "0.81"]


def test_quick_draws_every_picture_as_wide_as_a_page(quick):
    names = {"alpha", "real-decision", "real-matches", "synthetic-decision", "synthetic-matches"}
    for name in names:
        image = cv2.imread(str(quick / f"paper-{name}.png"))
        assert image is not None
        assert image.std() > 5
        assert image.shape[1] == 1000
        copy = quick.parent / "images" / f"paper-{name}.png"
        assert copy.read_bytes() == (quick / f"paper-{name}.png").read_bytes()


def test_the_page_holds_the_tables_of_the_report_and_its_own_words(quick):
    def words(text):
        return [line for line in text.splitlines() if not line.startswith("|")]

    page = (quick.parent / PAGE.name).read_text("utf-8")
    # Only the summary at the top, and what it says, are written by hand.
    assert words(page) == words(PAGE.read_text("utf-8"))
    report = set((quick / "paper.md").read_text("utf-8").splitlines())
    own = [line for line in page.splitlines() if line.startswith("|") and line not in report]
    assert own[0] == "| the paper says | we find |"
    assert all(line.count("|") == 3 for line in own)


def test_draws_are_as_large_as_the_paper_s_and_differ(quick):
    pair = make_scene("clusters", 800, 0.5, 0.5)
    first, again, other = (paper.draw(pair.X, seed) for seed in (0, 0, 1))
    assert first.shape == (paper.N_PAPER, 4)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    assert len(paper.draw(pair.X[:200], 0)) == 200


def test_cuts_thin_out_the_matches():
    views = paper.motorcycle()
    one_way, mutual, best = (views.matches(cut) for cut in paper.CUTS)
    assert set(map(tuple, best)) == set(map(tuple, views.pair.X[views.pair.scores > 0.2]))
    for fewer, more in ((best, mutual), (mutual, one_way)):
        assert set(map(tuple, fewer)) < set(map(tuple, more))


def trial(method, cut, seed, threshold, ms):
    return paper.Trial(
        "real", cut, "pair", method, seed, 100, threshold, 0.0, ms, own=0.1, truth=0.1, zhang=0.1,
        inliers=40, drawn_from=100,
    )  # fmt: skip


def test_the_growth_of_ransacs_time_is_over_that_at_the_largest_threshold():
    trials = [
        trial(method, cut, 0, threshold, factor * 10 / threshold**power)
        for power, cut in enumerate(paper.CUTS)
        for threshold, *_ in paper.TABLE_1
        for method, factor in (("RANSAC", 1.0), ("USAC_MAGSAC", threshold))
    ]
    (found,) = tables("\n" + paper._growth_table(trials)).values()
    assert found[0][1:-1] == ["th 2.2", "th 1", "th 0.8", "th 0.5"]
    assert found[1][0] == ["the paper", "1.0", "2.2", "7.1", "26.8", ""]
    for power, (cut, row) in enumerate(zip(paper.CUTS, found[1][1:], strict=True)):
        growth = [(2.2 / threshold) ** power for threshold in (2.2, 1, 0.8, 0.5)]
        cells = [f"{g:.1f} [{g:.1f} to {g:.1f}]" for g in growth]
        assert row == [cut, *cells, "0.40 [0.40 to 0.40]"]


def test_times_are_told_by_how_hard_ransac_had_to_work():
    # Of LMedS, which takes 2 ms whatever the threshold.
    works = [0.1, 0.5, 0.9, 3.0, 5.0, 7.0]
    trials = [
        trial(method, paper.MUTUAL, seed, threshold, ms)
        for seed, work in enumerate(works)
        for method, threshold, ms in (
            ("LMedS", 2.2, 2.0),
            ("RANSAC", 0.5, 2.0 * work),
            ("RANSAC", 2.2, 1.0),
            (paper.DEFAULT, 0.5, 1.0),
            (paper.PROPOSED, 0.5, 2.0),
            (paper.PROPOSED_CV2, 0.5, 3.0),
            (paper.MAGSAC, 0.5, 4.0),
        )
    ]
    ((header, rows),) = tables("\n" + paper._work_table(trials)).values()
    assert header[3:] == [paper.PROPOSED, paper.PROPOSED_CV2, paper.DEFAULT, paper.MAGSAC]
    assert [row[1] for row in rows] == ["1", "2", "1", "2"]
    # The paper's RANSAC took 126 ms, its LMedS 18.2.
    assert [row[2] for row in rows] == ["", "", "", "0.14"]
    assert rows[0][5] == "5.000 [5.000 to 5.000]"
    assert [cell.split()[0] for cell in rows[3][3:]] == ["0.143", "0.214", "0.071", "0.286"]


@pytest.mark.parametrize("method", [paper.PROPOSED, paper.PROPOSED_CV2])
def test_own_inliers_of_the_rule_are_among_the_kept(method):
    X = make_scene("clusters", 411, 0.7, 0.5).X
    kept = paper.paper_support(X, 0.011, 2.0)[1]
    solution = paper.METHODS[method](X, 1.0, 0.011, 0)
    assert solution.drawn_from == np.count_nonzero(kept) < len(X)
    assert solution.own.any()
    assert not (solution.own & ~kept).any()


def test_without_a_renderer_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pyvista", None)
    monkeypatch.setattr(paper, "real_pairs", lambda data: [])
    assert main(["paper"]) == 2
    assert "pip install pyvista" in capsys.readouterr().err


@pytest.mark.skipif(not find_spec("stereodemo"), reason="stereodemo is not installed")
def test_rows_of_stereodemo_match():
    views = paper._stereodemo()
    assert len(views) == 12
    for v in views:
        distance = sampson_distance(v.pair.F_gt, v.pair.X)
        assert np.median(distance[distance < 2]) < 0.5


@pytest.fixture(scope="module")
def rendered_pair():
    return rendered.render_pair("gallery")


@needs_renderer
class TestRendered:
    def test_matches_lie_on_the_cameras_geometry(self, rendered_pair):
        pair = rendered_pair[0]
        assert len(pair.X) > 300
        distance = sampson_distance(pair.F_gt, pair.X)
        right = distance < 2
        assert np.count_nonzero(right) > 0.5 * len(pair.X)
        assert np.median(distance[right]) < 0.15

    def test_truth_from_the_depth_buffer_lies_on_it_and_fixes_it(self, rendered_pair):
        pair = rendered_pair[0]
        assert len(pair.truth) > 1000
        assert pair.error(pair.F_gt) < 1e-6
        F, _ = cv2.findFundamentalMat(pair.truth[:, :2], pair.truth[:, 2:], cv2.FM_8POINT)
        assert pair.pose_error(F) < 0.1

    def test_truth_points_show_the_same_spot(self, rendered_pair):
        """Half a pixel more, and the two pictures agree less."""
        pair, image1, image2 = rendered_pair
        blurred = [cv2.GaussianBlur(i, (0, 0), 1.0).astype(np.float32) for i in (image1, image2)]

        def colours(image, points):
            x, y = points.astype(np.float32).T
            return cv2.remap(image, x[None], y[None], cv2.INTER_LINEAR)[0]

        def agreement(shift):
            one = colours(blurred[0], pair.truth[:, :2])
            two = colours(blurred[1], pair.truth[:, 2:] + shift)
            return np.corrcoef(one.ravel(), two.ravel())[0, 1]

        assert agreement((0, 0)) > 0.9
        for shift in ((0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)):
            assert agreement(shift) < agreement((0, 0))

    def test_hidden_points_are_left_out(self):
        view1, view2 = rendered.render("table")
        alone = len(rendered.seen_by_both(view1, view1))
        # All but the sky.
        assert alone == pytest.approx(np.isfinite(view1.depth).mean() * 80 * 60, rel=0.01)
        assert 0.5 * alone < len(rendered.seen_by_both(view1, view2)) < 0.9 * alone
