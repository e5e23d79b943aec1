from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from cv_densityf.datasets import two_view_scene
from cv_densityf.plotting import (
    new_figure,
    plot_decision_graph,
    plot_epipolar_lines,
    plot_matches,
    summary_figure,
)

SCENE = two_view_scene(60, inlier_ratio=0.5, noise=0)
PEAKS = SimpleNamespace(
    rho=np.array([9.0, 5.0, 1.0, 0.0, 8.0]), delta=np.array([80.0, 3.0, 40.0, 70.0, 0.0])
)
#: Six classes of matches, which with a curve have the longest legend there is.
CLASSES = {
    "kept": np.arange(60) < 20,
    "mask": SCENE.inliers,
    "reliability": np.where(np.arange(60) < 40, 1, np.nan),
}
CURVED = SimpleNamespace(rho=np.arange(60.0), delta=np.linspace(90, 1, 60))
IMAGE = np.random.default_rng(0).integers(0, 255, (960, 1280), dtype=np.uint8)


@pytest.fixture
def ax():
    return Figure().subplots()


@pytest.fixture(autouse=True)
def no_display(monkeypatch):
    mpl.use("agg")
    yield
    import matplotlib.pyplot as plt

    plt.close("all")


def drawn(ax):
    """Number of points of each labelled set in the axes."""
    return {
        line.get_label(): len(line.get_xdata())
        for line in ax.lines
        if not line.get_label().startswith("_")
    }


def legend(ax):
    return [text.get_text() for text in ax.get_legend().get_texts()]


class TestDecisionGraph:
    def test_classes(self, ax):
        kept = [True, True, False, False, True]
        mask = [True, False, True, False, True]
        assert plot_decision_graph(PEAKS, kept=kept, mask=mask, ax=ax) is ax
        sets = {line.get_label(): line.get_xydata().tolist() for line in ax.lines}
        assert sets["kept, inlier (2)"] == [[9, 80], [8, 0]]
        assert sets["kept, not an inlier (1)"] == [[5, 3]]
        assert sets["dropped, yet inlier (1)"] == [[1, 40]]
        assert sets["dropped (1)"] == [[0, 70]]
        assert set(legend(ax)) == set(sets)

    def test_curve(self, ax):
        plot_decision_graph(PEAKS, alpha=0.05, ax=ax)
        (curve,) = (line for line in ax.lines if "0.05" in line.get_label())
        x, y = curve.get_data()
        np.testing.assert_allclose(x * y, 0.05 * 9 * 80)
        assert x.max() >= 9
        assert y.max() >= 80

    def test_no_curve_where_none_is_the_rule(self, ax):
        plot_decision_graph(PEAKS, ax=ax)
        assert drawn(ax) == {"matches (5)": 5}

    def test_curve_parts_kept_from_dropped_by_default(self, ax):
        plot_decision_graph(PEAKS, alpha=0.05, ax=ax)
        product = PEAKS.rho * PEAKS.delta
        kept = int(np.sum(product >= 0.05 * 9 * 80))
        assert drawn(ax)[f"kept ({kept})"] == kept
        assert drawn(ax)[f"dropped ({5 - kept})"] == 5 - kept

    def test_units_do_not_matter(self, ax):
        """Small numbers stand as far apart as large ones, and are nobody's pixels."""
        places = []
        for unit in (1.0, 1e-5):
            ax.clear()
            peaks = SimpleNamespace(rho=PEAKS.rho, delta=unit * PEAKS.delta)
            plot_decision_graph(peaks, ax=ax)
            to_axes = ax.transData + ax.transAxes.inverted()
            places.append(to_axes.transform(np.c_[peaks.rho, peaks.delta]))
        np.testing.assert_allclose(*places, atol=1e-6)
        height = dict(zip(PEAKS.delta, places[0][:, 1], strict=True))
        assert height[80] - height[3] > 0.3
        assert "px" not in ax.get_ylabel()

    @pytest.mark.parametrize("alpha", [None, 0.011])
    def test_every_point_is_in_view(self, ax, alpha):
        plot_decision_graph(PEAKS, alpha=alpha, ax=ax)
        (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
        assert left < PEAKS.rho.min()
        assert right > PEAKS.rho.max()
        assert bottom < PEAKS.delta.min()
        assert top > PEAKS.delta.max()

    @pytest.mark.parametrize("n", [0, 1, 4])
    def test_nothing_to_tell(self, ax, n):
        peaks = SimpleNamespace(rho=np.zeros(n), delta=np.zeros(n))
        plot_decision_graph(peaks, alpha=0.011, ax=ax)
        ax.figure.draw_without_rendering()

    @pytest.mark.parametrize("name", ["kept", "mask", "reliability"])
    def test_lengths(self, ax, name):
        with pytest.raises(ValueError, match=name):
            plot_decision_graph(PEAKS, **{name: [True]}, ax=ax)


class TestMatches:
    def test_classes(self, ax):
        kept = np.arange(60) < 40
        plot_matches(IMAGE, IMAGE, SCENE.X, kept, SCENE.inliers, ax=ax)
        sets = drawn(ax)
        for label, rows in {
            "kept, inlier": kept & SCENE.inliers,
            "kept, not an inlier": kept & ~SCENE.inliers,
            "dropped, yet inlier": ~kept & SCENE.inliers,
            "dropped": ~kept & ~SCENE.inliers,
        }.items():
            # Each match has a point in both images.
            assert sets[f"{label} ({rows.sum()})"] == 2 * rows.sum()
        assert set(legend(ax)) == set(sets)

    def test_what_density_did_not_look_at_was_not_dropped(self, ax):
        plot_matches(None, None, SCENE.X, **CLASSES, ax=ax)
        kept, seen = np.arange(60) < 20, np.arange(60) < 40
        sets = drawn(ax)
        for label, rows in {
            "dropped, yet inlier": ~kept & seen & SCENE.inliers,
            "dropped": ~kept & seen & ~SCENE.inliers,
            "not looked at, inlier": ~seen & SCENE.inliers,
            "not looked at, not an inlier": ~seen & ~SCENE.inliers,
        }.items():
            assert sets[f"{label} ({rows.sum()})"] == 2 * rows.sum()
        graph = Figure().subplots()
        plot_decision_graph(CURVED, **CLASSES, ax=graph)
        assert {label: 2 * n for label, n in drawn(graph).items()} == sets
        plot_matches(None, None, SCENE.X, **{**CLASSES, "mask": None}, ax=graph)
        assert set(legend(graph)) == {"kept (20)", "dropped (20)", "not looked at (20)"}

    @pytest.mark.parametrize("kept", [None, np.ones(60, bool)])
    def test_where_nothing_was_dropped_nothing_was_kept(self, ax, kept):
        plot_matches(None, None, SCENE.X, kept, SCENE.inliers, ax=ax)
        assert drawn(ax) == {"inlier (30)": 60, "not an inlier (30)": 60}

    def test_colors_of_inliers_and_others_differ_for_all_eyes(self, ax):
        plot_matches(None, None, SCENE.X, **CLASSES, ax=ax)
        lines = [line for line in ax.lines if not line.get_label().startswith("_")]
        rgb = {line.get_label().split(" (")[0]: to_rgb(line.get_color()) for line in lines}
        # Without red or without green, blue and lightness are what is left.
        wrong = np.array(rgb["kept, not an inlier"])
        for right in ("kept, inlier", "dropped, yet inlier", "not looked at, inlier"):
            assert rgb[right][2] - wrong[2] > 0.5

    def test_points_lie_on_their_images(self, ax):
        # The second image is shown as high as the first, twice its size.
        plot_matches(IMAGE, IMAGE[:480, :700], SCENE.X, ax=ax)
        shown = np.vstack([line.get_xydata() for line in ax.lines if "matches" in line.get_label()])
        first, second = (image.get_extent() for image in ax.images)
        for (left, right, bottom, top), size in ((first, (1280, 960)), (second, (1400, 960))):
            assert (right - left, bottom - top) == size
        assert first[1] < second[0]
        # An image begins half a pixel before the middle of its first pixel.
        np.testing.assert_allclose(shown[:60], SCENE.points1 + 0.5)
        expected = (SCENE.points2 + 0.5) * 2 + [second[0], 0]
        np.testing.assert_allclose(shown[60:], expected)

    @pytest.mark.parametrize("sizes", [[(20, 740), (500, 740)], [(500, 740), (20, 740)]])
    def test_no_image_is_a_speck_beside_a_strip(self, ax, sizes):
        images = [np.zeros(size, np.uint8) for size in sizes]
        plot_matches(*images, np.full((1, 4), 9.0), ax=ax)
        (bottom, top), extents = ax.get_ylim(), [image.get_extent() for image in ax.images]
        widths = [right - left for left, right, _, _ in extents]
        assert max(widths) <= 4 * min(widths) + 1e-9
        assert extents[0][1] < extents[1][0]
        assert bottom == max(extent[2] for extent in extents)
        assert top == 0

    def test_lines_join_the_points(self, ax):
        plot_matches(IMAGE, IMAGE, SCENE.X, max_lines=20, ax=ax)
        (lines,) = ax.collections
        shown = np.vstack([line.get_xydata() for line in ax.lines if "matches" in line.get_label()])
        expected = np.stack([shown[:60:3], shown[60::3]], axis=1)
        np.testing.assert_allclose(np.array(lines.get_segments()), expected)

    def test_cv2s_mask_will_do(self, ax):
        mask = (np.arange(60) < 20).astype(np.uint8)[:, None]
        plot_matches(None, None, SCENE.X, mask=mask, ax=ax)
        other = Figure().subplots()
        plot_matches(None, None, SCENE.X, mask=mask[:, 0] > 0, ax=other)
        assert drawn(ax) == drawn(other)

    def test_images_need_not_be_given(self, ax):
        plot_matches(None, None, SCENE.X, ax=ax)
        assert drawn(ax) == {"matches (60)": 120}
        shown = next(line for line in ax.lines if "matches" in line.get_label()).get_xydata()
        (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
        assert left < shown[:, 0].min()
        assert shown[:, 0].max() < right
        assert top < shown[:, 1].min()
        assert shown[:, 1].max() < bottom

    def test_rows_that_are_not_finite_are_left_out(self, ax):
        X = SCENE.X
        X[3, 0], X[7, 3] = np.nan, np.inf
        plot_matches(None, None, X, mask=SCENE.inliers, ax=ax)
        assert sum(drawn(ax).values()) == 2 * 58

    @pytest.mark.parametrize(
        "image", [IMAGE / 255, IMAGE.astype(np.uint16), np.dstack([IMAGE] * 4)]
    )
    def test_kinds_of_images(self, ax, image):
        plot_matches(image, IMAGE, SCENE.X, ax=ax)
        assert len(ax.images) == 2

    def test_what_is_no_image(self):
        for image, message in (
            (Image.new("L", (4, 4)), "must be a NumPy array, not Image; read_image makes one"),
            ([[1, 2], [3, 4]], "must be a NumPy array, not list"),
        ):
            with pytest.raises(TypeError, match=message):
                plot_matches(image, IMAGE, SCENE.X)
            with pytest.raises(TypeError, match=message):
                plot_epipolar_lines(IMAGE, image, SCENE.X, SCENE.F)
        with pytest.raises(ValueError, match="image must have the shape"):
            plot_matches(IMAGE[0], IMAGE, SCENE.X)

    def test_hidden_rows_are_left_out(self, ax):
        X = np.ma.masked_array(SCENE.X, mask=np.zeros((60, 4)))
        X[:5] = np.ma.masked
        plot_matches(None, None, X, ax=ax)
        assert drawn(ax) == {"matches (55)": 110}

    def test_numbers_are_real(self):
        with pytest.raises(ValueError, match="X is of type complex128"):
            plot_matches(None, None, SCENE.X + 1j)
        with pytest.raises(ValueError, match="F is of type complex128"):
            plot_epipolar_lines(None, None, SCENE.X, SCENE.F + 1j)

    @pytest.mark.parametrize("X", [np.full((9, 4), 7.0), np.outer(np.arange(9), [1, 0, 0, 5])])
    def test_no_spread(self, ax, X):
        plot_matches(None, None, X, ax=ax)
        (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
        assert 0.1 < (right - left) / (bottom - top) < 10

    @pytest.mark.parametrize("n", [0, 1])
    def test_few(self, ax, n):
        plot_matches(None, None, SCENE.X[:n], ax=ax)
        ax.figure.draw_without_rendering()

    def test_shapes(self, ax):
        with pytest.raises(ValueError, match=r"X must have the shape \(n, 4\)"):
            plot_matches(None, None, SCENE.points1, ax=ax)
        with pytest.raises(ValueError, match="mask"):
            plot_matches(None, None, SCENE.X, mask=[True], ax=ax)


class TestEpipolarLines:
    def line_and_points(self, ax):
        """Drawn segments (m, 2, 2) without their dark borders, and drawn points (m, 2)."""
        segments = [line.get_xydata() for line in ax.lines if line.get_linewidth() == 1.8]
        points = [line.get_xydata()[0] for line in ax.lines if line.get_marker() == "o"]
        return np.array(segments), np.array(points)

    def test_lines_pass_through_the_points_of_exact_matches(self, ax):
        plot_epipolar_lines(IMAGE, IMAGE, SCENE.X, SCENE.F, SCENE.inliers, n_lines=6, ax=ax)
        segments, points = self.line_and_points(ax)
        assert len(segments) == len(points) == 12
        direction = segments[:, 1] - segments[:, 0]
        offset = points - segments[:, 0]
        cross = direction[:, 0] * offset[:, 1] - direction[:, 1] * offset[:, 0]
        assert np.abs(cross / np.linalg.norm(direction, axis=1)).max() < 1e-6

    def test_lines_end_at_the_borders(self, ax):
        plot_epipolar_lines(IMAGE, IMAGE, SCENE.X, SCENE.F, SCENE.inliers, ax=ax)
        segments, _ = self.line_and_points(ax)
        for image, ends in zip(ax.images, (segments[::2], segments[1::2]), strict=True):
            left, right, bottom, top = image.get_extent()
            x, y = ends.reshape(-1, 2).T
            border = np.min(np.abs([x - left, x - right, y - top, y - bottom]), axis=0)
            assert border.max() < 1e-6
            assert x.min() > left - 1e-6
            assert x.max() < right + 1e-6
            assert y.min() > top - 1e-6
            assert y.max() < bottom + 1e-6

    def test_ten_lines_have_ten_colors(self, ax):
        plot_epipolar_lines(IMAGE, IMAGE, SCENE.X, SCENE.F, n_lines=10, ax=ax)
        points = [line for line in ax.lines if line.get_marker() == "o"]
        assert len(points) == 20
        assert len({line.get_color() for line in points}) == 10

    def test_only_inliers_are_drawn(self, ax):
        mask = np.zeros(60, bool)
        mask[[5, 17]] = True
        plot_epipolar_lines(IMAGE, IMAGE, SCENE.X, SCENE.F, mask, ax=ax)
        _, points = self.line_and_points(ax)
        assert sorted(points[::2].tolist()) == sorted((SCENE.points1[mask] + 0.5).tolist())
        assert sorted(text.get_text() for text in ax.texts) == ["1", "1", "2", "2"]

    def test_matches_far_apart_are_chosen(self, ax):
        crowd = np.random.default_rng(0).uniform(450, 550, (50, 4))
        corners = np.array([[9.0, 9], [9, 950], [1270, 9], [1270, 950]])
        X = np.vstack([crowd, np.hstack([corners, corners])])
        plot_epipolar_lines(IMAGE, IMAGE, X, SCENE.F, n_lines=5, ax=ax)
        _, points = self.line_and_points(ax)
        assert {tuple(point) for point in corners + 0.5} < {tuple(point) for point in points[::2]}

    def test_lines_outside_the_image_are_left_out(self, ax):
        # Rows of a rectified pair; the second match lies far above the images.
        F = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
        X = np.array([[10.0, 20, 30, 20], [10, -500, 30, -500]])
        plot_epipolar_lines(IMAGE, IMAGE, X, F, ax=ax)
        segments, _ = self.line_and_points(ax)
        assert len(segments) == 2
        np.testing.assert_allclose(segments[:, :, 1], 20.5)

    @pytest.mark.parametrize("n", [0, 1])
    def test_few(self, ax, n):
        plot_epipolar_lines(None, None, SCENE.X[:n], SCENE.F, ax=ax)
        ax.figure.draw_without_rendering()

    def test_shape_of_F(self, ax):
        with pytest.raises(ValueError, match=r"F must have the shape \(3, 3\)"):
            plot_epipolar_lines(None, None, SCENE.X, np.zeros((9, 3)), ax=ax)


class TestLegend:
    """As wide as its axes and inside of the figure, whoever made them."""

    @pytest.mark.parametrize("layout", [None, "constrained", "tight"])
    @pytest.mark.parametrize("columns", [1, 2])
    @pytest.mark.parametrize("tall", [False, True])
    def test_fits(self, layout, columns, tall):
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(1, columns, layout=layout, squeeze=False)
        image = IMAGE.T if tall else IMAGE
        plot_matches(image, image, SCENE.X, **CLASSES, ax=axes[0, 0])
        if columns == 2 or tall:
            axes[0, -1].clear()
            plot_decision_graph(CURVED, alpha=0.011, **CLASSES, ax=axes[0, -1])
        figure.draw_without_rendering()
        for ax in axes[0]:
            legend, slot = ax.get_legend().get_window_extent(), ax.get_position(original=True)
            assert legend.width <= 1.02 * slot.width * figure.bbox.width
            assert legend.y1 <= figure.bbox.y1 + 1
            assert legend.y0 >= ax.get_window_extent().y1 - 1

    def test_makes_no_room_where_there_is_some(self, ax):
        before = ax.get_position(original=True).bounds
        plot_matches(IMAGE, IMAGE, SCENE.X, **CLASSES, ax=ax)
        assert ax.get_position(original=True).bounds == before

    def test_takes_the_width_that_the_layout_gives(self):
        """Two lines; it would be three in the width of axes that are not laid out."""
        ax = Figure(figsize=(8.5, 4), layout="constrained").subplots()
        plot_matches(IMAGE, IMAGE, SCENE.X, **CLASSES, ax=ax)
        first, second, third, *_ = ax.get_legend().get_texts()
        ax.figure.draw_without_rendering()
        assert first.get_fontsize() == 11
        assert first.get_window_extent().y0 > second.get_window_extent().y0
        assert abs(first.get_window_extent().y0 - third.get_window_extent().y0) < 5

    def test_is_one_line_of_a_large_picture(self):
        classes = {**CLASSES, "reliability": None}
        figure = summary_figure(None, None, SCENE.X, SCENE.F, **classes, peaks=CURVED, alpha=0.011)
        figure.draw_without_rendering()
        for ax in (figure.axes[0], figure.axes[2]):
            legend = ax.get_legend()
            assert legend.get_window_extent().height < 40
            assert legend.get_texts()[0].get_fontsize() == 11


def test_summary_is_1600_pixels_wide(tmp_path):
    peaks = SimpleNamespace(rho=np.arange(60.0), delta=np.linspace(9, 1, 60))
    figure = summary_figure(
        None, None, SCENE.X, SCENE.F, kept=SCENE.inliers, mask=SCENE.inliers, peaks=peaks
    )
    figure.savefig(tmp_path / "summary.png")
    from matplotlib.image import imread

    image = imread(tmp_path / "summary.png")
    assert image.shape[1] == 1600
    assert image.std() > 0.05


def test_axes_are_made_where_none_are_given():
    axes = [
        plot_decision_graph(PEAKS),
        plot_matches(None, None, SCENE.X),
        plot_epipolar_lines(None, None, SCENE.X, SCENE.F),
    ]
    assert len({id(ax.figure) for ax in axes}) == 3


def test_new_figures_are_not_pyplots():
    import matplotlib.pyplot as plt

    new_figure(4, 3)
    assert plt.get_fignums() == []


def test_matplotlib_is_imported_only_to_draw():
    code = "import cv_densityf.plotting, sys; print('matplotlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.mark.parametrize("draw", [lambda: plot_decision_graph(PEAKS), lambda: new_figure(1, 1)])
def test_without_matplotlib(monkeypatch, draw):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match="pip install matplotlib"):
        draw()
