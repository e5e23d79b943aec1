from __future__ import annotations

import os
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cv_densityf._files import InputError, read_matches, replacing

RNG = np.random.default_rng(0)
X = RNG.uniform(0, 1000, (12, 4))
SCORES = RNG.uniform(0, 1, 12)


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
                r"scores must have the shape \(12,\), not \(5,\)",
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

    @pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04", b"\x93NUMPY"])
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
        header=st.sampled_from(["", "x,y,x',y'", "x1,y1,x2,y2", "X, Y, U, V"]),
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
            ("1 2 3 4\n", "header '1 2 3 4' is not"),
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
        with pytest.raises(InputError, match="not a text file"):
            read_matches(path)


def test_other_kinds_of_files_are_named(tmp_path):
    with pytest.raises(InputError, match=r"matches.txt: .*\.npz or a \.csv"):
        read_matches(tmp_path / "matches.txt")


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
