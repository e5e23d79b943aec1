"""The decision graph in scikit-learn's Display style."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from cv_densityf.plotting import given_or_new

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


class DecisionGraphDisplay:
    """Decision graph of density peaks: distance to a denser point against density.

    Make one with `from_estimator` or `from_arrays`; the axes are then in ``ax_``.

    Parameters
    ----------
    rho : ndarray of float, shape (n,)
        Local density of each point.
    delta : ndarray of float, shape (n,)
        Distance of each point to the nearest denser one.
    centers : ndarray of int, shape (k,), optional
        Rows of the cluster centres, drawn apart.
    alpha : float, optional
        Draw the curve ``rho * delta = alpha * max(rho) * max(delta)``.

    Attributes
    ----------
    ax_ : matplotlib.axes.Axes
        Axes of the last `plot`.
    figure_ : matplotlib.figure.Figure
        Figure of those axes.

    See Also
    --------
    DensityPeaks : The clusterer.

    References
    ----------
    A. Rodriguez and A. Laio, "Clustering by fast search and find of density peaks", Science 344
    (2014) 1492-1496.

    Examples
    --------
    >>> import numpy as np
    >>> from cv_densityf.estimators import DecisionGraphDisplay, DensityPeaks
    >>> rng = np.random.default_rng(0)
    >>> X = np.concatenate([rng.normal(0, 1, (60, 4)), rng.normal(20, 1, (40, 4))])
    >>> display = DecisionGraphDisplay.from_estimator(DensityPeaks().fit(X))
    >>> [text.get_text() for text in display.ax_.get_legend().get_texts()]
    ['points (98)', 'centers (2)', 'alpha = 0.1']
    """

    ax_: Axes
    figure_: Figure | SubFigure

    def __init__(
        self,
        *,
        rho: ArrayLike,
        delta: ArrayLike,
        centers: ArrayLike | None = None,
        alpha: float | None = None,
    ) -> None:
        self.rho = rho
        self.delta = delta
        self.centers = centers
        self.alpha = alpha

    def plot(self, ax: Axes | None = None, **kwargs: Any) -> DecisionGraphDisplay:
        """Draw the graph.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Where to draw; a new figure when None.
        **kwargs
            Passed to ``Axes.scatter`` of the points.

        Returns
        -------
        DecisionGraphDisplay
            This object, with ``ax_`` and ``figure_`` set.

        Raises
        ------
        ImportError
            If matplotlib is not installed.
        """
        ax = given_or_new(ax, (6.4, 4.8))
        rho, delta = np.asarray(self.rho, dtype=float), np.asarray(self.delta, dtype=float)
        is_center = np.zeros(len(rho), dtype=bool)
        centers = np.asarray([] if self.centers is None else self.centers)
        is_center[centers if centers.dtype == bool else centers.astype(int)] = True
        for name, rows, style in (
            ("points", ~is_center, {"color": "#0072B2", "marker": "o", "s": 12}),
            ("centers", is_center, {"color": "#D55E00", "marker": "^", "s": 60}),
        ):
            if rows.any():
                label = f"{name} ({np.count_nonzero(rows)})"
                given = kwargs if name == "points" else {}
                ax.scatter(rho[rows], delta[rows], **{**style, "label": label, **given})
        limit = 0.0 if self.alpha is None else self.alpha * rho.max() * delta.max()
        if limit > 0:
            curve = np.geomspace(limit / delta.max(), rho.max(), 200)
            ax.plot(curve, limit / curve, "k--", lw=1, label=f"alpha = {self.alpha:g}")
        ax.set(xlabel="rho: local density", ylabel="delta: distance to a denser point")
        ax.legend()
        self.ax_, self.figure_ = ax, ax.figure
        return self

    @classmethod
    def from_estimator(
        cls, estimator: Any, *, ax: Axes | None = None, **kwargs: Any
    ) -> DecisionGraphDisplay:
        """Draw the decision graph of a fitted `DensityPeaks`.

        Parameters
        ----------
        estimator : DensityPeaks
            Fitted.
        ax : matplotlib.axes.Axes, optional
            Where to draw; a new figure when None.
        **kwargs
            Passed to ``Axes.scatter`` of the points.

        Returns
        -------
        DecisionGraphDisplay

        Raises
        ------
        sklearn.exceptions.NotFittedError
            If the estimator is not fitted.
        TypeError
            If it has no decision graph.
        """
        from sklearn.utils.validation import check_is_fitted

        check_is_fitted(estimator)
        if not hasattr(estimator, "rho_"):
            raise TypeError(f"{type(estimator).__name__} has no decision graph; DensityPeaks has")
        return cls.from_arrays(
            estimator.rho_,
            estimator.delta_,
            centers=estimator.cluster_centers_indices_,
            alpha=estimator.alpha if estimator.n_clusters is None else None,
            ax=ax,
            **kwargs,
        )

    @classmethod
    def from_arrays(
        cls,
        rho: ArrayLike,
        delta: ArrayLike,
        *,
        centers: ArrayLike | None = None,
        alpha: float | None = None,
        ax: Axes | None = None,
        **kwargs: Any,
    ) -> DecisionGraphDisplay:
        """Draw the decision graph of given densities and distances.

        Parameters
        ----------
        rho, delta : array_like of float, shape (n,)
            Local density, and distance to the nearest denser point.
        centers : array_like of int, shape (k,), or of bool, shape (n,), optional
            Rows of the cluster centres, drawn apart.
        alpha : float, optional
            Draw the curve ``rho * delta = alpha * max(rho) * max(delta)``.
        ax : matplotlib.axes.Axes, optional
            Where to draw; a new figure when None.
        **kwargs
            Passed to ``Axes.scatter`` of the points.

        Returns
        -------
        DecisionGraphDisplay
        """
        return cls(rho=rho, delta=delta, centers=centers, alpha=alpha).plot(ax, **kwargs)
