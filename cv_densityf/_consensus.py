"""Draw hypotheses on the dense part, polish them on all matches, pick one by a weighted vote."""

from __future__ import annotations

from collections.abc import Iterable
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cv_densityf._blas import times_vector
from cv_densityf._engine import draw
from cv_densityf._epipolar import (
    FAR,
    Frame,
    essential_ratio,
    middle,
    polish,
    refine,
    shift,
)
from cv_densityf._parallax import FEWEST, plane_and_parallax
from cv_densityf._prefilter import (
    COHERENT,
    Support,
    coherence,
    grouped,
    place_numbers,
    ranks,
    turns,
)
from cv_densityf._stopwatch import Stopwatch

Floats = NDArray[np.floating]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]

#: Draws from the ranked matches within a few thresholds of the best hypothesis so far.
NEAR = 0.0
#: Draws from all matches, whatever the density says, in the order of the caller's scores.
BY_SCORE = -1.0
#: Draws from half of the ranked matches, spread over the image: of the most reliable three quarters
#: the first of each cell, then the second of each, and so on. What moves on its own, a crowd
#: mostly, has few among them.
SPREAD = -2.0
_SPREAD_OF = 0.75
#: Shares of the ranked matches, most reliable first, that hypotheses are drawn from, round by
#: round.
ROUNDS = (
    (0.25, SPREAD),
    (BY_SCORE, 0.75, NEAR),
    (0.125, BY_SCORE, 1.0),
    (0.5, BY_SCORE, NEAR),
    (0.25, NEAR),
    (1.0, NEAR),
)
#: Where fewer than this share of the ranked matches seem right, all parts but the whole shrink as
#: these do, but to no less than so much: most of what is left out is wrong.
_MOSTLY_RIGHT = 2 / 3
_SMALLEST = 2 / 3
#: Matches of so small a part are close together, and nearly all samples pass for planes.
_DENSE = 0.25
#: After so many it may be hopeless.
_ROUNDS_BY_CHANCE = 2
_NEAR_WIDTH = 8.0
#: What the draws agree on may be one of several motions, or a mark that both images bear: with more
#: than this share of the better half of what seems right unexplained, farther than so many working
#: thresholds, one more draw is from all that is unexplained, before they may end. A motion that is
#: the larger one has most of these, so that this draw is short.
_UNEXPLAINED = 0.1
_EXPLAINED_WIDTH = 3.0
_SHORT_DRAW_ITERS = 200
#: Matches a draw gets at least: fewer crowd on too little of the image to fix F.
MIN_DRAW = 30
#: cv2's iterations in one draw from a quarter of the ranked matches, and less from larger, less
#: pure parts. More find no better F; several short draws do.
MAX_DRAW_ITERS = 1000
#: Two hypotheses agree when their inlier sets have this intersection over union; then there are no
#: more draws.
_AGREEMENT = 0.93
#: Clearly more matches are near a hypothesis than near another one if their sum, in which each
#: counts less the farther it is, is larger by so many standard deviations of chance. The local
#: optimisation has many that differ little, and asks for more.
_CLEARLY = 1.25
_CLEARLY_OF_MANY = 2.0
#: Where a plane is dominant, a hypothesis with this share of the most votes that clearly more
#: matches off the plane are near, and no fewer in all, is the better one: these fix F, and are
#: often sparse and of little reliability. With fewer votes it fits a crowd of wrong ones there.
_NEARLY = 0.96
#: A rival, another motion than the one with the most votes, is taken in its place if clearly more
#: matches are near it, within so many robust standard deviations of the residuals, the larger ones
#: of the two. It has to have this part of the other's inliers at least. Where the other has this
#: part of its own, too, they are of like size, and each match counts its rank by score.
_RIVAL_SIGMAS = 2.0
_AT_LEAST = 0.7
#: Working thresholds within which a match is on a plane.
_PLANE_WIDTH = 2.0
#: With more than this share of the inliers on a plane the reason says so. F is open if those off it
#: may be by chance: no more than so many and this share of all that is off it.
_PLANAR = 0.9
_BY_CHANCE = (8, 0.03)
#: Draws from parts whose sizes differ by less than this factor are not independent.
_DISTINCT = 1.4
#: Largest size of the samples of the local optimisation, how many of its widths from the hypothesis
#: they are taken, and how far and at how many matches at most their polish and their vote look.
_LOCAL_SIZE = 10
_LOCAL_WIDTH = 3.0
_LOCAL_REACH = 20.0
_LOCAL_MATCHES = 1_000
_LOCAL_STEPS = 3
#: Of the winner it is at a width of so many robust standard deviations of the residuals. Number of
#: samples, and of the best ones, which are polished.
_LOCAL_SIGMAS = 2.5
_LOCAL_SAMPLES = (24, 8)
#: Before that, where no draws agree, the right F may be next to another hypothesis than the best:
#: the same numbers at the working threshold from each of so many, whose inliers have less than this
#: intersection over union.
_LOCAL_SAMPLES_IN_DOUBT = (96, 16)
_LOCAL_STARTS_IN_DOUBT = 2
_SAME_BASIN = 0.8
#: Threshold of a draw for what most matches agree on, in standard deviations, and how many
#: near matches it is from.
_MAJORITY_SIGMAS = 1.2
_MAJORITY_OF = 300
#: Widths of the vote, in units of the working threshold.
_VOTE_WIDTHS = np.array([0.3, 0.5, 0.8, 1.3])
#: Votes saturate within a cell of this many to the longer side of each image.
_GRID = 16
#: Width of the weights in the polish, in units of the working threshold.
_POLISH_WIDTH = 0.7
_POLISH_STEPS = 2
_REFINE_STEPS = 2
#: The noise that motions are compared at, and that what follows the choice of the winner reckons
#: with, at least, in units of the threshold.
_NARROWEST = 0.03
#: For the last steps, right matches are counted within so many sigmas of their lines, wrong ones
#: between these, in each of so many groups of like reliability; and the density of right ones on
#: the lines is this share of their number, per sigma.
_NEARBY = 2.5
_BESIDE = (4.0, 12.0)
_GROUPS = 4
_PEAK = 0.8
#: Hypotheses of a part of the matches that the others vote on.
_FINALISTS = 3
#: From so many matches on the winner has a way to go: in strides of this many steps of the polish,
#: for wrong matches make them short, at a width of this many robust standard deviations, until a
#: step is as short a part of one. So long strides need not converge; more of them would not be
#: better.
_MANY = 1_000
_STRIDES = 10
_AT_REST = 0.03
_STRIDE = 3.0
_STRIDE_SIGMAS = 1.4
#: Noise may exceed the threshold; residuals beyond this many of it are wrong matches.
_WIDEST = 3.0
#: A working threshold of this many robust standard deviations of the residuals lets nearly every
#: inlier vote; it never exceeds the threshold and never falls below a part of it: exact matches,
#: such as those of a mark on both images, should not deny the others their vote.
_SIGMAS = 4.0
_SMALLEST_SCALE = 0.5


@dataclass(frozen=True, slots=True)
class Consensus:
    """The hypothesis that won, the ranking it was found with, and how it came about."""

    F: NDArray[np.float64]
    reliability: NDArray[np.float64]
    votes: tuple[float, ...]
    n_draws: int
    agreed: bool
    reason: str


def search(
    X: Floats,
    rankings: Iterable[Support],
    *,
    threshold: float,
    confidence: float,
    max_iters: int,
    seed: int,
    watch: Stopwatch,
    about: tuple[Floats, float] | None = None,
    scores: Floats | None = None,
    others: Floats | None = None,
    other_scores: Floats | None = None,
    majority: bool = False,
) -> Consensus | None:
    """Search for the fundamental matrix that the reliable and well spread matches vote for.

    Rounds of draws on nested sets of the most reliable matches, on some that are spread over the
    image, on all that are ranked, and on what the best hypothesis so far leaves near its epipolar
    lines: a nearly right F has the right one's inliers there. Each hypothesis is polished on all
    matches. The draws end when a second, independent one arrives at the best hypothesis's inliers,
    and one from what these leave, if that is much, is no better; or after `ROUNDS` on each ranking,
    or where there is no hope. Another motion that clearly more matches are near is best, whatever
    its votes. Where most inliers are on a plane, other hypotheses of that plane are then tried.
    Where no draws agree, and there is hope, the best hypotheses are optimised locally; the winner
    always is, within its noise.

    Parameters
    ----------
    X : array, shape (n, 4)
        Finite matches.
    rankings : iterable of Support
        Reliability of each match: the weight of its vote, in [0, 1], and its place in the order of
        the draws. NaN where it is not known: such a match is in no draw by density and has half a
        vote. If the matches do not lie together more than by chance, and the inliers of the best
        hypothesis do not either, the search ends after two rounds. Otherwise it begins anew with
        the next ranking where no two draws agree.
    threshold : float
        Of the draws, pixels. The mask has one of its own, the caller's.
    confidence, max_iters
        As for cv2.
    seed : int
        Where the draws' random numbers start.
    watch : Stopwatch
        Is charged with the time of the draws, and of what is made of them as polish.
    about : (array, float), optional
        What `middle` says of X, if it is known.
    scores : array, shape (n,), optional
        The caller's trust in each match: one more draw in three of the rounds takes its samples in
        this order, whatever the density says. And it decides between motions of like size.
    others : array, shape (k, 4), optional
        Matches that are not searched: with the rest they vote on the best hypotheses, and polish
        the winner.
    other_scores : array, shape (k,), optional
        Their scores.
    majority : bool
        Whether what most matches agree on closely is wanted, as from LMEDS, rather than what as
        many as possible agree on within the threshold. One more draw is at their noise then.

    Returns
    -------
    Consensus or None
        None if no draw found a fundamental matrix.
    """
    # Far from the origin the float32 that cv2 draws with would eat the pixels.
    centre, spread = about or middle(X)
    X = X - centre
    frame = Frame(X, (np.zeros(4), spread))
    rng = np.random.default_rng(abs(seed))
    n_draws = 0
    pool: _Pool | None = None
    reliability, in_vain = np.empty(0), False
    for support in rankings:
        ranking = support.reliability
        order = np.argsort(-ranking, kind="stable")[: np.count_nonzero(ranking >= 0.0)]
        reliable = order[: max(MIN_DRAW, len(order) // 2)]
        weights = np.nan_to_num(ranking, nan=0.5)
        latest = _Pool(X, weights, reliable, threshold, rng, frame, scores)
        made, agreed, hopeless = _fill(
            latest, X, order, support, scores, confidence, max_iters, seed + n_draws, watch
        )
        n_draws += made
        if len(latest):
            pool, reliability, in_vain = latest, ranking, hopeless
        if agreed or hopeless:
            break
    if pool is None:
        return None
    pool.complete()
    if not (in_vain or pool.agrees()):
        pool.optimise()
    agreed, virtue, (planar, by_chance) = pool.agrees_independently(), pool.virtue, pool.planar
    drawn = None
    if majority:
        watch.lap("polish")
        some = _at_most(_MAJORITY_OF, np.flatnonzero(pool.near_best(_NEAR_WIDTH)), rng)
        drawn = draw(
            X[some].astype(np.float32),
            max(_MAJORITY_SIGMAS * pool.noise, _NARROWEST * threshold),
            confidence,
            min(max_iters, _SHORT_DRAW_ITERS),
            seed + n_draws,
        )
        n_draws += 1
        watch.lap("draws")
    G = pool.optimised_best(drawn)
    F = pool.refined(G) if others is None else pool.settled_by(others - centre, other_scores, G)
    # On its way it may have gone over to matches that no other draw has seen.
    agreed = agreed and pool.best_has_inliers_of(F)
    F = shift(-centre[2:]).T @ F @ shift(-centre[:2])
    watch.lap("polish")
    again, remark = "found again by another" if agreed else "found by no other", ""
    if in_vain:
        remark = (
            "; the search ended early: matches lie together only as by chance, and so do the "
            "inliers"
        )
    elif planar > _PLANAR:
        remark = f"; {planar:.1%} of its inliers suit one plane, or a camera that only turned, "
        if by_chance:
            remark += "which leaves F open"
            if agreed:
                # Draws that have the same inliers may have another F.
                agreed, again = False, "its inliers found again by another"
        else:
            remark += f"and F rests on the other {1 - planar:.1%}"
    reason = f"the hypothesis with {virtue} of {n_draws} draws, {again}{remark}"
    return Consensus(F, reliability, tuple(pool.votes.tolist()), n_draws, agreed, reason)


class _Part(NamedTuple):
    """What a draw is from, with its most iterations, and the size that tells it from others."""

    points: Floats
    iters: int
    #: Negative where the best hypothesis so far has chosen the matches.
    size: int
    best_first: bool = False
    #: Whether samples are asked whether they lie on a plane.
    planes: bool = True


def _fill(
    pool: _Pool,
    X: Floats,
    order: Ints,
    support: Support,
    scores: Floats | None,
    confidence: float,
    max_iters: int,
    seed: int,
    watch: Stopwatch,
) -> tuple[int, bool, bool]:
    """Make rounds of draws until two of them agree, or it is hopeless.

    Returns how many draws it took, whether two agree, and whether it is hopeless: the matches do
    not lie together more than by chance, and neither do the inliers of the best hypothesis.
    """
    points = X[order].astype(np.float32)
    # A half of fewer could not be told from a quarter, which is `MIN_DRAW` at least.
    smallest = max(_SMALLEST, 3 * MIN_DRAW / len(order))
    shrunk = float(np.clip(support.share_right / _MOSTLY_RIGHT, smallest, 1.0))
    n_draws, agreed, asked_rest = 0, False, False
    for number, fractions in enumerate(ROUNDS, start=1):
        parts = []
        for fraction in fractions:
            by_score = fraction == BY_SCORE
            if by_score and scores is not None:
                part = X[np.argsort(-scores, kind="stable")].astype(np.float32)
            elif fraction == NEAR and len(pool):
                part = points[pool.near_best(_NEAR_WIDTH)[order]]
            elif fraction == SPREAD:
                part = points[pool.spread(order, shrunk)]
            elif fraction > 0.0:
                wanted = fraction * shrunk if fraction < 1.0 else 1.0
                part = points[: max(MIN_DRAW, int(wanted * len(order)))]
            else:
                continue
            share = min(max(len(part) / len(order), 0.25), 1.0)
            iters = min(max_iters, int(MAX_DRAW_ITERS * np.sqrt(0.25 / share)))
            size = -len(part) if fraction == NEAR else len(part)
            planes = fraction <= 0.0 or len(part) > _DENSE * len(order)
            parts.append(_Part(part, iters, size, by_score, planes))
        _draw(pool, parts, confidence, seed + n_draws, watch)
        n_draws += len(parts)
        agreed = pool.agrees()
        if agreed and not asked_rest:
            asked_rest = True
            rest = ~pool.near_best(_EXPLAINED_WIDTH)[order]
            better = rest[: max(MIN_DRAW // 2, int(support.share_right * len(order)) // 2)]
            much = better.mean() > _UNEXPLAINED
            if much and np.count_nonzero(rest) >= MIN_DRAW:
                short = _Part(points[rest], min(max_iters, _SHORT_DRAW_ITERS), 0)
                _draw(pool, [short], confidence, seed + n_draws, watch)
                n_draws += 1
                agreed = pool.agrees()
        if agreed:
            break
        if not support.beyond_chance and number == _ROUNDS_BY_CHANCE and not pool.coherent():
            return n_draws, False, True
    return n_draws, agreed, False


def _draw(pool: _Pool, parts: list[_Part], confidence: float, seed: int, watch: Stopwatch) -> None:
    """Draw a hypothesis from each part; those that are found join the pool."""
    found, sizes = [], []
    for number, part in enumerate(parts):
        F = draw(
            part.points,
            pool.working,
            confidence,
            part.iters,
            seed + number,
            best_first=part.best_first,
            planes=part.planes,
        )
        if F is not None:
            found.append(F)
            sizes.append(part.size)
    watch.lap("draws")
    if found:
        join = pool.add if len(pool) else pool.begin
        join(np.stack(found), sizes)
    watch.lap("polish")


class _Pool:
    """Polished hypotheses, their residuals and votes.

    ``working`` is the threshold of draws and votes, pixels: the one given, or a part of it where
    the noise is smaller.
    """

    def __init__(
        self,
        X: Floats,
        reliability: Floats,
        reliable: Ints,
        threshold: float,
        rng: np.random.Generator,
        frame: Frame | None = None,
        scores: Floats | None = None,
    ) -> None:
        self.threshold = threshold
        self.working = threshold
        self.votes: Floats = np.empty(0)
        #: Index of the best hypothesis.
        self.best = 0
        #: The matches that are not on a dominant plane, if there is one.
        self._off_plane: Bools | None = None
        #: The matches on the plane that most inliers suit, dominant or not.
        self._planar = np.zeros(len(X), dtype=bool)
        self._X = X
        #: What a match counts where matches are counted.
        self._share = (1.0 / _claimants(X)).astype(np.float32)
        self._reliability = reliability = reliability * self._share
        self._reliable = reliable
        self._scores = scores
        self._rng = rng
        self._frame = frame or Frame(X)
        # What lies far out must not make the cells so large that all others share one.
        reach = FAR / self._frame.scale
        self._ballot = _Ballot(X.clip(-reach, reach), reliability)
        self._G: Floats = np.empty((0, 3, 3))
        self._squared: Floats = np.empty((0, len(X)))
        #: Inliers of each hypothesis as ones, in a type that can be multiplied fast, (m, n).
        self._inliers: Floats = np.empty((0, len(X)), dtype=np.float32)
        self._sizes: Floats = np.empty(0)

    def __len__(self) -> int:
        return len(self._G)

    def begin(self, F: Floats, sizes: ArrayLike) -> None:
        """Add the first hypotheses, and narrow the working threshold to the best one's noise."""
        # One step tells the noise; those at the right width follow.
        G = polish(self._frame, self._frame.enter(F), [_POLISH_WIDTH * self.working])
        squared = self._frame.sampson(G)
        best = self._ballot.count(squared, self.working).argmax()
        scale = _SIGMAS * self._noise_of(squared[best])
        self.working = max(min(scale, self.threshold), _SMALLEST_SCALE * self.threshold)
        self._join(G, sizes)

    def add(self, F: Floats, sizes: ArrayLike) -> None:
        """Polish hypotheses (m, 3, 3), in pixels, drawn from ``sizes`` matches, and count votes."""
        self._join(self._frame.enter(F), sizes)

    def _join(self, G: Floats, sizes: ArrayLike) -> None:
        G = polish(self._frame, G, [_POLISH_WIDTH * self.working] * _POLISH_STEPS)
        self._append(G, *self._poll(G), sizes)

    def _append(self, G: Floats, squared: Floats, votes: Floats, sizes: ArrayLike) -> None:
        self._G = np.concatenate([self._G, G])
        self._squared = np.concatenate([self._squared, squared])
        self._inliers = np.concatenate([self._inliers, self._inliers_by(squared)])
        self.votes = np.concatenate([self.votes, votes])
        self._sizes = np.concatenate([self._sizes, sizes])
        self.best = self._for_more(self._elected(self.votes, self._squared, self.working))

    def _inliers_by(self, squared: Floats) -> Floats:
        return (squared < self.working**2).astype(np.float32)

    def _elected(
        self,
        votes: Floats,
        squared: Floats,
        width: float,
        deviations: float = _CLEARLY,
        rows: Ints | slice = slice(None),
    ) -> int:
        """Index of the most votes (m,), or of nearly as many and more matches off a dominant plane.

        ``squared`` residuals (m, k) are of the given rows; ``deviations`` tell how clearly more.
        """
        elected = int(votes.argmax())
        if self._off_plane is None:
            return elected
        nearly = np.flatnonzero(~(votes < _NEARLY * votes[elected]))
        gain = _gain(squared[nearly], squared[elected], width) * self._share[rows]
        lead = _lead(gain[:, self._off_plane[rows]], deviations)
        lead[gain.sum(axis=1) < 0.0] = -np.inf
        # Its own lead is 0.
        return int(nearly[lead.argmax()]) if lead.max() > 0.0 else elected

    @cached_property
    def _trust(self) -> Floats | None:
        """The rank of each match by score, where there are scores."""
        return None if self._scores is None else ranks(self._scores)

    def _for_more(self, elected: int) -> int:
        """Index of another motion that clearly more matches suit than the elected; or of that.

        With scores, of motions of like size, it is the one that clearly better matches suit.

        Votes count crowds less, and a crowd may be the larger part: an object before a background
        that has a motion, or none, of its own. What is spread then leaves F free to suit a part of
        the object as well.
        """
        apart = ~_alike(self._inliers, self._inliers[elected], _SAME_BASIN)
        numbers = times_vector(self._inliers, self._share)
        rivals = np.flatnonzero(apart & (numbers > _AT_LEAST * numbers[elected]))
        if not len(rivals):
            return elected
        squared = self._squared[[elected, *rivals]]
        noise = np.array([_noise(row, self.threshold) for row in squared])
        width = _RIVAL_SIGMAS * np.maximum(noise, max(noise[0], _NARROWEST * self.threshold))
        gain = _gain(squared[1:], squared[0], width[1:, None]) * self._share
        if self._trust is not None:
            gain[numbers[rivals] < numbers[elected] / _AT_LEAST] *= self._trust
        lead = _lead(gain, _CLEARLY)
        return int(rivals[lead.argmax()]) if lead.max() > 0.0 else elected

    def _poll(self, G: Floats) -> tuple[Floats, Floats]:
        """Squared residuals (m, n) of hypotheses and the votes for them (m,)."""
        squared = self._frame.sampson(G)
        return squared, self._ballot.count(squared, self.working) * _credit(G)

    def near_best(self, width: float) -> Bools:
        """Mark the matches within ``width`` working thresholds of the best hypothesis."""
        return np.asarray(self._squared[self.best] < (width * self.working) ** 2)

    @property
    def noise(self) -> float:
        """Robust standard deviation of the best hypothesis's residuals, pixels."""
        return self._noise_of(self._squared[self.best])

    def _noise_of(self, squared: Floats) -> float:
        return _noise(squared[self._reliable], self.threshold)

    def spread(self, order: Ints, shrunk: float) -> Ints:
        """Places in an order of reliability of a ``shrunk`` half of it, in turn from each cell."""
        top = order[: max(MIN_DRAW, int(_SPREAD_OF * shrunk * len(order)))]
        turn = turns(self._ballot.cells[0, top])
        return np.argsort(turn, kind="stable")[: max(MIN_DRAW, 2 * len(top) // 3)]

    def coherent(self) -> bool:
        """Whether the inliers of the best hypothesis stay neighbours, as those of a scene do."""
        return len(self) > 0 and coherence(self._X[self.near_best(1.0)]) > COHERENT

    def complete(self) -> None:
        """Where a plane has most inliers of the best hypothesis, add others of that plane."""
        width = _PLANE_WIDTH * self.working
        inliers = self.near_best(1.0)
        try:
            G, off_plane = plane_and_parallax(
                self._frame, self._G[self.best], inliers, width, self._rng
            )
        except np.linalg.LinAlgError:
            return
        self._planar = ~off_plane
        if len(G):
            self._off_plane = off_plane
            self._join(G, np.zeros(len(G)))

    def optimise(self) -> None:
        """Optimise the best hypotheses locally; what comes of them joins."""
        for start in self._finalists(_LOCAL_STARTS_IN_DOUBT, _SAME_BASIN):
            before = self._G[start]
            G = self._optimised(
                before, self._squared[start], self.working, *_LOCAL_SAMPLES_IN_DOUBT
            )
            if G is not before:
                self._append(G[None], *self._poll(G[None]), [0])

    def _optimised(
        self,
        G: Floats,
        squared: Floats,
        width: float,
        n_samples: int,
        n_polished: int,
        others: Floats | None = None,
    ) -> Floats:
        """Step from a hypothesis on samples of its near matches, polish the best, and choose one.

        Or one of the ``others`` (m, 3, 3). The inner sampling of Chum, Matas and Kittler, "Locally
        optimized RANSAC" (2003), with the vote as its score. The matches it is not far from polish
        and vote, some of many. Where two samples of eight are not near, the same matrix comes back.
        """
        reached = np.flatnonzero(squared < (_LOCAL_REACH * width) ** 2)
        rows = _at_most(_LOCAL_MATCHES, reached, self._rng)
        near = squared[rows] < (_LOCAL_WIDTH * width) ** 2
        size = min(_LOCAL_SIZE, int(np.count_nonzero(near)) // 2)
        if size < 8:
            return G
        keys = np.where(near, self._rng.random((n_samples, len(near))), np.inf)
        samples = keys < np.partition(keys, size, axis=1)[:, size, None]
        part = self._frame.part(rows)
        several = polish(part, G[None], [np.inf], samples=samples)
        # Of so many, in a hurry: without cells and cameras, and at the largest width alone.
        widest = _VOTE_WIDTHS[-1] * width
        votes = np.maximum(1.0 - part.sampson(several) / widest**2, 0.0)
        votes = times_vector(votes, self._reliability[rows])
        several = several[np.argsort(-votes, kind="stable")[:n_polished]]
        several = np.concatenate([G[None], several, *([] if others is None else [others])])
        several = polish(part, several, [_POLISH_WIDTH * width] * _LOCAL_STEPS)
        squared = part.sampson(several)
        votes = self._ballot.part(rows).count(squared, width) * _credit(several)
        return np.asarray(several[self._elected(votes, squared, width, _CLEARLY_OF_MANY, rows)])

    @property
    def planar(self) -> tuple[float, bool]:
        """Share of the best hypothesis's inliers on a plane; whether the rest may be by chance."""
        planar = self._planar[self.near_best(1.0)]
        if len(planar) < FEWEST:
            return 0.0, False
        few, share = _BY_CHANCE
        n_off = len(planar) - np.count_nonzero(planar)
        by_chance = n_off <= few + share * np.count_nonzero(~self._planar)
        return float(planar.mean()), bool(by_chance)

    @property
    def virtue(self) -> str:
        """What the best hypothesis has most of."""
        if self.best == self.votes.argmax():
            return "the most votes"
        if self.best == self._elected(self.votes, self._squared, self.working):
            more = "more matches near it, off a dominant plane,"
        elif self._scores is None:
            more = "more matches near it"
        else:
            more = "more, or better scored, matches near it"
        return f"{more} than the one with the most votes"

    def agrees_independently(self) -> bool:
        """Whether draws that no hypothesis had a say in agree, off a dominant plane as well."""
        off_plane = self._off_plane
        return self.agrees(independently=True) and (
            off_plane is None or self.agrees(among=off_plane, independently=True)
        )

    def agrees(
        self,
        among: Bools | None = None,
        independently: bool = False,
    ) -> bool:
        """Whether draws from two different parts have the best hypothesis's inliers."""
        if len(self) < 2:
            return False
        inliers = self._inliers if among is None else self._inliers[:, among]
        alike = _alike(inliers, inliers[self.best], _AGREEMENT)
        sizes = self._sizes if independently else np.abs(self._sizes)
        sizes = sizes[alike & (sizes > 0)]
        return len(sizes) > 1 and bool(sizes.max() >= _DISTINCT * sizes.min())

    def best_has_inliers_of(self, F: Floats) -> bool:
        """Whether a matrix, in pixels, has the best hypothesis's inliers."""
        inliers = self._inliers_by(self._frame.sampson(self._frame.enter(F[None])))
        return bool(_alike(inliers, self._inliers[self.best], _AGREEMENT)[0])

    def optimised_best(self, drawn: Floats | None = None) -> Floats:
        """Optimise the best hypothesis at the width of its own residuals; (3, 3), in the frame.

        Or one ``drawn`` at this width, in pixels, if that makes a better one.
        """
        width = _LOCAL_SIGMAS * max(self.noise, _NARROWEST * self.threshold)
        others = None if drawn is None else self._frame.enter(drawn[None])
        return self._optimised(
            self._G[self.best], self._squared[self.best], width, *_LOCAL_SAMPLES, others
        )

    def refined(self, G: Floats) -> NDArray[np.float64]:
        """Take the last steps from a matrix in the frame; in pixels, (3, 3).

        Of many matches polish it before, as long as it moves.
        """
        squared = self._frame.sampson(G[None])[0]
        if len(squared) > _MANY:
            G = self._settled(G, squared)
            squared = self._frame.sampson(G[None])[0]
        noise = self._noise_of(squared)
        sigma = max(noise, _NARROWEST * self.threshold)
        doubt = _doubt(squared, sigma, self._reliability)
        G = refine(self._frame, G, sigma, doubt, noise, _REFINE_STEPS)
        return np.ascontiguousarray(self._frame.leave(G[None])[0])

    def _settled(self, G: Floats, squared: Floats) -> Floats:
        noise = self._noise_of(squared)
        width = max(_STRIDE_SIGMAS * noise, _NARROWEST * self.threshold)
        end = step = G[None]
        for _ in range(_STRIDES):
            step = polish(self._frame, end, [width])
            move = step - end
            if np.linalg.norm(move) < _AT_REST * noise * self._frame.scale:
                break
            end = end + _STRIDE * move
        return np.asarray(step[0])

    def _finalists(self, most: int, overlap: float) -> list[int]:
        """Return the indices of the best hypotheses whose inliers overlap by less."""
        ranking = np.argsort(-self.votes, kind="stable").tolist()
        # What had more votes, and lost, is out.
        ranking = ranking[ranking.index(self.best) :]
        chosen: list[int] = []
        for i in ranking:
            if not _alike(self._inliers[chosen], self._inliers[i], overlap).any():
                chosen.append(i)
            if len(chosen) == most:
                break
        return chosen

    def settled_by(self, others: Floats, scores: Floats | None, G: Floats) -> NDArray[np.float64]:
        """Let more matches, all equal, choose among the rivals of G; take the last steps with them.

        G stands for the best hypothesis. In pixels, (3, 3).
        """
        rivals = self._finalists(_FINALISTS, _AGREEMENT)[1:]
        X = np.concatenate([self._X, others])
        if self._scores is not None and scores is not None:
            scores = np.concatenate([self._scores, scores])
        weights = np.ones(len(X))
        wider = _Pool(X, weights, self._reliable, self.threshold, self._rng, scores=scores)
        wider.working = self.working
        hypotheses = np.concatenate([G[None], self._G[rivals]])
        entered = wider._frame.enter(self._frame.leave(hypotheses))
        wider._append(entered, *wider._poll(entered), np.zeros(len(entered)))
        return wider.refined(entered[wider.best])


def _at_most(size: int, rows: Ints, rng: np.random.Generator) -> Ints:
    """Draw ``size`` of the rows, or take all of fewer."""
    return rows if len(rows) <= size else rng.choice(rows, size, replace=False, shuffle=False)


def _gain(squared: Floats, one: Floats, width: float | Floats) -> Floats:
    """How much nearer matches are to hypotheses (m, n) than to one (n,); 1 at most, 0 if far."""
    near, before = (np.maximum(1.0 - s / width**2, 0.0) for s in (squared, one))
    return np.asarray(near - before)


def _lead(gain: Floats, deviations: float) -> Floats:
    """By how much sums of gains (m, n) exceed so many standard deviations of chance, (m,)."""
    return np.asarray(gain.sum(axis=1) - deviations * np.sqrt((gain * gain).sum(axis=1)))


def _alike(inliers: Floats, one: Floats, overlap: float) -> Bools:
    """Which of some inlier sets (m, n) agree with another one (n,)."""
    common = times_vector(inliers, one)
    return np.asarray(common >= overlap * (inliers.sum(axis=1) + one.sum() - common))


def _claimants(X: Floats) -> Floats:
    """Count the matches that share a point with each match, (n,): one of them is right at most.

    An F whose epipole is that point suits them all. Told where a point has a good part of the
    matches, such as tracks that were lost and left at a corner; else all ones.
    """
    total = np.ones(len(X))
    for points in (X[:, :2], X[:, 2:]):
        place = place_numbers(points)
        if place is not None:
            total = np.maximum(total, np.bincount(place)[place])
    return total


def _credit(G: Floats) -> Floats:
    """How well each hypothesis suits ordinary cameras: what its votes are multiplied by."""
    # The root: odd pixels or a cropped image should not decide.
    return np.sqrt(essential_ratio(G))


def _doubt(squared: Floats, sigma: float, reliability: Floats) -> Floats:
    """How much more likely each match is wrong than right, if its residual is 0, (n,).

    Wrong matches are as frequent near the lines as beside them, where they are counted; the others
    near the lines are right. Either is counted among matches of like reliability.
    """
    group = np.minimum(reliability * _GROUPS, _GROUPS - 1).astype(np.intp)

    def count(marked: Bools) -> Ints:
        return np.bincount(group[marked], minlength=_GROUPS)

    first, last = _BESIDE
    beside = (squared > (first * sigma) ** 2) & (squared < (last * sigma) ** 2)
    # Per sigma, and never quite none.
    wrong = (count(beside) + 0.5) / (last - first)
    right = np.maximum(count(squared < (_NEARBY * sigma) ** 2) - _NEARBY * wrong, 0.25)
    return np.asarray((wrong / (_PEAK * right))[group])


def _noise(squared: Floats, threshold: float) -> float:
    """Robust standard deviation of the inliers' residuals, pixels.

    1.4826 times the median of the residuals below the threshold, then of those below 2.5 of these
    standard deviations, four times, by when it has settled; with Rousseeuw and Leroy's factor for
    few residuals, which a fit has made smaller.
    """
    r = np.sqrt(np.sort(squared))
    cut, sigma, below = threshold, 0.4 * threshold, 0
    for _ in range(4):
        below = int(r.searchsorted(cut))
        if below < 8:
            break
        sigma = 1.4826 * float(r[below // 2])
        cut = min(_WIDEST * threshold, 2.5 * sigma)
    return sigma * (1.0 + 5.0 / max(below - 7, 5))


class _Ballot:
    """Votes that count reliable matches more, and crowds less.

    A match votes ``reliability * max(0, 1 - r^2 / width^2)``. Matches of a crowd are not
    independent witnesses, so the votes of each cell of a grid over either image are added up and
    their square root counts. The sum is taken over several widths, since noise differs from pair
    to pair.
    """

    def __init__(self, X: Floats, reliability: Floats) -> None:
        self._reliability = reliability
        self.cells = np.stack([_cells(X[:, :2]), _cells(X[:, 2:]) + _GRID * _GRID])
        self._order, self._starts = _groups(self.cells)

    def part(self, rows: Ints) -> _Ballot:
        """Return the same ballot, holding only the matches of the given rows."""
        part = copy(self)
        part._reliability = self._reliability[rows]
        part.cells = self.cells[:, rows]
        part._order, part._starts = _groups(part.cells)
        return part

    def count(self, squared: Floats, working: float) -> Floats:
        """Votes for each hypothesis from its squared residuals (m, n), (m,)."""
        widths = (_VOTE_WIDTHS * working)[:, None, None]
        votes = squared / (-widths * widths)
        votes += 1.0
        np.maximum(votes, 0.0, out=votes)
        votes *= self._reliability
        votes = np.add.reduceat(votes.take(self._order, axis=-1), self._starts, axis=-1)
        return np.asarray(np.sqrt(votes).sum(axis=(0, -1)))


def _cells(points: Floats) -> NDArray[np.uint16]:
    """Give each point the number of its grid cell."""
    columns = np.ascontiguousarray(points.T)
    columns = columns - columns.min(axis=1, keepdims=True)
    side = max(float(columns.max()), 1e-9)
    # Of so small integers numpy sorts by their digits.
    place = np.minimum(columns * (_GRID / side), _GRID - 1).astype(np.uint16)
    return np.asarray(place[0] * _GRID + place[1])


def _groups(cells: NDArray[np.uint16]) -> tuple[Ints, Ints]:
    """Rows sorted by cell, and where each starts; of k grids (k, n) without a number in common."""
    order, starts = grouped(cells.ravel())
    return order % cells.shape[1], starts
