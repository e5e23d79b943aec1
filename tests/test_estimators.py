"""The scikit-learn estimators: scikit-learn's own battery, cv2's masks, and composition."""

from __future__ import annotations

import pickle
import subprocess
import sys

import cv2
import joblib
import numpy as np
import pandas as pd
import pytest
import sklearn
from imblearn.pipeline import make_pipeline as make_imblearn_pipeline
from scipy.stats import rankdata
from sklearn.base import BaseEstimator, clone
from sklearn.ensemble import IsolationForest
from sklearn.exceptions import NotFittedError
from sklearn.metrics import f1_score
from sklearn.model_selection import GridSearchCV
from sklearn.neighbors import LocalOutlierFactor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler
from sklearn.utils.estimator_checks import estimator_checks_generator, parametrize_with_checks
from sklearn.utils.validation import validate_data

from cv_densityf import _engine, estimators
from cv_densityf._density import density_peaks
from cv_densityf._engine import METHODS
from cv_densityf._estimate import estimate_fundamental
from cv_densityf._paper import paper_support
from cv_densityf._prefilter import contrast_support
from cv_densityf.datasets import two_view_scene
from cv_densityf.estimators import (
    DecisionGraphDisplay,
    DensityPeaks,
    DensityPeaksFilter,
    FundamentalMatrixEstimator,
)

COLUMNS = ["x1", "y1", "x2", "y2"]

# ------------------------------------------------------------------ scikit-learn's own battery


def as_matches(X, fitting):
    """Turn the battery's data of any width into matches of a rectified pair, some of them wrong."""
    weights = np.random.default_rng(0).normal(size=(X.shape[1], 3))
    x, y, z = 100 * np.arctan(X @ weights).T
    if fitting and len(np.unique(X, axis=0)) < 8:
        # Four different matches, repeated, have no fundamental matrix.
        x, y, z = np.random.default_rng(1).normal(scale=50, size=(len(X), 3)).T
    wrong = np.floor(z * 7) % 5 == 0
    return np.column_stack([x, y, x + 20 + 0.3 * z, y + np.where(wrong, 30 + z, 0)])


class AnyWidthEstimator(FundamentalMatrixEstimator):
    """The estimator without its one rule that the battery's data breaks: four columns."""

    def _validated(self, X, **options):
        checked = validate_data(self, X, dtype=np.float64, **options)
        return as_matches(checked, fitting=options.get("reset", True))


class AnyWidthFilter(DensityPeaksFilter):
    def _validated(self, X):
        return as_matches(validate_data(self, X, dtype=np.float64), fitting=True)


BATTERY = [
    DensityPeaks(),
    DensityPeaks(n_clusters=3, kernel="gaussian", sample_size=20, halo=True),
    DensityPeaksFilter("paper"),
    AnyWidthFilter("contrast"),
    AnyWidthEstimator(),
    AnyWidthEstimator(prefilter=None, method="lmeds"),
    AnyWidthEstimator(prefilter=AnyWidthFilter(), method="ransac"),
]


def expected_failures(estimator):
    if isinstance(estimator, AnyWidthEstimator):
        return {
            "check_sample_weight_equivalence_on_dense_data": (
                "sample_weight is the trust in a match, not its number of copies"
            )
        }
    return {}


@pytest.mark.filterwarnings("ignore:.*fewer than 15. all are kept:UserWarning")
@pytest.mark.filterwarnings("ignore:no fundamental matrix from the:UserWarning")
@pytest.mark.filterwarnings("ignore:the threshold is .* of the points' spread:UserWarning")
@parametrize_with_checks(BATTERY, expected_failed_checks=expected_failures)
def test_battery(estimator, check):
    check(estimator)


@pytest.mark.parametrize("estimator", BATTERY, ids=repr)
def test_battery_runs_its_checks(estimator):
    names = [check.func.__name__ for _, check in estimator_checks_generator(estimator)]
    assert len(names) >= 44
    assert {"check_n_features_in", "check_fit2d_1sample", "check_dict_unchanged"} <= set(names)


# ------------------------------------------------------------------ FundamentalMatrixEstimator


@pytest.fixture(scope="module")
def scene():
    return two_view_scene(400, inlier_ratio=0.6)


#: USAC_PARALLEL answers differently from call to call.
REPEATABLE = sorted(set(METHODS) - {"usac_parallel"})


@pytest.mark.parametrize("n", [400, 12])
@pytest.mark.parametrize("method", REPEATABLE)
def test_without_prefilter_it_is_cv2(scene, method, n):
    X = scene.X[scene.inliers][:n] if n < 15 else scene.X
    estimator = FundamentalMatrixEstimator(None, method=method).fit(X)
    F, mask = cv2.findFundamentalMat(X[:, :2], X[:, 2:], METHODS[method], 1.0, 0.999, 5000)
    np.testing.assert_array_equal(estimator.F_, F)
    if method != "8point":  # cv2 calls every row an inlier there
        np.testing.assert_array_equal(estimator.inlier_mask_, mask.ravel() == 1)
    np.testing.assert_array_equal(estimator.predict(X), estimator.inlier_mask_)
    assert estimator.n_inliers_ == estimator.inlier_mask_.sum()
    assert estimator.candidate_mask_.all()


def test_graph_cut_gets_no_more_rows_than_it_bears(scene, monkeypatch):
    monkeypatch.setattr(_engine, "GRAPH_CUT_MAX", len(scene.X) - 1)
    estimator = FundamentalMatrixEstimator(None, method="usac_accurate").fit(scene.X)
    settings = (1.0, 0.999, 5000)
    points = scene.points1, scene.points2
    expected, _ = cv2.findFundamentalMat(*points, cv2.USAC_DEFAULT, *settings)
    np.testing.assert_array_equal(estimator.F_, expected)
    by_graph_cut, _ = cv2.findFundamentalMat(*points, cv2.USAC_ACCURATE, *settings)
    assert not np.array_equal(by_graph_cut, expected)


@pytest.mark.parametrize("method", ["usac_accurate", "ransac", cv2.USAC_MAGSAC, "lmeds"])
def test_auto_is_the_pipeline(scene, method):
    trust = np.random.default_rng(0).uniform(size=len(scene.X)) + scene.inliers
    estimator = FundamentalMatrixEstimator(method=method, threshold=1.5, random_state=3)
    estimator.fit(scene.X, sample_weight=trust)
    expected = estimate_fundamental(
        scene.X[:, :2], scene.X[:, 2:], method=method, threshold=1.5, scores=trust, random_state=3
    )
    np.testing.assert_array_equal(estimator.F_, expected.F)
    np.testing.assert_array_equal(estimator.inlier_mask_, expected.mask)
    np.testing.assert_array_equal(estimator.candidate_mask_, expected.kept)
    assert estimator.reason_ == expected.reason


@pytest.mark.parametrize(
    "prefilter",
    [DensityPeaksFilter(), IsolationForest(random_state=0), LocalOutlierFactor()],
    ids=lambda prefilter: type(prefilter).__name__,
)
def test_a_prefilter_decides_the_candidates(scene, prefilter):
    X = scene.X
    estimator = FundamentalMatrixEstimator(prefilter, method="usac_magsac").fit(X)
    kept = np.asarray(clone(prefilter).fit_predict(X)) > 0
    np.testing.assert_array_equal(estimator.candidate_mask_, kept)
    assert 15 <= kept.sum() < len(X)
    F, _ = cv2.findFundamentalMat(X[kept, :2], X[kept, 2:], cv2.USAC_MAGSAC, 1.0, 0.999, 5000)
    np.testing.assert_array_equal(estimator.F_, F)
    assert estimator.inlier_mask_[~kept].any()
    assert estimator.reason_.startswith("cv2's own call")
    assert isinstance(estimator.prefilter_, type(prefilter))
    assert estimator.prefilter_ is not prefilter


def test_without_a_prefilter_it_is_the_functions_call_without_density(scene):
    """Rows beyond float32 included, and the method that is called in place of graph cut."""
    X = np.vstack([scene.X, [[1e39, 0, 0, 0]]])
    for method in ("8point", "usac_magsac"):
        estimator = FundamentalMatrixEstimator(None, method=method).fit(X)
        expected = estimate_fundamental(X[:, :2], X[:, 2:], method=method, density="off")
        np.testing.assert_array_equal(estimator.F_, expected.F)
        assert estimator.reason_ == expected.reason


class Answers(BaseEstimator):
    """A prefilter that answers what it is told to, and remembers what it was given."""

    def __init__(self, answer=None):
        self.answer = answer

    def fit(self, X, y=None, sample_weight=None):
        self.sample_weight_ = sample_weight
        return self

    def fit_predict(self, X, y=None, sample_weight=None):
        self.fit(X, y, sample_weight)
        return np.ones(len(X), dtype=bool) if self.answer is None else self.answer


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        # Two clusters, or a mask? Nobody knows.
        (np.repeat([0, 1], 200), "it answered 0 as well"),
        (np.arange(400), "it answered 0, 2, 3 as well"),
        (np.ones((400, 1), dtype=bool), r"shape \(400,\).* shape \(400, 1\)"),
        (np.ones(399, dtype=bool), r"shape \(400,\).* shape \(399,\)"),
    ],
)
def test_a_prefilter_that_answers_no_mask_is_refused(scene, answer, told):
    with pytest.raises(ValueError, match=told):
        FundamentalMatrixEstimator(Answers(answer)).fit(scene.X)


def test_a_prefilter_may_work_in_place(scene):
    class InPlace(Answers):
        def fit_predict(self, X, y=None):
            X -= X.mean(axis=0)
            return np.ones(len(X), dtype=bool)

    X = scene.X.copy()
    estimator = FundamentalMatrixEstimator(InPlace()).fit(X)
    np.testing.assert_array_equal(X, scene.X)
    np.testing.assert_array_equal(estimator.F_, FundamentalMatrixEstimator(Answers()).fit(X).F_)


def test_too_few_candidates_are_not_trusted(scene):
    with pytest.warns(UserWarning, match="14 of 400 rows would be left"):
        estimator = FundamentalMatrixEstimator(Answers(np.arange(400) < 14)).fit(scene.X)
    assert estimator.candidate_mask_.all()


def test_candidates_without_a_solution_are_not_the_last_word(scene):
    X = np.concatenate([scene.X, np.tile([5.0, 5.0, 9.0, 9.0], (20, 1))])
    same = Answers(np.arange(len(X)) >= len(scene.X))
    with pytest.warns(UserWarning, match="from the 20 rows"):
        estimator = FundamentalMatrixEstimator(same, method="ransac").fit(X)
    assert estimator.candidate_mask_.all()


@pytest.mark.parametrize("method", REPEATABLE)
def test_the_distances_explain_the_mask(scene, method):
    estimator = FundamentalMatrixEstimator(None, method=method, threshold=2.0).fit(scene.X)
    inside = estimator.decision_function(scene.X)
    clear = np.abs(inside) > 1e-3
    np.testing.assert_array_equal(estimator.predict(scene.X)[clear], inside[clear] > 0)
    np.testing.assert_allclose(
        inside, estimator.threshold_ + estimator.score_samples(scene.X), rtol=1e-12
    )
    utility = np.clip(1 - (estimator.score_samples(scene.X) / estimator.threshold_) ** 2, 0, None)
    assert estimator.score(scene.X) == pytest.approx(utility.mean())
    assert estimator.score(scene.X[scene.inliers]) > estimator.score(scene.X[~scene.inliers])


@pytest.mark.parametrize(("method", "expected"), [("usac_magsac", 3 / np.sqrt(2)), ("ransac", 3.0)])
def test_residuals_are_pixels(method, expected):
    """In a rectified pair a match 3 rows off is 3 px from its lines; Sampson shares it out."""
    rng = np.random.default_rng(0)
    X = rng.uniform(0, 500, (200, 4))
    X[:, 3] = X[:, 1]
    estimator = FundamentalMatrixEstimator(method=method).fit(X)
    off = X + np.array([0, 0, 0, 3])
    np.testing.assert_allclose(estimator.score_samples(off), -expected, rtol=1e-3)


def test_eight_points_obey_the_threshold(scene):
    """cv2 has no rule for FM_8POINT."""
    X = scene.X[scene.inliers]
    estimator = FundamentalMatrixEstimator(None, method="8point", threshold=0.7).fit(X)
    ransac = FundamentalMatrixEstimator(None, method="ransac").fit(X)
    ransac.F_ = estimator.F_
    assert estimator.threshold_ == 0.7
    np.testing.assert_array_equal(estimator.inlier_mask_, ransac.score_samples(X) >= -0.7)


@pytest.mark.parametrize("prefilter", ["auto", None, DensityPeaksFilter()])
def test_a_threshold_as_wide_as_the_points_is_asked_about(scene, prefilter):
    estimator = FundamentalMatrixEstimator(prefilter)
    estimator.fit(scene.X)
    with pytest.warns(UserWarning, match="points' spread .are they in pixels"):
        estimator.fit(StandardScaler().fit_transform(scene.X))


def test_lmeds_asks_whether_most_matches_are_right():
    X = two_view_scene(400, inlier_ratio=0.3, random_state=5).X
    with pytest.warns(UserWarning, match="are more than half of the matches right"):
        estimator = FundamentalMatrixEstimator(method="lmeds").fit(X)
    assert "are more than half of the matches right" in estimator.reason_


def test_the_epipole_is_no_inlier(scene):
    estimator = FundamentalMatrixEstimator().fit(scene.X)
    estimator.F_ = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]])
    at_epipole = np.zeros((1, 4))
    assert not estimator.predict(at_epipole).any()
    assert estimator.score_samples(at_epipole) == -np.inf
    assert estimator.score(at_epipole) == 0


@pytest.mark.parametrize("size", [1e30, 1e80, 1e155, 1e300])
@pytest.mark.parametrize("method", ["ransac", "usac_magsac"])
def test_coordinates_of_any_size_are_judged_in_silence(scene, method, size):
    """Warnings are errors here."""
    estimator = FundamentalMatrixEstimator(method=method).fit(scene.X)
    far = scene.X * size
    assert not estimator.predict(far).any()
    assert (estimator.score_samples(far) < -1).all()
    assert (estimator.decision_function(far) < 0).all()
    assert estimator.score(far) == 0


@pytest.mark.parametrize("prefilter", ["auto", None])
def test_lmeds_takes_its_scale_from_the_rest_in_silence(scene, prefilter):
    X = np.concatenate([scene.X, np.full((1, 4), 1e30)])
    estimator = FundamentalMatrixEstimator(prefilter, method="lmeds").fit(X)
    assert not estimator.inlier_mask_[-1]
    assert np.isfinite(estimator.threshold_)


@pytest.mark.parametrize("method", ["lmeds", "usac_magsac"])
def test_a_row_is_judged_alone(scene, method):
    """LMEDS takes its scale from the rows of fit, so that one new row has an answer too."""
    estimator = FundamentalMatrixEstimator(None, method=method).fit(scene.X)
    alone = [bool(estimator.predict(row[None])[0]) for row in scene.X[:50]]
    assert alone == estimator.inlier_mask_[:50].tolist()
    assert 0 < sum(alone) < 50


def test_no_fundamental_matrix_says_why():
    X = np.tile([1.0, 2.0, 3.0, 4.0], (30, 1))
    for prefilter in ("auto", None):
        with pytest.raises(ValueError, match=r"no fundamental matrix .* from 30 matches .* try"):
            FundamentalMatrixEstimator(prefilter).fit(X)


def test_a_fit_that_fails_leaves_nothing_of_the_last(scene):
    one_spot = np.tile([1.0, 2.0, 3.0, 4.0], (30, 1))
    for estimator in (FundamentalMatrixEstimator(), FundamentalMatrixEstimator().fit(scene.X)):
        with pytest.raises(ValueError, match="no fundamental matrix"):
            estimator.fit(one_spot)
        assert not hasattr(estimator, "F_")
        assert not hasattr(estimator, "inlier_mask_")
        for method in ("predict", "score", "score_samples", "decision_function"):
            with pytest.raises(NotFittedError):
                getattr(estimator, method)(scene.X)


@pytest.mark.parametrize("estimator", [FundamentalMatrixEstimator(), DensityPeaksFilter()])
def test_the_columns_are_named(scene, estimator):
    with pytest.raises(ValueError, match="x, y in the first image and x', y' in the second"):
        estimator.fit(scene.X[:, :3])


def test_swapped_images_are_noticed(scene):
    estimator = FundamentalMatrixEstimator().fit(pd.DataFrame(scene.X, columns=COLUMNS))
    assert estimator.feature_names_in_.tolist() == COLUMNS
    with pytest.raises(ValueError, match="feature names"):
        estimator.predict(pd.DataFrame(scene.X, columns=COLUMNS[2:] + COLUMNS[:2]))


@pytest.mark.parametrize(
    "parameters",
    [
        {"prefilter": "density"}, {"method": "magic"}, {"method": 99}, {"threshold": 0.0},
        {"confidence": 1.0}, {"max_iters": 0}, {"max_iters": 2**31}, {"random_state": "seed"},
    ],
)  # fmt: skip
def test_wrong_parameters_are_refused(scene, parameters):
    with pytest.raises(ValueError, match="|".join(parameters)):
        FundamentalMatrixEstimator(**parameters).fit(scene.X)


@pytest.mark.parametrize("threshold", [1e-300, 1e-12, 1e6, 1e300])
def test_thresholds_are_those_of_the_function(scene, threshold):
    with pytest.raises(ValueError, match="threshold is"):
        estimate_fundamental(scene.points1, scene.points2, threshold=threshold)
    for prefilter in ("auto", None):
        with pytest.raises(ValueError, match="'threshold' parameter"):
            FundamentalMatrixEstimator(prefilter, threshold=threshold).fit(scene.X)


def test_unfitted(scene):
    for method in ("predict", "score_samples", "decision_function", "score"):
        with pytest.raises(NotFittedError):
            getattr(FundamentalMatrixEstimator(), method)(scene.X)
    with pytest.raises(NotFittedError):
        DensityPeaksFilter().get_support()
    with pytest.raises(NotFittedError):
        DecisionGraphDisplay.from_estimator(DensityPeaks())


def test_random_state_none_follows_numpys_seed(scene, monkeypatch):
    seeds, run = [], estimators.run
    monkeypatch.setattr(
        estimators, "run", lambda *a, seed, **k: seeds.append(seed) or run(*a, seed=seed, **k)
    )
    for state in (1, 1, 2):
        np.random.seed(state)  # noqa: NPY002
        FundamentalMatrixEstimator(random_state=None).fit(scene.X)
    assert seeds[0] == seeds[1] != seeds[2]
    FundamentalMatrixEstimator(random_state=7).fit(scene.X)
    assert seeds[-1] == 7


# ------------------------------------------------------------------ sample_weight and routing


def test_sample_weight_reaches_the_prefilter(scene):
    weight = np.linspace(0, 1, len(scene.X))
    estimator = FundamentalMatrixEstimator(Answers()).fit(scene.X, sample_weight=weight)
    np.testing.assert_array_equal(estimator.prefilter_.sample_weight_, weight)
    FundamentalMatrixEstimator(LocalOutlierFactor()).fit(scene.X, sample_weight=weight)


def test_sample_weight_is_for_what_fit_predict_takes(scene):
    weight = np.linspace(0, 1, len(scene.X))

    class OfFitAlone(Answers):
        def fit_predict(self, X, y=None):
            return Answers.fit_predict(self, X)

    class HandsOn(Answers):
        def fit_predict(self, X, y=None, **options):
            return Answers.fit_predict(self, X, **options)

    for prefilter, given in ((OfFitAlone(), None), (HandsOn(), weight)):
        estimator = FundamentalMatrixEstimator(prefilter).fit(scene.X, sample_weight=weight)
        np.testing.assert_array_equal(estimator.prefilter_.sample_weight_, given)


def test_metadata_are_routed(scene):
    weight = np.linspace(0, 1, len(scene.X))
    with sklearn.config_context(enable_metadata_routing=True):
        prefilter = Answers().set_fit_request(sample_weight=True)
        estimator = FundamentalMatrixEstimator(prefilter).set_fit_request(sample_weight=True)
        estimator.fit(scene.X, sample_weight=weight)
        np.testing.assert_array_equal(estimator.prefilter_.sample_weight_, weight)
        refusing = FundamentalMatrixEstimator(Answers().set_fit_request(sample_weight=False))
        refusing.fit(scene.X, sample_weight=weight)
        assert refusing.prefilter_.sample_weight_ is None
        piped = make_pipeline(estimator).fit(scene.X, sample_weight=weight)
        np.testing.assert_array_equal(piped[-1].prefilter_.sample_weight_, weight)
        for prefilter in ("auto", None):
            FundamentalMatrixEstimator(prefilter).fit(scene.X, sample_weight=weight)


def test_unknown_fit_parameters_are_refused(scene):
    with pytest.raises(TypeError, match=r"unexpected parameters \['scores'\]"):
        FundamentalMatrixEstimator().fit(scene.X, scores=np.ones(len(scene.X)))


# ------------------------------------------------------------------ composition


def test_grid_search_over_a_nested_parameter(scene):
    grid = {"prefilter__alpha": [0.0, 0.011], "threshold": [1.0, 2.0]}
    search = GridSearchCV(
        FundamentalMatrixEstimator(DensityPeaksFilter("paper")), grid, scoring="f1", cv=2
    )
    search.fit(scene.X, scene.inliers)
    assert np.isfinite(search.cv_results_["mean_test_score"]).all()
    found = search.best_estimator_
    assert f1_score(scene.inliers, found.predict(scene.X)) > 0.9
    alpha = search.best_params_["prefilter__alpha"]
    assert found.prefilter_.alpha == found.get_params()["prefilter__alpha"] == alpha


def test_clone_pickle_joblib_repr_and_output_config(scene):
    estimator = FundamentalMatrixEstimator(DensityPeaksFilter(keep=0.5)).fit(scene.X)
    assert not hasattr(clone(estimator), "F_")
    again = pickle.loads(pickle.dumps(estimator))
    np.testing.assert_array_equal(again.predict(scene.X), estimator.inlier_mask_)
    with sklearn.config_context(transform_output="pandas"):
        pipeline = make_pipeline(
            FunctionTransformer(feature_names_out="one-to-one"), clone(estimator)
        ).fit(scene.X)
        assert pipeline.predict(scene.X).dtype == bool
    assert "DensityPeaksFilter" in pipeline._repr_html_()
    fits = joblib.Parallel(n_jobs=2, prefer="threads")(
        joblib.delayed(lambda X: clone(estimator).fit(X).F_)(X) for X in [scene.X] * 4
    )
    for F in fits:
        np.testing.assert_array_equal(F, estimator.F_)


@pytest.mark.parametrize("with_y", [True, False])
def test_a_step_of_imbalanced_learns_pipeline(scene, with_y):
    pipeline = make_imblearn_pipeline(DensityPeaksFilter(), FundamentalMatrixEstimator(None))
    pipeline.fit(scene.X, scene.inliers if with_y else None)
    kept = pipeline[0].support_
    assert len(pipeline[-1].inlier_mask_) == kept.sum() < len(scene.X)
    whole = pipeline.predict(scene.X)
    assert whole.shape == (len(scene.X),)
    np.testing.assert_array_equal(whole[kept], pipeline[-1].inlier_mask_)


# ------------------------------------------------------------------ DensityPeaksFilter


def test_rules_are_those_of_the_prefilter_module(scene):
    contrast = DensityPeaksFilter().fit(scene.X)
    reliability, kept, *_ = contrast_support(scene.X)
    np.testing.assert_array_equal(contrast.reliability_, reliability)
    np.testing.assert_array_equal(contrast.support_, kept)
    paper = DensityPeaksFilter("paper", alpha=0.02, dc_percent=5).fit(scene.X)
    reliability, kept = paper_support(scene.X, 0.02, 5)
    np.testing.assert_array_equal(paper.reliability_, reliability)
    np.testing.assert_array_equal(paper.support_, kept)
    assert kept.sum() != paper_support(scene.X, 0.02, 2)[1].sum()


def test_paper_rule_by_its_formula(scene):
    peaks = density_peaks(scene.X)
    kept = peaks.gamma >= 0.02 * peaks.rho.max() * peaks.delta.max()
    np.testing.assert_array_equal(
        DensityPeaksFilter("paper", alpha=0.02).fit_predict(scene.X), kept
    )


def test_what_is_kept_is_purer():
    scene = two_view_scene(600, inlier_ratio=0.3)
    kept = DensityPeaksFilter(keep=0.25).fit_predict(scene.X)
    assert kept.sum() == 150
    assert scene.inliers[kept].mean() > 2 * scene.inliers.mean()


def test_weights_reorder_and_keep_the_number():
    scene = two_view_scene(300, inlier_ratio=0.1)
    plain = DensityPeaksFilter(keep=0.1).fit(scene.X)
    trusted = DensityPeaksFilter(keep=0.1).fit(scene.X, sample_weight=scene.inliers.astype(float))
    assert trusted.support_.sum() == plain.support_.sum() == 30
    assert scene.inliers[trusted.support_].mean() > scene.inliers[plain.support_].mean()
    assert trusted.reliability_.min() >= 0
    assert trusted.reliability_.max() <= 1
    by_rule = DensityPeaksFilter().fit(scene.X)
    equal = DensityPeaksFilter().fit(scene.X, sample_weight=np.full(len(scene.X), 5.0))
    assert equal.support_.sum() == by_rule.support_.sum()
    np.testing.assert_array_equal(
        np.argsort(equal.reliability_, kind="stable"),
        np.argsort(by_rule.reliability_, kind="stable"),
    )


def test_weights_count_as_scores_do_in_the_pipeline():
    scene = two_view_scene(300, inlier_ratio=0.4)
    trust = np.random.default_rng(0).random(300)
    estimate = estimate_fundamental(scene.points1, scene.points2, scores=trust)
    fitted = DensityPeaksFilter().fit(scene.X, sample_weight=trust)
    np.testing.assert_array_equal(fitted.reliability_, estimate.reliability)


def test_weight_counts_a_quarter_as_the_density_of_the_paper():
    rng = np.random.default_rng(3)
    X, weight = rng.normal(size=(40, 4)) * 100, rng.integers(0, 10, 40)
    by_density = DensityPeaksFilter("paper").fit(X).reliability_
    by_both = 4 * rankdata(by_density) + rankdata(weight)
    fitted = DensityPeaksFilter("paper").fit(X, sample_weight=weight)
    assert (np.diff(by_both[np.argsort(fitted.reliability_)]) >= 0).all()


def test_too_few_rows_left_keeps_all(scene):
    with pytest.warns(UserWarning, match="1 of 400 rows would be left, fewer than 15"):
        filter_ = DensityPeaksFilter("paper", alpha=1.0).fit(scene.X)
    assert filter_.support_.all()
    with pytest.warns(UserWarning, match="5 of 10 rows would be left"):
        assert DensityPeaksFilter(keep=0.5).fit_predict(scene.X[:10]).all()
    with pytest.warns(UserWarning, match="1 of 400 rows would be left"):
        assert DensityPeaksFilter(keep=0.001).fit_predict(scene.X).all()


@pytest.mark.parametrize("filter_", [DensityPeaksFilter(), DensityPeaksFilter("paper", keep=1.0)])
def test_few_rows_of_which_none_would_be_dropped_are_no_warning(scene, filter_):
    """Warnings are errors here."""
    weight = np.arange(10.0)
    assert filter_.fit_predict(scene.X[:10]).all()
    assert filter_.fit_predict(scene.X[:10], sample_weight=weight).all()
    estimator = FundamentalMatrixEstimator(filter_).fit(scene.X[:10])
    assert estimator.candidate_mask_.all()


def test_resampling_keeps_types_and_alignment(scene):
    X = pd.DataFrame(scene.X, columns=COLUMNS)
    y = pd.Series(scene.inliers)
    filter_ = DensityPeaksFilter()
    kept_X, kept_y = filter_.fit_resample(X, y)
    pd.testing.assert_frame_equal(kept_X, X[filter_.get_support()])
    pd.testing.assert_series_equal(kept_y, y[filter_.get_support()])
    np.testing.assert_array_equal(
        filter_.get_support(indices=True), np.flatnonzero(filter_.support_)
    )
    rows, nothing = filter_.fit_resample(scene.X)
    assert nothing is None
    np.testing.assert_array_equal(rows, scene.X[filter_.support_])


# ------------------------------------------------------------------ DensityPeaks


@pytest.mark.parametrize("options", [{"alpha": 0.2}, {"n_clusters": 4}])
def test_clusterer_is_density_peaks(scene, options):
    X = scene.X
    clusterer = DensityPeaks(dc_percent=3, kernel="gaussian", **options).fit(X)
    peaks = density_peaks(X, dc_percent=3, kernel="gaussian")
    centers = peaks.centers(alpha=options.get("alpha"), n=options.get("n_clusters"))
    labels = peaks.labels(centers)
    for name in ("rho", "delta", "gamma", "dc", "predecessor"):
        np.testing.assert_array_equal(getattr(clusterer, name + "_"), getattr(peaks, name))
    np.testing.assert_array_equal(clusterer.cluster_centers_indices_, centers)
    np.testing.assert_array_equal(clusterer.labels_, labels)
    np.testing.assert_array_equal(clusterer.halo_mask_, peaks.halo(labels))
    marked = DensityPeaks(dc_percent=3, kernel="gaussian", halo=True, **options).fit_predict(X)
    np.testing.assert_array_equal(marked, np.where(peaks.halo(labels), -1, labels))
    assert (marked == -1).any()
    assert DensityPeaks(dc=50.0).fit(X).dc_ == 50
    assert not hasattr(clusterer, "predict")


def test_clusterer_counts_in_a_sample(scene):
    sampled = DensityPeaks(sample_size=50).fit(scene.X)
    np.testing.assert_array_equal(sampled.rho_, density_peaks(scene.X, sample_size=50).rho)
    assert (sampled.rho_ != DensityPeaks().fit(scene.X).rho_).any()
    with pytest.raises(ValueError, match="'sample_size' parameter of DensityPeaks"):
        DensityPeaks(sample_size=1).fit(scene.X)


def test_more_clusters_than_points():
    with pytest.raises(ValueError, match="n_clusters=5 exceeds n_samples=3"):
        DensityPeaks(n_clusters=5).fit(np.eye(3))


def test_only_density_peaks_has_a_decision_graph(scene):
    with pytest.raises(TypeError, match="DensityPeaksFilter has no decision graph"):
        DecisionGraphDisplay.from_estimator(DensityPeaksFilter().fit(scene.X))
    with pytest.raises(NotFittedError):
        DecisionGraphDisplay.from_estimator(DensityPeaks())


def test_decision_graph_display(scene):
    from matplotlib.figure import Figure

    clusterer = DensityPeaks(alpha=0.3).fit(scene.X)
    ax = Figure().subplots()
    display = DecisionGraphDisplay.from_estimator(clusterer, ax=ax, s=5)
    assert display.ax_ is ax
    assert display.figure_ is ax.figure
    points, centers = (np.asarray(drawn.get_offsets()) for drawn in ax.collections)
    graph = np.column_stack([clusterer.rho_, clusterer.delta_])
    np.testing.assert_array_equal(centers, graph[np.sort(clusterer.cluster_centers_indices_)])
    assert len(points) + len(centers) == len(graph)
    sizes = [drawn.get_sizes()[0] for drawn in ax.collections]
    assert sizes[0] == 5 < sizes[1]
    x, y = ax.lines[0].get_data()
    np.testing.assert_allclose(x * y, 0.3 * clusterer.rho_.max() * clusterer.delta_.max())

    arrays = DecisionGraphDisplay.from_arrays(
        clusterer.rho_, clusterer.delta_, ax=Figure().subplots()
    )
    assert len(arrays.ax_.collections) == 1
    assert not arrays.ax_.lines
    graphs = [
        DecisionGraphDisplay.from_arrays(
            clusterer.rho_, clusterer.delta_, centers=rows, ax=Figure().subplots()
        )
        for rows in (np.array([5, 7]), np.isin(np.arange(len(clusterer.rho_)), [5, 7]))
    ]
    rows, marks = (graph.ax_.collections[1].get_offsets() for graph in graphs)
    assert len(rows) == 2
    np.testing.assert_array_equal(rows, marks)
    fixed = DensityPeaks(n_clusters=2).fit(scene.X)
    assert not DecisionGraphDisplay.from_estimator(fixed, ax=Figure().subplots()).ax_.lines


def test_a_call_in_cv2s_form_imports_no_more_than_cv2():
    code = """
import sys
import cv2, numpy
from cv_densityf import findFundamentalMat
X = numpy.random.default_rng(0).uniform(0, 500, (100, 4))
findFundamentalMat(X[:, :2], X[:, 2:], cv2.USAC_ACCURATE, 1.0, 0.99, 100)
assert not {"scipy", "sklearn", "matplotlib", "joblib"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("rule", ["contrast", "paper"])
def test_points_whose_distances_overflow_are_refused(rule):
    X = two_view_scene(50, random_state=0).X * 1e160
    with pytest.raises(ValueError, match="rescale"):
        DensityPeaksFilter(rule=rule).fit(X)


def test_a_prefilter_is_an_object(scene):
    with pytest.raises(TypeError, match=r"give an object, such as DensityPeaksFilter\(\)"):
        FundamentalMatrixEstimator(DensityPeaksFilter).fit(scene.X)


def test_the_estimator_tells_whether_draws_agreed(scene):
    found = estimate_fundamental(scene.X[:, :2], scene.X[:, 2:])
    assert FundamentalMatrixEstimator().fit(scene.X).agreed_ is found.agreed is True
    assert FundamentalMatrixEstimator(None).fit(scene.X).agreed_ is False
