"""Density peaks against the definitions, ties and duplicates included."""

from __future__ import annotations

import tracemalloc
from unittest import mock

import numpy as np
import pytest
import reference_density as reference
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from cv_densityf import _density
from cv_densityf._density import density_peaks

KERNELS = ["cutoff", "gaussian"]

#: Block sizes that force the kd-tree, the exact search behind it, or one plain matrix.
blocks = st.sampled_from([1, 60, 1 << 20])
shapes = st.tuples(st.integers(1, 40), st.integers(1, 5))
#: On a small lattice distances are exact, and ties and duplicates are the rule.
lattice = hnp.arrays(np.float64, shapes, elements=st.integers(0, 3).map(float))
scattered = st.builds(
    lambda seed, shape: np.random.default_rng(seed).normal(size=shape) * 100,
    st.integers(0, 2**32 - 1),
    shapes,
)
points = lattice | scattered


def peaks_of(X, block=1 << 20, **options):
    with mock.patch.object(_density, "_BLOCK", block):
        return density_peaks(X, **options)


@given(X=points, percent=st.floats(0.1, 100))
def test_dc_is_the_order_statistic(X, percent):
    low, high = reference.cutoff_interval(X.tolist(), percent)
    dc = density_peaks(X, dc_percent=percent).dc
    assert low * (1 - 1e-12) < dc <= high * (1 + 1e-12)


@given(X=points, percent=st.floats(0.1, 100) | st.just(100.0))
def test_dc_lies_half_way_to_the_next_distance(X, percent):
    low, high = reference.cutoff_interval(X.tolist(), percent)
    dc = density_peaks(X, dc_percent=percent).dc
    if low == 0 or high / low < 1 + 1e-8:
        return  # no distances, or such as differ by rounding
    assert dc == pytest.approx((low + high) / 2 if high < np.inf else low, rel=1e-8)
    assert dc > low


def test_distances_that_differ_by_less_than_1e_9_are_one():
    for gap, rho in ((1.5e-9, [1, 1, 0]), (0.7e-9, [1, 2, 1])):
        peaks = density_peaks([[0.0], [1.0], [2 + gap]], dc_percent=1.0)
        assert peaks.rho.tolist() == rho


def test_numbers_of_any_type_and_the_default_percentage():
    X = np.random.default_rng(0).integers(-120, 120, (300, 4))
    expected = density_peaks(X.astype(float), dc=None, dc_percent=2.0, kernel="cutoff")
    for kind in (np.int8, np.int64, np.float32):
        peaks = density_peaks(X.astype(kind))
        assert peaks.X.dtype == np.float64
        assert peaks.dc == expected.dc
        np.testing.assert_array_equal(peaks.rho, expected.rho)
        np.testing.assert_array_equal(peaks.delta, expected.delta)


def test_no_weight_at_a_distance_too_large_for_the_kernel():
    """Whatever the caller has numpy do about it."""
    with np.errstate(all="raise"):
        over = density_peaks([[0.0], [1e150], [1e150]], dc=1e-100, kernel="gaussian")
        under = density_peaks([[0.0], [30.0], [30.0]], dc=1.0, kernel="gaussian")
    assert over.rho.tolist() == under.rho.tolist() == [0, 1, 1]


@given(X=points, kernel=st.sampled_from(KERNELS), power=st.sampled_from([-14, 9]))
def test_another_unit_of_length_changes_no_digit(X, kernel, power):
    peaks, others = (density_peaks(Y, kernel=kernel) for Y in (X, X * 2.0**power))
    np.testing.assert_array_equal(others.rho, peaks.rho)
    np.testing.assert_array_equal(others.predecessor, peaks.predecessor)
    np.testing.assert_array_equal(others.delta, peaks.delta * 2.0**power)
    if peaks.delta.any():  # in one place any cut-off is as good
        assert others.dc == peaks.dc * 2.0**power


@given(X=lattice, dc=st.integers(1, 18).map(lambda s: float(np.sqrt(s))))
def test_cutoff_kernel_is_strict_at_the_boundary(X, dc):
    assert density_peaks(X, dc=dc).rho.tolist() == reference.density(X.tolist(), dc, "cutoff")


@given(X=points, block=blocks, kernel=st.sampled_from(KERNELS), percent=st.floats(0.1, 60))
def test_density_is_the_definition(X, block, kernel, percent):
    peaks = peaks_of(X, block, kernel=kernel, dc_percent=percent)
    expected = reference.density(X.tolist(), peaks.dc, kernel)
    np.testing.assert_allclose(peaks.rho, expected, rtol=1e-12, atol=1e-300)


@given(X=points, block=blocks, kernel=st.sampled_from(KERNELS), percent=st.floats(0.1, 60))
def test_delta_and_predecessor_are_the_definition(X, block, kernel, percent):
    peaks = peaks_of(X, block, kernel=kernel, dc_percent=percent)
    delta, predecessor = reference.delta_and_predecessor(X.tolist(), peaks.rho.tolist())
    assert peaks.predecessor.tolist() == predecessor
    np.testing.assert_allclose(peaks.delta, delta, rtol=1e-13)
    np.testing.assert_array_equal(peaks.gamma, peaks.rho * peaks.delta)


@given(X=points, block=blocks, percent=st.floats(0.5, 60), data=st.data())
def test_labels_and_halo_are_the_definition(X, block, percent, data):
    peaks = peaks_of(X, block, dc_percent=percent)
    centers = data.draw(
        st.integers(1, len(X)).map(lambda n: peaks.centers(n=n).tolist())
        | st.lists(st.integers(0, len(X) - 1), unique=True)
    )
    labels = peaks.labels(centers).tolist()
    assert labels == reference.labels(peaks.predecessor.tolist(), centers)
    with mock.patch.object(_density, "_BLOCK", block):
        halo = peaks.halo(labels).tolist()
    assert halo == reference.halo(X.tolist(), peaks.rho.tolist(), labels, peaks.dc)


@given(X=lattice, block=blocks, dc=st.integers(1, 6).map(lambda s: float(np.sqrt(s))))
def test_the_border_of_a_halo_is_strictly_nearer_than_dc(X, block, dc):
    labels = np.arange(len(X)) % 3
    peaks = density_peaks(X, dc=dc)
    with mock.patch.object(_density, "_BLOCK", block):
        halo = peaks.halo(labels).tolist()
    assert halo == reference.halo(X.tolist(), peaks.rho.tolist(), labels.tolist(), dc)


def test_a_neighbor_at_just_dc_is_none():
    peaks = density_peaks([[0.0], [1.0], [2.0], [3.5]], dc=1.0)
    assert peaks.rho.tolist() == [0, 0, 0, 0]
    assert not peaks.halo([0, 1, 2, 2]).any()
    peaks = density_peaks([[0.0], [1.0], [2.0], [3.5]], dc=np.nextafter(1.0, 2.0))
    assert peaks.rho.tolist() == [1, 2, 1, 0]
    assert peaks.halo([0, 1, 2, 2]).tolist() == [True, True, True, True]
    assert peaks.halo([0, 1, 1, 2]).tolist() == [True, True, True, False]


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_size_of_blocks_does_not_matter_to_a_sample(kernel):
    X = np.random.default_rng(0).normal(size=(200, 3))
    one, many = (peaks_of(X, b, kernel=kernel, sample_size=30) for b in (1 << 20, 600))
    np.testing.assert_allclose(many.rho, one.rho, rtol=1e-12)


def test_a_sample_of_all_but_one_misses_one_neighbor():
    """No row is in the sample twice."""
    X = np.random.default_rng(0).normal(size=(300, 3))
    gap = density_peaks(X, sample_size=299).rho - density_peaks(X).rho
    assert 0 < np.abs(gap).max() < 1.5


@given(n=st.integers(0, 40), width=st.integers(1, 70))
def test_parts_are_as_large_as_a_block_allows(n, width):
    with mock.patch.object(_density, "_BLOCK", 60):
        parts = list(_density._parts(np.arange(n), width))
    assert [row for part in parts for row in part] == list(range(n))
    sizes = [len(part) for part in parts]
    assert all(size * width <= 60 or size == 1 for size in sizes)
    assert all((size + 1) * width > 60 for size in sizes[:-1])


def test_ties_beyond_the_first_neighbors():
    """On a lattice more points are equally far than a neighbour list holds."""
    X = np.stack(np.meshgrid(*[np.arange(6.0)] * 3), axis=-1).reshape(-1, 3)
    X = np.random.default_rng(0).permutation(X)
    peaks = peaks_of(X, block=1, dc=0.5)
    assert (peaks.rho == 0).all()
    delta, predecessor = reference.delta_and_predecessor(X.tolist(), peaks.rho.tolist())
    assert peaks.predecessor.tolist() == predecessor
    assert peaks.delta.tolist() == delta


@given(X=points, alpha=st.floats(0, 1))
def test_centers(X, alpha):
    peaks = density_peaks(X)
    centers = peaks.centers(alpha=alpha)
    limit = alpha * (peaks.rho.max() * peaks.delta.max())
    assert sorted(centers) == np.flatnonzero(peaks.gamma >= limit).tolist()
    assert peaks.predecessor[centers[0]] == -1
    assert (np.diff(peaks.gamma[centers]) <= 0).all()
    assert peaks.centers(n=len(centers)).tolist() == centers.tolist()


def test_equal_centers_come_in_the_order_of_the_rows():
    X = np.random.default_rng(0).permutation(np.repeat(np.arange(100.0), 3))[:, None]
    peaks = density_peaks(X, dc=0.5)
    assert len(np.unique(peaks.gamma)) < 20
    expected = sorted(range(300), key=lambda row: (-peaks.gamma[row], row))
    assert peaks.centers(n=300).tolist() == expected
    assert peaks.centers(alpha=0).tolist() == expected


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("columns", [1, 2, 4, 20])
def test_larger_sets_agree_with_the_matrix(kernel, columns):
    """Through neighbour lists of growing length, with duplicates, and with the usual block size."""
    rng = np.random.default_rng(columns)
    X = np.round(rng.normal(0, 3, (1500, columns)), 1)
    peaks = density_peaks(X, kernel=kernel)
    D = np.sqrt(np.square(X[:, None] - X).sum(axis=2))
    rank = np.empty(len(X), dtype=int)
    rank[np.argsort(-peaks.rho, kind="stable")] = np.arange(len(X))
    to_denser = np.where(rank[:, None] > rank, D, np.inf)
    root = np.flatnonzero(peaks.predecessor < 0)
    assert rank[root].tolist() == [0]
    to_denser[root] = D[root].max()
    np.testing.assert_allclose(peaks.delta, to_denser.min(axis=1), rtol=1e-13)
    weights = np.less(D, peaks.dc) if kernel == "cutoff" else np.exp(-((D / peaks.dc) ** 2))
    np.fill_diagonal(weights, 0)
    np.testing.assert_allclose(peaks.rho, weights.sum(axis=1), rtol=1e-10)


@pytest.mark.parametrize("kernel", KERNELS)
def test_no_matrix_is_held(kernel):
    X = np.random.default_rng(0).uniform(size=(6000, 4))
    tracemalloc.start()
    try:
        density_peaks(X, dc=0.2, kernel=kernel)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 6000 * 6000 * 8 / 6


def test_delta_is_found_among_few_of_all_pairs():
    X = np.random.default_rng(0).uniform(size=(6000, 4))
    parts, looked_at = _density._parts, []

    def counted(rows, width):
        looked_at.append(len(rows) * width)
        return parts(rows, width)

    with mock.patch.object(_density, "_parts", counted):
        density_peaks(X, dc=0.2)
    assert 6000 < sum(looked_at) < 6000 * 6000 / 10


@pytest.mark.parametrize("percent", [0.5, 2.0, 10.0])
def test_sampled_dc_stays_within_its_stated_error(percent):
    X = 100 + np.random.default_rng(1).normal(size=(4001, 4))
    peaks = density_peaks(X, dc_percent=percent)
    standard_error = np.sqrt((100 / percent - 1) / 1e6)
    miss = peaks.rho.mean() / (percent / 100 * len(X)) - 1
    assert 1e-4 < abs(miss) < 4 * standard_error  # all distances would hit, but for one pair
    assert density_peaks(X, dc_percent=percent).dc == peaks.dc
    exact = density_peaks(X[:4000], dc_percent=percent)
    assert exact.rho.mean() == pytest.approx(percent / 100 * 4000, rel=1e-6)


def test_one_and_two_points():
    one = density_peaks([[3.0, 4.0]])
    assert (one.rho[0], one.delta[0], one.gamma[0], one.predecessor[0]) == (0, 0, 0, -1)
    assert one.labels(one.centers(alpha=0.5)).tolist() == [0]
    two = density_peaks([[0.0, 0.0], [3.0, 4.0]])
    assert two.rho.tolist() == [1, 1]
    assert two.delta.tolist() == [5, 5]
    assert two.predecessor.tolist() == [-1, 0]


@pytest.mark.parametrize("kernel", KERNELS)
def test_all_points_equal(kernel):
    peaks = density_peaks(np.full((1200, 4), 7.0), kernel=kernel)
    assert peaks.dc > 0
    assert (peaks.rho == 1199).all()
    assert (peaks.delta == 0).all()
    assert peaks.predecessor.tolist() == [-1] + [0] * 1199
    assert not peaks.halo(peaks.labels(peaks.centers(n=1))).any()


def test_clusters_of_known_membership_are_found():
    rng = np.random.default_rng(2)
    truth = np.repeat([0, 1, 2], [300, 200, 100])
    X = rng.normal(size=(600, 4)) + np.array([0.0, 12.0, -15.0])[truth, None]
    peaks = density_peaks(X)
    assert peaks.labels(peaks.centers(n=3)).tolist() == truth.tolist()


@settings(max_examples=30)
@given(seed=st.integers(0, 1000))
def test_row_order_only_renames_the_rows(seed):
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(50, 4))
    order = rng.permutation(50)
    before, after = density_peaks(X), density_peaks(X[order])
    assert after.dc == pytest.approx(before.dc, rel=1e-13)
    np.testing.assert_array_equal(after.rho, before.rho[order])


@pytest.mark.parametrize(
    ("X", "options", "message"),
    [
        (np.zeros(4), {}, "two-dimensional"),
        (np.zeros((0, 4)), {}, "at least one row"),
        (np.zeros((4, 0)), {}, "one column"),
        ([[0.0], [np.nan]], {}, "NaN"),
        ([[0.0], [np.inf]], {}, "infinite"),
        ([[0.0], [1e200]], {}, "rescale"),
        ([[0.0] * 4, [1e154] * 4], {}, "rescale"),
        ([[0.0], [1.0]], {"dc": 0.0}, "a distance, finite"),
        ([[0.0], [1.0]], {"dc": np.nan}, "a distance, finite"),
        ([[0.0], [1.0]], {"dc": np.inf}, "a distance, finite"),
        ([[0.0], [1.0]], {"dc_percent": 0.0}, "percentage"),
        ([[0.0], [1.0]], {"dc_percent": 101.0}, "percentage"),
        ([[0.0], [1.0]], {"kernel": "box"}, "'cutoff' or 'gaussian'"),
    ],
)
def test_wrong_input_is_named(X, options, message):
    with pytest.raises(ValueError, match=message):
        density_peaks(X, **options)


def test_a_column_may_be_far_from_another():
    assert density_peaks([[0.0, 1e200], [3.0, 1e200]]).delta.tolist() == [3.0, 3.0]


def test_the_largest_alpha_leaves_the_densest():
    peaks = density_peaks([[0.0], [1.0], [1.5], [9.0]], dc=1.2)
    assert peaks.rho.tolist() == [1, 2, 1, 0]
    assert peaks.centers(alpha=1).tolist() == [1]


@pytest.mark.parametrize("alpha", [0.011, 0.9, 1.0])
def test_where_nothing_stands_out_there_is_one_centre(alpha):
    """Copies of one point, and points all out of each other's reach."""
    for peaks in (density_peaks(np.ones((30, 4))), density_peaks(np.eye(30), dc=1e-3)):
        centers = peaks.centers(alpha=alpha)
        assert len(centers) == 1
        assert peaks.predecessor[centers[0]] == -1
        assert (peaks.labels(centers) == 0).all()
        assert len(peaks.centers(alpha=0)) == 30


@pytest.mark.parametrize(
    "options", [{}, {"alpha": 0.1, "n": 2}, {"alpha": 1.1}, {"n": 0}, {"n": 6}, {"n": 2.5}]
)
def test_centers_wants_one_rule_in_range(options):
    with pytest.raises(ValueError, match=r"alpha|n must be a whole number between 1 and the 5"):
        density_peaks(np.eye(5)).centers(**options)


def test_labels_and_halo_refuse_what_does_not_fit():
    peaks = density_peaks(np.eye(5))
    for centers in ([5], [-1], [1, 1], [0, 5], [4, -1], [0.7], [1.0], [True], ["1"], [2**63]):
        with pytest.raises(ValueError, match="row numbers"):
            peaks.labels(centers)
    with pytest.raises(ValueError, match="shape"):
        peaks.halo([0, 0])


def test_complex_points_are_refused():
    with pytest.raises(ValueError, match="X is of type complex128"):
        density_peaks(np.ones((5, 2)) + 1j)
