from __future__ import annotations

import errno
import json
import os
import re
import shlex
import socket
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import cv_densityf
from cv_densityf.__main__ import main
from cv_densityf._coherence import coherence
from cv_densityf._epipolar import inlier_mask, residuals, sampson_distance
from cv_densityf._estimate import estimate_fundamental
from cv_densityf.colmap import Verification
from cv_densityf.datasets import motorcycle, two_view_scene
from cv_densityf.plotting import new_figure

SCENE = two_view_scene(400, inlier_ratio=0.5)


@pytest.fixture
def npz(tmp_path):
    path = tmp_path / "matches.npz"
    np.savez(path, points1=SCENE.points1, points2=SCENE.points2)
    return str(path)


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    pair, folder = motorcycle(), tmp_path_factory.mktemp("photos")
    paths = [str(folder / name) for name in ("left.png", "right.png")]
    for path, image in zip(paths, (pair.image1, pair.image2), strict=True):
        cv2.imwrite(path, image)
    return paths


@pytest.fixture
def run(capfd):
    """Run the command line; exit code, standard output, standard error."""

    def run(*arguments):
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as stop:
            code = stop.code
        return (code, *capfd.readouterr())

    return run


@pytest.fixture
def figures(monkeypatch):
    """Figures that are drawn."""
    made = []

    def spy(*size):
        made.append(new_figure(*size))
        return made[-1]

    monkeypatch.setattr("cv_densityf.plotting.new_figure", spy)
    return made


@pytest.fixture
def asked(monkeypatch):
    """Options of each call of the estimator."""
    calls = []

    def spy(*arguments, **options):
        calls.append(options)
        return estimate_fundamental(*arguments, **options)

    monkeypatch.setattr("cv_densityf.__main__.estimate_fundamental", spy)
    return calls


def test_points_to_json(run, npz):
    code, out, err = run("match", "--points", npz, "--json")
    report = json.loads(out)
    assert (code, err) == (0, "")
    F = np.array(report["F"])
    assert np.median(sampson_distance(F, SCENE.X[SCENE.inliers])) < 1
    mask = inlier_mask(F, SCENE.X, "usac", 1.0)
    assert report["n_matches"] == 400
    assert report["n_inliers"] == mask.sum()
    assert report["coherence"] == coherence(SCENE.points1, SCENE.points2, mask)
    assert report["median_residual"] == pytest.approx(
        np.median(residuals(F, SCENE.X[mask], "usac"))
    )


def test_plain_cv2_stands_beside_it(run, npz):
    _, out, _ = run("match", "--points", npz, "--json", "--method", "ransac", "--threshold", "2")
    F, mask = cv2.findFundamentalMat(SCENE.points1, SCENE.points2, cv2.FM_RANSAC, 2.0, 0.999, 5000)
    plain = json.loads(out)["cv2"]
    np.testing.assert_array_equal(plain["F"], F)
    assert plain["n_inliers"] == mask.sum()
    assert plain["coherence"] == coherence(SCENE.points1, SCENE.points2, mask)
    expected = np.median(residuals(F, SCENE.X[mask.ravel() > 0], "ransac"))
    assert plain["median_residual"] == pytest.approx(expected)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"method": "ransac", "threshold": 3.0, "confidence": 0.9, "max_iters": 50},
        {"density": "paper", "alpha": 0.05},
        {"density": "off", "method": "lmeds"},
        {"random_state": 7},
    ],
)
def test_options_reach_the_estimate(run, npz, asked, options):
    flags = []
    for name, value in options.items():
        flags += [f"--{name.replace('_', '-').replace('random-state', 'seed')}", value]
    code, out, _ = run("match", "--points", npz, "--json", *flags)
    assert code == 0
    assert options.items() <= asked[0].items()
    expected = estimate_fundamental(SCENE.points1, SCENE.points2, **options)
    report = json.loads(out)
    np.testing.assert_array_equal(report["F"], expected.F)
    assert report["n_kept"] == expected.kept.sum()
    assert report["n_draws"] == expected.n_draws


def test_scores_reach_the_estimate(run, tmp_path, asked):
    scores = np.random.default_rng(0).uniform(size=400)
    path = tmp_path / "matches.npz"
    np.savez(path, points1=SCENE.points1, points2=SCENE.points2, scores=scores)
    assert run("match", "--points", path)[0] == 0
    np.testing.assert_array_equal(asked[0]["scores"], scores)


def test_csv_and_npz_say_the_same(run, npz, tmp_path):
    path = tmp_path / "matches.csv"
    np.savetxt(path, SCENE.X, delimiter=",", header="x,y,x',y'", comments="", fmt="%.17g")
    results = [json.loads(run("match", "--points", p, "--json")[1]) for p in (npz, path)]
    assert results[0]["F"] == results[1]["F"]


def test_people_read_the_same_numbers(run, npz):
    _, out, _ = run("match", "--points", npz, "--json")
    report = json.loads(out)
    code, text, err = run("match", "--points", npz)
    assert (code, err) == (0, "")
    assert text.startswith("400 matches, usac_accurate, threshold 1 px\n")
    for line, ours, plain in (
        ("kept as dense", report["n_kept"], "-"),
        ("inliers", report["n_inliers"], report["cv2"]["n_inliers"]),
        ("coherence", f"{report['coherence']:.2f}", f"{report['cv2']['coherence']:.2f}"),
        (
            "median residual, px",
            f"{report['median_residual']:.3f}",
            f"{report['cv2']['median_residual']:.3f}",
        ),
    ):
        assert re.search(rf"^{line} +{ours} +{plain}$", text, re.MULTILINE)
    assert re.search(r"^processor time, ms +[\d.]+ +[\d.]+$", text, re.MULTILINE)
    assert " ".join(text.split("\nhow")[1].split("\n\nF\n")[0].split()) == report["reason"]
    assert max(map(len, text.splitlines())) < 80
    numbers = [float(word) for word in text.split("\nF\n")[1].split()]
    np.testing.assert_allclose(numbers, np.ravel(report["F"]), rtol=1e-8)


def test_prosac_of_plain_cv2_has_the_best_scores_first(run, tmp_path):
    scores = np.random.default_rng(0).permutation(400) / 400
    path = tmp_path / "matches.npz"
    np.savez(path, points1=SCENE.points1, points2=SCENE.points2, scores=scores)
    _, out, _ = run("match", "--points", path, "--method", "USAC_PROSAC", "--json")
    best = np.argsort(-scores)
    numbers = (cv2.USAC_PROSAC, 1.0, 0.999, 5000)
    F, _ = cv2.findFundamentalMat(SCENE.points1[best], SCENE.points2[best], *numbers)
    np.testing.assert_array_equal(json.loads(out)["cv2"]["F"], F)


def test_what_is_written_is_named(run, npz, tmp_path):
    path = tmp_path / "o.npz"
    assert run("match", "--points", npz, "-o", path)[1].endswith(f"\n\nWritten: {path}\n")
    json.loads(run("match", "--points", npz, "-o", path, "--json")[1])


def test_methods_are_timed_warm_and_in_turn(run, npz, monkeypatch):
    called, clock = [], iter(range(100))
    monkeypatch.setattr("time.process_time", lambda: next(clock) / 100)

    extra = iter([20, 0, 2, 4])  # the first call sets something up

    def ours(*arguments, **options):
        called.append("ours")
        [next(clock) for _ in range(next(extra))]
        return estimate_fundamental(*arguments, **options)

    def plain(self, *points):
        called.append("cv2")
        return cv2.findFundamentalMat(*points)

    monkeypatch.setattr("cv_densityf.__main__.estimate_fundamental", ours)
    monkeypatch.setattr("cv_densityf._engine.Robust.plain", plain)
    times = json.loads(run("match", "--points", npz, "--json")[1])["timings_ms"]
    assert called == ["ours", "cv2"] * 4
    assert (times["estimating"], times["plain cv2"]) == (30, 10)


def test_long_calls_are_made_once(run, npz, asked, monkeypatch):
    clock = iter(range(100))
    monkeypatch.setattr("time.process_time", lambda: next(clock))
    times = json.loads(run("match", "--points", npz, "--json")[1])["timings_ms"]
    assert len(asked) == 1
    assert times["estimating"] == 1000


@pytest.mark.parametrize("options", [("--density", "off"), ("--method", "8point")])
def test_the_same_call_is_shown_once(run, npz, options):
    report = json.loads(run("match", "--points", npz, "--json", *options)[1])
    flag = cv2.FM_8POINT if "8point" in options else cv2.USAC_ACCURATE
    F, mask = cv2.findFundamentalMat(SCENE.points1, SCENE.points2, flag, 1.0, 0.999, 5000)
    np.testing.assert_array_equal(report["cv2"]["F"], F)
    assert report["cv2"]["n_inliers"] == report["n_inliers"] == mask.sum()
    assert "plain cv2" not in report["timings_ms"]
    text = run("match", "--points", npz, *options)[1]
    assert re.search(r"\n\n +plain cv2\ninliers +\d+\n", text)
    assert re.search(r"^processor time, ms +[\d.]+$", text, re.MULTILINE)


@pytest.mark.parametrize("name", ["out.npz", "OUT.NPZ"])
def test_output_npz_can_be_read_back(run, npz, tmp_path, name):
    path = tmp_path / name
    code, out, _ = run("match", "--points", npz, "--json", "-o", path)
    assert code == 0
    with np.load(path, allow_pickle=False) as found:
        np.testing.assert_array_equal(found["points1"], SCENE.points1)
        np.testing.assert_array_equal(found["F"], json.loads(out)["F"])
        np.testing.assert_array_equal(found["mask"], inlier_mask(found["F"], SCENE.X, "usac", 1.0))
        assert found["kept"].shape == found["reliability"].shape == (400,)
    again = json.loads(run("match", "--points", path, "--json")[1])
    assert again["F"] == json.loads(out)["F"]


def test_output_json_holds_the_matches_too(run, tmp_path):
    # JSON knows no NaN; a strict reader would stumble.
    points1 = SCENE.points1.copy()
    points1[3] = np.nan
    np.savez(tmp_path / "in.npz", points1=points1, points2=SCENE.points2)
    path = tmp_path / "out.json"
    code, out, _ = run("match", "--points", tmp_path / "in.npz", "--json", "--output", path)
    assert code == 0
    found = json.loads(path.read_text(), parse_constant=pytest.fail)
    assert {name: found[name] for name in json.loads(out)} == json.loads(out)
    assert found["points1"][3] == [None, None]
    assert found["points1"][4] == points1[4].tolist()
    assert found["mask"][3] is False
    assert sum(found["mask"]) == found["n_inliers"]


def test_the_page_names_every_key(run, npz, tmp_path):
    page = (Path(__file__).parents[1] / "docs" / "command-line.md").read_text("utf-8")
    out, report = tmp_path / "out.json", json.loads(run("match", "--points", npz, "--json")[1])
    run("match", "--points", npz, "-o", out)
    for key in {*json.loads(out.read_text()), *report, *report["timings_ms"], *report["cv2"]}:
        assert f"`{key}`" in page


def test_two_images(run, photos, tmp_path):
    plot = tmp_path / "plot.png"
    code, out, err = run("match", *photos, "--json", "--plot", plot, "-o", tmp_path / "out.npz")
    assert (code, err) == (0, "")
    report = json.loads(out)
    assert motorcycle().error(np.array(report["F"])) < 0.5
    assert {"reading", "features", "matching", "estimating"} <= set(report["timings_ms"])
    assert cv2.imread(str(plot)).shape[1] == 1600
    with np.load(tmp_path / "out.npz") as found:
        assert found["scores"].shape == (report["n_matches"],)


def test_matching_options(run, photos):
    def n_matches(*options):
        return json.loads(run("match", *photos, "--json", *options)[1])["n_matches"]

    everything = n_matches()
    assert 8 <= n_matches("--max-features", 200) <= 200
    assert n_matches("--ratio", 0.7) < everything
    assert n_matches("--max-size", 300) < everything


def test_points_can_be_drawn_without_images(run, npz, tmp_path):
    assert run("match", "--points", npz, "--plot", tmp_path / "plot.png")[0] == 0
    assert cv2.imread(str(tmp_path / "plot.png")).shape[1] == 1600


@pytest.mark.parametrize(("limit", "shown"), [(400, ""), (150, "1 in 3 of 400 matches shown")])
def test_a_plot_of_a_part_says_so(run, npz, tmp_path, figures, monkeypatch, limit, shown):
    monkeypatch.setattr("cv_densityf.__main__._MAX_GRAPH_POINTS", limit)
    assert run("match", "--points", npz, "--plot", tmp_path / "plot.png")[0] == 0
    assert figures[0].get_suptitle() == shown


@pytest.mark.parametrize(
    ("options", "curves"),
    [
        ((), 0),
        (("--density", "off"), 0),
        (("--density", "paper"), 1),
        (("--density", "paper", "--method", "8point"), 0),
    ],
)
def test_the_papers_curve_is_of_the_papers_rule(run, npz, tmp_path, figures, options, curves):
    assert run("match", "--points", npz, "--plot", tmp_path / "plot.png", *options)[0] == 0
    assert len(curves_of(figures[0].axes[2])) == curves


def curves_of(ax):
    """Curves in a decision graph."""
    return [line for line in ax.lines if "delta" in line.get_label()]


def test_the_papers_curve_parts_kept_from_dropped_or_is_not_there(
    run, npz, tmp_path, figures, monkeypatch
):
    arguments = ("match", "--points", npz, "--density", "paper", "--plot", tmp_path / "plot.png")
    assert run(*arguments)[0] == 0
    (curve,) = curves_of(figures[0].axes[2])
    product = np.prod(curve.get_xydata()[0])
    for line in figures[0].axes[2].lines:
        above = np.prod(line.get_xydata(), axis=1) >= product
        if line is not curve:
            assert (above == line.get_label().startswith("kept")).all()
    # Of part of the matches it would part others.
    monkeypatch.setattr("cv_densityf._estimate.MAX_SEARCHED", 300)
    assert run(*arguments)[0] == 0
    assert curves_of(figures[1].axes[2]) == []


def test_the_legend_says_what_density_did(run, npz, tmp_path, figures, monkeypatch):
    def words(*options):
        arguments = ("match", "--points", npz, "--plot", tmp_path / "plot.png", *options)
        assert run(*arguments)[0] == 0
        first, _, last = figures[-1].axes
        labels = [line.get_label().split(" (")[0] for line in last.lines]
        assert labels == [text.get_text().split(" (")[0] for text in first.get_legend().get_texts()]
        return set(labels)

    plain, filtered = {"inlier", "not an inlier"}, {"kept, inlier", "kept, not an inlier"}
    assert words("--density", "off") == plain
    filtered |= {"dropped, yet inlier", "dropped"}
    assert words() == filtered
    monkeypatch.setattr("cv_densityf._estimate.MAX_RANKED", 300)
    assert words() == filtered | {"not looked at, inlier", "not looked at, not an inlier"}


def test_stages_are_shown_on_a_terminal_only(run, npz, monkeypatch):
    assert run("match", "--points", npz)[2] == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    _, out, err = run("match", "--points", npz, "--json")
    json.loads(out)
    assert "estimating ..." in err


class TestNoF:
    @pytest.fixture
    def constant(self, tmp_path):
        path = tmp_path / "same.npz"
        np.savez(path, points1=np.ones((30, 2)), points2=np.ones((30, 2)))
        return path

    def test_exit_code_and_reason(self, run, constant):
        code, out, err = run("match", "--points", constant)
        assert code == 1
        assert "no F" in out
        assert re.fullmatch(r"cv-densityf: no fundamental matrix found: .+\n", err)

    def test_json_says_so(self, run, constant):
        code, out, _ = run("match", "--points", constant, "--json")
        assert code == 1
        assert json.loads(out)["F"] is None
        assert json.loads(out)["reason"]

    def test_a_matrix_of_nan_is_none(self, run, tmp_path):
        # cv2's 8-point method answers NaN where a single point is not finite.
        X = np.vstack([SCENE.X[SCENE.inliers][:20], [[np.nan, 1, 2, 3]]])
        np.savez(tmp_path / "nan.npz", points1=X[:, :2], points2=X[:, 2:])
        arguments = ("match", "--points", tmp_path / "nan.npz", "--method", "8point", "--json")
        code, out, err = run(*arguments, "-o", tmp_path / "out.npz")
        report = json.loads(out, parse_constant=pytest.fail)
        assert report["cv2"]["F"] is None
        assert code == (0 if report["F"] else 1)
        assert (tmp_path / "out.npz").exists() == (code == 0)
        assert err.count("\n") == code

    @pytest.mark.parametrize("n", [0, 6])
    def test_too_few_matches(self, run, tmp_path, n):
        path = tmp_path / "few.npz"
        np.savez(path, points1=SCENE.points1[:n], points2=SCENE.points2[:n])
        code, out, err = run("match", "--points", path, "--json")
        assert code == 1
        assert json.loads(out)["F"] is None
        assert json.loads(out)["n_matches"] == n
        assert err.endswith(f"few.npz: {n} matches, at least 7 are needed\n")

    def test_too_few_are_finite(self, run, tmp_path):
        X = np.vstack([SCENE.X[:6], [[np.nan] * 4, [1e300, 0, 0, 0]]])
        np.savez(tmp_path / "few.npz", points1=X[:, :2], points2=X[:, 2:])
        code, _, err = run("match", "--points", tmp_path / "few.npz")
        assert code == 1
        assert "few.npz: 6 finite matches, at least 7" in err

    def test_black_images(self, run, tmp_path):
        black = str(tmp_path / "black.png")
        cv2.imwrite(black, np.zeros((50, 60), np.uint8))
        code, out, err = run("match", black, black, "--json")
        assert code == 1
        assert json.loads(out)["F"] is None
        assert err.count("\n") == 1
        assert err.endswith(f"no features in {black}\n")

    def test_nothing_is_written(self, run, constant, tmp_path):
        run("match", "--points", constant, "-o", tmp_path / "o.npz", "--plot", tmp_path / "p.png")
        assert [path.name for path in tmp_path.iterdir()] == ["same.npz"]


class TestSevenMatches:
    @pytest.fixture
    def seven(self, tmp_path):
        rows = np.random.default_rng(0).choice(np.flatnonzero(SCENE.inliers), 7, replace=False)
        path = tmp_path / "seven.npz"
        np.savez(path, points1=SCENE.points1[rows], points2=SCENE.points2[rows])
        F, _ = cv2.findFundamentalMat(SCENE.points1[rows], SCENE.points2[rows], cv2.FM_7POINT)
        assert F.shape == (9, 3)
        return path, F

    def test_have_up_to_three_matrices(self, run, seven):
        path, F = seven
        code, out, err = run("match", "--points", path, "--method", "7point", "--json")
        assert (code, err) == (0, "")
        np.testing.assert_array_equal(json.loads(out)["F"], F)
        text = run("match", "--points", path, "--method", "7point")[1]
        numbers = [float(word) for word in text.split("\nF\n", 1)[1].replace("F", "").split()]
        np.testing.assert_allclose(np.reshape(numbers, (9, 3)), F, rtol=1e-8)

    def test_have_no_one_picture(self, run, seven, tmp_path):
        plot = tmp_path / "plot.png"
        code, out, err = run("match", "--points", seven[0], "--method", "7point", "--plot", plot)
        assert (code, out) == (2, "")
        assert err == (
            "cv-densityf: seven matches fit several matrices, and --plot draws the lines of one\n"
        )
        assert not plot.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "COMMAND"),
        (["guess"], "invalid choice: 'guess'"),
        (["match"], "give two images, or --points FILE"),
        (["match", "one.png"], "give two images"),
        (["match", "a.png", "b.png", "c.png"], "give two images"),
        (["match", "{here}/no.png", "{here}/no.png"], "no.png: No such file"),
        (["match", "{here}", "{here}"], "Is a directory"),
        (["match", "{here}/text.csv", "{here}/text.csv"], "text.csv: not an image"),
        (["match", "--points", "{here}/no.npz"], "no.npz: No such file"),
        (["match", "--points", "{here}/text.csv"], "text.csv: header 'hello' is not"),
        (["match", "--points", "{npz}", "a.png", "b.png"], "--points and images exclude"),
        (["match", "--points", "{npz}", "--ratio", "0.8"], "--points and --ratio exclude"),
        (["match", "--points", "{npz}", "--max-size", "9"], "--points and --max-size exclude"),
        (["match", "--points", "{npz}", "--method", "guess"], "--method: invalid choice: 'guess'"),
        (["match", "--points", "{npz}", "--density", "high"], "--density: invalid choice"),
        (["match", "--points", "{npz}", "--threshold", "0"], "--threshold: '0' is not a positive"),
        (["match", "--points", "{npz}", "--threshold", "nan"], "--threshold: 'nan' is not"),
        (["match", "--points", "{npz}", "--confidence", "1"], "--confidence: '1' is not"),
        (["match", "--points", "{npz}", "--max-iters", "0"], "--max-iters: '0' is not"),
        (["match", "--points", "{npz}", "--max-iters", "9e9"], "--max-iters: '9e9' is not"),
        (["match", "--points", "{npz}", "--max-iters", "99999999999"], "from 1 to 2147483647"),
        (["verify", "{npz}", "--jobs", "0"], "'0' is not a whole number of pairs, or -1 for all"),
        (["match", "a.png", "--seed", "1", "b.png", "c.png"], "give two images"),
        (["match", "--points", "{npz}", "--alpha", "-1"], "--alpha: '-1' is not"),
        (["match", "--points", "{npz}", "--seed", "1.5"], "--seed: '1.5' is not a whole"),
        (["match", "a.png", "b.png", "--ratio", "2"], "--ratio: '2' is not"),
        (["match", "--points", "{npz}", "-o", "out.txt"], "'out.txt' does not end in .npz or"),
        (["match", "--points", "{npz}", "-o", "{here}/no/out.npz"], "folder of .* does not exist"),
        (["match", "--points", "{npz}", "--plot", "out.jpg"], "'out.jpg' does not end in .png"),
        (["demo", "--out", "{npz}"], "--out takes a folder, and .*npz is a file"),
        (["match", "--points", "{npz}", "--alpha", ".1"], "--alpha is of --density paper"),
        (["match", "a.png", "b.png", "--thresold", "2"], r"unknown: --thresold 2 \(see .* match -"),
    ],
)
def test_wrong_use(run, npz, tmp_path, arguments, message):
    (tmp_path / "text.csv").write_text("hello\n")
    before = {path.name for path in tmp_path.iterdir()}
    code, out, err = run(*(text.format(here=tmp_path, npz=npz) for text in arguments))
    assert (code, out) == (2, "")
    assert err.startswith("cv-densityf")
    assert err.count("\n") == 1
    assert re.search(message, err)
    assert {path.name for path in tmp_path.iterdir()} == before


def test_full_disk_leaves_no_half_file(run, npz, tmp_path, monkeypatch):
    def full(stream, **arrays):
        stream.write(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    code, _, err = run("match", "--points", npz, "-o", tmp_path / "out.npz")
    assert code == 2
    assert err.endswith("out.npz: cannot write: No space left on device\n")
    assert [path.name for path in tmp_path.iterdir()] == ["matches.npz"]


def test_without_matplotlib_it_says_so_before_it_works(run, npz, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    code, out, err = run("match", "--points", npz, "--plot", tmp_path / "plot.png")
    assert (code, out) == (2, "")
    assert "pip install matplotlib" in err


def test_more_matches_than_cv2_survives(run, tmp_path):
    scene = two_view_scene(60_000)
    path = tmp_path / "many.npz"
    np.savez(path, points1=scene.points1, points2=scene.points2)
    code, out, _ = run("match", "--points", path)
    assert code == 0
    assert "not run" in out


def test_demo_needs_no_network(run, tmp_path, figures, monkeypatch):
    monkeypatch.setattr(socket, "socket", lambda *arguments: pytest.fail("opened a socket"))
    monkeypatch.setattr("cv_densityf.__main__._DEMO_ORDERS", 2)
    code, out, err = run("demo", "--out", tmp_path / "new" / "folder")
    assert (code, err) == (0, "")
    errors = dict(re.findall(r"^(c.+?) {2,}([\d.]+) ", out, re.MULTILINE))
    assert set(errors) == {
        "cv-densityf",
        "cv-densityf, with scores",
        "cv2, ransac",
        "cv2, usac_magsac",
        "cv2, usac_accurate",
    }
    assert all(0 < float(error) < 2 for error in errors.values())
    assert float(errors["cv-densityf"]) < 0.3
    assert "processor time, ms" in out
    assert re.search(r"An easy pair: 7\d% of the matches are right", out)
    assert "known to a tenth of a pixel" in out
    assert not any(curves_of(figure.axes[0]) for figure in figures)
    for name in ("matches", "epipolar_lines", "decision_graph"):
        path = tmp_path / "new" / "folder" / f"{name}.png"
        assert str(path) in out
        assert cv2.imread(str(path)).shape[1] == 1600


def test_demo_times_its_methods_in_turn(run, tmp_path, monkeypatch):
    called = []

    def method(name):
        def estimate(X, scores):
            called.append(name)
            return np.eye(3), np.ones(len(X))

        return estimate

    monkeypatch.setattr("cv_densityf.__main__._DEMO_ORDERS", 2)
    monkeypatch.setattr(
        "cv_densityf.__main__._demo_estimators", lambda: [(n, method(n)) for n in "ab"]
    )
    assert run("demo", "--out", tmp_path)[0] == 0
    assert called == ["a", "b"] * 3


def test_version(run):
    code, out, _ = run("version")
    assert code == 0
    assert f"cv-densityf {cv_densityf.__version__}\n" in out
    assert re.search(rf"^opencv {re.escape(cv2.__version__)}, from opencv-[\w-]+$", out, re.M)


def test_images_may_stand_apart(run, photos):
    left, right = photos
    code, out, _ = run("match", left, "--threshold", "2", right, "--json")
    assert (code, json.loads(out)["threshold"]) == (0, 2)
    together = json.loads(run("match", left, right, "--threshold", "2", "--json")[1])
    assert json.loads(out)["F"] == together["F"]


def test_what_the_decoder_says_of_a_damaged_image_is_told(run, photos, tmp_path):
    data = cv2.imencode(".jpg", motorcycle().image1)[1]
    data[len(data) // 2 :][:40] = 0
    data.tofile(tmp_path / "damaged.jpg")
    code, _, err = run("match", tmp_path / "damaged.jpg", photos[1])
    assert code == 0
    assert "JPEG" in err


def test_too_large_an_input_is_said_in_a_line(run, npz, monkeypatch):
    def too_large(*arguments):
        raise MemoryError

    monkeypatch.setattr("cv_densityf.__main__.read_matches", too_large)
    assert run("match", "--points", npz) == (
        2,
        "",
        "cv-densityf: not enough memory for this input\n",
    )


@pytest.mark.parametrize("jobs", [-1, 2, -2])
@pytest.mark.parametrize(
    ("n_before", "n_verified", "failures", "code"),
    [(3, 0, (), 0), (0, 0, (), 1), (2, 0, ((1, 2, "odd"),), 1), (2, 1, ((1, 2, "odd"),), 0)],
)
def test_verify(run, monkeypatch, jobs, n_before, n_verified, failures, code):
    asked = []

    def done(database, **options):
        asked.append(options["n_jobs"])
        return Verification(3, n_before, n_verified, 0, 0, 0, 0, failures)

    monkeypatch.setattr("cv_densityf.colmap.verify_matches", done)
    assert run("verify", "some.db", "--resume", "--jobs", jobs)[0] == code
    assert asked == [jobs]


def test_interrupt_leaves_no_traceback(run, npz, monkeypatch):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("cv_densityf.__main__.read_matches", interrupted)
    assert run("match", "--points", npz) == (130, "", "cv-densityf: interrupted\n")


@pytest.mark.parametrize(("n", "code", "said"), [(100, 0, ""), (6, 1, "at least 7 are needed")])
def test_as_a_module_with_a_reader_that_leaves(tmp_path, n, code, said):
    """The exit code and the files are the same without it."""
    np.savetxt(tmp_path / "x.csv", SCENE.X[:n], delimiter=",")
    with subprocess.Popen(
        [sys.executable, "-m", "cv_densityf", "match", "--points", "x.csv", "-o", "out.npz"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
    ) as process:
        process.stdout.close()
        err = process.stderr.read()
    assert process.returncode == code
    assert err.count("\n") == (code == 1)
    assert said in err
    assert (tmp_path / "out.npz").exists() == (code == 0)


def test_as_a_module_where_the_terminal_has_other_letters(tmp_path):
    np.savetxt(tmp_path / "x.csv", SCENE.X, delimiter=",")
    done = subprocess.run(
        [sys.executable, "-m", "cv_densityf", "match", "--points", "x.csv", "-o", "日本.npz"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert r"\u65e5\u672c.npz" in done.stdout
    assert (tmp_path / "日本.npz").exists()


@pytest.mark.skipif(os.name == "nt", reason="needs a POSIX shell")
@pytest.mark.parametrize(
    ("arguments", "code"), [("match --points x.csv", 0), ("match --points y.csv", 2)]
)
@pytest.mark.parametrize("closed", ["2>&-", ">&-", ">&- 2>&-"])
def test_as_a_module_without_standard_streams(tmp_path, arguments, code, closed):
    np.savetxt(tmp_path / "x.csv", SCENE.X, delimiter=",")
    command = f"{shlex.quote(sys.executable)} -m cv_densityf {arguments} {closed}"
    done = subprocess.run(
        command, shell=True, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == code
    assert "Traceback" not in done.stderr
    assert ("processor time" in done.stdout) == (code == 0 and closed == "2>&-")


def test_prosac_gets_the_matches_best_first(run, tmp_path):
    """With cv2's own call on either side; of as few samples the order decides."""
    scene = two_view_scene(600, inlier_ratio=0.25, random_state=0)
    scores = scene.inliers + np.random.default_rng(0).uniform(0, 0.5, 600)
    order = np.argsort(-scores)
    for name, rows in (("mixed", np.arange(600)), ("sorted", order)):
        np.savetxt(
            tmp_path / f"{name}.csv", np.c_[scene.X, scores][rows], delimiter=",", fmt="%.17g"
        )
    for density in ("off", "contrast"):
        flags = ["--method", "usac_prosac", "--max-iters", 100, "--density", density, "--json"]
        mixed, best_first = (
            json.loads(run("match", "--points", tmp_path / f"{name}.csv", *flags)[1])
            for name in ("mixed", "sorted")
        )
        assert mixed["cv2"] == best_first["cv2"]
        assert (mixed["F"] == best_first["F"]) == (density == "off")
    output = tmp_path / "out.npz"
    run("match", "--points", tmp_path / "mixed.csv", "--method", "usac_prosac", "-o", output)
    with np.load(output) as written:
        np.testing.assert_array_equal(np.hstack([written["points1"], written["points2"]]), scene.X)
        assert scene.inliers[written["mask"]].mean() > 0.9


def test_incoherent_inliers_are_told(run, tmp_path, npz):
    shuffled = np.random.default_rng(0).permutation(SCENE.points2)
    np.savez(tmp_path / "wrong.npz", points1=SCENE.points1, points2=shuffled)
    for path, told in ((tmp_path / "wrong.npz", True), (npz, False)):
        assert ("nothing in common" in run("match", "--points", path)[1]) == told
    large = ("--threshold", "500")
    assert "nothing in common" not in run("match", "--points", tmp_path / "wrong.npz", *large)[1]


@pytest.mark.parametrize("method", ["lmeds", "8point"])
def test_of_methods_that_call_most_matches_inliers_coherence_decides(run, tmp_path, method):
    path, (points1, points2) = tmp_path / "matches.npz", np.hsplit(SCENE.X[SCENE.inliers], 2)
    shuffled = np.random.default_rng(0).permutation(points2)
    for partners, told in ((shuffled, True), (points2, False)):
        np.savez(path, points1=points1, points2=partners)
        text = run("match", "--points", path, "--method", method)[1]
        assert text.startswith(f"{len(points1)} matches, {method}\n")  # it takes no threshold
        assert ("nothing in common" in text) == told


def test_a_handful_of_inliers_is_said_to_say_nothing(run, tmp_path, npz):
    X = np.random.default_rng(0).uniform(0, 1000, (12, 4))
    np.savez(tmp_path / "random.npz", points1=X[:, :2], points2=X[:, 2:])
    assert "say nothing" in run("match", "--points", tmp_path / "random.npz")[1]
    assert "say nothing" not in run("match", "--points", npz)[1]


def test_an_image_without_features_is_named(run, photos, tmp_path):
    blank = tmp_path / "blank.png"
    cv2.imwrite(str(blank), np.zeros((200, 300), np.uint8))
    code, _, err = run("match", photos[0], blank)
    assert code == 1
    assert err == f"cv-densityf: no fundamental matrix found: no features in {blank}\n"


def test_of_many_matches_it_says_how_many_were_looked_at(run, tmp_path):
    scene = two_view_scene(3000, inlier_ratio=0.7, random_state=0)
    np.savez(tmp_path / "many.npz", points1=scene.points1, points2=scene.points2)
    report = json.loads(run("match", "--points", tmp_path / "many.npz", "--json")[1])
    assert report["n_kept"] < report["n_ranked"] < report["n_matches"] == 3000
    text = run("match", "--points", tmp_path / "many.npz")[1]
    assert f" {report['n_kept']} of {report['n_ranked']} " in text
