from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from benchmarks import metrics, peers, report
from benchmarks.__main__ import main
from benchmarks.data import Pair, load_pairs, move_onto
from benchmarks.lpm import MAX_COST, MIN_ALIKE, SIZES, locality_preserving_matches
from benchmarks.run import Record
from benchmarks.scenes import KINDS, make_scene
from cv_densityf import coherence

#: Rows match: x' on the same row as x.
RECTIFIED = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@pytest.fixture(scope="module")
def exact():
    return make_scene("clusters", 300, 0.6, 0.0, seed=3)


def record(method, pair, error, **more):
    fields = {"section": "s", "group": "g", "seed": 0, "n": 9, "threshold": 1.0, "ms": 2}
    fields["pose_error"] = np.nan
    return Record(method=method, pair=pair, error=error, **(fields | more))


class TestMetrics:
    def test_error_of_rows_that_differ_is_the_difference(self):
        rng = np.random.default_rng(0)
        X = rng.uniform(0, 500, (50, 4))
        X[:, 3] = X[:, 1] + np.tile([0.5, -1.5], 25)
        assert metrics.epipolar_error(RECTIFIED, X) == pytest.approx(1.0)
        assert metrics.epipolar_error(-7 * RECTIFIED, X) == pytest.approx(1.0)

    def test_both_images_count(self):
        # The second image is half as large, so the same displacement is half as far there.
        X = np.array([[10.0, 21.0, 5.0, 10.0]])
        F = RECTIFIED @ np.diag([0.5, 0.5, 1.0])
        assert metrics.epipolar_error(F, X) == pytest.approx((1.0 + 0.5) / 2)

    @pytest.mark.parametrize(
        "F", [None, np.full((3, 3), np.nan), np.zeros((3, 3)), np.zeros((0, 3))]
    )
    def test_failures_are_infinitely_wrong(self, exact, F):
        assert exact.error(F) == np.inf
        assert exact.pose_error(F) == np.inf

    def test_the_first_of_stacked_solutions_counts(self, exact):
        stacked = np.vstack([exact.F_gt, np.eye(3)])
        assert exact.error(stacked) == pytest.approx(0, abs=1e-6)

    def test_pose_error_is_the_angle_turned(self, exact):
        c = exact.cameras
        turn = cv2.Rodrigues(np.deg2rad([0.0, 2.0, 0.0]))[0]
        cross = np.cross(np.eye(3), c.t).T
        F = np.linalg.inv(c.K2).T @ cross @ turn @ c.R @ np.linalg.inv(c.K1)
        assert exact.pose_error(exact.F_gt) == pytest.approx(0, abs=1e-4)
        assert exact.pose_error(F) == pytest.approx(2.0, abs=1e-4)

    def test_pose_agrees_with_recover_pose(self, exact):
        c = exact.cameras
        rng = np.random.default_rng(1)
        F = exact.F_gt + 1e-4 * np.linalg.norm(exact.F_gt) * rng.normal(0, 1, (3, 3)) * [
            [1e-2, 1e-2, 1],
            [1e-2, 1e-2, 1],
            [1, 1, 1],
        ]
        E = c.K2.T @ F @ c.K1
        _, R, t, _ = cv2.recoverPose(E, exact.truth[:, :2], exact.truth[:, 2:], c.K1)
        angle_R = np.linalg.norm(cv2.Rodrigues(R.T @ c.R)[0])
        angle_t = np.arccos(t.ravel() @ c.t / np.linalg.norm(c.t))
        expected = np.degrees(max(angle_R, angle_t))
        assert expected > 1
        assert exact.pose_error(F) == pytest.approx(expected, abs=1e-4)

    def test_accuracy_and_area_by_hand(self):
        assert metrics.mean_average_accuracy([0.1, 0.3, np.inf, 3.0]) == pytest.approx(
            np.mean([1, 2, 2, 2, 3]) / 4
        )
        assert metrics.pose_auc([0.0, 0.0], 5) == 1
        assert metrics.pose_auc([np.inf], 5) == 0
        assert metrics.pose_auc([2.0], 5) == pytest.approx(1 - 1.0 / 5)
        assert metrics.pose_auc([2.0, np.inf], 10) == pytest.approx((1 - 1.0 / 10) / 2)

    def test_a_summary_leaves_unknown_poses_out_and_keeps_failures(self):
        row = metrics.summarise([0.2, 9.0, np.inf], [1.0, np.nan, np.inf], [1.0, 2.0, 6.0])
        assert row["lost"] == pytest.approx(2 / 3)
        assert row["median"] == 9.0
        assert row["p90"] == np.inf
        assert (row["n"], row["n_pose"]) == (3, 2)
        assert (row["ms_median"], row["ms_total"]) == (2.0, 9.0)

    def test_wins_and_losses(self):
        ours = np.array([1.0, 1.0, 1.0, np.inf, np.inf, 0.0])
        theirs = np.array([2.0, 1.01, 0.5, 1.0, np.inf, 0.0])
        assert metrics.wins_and_losses(ours, theirs) == (1, 2)
        assert metrics.wins_and_losses(theirs, ours) == (2, 1)


class TestData:
    @pytest.fixture
    def folder(self, tmp_path, exact):
        rng = np.random.default_rng(5)
        n = len(exact.X)
        common = {"pts1": exact.X[:, :2], "pts2": exact.X[:, 2:], "size1": [9, 8], "size2": [9, 8]}
        ratio = {"score": np.sort(rng.uniform(0.3, 1, n)), "score_kind": "sift_ratio"}
        c = exact.cameras
        cameras = {"K1": c.K1, "K2": c.K2, "R": c.R, "t": c.t}
        labels = np.arange(n) % 3 == 0
        none = {"score_kind": "none"}
        np.savez(tmp_path / "adelaideX__a.npz", **common, **none, labels=labels)
        np.savez(tmp_path / "hand__b.npz", **common, **ratio, val1=[[1, 2]], val2=[[3, 4]])
        np.savez(tmp_path / "known__c.npz", **common, **ratio, **cameras, F_gt=exact.F_gt)
        cameras["t"] = 1e-17 * c.t
        np.savez(tmp_path / "known__still.npz", **common, **ratio, **cameras, F_gt=exact.F_gt)
        return tmp_path

    def test_truth_follows_the_kind_of_the_set(self, folder, exact):
        labelled, hand, known, _ = load_pairs(folder)
        assert [labelled.group, hand.group, known.group] == ["adelaideX", "hand", "known"]
        np.testing.assert_array_equal(labelled.truth, exact.X[::3])
        np.testing.assert_array_equal(hand.truth, [[1, 2, 3, 4]])
        near = np.count_nonzero(metrics.sampson_distance(exact.F_gt, exact.X) < 1)
        assert len(known.truth) == near >= 180
        assert known.error(exact.F_gt) == pytest.approx(0, abs=1e-6)

    def test_rows_are_shuffled_with_their_scores(self, folder, exact):
        first, again, other = (load_pairs(folder, seed=seed)[2] for seed in (0, 0, 1))
        np.testing.assert_array_equal(first.X, again.X)
        assert not np.array_equal(first.X, other.X)
        assert not np.array_equal(first.X, exact.X)
        with np.load(folder / "known__c.npz") as file:
            score = dict(zip(map(tuple, exact.X), file["score"], strict=True))
        np.testing.assert_allclose(first.scores, [1 - score[tuple(row)] for row in first.X])

    def test_a_cut_keeps_the_truth_and_leaves_pairs_without_ratio_out(self, folder):
        cut = load_pairs(folder, cut=0.6)
        assert [pair.name for pair in cut] == ["hand__b", "known__c", "known__still"]
        assert len(cut[1].X) < 300
        assert cut[1].scores.min() > 0.4
        np.testing.assert_array_equal(cut[1].truth, load_pairs(folder)[2].truth)

    def test_so_many_of_the_matches(self, folder):
        n = len(load_pairs(folder, cut=0.6)[1].X) // 2
        some = load_pairs(folder, cut=0.6, n=n)
        assert [len(pair.X) for pair in some] == [n] * len(some)
        (all_of_it,) = (pair for pair in load_pairs(folder) if pair.name == some[0].name)
        assert {*map(tuple, some[0].X)} <= {*map(tuple, all_of_it.X)}
        with pytest.raises(ValueError, match="no pair has 301 such matches"):
            load_pairs(folder, cut=0.6, n=301)

    def test_a_camera_that_stands_still_has_no_pose(self, folder):
        still = load_pairs(folder, sets=["known"])[1]
        assert np.isnan(still.pose_error(still.F_gt))

    def test_says_what_is_wrong(self, folder, tmp_path_factory):
        with pytest.raises(ValueError, match=r"no \.npz file"):
            load_pairs(tmp_path_factory.mktemp("empty"))
        with pytest.raises(ValueError, match=r"it has .*'hand'"):
            load_pairs(folder, sets=["heads"])

    def test_points_move_little_and_onto_the_geometry(self, exact):
        X = exact.truth + np.random.default_rng(0).normal(0, 0.3, exact.truth.shape)
        moved = move_onto(exact.F_gt, X)
        assert metrics.epipolar_distance(exact.F_gt, moved).max() < 1e-6
        # To first order the shortest way is the Sampson distance.
        np.testing.assert_allclose(
            np.linalg.norm(moved - X, axis=1),
            metrics.sampson_distance(exact.F_gt, X),
            rtol=0.02,
            atol=1e-6,
        )


class TestPeers:
    @pytest.mark.parametrize("name", peers.METHODS)
    def test_convention_on_a_noise_free_scene(self, name, exact):
        method = peers.METHODS[name]
        if not method.installed:
            pytest.skip(f"{method.needs} is not installed")
        F = method.estimate(exact, peers.Settings())
        assert exact.error(F) < 0.2
        assert exact.pose_error(F) < 1
        assert exact.error(F.T) > 5

    @pytest.mark.parametrize("name", [n for n in peers.METHODS if "PROSAC" in n])
    def test_methods_in_score_order_do_not_see_the_order_of_the_rows(self, name):
        if not peers.METHODS[name].installed:
            pytest.skip(f"{peers.METHODS[name].needs} is not installed")
        if peers.METHODS[name].needs in ("pygcransac", "pysuperansac"):
            pytest.skip("takes no seed")
        pair = make_scene("clusters", 200, 0.3, 0.5)
        order = np.random.default_rng(0).permutation(200)
        turned = Pair(**(vars(pair) | {"X": pair.X[order], "scores": pair.scores[order]}))
        solve = peers.METHODS[name].estimate
        np.testing.assert_allclose(
            solve(pair, peers.Settings()), solve(turned, peers.Settings()), rtol=1e-6
        )

    @pytest.mark.parametrize("name", peers.METHODS)
    def test_hopeless_data_is_answered_not_raised(self, name, exact):
        method = peers.METHODS[name]
        if not method.installed:
            pytest.skip(f"{method.needs} is not installed")
        wrong = np.random.default_rng(0).uniform(0, 900, (20, 4))
        pair = Pair(**(vars(exact) | {"X": wrong, "scores": np.linspace(0, 1, 20)}))
        F = method.estimate(pair, peers.Settings(max_iters=50))
        assert F is None or F.shape == (3, 3)

    def test_choose_by_pattern_and_name_what_is_missing(self, monkeypatch):
        absent = peers.Method("absent", lambda pair, s: None, "no_such_module")
        monkeypatch.setitem(peers.METHODS, "absent", absent)
        chosen, skipped = peers.choose(["cv2:FM_*", "abs*", "cv2:FM_RANSAC"])
        assert [m.name for m in chosen] == ["cv2:FM_RANSAC", "cv2:FM_LMEDS"]
        assert skipped == ["absent"]
        with pytest.raises(ValueError, match=r"choose from .*poselib"):
            peers.choose(["posalib"])


class TestLocalityPreservingMatching:
    def test_agrees_with_the_definition_spelled_out(self):
        X = make_scene("clusters", 120, 0.5, 0.5).X
        n = len(X)
        motion = X[:, 2:] - X[:, :2]
        survivors = set(range(n))
        for max_cost in MAX_COST:
            kept = set()
            for i in range(n):
                others = [j for j in survivors if j != i]
                near1 = sorted(others, key=lambda j: np.linalg.norm(X[j, :2] - X[i, :2]))
                near2 = sorted(others, key=lambda j: np.linalg.norm(X[j, 2:] - X[i, 2:]))
                costs = []
                for k in SIZES:
                    lost = k
                    for j in set(near1[:k]) & set(near2[:k]):
                        a, b = np.linalg.norm(motion[i]), np.linalg.norm(motion[j])
                        cosine = motion[i] @ motion[j] / (a * b)
                        lost -= cosine * min(a, b) / max(a, b) >= MIN_ALIKE
                    costs.append(lost / k)
                if np.mean(costs) <= max_cost + 1e-12:
                    kept.add(i)
            survivors = kept
        assert set(np.flatnonzero(locality_preserving_matches(X))) == survivors
        assert 0 < len(survivors) < n

    def test_few_or_coinciding_matches(self):
        assert locality_preserving_matches(np.zeros((5, 4))).all()
        assert locality_preserving_matches(np.zeros((0, 4))).shape == (0,)
        assert locality_preserving_matches(np.ones((40, 4))).shape == (40,)


class TestScenes:
    @pytest.mark.parametrize("kind", [k for k, spec in KINDS.items() if spec.unique])
    def test_truth_lies_on_the_geometry_and_fixes_it(self, kind):
        scene = make_scene(kind, 400, 0.5, 0.0, seed=2)
        assert scene.error(scene.F_gt) < 1e-6
        assert scene.pose_error(scene.F_gt) < 1e-3
        on = metrics.sampson_distance(scene.F_gt, scene.X) < 1e-6
        assert np.count_nonzero(on) == 200
        F, _ = cv2.findFundamentalMat(scene.truth[:, :2], scene.truth[:, 2:], cv2.FM_8POINT)
        assert scene.pose_error(F) < 1

    @pytest.mark.parametrize("kind", [k for k, spec in KINDS.items() if not spec.unique])
    def test_one_homography_explains_what_does_not_fix_the_geometry(self, kind):
        scene = make_scene(kind, 400, 0.5, 0.0, seed=2)
        H, mask = cv2.findHomography(scene.X[:, :2], scene.X[:, 2:], cv2.USAC_ACCURATE, 0.01)
        assert np.count_nonzero(mask) >= 200
        moved = cv2.perspectiveTransform(scene.truth[:, None, :2], H)[:, 0]
        assert np.abs(moved - scene.truth[:, 2:]).max() < 0.05
        assert np.isnan(scene.pose_error(np.eye(3)))

    def test_a_plane_dominates(self):
        scene = make_scene("dominant_plane", 1000, 0.5, 0.0)
        true = scene.X[metrics.sampson_distance(scene.F_gt, scene.X) < 1e-6]
        _, mask = cv2.findHomography(true[:, :2], true[:, 2:], cv2.USAC_ACCURATE, 0.01)
        assert 0.85 < mask.mean() < 0.95

    def test_repeats_are_coherent_and_wrong(self):
        scene = make_scene("repeated_texture", 1200, 0.25, 0.0)
        wrong = scene.X[metrics.sampson_distance(scene.F_gt, scene.X) > 5]
        H, mask = cv2.findHomography(wrong[:, :2], wrong[:, 2:], cv2.USAC_ACCURATE, 0.01)
        assert H is not None
        assert np.count_nonzero(mask) >= 0.9 * 225

    def test_what_moves_are_crowds_that_keep_their_neighbours(self):
        scene = make_scene("moving_objects", 1000, 0.5, 0.0)
        wrong = scene.X[metrics.sampson_distance(scene.F_gt, scene.X) > 5]
        scattered = make_scene("clusters", 1000, 0.5, 0.0)
        by_chance = scattered.X[metrics.sampson_distance(scattered.F_gt, scattered.X) > 5]
        assert coherence(wrong[:, :2], wrong[:, 2:]) > 0.5
        assert coherence(by_chance[:, :2], by_chance[:, 2:]) < 0.05

    def test_noise_is_what_was_asked(self):
        exact, noisy = (make_scene("clusters", 2000, 1.0, noise) for noise in (0.0, 0.7))
        assert exact.error(exact.F_gt) == noisy.error(noisy.F_gt)
        distance = metrics.sampson_distance(noisy.F_gt, noisy.X)
        assert np.sqrt((distance**2).mean()) == pytest.approx(0.7, rel=0.05)

    def test_scores_rank_true_matches_higher(self):
        scene = make_scene("clusters", 1000, 0.5, 0.0)
        true = metrics.sampson_distance(scene.F_gt, scene.X) < 1e-6
        assert scene.scores[true].mean() > scene.scores[~true].mean() + 0.1

    def test_unknown_kind(self):
        with pytest.raises(ValueError, match="choose from clusters"):
            make_scene("cluster", 10, 0.5, 0)


class TestReport:
    def test_table_pairs_and_spread(self):
        rows = [
            record("cv2:USAC_ACCURATE", "a", 1.5),
            record("cv2:USAC_ACCURATE", "b", 6.0),
            record("ours:USAC_ACCURATE", "a", 0.4, ms=6),
            record("ours:USAC_ACCURATE", "b", np.inf, ms=6),
            record("ours:USAC_ACCURATE", "a", 0.1, threshold=3.0),
        ]
        text = report.markdown(rows, ["pyabsent"])
        assert "Not installed, left out: pyabsent." in text
        assert "| ours:USAC_ACCURATE | 0.400 | 0.500 |" in text
        assert "| USAC_ACCURATE | 0.200 → 0.400 | 0.500 → 0.500 |  →  | 1 : 1 | 3.00 |" in text
        assert "| cv2:USAC_ACCURATE | 1 : 1 |" in text
        assert "| b | 9 | lost | 6.00 | cv2:USAC_ACCURATE |" in text
        assert "| ours:USAC_ACCURATE | 0.400 | 1.000 | 0.600 |" in text

    def test_several_seeds_are_one_sample_and_a_pair_is_as_bad_as_its_median(self):
        errors = {"a": [9.0, 0.1, 0.1], "b": [3.0, 3.0, 0.1]}
        rows = [
            record(method, pair, factor * error, seed=seed)
            for method, factor in (("ours:USAC_ACCURATE", 1.0), ("poselib", 0.5))
            for pair, of_pair in errors.items()
            for seed, error in zip((0, 1, 2), of_pair, strict=True)
        ]
        text = report.markdown(rows)
        assert "2 pairs, 3 times each, with seeds 0 to 2.\n" in text
        assert f"| ours:USAC_ACCURATE | {(3 + 0.2 * 2) / 6:.3f} | {1 / 6:.3f} |" in text
        assert "| poselib | 0 : 6 |" in text
        assert "by |\n| --- | --: | --: | --: | --- |\n| b | 9 | 3.00 | 1.50 | poselib |" in text
        skipping = [r for r in rows if r.seed != 1]
        assert "2 pairs, 2 times each, with seeds 0, 2.\n" in report.markdown(skipping)

    def test_words_stand_left_and_figures_right(self):
        body = [["a", "1.5 [1 to 2]", "motorcycle", ""], ["b", "lost [2 to lost]", "7-point", "3"]]
        table = report.table(["method", "error", "pair", "n"], body)
        assert table.splitlines()[1] == "| --- | --: | --- | --: |"

    def test_a_page_is_filled_with_the_tables_it_names(self, tmp_path):
        page = tmp_path / "page.md"
        old = "# Page\n\n| own |\n| --- |\n\n<!-- table: B, all -->\n\n| x |\n| 1 |\n\nWords.\n"
        page.write_text(old)
        report.fill(page, "## A\n\n| a |\n\n## B, all\n\nAbout \\1.\n\n| b |\n| --: |\n| 2 |\n")
        assert page.read_text() == old.replace("| x |\n| 1 |", "| b |\n| --: |\n| 2 |")
        with pytest.raises(ValueError, match=r"no table 'B, all' in the report; it has \['A'\]"):
            report.fill(page, "## A\n\n| a |\n")
        page.write_text("<!-- table: A -->\n\nGone.\n")
        with pytest.raises(ValueError, match="no table below"):
            report.fill(page, "## A\n\n| a |\n")

    def test_command_line_from_scenes_to_files(self, tmp_path, capsys):
        out, plots = tmp_path / "out.json", tmp_path / "plots"
        arguments = "synthetic --scenes clusters rotation --n 60 --inlier-ratio .6 --noise .5"
        arguments += " --repeats 2 --threshold 1 3 --methods cv2:FM_* ours:USAC_MAGSAC"
        assert main([*arguments.split(), "--json", str(out), "--plots", str(plots)]) == 0
        assert "## rotation, threshold 3 px" in capsys.readouterr().out
        document = json.loads(out.read_text(), parse_constant=pytest.fail)
        assert document["settings"]["n"] == [60]
        assert document["packages"]["numpy"] == np.__version__
        # 2 kinds, 2 scenes, 2 thresholds, 3 methods
        assert len(document["records"]) == 2 * 2 * 2 * 3
        assert len(document["summary"]) == 2 * 2 * 3
        names = {path.name for path in plots.iterdir()}
        assert {"clusters-1px-errors.png", "rotation-3px-time.png"} <= names
        assert len(names) == 8

    def test_command_line_on_real_pairs(self, tmp_path, exact, capsys):
        np.savez(
            tmp_path / "set__a.npz",
            pts1=exact.X[:, :2],
            pts2=exact.X[:, 2:],
            score=1 - exact.scores,
            score_kind="sift_ratio",
            size1=[1280, 960],
            size2=[1280, 960],
            F_gt=exact.F_gt,
        )
        arguments = ["real", "--data", str(tmp_path), "--cut", "all", ".9", "--methods"]
        out = tmp_path / "out.json"
        seeds = ["--seed", "3", "5", "--json", str(out)]
        assert main([*arguments, "cv2:USAC_MAGSAC", "ours:USAC_FAST", *seeds]) == 0
        printed = capsys.readouterr().out
        assert "## all matches, threshold 1 px\n\n1 pairs, 2 times each, with seeds 3, 5" in printed
        records = json.loads(out.read_text())["records"]
        ours = [r for r in records if r["method"] == "ours:USAC_FAST"]
        (all_3, all_5), (below_3, below_5) = ours[:2], ours[2:]
        assert [r["seed"] for r in ours] == [3, 5, 3, 5]
        assert all_3["error"] != all_5["error"]
        assert below_3["error"] != below_5["error"]
        assert "## SIFT ratio < 0.9, threshold 1 px" in printed
        assert main([*arguments, "cv2:USAC_MAXSAC"]) == 2
        assert "no method 'cv2:USAC_MAXSAC'" in capsys.readouterr().err

    def test_no_pairs_no_report(self, tmp_path, exact, capsys):
        pair = {"pts1": exact.X[:, :2], "pts2": exact.X[:, 2:], "size1": [9, 8], "size2": [9, 8]}
        np.savez(tmp_path / "a.npz", **pair, score_kind="none", F_gt=exact.F_gt)
        arguments = ["real", "--data", str(tmp_path), "--methods", "cv2:FM_RANSAC", "--cut", ".8"]
        assert main(arguments) == 2
        assert "--cut takes pairs with SIFT ratios only" in capsys.readouterr().err
        assert main([*arguments, "all"]) == 0
        assert "1 pairs" in capsys.readouterr().out
        assert main(["synthetic", "--repeats", "0"]) == 2
        assert "--repeats is 1 at least" in capsys.readouterr().err
        for wrong in ("nan", "0"):
            with pytest.raises(SystemExit):
                main([*arguments, wrong])
            assert f"'{wrong}' is neither a SIFT ratio nor 'all'" in capsys.readouterr().err

    def test_stages_have_a_column_for_each_number(self, capsys):
        assert main(["stages", "--n", "50", "100", "--repeats", "1"]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert lines[0] == "| stage, ms | N = 50 | N = 100 |"
        assert lines[-1].startswith("| number of draws |")
