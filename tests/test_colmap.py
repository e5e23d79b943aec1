"""COLMAP reads what we write, and no accident costs more than a few pairs."""

from __future__ import annotations

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing

import numpy as np
import pytest

from cv_densityf import InputError, estimate_fundamental
from cv_densityf.__main__ import main
from cv_densityf.colmap import DEGENERATE, UNCALIBRATED, _open, verify_matches
from cv_densityf.datasets import two_view_scene

pycolmap = pytest.importorskip("pycolmap")

SURPLUS = 5
UNDEFINED = int(pycolmap.TwoViewGeometryConfiguration.UNDEFINED)


def make_database(path, n_pairs, n=300, junk=()):
    """Pairs of images 2i + 1 and 2i + 2; their keypoints are shuffled, some unmatched."""
    points = {}
    with pycolmap.Database.open(path) as database:
        camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 1000.0, 1280, 960)
        camera_id = database.write_camera(camera)
        for i in range(n_pairs):
            rng = np.random.default_rng(i)
            scene = two_view_scene(n, inlier_ratio=0.6, random_state=i)
            sides = [scene.points1, scene.points2]
            if i in junk:
                sides = [rng.uniform(0, 900, (n, 2)) for _ in range(2)]
            ids, columns = [], []
            for side, xy in enumerate(sides):
                image = pycolmap.Image(name=f"{i}-{side}.jpg", camera_id=camera_id)
                ids.append(database.write_image(image))
                place = rng.permutation(n + SURPLUS)[:n]
                keypoints = rng.uniform(0, 900, (n + SURPLUS, 4)).astype(np.float32)
                keypoints[place, :2] = xy
                database.write_keypoints(ids[-1], keypoints)
                columns.append(place)
            matches = np.stack(columns, axis=1).astype(np.uint32)
            database.write_matches(*ids, matches)
            points[tuple(ids)] = matches, *(side.astype(np.float32) for side in sides)
    return points


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    path = tmp_path_factory.mktemp("colmap") / "made.db"
    return path, make_database(path, 4, junk=(2,))


@pytest.fixture
def database(made, tmp_path):
    return shutil.copy(made[0], tmp_path / "data base #1.db")


def sql(path, *statements):
    """Execute, commit, close; the rows of the last statement."""
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        for statement in statements:
            found = connection.execute(statement).fetchall()
    return found


def rows(path):
    return sql(path, "SELECT * FROM two_view_geometries ORDER BY pair_id")


def test_colmap_reads_what_the_estimates_say(database, made):
    done = verify_matches(database, threshold=2.0, min_inliers=50)
    n_inliers = 0
    with pycolmap.Database.open(database) as opened:
        for (id1, id2), (matches, points1, points2) in made[1].items():
            geometry = opened.read_two_view_geometry(id1, id2)
            estimate = estimate_fundamental(points1, points2, threshold=2.0)
            if estimate.n_inliers < 50:
                assert geometry.config == pycolmap.TwoViewGeometryConfiguration.DEGENERATE
                assert geometry.F is None
                assert len(geometry.inlier_matches) == 0
                continue
            n_inliers += estimate.n_inliers
            assert geometry.config == pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
            np.testing.assert_array_equal(geometry.F, estimate.F)
            np.testing.assert_array_equal(geometry.inlier_matches, matches[estimate.mask])
        _, counts = opened.read_two_view_geometry_num_inliers()
    assert sum(count >= 50 for count in counts) == 3
    assert (done.n_pairs, done.n_before, done.n_verified) == (4, 0, 3)
    assert (done.n_matches, done.n_inliers) == (1200, n_inliers)
    assert done.failures == ()


def test_close_to_colmaps_own_verification(database, made, tmp_path):
    theirs = shutil.copy(made[0], tmp_path / "theirs.db")
    names = tmp_path / "pairs.txt"
    names.write_text("".join(f"{i}-0.jpg {i}-1.jpg\n" for i in range(4)))
    # By chance some 20 of 300 wrong matches agree, with theirs as with ours.
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = 50
    pycolmap.verify_matches(theirs, names, options)
    verify_matches(database, min_inliers=50)
    for own, other in zip(rows(database), rows(theirs), strict=True):
        assert own[0] == other[0]
        assert own[4] in (DEGENERATE, UNCALIBRATED)
        # COLMAP before 4.2 leaves pairs with few inliers undefined.
        assert (own[4] == DEGENERATE) == (other[4] in (UNDEFINED, DEGENERATE))
        a, b = (set(np.frombuffer(row[3] or b"", dtype=np.uint64).tolist()) for row in (own, other))
        assert len(a & b) >= 0.9 * len(a | b)


def test_verifying_again_replaces_and_resuming_does_not(database):
    verify_matches(database, threshold=4.0)
    before = rows(database)
    done = verify_matches(database, threshold=0.5, resume=True)
    assert (done.n_before, done.n_matches) == (4, 0)
    assert rows(database) == before
    sql(database, f"DELETE FROM two_view_geometries WHERE pair_id = {before[1][0]}")
    done = verify_matches(database, threshold=4.0, resume=True)
    assert (done.n_pairs, done.n_before) == (4, 3)
    assert rows(database) == before
    verify_matches(database, threshold=0.5)
    assert len(rows(database)) == 4
    assert sum(row[1] for row in rows(database)) < sum(row[1] for row in before)


def test_results_do_not_depend_on_jobs(database):
    verify_matches(database)
    before = rows(database)
    verify_matches(database, n_jobs=2)
    assert rows(database) == before


def test_geometries_without_matches_stay(database):
    sql(
        database,
        "INSERT INTO two_view_geometries (pair_id, rows, cols, config) VALUES (99, 0, 2, 1)",
    )
    verify_matches(database)
    assert len(rows(database)) == 5


def folder_of(path):
    """Names and bytes of all files beside a database, itself included."""
    return {file.name: file.read_bytes() for file in path.parent.iterdir()}


WRITES_AND_IS_KILLED = """
import os, sqlite3, sys
connection = sqlite3.connect(sys.argv[1])
connection.execute("DELETE FROM matches WHERE pair_id = (SELECT max(pair_id) FROM matches)")
connection.commit()
os.kill(os.getpid(), 9)
"""


def test_dry_run_leaves_alone_what_a_killed_program_has_left(database):
    subprocess.run([sys.executable, "-c", WRITES_AND_IS_KILLED, str(database)], check=False)
    before = folder_of(database)
    assert len(before[f"{database.name}-wal"]) > 0
    assert verify_matches(database, dry_run=True).n_pairs == 3
    after = folder_of(database)
    # The index of the log is memory that readers share.
    after.pop(f"{database.name}-shm", before.pop(f"{database.name}-shm", None))
    assert after == before


def test_keypoints_without_data_are_damage(database):
    sql(database, "UPDATE keypoints SET data = NULL WHERE image_id = 1")
    with pytest.raises(InputError, match="1 entries of keypoints have the wrong size"):
        verify_matches(database)


def test_dry_run_changes_nothing(database, capsys):
    before = folder_of(database)
    many = ["--min-inliers", "50"]
    assert main(["verify", str(database), "--dry-run", "--jobs", "1", *many]) == 0
    out = capsys.readouterr().out
    assert out.startswith("3 of 4 image pairs verified; ")
    assert "left out: 1 with fewer than 50 inliers, 0 whose inliers are incoherent" in out
    assert "nothing was written" in out
    assert folder_of(database) == before


def test_empty_and_few_matches_are_degenerate(tmp_path, capsys):
    path = tmp_path / "few.db"
    make_database(path, 2, n=10)
    first = "(SELECT min(pair_id) FROM matches)"
    sql(path, f"UPDATE matches SET rows = 0, data = x'' WHERE pair_id = {first}")
    assert main(["verify", str(path), "--jobs", "1"]) == 1
    assert capsys.readouterr().out.startswith("0 of 2 image pairs verified; 0 of 10 matches")
    assert [row[4] for row in rows(path)] == [DEGENERATE] * 2


def test_incoherent_inliers_do_not_verify_a_pair(database, made):
    _, points1, points2 = list(made[1].values())[2]  # the junk
    assert estimate_fundamental(points1, points2, threshold=4.0).n_inliers >= 15
    assert verify_matches(database).n_verified == 3
    assert rows(database)[2][4] == DEGENERATE
    assert verify_matches(database, min_coherence=-1.0).n_verified == 4
    # Where most matches are inliers nobody asks.
    assert main(["verify", str(database), "--min-coherence", "1"]) == 0
    done = verify_matches(database, min_coherence=1.0)
    assert (done.n_verified, done.n_few, done.n_incoherent) == (3, 0, 1)
    with pytest.raises(ValueError, match="min_coherence is nan"):
        verify_matches(database, min_coherence=np.nan)


@pytest.mark.parametrize("method", ["lmeds", "FM_7POINT", 2])
def test_most_being_inliers_says_nothing_where_they_always_are(database, made, method):
    _, points1, points2 = list(made[1].values())[2]  # the junk
    assert estimate_fundamental(points1, points2, method=method).mask.mean() > 0.5
    verify_matches(database, method=method)
    assert rows(database)[2][4] == DEGENERATE
    assert verify_matches(database, method=method, min_coherence=1.0).n_verified == 0
    assert verify_matches(database, method=method, min_coherence=-1.0).n_verified == 4


def refused(path, capsys, *options):
    """The one line, and the file as it was."""
    before = folder_of(path)
    assert main(["verify", str(path), *options]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"cv-densityf: {path}: ")
    assert err.count("\n") == 1
    assert folder_of(path) == before
    return err


def test_refuses_what_is_no_colmap_database(tmp_path, capsys):
    text = tmp_path / "text.db"
    text.write_text("hello " * 1000)
    assert "not a SQLite database" in refused(text, capsys)
    empty = tmp_path / "empty.db"
    empty.touch()
    assert "not a COLMAP database" in refused(empty, capsys)
    other = tmp_path / "other.db"
    sql(other, "CREATE TABLE images (name TEXT)")
    assert "it has no table keypoints" in refused(other, capsys)
    assert main(["verify", str(tmp_path)]) == 2
    assert "a folder" in capsys.readouterr().err
    assert main(["verify", str(tmp_path / "missing.db")]) == 2
    assert "No such file" in capsys.readouterr().err
    assert not (tmp_path / "missing.db").exists()


def test_refuses_without_matches(tmp_path, capsys):
    path = tmp_path / "unmatched.db"
    make_database(path, 0)
    assert "no matches in it" in refused(path, capsys)


def test_refuses_a_read_only_file_unless_dry(database, capsys):
    os.chmod(database, 0o444)
    assert "read-only" in refused(database, capsys)
    assert main(["verify", str(database), "--dry-run", "--jobs", "1"]) == 0


def test_refuses_a_locked_database(database, capsys, monkeypatch):
    monkeypatch.setattr("cv_densityf.colmap._PATIENCE", 0.1)
    holder = sqlite3.connect(database, isolation_level=None)
    holder.execute("BEGIN IMMEDIATE")
    with monkeypatch.context() as early:
        # Not after an hour's work.
        early.setattr("cv_densityf.colmap.estimate_many", pytest.fail)
        assert "another program has it locked" in refused(database, capsys)
    holder.execute("ROLLBACK")
    holder.close()
    assert main(["verify", str(database), "--jobs", "1"]) == 0


@pytest.mark.parametrize("where", [0.25, 0.5, 0.75])
def test_refuses_a_damaged_database(database, capsys, where):
    size = os.path.getsize(database)
    with open(database, "r+b") as stream:
        stream.seek(int(where * size) // 4096 * 4096)
        stream.write(b"\xa5" * 40960)
    refused(database, capsys)


def test_refuses_a_database_with_damage_where_nobody_looks(database, capsys):
    ((page,),) = sql(database, "SELECT rootpage FROM sqlite_master WHERE name = 'index_name'")
    ((size,),) = sql(database, "PRAGMA page_size")
    with open(database, "r+b") as stream:
        stream.seek((page - 1) * size)
        stream.write(b"\xa5" * size)
    assert "restore it from a copy" in refused(database, capsys)


def test_a_dry_run_could_not_write_if_it_would(database):
    with (
        pytest.raises(InputError, match="cannot be written"),
        _open(database, write=False) as connection,
    ):
        connection.execute("DELETE FROM matches")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ("UPDATE matches SET rows = rows + 1", "4 entries of matches have the wrong size"),
        ("UPDATE keypoints SET cols = 3 WHERE image_id = 1", "1 entries of keypoints"),
        ("UPDATE matches SET cols = 1, rows = 2 * rows", "matches have the wrong size"),
        ("DELETE FROM keypoints WHERE image_id = 1", "images 1 and 2 name keypoints"),
    ],
)
def test_refuses_entries_that_make_no_sense(database, capsys, change, complaint):
    sql(database, change)
    assert complaint in refused(database, capsys, "--jobs", "1")


def test_wrong_options(database, capsys):
    for options in (["--min-inliers", "7"], ["--threshold", "0"], ["--jobs", "0"]):
        with pytest.raises(SystemExit) as stopped:
            main(["verify", str(database), *options])
        assert stopped.value.code == 2
    with pytest.raises(ValueError, match="min_inliers is 7"):
        verify_matches(database, min_inliers=7)
    before = rows(database)
    with pytest.raises(ValueError, match="unknown method"):
        verify_matches(database, method="magic")
    with pytest.raises(TypeError, match="a COLMAP database has no place for them"):
        verify_matches(database, scores=np.ones(300))
    assert rows(database) == before


KILLED_RUN = """
import sys
import cv_densityf.colmap as colmap
colmap._CHUNK = 8
colmap.verify_matches(sys.argv[1], n_jobs=1)
"""


def test_killed_at_any_point_the_database_is_intact_and_resume_goes_on(tmp_path):
    path = tmp_path / "many.db"
    make_database(path, 160, n=200)
    whole = tmp_path / "whole.db"
    shutil.copy(path, whole)
    verify_matches(whole)
    counts = []
    for target in (1, 60):
        child = subprocess.Popen([sys.executable, "-c", KILLED_RUN, str(path)])
        end = time.monotonic() + 60
        while len(rows(path)) < target and time.monotonic() < end:
            time.sleep(0.01)
        child.send_signal(signal.SIGKILL)
        child.wait()
        assert sql(path, "PRAGMA integrity_check") == [("ok",)]
        counts.append(len(rows(path)))
        # The second run starts anew; a whole transaction is there or nothing of it.
        assert 0 < counts[-1] < 160
        assert counts[-1] % 8 == 0
    done = verify_matches(path, resume=True)
    assert done.n_before == counts[-1]
    assert rows(path) == rows(whole)


def test_a_pair_that_fails_is_named_and_left_to_resume(database, monkeypatch):
    import cv_densityf.batch as batch

    # What an earlier run has found for that pair does not stay.
    verify_matches(database)
    genuine = batch.estimate_fundamental
    calls = []

    def fails_once(points1, points2, **options):
        calls.append(len(points1))
        if len(calls) == 4:  # the first two check the options
            raise MemoryError("no room")
        return genuine(points1, points2, **options)

    monkeypatch.setattr(batch, "estimate_fundamental", fails_once)
    done = verify_matches(database)
    assert [failure[:2] for failure in done.failures] == [(3, 4)]
    assert "no room" in done.failures[0][2]
    assert len(rows(database)) == 3
    assert verify_matches(database, resume=True).n_before == 3
    assert len(rows(database)) == 4


@pytest.mark.parametrize("wrong", [{"threshold": -3.0}, {"n_jobs": 0}, {"nonsense": 1}])
def test_wrong_options_are_refused_even_if_nothing_is_left_to_do(database, wrong):
    verify_matches(database)
    with pytest.raises((TypeError, ValueError)):
        verify_matches(database, resume=True, **wrong)


def test_not_even_half_a_transaction(database, monkeypatch):
    import cv_densityf.colmap as colmap

    verify_matches(database)
    before = rows(database)
    genuine = colmap._row

    def broken(pair_id, *rest):
        row = genuine(pair_id, *rest)
        return (*row[:-1], object()) if pair_id == before[-1][0] else row

    monkeypatch.setattr(colmap, "_row", broken)
    with pytest.raises((sqlite3.Error, InputError)):
        verify_matches(database)
    assert rows(database) == before
