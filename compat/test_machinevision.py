"""A program as it is: points2F of machinevision-toolbox-python, on both functions.

Runs where that package is installed: ``nox -s clients``. Its own tests of points2F come with its
repository only: two of failures (too few points, points on a line), which are held here too, and a
notebook, chapter 14 of the book on it, that looks at nothing that comes out; the notebook's chain
from F on to the pose between the cameras is held here against the truth.
"""

from __future__ import annotations

import contextlib

import cv2
import numpy as np
import pytest

from compat.implementation import IS_CV2, reference, under_test
from compat.test_statistics import epipolar_error

toolbox = pytest.importorskip("machinevisiontoolbox")
spatialmath = pytest.importorskip("spatialmath")

SE3 = spatialmath.SE3
SAMPLED = ("ransac", "lmeds")


@contextlib.contextmanager
def in_place_of_cv2(function):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cv2, "findFundamentalMat", function)
        yield


def views(n, wrong=0.0, noise=0.3, seed=0):
    """Project points to two cameras: (2, n) arrays as the toolbox has them, exact ones, flags."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-0.4, -0.4, 0.8), (0.4, 0.4, 2.0), (n, 3)).T
    exact = [
        toolbox.CentralCamera(f=0.008, imagesize=1000, rho=10e-6, pose=pose).project_point(points)
        for pose in (SE3.Tx(-0.1) * SE3.Ry(0.1), SE3.Tx(0.1) * SE3.Ry(-0.1) * SE3.Rx(0.05))
    ]
    p1, p2 = (p + rng.normal(0, noise, p.shape) for p in exact)
    right = np.arange(n) >= round(wrong * n)
    p2[:, ~right] = rng.uniform(0, 1000, (2, np.count_nonzero(~right)))
    return p1, p2, np.vstack(exact).T, right


def answers(p1, p2, method, **options):
    """Call points2F on cv2's function and on ours; an exception is an answer, too."""
    made = []
    for function in (reference, under_test):
        with in_place_of_cv2(function):
            try:
                made.append(toolbox.CentralCamera.points2F(p1, p2, method=method, **options))
            except ValueError as error:
                made.append(error)
    return made


@pytest.mark.parametrize(
    ("method", "wrong"),
    [("8p", 0.0), ("ransac", 0.0), ("ransac", 0.3), ("lmeds", 0.0), ("lmeds", 0.3)],
)
def test_as_many_results_as_good(method, wrong):
    errors, flags = [], []
    for seed in range(6):
        p1, p2, exact, right = views(120, wrong, seed=seed)
        cv2s, ours = answers(p1, p2, method, seed=1)
        assert len(ours) == len(cv2s) == (3 if method in SAMPLED else 2)
        assert np.isscalar(ours[1]) == np.isscalar(cv2s[1])
        assert [type(value) for value in ours] == [type(value) for value in cv2s]
        errors.append([epipolar_error(F, exact[right]) for F in (cv2s[0], ours[0])])
        if method in SAMPLED:
            assert ours[2].dtype == cv2s[2].dtype == bool
            flags.append([(mask == right).mean() for mask in (cv2s[2], ours[2])])
    cv2s, ours = np.mean(errors, axis=0)
    assert ours <= 1.05 * cv2s + 1e-6
    if flags:
        cv2s, ours = np.mean(flags, axis=0)
        assert ours >= cv2s - 0.01


def test_seven_points():
    p1, p2, _, _ = views(7, noise=0.0, seed=2)
    cv2s, ours = answers(p1, p2, "7p", residual=False)
    np.testing.assert_allclose(ours[0], cv2s[0])


@pytest.mark.parametrize("method", SAMPLED)
def test_options_get_through(method):
    p1, p2, _, _ = views(120, 0.3)
    options = {"ransacReprojThreshold": 1.0, "confidence": 0.999, "maxIters": 2000}
    cv2s, ours = answers(p1, p2, method, **options)
    assert len(ours) == len(cv2s) == 3
    # cv2's overloads: maxIters alone is refused.
    for answer in answers(p1, p2, method, maxIters=2000):
        assert isinstance(answer, ValueError)
        assert isinstance(answer.__cause__, cv2.error)


@pytest.mark.parametrize("method", ["7p", "8p", "ransac", "lmeds"])
@pytest.mark.parametrize("kind", ["few", "line", "same", "point"])
def test_failures_are_the_toolboxs_own(method, kind):
    p1, p2, _, _ = views(30)
    if kind == "few":
        p1, p2 = p1[:, :6], p2[:, :6]
    elif kind == "line":
        p1 = np.vstack([np.arange(30.0), 2 * np.arange(30.0)])
        p2 = p1 + 5
    elif kind == "same":
        p2 = p1
    else:
        p1, p2 = p1[:, :1].repeat(30, 1), p2[:, :1].repeat(30, 1)
    cv2s, ours = answers(p1, p2, method)
    if kind == "few":
        assert "needs at least" in str(ours)
    elif method in SAMPLED and kind in ("line", "point"):
        assert "too degenerate" in str(ours)
    # No answer where cv2 has one would be worse; an answer where it has none need not be.
    assert isinstance(cv2s, ValueError) or not isinstance(ours, ValueError) or kind == "same"


def test_ten_points_on_a_line_are_degenerate():
    t = np.linspace(0, 1, 10)
    _, ours = answers(np.vstack([t, t]) * 5 + 10, np.vstack([t, t]) * 5 + 11, "ransac")
    assert "too degenerate" in str(ours)


def pose_error(F):
    """Angle between the true and the estimated rotation plus that of the directions, degrees."""
    poses = SE3.Tx(-0.1) * SE3.Ry(0.1), SE3.Tx(0.1) * SE3.Ry(-0.1) * SE3.Rx(0.05)
    camera = toolbox.CentralCamera(f=0.008, imagesize=1000, rho=10e-6)
    true = poses[0].inv() * poses[1]
    found = camera.decomposeE(camera.E(F), [0, 0, 10])
    turn = np.degrees((found.inv() * true).angvec()[0])
    # The toolbox chooses between t and -t by a point that both put in front of the camera.
    cosine = abs(found.t @ true.t) / np.linalg.norm(found.t) / np.linalg.norm(true.t)
    return turn + np.degrees(np.arccos(min(cosine, 1.0)))


@pytest.mark.parametrize("method", SAMPLED)
def test_the_pose_that_comes_of_it_is_as_good(method):
    errors = []
    for seed in range(6):
        p1, p2, _, _ = views(120, 0.3, seed=seed)
        errors.append([pose_error(answer[0]) for answer in answers(p1, p2, method)])
    cv2s, ours = np.median(errors, axis=0)
    assert ours <= 1.05 * cv2s
    assert ours < 10


def test_the_toolbox_calls_what_is_tested():
    called = []

    def spy(*args, **kwargs):
        called.append(kwargs)
        return under_test(*args, **kwargs)

    with in_place_of_cv2(spy):
        toolbox.CentralCamera.points2F(*views(40)[:2], method="ransac")
    assert set(called[0]) == {"points1", "points2", "method"}
    assert IS_CV2 or under_test is not reference
