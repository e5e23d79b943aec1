from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cv_densityf._zhang import _one_way, epipolar_distance
from cv_densityf.datasets import two_view_scene

SIZE1, SIZE2 = (640, 480), (800, 500)
ROWS = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def shifted_rows(shift):
    """Epipolar geometry in which y' = y + shift."""
    return ROWS + np.diag([0.0, 0.0, -shift])


def cross(e):
    return np.array([[0, -e[2], e[1]], [e[2], 0, -e[0]], [-e[1], e[0], 0]], dtype=float)


def homography(*shift):
    return np.array([[1.02, 0.05, shift[0]], [-0.04, 0.98, shift[1]], [2e-5, -1e-5, 1.0]])


def general(seed, bend=0.0):
    """F = [e']x H with both epipoles outside the images, turned a little by ``bend``."""
    rng = np.random.default_rng(seed)
    H = homography(*rng.uniform(-30, 30, 2))
    return cross([-900 + bend, 200 - bend / 2, 1.0]) @ H


def literally(F0, F1, size1, size2, n, rng):
    """Zhang's steps one by one for both matrices and both images; every distance, a list."""
    distances = []
    for start in (1, 2):
        for drawer, judge in ((F0, F1), (F1, F0)):
            A, B = (drawer, judge) if start == 1 else (drawer.T, judge.T)
            here, there = (size1, size2) if start == 1 else (size2, size1)
            done = 0
            while done < n:
                m = (rng.uniform(0, here[0]), rng.uniform(0, here[1]), 1.0)
                a, b, c = (sum(A[i, j] * m[j] for j in range(3)) for i in range(3))
                crossings = []
                for x in (0, there[0]):
                    if b and 0 <= -(a * x + c) / b <= there[1]:
                        crossings.append((x, -(a * x + c) / b))
                for y in (0, there[1]):
                    if a and 0 <= -(b * y + c) / a <= there[0]:
                        crossings.append((-(b * y + c) / a, y))
                if len(crossings) < 2:
                    continue
                (x0, y0), (x1, y1) = min(crossings), max(crossings)
                t = rng.uniform()
                other = (x0 + t * (x1 - x0), y0 + t * (y1 - y0), 1.0)
                line = [sum(B[i, j] * m[j] for j in range(3)) for i in range(3)]
                back = [sum(B[j, i] * other[j] for j in range(3)) for i in range(3)]
                for point, at in ((other, line), (m, back)):
                    value = sum(p * q for p, q in zip(point, at, strict=True))
                    distances.append(abs(value) / math.hypot(at[0], at[1]))
                done += 1
    return distances


@pytest.mark.parametrize(
    ("F0", "F1"),
    [
        (general(0), general(0, bend=40)),
        (general(1), general(2)),
        # The epipole lies inside the second image, so that lines point everywhere.
        (cross([400, 250, 1]) @ homography(5, 3), cross([420, 240, 1]) @ homography(5, 3)),
        # Most lines of these miss the image and are drawn again.
        (shifted_rows(400), shifted_rows(430)),
    ],
    ids=["bent", "unrelated", "epipole inside", "redrawn"],
)
def test_agrees_with_the_steps_taken_literally(F0, F1):
    literal = literally(F0, F1, SIZE1, SIZE2, 1000, np.random.default_rng(8))
    ours = epipolar_distance(F0, F1, SIZE1, SIZE2, n=10_000)
    # The two distances of a draw are dependent: the error of the mean is at most this.
    standard_error = np.std(literal) / math.sqrt(len(literal) / 2)
    assert ours == pytest.approx(np.mean(literal), abs=4.5 * standard_error + 1e-9)


@pytest.mark.parametrize("shift", [0.01, 3.0, 479.0])
def test_a_shift_of_all_rows_is_its_own_distance(shift):
    # 479: nearly every line of one of the two misses the image.
    distance = epipolar_distance(ROWS, shifted_rows(shift), SIZE1, SIZE1, n=50)
    assert distance == pytest.approx(shift)


def test_a_pure_shift_of_one_epipole_is_an_integral_over_the_images():
    """Two lines through one point, one to each epipole: elementary geometry, no matrix."""
    width, height = SIZE1
    e0, e1 = np.array([-700.0, 240.0]), np.array([-700.0, 270.0])
    # Sideways steps along lines that are nearly level: columns of the image weight evenly.
    x, y, u = np.meshgrid(
        *((np.arange(k) + 0.5) / k * extent for k, extent in ((40, width), (48, height), (40, 1)))
    )
    total = []
    for towards, other in ((e0, e1), (e1, e0)):
        slope = (y - towards[1]) / (x - towards[0])
        # Where the line enters and leaves the image through its top or bottom.
        with np.errstate(divide="ignore"):
            ends = np.sort([x + (0 - y) / slope, x + (height - y) / slope], axis=0)
        left, right = np.maximum(ends[0], 0), np.minimum(ends[1], width)
        there_x = left + u * (right - left)
        there_y = y + slope * (there_x - x)
        for px, py, qx, qy in ((x, y, there_x, there_y), (there_x, there_y, x, y)):
            ax, ay = other[0] - px, other[1] - py
            total.append(np.abs(ax * (qy - py) - ay * (qx - px)) / np.hypot(ax, ay))
    F0, F1 = (cross([*e, 1.0]) for e in (e0, e1))
    distance = epipolar_distance(F0, F1, SIZE1, SIZE1, n=100_000)
    assert distance == pytest.approx(np.mean(total), rel=0.01)
    half_way = cross([-700.0, 255.0, 1.0])
    assert epipolar_distance(F0, half_way, SIZE1, SIZE1) == pytest.approx(distance / 2, rel=0.05)


@given(seed=st.integers(0, 2**32), scale=st.sampled_from([-1.0, 1e-200, -3e150, 1e303]))
@settings(max_examples=30)
def test_neither_scale_nor_order_nor_direction_matters(seed, scale):
    F0, F1 = general(seed), general(seed + 1)
    distance = epipolar_distance(F0, F1, SIZE1, SIZE2, n=200)
    assert 0 < distance < np.inf
    for same in (
        epipolar_distance(scale * F0, F1, SIZE1, SIZE2, n=200),
        epipolar_distance(F1, F0, SIZE1, SIZE2, n=200),
        epipolar_distance(F0.T, F1.T, SIZE2, SIZE1, n=200),
    ):
        assert same == pytest.approx(distance, rel=1e-6)
    assert epipolar_distance(F0, scale * F0, SIZE1, SIZE2, n=200) < 1e-6


def test_pixels_scale_with_the_images():
    F0, F1 = general(0), general(0, bend=40)
    distance = epipolar_distance(F0, F1, SIZE1, SIZE2)
    shrink = np.diag([2.0, 2.0, 1.0])
    half = [tuple(s / 2 for s in size) for size in (SIZE1, SIZE2)]
    assert epipolar_distance(shrink @ F0 @ shrink, shrink @ F1 @ shrink, *half) == pytest.approx(
        distance / 2
    )


def test_a_worse_estimate_is_further_away():
    scene = two_view_scene(300)
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 1, (3, 3)) * [[1e-3, 1e-3, 1], [1e-3, 1e-3, 1], [1, 1, 10]]
    small, large = (
        epipolar_distance(scene.F, scene.F + k * 1e-4 * noise, scene.size, scene.size)
        for k in (1, 4)
    )
    assert 0 < 2 * small < large


def test_the_transposed_matrix_is_another_one():
    F = general(3)
    distance = epipolar_distance(F, F.T, SIZE1, SIZE1)
    assert 10 < distance < np.inf


@pytest.mark.parametrize(
    "F",
    [
        np.zeros((3, 3)),
        np.full((3, 3), np.nan),
        np.diag([1.0, 1.0, np.inf]),
        # Every point's line is the line at infinity.
        np.diag([0.0, 0.0, 1.0]),
        # y' = y + 10^6
        shifted_rows(1e6),
    ],
    ids=["zero", "nan", "inf", "line at infinity", "beyond the image"],
)
def test_no_line_in_the_image_is_infinitely_far(F):
    assert epipolar_distance(F, ROWS, SIZE1, SIZE2, n=200) == np.inf
    assert epipolar_distance(ROWS, F, SIZE1, SIZE2, n=20) == np.inf
    assert epipolar_distance(F, F, SIZE1, SIZE2, n=20) == np.inf


@pytest.mark.parametrize("rank", [1, 3])
def test_other_ranks_have_lines_too(rank):
    rng = np.random.default_rng(4)
    # Rank 1: one line in each image for all points of the other.
    F = np.outer([1.0, 2.0, -900.0], [1.0, 3.0, -900.0]) if rank == 1 else general(0)
    if rank == 3:
        F = F + 1e-3 * np.abs(F).max() * rng.normal(size=(3, 3)) * [1e-3, 1e-3, 1]
    assert np.linalg.matrix_rank(F / np.linalg.norm(F), tol=1e-12) == rank
    distance = epipolar_distance(F, general(0), SIZE1, SIZE2)
    assert 0 < distance < np.inf


def test_a_line_along_the_border_is_in_the_image():
    top = np.outer([0.0, 1.0, 0.0], [1.0, 3.0, -900.0])
    assert 0 < epipolar_distance(top, general(0), SIZE1, SIZE2) < np.inf


def test_a_point_that_is_the_epipole_is_drawn_again():
    class Draws:
        def __init__(self, *draws):
            self.draws = iter(np.array(draws, dtype=float))

        def random(self, shape):
            return next(self.draws)

    F, G = cross([100, 240, 1]), cross([320, 240, 1])
    middle, others = [0.5, 0.5, 0.5], [[0.2, 0.3, 0.4], [0.7, 0.1, 0.6], [0.4, 0.8, 0.9]]
    sizes = np.array(SIZE1), np.array(SIZE1)
    expected = _one_way(F, G, *sizes, 2, Draws(others[:2]))
    assert 0 < expected < np.inf
    assert _one_way(F, G, *sizes, 2, Draws([others[0], middle], others[1:])) == expected


def test_the_seed_decides_the_points():
    F0, F1 = general(0), general(1)
    first = epipolar_distance(F0, F1, SIZE1, SIZE2, random_state=1)
    assert first == epipolar_distance(F0, F1, SIZE1, SIZE2, random_state=1)
    assert first == epipolar_distance(F0, F1, SIZE1, SIZE2, random_state=np.random.default_rng(1))
    assert first != epipolar_distance(F0, F1, SIZE1, SIZE2, random_state=2)
    assert epipolar_distance(F0, F1, SIZE1, SIZE2, random_state=None) != epipolar_distance(
        F0, F1, SIZE1, SIZE2, random_state=None
    )


def test_says_what_is_wrong():
    with pytest.raises(ValueError, match=r"F1 has shape \(9, 3\).*pass one"):
        epipolar_distance(ROWS, np.vstack([ROWS] * 3), SIZE1, SIZE2)
    with pytest.raises(ValueError, match=r"F0 is None"):
        epipolar_distance(None, ROWS, SIZE1, SIZE2)
    with pytest.raises(ValueError, match=r"size2 is .*width, height"):
        epipolar_distance(ROWS, ROWS, SIZE1, (640, 0))
    with pytest.raises(ValueError, match=r"size1 is .*width, height"):
        epipolar_distance(ROWS, ROWS, (640, 480, 3), SIZE2)
    with pytest.raises(ValueError, match="n is 0"):
        epipolar_distance(ROWS, ROWS, SIZE1, SIZE2, n=0)
    with pytest.raises(ValueError, match=r"n is 10\.0; it must be an integer"):
        epipolar_distance(ROWS, ROWS, SIZE1, SIZE2, n=10.0)


@pytest.mark.parametrize("size", ["ab", (640, (480, 1)), (640, 480j), None, {}])
def test_sizes_that_are_no_numbers_are_named(size):
    with pytest.raises(ValueError, match="size1"):
        epipolar_distance(ROWS, ROWS, size, SIZE2)


def test_complex_matrices_are_refused():
    with pytest.raises(ValueError, match="F1 is of type complex128"):
        epipolar_distance(np.eye(3), 1j * np.eye(3), (640, 480), (640, 480))
