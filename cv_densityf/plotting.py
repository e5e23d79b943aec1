"""Pictures of matches and of what was made of them, with matplotlib.

Every function draws into the axes it is given, or into those of a new figure, and returns them.
The colours of matches are Okabe and Ito's, which colour-blind readers tell apart; where a
difference matters, marker shapes or numbers show it as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cv_densityf._arguments import check_mask
from cv_densityf._zhang import points_inside
from cv_densityf.matching import _grey

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Okabe and Ito's seven colours, then two of Tol's and white: as many as there are lines.
_LINE_COLORS = (
    *("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#F0E442"),
    *("#332288", "#882255", "#FFFFFF"),
)
#: Between two images, as a share of the first one's width.
_GAP = 0.02


class _Peaks(Protocol):
    """What a decision graph needs of density peaks."""

    @property
    def rho(self) -> NDArray[Any]: ...
    @property
    def delta(self) -> NDArray[np.float64]: ...


@dataclass(frozen=True)
class _Style:
    """How one class of matches is drawn."""

    label: str
    color: str
    marker: str
    size: float
    edge: float
    alpha: float
    order: int


_STYLES = {
    # (kept, inlier)
    (False, False): _Style("dropped", "#333333", ".", 5.0, 0.0, 0.6, 2),
    (True, False): _Style("kept, not an inlier", "#D55E00", "x", 5.0, 1.4, 0.9, 3),
    (True, True): _Style("kept, inlier", "#0072B2", "o", 4.5, 0.0, 0.9, 4),
    (False, True): _Style("dropped, yet inlier", "#56B4E9", "^", 5.5, 0.0, 1.0, 5),
}


def plot_decision_graph(
    peaks: _Peaks,
    *,
    alpha: float | None = None,
    kept: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the decision graph: distance to a denser match against density.

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
        If ``kept`` or ``mask`` has another length than ``peaks``, or negative numbers or NaN.

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
    'rho, density: matches closer than the cut-off distance'
    """
    rho, delta = np.asarray(peaks.rho), np.asarray(peaks.delta)
    product = (alpha or 0.0) * rho.max(initial=0) * delta.max(initial=0)
    on_or_above: NDArray[np.bool_] = rho * delta >= product
    kept = on_or_above if kept is None else check_mask(kept, len(rho), "kept")
    mask = None if mask is None else check_mask(mask, len(rho), "mask")
    ax = _axes(ax, (16, 7))
    handles = []
    for style, rows in _classes(kept, mask):
        (handle,) = ax.plot(
            rho[rows], delta[rows], ls="none", marker=style.marker, color=style.color,
            ms=style.size, mew=style.edge, alpha=style.alpha, zorder=style.order,
            label=f"{style.label} ({len(rows)})",
        )  # fmt: skip
        handles.append(handle)
    ax.set_yscale("symlog", linthresh=1)
    if rho.max(initial=0) > 0 and delta.max() > 0:
        top, right = 1.5 * delta.max(), 1.03 * rho.max()
        bottom = 0.7 * delta.min() if delta.min() > 0 else -0.2
        ax.set(xlim=(-0.02 * right, right), ylim=(bottom, top))
        if product > 0:
            x = np.geomspace(product / top, right, 400)
            label = f"rho x delta = {alpha:g} x max rho x max delta"
            handles += ax.plot(x, product / x, "k--", lw=1.6, zorder=6, label=label)
    ax.set_xlabel("rho, density: matches closer than the cut-off distance")
    ax.set_ylabel("delta, distance to a denser match (px)")
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
        Matches of the dense part; by default all.
    mask : (n,) array of bool, optional
        Inliers of the final fundamental matrix; by default they are not told apart.
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
    ValueError
        If a shape does not fit.

    Examples
    --------
    >>> from cv_densityf.datasets import two_view_scene
    >>> from cv_densityf.plotting import plot_matches
    >>> scene = two_view_scene(100)
    >>> ax = plot_matches(None, None, scene.X, mask=scene.inliers)
    >>> [text.get_text() for text in ax.get_legend().get_texts()]
    ['kept, not an inlier (60)', 'kept, inlier (40)']
    """
    X = _matches(X)
    finite = _finite(X)
    kept = finite if kept is None else check_mask(kept, len(X), "kept")
    mask = None if mask is None else check_mask(mask, len(X), "mask")[finite]
    X, kept = X[finite], kept[finite]
    ax = _axes(ax, (16, 6))
    place1, place2 = _show(ax, image1, image2, X)
    shown1, shown2 = place1(X[:, :2]), place2(X[:, 2:])

    from matplotlib.collections import LineCollection

    lined = np.zeros(len(X), dtype=bool)
    lined[:: max(1, -(-len(X) // max(1, max_lines)))] = max_lines > 0
    handles = []
    for style, rows in _classes(kept, mask):
        strong = style.label != "dropped"
        joined = rows[lined[rows]]
        segments = np.stack([shown1[joined], shown2[joined]], axis=1)
        lines = LineCollection(
            list(segments), colors=style.color, linewidths=1.0 if strong else 0.6,
            alpha=0.75 if strong else 0.5, zorder=style.order,
        )  # fmt: skip
        ax.add_collection(lines, autolim=False)
        (handle,) = ax.plot(
            *np.vstack([shown1[rows], shown2[rows]]).T, ls="none", marker=style.marker,
            ms=style.size, mew=style.edge, color=style.color, alpha=style.alpha,
            zorder=style.order + 10, label=f"{style.label} ({len(rows)})",
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
    ValueError
        If a shape does not fit.

    Examples
    --------
    >>> from cv_densityf.datasets import two_view_scene
    >>> from cv_densityf.plotting import plot_epipolar_lines
    >>> scene = two_view_scene(100)
    >>> ax = plot_epipolar_lines(None, None, scene.X, scene.F, scene.inliers, n_lines=5)
    >>> sorted({text.get_text() for text in ax.texts})
    ['1', '2', '3', '4', '5']
    """
    X, F = _matches(X), np.asarray(F, dtype=np.float64)
    if F.shape != (3, 3):
        raise ValueError(f"F must have the shape (3, 3), not {F.shape}")
    finite = _finite(X)
    mask = finite if mask is None else check_mask(mask, len(X), "mask")
    ax = _axes(ax, (16, 6))
    places = _show(ax, image1, image2, X[finite])
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
    plot_matches(image1, image2, X, kept, mask, ax=axes[0])
    plot_epipolar_lines(image1, image2, X, F, mask, ax=axes[1])
    axes[1].set_title("Epipolar lines of a few inliers", fontsize=13)
    plot_decision_graph(peaks, alpha=alpha, kept=kept, mask=mask, ax=axes[2])
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


def _axes(ax: Axes | None, size: tuple[float, float]) -> Axes:
    if ax is not None:
        return ax
    require_matplotlib()
    import matplotlib.pyplot as plt

    return plt.subplots(figsize=size, dpi=100, layout="constrained")[1]


def _matches(X: ArrayLike) -> NDArray[np.float64]:
    X = np.asarray(X, dtype=np.float64)
    if X.ndim != 2 or X.shape[1] != 4:
        raise ValueError(f"X must have the shape (n, 4), the columns x, y, x', y', not {X.shape}")
    return X


def _finite(X: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(X).all(axis=1))


def _classes(
    kept: NDArray[np.bool_], mask: NDArray[np.bool_] | None
) -> Iterator[tuple[_Style, NDArray[np.intp]]]:
    """Yield the style and the rows of each class that has any, the least important first."""
    for (is_kept, is_inlier), style in _STYLES.items():
        if mask is None:
            # Nothing is known of inliers: neither claim them nor deny them.
            style = replace(style, label="kept" if is_kept else "dropped")
            chosen = (kept == is_kept) if is_kept == is_inlier else np.zeros_like(kept)
        else:
            chosen = (kept == is_kept) & (mask == is_inlier)
        rows = np.flatnonzero(chosen)
        if len(rows):
            yield style, rows


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
    ax: Axes, image1: NDArray[Any] | None, image2: NDArray[Any] | None, X: NDArray[np.float64]
) -> tuple[_Place, _Place]:
    """Show the images side by side, equally high."""
    extent1, extent2 = _extent(image1, X[:, :2]), _extent(image2, X[:, 2:])
    width, height = extent1[1] - extent1[0]
    scale = height / (extent2[1, 1] - extent2[0, 1])
    shift2 = np.array([(1 + _GAP) * width, 0]) - scale * extent2[0]
    places = _Place(extent1, 1.0, -extent1[0]), _Place(extent2, scale, shift2)
    for image, place in zip((image1, image2), places, strict=True):
        (left, top), (right, bottom) = place(place.extent)
        if image is not None:
            # Only the light greys: lines and points stay visible on them.
            ax.imshow(
                _grey(image), cmap="gray", vmin=-450, vmax=255, extent=(left, right, bottom, top),
                interpolation="antialiased", zorder=0,
            )  # fmt: skip
        frame = np.array([[left, right, right, left, left], [top, top, bottom, bottom, top]])
        ax.plot(*frame, color="0.4", lw=1, zorder=1, clip_on=False)
    ax.set(xlim=(0, places[1](extent2)[1, 0]), ylim=(height, 0), aspect="equal")
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
    if handles:
        ax.legend(
            handles=handles, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=5,
            frameon=False, fontsize=11, markerscale=1.6, columnspacing=1.5,
        )  # fmt: skip


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
