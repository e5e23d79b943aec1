from __future__ import annotations

import io
import itertools
import os
import pickle
import re
import struct
import tracemalloc
import zipfile
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pandas
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cv_densityf import _files
from cv_densityf._files import InputError, read_matches, replacing

RNG = np.random.default_rng(0)
X = RNG.uniform(0, 1000, (12, 4))
SCORES = RNG.uniform(0, 1, 12)


def npy(array):
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npy_header(shape, descr="<f8"):
    """The start of an .npy file, which may claim anything."""
    header = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header


def archive(members):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as found:
        for name, content in members.items():
            found.writestr(name, content)
    return stream.getvalue()


class TestNpz:
    @pytest.mark.parametrize("names", [("points1", "points2"), ("pts1", "pts2")])
    @pytest.mark.parametrize("score", [None, "scores", "score"])
    def test_read(self, tmp_path, names, score):
        path = tmp_path / "matches.npz"
        extra = {} if score is None else {score: SCORES}
        np.savez(path, **{names[0]: X[:, :2], names[1]: X[:, 2:]}, F=np.eye(3), **extra)
        found, scores = read_matches(path)
        np.testing.assert_array_equal(found, X)
        if score is None:
            assert scores is None
        else:
            np.testing.assert_array_equal(scores, SCORES)

    @pytest.mark.parametrize("shape", [(12, 1), (1, 12)])
    def test_scores_in_a_column_or_a_row(self, tmp_path, shape):
        path, scores = tmp_path / "matches.npz", np.where(SCORES > 0.8, np.inf, SCORES)
        np.savez(path, points1=X[:, :2], points2=X[:, 2:], scores=scores.reshape(shape))
        np.testing.assert_array_equal(read_matches(path)[1], scores)

    @pytest.mark.parametrize("dtype", [np.float32, np.int16, np.float16])
    def test_any_real_numbers(self, tmp_path, dtype):
        path = tmp_path / "matches.npz"
        np.savez_compressed(path, points1=X[:, :2].astype(dtype), points2=X[:, 2:].astype(dtype))
        found, _ = read_matches(str(path))
        assert found.dtype == np.float64
        assert found.flags.c_contiguous
        np.testing.assert_array_equal(found, X.astype(dtype))

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            ({"a": X}, "needs the arrays points1 and points2; it holds a"),
            ({}, "it holds nothing"),
            ({"points1": X, "points2": X}, r"points1 must have the shape \(n, 2\), not \(12, 4\)"),
            ({"points1": X[:, :2], "points2": X[:5, 2:]}, "12 points in points1, 5 in points2"),
            (
                {"points1": X[:, :2], "points2": X[:, 2:], "scores": SCORES[:5]},
                "scores has 5 entries for 12 matches",
            ),
            (
                {"points1": X[:, :2], "points2": X[:, 2:], "scores": X[:6, :2]},
                r"scores has shape \(6, 2\)",
            ),
            ({"points1": X[:, :2].astype(str), "points2": X[:, 2:]}, "points1 must hold real"),
            ({"points1": X[:, :2] * 1j, "points2": X[:, 2:]}, "points1 must hold real"),
            ({"points1": np.float64(1), "points2": np.float64(1)}, "points1 must have the shape"),
        ],
    )
    def test_not_matches(self, tmp_path, content, message):
        path = tmp_path / "matches.npz"
        np.savez(path, **content)
        with pytest.raises(InputError, match=f"matches.npz: .*{message}"):
            read_matches(path)

    def test_pickles_are_refused(self, tmp_path):
        # Unpickling runs code of the file's author.
        class Bomb:
            def __reduce__(self):
                return os.mkdir, (str(tmp_path / "boom"),)

        path = tmp_path / "matches.npz"
        np.savez(path, points1=np.array([Bomb()], dtype=object), points2=X[:, 2:])
        with pytest.raises(InputError, match="points1 cannot be read"):
            read_matches(path)
        path.write_bytes(pickle.dumps(Bomb()))
        with pytest.raises(InputError, match=r"not a NumPy \.npz archive"):
            read_matches(path)
        assert not (tmp_path / "boom").exists()

    @pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04", b"\x93NUM"])
    def test_not_an_archive(self, tmp_path, content):
        path = tmp_path / "matches.npz"
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"not a NumPy \.npz archive"):
            read_matches(path)

    def test_npy_in_disguise(self, tmp_path):
        path = tmp_path / "matches.npz"
        with path.open("wb") as stream:
            np.save(stream, X)
        with pytest.raises(InputError, match="a single array"):
            read_matches(path)

    def test_damaged(self, tmp_path):
        path = tmp_path / "matches.npz"
        np.savez(path, points1=X[:, :2], points2=X[:, 2:])
        content = bytearray(path.read_bytes())
        position = content.find(X[:2, :2].tobytes())
        content[position + 3] ^= 0xFF
        path.write_bytes(content)
        with pytest.raises(InputError, match="points1 cannot be read"):
            read_matches(path)

    def refused(self, tmp_path, content):
        path = tmp_path / "matches.npz"
        path.write_bytes(content)
        with pytest.raises(InputError) as refusal:
            read_matches(path)
        message = str(refusal.value)
        assert message.isprintable()
        assert len(message) < len(str(path)) + 200
        return message.removeprefix(f"{path}: ")

    @pytest.mark.parametrize(
        "member",
        [
            b"",
            b"hello",
            b"\x93NUMPY\x01\x00\x04\x00",
            b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 0xFFFF,
            b"\x93NUMPY\x01\x00\x14\x00" + b"{'descr': '''abc,\n    ",
            npy_header("(10000000000000, 2)"),
            npy_header("(10000000, 2)"),
            npy_header("(-12, 2)"),
            npy_header("(12, 2)", "|O") + bytes(400),
            npy_header("(4611686018427387904, 4)"),
        ],
        ids=range(10),
    )
    @pytest.mark.parametrize("name", ["points1", "points1.npy"])
    def test_members_that_are_no_arrays(self, tmp_path, member, name):
        message = self.refused(tmp_path, archive({name: member, "points2.npy": npy(X[:, 2:])}))
        assert "points1 cannot be read (damaged, or a pickled object)" in message

    def test_every_byte_of_an_archive_may_be_wrong(self, tmp_path):
        """Compressed, so that the decompressor meets the damage before the check sum does."""
        content = archive({"points1.npy": npy(X[:, :2]), "points2.npy": npy(X[:, 2:])})
        rng = np.random.default_rng(0)
        refusals = set()
        for place, value in zip(
            itertools.chain(range(len(content)), rng.integers(0, len(content), 500)),
            itertools.chain(itertools.repeat(0xFF, len(content)), rng.integers(0, 255, 500)),
            strict=True,
        ):
            damaged = bytearray(content)
            damaged[place] = value
            path = tmp_path / "matches.npz"
            path.write_bytes(damaged)
            try:
                found, _ = read_matches(path)
            except InputError as error:
                refusals.add(str(error).split(": ", 1)[1].split(";")[0])
            else:  # in what nobody reads, such as a date
                np.testing.assert_array_equal(found, X)
        assert {"not a NumPy .npz archive", "needs the arrays points1 and points2"} <= refusals
        assert all(refusal.isprintable() for refusal in refusals)

    def test_encrypted(self, tmp_path):
        content = bytearray(archive({"points1.npy": npy(X[:, :2]), "points2.npy": npy(X[:, 2:])}))
        for signature, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
            content[content.find(signature) + flags] |= 1
        assert "points1 cannot be read" in self.refused(tmp_path, content)

    def test_names_from_the_file_are_shown_short_and_printable(self, tmp_path):
        names = [f"a\nb\x1b[31m{i}" for i in range(1000)]
        message = self.refused(tmp_path, archive(dict.fromkeys(names, b"")))
        assert message.startswith("needs the arrays points1 and points2; it holds a?b?[31m0, a?b")

    def test_more_matches_than_are_read(self, tmp_path, monkeypatch):
        monkeypatch.setattr(_files, "MAX_MATCHES", 12)
        for kind in (np.float64, np.int8):
            whole = archive({f"points{i}.npy": npy(np.ones((12, 2), kind)) for i in (1, 2)})
            (tmp_path / "matches.npz").write_bytes(whole)
            assert len(read_matches(tmp_path / "matches.npz")[0]) == 12
            more = archive({f"points{i}.npy": npy(np.ones((13, 2), kind)) for i in (1, 2)})
            message = self.refused(tmp_path, more)
            assert message == "points1 holds more than the 12 matches that are read"
        text = "1,2,3,4\n" * 12
        (tmp_path / "matches.csv").write_text("x,y,x',y'\n" + text)
        assert len(read_matches(tmp_path / "matches.csv")[0]) == 12
        (tmp_path / "matches.csv").write_text(text + "\n1,2,3,4\n")
        with pytest.raises(InputError, match="more than the 12 matches that are read"):
            read_matches(tmp_path / "matches.csv")

    @pytest.mark.parametrize("declared", [2**31, 1000], ids=["as it is", "as if it were small"])
    def test_a_bomb_is_not_unpacked(self, tmp_path, declared):
        """A hundred megabytes in a hundred kilobytes, whatever size the archive gives them."""
        n = 6_250_000
        content = bytearray(
            archive({"points1.npy": npy_header(f"({n}, 2)") + bytes(16 * n), "points2.npy": b""})
        )
        assert len(content) < 200_000
        for signature, size in ((b"PK\x03\x04", 22), (b"PK\x01\x02", 24)):
            struct.pack_into("<I", content, content.find(signature) + size, declared)
        tracemalloc.start()
        try:
            message = self.refused(tmp_path, content)
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        # The array itself is asked for before its numbers are seen, and never written to.
        assert peak < 10_000_000 + (16 * n if declared == 1000 else 0)
        assert ("more than the 10,000,000 matches" in message) == (declared > 1000)

    def test_long_doubles_beyond_double_are_infinite(self, tmp_path):
        points = np.full((12, 2), np.finfo(np.longdouble).max)
        path = tmp_path / "matches.npz"
        path.write_bytes(archive({"points1.npy": npy(points), "points2.npy": npy(X[:, 2:])}))
        found, _ = read_matches(path)
        assert (found[:, :2] > 1e308).all()
        np.testing.assert_array_equal(found[:, 2:], X[:, 2:])


class TestCsv:
    def read(self, tmp_path, text, encoding="utf-8"):
        path = tmp_path / "matches.csv"
        path.write_bytes(text.encode(encoding))
        return read_matches(path)

    @given(
        table=arrays(
            np.float64,
            st.tuples(st.integers(1, 9), st.sampled_from([4, 5])),
            elements=st.floats(allow_infinity=True, allow_nan=True),
        ),
        header=st.sampled_from(["", "x,y,x',y'", "# x1,y1,x2,y2", "X, Y, U, V"]),
        end=st.sampled_from(["\n", "\r\n"]),
    )
    def test_what_is_written_is_read(self, tmp_path_factory, table, header, end):
        if header and table.shape[1] == 5:
            header += ",score"
        lines = [header] if header else []
        lines += [",".join(repr(float(value)) for value in row) for row in table]
        text = end.join(lines) + end
        if np.isnan(table[:, 4:]).any():
            with pytest.raises(InputError, match=r"the score of match \d+ is NaN"):
                self.read(tmp_path_factory.getbasetemp(), text)
            return
        found, scores = self.read(tmp_path_factory.getbasetemp(), text)
        np.testing.assert_array_equal(found, table[:, :4])
        if table.shape[1] == 5:
            np.testing.assert_array_equal(scores, table[:, 4])
        else:
            assert scores is None

    def test_blanks_and_byte_order_mark(self, tmp_path):
        found, _ = self.read(tmp_path, "x1 , y1,x2,y2\n\n 1, 2,3 ,4\n\n", "utf-8-sig")
        assert found.tolist() == [[1, 2, 3, 4]]

    @pytest.mark.parametrize("text", ["", "\n\n", "x,y,x',y'\n"])
    def test_no_rows(self, tmp_path, text):
        found, scores = self.read(tmp_path, text)
        assert found.shape == (0, 4)
        assert scores is None

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("1,2,3\n", "line 1: 3 comma-separated columns, expected 4 or 5"),
            ("1 2 3 4\n", "line 1: 1 comma-separated columns, expected 4 or 5"),
            ("1;2;3;4\n", "header '1;2;3;4' is not"),
            ("1,2,3,4\n1,2,3,4,5\n", "line 2: 5 comma-separated columns, expected 4"),
            ("x,y,x',y'\n1,2,3,4\n1,2,3,4a\n", "line 3: '4a' is not a number"),
            ("1,2,3,\n", "line 1: '' is not a number"),
            ("x2,y2,x1,y1\n1,2,3,4\n", "header 'x2,y2,x1,y1' is not"),
            ("x,y,x',y',size\n1,2,3,4,5\n", "header .* is not"),
        ],
    )
    def test_not_matches(self, tmp_path, text, message):
        with pytest.raises(InputError, match=f"matches.csv: {message}"):
            self.read(tmp_path, text)

    def test_not_text(self, tmp_path):
        path = tmp_path / "matches.csv"
        path.write_bytes(b"\xff\xfe\x00\x01" * 10)
        with pytest.raises(InputError, match=r"not a text file of .* in UTF-8"):
            read_matches(path)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("1,2,3,4\n" + "1," * 500 + "x" * 500 + "\n", "line 2: 501 comma-separated columns"),
            ("1,2,3," + "x" * 500 + "\n", "line 1: 'x+\\.\\.\\.' is not a number"),
            ("x\x1b[31m" * 500, r"header 'x\?\[31mx.*\.\.\.' is not"),
            ('1,2,"3\n3",4\n1,2,3,4\n', r"line 2: '3\?3' is not a number"),
            ('1,2,3,4\n"1\n2\n', r"line 3: 1 comma-separated columns"),
        ],
    )
    def test_what_the_file_says_is_shown_short_and_printable(self, tmp_path, text, message):
        with pytest.raises(InputError, match=f"matches.csv: {message}") as refusal:
            self.read(tmp_path, text)
        assert str(refusal.value).isprintable()
        assert len(str(refusal.value)) < len(str(tmp_path)) + 200

    @pytest.mark.parametrize("unit", ["1,", "\0", '"1\n', "x"])
    def test_a_line_without_end_is_not_read(self, tmp_path, unit):
        path = tmp_path / "matches.csv"
        path.write_text("1,2,3,4\n" + unit * (30_000_000 // len(unit)))
        tracemalloc.start()
        try:
            with pytest.raises(InputError) as refusal:
                read_matches(path)
            assert tracemalloc.get_traced_memory()[1] < 3_000_000
        finally:
            tracemalloc.stop()
        assert len(str(refusal.value)) < len(str(tmp_path)) + 200

    @pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-32", "latin-1", "cp1252"])
    def test_other_encodings_than_utf_8(self, tmp_path, encoding):
        with pytest.raises(InputError, match=r"matches\.csv: (not a text file|header|line 1)"):
            self.read(tmp_path, "x,y,x',y',\xe9\n1,2,3,4,5\n", encoding)


def test_other_kinds_of_files_are_named(tmp_path):
    with pytest.raises(InputError, match=r"matches.txt: .*\.npz or a \.csv"):
        read_matches(tmp_path / "matches.txt")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes")
def test_an_npz_in_a_pipe_is_refused(tmp_path):
    path = tmp_path / "pipe.npz"
    os.mkfifo(path)
    with ThreadPoolExecutor(1) as writer:
        writer.submit(path.write_bytes, b"PK")
        with pytest.raises(InputError, match=r"a pipe; an \.npz has to be a file"):
            read_matches(path)


@pytest.mark.parametrize("name", ["matches.npz", "matches.csv"])
def test_missing(tmp_path, name):
    with pytest.raises(FileNotFoundError):
        read_matches(tmp_path / name)


class TestReplacing:
    def test_new_file(self, tmp_path):
        with replacing(tmp_path / "out.json") as temporary:
            assert temporary.suffix == ".json"
            temporary.write_text("new")
            assert not (tmp_path / "out.json").exists()
        assert [path.name for path in tmp_path.iterdir()] == ["out.json"]
        assert (tmp_path / "out.json").read_text() == "new"

    @pytest.mark.parametrize("error", [RuntimeError, OSError, KeyboardInterrupt])
    def test_failure_leaves_what_was_there(self, tmp_path, error):
        path = tmp_path / "out.json"
        path.write_text("old")

        def fail():
            with replacing(path) as temporary:
                temporary.write_text("half")
                raise error

        with pytest.raises(error):
            fail()
        assert [path.name for path in tmp_path.iterdir()] == ["out.json"]
        assert path.read_text() == "old"

    def test_same_rights_as_any_new_file(self, tmp_path):
        (tmp_path / "usual").touch()
        with replacing(tmp_path / "out.json") as temporary:
            temporary.write_text("new")
        assert (tmp_path / "out.json").stat().st_mode == (tmp_path / "usual").stat().st_mode

    def test_rights_of_the_file_before_stay(self, tmp_path):
        path = tmp_path / "out.json"
        path.touch(0o600)
        with replacing(path) as temporary:
            temporary.write_text("new")
        assert path.stat().st_mode & 0o777 == 0o600

    def test_a_link_stays_one(self, tmp_path):
        (tmp_path / "elsewhere").mkdir()
        link = tmp_path / "out.json"
        link.symlink_to(tmp_path / "elsewhere" / "real.json")
        with replacing(link) as temporary:
            temporary.write_text("new")
        assert link.is_symlink()
        assert (tmp_path / "elsewhere" / "real.json").read_text() == "new"

    def test_error_names_the_file_that_was_asked_for(self, tmp_path):
        path = tmp_path / "missing" / "out.json"
        with (
            pytest.raises(OSError, match=r"cannot write: .*missing/out\.json"),
            replacing(path) as temporary,
        ):
            temporary.write_text("new")


@pytest.mark.parametrize("n_columns", [4, 5])
def test_numbers_of_columns_that_pandas_wrote_are_no_match(tmp_path, n_columns):
    path = tmp_path / "m.csv"
    table = pandas.DataFrame(np.hstack([X, X])[:, :n_columns])
    table.to_csv(path, index=False)
    with pytest.raises(InputError, match=r"line 1: 0,1,2,3.* is a header as pandas") as refusal:
        read_matches(path)
    header = re.search(r"put (\S+) in its place", str(refusal.value))[1]
    table.to_csv(path, index=False, header=header.split(","))
    np.testing.assert_array_equal(read_matches(path)[0], X)
    counted = ",".join("01234"[:n_columns])
    path.write_text(f"{header}\n{counted}\n")
    np.testing.assert_array_equal(read_matches(path)[0], [[0, 1, 2, 3]])


@pytest.mark.parametrize(
    ("text", "asked"),
    [(",x1,y1,x2,y2\n0,1,2,3,4\n", True), ("x1,y1,x2,y2\n1,2,,4\n", False)],
    ids=["index", "gap"],
)
def test_an_index_that_pandas_wrote_is_asked_about(tmp_path, text, asked):
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(InputError) as error:
        read_matches(tmp_path / "m.csv")
    assert ("as pandas writes it" in str(error.value)) == asked
