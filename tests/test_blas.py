"""Linear algebra on one thread: the same numbers as numpy's, whatever numpy it is."""

import numpy as np
import pytest

from cv_densityf import _blas


@pytest.fixture(params=[False, True], ids=["numpy 2", "numpy 1"])
def numpy_1(request, monkeypatch):
    monkeypatch.setattr(_blas, "_NUMPY_1", request.param)
    return request.param


@pytest.mark.parametrize(("m", "r"), [(1, 9), (2, 9), (1, 45), (16, 45), (512, 9), (1024, 1024)])
@pytest.mark.parametrize("n", [1, 3000, 20_000])
def test_parts_are_small_enough_for_one_thread(n, m, r, numpy_1):
    numbers = np.arange(n)
    parts = [numbers[part] for part in _blas.parts(n, m, r)]
    np.testing.assert_array_equal(np.concatenate(parts), numbers)
    for part in parts:
        assert len(part) * m * r <= (9_000 if numpy_1 and m == 1 else 2**18) or len(part) == 1


@pytest.mark.usefixtures("numpy_1")
def test_solved_solves_systems_that_are_all_but_singular():
    rng = np.random.default_rng(0)
    half = rng.normal(size=(5, 7, 9))
    matrices = half.transpose(0, 2, 1) @ half + 1e-9 * np.eye(9)
    solutions = rng.normal(size=(5, 9, 1))
    right = matrices @ solutions
    found = _blas.solved(matrices, right)
    assert found.shape == solutions.shape
    np.testing.assert_allclose(matrices @ found, right, rtol=0, atol=1e-6)


@pytest.mark.usefixtures("numpy_1")
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_times_vector_is_the_product(dtype):
    rng = np.random.default_rng(0)
    rows, vector = rng.random((6, 500)).astype(dtype), rng.random(500).astype(dtype)
    found = _blas.times_vector(rows, vector)
    assert found.dtype == dtype
    np.testing.assert_allclose(found, [sum(row * vector) for row in rows], rtol=1e-4)
