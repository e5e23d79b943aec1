"""The mask is the method's rule applied to the F that is returned: exactly, for every point."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from compat import implementation, versions
from compat.cases import CASES, halves
from compat.cases import METHODS as ALL_METHODS
from compat.implementation import under_test
from compat.rules import RULES, rule_of, squared_residuals, wrong_flags
from compat.scenes import scene

#: The robust ones: the direct solvers call every match an inlier.
METHODS = {name: flag for name, flag in ALL_METHODS.items() if flag not in (1, 2, None)}


@pytest.mark.parametrize(
    "id_", [id_ for id_, case in CASES.items() if case.rule is not None and not case.refused]
)
def test_mask_is_the_rule_applied_to_F(run, id_):
    case, outcome = CASES[id_], run.ours[id_]
    if outcome.kind == "answer" and outcome.mask is not None:
        hold_rule(outcome.F, case.X, outcome.mask, case.rule, case.threshold)


def hold_rule(F, X, mask, rule, threshold):
    """Fail, and say by which rule, if a flag is wrong. Without F only "all" has one."""
    if F is None and rule != "all":
        return
    if rule != "all" and F.shape != (3, 3):
        pytest.fail(f"F has the shape {F.shape}", pytrace=False)
    others = sorted({*np.unique(mask).tolist()} - {0, 1})
    if others:
        pytest.fail(f"the mask has values that are neither 0 nor 1: {others[:5]}", pytrace=False)
    wrong = wrong_flags(F, X, mask, rule, threshold)
    if wrong:
        pytest.fail(
            f"{wrong} of {len(X)} flags are not what the rule {rule!r} makes of the F returned: "
            f"inliers are {RULES[rule]}; the threshold was {threshold}",
            pytrace=False,
        )


@pytest.mark.parametrize(
    "id_",
    [
        id_
        for id_, case in CASES.items()
        # cv2's classic methods answer with uninitialised memory (issues 9665, 5551), and UsacParams
        # with what was in the caller's mask.
        if case.rule in ("usac", "ransac", "lmeds")
        and not (
            implementation.IS_CV2
            and (case.rule != "usac" or id_.endswith("nothing found/UsacParams"))
        )
    ],
)
def test_no_model_means_no_inliers(run, id_):
    """A caller who sums the mask before looking at F must not find inliers."""
    outcome = run.ours[id_]
    if outcome.kind == "answer" and outcome.F is None and outcome.mask is not None:
        set_ = np.count_nonzero(outcome.mask)
        if set_:
            pytest.fail(
                f"F is None, but {set_} of {outcome.mask.size} flags are set: "
                "cv2's own mask is memory as it was (OpenCV issues 9665, 5551)",
                pytrace=False,
            )


@pytest.mark.parametrize("name", METHODS)
def test_exact_on_many_scenes(name):
    method, points = METHODS[name], 0
    for seed in range(12):
        threshold = (0.3, 1.0, 3.0)[seed % 3]
        X = scene(200 + 37 * seed, 0.3 + 0.05 * seed, noise=0.7, seed=seed)[0]
        X += np.float32((0, 0, 1e3, 1e4)[seed % 4])
        F, mask = under_test(*halves(X), method, threshold, 0.99, 300)
        if F is not None:
            points += len(X)
            hold_rule(F, X, mask, rule_of(method, len(X)), threshold)
    assert points > 2_000


@pytest.mark.skipif(not versions.EXACT_ARITHMETIC, reason="the last bit is not known here")
@pytest.mark.parametrize("name", ["FM_RANSAC", "USAC_FAST", "USAC_MAGSAC"])
def test_a_point_exactly_on_the_threshold(name):
    """Put the threshold on a residual: FM_RANSAC counts the point in, USAC counts it out."""
    method, hits = METHODS[name], 0
    for seed in range(15):
        X = scene(150, noise=1.0, seed=seed)[0]
        rule = rule_of(method, len(X))
        F, _ = under_test(*halves(X), method, 2.0, 0.99, 300)
        error = np.sort(squared_residuals(F, X, rule).astype(np.float64))
        for limit in error[np.searchsorted(error, 4.0) - np.arange(1, 4)]:
            threshold = float(np.sqrt(limit))
            F, mask = under_test(*halves(X), method, threshold, 0.99, 300)
            on_it = squared_residuals(F, X, rule).astype(np.float64) == threshold * threshold
            hits += np.count_nonzero(on_it)
            hold_rule(F, X, mask, rule, threshold)
            assert mask.ravel()[on_it].all() if rule == "ransac" else not mask.ravel()[on_it].any()
    if not hits and implementation.NAME != implementation.DEFAULT and not implementation.IS_CV2:
        pytest.skip("no residual came to lie on the threshold, for F depends on it")
    assert hits


def test_predict_has_the_same_rule():
    if implementation.NAME != implementation.DEFAULT:
        pytest.skip("only cv_densityf has this estimator")
    estimators = pytest.importorskip("cv_densityf.estimators")
    X = scene(300, seed=2)[0].astype(np.float64)
    for name, method in (("ransac", 8), ("usac_magsac", 38), ("usac_accurate", 36)):
        estimator = estimators.FundamentalMatrixEstimator(method=name, threshold=1.5).fit(X)
        mask = estimator.predict(X)
        assert mask.dtype == bool
        hold_rule(estimator.F_, X, mask, rule_of(method, len(X)), 1.5)


def test_given_mask_feeds_recover_pose():
    """A fresh uint8 column that the next function may write to."""
    X = scene(100, 0.8, seed=4)[0]
    p1, p2 = halves(X)
    F, mask = under_test(p1, p2, cv2.USAC_ACCURATE, 1.0, 0.999, 1000)
    K = np.array([[800.0, 0, 512], [0, 800, 384], [0, 0, 1]])
    kept = int(mask.sum())
    in_front, *_ = cv2.recoverPose(K.T @ F @ K, p1, p2, K, mask=mask)
    assert 0 < in_front <= kept
