"""scikit-learn estimators: clustering, filtering of matches, and the fundamental matrix.

Matches are rows x, y, x', y' in pixels. Every mask is boolean with one entry per row, so that
``X[mask]`` selects rows.
"""

from __future__ import annotations

import warnings
from inspect import signature
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, ClassVar, Self, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, ClusterMixin, MetaEstimatorMixin, clone
from sklearn.utils import _safe_indexing, check_random_state
from sklearn.utils._param_validation import HasMethods, Interval, StrOptions
from sklearn.utils.metadata_routing import (
    MetadataRouter,
    MethodMapping,
    _routing_enabled,
    process_routing,
)
from sklearn.utils.validation import (
    _check_sample_weight,
    check_is_fitted,
    has_fit_parameter,
    validate_data,
)

from cv_densityf import _epipolar
from cv_densityf._arguments import OFF, THRESHOLDS
from cv_densityf._density import Kernel, checked_points, density_peaks
from cv_densityf._display import DecisionGraphDisplay
from cv_densityf._engine import METHODS, Robust, method_flag
from cv_densityf._estimate import MIN_FILTERED, run, threshold_doubt
from cv_densityf._paper import paper_support
from cv_densityf._prefilter import contrast_support, ranks, with_scores

if TYPE_CHECKING:
    from cv_densityf._epipolar import Rule

__all__ = [
    "DecisionGraphDisplay",
    "DensityPeaks",
    "DensityPeaksFilter",
    "FundamentalMatrixEstimator",
]

_COLUMNS = "x, y in the first image and x', y' in the second, in pixels"


def _validated_matches(estimator: Any, X: ArrayLike, **options: Any) -> NDArray[np.float64]:
    """Validate rows of matches as scikit-learn does, and that there are four columns."""
    matches = validate_data(estimator, X, dtype=np.float64, order="C", **options)
    if matches.shape[1] != 4:
        raise ValueError(f"X must have 4 columns, {_COLUMNS}; it has {matches.shape[1]}")
    return np.asarray(matches)


def _validated_weight(
    sample_weight: ArrayLike | None, matches: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Validate the weights of matches, if there are any, as scikit-learn does."""
    if sample_weight is None:
        return None
    return np.asarray(_check_sample_weight(sample_weight, matches, dtype=np.float64))


class DensityPeaks(ClusterMixin, BaseEstimator):  # type: ignore[misc]
    """Clustering by fast search and find of density peaks.

    A cluster centre is denser than what surrounds it and far from anything denser; every other
    point follows its nearest denser point. Points of any dimension. There is no ``predict``: the
    clustering holds for the points it was fitted on.

    Parameters
    ----------
    n_clusters : int or None, default=None
        Number of clusters: the points with the largest gamma become centres. When None, ``alpha``
        decides.
    alpha : float in [0, 1], default=0.1
        Points with ``gamma >= alpha * max(rho) * max(delta)`` become centres. Ignored when
        ``n_clusters`` is given.
    dc : float > 0 or None, default=None
        Cut-off distance, in the units of X. When None, ``dc_percent`` decides.
    dc_percent : float in (0, 100], default=2.0
        Choose ``dc`` so that a point has on average ``dc_percent`` % of all points nearer than it.
    kernel : {"cutoff", "gaussian"}, default="cutoff"
        Density as a count of the points nearer than ``dc``, or as a sum of Gaussians of that
        width, which has fewer ties in small sets.
    sample_size : int >= 2 or None, default=None
        Estimate densities from this many of the points, where counting all takes too long: see
        `cv_densityf.density_peaks` for the error. None uses all.
    halo : bool, default=False
        Label the halo of the clusters -1.

    Attributes
    ----------
    labels_ : ndarray of int, shape (n,)
        Cluster of each point; cluster 0 is that of the densest point. -1 in the halo where
        ``halo=True``.
    cluster_centers_indices_ : ndarray of int, shape (n_clusters,)
        Rows of the centres.
    rho_ : ndarray of float, shape (n,)
        Local density.
    delta_ : ndarray of float, shape (n,)
        Distance to the nearest denser point.
    gamma_ : ndarray of float, shape (n,)
        ``rho_ * delta_``.
    dc_ : float
        Cut-off distance used.
    predecessor_ : ndarray of int, shape (n,)
        Row of the nearest denser point, -1 for the densest.
    halo_mask_ : ndarray of bool, shape (n,)
        Points on the rim of their cluster, no denser than its border to another.
    n_features_in_ : int
        Number of columns seen in fit.
    feature_names_in_ : ndarray of str, shape (n_features,)
        Names of the columns, where X had string names.

    See Also
    --------
    cv_densityf.density_peaks : The function underneath.
    DecisionGraphDisplay : Draws the decision graph.
    DensityPeaksFilter : Keeps the reliable ones of a set of matches.

    References
    ----------
    A. Rodriguez and A. Laio, "Clustering by fast search and find of density peaks", Science 344
    (2014) 1492-1496.

    Examples
    --------
    >>> import numpy as np
    >>> from cv_densityf.estimators import DensityPeaks
    >>> rng = np.random.default_rng(0)
    >>> X = np.concatenate([rng.normal(0, 1, (60, 2)), rng.normal(9, 1, (40, 2))])
    >>> clusterer = DensityPeaks().fit(X)
    >>> np.bincount(clusterer.labels_)
    array([60, 40])
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "n_clusters": [Interval(Integral, 1, None, closed="left"), None],
        "alpha": [Interval(Real, 0, 1, closed="both")],
        "dc": [Interval(Real, 0, None, closed="neither"), None],
        "dc_percent": [Interval(Real, 0, 100, closed="right")],
        "kernel": [StrOptions(set(get_args(Kernel)))],
        "sample_size": [Interval(Integral, 2, None, closed="left"), None],
        "halo": ["boolean"],
    }

    def __init__(
        self,
        n_clusters: int | None = None,
        *,
        alpha: float = 0.1,
        dc: float | None = None,
        dc_percent: float = 2.0,
        kernel: Kernel = "cutoff",
        sample_size: int | None = None,
        halo: bool = False,
    ) -> None:
        self.n_clusters = n_clusters
        self.alpha = alpha
        self.dc = dc
        self.dc_percent = dc_percent
        self.kernel: Kernel = kernel
        self.sample_size = sample_size
        self.halo = halo

    def fit(self, X: ArrayLike, y: Any = None) -> Self:
        """Cluster the points.

        Parameters
        ----------
        X : array_like, shape (n, d)
            Finite points.
        y : ignored

        Returns
        -------
        DensityPeaks
            This object, fitted.

        Raises
        ------
        ValueError
            If a parameter is out of range, X is not a finite two-dimensional array, or there are
            fewer points than ``n_clusters``.
        """
        self._validate_params()
        points = validate_data(self, X, dtype=np.float64)
        n = len(points)
        if self.n_clusters is not None and self.n_clusters > n:
            raise ValueError(f"n_clusters={self.n_clusters} exceeds n_samples={n}")
        peaks = density_peaks(
            points,
            dc=self.dc,
            dc_percent=self.dc_percent,
            kernel=self.kernel,
            sample_size=self.sample_size,
        )
        centers = (
            peaks.centers(alpha=self.alpha)
            if self.n_clusters is None
            else peaks.centers(n=self.n_clusters)
        )
        labels = peaks.labels(centers)
        self.halo_mask_: NDArray[np.bool_] = peaks.halo(labels)
        self.labels_: NDArray[np.intp] = (
            np.where(self.halo_mask_, -1, labels) if self.halo else labels
        )
        self.cluster_centers_indices_: NDArray[np.intp] = centers
        self.rho_: NDArray[np.float64] = peaks.rho
        self.delta_: NDArray[np.float64] = peaks.delta
        self.gamma_: NDArray[np.float64] = peaks.gamma
        self.dc_: float = peaks.dc
        self.predecessor_: NDArray[np.intp] = peaks.predecessor
        return self


class DensityPeaksFilter(BaseEstimator):  # type: ignore[misc]
    """Keep the reliable ones of the matches between two images, by their density.

    True matches crowd together in the space of (x, y, x', y'), wrong ones are scattered.

    Parameters
    ----------
    rule : {"contrast", "paper"}, default="contrast"
        ``"contrast"``: how much denser a match lies in 4-D than its two points lie in their
        images; needs four columns. ``"paper"``: density peaks with
        ``gamma >= alpha * max(rho) * max(delta)`` (Wu and Wan); any number of columns.
    alpha : float in [0, 1], default=0.011
        Threshold of the paper's rule: larger keeps fewer.
    dc_percent : float in (0, 100], default=2.0
        Cut-off distance of the paper's rule, see `DensityPeaks`.
    keep : float in (0, 1] or None, default=None
        Share of the rows to keep, at least one, the most reliable first, whichever the rule. When
        None the rule decides.

    Attributes
    ----------
    support_ : ndarray of bool, shape (n,)
        The rows kept.
    reliability_ : ndarray of float, shape (n,)
        How reliable each row is, in [0, 1].
    sample_indices_ : ndarray of int
        Indices of the rows kept.
    n_features_in_ : int
        Number of columns seen in fit.
    feature_names_in_ : ndarray of str, shape (n_features,)
        Names of the columns, where X had string names.

    See Also
    --------
    FundamentalMatrixEstimator : Takes this filter as its ``prefilter``.

    Notes
    -----
    `fit_resample` lets it be a step of imbalanced-learn's Pipeline; scikit-learn's own Pipeline
    allows no step that drops rows.

    Rows are only dropped where 15 or more are left: all are kept otherwise, with a warning, since
    cv2 estimates differently (by LMEDS) from fewer.

    References
    ----------
    Hao Wu and Yi Wan, "Clustering assisted fundamental matrix estimation" (2015), section 2.6.

    Examples
    --------
    >>> from cv_densityf.datasets import two_view_scene
    >>> from cv_densityf.estimators import DensityPeaksFilter
    >>> scene = two_view_scene(400)
    >>> kept = DensityPeaksFilter(keep=0.25).fit_predict(scene.X)
    >>> int(kept.sum())
    100
    >>> bool(scene.inliers[kept].mean() > scene.inliers.mean())
    True
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "rule": [StrOptions({"contrast", "paper"})],
        "alpha": [Interval(Real, 0, 1, closed="both")],
        "dc_percent": [Interval(Real, 0, 100, closed="right")],
        "keep": [Interval(Real, 0, 1, closed="right"), None],
    }

    def __init__(
        self,
        rule: str = "contrast",
        *,
        alpha: float = 0.011,
        dc_percent: float = 2.0,
        keep: float | None = None,
    ) -> None:
        self.rule = rule
        self.alpha = alpha
        self.dc_percent = dc_percent
        self.keep = keep

    def fit(self, X: ArrayLike, y: Any = None, sample_weight: ArrayLike | None = None) -> Self:
        """Tell the reliable rows.

        Parameters
        ----------
        X : array_like, shape (n, 4)
            Matches x, y, x', y', in pixels. ``rule="paper"`` takes any number of columns.
        y : ignored
        sample_weight : array_like, shape (n,), optional
            Trust in each row, finite and not all 0; higher is better, only its order counts. It is
            used as the ``scores`` of `estimate_fundamental` are: rows are ordered by a sum of ranks
            in which that by density counts four times, and by the contrast rule the worst fifth
            does not count as neighbours. ``reliability_`` is the rank of that sum. The better half
            is kept by the contrast rule, by the paper's as many rows as without.

        Returns
        -------
        DensityPeaksFilter
            This object, fitted.

        Raises
        ------
        ValueError
            If a parameter is out of range, or X is not a finite array of the right width.

        Warns
        -----
        UserWarning
            If rows were to be dropped and fewer than 15 would be left; all are kept then.
        """
        self._validate_params()
        matches = self._validated(X)
        n = len(matches)
        weight = _validated_weight(sample_weight, matches)
        reliability: NDArray[np.floating]
        if n >= MIN_FILTERED and self.rule == "contrast":
            reliability, support, *_ = contrast_support(checked_points(matches), weight)
        else:
            reliability, support = np.ones(n), np.ones(n, dtype=bool)
            if n >= MIN_FILTERED:
                reliability, support = paper_support(matches, self.alpha, self.dc_percent)
            if weight is not None:
                reliability = with_scores(ranks(reliability), weight)
        if weight is not None or self.keep is not None:
            n_kept = int(np.count_nonzero(support))
            if self.keep is not None:
                n_kept = max(1, round(self.keep * n))
            support = np.zeros(n, dtype=bool)
            support[np.argsort(-reliability, kind="stable")[:n_kept]] = True
        self.reliability_: NDArray[np.float64] = reliability
        self.support_: NDArray[np.bool_] = _enough(support)
        self.sample_indices_: NDArray[np.intp] = np.flatnonzero(self.support_)
        return self

    def _validated(self, X: ArrayLike) -> NDArray[np.float64]:
        if self.rule == "contrast":
            return _validated_matches(self, X)
        return np.asarray(validate_data(self, X, dtype=np.float64))

    def get_support(self, indices: bool = False) -> NDArray[Any]:
        """Get the rows that were kept.

        Parameters
        ----------
        indices : bool, default=False
            Return row numbers rather than a mask.

        Returns
        -------
        ndarray
            ``support_``, or the indices of its true entries.

        Raises
        ------
        sklearn.exceptions.NotFittedError
            Before `fit`.
        """
        check_is_fitted(self)
        return self.sample_indices_ if indices else self.support_

    def fit_predict(
        self, X: ArrayLike, y: Any = None, sample_weight: ArrayLike | None = None
    ) -> NDArray[np.bool_]:
        """Fit, and return the mask of the rows kept.

        Parameters
        ----------
        X, y, sample_weight
            See `fit`.

        Returns
        -------
        ndarray of bool, shape (n,)
            ``support_``.

        Raises
        ------
        ValueError
            As `fit`.
        """
        return self.fit(X, y, sample_weight=sample_weight).support_

    def fit_resample(self, X: Any, y: Any = None) -> tuple[Any, Any]:
        """Fit, and return the rows kept: the contract of imbalanced-learn's pipeline.

        Parameters
        ----------
        X : array_like or DataFrame, shape (n, 4)
            See `fit`.
        y : array_like, shape (n,), optional
            Reduced alongside.

        Returns
        -------
        X_resampled, y_resampled
            The kept rows of each, of the type given; None for a ``y`` of None.

        Raises
        ------
        ValueError
            As `fit`.
        """
        rows = self.fit(X).sample_indices_
        return _safe_indexing(X, rows), None if y is None else _safe_indexing(y, rows)


class FundamentalMatrixEstimator(MetaEstimatorMixin, BaseEstimator):  # type: ignore[misc]
    """Fundamental matrix of two images from their matches.

    Parameters
    ----------
    prefilter : "auto", None or an estimator, default="auto"
        Which matches are trusted first. ``"auto"``: the pipeline of
        `cv_densityf.estimate_fundamental`. None: all, a plain call of cv2. Or an object whose
        ``fit_predict(X)`` answers a boolean mask or +-1, one per row: a `DensityPeaksFilter`, an
        outlier detector like scikit-learn's IsolationForest; cv2 is then called on the rows it
        keeps.
    method : str or int, default="usac_accurate"
        cv2's method: "ransac", "lmeds", "8point", "7point", "usac_default", "usac_parallel",
        "usac_fm_8pts", "usac_fast", "usac_accurate", "usac_prosac", "usac_magsac", or its constant.
    threshold : float in (1e-12, 1e6), default=1.0
        Largest distance of an inlier, in pixels. "lmeds" finds its own. It rules the masks: the
        search of ``prefilter="auto"`` has a threshold of its own, a hundredth of the points'
        spread, up to 3 px, and of few matches more, brought to within a factor of two of this one,
        but never below half of its own, nor below .8 steps of a lattice that all points are on.
    confidence : float in (0, 1), default=0.999
        Of each draw to have found the best model.
    max_iters : int in [1, 2^31), default=5000
        Bound on the iterations of each draw; those of ``prefilter="auto"`` end after a thousand
        in any case.
    random_state : int, RandomState or None, default=0
        Seed of the pipeline of ``prefilter="auto"``. None takes one from numpy's global state.
        A plain call of cv2 has a fixed seed of its own.

    Attributes
    ----------
    F_ : ndarray of float, shape (3, 3)
        Fundamental matrix, ``[x', y', 1] @ F_ @ [x, y, 1] == 0``.
    inlier_mask_ : ndarray of bool, shape (n,)
        Inliers among the rows of fit, ``predict`` of them.
    n_inliers_ : int
        Their number.
    candidate_mask_ : ndarray of bool, shape (n,)
        Rows of fit in the dense part (of more than 1,000 rows, that of the 1,000 or 250 that were
        looked at), or those that the prefilter kept.
    prefilter_ : estimator or None
        The fitted prefilter, None where ``prefilter`` is "auto" or None.
    threshold_ : float
        Largest distance of an inlier, in pixels: ``threshold``, or what "lmeds" derived from the
        rows of fit.
    reason_ : str
        How ``F_`` came about, in a few words: the ``reason`` of an `Estimate`, or that cv2's own
        call made it.
    agreed_ : bool
        Whether another draw found the same, see `Estimate`. False where cv2's own call made ``F_``.
    n_features_in_ : int
        Always 4.
    feature_names_in_ : ndarray of str, shape (4,)
        Names of the columns, where X had string names.

    See Also
    --------
    cv_densityf.estimate_fundamental : The function behind ``prefilter="auto"``.
    cv_densityf.findFundamentalMat : The same with cv2's signature.

    Notes
    -----
    The residual of a match is the distance that cv2's method compares with its threshold: the
    Sampson distance for the USAC methods; the larger one of the distances of the two points to
    their epipolar lines for the others. cv2 turns "ransac" with 14 rows or fewer, and "7point",
    into "lmeds". "8point" takes every row for an inlier in cv2; here ``threshold`` applies.

    One fit is one pair of images. Parameters are compared over many pairs in a loop of fits;
    folds over the matches of one pair do not tell what another pair needs.

    Examples
    --------
    >>> from sklearn.metrics import f1_score
    >>> from cv_densityf.datasets import two_view_scene
    >>> from cv_densityf.estimators import FundamentalMatrixEstimator
    >>> scene = two_view_scene(400)
    >>> estimator = FundamentalMatrixEstimator().fit(scene.X)
    >>> estimator.F_.shape
    (3, 3)
    >>> inliers = scene.X[estimator.predict(scene.X)]
    >>> len(inliers) == estimator.n_inliers_
    True
    >>> bool(f1_score(scene.inliers, estimator.predict(scene.X)) > 0.9)
    True
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "prefilter": [StrOptions({"auto"}), HasMethods("fit_predict"), None],
        "method": [str, Integral],
        "threshold": [Interval(Real, *THRESHOLDS, closed="neither")],
        "confidence": [Interval(Real, 0, 1, closed="neither")],
        "max_iters": [Interval(Integral, 1, 2**31 - 1, closed="both")],
        "random_state": ["random_state"],
    }

    def __init__(
        self,
        prefilter: Any = "auto",
        *,
        method: str | int = "usac_accurate",
        threshold: float = 1.0,
        confidence: float = 0.999,
        max_iters: int = 5000,
        random_state: int | np.random.RandomState | None = 0,
    ) -> None:
        self.prefilter = prefilter
        self.method = method
        self.threshold = threshold
        self.confidence = confidence
        self.max_iters = max_iters
        self.random_state = random_state

    def fit(
        self, X: ArrayLike, y: Any = None, sample_weight: ArrayLike | None = None, **params: Any
    ) -> Self:
        """Estimate the fundamental matrix.

        Parameters
        ----------
        X : array_like, shape (n, 4)
            Matches x, y, x', y', in pixels, n >= 8.
        y : ignored
        sample_weight : array_like, shape (n,), optional
            Trust in each match, such as 1 - SIFT ratio, finite and not all 0: higher is better,
            only its order counts. "auto" uses it as its ``scores``; a prefilter gets it where its
            ``fit`` has such a parameter; a plain call of cv2 has no use for it.
        **params
            Metadata for the prefilter's ``fit``, where metadata routing is enabled.

        Returns
        -------
        FundamentalMatrixEstimator
            This object, fitted.

        Raises
        ------
        ValueError
            If no fundamental matrix was found, which leaves the estimator not fitted; if X is not
            a finite array of four columns and at least 8 rows, if a parameter is out of range, or
            if the prefilter answers anything but a boolean mask or +-1.

        Warns
        -----
        UserWarning
            If the prefilter drops rows and leaves fewer than 15, or no fundamental matrix is found
            from those it leaves; all rows are used then. If the threshold is more than a tenth of
            the points' spread: they may be in other units than pixels, or have been scaled; or
            fewer than half of them are right, for ``"lmeds"``.
        """
        # Pairs without F are ordinary: what the last one left must not pass for theirs.
        for name in [name for name in vars(self) if name.endswith("_")]:
            delattr(self, name)
        self._validate_params()
        if isinstance(self.prefilter, type):
            name = self.prefilter.__name__
            raise TypeError(f"prefilter is the class {name}; give an object, such as {name}()")
        robust = Robust(
            method_flag(self.method), float(self.threshold), float(self.confidence),
            int(self.max_iters),
        )  # fmt: skip
        matches = self._validated(X, ensure_min_samples=8)
        weight = _validated_weight(sample_weight, matches)
        prefilter_params = self._prefilter_params(weight, params)

        self.prefilter_: Any = None
        self.agreed_: bool = False
        if isinstance(self.prefilter, str):
            estimate = run(matches, robust, scores=weight, seed=self._seed())
            F, candidates, reason = estimate.F, estimate.kept, estimate.reason
            self.agreed_ = estimate.agreed
        else:
            candidates = np.ones(len(matches), dtype=bool)
            if self.prefilter is not None:
                self.prefilter_ = clone(self.prefilter, safe=False)
                # A copy, since it may work in place.
                answer = self.prefilter_.fit_predict(matches.copy(), **prefilter_params)
                candidates = _enough(_as_mask(answer, len(matches)))
            F, candidates, reason = _plain_estimate(matches, candidates, robust)
        if F is None or not np.isfinite(F).all():
            raise ValueError(
                f"no fundamental matrix was found from {len(matches)} matches ({reason}); try a "
                f"threshold larger than {self.threshold:g} px, more max_iters, another method, "
                "or matches that are not all on one line or plane"
            )
        self.F_: NDArray[np.float64] = F
        self.reason_: str = reason
        self.candidate_mask_: NDArray[np.bool_] = candidates
        self._set_rule(robust, matches)
        self.inlier_mask_: NDArray[np.bool_] = self._inliers(matches)
        self.n_inliers_: int = int(np.count_nonzero(self.inlier_mask_))
        return self

    def predict(self, X: ArrayLike) -> NDArray[np.bool_]:
        """Tell which matches fit the fundamental matrix, by cv2's own rule for the method.

        Parameters
        ----------
        X : array_like, shape (n, 4)
            Matches x, y, x', y', in pixels.

        Returns
        -------
        ndarray of bool, shape (n,)
            True for inliers, so that ``X[predict(X)]`` are the inliers.

        Raises
        ------
        sklearn.exceptions.NotFittedError
            Before `fit`.
        ValueError
            If X is not a finite array of four columns, or has other names of columns than in `fit`.
        """
        check_is_fitted(self, "F_")
        return self._inliers(self._validated(X, reset=False))

    def score_samples(self, X: ArrayLike) -> NDArray[np.float64]:
        """Return the negative residual of each match, in pixels.

        Parameters
        ----------
        X : array_like, shape (n, 4)
            Matches x, y, x', y', in pixels.

        Returns
        -------
        ndarray of float, shape (n,)
            At most 0, higher is better; ``-inf`` where the distance is undefined, at an epipole,
            or too large for a float.

        Raises
        ------
        sklearn.exceptions.NotFittedError
            Before `fit`.
        ValueError
            If X is not a finite array of four columns, or has other names of columns than in `fit`.
        """
        check_is_fitted(self, "F_")
        return -self._residuals(self._validated(X, reset=False))

    def decision_function(self, X: ArrayLike) -> NDArray[np.float64]:
        """Return how far each match is inside the threshold, in pixels.

        Parameters
        ----------
        X : array_like, shape (n, 4)
            Matches x, y, x', y', in pixels.

        Returns
        -------
        ndarray of float, shape (n,)
            ``threshold_`` minus the residual, positive for inliers.

        Raises
        ------
        sklearn.exceptions.NotFittedError
            Before `fit`.
        ValueError
            If X is not a finite array of four columns, or has other names of columns than in `fit`.
        """
        check_is_fitted(self, "F_")
        return self.threshold_ - self._residuals(self._validated(X, reset=False))

    def score(self, X: ArrayLike, y: Any = None) -> float:
        """Return how well the matches fit: 1 if all do exactly, 0 if there are no inliers.

        Parameters
        ----------
        X : array_like, shape (n, 4)
            Matches x, y, x', y', in pixels.
        y : ignored

        Returns
        -------
        float
            Mean of ``max(0, 1 - (residual / threshold_)**2)``. It grows with the threshold: do
            not compare thresholds by it.

        Raises
        ------
        sklearn.exceptions.NotFittedError
            Before `fit`.
        ValueError
            If X is not a finite array of four columns, or has other names of columns than in `fit`.
        """
        check_is_fitted(self, "F_")
        residuals = self._residuals(self._validated(X, reset=False))
        relative = np.minimum(residuals, self.threshold_) / self.threshold_
        return float((1 - np.square(relative)).mean())

    def get_metadata_routing(self) -> MetadataRouter:
        """Describe which metadata go to the prefilter.

        Returns
        -------
        sklearn.utils.metadata_routing.MetadataRouter
            ``fit`` passes them on to the prefilter's ``fit``.
        """
        return (
            MetadataRouter(owner=type(self).__name__)
            .add_self_request(self)
            .add(
                prefilter=self.prefilter,
                method_mapping=MethodMapping().add(caller="fit", callee="fit"),
            )
        )

    def _validated(self, X: ArrayLike, **options: Any) -> NDArray[np.float64]:
        return _validated_matches(self, X, **options)

    def _seed(self) -> int:
        if isinstance(self.random_state, Integral):
            return int(self.random_state)
        return int(check_random_state(self.random_state).randint(2**31 - 1))

    def _prefilter_params(
        self, weight: NDArray[np.float64] | None, params: dict[str, Any]
    ) -> dict[str, Any]:
        if _routing_enabled():
            routed = process_routing(self, "fit", sample_weight=weight, **params)
            return dict(routed.prefilter.fit)
        if params:
            raise TypeError(
                f"fit got unexpected parameters {sorted(params)}; enable metadata routing "
                "(sklearn.set_config(enable_metadata_routing=True)) to pass them to the prefilter"
            )
        if weight is None or not _takes_weight(self.prefilter):
            return {}
        return {"sample_weight": weight}

    def _set_rule(self, robust: Robust, matches: NDArray[np.float64]) -> None:
        rule: Rule = robust.rule
        if robust.flag == METHODS["8point"]:
            rule = "ransac"
        elif rule == "ransac" and len(matches) < MIN_FILTERED:
            rule = "lmeds"
        self.threshold_: float = robust.threshold
        derived = rule == "lmeds"
        if derived:
            # The scale is that of the rows of fit; from then on the rule is RANSAC's.
            self.threshold_ = _epipolar.lmeds_threshold(self.F_, matches)
            rule = "ransac"
        self._rule: Rule = rule
        doubt = threshold_doubt(self.threshold_, _epipolar.middle(matches)[1], derived)
        if doubt:
            warnings.warn(f"{doubt}; inliers mean little then", stacklevel=3)

    def _inliers(self, matches: NDArray[np.float64]) -> NDArray[np.bool_]:
        return _epipolar.inlier_mask(self.F_, matches, self._rule, self.threshold_)

    def _residuals(self, matches: NDArray[np.float64]) -> NDArray[np.float64]:
        distance = _epipolar.residuals(self.F_, matches, self._rule)
        return np.where(np.isnan(distance), np.inf, distance)


def _enough(support: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the mask, or one of all rows, with a warning, where too few are left."""
    left = np.count_nonzero(support)
    if left >= MIN_FILTERED or left == len(support):
        return support
    warnings.warn(
        f"{left} of {len(support)} rows would be left, fewer than {MIN_FILTERED}: all are kept",
        UserWarning,
        stacklevel=3,
    )
    return np.ones_like(support)


def _takes_weight(prefilter: Any) -> bool:
    """Whether ``fit_predict`` takes a ``sample_weight``, if only to hand it on to ``fit``."""
    if not hasattr(prefilter, "fit_predict"):
        return False
    parameters = signature(prefilter.fit_predict).parameters
    return "sample_weight" in parameters or (
        any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())
        and has_fit_parameter(prefilter, "sample_weight")
    )


def _as_mask(answer: ArrayLike, n: int) -> NDArray[np.bool_]:
    """Read a prefilter's answer, a boolean mask or +-1."""
    mask = np.asarray(answer)
    if mask.shape == (n,):
        if mask.dtype == bool:
            return mask
        if np.isin(mask, (-1, 1)).all():
            return np.asarray(mask > 0)
        others = np.setdiff1d(mask, (-1, 1))[:3].tolist()
        raise ValueError(
            "the prefilter's fit_predict must answer a boolean mask, or 1 for rows to keep and -1 "
            f"for the others; it answered {', '.join(map(str, others))} as well: of clusters' "
            "labels make a mask, such as labels >= 0"
        )
    raise ValueError(
        f"the prefilter's fit_predict must answer a mask of shape ({n},), one entry per row; it "
        f"answered an array of shape {mask.shape}"
    )


def _plain_estimate(
    matches: NDArray[np.float64], candidates: NDArray[np.bool_], robust: Robust
) -> tuple[NDArray[np.float64] | None, NDArray[np.bool_], str]:
    """Call cv2 on the candidates, and on all rows where that fails.

    Returns F, the rows it is from, and the reason.
    """
    drawn = matches[candidates]
    estimate = run(drawn, robust, OFF)
    if estimate.F is None and not candidates.all():
        warnings.warn(
            f"no fundamental matrix from the {len(drawn)} rows that the prefilter kept: all "
            f"{len(matches)} are used",
            UserWarning,
            stacklevel=3,
        )
        return _plain_estimate(matches, np.ones_like(candidates), robust)
    return estimate.F, candidates, estimate.reason
