"""Any call and any file: an answer of the right form or one clear refusal, in bounded memory.

Each target runs in a process of its own with little memory, where a crash of cv2 costs one test.
Without more said the calls are always the same; these are others, for ten minutes::

    CV_DENSITYF_FUZZ_MINUTES=10 python -m pytest tests/test_fuzz.py --timeout 0 -s
"""

from __future__ import annotations

import contextlib
import io
import json
import multiprocessing
import os
import struct
import sys
import tempfile
import time
import warnings
import zipfile
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.errors import HypothesisWarning
from hypothesis.extra import numpy as hnp

from cv_densityf import estimate_fundamental, findFundamentalMat
from cv_densityf.__main__ import main
from cv_densityf._engine import METHODS
from cv_densityf._files import InputError, read_matches
from cv_densityf.datasets import two_view_scene
from cv_densityf.estimators import (
    DensityPeaks,
    DensityPeaksFilter,
    FundamentalMatrixEstimator,
)

MINUTES = float(os.environ.get("CV_DENSITYF_FUZZ_MINUTES", "0"))
#: Bytes that a target may take beside what is loaded.
MEMORY = 2**31
#: Pixels that OpenCV may decode in the target of images.
PIXELS = 2**20
#: Calls of each target without MINUTES.
EXAMPLES = {"archives": 400, "tables": 400, "images": 60, "facade": 500, "estimate": 250}


def fuzzed(name):
    return settings(
        max_examples=EXAMPLES.get(name, 200),
        derandomize=not MINUTES,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )


# ------------------------------------------------------------------------------------- refusals


def assert_one_line(message, most=400):
    assert message
    assert message.isprintable(), message
    assert len(message) < most, message


def run_command(*arguments):
    """Run the command line: 0 with JSON, or one line on the standard error, C libraries' too."""
    out = io.StringIO()
    with tempfile.TemporaryFile() as said:
        terminal = os.dup(2)
        os.dup2(said.fileno(), 2)
        try:
            with contextlib.redirect_stdout(out):
                code = main([str(each) for each in arguments])
        except SystemExit as stop:
            code = stop.code
        finally:
            sys.stderr.flush()
            os.dup2(terminal, 2)
            os.close(terminal)
        said.seek(0)
        error = said.read().decode()
    if code == 0:
        report = json.loads(out.getvalue(), parse_constant=lambda name: pytest.fail(name))
        assert np.isfinite(report["F"]).all()
        return 0
    assert code in (1, 2)
    assert error.endswith("\n")
    assert_one_line(error[:-1])
    assert "memory" not in error
    return code


# ---------------------------------------------------------------------------------------- files


@st.composite
def damaged(draw, content):
    """Bytes with some of them changed, cut off, or said twice."""
    content = bytearray(content)
    kind = draw(st.sampled_from(["whole", "whole", "bytes", "cut", "twice"]))
    if content and kind == "bytes":
        for _ in range(draw(st.integers(1, 6))):
            content[draw(st.integers(0, len(content) - 1))] = draw(st.integers(0, 255))
    elif kind == "cut":
        content = content[: draw(st.integers(0, len(content)))]
    elif kind == "twice":
        place = draw(st.integers(0, len(content)))
        content[place:place] = content[: draw(st.integers(0, len(content)))]
    return bytes(content)


def npy(array):
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


@st.composite
def headers(draw):
    """The start of an .npy file that claims anything, and some bytes."""
    sides = st.integers(-2, 20) | st.sampled_from([10**6, 10**9, 2**31, 2**62, 10**30])
    shape = tuple(draw(st.lists(sides, max_size=4)))
    descr = draw(st.sampled_from(["<f8", "<f4", ">i2", "|b1", "|O", "|V0", "<U9", "<M8[s]", "x"]))
    text = f"{{'descr': {descr!r}, 'fortran_order': {draw(st.booleans())}, 'shape': {shape}, }}"
    text = draw(st.just(text) | st.text(max_size=40)).encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + draw(st.binary())


arrays = hnp.arrays(
    st.sampled_from(["f8", "f4", "f2", "i8", "u1", "?", "c16", "U3", "M8[s]", ">f8", "g"]),
    hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=30)
    | st.tuples(st.integers(0, 60), st.just(2)),
)
seeds = st.integers(0, 2**31 - 1)


def matches_of(seed, n, inlier_ratio=0.6):
    return two_view_scene(max(n, 1), inlier_ratio=inlier_ratio, random_state=seed).X[:n]


@st.composite
def archives(draw):
    X = matches_of(draw(seeds), draw(st.integers(0, 60)))
    good = {"points1": npy(X[:, :2]), "points2": npy(X[:, 2:]), "scores": npy(X[:, 0])}
    names = st.sampled_from(["points1", "points2", "pts1", "pts2", "scores", "score"])
    content = st.binary() | headers() | arrays.map(npy)
    members = good | draw(
        st.dictionaries(names | st.text(min_size=1, max_size=9), content, max_size=2)
    )
    stream = io.BytesIO()
    kinds = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
    with zipfile.ZipFile(stream, "w", draw(st.sampled_from(kinds))) as archive:
        for name, each in members.items():
            archive.writestr(name.replace("\x00", "0") + draw(st.sampled_from([".npy", ""])), each)
    return draw(damaged(stream.getvalue()))


numbers = st.floats(width=32) | st.integers(-(10**6), 10**6) | st.floats()
cells = (
    numbers.map(str) | numbers.map(str) | st.text(max_size=6) | st.sampled_from(["", '"', "nan"])
)


@st.composite
def tables(draw):
    X = matches_of(draw(seeds), draw(st.integers(0, 30)))
    rows = [[repr(value) for value in row] for row in X.tolist()]
    rows += draw(st.lists(st.lists(cells, min_size=1, max_size=6), max_size=3))
    start = draw(st.sampled_from(["", "x,y,x',y'\n", "x1,y1,x2,y2,score\n", "# x\n"]))
    comma = draw(st.sampled_from([",", ",", ",", ", ", ";", "\t"]))
    end = draw(st.sampled_from(["\n", "\r\n", "\r", "\n\n", "\x00"]))
    encoding = draw(st.sampled_from(["utf-8", "utf-8", "utf-8-sig", "utf-16", "latin-1", "cp037"]))
    text = start + "".join(comma.join(row) + end for row in rows)
    return draw(damaged(text.encode(encoding, "replace")))


options = st.lists(
    st.sampled_from(
        [["--method", name] for name in ("ransac", "lmeds", "8point", "7point", "usac_magsac")]
        + [["--density", name] for name in ("paper", "off")]
        + [["--threshold", name] for name in ("0.1", "1e5", "1e-11", "0", "nan", "-1", "1e99")]
        + [["--seed", "7"], ["--alpha", "0.5"], ["--confidence", "0.5"], ["--ratio", "0.5"]]
    ),
    max_size=2,
).map(lambda chosen: ["--json", "--max-iters", "100", *chain.from_iterable(chosen)])


def check_file(suffix, content, flags):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"matches{suffix}"
        path.write_bytes(content)
        try:
            X, scores = read_matches(path)
        except InputError as error:
            assert_one_line(str(error).removeprefix(f"{path}: "), 200)
            assert run_command("match", "--points", path, *flags) == 2
        else:
            assert X.dtype == np.float64
            assert X.ndim == 2
            assert X.shape[1] == 4
            assert scores is None or scores.shape == (len(X),)
            run_command("match", "--points", path, *flags)


@fuzzed("archives")
@given(content=archives(), flags=options)
def fuzz_archives(content, flags):
    CALLS.append(1)
    check_file(".npz", content, flags)


@fuzzed("tables")
@given(content=tables(), flags=options)
def fuzz_tables(content, flags):
    CALLS.append(1)
    check_file(".csv", content, flags)


def encoded(format_):
    rng = np.random.default_rng(0)
    image = cv2.resize(rng.integers(0, 255, (30, 40), dtype=np.uint8), (160, 120))
    return cv2.imencode(format_, cv2.merge([image] * 3))[1].tobytes()


@st.composite
def images(draw):
    """An image file, damaged at its start where most of the sense is, or anywhere."""
    content = encoded(draw(st.sampled_from([".png", ".jpg", ".tif", ".webp", ".bmp", ".ppm"])))
    start = draw(st.sampled_from([30, 200, len(content)]))
    return draw(damaged(content[:start])) + content[start:]


@fuzzed("images")
@given(content=images() | st.binary(), flags=options)
def fuzz_images(content, flags):
    CALLS.append(1)
    with tempfile.TemporaryDirectory() as folder:
        for name, each in (("left.png", encoded(".png")), ("right", content)):
            (Path(folder) / name).write_bytes(each)
        run_command("match", Path(folder) / "left.png", Path(folder) / "right", *flags)


# ---------------------------------------------------------------------------------------- calls

KINDS = [
    "f4",
    "f8",
    "f2",
    "i1",
    "u1",
    "i2",
    "u2",
    "i4",
    "u4",
    "i8",
    "u8",
    "?",
    ">f4",
    "c8",
    "O",
    "g",
]
SHAPES = {
    "(n, 2)": lambda p: p,
    "(n, 1, 2)": lambda p: p[:, None],
    "(1, n, 2)": lambda p: p[None],
    "(n, 2, 1)": lambda p: p[:, :, None],
    "(2, n)": lambda p: p.T,
    "(n, 3)": lambda p: np.hstack([p, p[:, :1]]),
    "reversed": lambda p: p[::-1],
    "columns": lambda p: np.hstack([p, p])[:, 1:3],
    "list": lambda p: p.tolist(),
    "UMat": lambda p: cv2.UMat(np.array(p, np.float32)),
}
POISONS = (np.nan, np.inf, -np.inf, 0.0, -0.0, 1e-45, 1e-300, 1e9, 1e19, 3e38, 1e39, 1e200)
junk = st.sampled_from(
    [None, "points", b"", 3, 1.5, (), [], {}, object(), [[1]], [[1, 2], [3]], True]
)


@st.composite
def matches(draw):
    """Matches of a scene, some of them damaged; or of no scene at all."""
    n = draw(st.integers(0, 40) | st.sampled_from([7, 8, 14, 15, 100, 300]))
    seed = draw(seeds)
    X = matches_of(seed, n, draw(st.sampled_from([0.1, 0.5, 1.0])))
    rng = np.random.default_rng(seed)
    for value in draw(st.lists(st.sampled_from(POISONS), max_size=2)):
        X[rng.random((n, 4)) < draw(st.sampled_from([0.01, 0.3, 1.0]))] = value
    kind = draw(st.sampled_from(["", "", "", "same", "few", "line", "integers", "far", "small"]))
    if kind == "same":
        X[:, 2:] = X[:, :2]
    elif kind == "few" and n:
        X = X[rng.integers(0, min(n, draw(st.integers(1, 10))), n)]
    elif kind == "line":
        X[:, draw(st.integers(0, 3))] = X[:, draw(st.integers(0, 3))]
    elif kind == "integers":
        X = rng.integers(0, 3, (n, 4)).astype(float)
    elif kind in ("far", "small"):
        X = X + 1e7 if kind == "far" else X * 1e-6
    return X


def halves(X):
    return X[:, :2].copy(), X[:, 2:].copy()


@st.composite
def points(draw):
    pair = halves(draw(matches()))
    if draw(st.integers(0, 9)) == 0:
        pair = tuple(draw(arrays) for _ in pair)
    else:
        kind = draw(st.sampled_from(["f4", "f8", *KINDS]))
        shape = SHAPES[draw(st.sampled_from(["(n, 2)", *SHAPES]))]
        with np.errstate(all="ignore"):
            pair = tuple(shape(p.astype(kind)) for p in pair)
    if draw(st.integers(0, 19)) == 0:
        pair = (pair[0], draw(junk))
    return pair


small_floats = st.sampled_from([1.0, 3.0, 0.5]) | st.floats()
small_integers = st.integers(-3, 300)


@st.composite
def params(draw):
    made = cv2.UsacParams()
    made.maxIterations = draw(small_integers)
    made.threshold = draw(small_floats)
    made.confidence = draw(st.sampled_from([0.99, 0.5]) | st.floats())
    made.randomGeneratorState = draw(st.integers(-(2**31), 2**31 - 1))
    made.sampler = draw(st.integers(0, 4))
    made.score = draw(st.integers(0, 4))
    made.loMethod = draw(st.integers(0, 5))
    made.neighborsSearch = draw(st.integers(0, 2))
    return made


@st.composite
def calls(draw):
    """Arguments of cv2's function, mostly such as it takes."""
    pair = draw(points())
    numbers = (
        draw(st.sampled_from([*METHODS.values()]) | st.integers(-5, 40) | junk),
        draw(small_floats | junk),
        draw(st.sampled_from([0.99, 0.5]) | st.floats() | junk),
        draw(small_integers | junk),
    )
    given = draw(st.integers(0, 4))
    arguments = [*pair, *numbers[:given]]
    if draw(st.integers(0, 3)) == 0:
        arguments = [*pair, draw(params())]
    keywords = {}
    if draw(st.integers(0, 3)) == 0:
        n = draw(st.integers(0, 40))
        if isinstance(pair[0], np.ndarray) and pair[0].ndim:
            n = draw(st.sampled_from([n, len(pair[0])]))
        shape = draw(st.sampled_from([(n, 1), (n,), (1, n), (n, 2)]))
        kind = draw(st.sampled_from(["u1", "u1", "i4", "f8", "?"]))
        keywords["mask"] = draw(st.just(np.full(shape, 9, kind)) | junk)
    own = {
        "density": st.sampled_from(["contrast", "paper", "off", "on", None]),
        "alpha": small_floats,
        "dc_percent": small_floats,
        "scores": st.just(
            np.arange(len(pair[0]) if isinstance(pair[0], np.ndarray) and pair[0].ndim else 0)
        )
        | arrays
        | junk,
    }
    for name in draw(st.lists(st.sampled_from(sorted(own)), max_size=2, unique=True)):
        keywords[name] = draw(own[name])
    return arguments, keywords


@fuzzed("facade")
@given(call=calls())
def fuzz_facade(call):
    CALLS.append(1)
    arguments, keywords = call
    try:
        answer = findFundamentalMat(*arguments, **keywords)
    except cv2.error:
        return
    except (ValueError, TypeError) as error:
        assert keywords.keys() & {"density", "alpha", "dc_percent", "scores"}
        assert_one_line(str(error))
        return
    assert type(answer) is tuple
    F, mask = answer
    assert F is None or (F.dtype == np.float64 and F.shape in ((3, 3), (6, 3), (9, 3)))
    if mask is None:
        assert F is None
    elif not isinstance(mask, cv2.UMat):
        assert isinstance(mask, np.ndarray)
        if "mask" not in keywords:
            assert mask.dtype == np.uint8
            assert set(mask.ravel()) <= {0, 1}


@fuzzed("estimate")
@given(
    X=matches(),
    kind=st.sampled_from(["f8", "f8", "f4", "f2", "i2", "O", "c8", "U9"]),
    options=st.fixed_dictionaries(
        {"max_iters": small_integers},
        optional={
            "method": st.sampled_from([*METHODS, 8, 77, None]) | junk,
            "threshold": small_floats | junk,
            "confidence": small_floats | junk,
            "density": st.sampled_from(["contrast", "paper", "off", "on"]) | junk,
            "alpha": small_floats | junk,
            "dc_percent": small_floats | junk,
            "scores": st.just("x") | arrays | junk,
            "random_state": st.integers() | junk,
        },
    ),
)
def fuzz_estimate(X, kind, options):
    CALLS.append(1)
    if isinstance(options.get("scores"), str):
        options["scores"] = np.arange(len(X)) % 7
    with np.errstate(all="ignore"):
        pair = halves(X.astype(kind))
    try:
        found = estimate_fundamental(*pair, **options)
    except (ValueError, TypeError) as error:
        assert_one_line(str(error))
        return
    n = len(X)
    assert found.mask.shape == found.kept.shape == found.reliability.shape == (n,)
    assert found.mask.dtype == found.kept.dtype == bool
    assert_one_line(found.reason)
    assert bool(found) or not found.mask.any()
    finite = np.isfinite(np.hstack(pair).astype(float)).all(axis=1)
    if found.engine != "8point":
        assert not found.mask[~finite].any()


@fuzzed("estimators")
@given(X=matches() | arrays, data=st.data())
def fuzz_estimators(X, data):
    CALLS.append(1)
    draw = data.draw
    shares = st.sampled_from([0.5, 0.01]) | st.floats()
    estimator = draw(
        st.sampled_from(
            [
                lambda: DensityPeaks(
                    draw(st.none() | st.integers(-1, 9)),
                    alpha=draw(shares),
                    dc=draw(st.none() | small_floats),
                    dc_percent=draw(small_floats),
                    kernel=draw(st.sampled_from(["cutoff", "gaussian", "box"])),
                    halo=draw(st.booleans()),
                ),
                lambda: DensityPeaksFilter(
                    draw(st.sampled_from(["contrast", "paper", None])),
                    alpha=draw(shares),
                    dc_percent=draw(small_floats),
                    keep=draw(st.none() | shares),
                ),
                lambda: FundamentalMatrixEstimator(
                    draw(st.sampled_from(["auto", None, DensityPeaksFilter("paper"), 3])),
                    method=draw(st.sampled_from([*METHODS, 8, "x"])),
                    threshold=draw(small_floats),
                    confidence=draw(shares),
                    max_iters=draw(small_integers),
                    random_state=draw(st.none() | st.integers(-1, 2**32)),
                ),
            ]
        )
    )()
    weight = draw(st.none() | st.just(np.ones(len(X) if X.ndim else 0)) | arrays)
    takes_weight = weight is not None and not isinstance(estimator, DensityPeaks)
    try:
        estimator.fit(X, **({"sample_weight": weight} if takes_weight else {}))
    except (ValueError, TypeError) as error:
        # scikit-learn's own refusals may have a second line.
        assert_one_line(str(error).splitlines()[0])
        return
    rows = {"DensityPeaks": "labels_", "DensityPeaksFilter": "support_"}
    named = rows.get(type(estimator).__name__, "inlier_mask_")
    assert getattr(estimator, named).shape == (len(X),)


# -------------------------------------------------------------------------------------- targets

TARGETS = {
    "archives": fuzz_archives,
    "tables": fuzz_tables,
    "images": fuzz_images,
    "facade": fuzz_facade,
    "estimate": fuzz_estimate,
    "estimators": fuzz_estimators,
}
CALLS: list[int] = []


def in_a_process(name):
    cv2.setNumThreads(1)
    warnings.simplefilter("error")
    # Said to the caller, and no fault: too few rows for a filter; numpy on complex numbers, and on
    # coordinates beyond cv2's float32 in an estimator.
    warnings.filterwarnings("ignore", ".* rows would be left", UserWarning)
    warnings.filterwarnings("ignore", "the threshold is .* of the points' spread", UserWarning)
    warnings.filterwarnings("ignore", category=np.exceptions.ComplexWarning)
    warnings.filterwarnings("ignore", "overflow encountered in cast", RuntimeWarning)
    warnings.filterwarnings("ignore", category=HypothesisWarning)
    if sys.platform == "linux":
        import resource

        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * os.sysconf("SC_PAGE_SIZE") + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    end = time.monotonic() + 60 * MINUTES / len(TARGETS)
    TARGETS[name]()
    while time.monotonic() < end:
        TARGETS[name]()
    print(f"{name}: {len(CALLS):,} calls")


@pytest.mark.parametrize("name", TARGETS)
def test_answers_or_refuses(name, monkeypatch):
    monkeypatch.setenv("OPENCV_IO_MAX_IMAGE_PIXELS", str(PIXELS))
    # Threads reserve memory, the more the more cores there are.
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MALLOC_ARENA_MAX"):
        monkeypatch.setenv(variable, "1")
    child = multiprocessing.get_context("spawn").Process(target=in_a_process, args=(name,))
    child.start()
    child.join()
    assert child.exitcode == 0, "see the standard error; a negative code is a signal"
