"""The pipeline: matches and options in, one `Estimate` out."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cv_densityf._arguments import (
    CONTRAST,
    THRESHOLDS,
    Density,
    DensityRule,
    check,
    check_matches,
    check_scores,
)
from cv_densityf._consensus import search
from cv_densityf._engine import Robust, method_flag
from cv_densityf._epipolar import FAR, mask_and_threshold, middle
from cv_densityf._prefilter import KEPT, Support, best_scored, contrast_support
from cv_densityf._stopwatch import Stopwatch

#: One line per estimate at level DEBUG.
LOG = logging.getLogger("cv_densityf")
LOG.addHandler(logging.NullHandler())

#: With fewer matches cv2 turns RANSAC into LMEDS, and there is no density to speak of.
MIN_FILTERED = 15
#: More matches than this do not help to find F: a seeded part of this size searches.
MAX_SEARCHED = 5_000
#: They do help to choose and to measure it, up to what memory should bear.
MAX_REFINED = 100_000
#: Of as many of those that search the density is looked at, and hypotheses are drawn; without
#: scores, of so few where most of these are right; and of all where no two hypotheses agree.
MAX_RANKED = 1_000
FEW_RANKED = 250
#: The noise is the data's, and the caller's threshold rules the mask: the search has this part of
#: the points' spread for its threshold, 1 to 3 px in a photograph, as far as it is within this
#: factor of the caller's; below half of it, right matches may not agree any more. It is no more
#: than so many pixels: the noise of a large image is no larger, and there wrong matches a few
#: pixels off would pass. Points of more spread than those of any image are not in pixels. Few
#: matches get more, by this over their number: of these each that is right counts.
_SEARCH_THRESHOLD = 0.01
_LEEWAY = 2.0
_MOST_PIXELS = 3.0
_NO_PIXELS = 1e4
_MORE_FOR_FEW = 25.0
#: Points that were rounded to a lattice have this part of its step for a threshold at least: they
#: are off by up to half of it, and there are wrong matrices that suit many of them exactly. So many
#: tell whether there is one, by gaps that are whole multiples of the step but for so much.
_OF_STEP = 0.8
_TELL_STEP = 200
_WHOLE = 1e-3
#: Matches of a minimal sample: fewer have no F, and an F that explains fewer is none.
MINIMAL = 7
#: If one image is so many times as large as the other, they are in different units.
_OTHER_UNITS = 30.0
#: A larger threshold, in units of the points' spread, is hardly meant.
_COARSE = 0.1


@dataclass(frozen=True, eq=False)
class Estimate:
    """A fundamental matrix, its inliers, and how they were found.

    An estimate without a fundamental matrix is falsy.

    Attributes
    ----------
    F : array, shape (3, 3), float64, or None
        Fundamental matrix, ``[x', y', 1] @ F @ [x, y, 1] = 0``. cv2 may return up to three,
        stacked, for seven matches.
    mask : array, shape (n,), bool
        Inliers by the method's own rule.
    kept : array, shape (n,), bool
        The dense part: matches the density rule holds reliable. Of more than a thousand it looks at
        a thousand, without scores at 250 if most of these are right, and at all where they lead to
        no agreement. Where cv2's own call answered, all finite matches.
    reliability : array, shape (n,), float64
        From 0 (isolated) to 1 (densest); NaN for matches whose density was not looked at. Where
        cv2's own call answered, 1 for finite matches and 0 for others.
    n_draws : int
        Hypotheses drawn; 0 if cv2's own call answered.
    agreed : bool
        Whether another draw found the same inliers, which is hardly ever by accident. False where
        nearly all are on one plane, which leaves F open, where cv2's own call answered, and for
        ``density="paper"``.
    engine : str
        What drew: ``"density"``, or the name of cv2's method that was called instead.
    reason : str
        One sentence on how the result came about, or why there is none.
    timings : dict of str to float
        Milliseconds per stage.
    votes : tuple of float
        The vote for each polished hypothesis of the last search, in the order of the draws; then
        for those of a dominant plane and, where no draws agreed, of the local optimisation. What
        the best of them becomes after that has none, nor has the draw that only ``"lmeds"`` makes.
        Of many matches, those of the part that searched. Where a plane is dominant, the best one's
        may be 4 % less than the largest: among these the matches near it off the plane decide.
        And it may be far less where clearly more matches are near another motion.

    See Also
    --------
    estimate_fundamental : Makes estimates.
    """

    F: NDArray[np.float64] | None
    mask: NDArray[np.bool_]
    kept: NDArray[np.bool_]
    reliability: NDArray[np.float64]
    n_draws: int
    agreed: bool
    engine: str
    reason: str
    timings: dict[str, float] = field(default_factory=dict)
    votes: tuple[float, ...] = ()

    def __bool__(self) -> bool:
        return self.F is not None

    @property
    def n_inliers(self) -> int:
        """Number of inliers."""
        return int(np.count_nonzero(self.mask))

    def __repr__(self) -> str:
        found = f"{self.n_inliers} inliers of {len(self.mask)}" if self else "no F"
        return f"<Estimate: {found}; {self.reason}>"


def run(
    X: NDArray[np.float64],
    robust: Robust,
    rule: DensityRule = CONTRAST,
    *,
    scores: NDArray[np.float64] | None = None,
    seed: int = 0,
) -> Estimate:
    """Estimate F from trusted arguments: X (n, 4) float64, whose rows may hold NaN or Inf."""
    estimate = _estimate(X, robust, rule, scores, seed)
    if LOG.isEnabledFor(logging.DEBUG):
        LOG.debug(
            "%d matches, %d kept, %d draws, %d inliers, engine %s, %.1f ms: %s",
            len(X),
            np.count_nonzero(estimate.kept),
            estimate.n_draws,
            estimate.n_inliers,
            estimate.engine,
            sum(estimate.timings.values()),
            estimate.reason,
        )
    return estimate


def _estimate(
    X: NDArray[np.float64],
    robust: Robust,
    rule: DensityRule,
    scores: NDArray[np.float64] | None,
    seed: int,
) -> Estimate:
    watch = Stopwatch()
    n, density = len(X), rule.density
    finite = finite_in_cv2(X)
    rows = np.flatnonzero(finite)

    def plain(why: str) -> Estimate:
        return _plain(X, finite, scores, robust, watch, f"cv2's own call, since {why}")

    if len(rows) < MIN_FILTERED:
        return plain(f"fewer than {MIN_FILTERED} finite matches")
    if density == "off" or robust.direct:
        return plain("density is off" if density == "off" else f"{robust.name} takes no filter")
    heard = rows
    if len(rows) > MAX_SEARCHED:
        rng = np.random.default_rng(abs(seed))
        heard = rows[_some(len(rows), MAX_REFINED, rng)]
        rows = heard[_some(len(heard), MAX_SEARCHED, rng)]
    Z = X[rows] if len(rows) < n else X
    about = middle(Z)
    on_a_line, sizes = _shape(Z, about)
    if on_a_line:
        return plain("all points of an image are nearly on a line")
    # What is to the eye one image beside another is to residuals one of them alone.
    units = np.ones(2)
    if max(sizes) > _OTHER_UNITS * min(sizes):
        units = max(sizes) / sizes
        Z = Z * units.repeat(2)
        about = middle(Z)
    asked: dict[str, Any] = {
        "threshold": _search_threshold(about[1], len(Z), robust, density),
        "confidence": robust.confidence,
        "max_iters": robust.max_iters,
        "seed": seed,
    }
    lowest = rule.alpha
    if density != "paper":
        lowest = KEPT
        of_step = _OF_STEP * _lattice_step(Z, asked["threshold"], _COARSE * about[1])
        asked["threshold"] = max(asked["threshold"], of_step)
    with np.errstate(all="ignore"):
        try:
            if density == "paper":
                # It needs scipy, whose import takes as long as cv2's.
                from cv_densityf._paper import eight_point_ransac, paper_support

                peaks, support = paper_support(Z, lowest, rule.dc_percent)
                watch.lap("density")
                found = eight_point_ransac(Z[support], **asked)
                if found is not None:
                    found = replace(found, reliability=peaks)
                watch.lap("draws")
            else:
                trust = scores
                if trust is None and robust.best_first:
                    trust = -np.arange(n, dtype=np.float64)
                others = other_scores = None
                if len(heard) > len(rows):
                    searched = np.zeros(n, dtype=bool)
                    searched[rows] = True
                    rest = heard[~searched[heard]]
                    others = X[rest] * units.repeat(2)
                    other_scores = None if trust is None else trust[rest]
                trust = None if trust is None else trust[rows]
                rankings = _rankings(Z, trust, seed, watch)
                found = search(
                    Z,
                    rankings,
                    watch=watch,
                    about=about,
                    scores=trust,
                    others=others,
                    other_scores=other_scores,
                    majority=robust.rule == "lmeds",
                    **asked,
                )
        except np.linalg.LinAlgError:
            found = None
    if found is None:
        return plain("no draw on the dense part held")
    reliability = np.full(n, np.nan)
    reliability[rows] = found.reliability
    F = found.F * np.outer([units[1], units[1], 1.0], [units[0], units[0], 1.0])
    mask, limit = mask_and_threshold(F, X, robust.rule, robust.threshold)
    watch.lap("mask")
    if np.count_nonzero(mask) < MINIMAL:
        return plain("too few matches fit at this threshold")
    doubt = threshold_doubt(limit, about[1], derived=robust.rule == "lmeds")
    return Estimate(
        F=F,
        mask=mask,
        kept=reliability >= lowest,
        reliability=reliability,
        n_draws=found.n_draws,
        agreed=found.agreed,
        engine="density",
        reason=f"{doubt}; {found.reason}" if doubt else found.reason,
        timings=watch.laps,
        votes=found.votes,
    )


def threshold_doubt(threshold: float, spread: float, derived: bool) -> str:
    """Ask about a threshold that is a good part of the points' spread; else an empty string.

    It may be the caller's, or ``derived`` from the residuals.
    """
    if threshold <= _COARSE * spread or spread == 0.0:
        return ""
    question = "are more than half of the matches right?" if derived else "are they in pixels?"
    return f"the threshold is {threshold / spread:.2g} of the points' spread ({question})"


def _search_threshold(spread: float, n: int, robust: Robust, density: str) -> float:
    own = _SEARCH_THRESHOLD * spread
    if spread < _NO_PIXELS:
        own = min(own, _MOST_PIXELS)
    own *= 1.0 + _MORE_FOR_FEW / n
    if robust.rule == "lmeds":  # takes none from the caller
        return own
    if density == "paper":  # th of its step 5
        return robust.threshold
    most = max(robust.threshold * _LEEWAY, own / _LEEWAY)
    return min(max(own, robust.threshold / _LEEWAY), most)


def _lattice_step(X: NDArray[np.float64], least: float, most: float) -> float:
    """Step of the lattice that all coordinates are on; 0 if there is none between these limits."""
    # Mostly some matches tell that there is none.
    for part in (X[:_TELL_STEP], X):
        gaps = np.diff(np.sort(part.T))
        steps = np.where(gaps > 0.0, gaps, np.inf).min(axis=1, keepdims=True)
        step = float(steps.min())
        if not least <= step <= most:
            return 0.0
    gaps /= steps
    return step if (np.abs(gaps - np.rint(gaps)) < _WHOLE).all() else 0.0


def _rankings(
    X: NDArray[np.float64], trust: NDArray[np.float64] | None, seed: int, watch: Stopwatch
) -> Iterator[Support]:
    """Tell the reliability of a part of the better half by score; then of all."""
    n = len(X)
    if n > MAX_RANKED:
        better = np.arange(n) if trust is None else best_scored(trust, max(n // 2, MAX_RANKED))
        rng = np.random.default_rng(abs(seed))
        rows = better[_some(len(better), MAX_RANKED, rng)]
        few = None
        if trust is None:  # the better half would not tell that most of all are right
            few = FEW_RANKED
            first = _some(len(rows), few, rng)
            rows = np.concatenate([rows[first], np.delete(rows, first)])
        support = contrast_support(X, trust, rows, few)
        watch.lap("density")
        yield support
    support = contrast_support(X, trust)
    watch.lap("density")
    yield support


def _some(n: int, size: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Draw ``size`` of n rows, in rising order; all of fewer."""
    return np.arange(n) if n <= size else np.sort(rng.choice(n, size, replace=False, shuffle=False))


def finite_in_cv2(X: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Whether each match is finite in float32, as cv2 sees it."""
    with np.errstate(over="ignore"):
        return np.asarray(np.isfinite(X.astype(np.float32)).all(axis=1))


def _shape(
    X: NDArray[np.float64], about: tuple[NDArray[np.floating], float]
) -> tuple[bool, NDArray[np.float64]]:
    """Whether an image's points lie on one line or spot, as far as float32 can tell; their spreads.

    What lies far out from the centre and spread ``about`` is drawn in: the others would look like
    one spot from there.
    """
    centre, spread = about
    columns = np.ascontiguousarray(X.clip(centre - FAR * spread, centre + FAR * spread).T)
    largest = np.abs(columns).max(axis=1)
    centred = columns - columns.mean(axis=1, keepdims=True)
    covariance = centred @ centred.T / len(X)
    sizes = np.sqrt(np.diagonal(covariance).reshape(2, 2).sum(axis=1))
    for image in (slice(0, 2), slice(2, 4)):
        (a, b), (_, d) = covariance[image, image]
        smallest = 0.5 * (a + d - np.hypot(a - d, 2.0 * b))
        if smallest <= 1e-12 * largest[image].max() ** 2:
            return True, sizes
    return False, sizes


def _plain(
    X: NDArray[np.float64],
    finite: NDArray[np.bool_],
    scores: NDArray[np.float64] | None,
    robust: Robust,
    watch: Stopwatch,
    reason: str,
) -> Estimate:
    """Answer as cv2 itself does on the finite matches, PROSAC with the best scores first."""
    n_finite = int(np.count_nonzero(finite))
    heard = finite
    if robust.rule == "ransac" and n_finite < MIN_FILTERED <= len(X):
        # It would be another method on so few; RANSAC itself knows rows that are not numbers.
        heard = np.ones_like(finite)
    Z = X if heard.all() else X[heard]
    asked, robust = robust, robust.for_size(len(Z))
    if robust is not asked:
        reason += ", without graph cut, which takes too long here"
    F, found = robust.plain(Z[:, :2], Z[:, 2:], None if scores is None else scores[heard])
    if F is not None and len(Z) < len(X):
        # Through seven numbers cv2 stacks all matrices there are.
        F = F[:3]
    mask = np.zeros(len(X), dtype=bool)
    if found is not None:
        mask[heard] = found.ravel() != 0
    watch.lap("draws")
    name = robust.name
    if F is None:
        why = "they may be too few or degenerate"
        if n_finite < MINIMAL:
            why = f"at least {MINIMAL} are needed"
        reason += f"; {name} found no F in {n_finite} finite matches: {why}"
    return Estimate(
        F=F,
        mask=mask,
        kept=finite,
        reliability=finite.astype(np.float64),
        n_draws=0,
        agreed=False,
        engine=name,
        reason=reason,
        timings=watch.laps,
    )


def estimate_fundamental(
    points1: ArrayLike,
    points2: ArrayLike,
    *,
    method: str | int = "usac_accurate",
    threshold: float = 1.0,
    confidence: float = 0.999,
    max_iters: int = 5000,
    density: Density = "contrast",
    alpha: float = 0.011,
    dc_percent: float = 2.0,
    scores: ArrayLike | None = None,
    random_state: int = 0,
) -> Estimate:
    """Estimate the fundamental matrix of two images from matched points.

    Hypotheses are drawn where matches are dense in (x, y, x', y'), polished on all matches and
    picked by a vote of the reliable and well spread ones.

    Parameters
    ----------
    points1, points2 : array-like, shape (n, 2)
        Matched points, pixels. Rows with NaN or Inf are never inliers.
    method : str or int
        Name (``"ransac"``, ``"lmeds"``, ``"usac_magsac"``, ...) or cv2 constant. It decides the
        rule of the inlier mask, and the call that answers where density cannot help.
    threshold : float
        Largest residual of an inlier, pixels, in (1e-12, 1e6); unused by ``"lmeds"``, which finds
        its own. It rules the mask: the search has one of its own, a hundredth of the points'
        spread, up to 3 px, and of few matches more, brought to within a factor of two of this one,
        but never below half of its own, nor below .8 steps of a lattice that all points are on;
        ``density="paper"`` takes this one.
    confidence : float
        Of each draw to have found the best model, in (0, 1).
    max_iters : int
        Bound on the iterations of each draw, in [1, 2^31). The default rule's draws end after a
        thousand in any case, those of ``"paper"`` and of cv2's own call only here.
    density : {"contrast", "paper", "off"}
        Rule for the dense part: density contrast, Wu and Wan's rho * delta, or none.
    alpha : float
        For ``"paper"``: matches below ``alpha * rho_max * delta_max`` are dropped; in [0, 1].
    dc_percent : float
        For ``"paper"``: mean share of neighbours within the cut-off distance, percent, (0, 100].
    scores : array-like, shape (n,) or (n, 1), optional
        Trust in each match, higher is better (1 - SIFT ratio, a matcher's confidence). Only the
        order counts, so infinities will do, but not NaN. ``"paper"`` and ``"off"`` use none, but
        cv2's own PROSAC gets the best first.
    random_state : int
        Seed, in [0, 2^31).

    Returns
    -------
    Estimate
        Falsy, with a ``reason``, if no fundamental matrix was found.

    Raises
    ------
    ValueError
        If shapes differ or an option is out of its range.

    References
    ----------
    Hao Wu and Yi Wan, "Clustering assisted fundamental matrix estimation" (2015).

    Examples
    --------
    >>> from cv_densityf import estimate_fundamental
    >>> from cv_densityf.datasets import two_view_scene
    >>> scene = two_view_scene(500, inlier_ratio=0.4, noise=0.5, random_state=0)
    >>> estimate = estimate_fundamental(scene.points1, scene.points2)
    >>> bool(estimate), estimate.F.shape, estimate.mask.shape
    (True, (3, 3), (500,))
    """
    X = check_matches(points1, points2)
    trust = None if scores is None else check_scores(scores, len(X))
    low, high = THRESHOLDS
    wanted = f"a number above {low:g}, below {high:,.0f}"
    check("threshold", threshold, Real, lambda v: low < v < high, wanted)
    check("confidence", confidence, Real, lambda v: 0 < v < 1, "a number inside (0, 1)")
    check(
        "max_iters", max_iters, Integral, lambda v: 1 <= v < 2**31, "an integer from 1 to 2^31 - 1"
    )
    rule = DensityRule(density, alpha, dc_percent)
    in_range = "an integer from 0 to 2^31 - 1"
    check("random_state", random_state, Integral, lambda v: 0 <= v < 2**31, in_range)
    return run(
        X,
        Robust(method_flag(method), float(threshold), float(confidence), int(max_iters)),
        rule,
        scores=trust,
        seed=int(random_state),
    )
