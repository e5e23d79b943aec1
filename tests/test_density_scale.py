"""Density peaks of many points: estimated from a sample, and with many copies."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.scenes import make_scene
from cv_densityf import density_peaks

KERNELS = ["cutoff", "gaussian"]


def crowds(n, copies, seed=0):
    """Points of differing density; each of the first ones comes ``copies`` times."""
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(n, 3)) * rng.choice([1.0, 4.0], size=(n, 1))
    X[n // 2 :] = X[rng.integers(0, n // 2 // copies, n - n // 2)]
    return X


@pytest.mark.parametrize("kernel", KERNELS)
def test_sampled_densities_have_the_stated_error(kernel):
    n, m = 2000, 250
    squares, ratios = [], []
    for seed in range(20):
        # The rows of the sample are always the same.
        X = np.random.default_rng(seed).permutation(make_scene("clusters", n, 0.3, 0.5, seed).X)
        exact = density_peaks(X, kernel=kernel)
        estimated = density_peaks(X, kernel=kernel, sample_size=m)
        assert estimated.dc == exact.dc
        some = exact.rho > 0
        assert (estimated.rho[~some] == 0).all()
        p = exact.rho[some] / n
        standard_error = np.sqrt((1 - p) / p * (1 - m / n) / m)
        error = estimated.rho[some] / exact.rho[some] - 1
        squares.append(np.mean((error / standard_error) ** 2))
        ratios.append(estimated.rho.mean() / exact.rho.mean())
    size = np.sqrt(np.mean(squares))
    # The smooth kernel does better than the bound.
    assert (0.85 < size < 1.15) if kernel == "cutoff" else (0.1 < size < 0.85)
    assert np.mean(ratios) == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_whole_as_sample_is_exact(kernel):
    X = crowds(600, copies=10)
    exact = density_peaks(X, kernel=kernel)
    for size in (600, 601):
        again = density_peaks(X, kernel=kernel, sample_size=size)
        for name in ("rho", "delta", "predecessor"):
            np.testing.assert_array_equal(getattr(again, name), getattr(exact, name))
    assert not np.array_equal(density_peaks(X, sample_size=599).rho, exact.rho)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("size", [2, 40, 1000])
def test_delta_is_exact_for_the_estimated_density(kernel, size):
    X = crowds(1400, copies=5)
    peaks = density_peaks(X, kernel=kernel, sample_size=size)
    rank = np.empty(len(X), dtype=int)
    rank[np.argsort(-peaks.rho, kind="stable")] = np.arange(len(X))
    D = np.sqrt(np.square(X[:, None] - X).sum(axis=2))
    to_denser = np.where(rank[:, None] > rank, D, np.inf)
    root = peaks.predecessor < 0
    assert rank[root].tolist() == [0]
    to_denser[root] = D[root].max()
    np.testing.assert_allclose(peaks.delta, to_denser.min(axis=1), rtol=1e-13)
    rows = np.flatnonzero(~root)
    assert (rank[peaks.predecessor[rows]] < rank[rows]).all()
    np.testing.assert_allclose(D[rows, peaks.predecessor[rows]], peaks.delta[rows], rtol=1e-13)


@pytest.mark.parametrize("kernel", KERNELS)
def test_copies_are_counted_and_not_estimated(kernel):
    """A place is as dense as it has copies, whichever of them are in the sample."""
    X = np.repeat([[0.0, 0.0], [9.0, 9.0], [0.0, 9.0]], [70, 20, 10], axis=0)
    X = X[np.random.default_rng(0).permutation(100)]
    for size in (2, 5, 50):
        peaks = density_peaks(X, dc=0.1, kernel=kernel, sample_size=size)
        assert peaks.rho[(X == 0).all(axis=1)].tolist() == [69] * 70
        assert peaks.rho[(X == 9).all(axis=1)].tolist() == [19] * 20


def test_clusters_are_found_from_a_sample():
    rng = np.random.default_rng(3)
    truth = np.repeat([0, 1, 2], [9000, 6000, 5000])
    X = rng.normal(size=(20_000, 4)) + np.array([0.0, 9.0, -9.0])[truth, None]
    peaks = density_peaks(X, sample_size=1000)
    assert peaks.labels(peaks.centers(n=3)).tolist() == truth.tolist()


def test_the_same_sample_every_time():
    X = crowds(500, copies=2)
    np.random.seed(1)  # noqa: NPY002
    first = density_peaks(X, sample_size=50)
    np.random.seed(2)  # noqa: NPY002
    np.testing.assert_array_equal(density_peaks(X, sample_size=50).rho, first.rho)


@pytest.mark.parametrize("size", [1, 0, -5, 2.5, "all"])
def test_a_sample_is_a_number_of_points(size):
    with pytest.raises(ValueError, match="must be a number of points, at least 2"):
        density_peaks(np.eye(5), sample_size=size)


def test_many_copies_of_few_points():
    """A hundred thousand rows in four places; whatever looks at all pairs does not come back."""
    counts = np.array([60_000, 40_000, 20_000, 10])
    places = np.array([[0.0, 0.0], [1.0, 0.0], [50.0, 0.0], [90.0, 0.0]])
    place = np.random.default_rng(0).permutation(np.repeat(np.arange(4), counts))
    for kernel in KERNELS:
        peaks = density_peaks(places[place], dc=2.0, kernel=kernel)
        near = 1.0 if kernel == "cutoff" else np.exp(-1 / 4)
        expected = counts - 1 + near * np.array([40_000, 60_000, 0, 0])
        np.testing.assert_allclose(peaks.rho, expected[place], rtol=1e-12)
        first = np.array([np.flatnonzero(place == i)[0] for i in range(4)])
        densest, second = (1, 0) if expected[1] > expected[0] else (0, 1)
        if kernel == "cutoff":  # equally dense
            densest, second = np.argsort(first[:2])
        assert peaks.predecessor[first[densest]] == -1
        assert peaks.predecessor[first[second]] == first[densest]
        assert peaks.predecessor[first[2:]].tolist() == [first[1], first[2]]
        others = np.setdiff1d(np.arange(len(place)), first)
        np.testing.assert_array_equal(peaks.predecessor[others], first[place[others]])
        # The first two clusters touch each other.
        assert not (peaks.halo(place) ^ (place < 2)).any()
        one = np.where(place < 2, 0, place)
        assert not peaks.halo(one).any()


def test_the_halo_of_a_thousand_clusters():
    rng = np.random.default_rng(5)
    X = np.repeat(rng.uniform(0, 30, (1000, 2)), 2, axis=0)
    label = np.arange(2000) // 2
    label[::7] = -1
    peaks = density_peaks(X, dc=0.5)
    halo = peaks.halo(label)
    D = np.sqrt(np.square(X[:, None] - X).sum(axis=2))
    foreign = (label[:, None] != label) & (label >= 0) & (D < 0.5)
    on_border = foreign.any(axis=1) & (label >= 0)
    border = np.full(1000, -np.inf)
    np.maximum.at(border, label[on_border], peaks.rho[on_border])
    expected = (label < 0) | (peaks.rho <= border[label])
    np.testing.assert_array_equal(halo, expected)
    assert 0.1 < halo.mean() < 0.9
