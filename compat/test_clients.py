"""What programs do with the answer, each way that is in use somewhere, works on any implementation.

Each consumer below calls the function in the style of a known program and goes on with the results
the way that program does: the tutorials, OpenSfM, pyslam, kornia, image-matching-benchmark and
others. cv2 itself is the yardstick: where it carries a consumer through, so must the function under
test, and what the consumer ends up with must be as good.
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from compat.cases import halves, params
from compat.implementation import reference, under_test
from compat.outcomes import in_both
from compat.scenes import degenerate, scene

K = np.array([[800.0, 0, 512], [0, 800, 384], [0, 0, 1]])


def tutorial(find, p1, p2):
    """Integer pixels, LMEDS by default arguments, points selected by comparing with 1."""
    p1, p2 = np.int32(p1), np.int32(p2)
    F, mask = find(p1, p2, cv2.FM_LMEDS)
    right1, right2 = p1[mask.ravel() == 1], p2[mask.ravel() == 1]
    lines = cv2.computeCorrespondEpilines(right2.reshape(-1, 1, 2), 2, F).reshape(-1, 3)
    assert len(lines) == len(right1)
    return mask.ravel() == 1


def mask_before_matrix(find, p1, p2):
    """Structure from motion: the mask is indexed before F is looked at."""
    F, mask = find(p1, p2, cv2.FM_RANSAC, 3.0, 0.9999)
    rows = mask.ravel().nonzero()[0]
    if F is None or F[2, 2] == 0.0:
        return np.zeros(len(p1), bool)
    return np.isin(np.arange(len(p1)), rows)


def keywords_and_bool(find, p1, p2):
    """A web demo: all keywords, cv2.error means no result, the mask as a flat bool array."""
    try:
        _, mask = find(
            p1, p2, method=cv2.USAC_MAGSAC, ransacReprojThreshold=3.0, confidence=0.99, maxIters=500
        )
    except cv2.error:
        return np.zeros(len(p1), bool)
    return mask.ravel().astype("bool")


def squeezed(find, p1, p2):
    """A matching toolbox: everything by position, the mask squeezed."""
    _, inliers = find(p1, p2, cv2.USAC_MAGSAC, 3.0, 0.99, 500)
    return (inliers > 0).squeeze()


def pose_with_the_mask(find, p1, p2):
    """Dense matchers: F to E, E split, and the mask handed on to be written to."""
    F, mask = find(
        p1, p2, method=cv2.USAC_ACCURATE, ransacReprojThreshold=1.5, confidence=0.999, maxIters=500
    )
    E = K.T @ F @ K
    best, pose = 0, None
    for candidate in np.split(E, len(E) // 3):
        n, R, t, _ = cv2.recoverPose(candidate, p1, p2, K, 1e9, mask=mask.copy())
        if n > best:
            best, pose = n, (R, t)
    assert pose is not None
    n, *_ = cv2.recoverPose(E[:3], p1, p2, K, mask=mask)
    assert mask.dtype == np.uint8
    return mask.ravel() > 0


def notebook(find, p1, p2):
    """Tutorials of a vision library: four positions, the comparison with 0 as the mask."""
    _, inliers = find(p1, p2, cv2.USAC_MAGSAC, 1.5)
    inliers = inliers > 0
    return inliers[:, 0]


def benchmark(find, p1, p2):
    """A benchmark: -1 for what does not apply, a stack of up to three matrices is split."""
    cv2.setRNGSeed(3)
    F, mask = find(p1, p2, method=cv2.FM_RANSAC, ransacReprojThreshold=2.0, confidence=0.999)
    mask = mask.astype(bool).flatten()
    if F is None:
        return mask
    if F.shape[0] != 3:
        F = np.split(F, len(F) / 3)[0]
    eight, all_in = find(p1, p2, cv2.FM_8POINT, ransacReprojThreshold=-1, confidence=-1)
    assert eight is None or (eight.shape[1] == 3 and all_in.all())
    return mask


def visual_odometry(find, p1, p2):
    """A SLAM system: a 1 x 1 matrix or None is a failure, the mask is enumerated."""
    F, mask = find(p1, p2, cv2.FM_RANSAC, 2.0, 0.999)
    if F is None or F.shape == (1, 1):
        raise ValueError("no matrix")
    if F.shape[0] > 3:
        F = F[0:3, 0:3]
    rows = [i for i, v in enumerate(mask) if v > 0]
    assert np.count_nonzero(mask) == len(rows)
    return np.isin(np.arange(len(p1)), rows)


def method_by_name(find, p1, p2):
    """A verifier: the method by getattr, float32 slices of a wider table."""
    table = np.hstack([p1, np.ones((len(p1), 3), np.float32), p2])
    _, mask = find(table[:, :2], table[:, 5:], method=cv2.USAC_DEFAULT)
    return mask.ravel() == 1


def transposed(find, p1, p2):
    """Column vectors: Fortran-ordered views, and the size of F tells success."""
    one, two = np.asarray(p1, np.float64).T.copy(), np.asarray(p2, np.float64).T.copy()
    F, mask = find(one.T, two.T, cv2.FM_RANSAC, 2.0)
    if len(np.ravel(F)) != 9:
        return np.zeros(len(p1), bool)
    return mask.reshape(-1).astype(bool)


def first_three_rows(find, p1, p2):
    """An evaluator: F[:3] for whatever came, the mask squeezed to bool."""
    F, mask = find(p1, p2, method=cv2.FM_RANSAC, ransacReprojThreshold=1, confidence=1 - 1e-5)
    assert F[:3].shape == (3, 3)
    return mask.squeeze().astype(bool)


def where_the_column_is_set(find, p1, p2):
    """Matchers' demos: views into one array of matches, np.where on the column."""
    both = np.concatenate([p1, p2], axis=1)
    _, mask = find(both[:, :2], both[:, 2:], cv2.USAC_FAST, 2.0, 0.999, 1000)
    rows = np.where(mask[:, 0])[0]
    return np.isin(np.arange(len(p1)), rows)


def one_params_object(find, p1, p2):
    """Snippets that keep one UsacParams for all calls."""
    settings = params(threshold=2.0, score=cv2.SCORE_METHOD_MAGSAC, randomGeneratorState=3)
    _, first = find(p1, p2, settings)
    _, second = find(p1, p2, settings)
    np.testing.assert_array_equal(first, second)
    return first.ravel() == 1


def counts_inliers(find, p1, p2):
    """The wrong but common one: only the mask is tested for None."""
    _, mask = find(p1, p2, cv2.FM_RANSAC, 2.0, 0.99)
    if mask is None or int(mask.sum()) < 8:
        return np.zeros(len(p1), bool)
    return mask.ravel() == 1


def rectifies(find, p1, p2):
    """Stereo from uncalibrated images: F goes on into cv2."""
    F, mask = find(p1, p2, cv2.USAC_MAGSAC, 1.5, 0.999, 1000)
    right = mask.ravel() == 1
    done, H1, H2 = cv2.stereoRectifyUncalibrated(p1[right], p2[right], F, (1024, 768))
    assert done
    assert H1.shape == H2.shape == (3, 3)
    corrected, _ = cv2.correctMatches(F, p1[right][None], p2[right][None])
    assert np.isfinite(corrected).all()
    return right


def strict(find, p1, p2):
    """A dense matcher's demo: a tiny threshold, almost certainty, many iterations."""
    _, mask = find(
        p1,
        p2,
        ransacReprojThreshold=0.2,
        method=cv2.USAC_MAGSAC,
        confidence=0.999999,
        maxIters=10000,
    )
    return mask.ravel() > 0


def confidence_by_name(find, p1, p2):
    """A feature tracker: numbers by position, the last by keyword, rows counted."""
    _, mask = find(p1, p2, cv2.FM_RANSAC, 2.0, confidence=0.999)
    n = 0 if mask is None else np.count_nonzero(mask)
    found = np.zeros(len(p1), bool)
    if n >= 8:
        found[[i for i, v in enumerate(mask) if v > 0]] = True
    return found


def falls_back(find, p1, p2):
    """A training script: anything raised or None means the identity and no match."""
    try:
        F, mask = find(p1, p2, cv2.USAC_MAGSAC, 1.0, 0.999999, 10000)
        mask = mask.ravel() > 0
    except Exception:
        F, mask = None, np.zeros(len(p1), bool)
    F = np.eye(3) if F is None else F
    assert F.shape == (3, 3)
    return mask


CONSUMERS = [
    tutorial,
    mask_before_matrix,
    keywords_and_bool,
    squeezed,
    pose_with_the_mask,
    notebook,
    benchmark,
    visual_odometry,
    method_by_name,
    transposed,
    first_three_rows,
    where_the_column_is_set,
    one_params_object,
    counts_inliers,
    rectifies,
    strict,
    confidence_by_name,
    falls_back,
]


def quality(found, inliers):
    """F1 of the flags that a consumer ends up with."""
    hits = np.count_nonzero(found & inliers)
    return 2 * hits / max(np.count_nonzero(found) + np.count_nonzero(inliers), 1)


@pytest.mark.parametrize("consumer", CONSUMERS, ids=lambda consumer: consumer.__name__)
def test_ends_up_with_matches_as_good(consumer):
    ours, cv2s = [], []
    for seed in range(8):
        X, inliers, _ = scene(250, 0.6 + 0.04 * seed, 0.4, seed)
        for results, find in ((ours, under_test), (cv2s, reference)):
            found = consumer(find, *halves(X))
            assert (found.shape, found.dtype) == ((250,), bool)
            results.append(quality(found, inliers))
    assert np.mean(ours) > np.mean(cv2s) - 0.02
    assert np.min(ours) > np.min(cv2s) - 0.1


HARD = {
    "nothing": np.empty((0, 4), np.float32),
    "six": scene(6, 1.0)[0],
    "seven": scene(7, 1.0, 0.0, seed=1)[0],
    "eight": scene(8, 1.0)[0],
    "twelve": scene(12, 0.7)[0],
    "sixteen, wrong": scene(16, 0.0)[0],
    "a line": degenerate("line in both", 40),
    "one point": degenerate("one point", 40),
    "NaN": degenerate("NaN", 40),
    "some NaN": np.where(
        np.arange(60)[:, None] % 10 == 3, np.float32(np.nan), scene(60, 0.9)[0]
    ).astype(np.float32),
}


BY_NAME = {consumer.__name__: consumer for consumer in CONSUMERS}


def ending(find, id_):
    name, situation = id_.split("/")
    try:
        found = BY_NAME[name](find, *halves(HARD[situation]))
    except Exception as error:
        return type(error).__name__
    return f"flags {found.shape}"


@pytest.fixture(scope="module")
def endings():
    """How every consumer ends: in child processes, since little data is what programs die of."""
    return in_both(ending, [f"{name}/{situation}" for name in BY_NAME for situation in HARD])


@pytest.mark.parametrize("situation", HARD)
@pytest.mark.parametrize("consumer", BY_NAME)
def test_ends_no_worse_when_there_is_little(endings, consumer, situation):
    ours, cv2s = (found[f"{consumer}/{situation}"] for found in endings)
    # Where cv2 leads a program into an exception, no exception is as good.
    if ours != cv2s and not (str(ours).startswith("flags") and not str(cv2s).startswith("flags")):
        end = ours if isinstance(ours, str) else f"{ours.kind}: {ours.detail}"
        pytest.fail(f"ends with {end}, where cv2 leads it to {cv2s}", pytrace=False)
