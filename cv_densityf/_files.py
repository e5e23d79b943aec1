"""Matches from files, and files written whole or not at all."""

from __future__ import annotations

import csv
import os
import shutil
import zipfile
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from uuid import uuid4

import numpy as np
from numpy.lib.format import MAGIC_PREFIX
from numpy.typing import NDArray

from cv_densityf._arguments import check_scores

#: No file is read that holds more matches: memory would not bear what follows either.
MAX_MATCHES = 10_000_000
#: Bytes of that many points in the widest numbers there are.
_MAX_BYTES = 32 * MAX_MATCHES
#: Longest line of a table, in characters.
_MAX_LINE = 10_000
#: Most characters of a file's own text in a message.
_MAX_SHOWN = 60

_POINT_KEYS = (("points1", "points2"), ("pts1", "pts2"))
_SCORE_KEYS = ("scores", "score")
_HEADERS = (
    ("x", "y", "x'", "y'"),
    ("x1", "y1", "x2", "y2"),
    ("x", "y", "u", "v"),
)
#: What pandas writes as a header where columns have no names, and what it should be.
_NAMES = {"0,1,2,3": "x,y,x',y'", "0,1,2,3,4": "x,y,x',y',score"}


class InputError(ValueError):
    """A file that is not what it should be; the message is one line and says what to do.

    `cv_densityf.read_image` and `cv_densityf.colmap.verify_matches` raise it, as does the command
    line, which prints the message and ends with 2.
    """


def read_matches(
    path: str | os.PathLike[str],
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Read matches from an ``.npz`` or a ``.csv`` file.

    Parameters
    ----------
    path : str or path-like
        ``.npz``: arrays ``points1`` and ``points2`` (or ``pts1`` and ``pts2``), each (n, 2) in
        pixels, and optionally ``scores`` (or ``score``), (n,) or (n, 1); pickled objects are
        refused.
        ``.csv``: comma-separated columns x, y, x', y' and optionally a score; one header row of
        these names is allowed, and needed if the first match is 0,1,2,3 (and score 4), which
        pandas writes as a header. Up to ten million matches are read.

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
        if scores is not None:
            scores = _checked(scores, len(X))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return np.ascontiguousarray(X, dtype=np.float64), scores


def _checked(scores: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    nan = np.flatnonzero(np.isnan(scores))
    if nan.size:
        raise InputError(f"the score of match {nan[0] + 1} is NaN; give a low score instead")
    try:
        return check_scores(scores, n)
    except ValueError as error:
        raise InputError(str(error)) from None


def _read_npz(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    with path.open("rb") as stream:
        if not stream.seekable():
            raise InputError("a pipe; an .npz has to be a file, a .csv need not")
        if stream.read(len(MAGIC_PREFIX)) == MAGIC_PREFIX:
            raise InputError("a single array; save points1 and points2 with numpy.savez")
        with _refusing("not a NumPy .npz archive"):
            archive = zipfile.ZipFile(stream)
            members = {each.filename.removesuffix(".npy"): each for each in archive.infolist()}
        names = next((pair for pair in _POINT_KEYS if members.keys() >= set(pair)), None)
        if names is None:
            found = _shortened(", ".join(members) or "nothing")
            raise InputError(f"needs the arrays points1 and points2; it holds {found}")
        points1, points2 = (_numbers(archive, members[name], name) for name in names)
        score_key = next((key for key in _SCORE_KEYS if key in members), None)
        scores = None if score_key is None else _numbers(archive, members[score_key], score_key)
    for name, points in zip(names, (points1, points2), strict=True):
        if points.ndim != 2 or points.shape[1] != 2:
            raise InputError(f"{name} must have the shape (n, 2), not {points.shape}")
    if len(points1) != len(points2):
        raise InputError(f"{len(points1)} points in {names[0]}, {len(points2)} in {names[1]}")
    return np.hstack([points1, points2]), scores


def _numbers(archive: zipfile.ZipFile, member: zipfile.ZipInfo, name: str) -> NDArray[np.float64]:
    too_large = InputError(f"{name} holds more than the {MAX_MATCHES:,} matches that are read")
    # A small file may unpack to anything, but to no more than it says here.
    if member.file_size > _MAX_BYTES:
        raise too_large
    damaged = f"{name} cannot be read (damaged, or a pickled object)"
    with _refusing(damaged), archive.open(member) as stream:
        values = np.lib.format.read_array(stream, allow_pickle=False)
    if values.dtype.kind not in "fiu":
        raise InputError(f"{name} must hold real numbers, not {_shortened(str(values.dtype))}")
    if values.size > 2 * MAX_MATCHES:
        raise too_large
    with np.errstate(all="ignore"):
        return np.asarray(values, dtype=np.float64)


@contextmanager
def _refusing(message: str) -> Iterator[None]:
    """Raise `InputError` for whatever goes wrong: of damaged bytes decoders raise anything."""
    try:
        yield
    except Exception:
        raise InputError(message) from None


def _read_csv(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    rows = _csv_rows(path)
    first = next(rows, None)
    if first is not None and (header := _NAMES.get(",".join(first[1]))):
        raise InputError(
            f"line {first[0]}: {','.join(first[1])} is a header as pandas writes it, or a match; "
            f"put {header} in its place or, if it is a match, before it"
        )
    if first is not None and not all(map(_is_number, first[1][0].split())):
        # As numpy's savetxt writes it.
        first[1][0] = first[1][0].removeprefix("#").strip()
        _check_header(first[1])
        first = next(rows, None)
    if first is None:
        return np.empty((0, 4)), None
    width = len(first[1])
    numbers = array("d")
    for line, cells in chain([first], rows):
        if width not in (4, 5) or len(cells) != width:
            wanted = "4 or 5" if width not in (4, 5) else str(width)
            raise InputError(
                f"line {line}: {len(cells)} comma-separated columns, expected {wanted} "
                "(x, y, x', y' and optionally a score)"
            )
        if len(numbers) == width * MAX_MATCHES:
            raise InputError(f"more than the {MAX_MATCHES:,} matches that are read")
        try:
            numbers.extend([float(cell) for cell in cells])
        except ValueError:
            bad = next(cell for cell in cells if not _is_number(cell))
            hint = "" if cells[0] else "; is the first column an index, as pandas writes it?"
            raise InputError(f"line {line}: {_shortened(bad)!r} is not a number{hint}") from None
    table = np.array(numbers).reshape(-1, width)
    return table[:, :4], table[:, 4] if width == 5 else None


def _csv_rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the cells of each line that is not blank."""
    with path.open(newline="", encoding="utf-8-sig") as stream:
        # Pieces of lines, since a file without line ends would fill the memory.
        reader = csv.reader(iter(lambda: stream.readline(_MAX_LINE), ""))
        try:
            for row in reader:
                cells = [cell.strip() for cell in row]
                if any(cells):
                    yield reader.line_num, cells
        except (UnicodeDecodeError, csv.Error):
            raise InputError("not a text file of comma-separated values in UTF-8") from None


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _shortened(text: str) -> str:
    """Text from a file, short enough for a message of one line and harmless to a terminal."""
    text = text if len(text) <= _MAX_SHOWN else text[: _MAX_SHOWN - 3] + "..."
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def _check_header(cells: list[str]) -> None:
    # Names in another order would swap the images without a word.
    names = tuple(cell.lower() for cell in cells)
    shown = _shortened(",".join(cells))
    if names[:4] not in _HEADERS or (len(names) == 5 and names[4] not in _SCORE_KEYS):
        raise InputError(
            f"header {shown!r} is not x,y,x',y' or x1,y1,x2,y2, separated by commas, with score "
            "as an optional fifth name"
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
    temporary = target.with_name(f".{target.stem}-{uuid4().hex}{target.suffix}")
    try:
        yield temporary
        if target.exists():
            shutil.copymode(target, temporary)
        os.replace(temporary, target)
    except OSError as error:
        # The temporary name would tell the caller nothing.
        raise OSError(error.errno, f"cannot write: {error.strerror or error}", str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)
