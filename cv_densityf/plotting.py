"""Pictures of matches and of what was made of them, with matplotlib.

Every function draws into the axes it is given, or into those of a new figure, and returns them.
The colours of matches are Okabe and Ito's, which colour-blind readers tell apart; where a
difference matters, marker shapes or numbers show it as well.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cv_densityf._arguments import check_mask, real
from cv_densityf._zhang import points_inside
from cv_densityf.matching import grey

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.legend import Legend

#: Okabe and Ito's seven colours, then two of Tol's and white: as many as there are lines.
_LINE_COLORS = (
    *("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#F0E442"),
    *("#332288", "#882255", "#FFFFFF"),
)
#: Between two images, as a share of the first one's width.
_GAP = 0.02
#: At most so many times as wide as the other is an image shown.
_WIDER = 4.0


class _Peaks(Protocol):
    """What a decision graph needs of density peaks."""

    @property
    def rho(self) -> NDArray[Any]: ...
    @property
    def delta(self) -> NDArray[np.float64]: ...


@dataclass(frozen=True)
class _Style:
    """How one class of matches is drawn; ``line`` is the width of the lines that join points."""

    label: str
    color: str
    marker: str
    size: float
    edge: float
    alpha: float
    line: float


#: By what density says of a match, and whether it is an inlier; the least important first. Where it
#: keeps all, it says nothing, and they are just "matches".
_STYLES = {
    ("not looked at", False): _Style(
        "not looked at, not an inlier", "#333333", "+", 4.0, 0.8, 0.6, 0.6
    ),
    ("dropped", False): _Style("dropped", "#333333", ".", 5.0, 0.0, 0.6, 0.6),
    ("not looked at", True): _Style("not looked at, inlier", "#56B4E9", "D", 4.0, 0.0, 1.0, 1.0),
    ("kept", False): _Style("kept, not an inlier", "#D55E00", "x", 5.0, 1.4, 0.9, 1.0),
    ("matches", False): _Style("not an inlier", "#D55E00", "x", 5.0, 1.4, 0.9, 1.0),
    ("kept", True): _Style("kept, inlier", "#0072B2", "o", 4.5, 0.0, 0.9, 1.0),
    ("matches", True): _Style("inlier", "#0072B2", "o", 4.5, 0.0, 0.9, 1.0),
    ("dropped", True): _Style("dropped, yet inlier", "#56B4E9", "^", 5.5, 0.0, 1.0, 1.0),
}


def plot_decision_graph(
    peaks: _Peaks,
    *,
    alpha: float | None = None,
    kept: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    reliability: ArrayLike | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the decision graph: distance to a denser match against density.

    The density is the number of matches closer than the cut-off distance dc.

    Parameters
    ----------
    peaks : DensityPeaksResult
        From `cv_densityf.density_peaks`; anything with ``rho`` and ``delta``, each (n,).
    alpha : float, optional
        Of ``density="paper"``, whose curve rho * delta = alpha * max(rho) * max(delta) is then
        drawn; other rules have none.
    kept : (n,) array of bool, optional
        Matches of the dense part; by default those on or above the curve, all without one.
    mask : (n,) array of bool, optional
        Inliers of the final fundamental matrix; by default they are not told apart.
    reliability : (n,) array, optional
        That of an `Estimate`, NaN for matches whose density was not looked at; by default it was
        looked at for all.
    ax : matplotlib.axes.Axes, optional
        Where to draw; by default a new figure.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    ValueError
        If ``kept``, ``mask`` or ``reliability`` has another length than ``peaks``, or one of the
        first two has negative numbers or NaN.

    References
    ----------
    Rodriguez and Laio, Clustering by fast search and find of density peaks, Science 2014.
    Wu and Wan, Clustering assisted fundamental matrix estimation, 2015.

    Examples
    --------
    >>> import numpy as np
    >>> from types import SimpleNamespace
    >>> from cv_densityf.plotting import plot_decision_graph
    >>> peaks = SimpleNamespace(rho=np.array([9, 5, 1]), delta=np.array([80.0, 3.0, 40.0]))
    >>> ax = plot_decision_graph(peaks, mask=[True, False, False])
    >>> ax.get_xlabel()
    'rho, density: matches within dc'
    """
    rho, delta = np.asarray(peaks.rho), np.asarray(peaks.delta)
    product = (alpha or 0.0) * rho.max(initial=0) * delta.max(initial=0)
    on_or_above: NDArray[np.bool_] = rho * delta >= product
    kept = on_or_above if kept is None else check_mask(kept, len(rho), "kept")
    mask = None if mask is None else check_mask(mask, len(rho), "mask")
    unseen = _unseen(reliability, len(rho))
    ax = given_or_new(ax, (16, 7))
    handles = []
    for order, (style, rows) in enumerate(_classes(kept, mask, unseen)):
        (handle,) = ax.plot(
            rho[rows], delta[rows], ls="none", marker=style.marker, color=style.color,
            ms=style.size, mew=style.edge, alpha=style.alpha, zorder=2 + order,
            label=f"{style.label} ({len(rows)})",
        )  # fmt: skip
        handles.append(handle)
    if rho.max(initial=0) > 0 and delta.max() > 0:
        top, right = 1.5 * delta.max(), 1.03 * rho.max()
        # Three decades are logarithmic, in whatever units the points are.
        linear = delta.max() / 1000
        ax.set_yscale("symlog", linthresh=linear)
        bottom = 0.7 * delta.min() if delta.min() > linear else -0.2 * linear
        ax.set(xlim=(-0.02 * right, right), ylim=(bottom, top))
        if product > 0:
            x = np.geomspace(product / top, right, 400)
            label = rf"$\rho\,\delta = {alpha:g}\;\rho_{{max}}\,\delta_{{max}}$"
            handles += ax.plot(x, product / x, "k--", lw=1.6, zorder=9, label=label)
    ax.set_xlabel("rho, density: matches within dc")
    ax.set_ylabel("delta, distance to a denser match")
    ax.grid(alpha=0.25)
    _legend_above(ax, handles)
    return ax


def plot_matches(
    image1: NDArray[Any] | None,
    image2: NDArray[Any] | None,
    X: ArrayLike,
    kept: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    *,
    reliability: ArrayLike | None = None,
    max_lines: int = 150,
    ax: Axes | None = None,
) -> Axes:
    """Draw the matches of two images side by side: dropped, kept and inliers.

    Parameters
    ----------
    image1, image2 : (h, w) or (h, w, channels) array or None
        Shown in grey, so that the matches stand out. None leaves the place blank.
    X : (n, 4) array
        The columns x, y, x', y', in pixels; rows that are not finite are left out.
    kept : (n,) array of bool, optional
        Matches of the dense part; by default all. Where all are, the legend is only about inliers.
    mask : (n,) array of bool, optional
        Inliers of the final fundamental matrix; by default they are not told apart.
    reliability : (n,) array, optional
        That of an `Estimate`, NaN for matches whose density was not looked at; by default it was
        looked at for all.
    max_lines : int
        Every match gets its two points; about this many, evenly chosen, also get the line that
        joins them.
    ax : matplotlib.axes.Axes, optional
        Where to draw; by default a new figure.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError, ValueError
        If an argument is no image, or a shape does not fit.

    Examples
    --------
    >>> from cv_densityf.datasets import two_view_scene
    >>> from cv_densityf.plotting import plot_matches
    >>> scene = two_view_scene(100)
    >>> ax = plot_matches(None, None, scene.X, mask=scene.inliers)
    >>> [text.get_text() for text in ax.get_legend().get_texts()]
    ['not an inlier (60)', 'inlier (40)']
    """
    X, greys = _matches(X), _greys(image1, image2)
    finite = _finite(X)
    kept = finite if kept is None else check_mask(kept, len(X), "kept")
    mask = None if mask is None else check_mask(mask, len(X), "mask")[finite]
    unseen = _unseen(reliability, len(X))[finite]
    X, kept = X[finite], kept[finite]
    ax = given_or_new(ax, (16, 6))
    place1, place2 = _show(ax, greys, X)
    shown1, shown2 = place1(X[:, :2]), place2(X[:, 2:])

    from matplotlib.collections import LineCollection

    lined = np.zeros(len(X), dtype=bool)
    lined[:: max(1, -(-len(X) // max(1, max_lines)))] = max_lines > 0
    handles = []
    for order, (style, rows) in enumerate(_classes(kept, mask, unseen)):
        joined = rows[lined[rows]]
        segments = np.stack([shown1[joined], shown2[joined]], axis=1)
        lines = LineCollection(
            list(segments), colors=style.color, linewidths=style.line,
            alpha=0.8 * style.alpha, zorder=2 + order,
        )  # fmt: skip
        ax.add_collection(lines, autolim=False)
        (handle,) = ax.plot(
            *np.vstack([shown1[rows], shown2[rows]]).T, ls="none", marker=style.marker,
            ms=style.size, mew=style.edge, color=style.color, alpha=style.alpha,
            zorder=12 + order, label=f"{style.label} ({len(rows)})",
        )  # fmt: skip
        handles.append(handle)
    _legend_above(ax, handles)
    return ax


def plot_epipolar_lines(
    image1: NDArray[Any] | None,
    image2: NDArray[Any] | None,
    X: ArrayLike,
    F: ArrayLike,
    mask: ArrayLike | None = None,
    *,
    n_lines: int = 10,
    ax: Axes | None = None,
) -> Axes:
    """Draw a few matches with the epipolar lines on which they should lie.

    Parameters
    ----------
    image1, image2 : (h, w) or (h, w, channels) array or None
        Shown in grey. None leaves the place blank.
    X : (n, 4) array
        The columns x, y, x', y', in pixels.
    F : (3, 3) array
        Fundamental matrix, ``[x', y', 1] @ F @ [x, y, 1] == 0``.
    mask : (n,) array of bool, optional
        Inliers, of which some far from each other are drawn; by default all rows count.
    n_lines : int
        How many matches are drawn.
    ax : matplotlib.axes.Axes, optional
        Where to draw; by default a new figure.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError, ValueError
        If an argument is no image, or a shape does not fit.

    Examples
    --------
    >>> from cv_densityf.datasets import two_view_scene
    >>> from cv_densityf.plotting import plot_epipolar_lines
    >>> scene = two_view_scene(100)
    >>> ax = plot_epipolar_lines(None, None, scene.X, scene.F, scene.inliers, n_lines=5)
    >>> sorted({text.get_text() for text in ax.texts})
    ['1', '2', '3', '4', '5']
    """
    X, F, greys = _matches(X), real(F, "F"), _greys(image1, image2)
    if F.shape != (3, 3):
        raise ValueError(f"F must have the shape (3, 3), not {F.shape}")
    finite = _finite(X)
    mask = finite if mask is None else check_mask(mask, len(X), "mask")
    ax = given_or_new(ax, (16, 6))
    places = _show(ax, greys, X[finite])
    for number, row in enumerate(_far_apart(X, np.flatnonzero(mask & finite), n_lines)):
        color = _LINE_COLORS[number % len(_LINE_COLORS)]
        point1, point2 = X[row, :2], X[row, 2:]
        lines = (F.T @ [*point2, 1], F @ [*point1, 1])
        for point, line, place in zip((point1, point2), lines, places, strict=True):
            ends = _clipped(line, place.extent)
            if ends is not None:
                ax.plot(*place(ends).T, color="black", lw=3.2, alpha=0.6, zorder=3)
                ax.plot(*place(ends).T, color=color, lw=1.8, zorder=4)
            x, y = place(point)
            ax.plot(x, y, "o", ms=7, color=color, mec="black", mew=1, zorder=5)
            ax.annotate(
                str(number + 1), (x, y), (6, 6), textcoords="offset points", fontsize=11,
                fontweight="bold", zorder=6, annotation_clip=False,
                bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": color, "alpha": 0.9},
            )  # fmt: skip
    return ax


def summary_figure(
    image1: NDArray[Any] | None,
    image2: NDArray[Any] | None,
    X: ArrayLike,
    F: ArrayLike,
    *,
    kept: ArrayLike,
    mask: ArrayLike,
    reliability: ArrayLike | None = None,
    peaks: _Peaks,
    alpha: float | None = None,
) -> Figure:
    """Draw matches, epipolar lines and decision graph below each other, 1600 pixels wide.

    Parameters
    ----------
    image1, image2 : (h, w) or (h, w, channels) array or None
        The images; None leaves the place blank.
    X : (n, 4) array
        The matches, all finite.
    F : (3, 3) array
        Fundamental matrix.
    kept, mask : (n,) array of bool
        Matches of the dense part, and inliers of ``F``.
    reliability : (n,) array, optional
        That of an `Estimate`, NaN for matches whose density was not looked at.
    peaks : DensityPeaksResult
        Density peaks of ``X``.
    alpha : float, optional
        Of ``density="paper"``, for its curve in the decision graph.

    Returns
    -------
    matplotlib.figure.Figure
        Not known to pyplot, see `new_figure`.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    """
    figure = new_figure(16, 18)
    axes = figure.subplots(3, 1)
    plot_matches(image1, image2, X, kept, mask, reliability=reliability, ax=axes[0])
    plot_epipolar_lines(image1, image2, X, F, mask, ax=axes[1])
    axes[1].set_title("Epipolar lines of a few inliers", fontsize=13)
    plot_decision_graph(
        peaks, alpha=alpha, kept=kept, mask=mask, reliability=reliability, ax=axes[2]
    )
    return figure


def require_matplotlib() -> None:
    """Say what to install where matplotlib is missing.

    Raises
    ------
    ImportError
        If matplotlib cannot be imported.
    """
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        raise ImportError(
            "plots need matplotlib: python -m pip install matplotlib "
            "(or the extra cv-densityf[plot])"
        ) from None


def new_figure(width: float, height: float) -> Figure:
    """Make a figure that is not known to pyplot: it needs no display, nothing has to be closed.

    Parameters
    ----------
    width, height : float
        Hundreds of pixels.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=100, layout="constrained")


def given_or_new(ax: Axes | None, size: tuple[float, float]) -> Axes:
    """Return the axes, or those of a new figure of pyplot of this size, hundreds of pixels."""
    if ax is not None:
        return ax
    require_matplotlib()
    import matplotlib.pyplot as plt

    return plt.subplots(figsize=size, dpi=100, layout="constrained")[1]


def _matches(X: ArrayLike) -> NDArray[np.float64]:
    X = real(X, "X")
    if X.ndim != 2 or X.shape[1] != 4:
        raise ValueError(f"X must have the shape (n, 4), the columns x, y, x', y', not {X.shape}")
    return X


def _finite(X: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(X).all(axis=1))


def _greys(
    image1: NDArray[Any] | None, image2: NDArray[Any] | None
) -> list[NDArray[np.uint8] | None]:
    return [None if image is None else grey(image) for image in (image1, image2)]


def _unseen(reliability: ArrayLike | None, n: int) -> NDArray[np.bool_]:
    if reliability is None:
        return np.zeros(n, dtype=bool)
    return check_mask(np.isnan(real(reliability, "reliability")), n, "reliability")


def _classes(
    kept: NDArray[np.bool_], mask: NDArray[np.bool_] | None, unseen: NDArray[np.bool_]
) -> Iterator[tuple[_Style, NDArray[np.intp]]]:
    """Yield the style and the rows of each class that has any, the least important first."""
    said = np.select([kept, unseen], ["kept", "not looked at"], "dropped")
    if kept.all():
        said[:] = "matches"
    for (name, is_inlier), style in _STYLES.items():
        rows = np.flatnonzero((said == name) & ((kept if mask is None else mask) == is_inlier))
        if len(rows):
            # Where nothing is known of inliers, neither claim them nor deny them.
            yield (replace(style, label=name) if mask is None else style), rows


@dataclass(frozen=True)
class _Place:
    """Where an image is shown in the axes.

    ``extent`` is ((left, top), (right, bottom)) in pixels of the image itself.
    """

    extent: NDArray[np.float64]
    scale: float
    shift: NDArray[np.float64]

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Move points in pixels of the image to the axes."""
        return points * self.scale + self.shift


def _show(
    ax: Axes, greys: list[NDArray[np.uint8] | None], X: NDArray[np.float64]
) -> tuple[_Place, _Place]:
    """Show the images side by side, equally high unless one would be a speck beside the other."""
    extent1, extent2 = _extent(greys[0], X[:, :2]), _extent(greys[1], X[:, 2:])
    (width, height), (width2, height2) = extent1[1] - extent1[0], extent2[1] - extent2[0]
    same_width = width / width2
    scale = np.clip(height / height2, same_width / _WIDER, same_width * _WIDER)
    shift2 = np.array([(1 + _GAP) * width, 0]) - scale * extent2[0]
    places = _Place(extent1, 1.0, -extent1[0]), _Place(extent2, scale, shift2)
    for image, place in zip(greys, places, strict=True):
        (left, top), (right, bottom) = place(place.extent)
        if image is not None:
            # Only the light greys: lines and points stay visible on them.
            ax.imshow(
                image, cmap="gray", vmin=-450, vmax=255, extent=(left, right, bottom, top),
                interpolation="antialiased", zorder=0,
            )  # fmt: skip
        frame = np.array([[left, right, right, left, left], [top, top, bottom, bottom, top]])
        ax.plot(*frame, color="0.4", lw=1, zorder=1, clip_on=False)
    ax.set(
        xlim=(0, places[1](extent2)[1, 0]), ylim=(max(height, scale * height2), 0), aspect="equal"
    )
    ax.axis("off")
    return places


def _extent(image: NDArray[Any] | None, points: NDArray[np.float64]) -> NDArray[np.float64]:
    if image is not None:
        height, width = image.shape[:2]
        return np.array([[-0.5, -0.5], [width - 0.5, height - 0.5]])
    if len(points) == 0:
        return np.array([[0.0, 0.0], [1.0, 1.0]])
    low, high = points.min(axis=0), points.max(axis=0)
    center, half = (low + high) / 2, (high - low) / 2
    # A margin, and no sliver where all points lie in a row.
    half = np.maximum(1.06 * half, half.max() / 3 if half.max() > 0 else 1.0)
    return np.array([center - half, center + half])


def _legend_above(ax: Axes, handles: list[Any]) -> None:
    """Put a legend above the axes that is no wider than they are and ends within the figure."""
    if not handles:
        return
    figure, layout = ax.figure, ax.figure.get_layout_engine()
    if layout is not None:
        layout.execute(figure.figure)  # which tells how wide the axes are
    width = ax.get_position(original=True).width * figure.bbox.width

    def drawn(size: int, n_lines: int) -> Legend:
        return ax.legend(
            handles=handles, loc="lower center", bbox_to_anchor=(0.5, 1.0),
            ncols=-(-len(handles) // n_lines), frameon=False, fontsize=size, markerscale=1.6,
            columnspacing=1.5,
        )  # fmt: skip

    first, *others = [*itertools.product((11, 9, 7), (1, 2, 3, 4)), (7, len(handles))]
    legend = drawn(*first)
    for smaller in others:
        if legend.get_window_extent().width <= width:
            break
        legend = drawn(*smaller)
    if layout is None:
        ax.apply_aspect()  # which tells where the legend will be
        over = (legend.get_window_extent().y1 - figure.bbox.y1) / figure.bbox.height
        if over > 0:
            left, bottom, width, height = ax.get_position(original=True).bounds
            ax.set_position((left, bottom, width, height - over))


def _far_apart(X: NDArray[np.float64], rows: NDArray[np.intp], n: int) -> list[int]:
    """Choose rows of ``X`` that are far from each other in the first image, greedily."""
    if len(rows) == 0 or n < 1:
        return []
    points = X[rows, :2]
    chosen = [int(np.argmin(np.linalg.norm(points - np.median(points, axis=0), axis=1)))]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(n, len(rows)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return [int(rows[i]) for i in chosen]


def _clipped(line: NDArray[np.float64], extent: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Cut the line a x + b y + c = 0 at a rectangle: its ends (2, 2), None where it misses."""
    corner, size = extent[0], extent[1] - extent[0]
    moved = np.array([*line[:2], line[2] + line[:2] @ corner])
    ends, meets = points_inside(np.stack([moved, moved]), size, np.array([0.0, 1.0]))
    return corner + ends if meets.all() else None
