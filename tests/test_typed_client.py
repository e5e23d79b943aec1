"""What mypy tells somebody who calls the installed package; cv2's own stub is the judge."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

NAMES = """
import cv2
import numpy as np

points = np.zeros((20, 2))
mask = np.zeros((20, 1), np.uint8)
umat, umat_mask = cv2.UMat(), cv2.UMat()
params = cv2.UsacParams()
"""

#: Arguments of a call of cv2, right or wrong.
CALLS = (
    "points, points",
    "points, points, cv2.FM_LMEDS",
    "points, points, cv2.FM_RANSAC, 1.0, 0.99",
    "points, points, cv2.FM_RANSAC, 1.0, 0.99, mask",
    "points, points, cv2.USAC_MAGSAC, 1.0, 0.99, 5000",
    "points, points, cv2.USAC_MAGSAC, 1.0, 0.99, 5000, mask",
    "points, points, method=cv2.USAC_MAGSAC, mask=mask",
    "points, points, ransacReprojThreshold=1, confidence=0.9, method=8, maxIters=100",
    "points1=points, points2=points",
    "points, points, params",
    "points, points, params, mask",
    "points, points, params=params, mask=None",
    "umat, umat",
    "umat, umat, cv2.FM_RANSAC, 1.0, 0.99, umat_mask",
    "umat, umat, cv2.FM_RANSAC, 1.0, 0.99, 100, umat_mask",
    "umat, umat, params, umat_mask",
    "",
    "points",
    "points, 'points'",
    "points, umat",
    "umat, umat, mask=mask",
    "points, points, 'ransac'",
    "points, points, method=8.0",
    "points, points, maxIters=100",
    "points, points, cv2.FM_RANSAC, 1.0, 0.99, 100.0",
    "points, points, cv2.FM_RANSAC, 1.0, 0.99, 100, mask, 0.011",
    "points, points, params, 1.0",
    "points, points, cv2.FM_RANSAC, params",
    "points, points, threshold=1.0",
)

#: What is ours alone. A line that mypy must refuse says why.
CLIENT = """
from collections.abc import Iterator
from typing import Any, assert_type

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray

import cv_densityf
from cv_densityf import findFundamentalMat
from cv_densityf.estimators import DensityPeaks, FundamentalMatrixEstimator

points = np.zeros((20, 2))
params = cv2.UsacParams()
Pair = tuple[MatLike, MatLike]

assert_type(findFundamentalMat(points, points, density="paper", alpha=0.02, dc_percent=3), Pair)
assert_type(findFundamentalMat(points, points, 8, 1.0, 0.99, 100, scores=[1.0] * 20), Pair)
assert_type(findFundamentalMat(points, points, params, density="off"), Pair)
findFundamentalMat(points, points, density="dense")  # refused: call-overload
findFundamentalMat(points, points, density=None)  # refused: call-overload
findFundamentalMat(points, points, alpha="0.02")  # refused: call-overload
findFundamentalMat(points, points, scores=object())  # refused: call-overload

estimate = cv_densityf.estimate_fundamental(points, points, threshold=1.0)
assert_type(estimate, cv_densityf.Estimate)
assert_type(estimate.F, NDArray[np.float64] | None)
assert_type(estimate.mask, NDArray[np.bool_])
estimate.F.sum()  # refused: union-attr
estimate.F = None  # refused: misc
cv_densityf.estimate_fundamental(points, points, treshold=1.0)  # refused: call-arg
cv_densityf.estimate_fundamental(points, points, density="dense")  # refused: arg-type

assert_type(cv_densityf.estimate_many([(points, points)]), Iterator[cv_densityf.Estimate])
assert_type(cv_densityf.epipolar_distance(np.eye(3), np.eye(3), (640, 480), (640, 480)), float)
assert_type(cv_densityf.density_peaks(points).rho, NDArray[np.float64])
assert_type(DensityPeaks().fit(points).labels_, NDArray[np.intp])
assert_type(FundamentalMatrixEstimator().fit(points).F_, NDArray[np.float64])
assert_type(FundamentalMatrixEstimator().predict(points), NDArray[np.bool_])
cv_densityf.match_image  # refused: attr-defined
with cv_densityf.patched(density="paper"):
    pass
cv_densityf.patch_cv2(density="dense")  # refused: arg-type
"""


def mypy(text, folder):
    """Lines of the text and what mypy --strict says about them, of the package as installed."""
    client = folder / "client.py"
    client.write_text(text, encoding="utf-8")
    command = ["--strict", "--hide-error-context", "--config-file=", "--no-pretty"]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *command, "--cache-dir", folder / "cache", client.name],
        cwd=folder, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode in (0, 1), done.stdout + done.stderr
    said = {}
    for line in done.stdout.splitlines():
        if found := re.fullmatch(r"client\.py:(\d+): (error|note): (.*)", line):
            said.setdefault(int(found[1]), []).append((found[2], found[3]))
    return said


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    pytest.importorskip("mypy")
    return tmp_path_factory.mktemp("typed")


def code(message):
    return re.search(r"\[([a-z-]+)\]$", message)[1]


@pytest.fixture(scope="module")
def answers(folder):
    """For each call what mypy says of cv2's function and of ours: a type, or codes of errors."""
    functions = ("cv2", "cv_densityf")
    lines = (NAMES + "import cv_densityf\n").splitlines()
    first = len(lines) + 1
    lines += [f"reveal_type({f}.findFundamentalMat({call}))" for call in CALLS for f in functions]
    said = mypy("\n".join(lines) + "\n", folder)
    assert min(said) >= first, said

    def answer(line):
        errors = {code(text) for kind, text in said[line] if kind == "error"}
        types = [text for _, text in said[line] if text.startswith("Revealed type")]
        return errors or types[-1]

    found = {
        call: tuple(answer(first + 2 * i + k) for k in range(2)) for i, call in enumerate(CALLS)
    }
    if "tuple[Any, Any]" in found["points, points"][0]:
        pytest.skip("this cv2's stub knows no arrays")
    return found


@pytest.mark.parametrize("call", CALLS)
def test_a_call_of_cv2_has_the_same_type_or_is_refused(answers, call):
    cv2s, ours = answers[call]
    assert ours == cv2s


def test_some_calls_have_types_and_some_are_refused(answers):
    refused = [call for call, (cv2s, _) in answers.items() if isinstance(cv2s, set)]
    assert refused == list(CALLS[CALLS.index("") :])
    assert len({cv2s for cv2s, _ in answers.values() if isinstance(cv2s, str)}) == 2


def test_a_client_sees_the_types_that_are_ours(folder):
    expected = {
        number: set(line.split("# refused: ")[1].split(","))
        for number, line in enumerate(CLIENT.splitlines(), 1)
        if "# refused: " in line
    }
    said = mypy(CLIENT, folder)
    errors = {
        n: {code(text) for kind, text in lines if kind == "error"} for n, lines in said.items()
    }
    assert {n: codes for n, codes in errors.items() if codes} == expected, said
