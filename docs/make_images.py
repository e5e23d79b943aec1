"""Draw the pictures that come from no benchmark: ``python docs/make_images.py [folder]``."""

from __future__ import annotations

import sys
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from PIL import Image
from scipy.spatial import cKDTree

from cv_densityf import Estimate, density_peaks, estimate_fundamental
from cv_densityf._epipolar import sampson_distance
from cv_densityf._prefilter import N_NEIGHBORS, contrast_support
from cv_densityf.datasets import motorcycle
from cv_densityf.matching import match_images
from cv_densityf.plotting import plot_decision_graph, plot_epipolar_lines, plot_matches

BLUE, ORANGE, RED, DARK, SKY = "#0072B2", "#E69F00", "#D55E00", "#333333", "#56B4E9"
#: A match is taken for right when it is this near to the known epipolar geometry, pixels.
RIGHT = 1.0


def main(folder: Path) -> None:
    """Match, estimate, and draw into a folder."""
    pair = motorcycle()
    matches = match_images(pair.image1, pair.image2)
    X = matches.X
    right = sampson_distance(pair.F, X) < RIGHT
    estimate = estimate_fundamental(matches.points1, matches.points2, scores=matches.scores)
    greys = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in (pair.image1, pair.image2)]
    print(
        f"{len(X)} matches, {right.sum()} right, {estimate.n_inliers} inliers, "
        f"{estimate.reason}, error {pair.error(estimate.F):.2f} px"
    )
    mpl.rcParams.update({"font.size": 11, "axes.titlesize": 12})
    photographs = (pair.image1, pair.image2, X)
    classes = {
        "kept": estimate.kept, "mask": estimate.mask, "reliability": estimate.reliability
    }  # fmt: skip
    pictures = {
        "matches": page_wide(4.1, plot_matches, *photographs, **classes),
        "epipolar_lines": page_wide(
            3.8, plot_epipolar_lines, *photographs, estimate.F, estimate.mask
        ),
        "decision_graph": page_wide(5, plot_decision_graph, density_peaks(X), **classes),
        "how-neighbours": neighbours(greys, X, right),
        "how-contrast": contrast(greys[0], X, right),
        "how-vote": vote(greys[0], X[estimate.mask]),
        "how-mask": mask(greys[0], X, estimate),
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in pictures.items():
        raw = BytesIO()
        figure.savefig(raw, dpi=100)
        # Few pixels are red, and there are many greys: other ways make the red ones orange.
        small = Image.open(raw).convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=3)
        small.save(folder / f"{name}.png", optimize=True)


def page_wide(
    height: float, plot: Callable[..., plt.Axes], *args: Any, **kwargs: Any
) -> plt.Figure:
    """Draw one of the package's plots in the width of a page, so that its letters can be read."""
    figure, ax = plt.subplots(figsize=(10, height), layout="constrained")
    plot(*args, **kwargs, ax=ax)
    return figure


def show(ax: plt.Axes, image: np.ndarray, title: str) -> None:
    """Put a pale picture on bare axes."""
    ax.imshow(image, cmap="gray", vmin=-250, vmax=255)
    ax.set(title=title, xticks=[], yticks=[], xlim=(0, image.shape[1]), ylim=(image.shape[0], 0))


def neighbours(greys: list[np.ndarray], X: np.ndarray, right: np.ndarray) -> plt.Figure:
    """Show a right and a wrong match, each with its nearest matches in either image."""
    near = [cKDTree(Y).query(Y, N_NEIGHBORS + 1)[1][:, 1:] for Y in (X[:, :2], X[:, 2:])]
    shared = np.array([len(set(a) & set(b)) for a, b in zip(*near, strict=True)])
    # A typical one of each kind, with room around it.
    room = (np.abs(X - np.tile([370, 250], 2)) < (280, 160, 230, 120)).all(axis=1)
    distance = np.linalg.norm(X[near[0][:, -1], :2] - X[:, :2], axis=1)
    room &= (distance > 25) & (distance < 60)
    typical = [
        next(row for row in np.flatnonzero(kind & room) if shared[row] == common)
        for kind, common in ((right, 8), (~right, 0))
    ]
    figure, axes = plt.subplots(2, 2, figsize=(10, 7.6), layout="constrained")
    for row, match, kind in zip(axes, typical, ("right", "wrong"), strict=True):
        common = set(near[0][match]) & set(near[1][match])
        for ax, image, side in zip(row, greys, (0, 1), strict=True):
            points = X[:, 2 * side : 2 * side + 2]
            show(ax, image, f"a {kind} match, {('first', 'second')[side]} image")
            ax.plot(*points.T, ".", color=DARK, ms=5)
            for other in near[side][match]:
                marker, color = ("o", BLUE) if other in common else ("s", ORANGE)
                ax.plot(*points[other], marker, color=color, ms=9, mec="white", mew=0.8)
            x, y = points[match]
            ax.plot(x, y, "*", color=RED, ms=17, mec="white", mew=0.8)
            ax.set(xlim=(x - 105, x + 105), ylim=(y + 70, y - 70))
        row[1].set_title(f"{row[1].get_title()}: shares {len(common)} of {N_NEIGHBORS} neighbours")
    handles = [
        plt.Line2D([], [], ls="", marker="*", ms=15, color=RED, label="the match"),
        plt.Line2D([], [], ls="", marker="o", ms=7, color=BLUE, label="near it in both images"),
        plt.Line2D([], [], ls="", marker="s", ms=7, color=ORANGE, label="near it in this image"),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=3, frameon=False)
    return figure


def contrast(grey: np.ndarray, X: np.ndarray, right: np.ndarray) -> plt.Figure:
    """Show where reliable matches are, and how pure the best of them are."""
    reliability = contrast_support(X)[0]
    figure, (left, curve) = plt.subplots(
        1, 2, figsize=(12, 4.6), layout="constrained", width_ratios=(1.35, 1)
    )
    show(left, grey, "matches by density contrast")
    order = np.argsort(reliability)
    dots = left.scatter(*X[order, :2].T, c=reliability[order], cmap="viridis", s=14)
    figure.colorbar(dots, ax=left, label="reliability", shrink=0.8)
    share = np.arange(1, len(X) + 1) / len(X)
    for name, values, color, dashes in (
        ("density contrast", reliability, BLUE, "-"),
        ("density in 4-D", density_peaks(X, kernel="gaussian").rho, ORANGE, "--"),
    ):
        best_first = right[np.argsort(-values, kind="stable")]
        curve.plot(
            100 * share, 100 * np.cumsum(best_first) / np.arange(1, len(X) + 1),
            dashes, color=color, lw=2, label=name,
        )  # fmt: skip
    curve.axhline(100 * right.mean(), color=DARK, ls=":", label="all matches")
    curve.set(
        xlabel="best matches, per cent of all", ylabel="right among them, per cent",
        xlim=(2, 100), ylim=(100 * right.mean() - 5, 101),
    )  # fmt: skip
    curve.legend(frameon=False)
    return figure


def vote(grey: np.ndarray, inliers: np.ndarray, cells: int = 16) -> plt.Figure:
    """Count inliers per cell of the first image, and what their votes come to."""
    side = (inliers[:, :2].max(axis=0) - (low := inliers[:, :2].min(axis=0))).max() / cells
    edges = [low[axis] + side * np.arange(cells + 1) for axis in (0, 1)]
    counts = np.histogram2d(*inliers[:, :2].T, bins=edges)[0].T
    counts[counts == 0] = np.nan
    figure, axes = plt.subplots(1, 2, figsize=(12, 4.2), layout="constrained")
    for ax, values, title in (
        (axes[0], counts, "inliers in each cell"),
        (axes[1], np.sqrt(counts), "their votes: the square root"),
    ):
        show(ax, grey, title)
        mesh = ax.pcolormesh(*edges, values, cmap="viridis", vmin=0, alpha=0.75, lw=0)
        figure.colorbar(mesh, ax=ax, shrink=0.8)
    return figure


def mask(grey: np.ndarray, X: np.ndarray, estimate: Estimate) -> plt.Figure:
    """Show the dense half, and the inliers in the end."""
    kept, inliers, unseen = estimate.kept, estimate.mask, np.isnan(estimate.reliability)
    dropped = ~kept & ~unseen
    figure, axes = plt.subplots(1, 2, figsize=(12, 4.4), layout="constrained")
    panels = (
        (
            "by density",
            [
                ("kept", kept, BLUE, "o"),
                ("dropped", dropped, DARK, "x"),
                ("not looked at", unseen, DARK, "+"),
            ],
        ),
        (
            "in the end",
            [
                ("kept, inlier", kept & inliers, BLUE, "o"),
                ("kept, not an inlier", kept & ~inliers, RED, "x"),
                ("dropped, yet inlier", dropped & inliers, SKY, "^"),
                ("not looked at, inlier", unseen & inliers, SKY, "D"),
            ],
        ),
    )
    for ax, (title, classes) in zip(axes, panels, strict=True):
        show(ax, grey, title)
        for name, rows, color, marker in classes:
            ax.plot(
                *X[rows, :2].T, marker, ls="", color=color, ms=4, mew=1,
                label=f"{name} ({rows.sum()})",
            )  # fmt: skip
        ax.legend(
            loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=2, frameon=False,
            fontsize=10, columnspacing=1, handletextpad=0.1,
        )  # fmt: skip
    return figure


if __name__ == "__main__":
    mpl.use("Agg")
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "images")
