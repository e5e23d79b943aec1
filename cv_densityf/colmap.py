"""Verify the matches of a COLMAP database, in place of COLMAP's own geometric verification.

Python's SQLite reads and writes the database. ``pycolmap.Database`` (4.2) changes a file by opening
it, does not wait for locks, and commits what an exception has interrupted.
"""

from __future__ import annotations

import os
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from numbers import Integral, Real
from pathlib import Path
from typing import Any
from urllib.request import pathname2url

import numpy as np
from numpy.typing import NDArray

from cv_densityf._arguments import check
from cv_densityf._coherence import coherence
from cv_densityf._engine import has_threshold, method_flag
from cv_densityf._estimate import Estimate
from cv_densityf._files import InputError
from cv_densityf._prefilter import COHERENT
from cv_densityf.batch import estimate_many, progress_bar

#: COLMAP's names for what two views can be.
DEGENERATE, UNCALIBRATED = 1, 3
#: ``pair_id = image_id1 * _PAIR_BASE + image_id2``, with image_id1 < image_id2.
_PAIR_BASE = 2**31 - 1
_TABLES = {"images", "keypoints", "matches", "two_view_geometries"}
#: Pairs per transaction: what a killed run has to do again.
_CHUNK = 256
_CACHED_IMAGES = 512
#: What comes of a pair.
_VERIFIED, _FEW, _INCOHERENT = "verified", "few inliers", "incoherent"
#: Seconds to wait for another program's lock.
_PATIENCE = 5.0

Indices = NDArray[np.uint32]


@dataclass(frozen=True)
class Verification:
    """What `verify_matches` did.

    Attributes
    ----------
    n_pairs : int
        Image pairs with an entry in the table of matches.
    n_before : int
        Of these, pairs that were verified before and left alone (``resume``).
    n_verified : int
        Pairs now found to overlap: with a fundamental matrix and enough, coherent inliers.
    n_few, n_incoherent : int
        Pairs left out: with no fundamental matrix or too few inliers, and with incoherent ones.
    n_matches, n_inliers : int
        Matches looked at now, and inliers among them.
    failures : tuple of (int, int, str)
        Pairs that were not estimated, by image ids, and why. Nothing is written for them.
    """

    n_pairs: int
    n_before: int
    n_verified: int
    n_few: int
    n_incoherent: int
    n_matches: int
    n_inliers: int
    failures: tuple[tuple[int, int, str], ...]


def verify_matches(
    database: str | os.PathLike[str],
    *,
    method: str = "usac_accurate",
    threshold: float = 4.0,
    min_inliers: int = 15,
    min_coherence: float = COHERENT,
    n_jobs: int | None = None,
    resume: bool = False,
    dry_run: bool = False,
    progress: bool | None = None,
    **options: Any,
) -> Verification:
    """Estimate F for every matched image pair of a COLMAP database, and write what it verifies.

    Parameters
    ----------
    database : str or path-like
        SQLite database with keypoints and matches, as COLMAP's or pycolmap's feature extraction
        and matching leave it.
    method : str
        As in `estimate_fundamental`.
    threshold : float
        Largest residual of an inlier, pixels. COLMAP's default is 4.
    min_inliers : int
        A pair with fewer is written as degenerate, without inliers; at least 8. COLMAP's default
        is 15.
    min_coherence : float
        Likewise a pair whose inliers have less of `coherence`, at most 1: wrong matches, of which
        some are always within 4 pixels of their lines. Not asked for where most are inliers,
        unless by ``"lmeds"``, ``"7point"`` or ``"8point"``, to which most always are.
    n_jobs : int, optional
        Pairs at a time, as in `estimate_many`; -1 for one per core.
    resume : bool
        Leave alone the pairs that have a two-view geometry. Otherwise those of all pairs with
        matches are replaced.
    dry_run : bool
        Estimate everything and write nothing.
    progress : bool, optional
        Show a bar on standard error. By default if that is a terminal and tqdm is installed.
    **options
        Further options of `estimate_fundamental`, all but ``scores``.

    Returns
    -------
    Verification

    Raises
    ------
    cv_densityf.InputError
        A ``ValueError``: the file is not a COLMAP database with matches, is damaged, locked or
        cannot be written. Before anything is written, unless the trouble begins later.
    OSError
        If there is no such file.
    TypeError, ValueError
        If an option is wrong.

    See Also
    --------
    estimate_many : Estimates the pairs.

    Notes
    -----
    Results are written in transactions of some hundred pairs. A run that is killed leaves the
    database as it was after the last one; ``resume`` does what is missing.

    A verified pair gets its inlier matches, F and the configuration UNCALIBRATED; COLMAP's mapper
    takes focal lengths from the cameras whatever the configuration says. Planar and panoramic
    pairs are not told apart.
    """
    check("min_inliers", min_inliers, Integral, lambda v: v >= 8, "an integer of 8 and more")
    check("min_coherence", min_coherence, Real, lambda v: v <= 1, "a number up to 1")
    if "scores" in options:
        raise TypeError("scores cannot be given: a COLMAP database has no place for them")
    asked: dict[str, Any] = {
        "n_jobs": n_jobs, "progress": False, "method": method, "threshold": threshold, **options
    }  # fmt: skip
    path = Path(database)
    with _open(path, write=not dry_run) as connection:
        n_pairs = _check(connection)
        # Checks the options, also where there is nothing left to do.
        estimate_many((), **asked)
        most_will_do = has_threshold(method_flag(method))
        where = "WHERE pair_id NOT IN (SELECT pair_id FROM two_view_geometries)" if resume else ""
        todo = [
            pair_id
            for (pair_id,) in connection.execute(
                f"SELECT pair_id FROM matches {where} ORDER BY pair_id"
            )
        ]
        keypoints = lru_cache(_CACHED_IMAGES)(lambda image_id: _keypoints(connection, image_id))
        verdicts: Counter[str] = Counter()
        n_matches = n_inliers = 0
        failures = []
        with progress_bar(len(todo), progress) as update:
            for start in range(0, len(todo), _CHUNK):
                part = todo[start : start + _CHUNK]
                pairs = [_load(connection, keypoints, pair_id) for pair_id in part]
                estimates = estimate_many([points for _, points in pairs], **asked)
                rows = []
                for pair_id, (matches, points), estimate in zip(
                    part, pairs, estimates, strict=True
                ):
                    update()
                    n_matches += len(matches)
                    if estimate.engine == "none":
                        failures.append((*image_ids(pair_id), estimate.reason))
                        continue
                    verdict = _verdict(points, estimate, min_inliers, min_coherence, most_will_do)
                    verdicts[verdict] += 1
                    row = _row(pair_id, matches, estimate if verdict == _VERIFIED else None)
                    n_inliers += row[1]
                    rows.append(row)
                if not dry_run:
                    replace = start == 0 and not resume
                    _write(connection, rows, replace)
    return Verification(
        n_pairs=n_pairs,
        n_before=n_pairs - len(todo),
        n_verified=verdicts[_VERIFIED],
        n_few=verdicts[_FEW],
        n_incoherent=verdicts[_INCOHERENT],
        n_matches=n_matches,
        n_inliers=n_inliers,
        failures=tuple(failures),
    )


@contextmanager
def _open(path: Path, *, write: bool) -> Iterator[sqlite3.Connection]:
    """Open an existing database; SQLite's complaints become one line that says what to do."""
    path.stat()  # Says what is wrong with a missing file better than SQLite does.
    if path.is_dir():
        raise InputError(f"{path}: a folder; give the database file in it")
    if write and not (os.access(path, os.W_OK) and path.stat().st_mode & 0o222):
        raise InputError(f"{path}: read-only; make it writable, or ask for a dry run")
    # COLMAP's write-ahead log: who may only read would leave an empty one behind, and who may write
    # would put into the database what a killed program has left in it.
    logged = path.with_name(f"{path.name}-wal").exists()
    mode = "rw" if write or not logged else "ro"
    url = f"file:{pathname2url(str(path.absolute()))}?mode={mode}"
    try:
        # Transactions are begun by hand: the module's own begin later than the lock must.
        with closing(
            sqlite3.connect(url, uri=True, timeout=_PATIENCE, isolation_level=None)
        ) as connection:
            if write:
                # A lock is found now, not after an hour's work.
                connection.execute("BEGIN IMMEDIATE")
                connection.execute("ROLLBACK")
            else:
                connection.execute("PRAGMA query_only = ON")
            yield connection
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except sqlite3.OperationalError as error:
        if "locked" in str(error):
            raise InputError(
                f"{path}: another program has it locked; end that one, then resume"
            ) from None
        if "readonly" in str(error):
            raise InputError(
                f"{path}: cannot be written, as SQLite must even to read it; make its folder "
                "writable too, or take a copy"
            ) from None
        raise InputError(f"{path}: {error}") from None
    except sqlite3.DatabaseError as error:
        raise InputError(f"{path}: not a SQLite database, or damaged ({error})") from None


def _check(connection: sqlite3.Connection) -> int:
    """Count the pairs, if this is an intact COLMAP database that has some."""
    tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master")}
    if missing := sorted(_TABLES - tables):
        raise InputError(f"not a COLMAP database: it has no table {missing[0]}")
    (verdict,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    if verdict != "ok":
        raise InputError(f"damaged ({verdict.splitlines()[-1]}); restore it from a copy")
    for table, width in (("matches", "cols = 2"), ("keypoints", "cols >= 2")):
        (odd,) = connection.execute(
            f"SELECT count(*) FROM {table} "
            f"WHERE rows > 0 AND NOT ({width} AND 4 * rows * cols = coalesce(length(data), 0))"
        ).fetchone()
        if odd:
            raise InputError(f"damaged: {odd} entries of {table} have the wrong size")
    (n_pairs,) = connection.execute("SELECT count(*) FROM matches").fetchone()
    if not n_pairs:
        raise InputError("no matches in it; run one of COLMAP's matchers first")
    return int(n_pairs)


def _load(
    connection: sqlite3.Connection,
    keypoints: Callable[[int], NDArray[np.float32]],
    pair_id: int,
) -> tuple[Indices, tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Read the matches of a pair, (m, 2) indices, and the points they join."""
    (data,) = connection.execute("SELECT data FROM matches WHERE pair_id = ?", [pair_id]).fetchone()
    matches = np.frombuffer(data or b"", dtype=np.uint32).reshape(-1, 2)
    image_id1, image_id2 = image_ids(pair_id)
    first, second = keypoints(image_id1), keypoints(image_id2)
    if len(matches) and (matches.max(axis=0) >= (len(first), len(second))).any():
        raise InputError(
            f"the matches of images {image_id1} and {image_id2} name keypoints that do not exist; "
            "match these images again"
        )
    return matches, (first[matches[:, 0]], second[matches[:, 1]])


def _keypoints(connection: sqlite3.Connection, image_id: int) -> NDArray[np.float32]:
    """Read x and y of an image's keypoints, (n, 2), pixels; (0, 2) if there are none."""
    found = connection.execute(
        "SELECT cols, data FROM keypoints WHERE image_id = ?", [image_id]
    ).fetchone()
    if found is None or not found[1]:
        return np.empty((0, 2), dtype=np.float32)
    cols, data = found
    return np.frombuffer(data, dtype=np.float32).reshape(-1, cols)[:, :2].copy()


def image_ids(pair_id: int) -> tuple[int, int]:
    """Split COLMAP's number of a pair into those of its images."""
    return divmod(pair_id, _PAIR_BASE)


def _verdict(
    points: tuple[NDArray[np.float32], NDArray[np.float32]],
    estimate: Estimate,
    min_inliers: int,
    min_coherence: float,
    most_will_do: bool,
) -> str:
    """Whether there are enough inliers, and these coherent or, if that will do, most matches."""
    n = estimate.n_inliers
    if n < min_inliers:
        return _FEW
    most = most_will_do and 2 * n > len(estimate.mask)
    coherent = most or coherence(*points, estimate.mask) >= min_coherence
    return _VERIFIED if coherent else _INCOHERENT


def _row(
    pair_id: int, matches: Indices, verified: Estimate | None
) -> tuple[int, int, bytes | None, int, bytes | None]:
    """Give pair_id, rows, data, config and F as the table of two-view geometries has them."""
    if verified is None:
        return pair_id, 0, None, DEGENERATE, None
    inliers = np.ascontiguousarray(matches[verified.mask])
    F = np.asarray(verified.F, dtype=np.float64)
    return pair_id, len(inliers), inliers.tobytes(), UNCALIBRATED, F.tobytes()


def _write(connection: sqlite3.Connection, rows: list[Any], replace: bool) -> None:
    """Write two-view geometries in one transaction; with ``replace`` drop the old of all pairs."""
    with connection:
        connection.execute("BEGIN IMMEDIATE")
        if replace:
            connection.execute(
                "DELETE FROM two_view_geometries WHERE pair_id IN (SELECT pair_id FROM matches)"
            )
        connection.executemany(
            "INSERT OR REPLACE INTO two_view_geometries (pair_id, rows, cols, data, config, F) "
            "VALUES (?, ?, 2, ?, ?, ?)",
            rows,
        )
