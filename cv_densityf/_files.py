"""Matches from files, and files written whole or not at all."""

from __future__ import annotations

import csv
import os
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_POINT_KEYS = (("points1", "points2"), ("pts1", "pts2"))
_SCORE_KEYS = ("scores", "score")
_HEADERS = (
    ("x", "y", "x'", "y'"),
    ("x1", "y1", "x2", "y2"),
    ("x", "y", "u", "v"),
)


class InputError(ValueError):
    """A file that is not what it should be; the message is one line and says what to do."""


def read_matches(
    path: str | os.PathLike[str],
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Read matches from an ``.npz`` or a ``.csv`` file.

    Parameters
    ----------
    path : str or path-like
        ``.npz``: arrays ``points1`` and ``points2`` (or ``pts1`` and ``pts2``), each (n, 2) in
        pixels, and optionally ``scores`` (or ``score``), (n,); pickled objects are refused.
        ``.csv``: comma-separated columns x, y, x', y' and optionally a score; one header row is
        allowed.

    Returns
    -------
    X : (n, 4) float64
        The columns x, y, x', y', in pixels.
    scores : (n,) float64 or None
        Higher means more trusted.

    Raises
    ------
    InputError
        If the file does not hold matches.
    OSError
        If the file cannot be read.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".npz", ".csv"):
        raise InputError(f"{path}: matches are read from a .npz or a .csv file")
    try:
        X, scores = _read_npz(path) if suffix == ".npz" else _read_csv(path)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if scores is not None and np.isnan(scores).any():
        row = int(np.flatnonzero(np.isnan(scores))[0]) + 1
        raise InputError(f"{path}: the score of match {row} is NaN; give a low score instead")
    return np.ascontiguousarray(X, dtype=np.float64), scores


def _read_npz(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    with path.open("rb") as stream:
        try:
            archive = np.load(stream, allow_pickle=False)
        except (ValueError, EOFError, zipfile.BadZipFile):
            raise InputError("not a NumPy .npz archive") from None
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise InputError("a single array; save points1 and points2 with numpy.savez")
        names = next((pair for pair in _POINT_KEYS if set(pair) <= set(archive.files)), None)
        if names is None:
            found = ", ".join(archive.files) or "nothing"
            raise InputError(f"needs the arrays points1 and points2; it holds {found}")
        points1, points2 = (_numbers(archive, name) for name in names)
        score_key = next((key for key in _SCORE_KEYS if key in archive.files), None)
        scores = None if score_key is None else _numbers(archive, score_key)
    for name, points in zip(names, (points1, points2), strict=True):
        if points.ndim != 2 or points.shape[1] != 2:
            raise InputError(f"{name} must have the shape (n, 2), not {points.shape}")
    if len(points1) != len(points2):
        raise InputError(f"{len(points1)} points in {names[0]}, {len(points2)} in {names[1]}")
    if scores is not None and scores.shape != (len(points1),):
        raise InputError(f"{score_key} must have the shape ({len(points1)},), not {scores.shape}")
    return np.hstack([points1, points2]), scores


def _numbers(archive: np.lib.npyio.NpzFile, name: str) -> NDArray[np.float64]:
    try:
        values = archive[name]
    except (ValueError, zipfile.BadZipFile):
        raise InputError(f"{name} cannot be read (damaged, or a pickled object)") from None
    if values.dtype.kind not in "fiu":
        raise InputError(f"{name} must hold real numbers, not {values.dtype}")
    return np.asarray(values, dtype=np.float64)


def _read_csv(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            lines = [
                (number, [cell.strip() for cell in cells])
                for number, cells in enumerate(csv.reader(stream), start=1)
                if any(cell.strip() for cell in cells)
            ]
    except (UnicodeDecodeError, csv.Error):
        raise InputError("not a text file of comma-separated values") from None
    if lines and not _is_number(lines[0][1][0]):
        _check_header(lines.pop(0)[1])
    width = len(lines[0][1]) if lines else 4
    rows = []
    for number, cells in lines:
        if width not in (4, 5) or len(cells) != width:
            wanted = "4 or 5" if width not in (4, 5) else str(width)
            raise InputError(
                f"line {number}: {len(cells)} comma-separated columns, expected {wanted} "
                "(x, y, x', y' and optionally a score)"
            )
        try:
            rows.append([float(cell) for cell in cells])
        except ValueError:
            bad = next(cell for cell in cells if not _is_number(cell))
            raise InputError(f"line {number}: {bad!r} is not a number") from None
    table = np.array(rows, dtype=np.float64).reshape(-1, width)
    return table[:, :4], table[:, 4] if width == 5 else None


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _check_header(cells: list[str]) -> None:
    # Names in another order would swap the images without a word.
    names = tuple(cell.lower() for cell in cells)
    if names[:4] not in _HEADERS or (len(names) == 5 and names[4] not in _SCORE_KEYS):
        raise InputError(
            f"header {','.join(cells)!r} is not x,y,x',y' or x1,y1,x2,y2, with score as an "
            "optional fifth name"
        )


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary name beside ``path``, and rename it to ``path`` if nothing goes wrong.

    Parameters
    ----------
    path : str or path-like
        The file to write; it keeps its old contents until the new ones are complete. A symbolic
        link stays one, its target is replaced.

    Yields
    ------
    pathlib.Path
        The name to write to, with the suffix of ``path``.

    Raises
    ------
    OSError
        If it cannot be written, with ``path`` as its file name.
    """
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{target.stem}-{os.getpid()}{target.suffix}")
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        # The temporary name would tell the caller nothing.
        raise OSError(error.errno, f"cannot write: {error.strerror or error}", str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)
