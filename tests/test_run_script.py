"""Programs under ``python -m cv_densityf run`` do what they do under ``python``, F aside."""

from __future__ import annotations

import os
import py_compile
import re
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from textwrap import dedent

import cv2
import pytest

from cv_densityf.__main__ import main
from cv_densityf.patching import is_patched

RUN = ("-m", "cv_densityf", "run")
POINTS = """
    import cv2
    import numpy as np
    from cv_densityf.datasets import two_view_scene

    scene = two_view_scene(200, inlier_ratio=0.4, random_state=3)
    P1, P2 = scene.points1, scene.points2
"""


def python(*arguments, cwd):
    command = [sys.executable, *map(str, arguments)]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=60)
    return done.returncode, done.stdout, done.stderr


def write(path, code):
    path.parent.mkdir(exist_ok=True)
    path.write_text(dedent(code), encoding="utf-8")
    return path


@pytest.fixture
def both(tmp_path):
    """Run a program without and with us; and tell what both did."""

    def both(*program, flags=()):
        with ThreadPoolExecutor(2) as pool:
            plain = pool.submit(python, *flags, *program, cwd=tmp_path)
            ours = pool.submit(python, *flags, *RUN, *program, cwd=tmp_path)
        assert ours.result() == plain.result()
        return plain.result()

    return both


WORLD = """
    import sys

    def annotated(x: sys.nonsense_is_evaluated if len(sys.argv) < 2 else int): pass

    class Pickled: pass

    if __name__ == "__main__":
        import atexit, pickle, threading, helper
        print(sys.argv, sys.path, helper.__file__)
        print(__file__, __package__, __cached__, type(__loader__), getattr(__spec__, "name", None))
        print(sorted(globals()), __builtins__)
        assert sys.modules["__main__"].__dict__ is globals()
        assert type(pickle.loads(pickle.dumps(Pickled()))) is Pickled
        assert annotated.__annotations__ == {"x": int}
        # Both are done after the last line, and still find the program's __main__.
        def late():
            threading.main_thread().join()
            pickle.dumps(Pickled())
            print("thread done")
        threading.Thread(target=late).start()
        atexit.register(lambda: pickle.dumps(Pickled()) and print("exit handler done"))
"""


@pytest.mark.parametrize("kind", ["link", "package", "folder", "compiled", "safe path"])
def test_the_program_sees_the_world_as_under_python(both, tmp_path, kind):
    folder = tmp_path / "folder"
    write(folder / "program.py", WORLD)
    write(folder / "__main__.py", WORLD)
    write(folder / "helper.py", "")
    write(tmp_path / "helper.py", "")
    (tmp_path / "link.py").symlink_to(folder / "program.py")
    py_compile.compile(str(folder / "program.py"), str(folder / "program.pyc"))
    program, flags = {
        "link": (["link.py"], []),
        "package": (["-m", "folder"], []),
        "folder": (["folder"], []),
        "compiled": (["folder/program.pyc"], []),
        # python -P puts no folder in front of the path, so that the helper is not found.
        "safe path": (["folder/program.py"], ["-P"]),
    }[kind]
    code, out, err = both(*program, "--report", "-m", "--", "-h", "", "a b", flags=flags)
    if kind == "safe path":
        assert "No module named 'helper'" in err
    else:
        assert (code, err) == (0, "")
        assert out.endswith("thread done\nexit handler done\n")


@pytest.mark.skipif(not os.path.exists("/dev/stdin"), reason="no such file here")
def test_the_program_may_come_from_a_pipe():
    asked = [sys.executable, *RUN, "/dev/stdin"]
    done = subprocess.run(asked, input="print('read')", capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("read\n", "")


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("raise SystemExit('a message')", 1),
        ("raise KeyboardInterrupt", -signal.SIGINT),
        # These are errors that our own commands explain in one line.
        (
            """
            def read():
                try:
                    open("nothing")
                except OSError as error:
                    raise ImportError("chained") from error
            read()
            """,
            1,
        ),
        ("# coding: latin-1\nx = (1,\ny = '\u00e9'", 1),
        (
            """
            import sys, traceback
            def hook(kind, error, trace):
                print(kind, traceback.extract_tb(trace))
                traceback.print_exception(error)
            sys.excepthook = hook
            {}["missing"]
            """,
            1,
        ),
    ],
)
def test_ends_as_under_python(both, tmp_path, code, expected):
    write(tmp_path / "program.py", code)
    returned, _, err = both("program.py")
    assert returned == expected
    assert "cv_densityf" not in err


def test_modules_end_as_under_python(both, tmp_path):
    write(tmp_path / "program.py", "1 / 0")
    assert both("-m", "program")[0] == 1
    assert both("-m", "no_such_module")[0] == 1


def test_a_missing_file_is_named(tmp_path):
    code, out, err = python(*RUN, "nothing.py", cwd=tmp_path)
    plain = python("nothing.py", cwd=tmp_path)
    assert (code, out) == plain[:2] == (2, "")
    assert err.split(": ", 1)[1] == plain[2].split(": ", 1)[1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give a script, or -m and a module"),
        (["-m"], "give a script, or -m and a module"),
        (["--density", "dense", "program.py"], "invalid choice: 'dense'"),
    ],
)
def test_wrong_use_is_one_line_and_patches_nothing(capsys, arguments, message):
    with pytest.raises(SystemExit, match="2"):
        main(["run", *arguments])
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("cv-densityf run: ")
    assert message in err
    assert err.count("\n") == 1
    assert not is_patched()


ESTIMATES = (
    POINTS
    + """
    from cv2 import findFundamentalMat

    for method in (cv2.FM_RANSAC, cv2.FM_LMEDS, cv2.FM_8POINT, *range(32, 39)):
        if method == cv2.USAC_PARALLEL:  # depends on the timing of its threads
            continue
        for find in (cv2.findFundamentalMat, findFundamentalMat):
            F, mask = find(P1, P2, method, 1.0, 0.999, 500)
            print(method, F.tolist(), mask.ravel().tolist())
"""
)


def test_density_off_prints_the_same_and_the_default_does_not(tmp_path):
    write(tmp_path / "program.py", ESTIMATES)
    plain = python("program.py", cwd=tmp_path)
    assert plain[0] == 0, plain[2]
    assert python(*RUN, "--density", "off", "program.py", cwd=tmp_path) == plain
    ours = python(*RUN, "program.py", cwd=tmp_path)
    assert (ours[0], ours[2]) == (0, "")
    plain_lines, our_lines = plain[1].splitlines(), ours[1].splitlines()
    # A name imported from cv2 is ours as well, since the patch is there before the program.
    assert our_lines[::2] == our_lines[1::2]
    same = {line.split()[0] for line in our_lines if line in plain_lines}
    assert same == {str(cv2.FM_8POINT)}


REPORTED = (
    POINTS
    + """
    import atexit, threading

    def call(): return cv2.findFundamentalMat(P1, P2, cv2.USAC_FAST)
    call()
    threading.Thread(target=call).start()
    atexit.register(call)
    cv2.findFundamentalMat(P1, P2, cv2.FM_8POINT)
    cv2.findFundamentalMat(P1 * np.nan, P2)
    print("printed")
    cv2.findFundamentalMat(P1)
"""
)


def test_report(tmp_path):
    path = write(tmp_path / "program.py", REPORTED)
    lines = dedent(REPORTED).splitlines()

    def line(text):
        return next(i for i, line in enumerate(lines, 1) if text in line)

    quiet = python(*RUN, "program.py", cwd=tmp_path)
    code, out, err = python(*RUN, "--report", "program.py", cwd=tmp_path)
    assert (code, out) == quiet[:2] == (1, "printed\n")
    assert err.startswith(quiet[2])
    assert "Overload resolution failed" in quiet[2]
    title, header, *rows = err[len(quiet[2]) :].splitlines()
    assert "cv2.findFundamentalMat" in title
    names = " calls cv2's own errors no model matches inliers ms a call line"
    assert re.sub(" +", " ", header) == names
    found = {row.split()[-1]: [int(n) for n in row.split()[:-2]] for row in rows}
    calls = found.pop(f"{path}:{line('def call')}")
    assert calls[:5] == [3, 0, 0, 0, 600]
    assert 0 < calls[5] < 600
    assert found == {
        f"{path}:{line('FM_8POINT')}": [1, 1, 0, 0, 200, 200],
        f"{path}:{line('nan')}": [1, 1, 0, 1, 0, 0],
        f"{path}:{line('Mat(P1)')}": [1, 0, 1, 0, 0, 0],
    }


def test_report_of_a_program_that_never_called(tmp_path):
    write(tmp_path / "program.py", "import sys; sys.exit(4)")
    code, out, err = python(*RUN, "--report", "program.py", cwd=tmp_path)
    assert (code, out) == (4, "")
    assert "was not called through the patch in this process" in err


WORKERS = """
    import multiprocessing, sys, cv2

    def is_ours(_=None):
        return cv2.findFundamentalMat.__module__ == "cv_densityf.patching"

    if __name__ == "__main__":
        with multiprocessing.get_context(sys.argv[1]).Pool(1) as pool:
            print(is_ours(), pool.apply(is_ours))
"""


@pytest.mark.parametrize(
    ("method", "patched"),
    [
        ("spawn", False),
        pytest.param(
            "fork", True, marks=pytest.mark.skipif(sys.platform != "linux", reason="no fork")
        ),
    ],
)
def test_limit_workers_that_start_afresh_have_cv2s_function(tmp_path, method, patched):
    write(tmp_path / "program.py", WORKERS)
    code, out, err = python("-W", "ignore", *RUN, "program.py", method, cwd=tmp_path)
    assert (code, out) == (0, f"True {patched}\n"), err
