"""Draw hypotheses on the dense part, polish them on all matches, pick one by a weighted vote."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cv_densityf._engine import draw
from cv_densityf._epipolar import Frame, eight_point, point_line_squared, polish
from cv_densityf._stopwatch import Stopwatch

Floats = NDArray[np.floating]
Ints = NDArray[np.intp]

#: Draws from the matches within a few thresholds of the best hypothesis so far, dense or not.
NEAR = 0.0
#: Shares of the matches, most reliable first, that hypotheses are drawn from, round by round.
ROUNDS = ((0.25, 0.5), (1.0, NEAR), (0.125, NEAR), (0.5, NEAR), (0.25, 1.0))
_NEAR_WIDTH = 8.0
#: Matches a draw gets at least: fewer crowd on too little of the image to fix F.
MIN_DRAW = 40
#: cv2's iterations in one draw from a quarter of the matches, and less from larger, less pure
#: parts. More find no better F; several short draws do.
MAX_DRAW_ITERS = 1000
#: Two hypotheses agree when their inlier sets have this intersection over union.
_AGREEMENT = 0.97
#: Widths of the vote, in units of the working threshold.
_VOTE_WIDTHS = np.array([0.3, 0.5, 0.8, 1.3])
#: Votes saturate within a cell of this many to the longer side of each image.
_GRID = 16
#: Width of the weights in the polish, in units of the working threshold.
_POLISH_WIDTH = 0.7
_POLISH_STEPS = 3
#: The winner's last steps take weights of this many robust standard deviations: nearly all of what
#: least squares gets out of normal noise, and little of what heavier tails put in.
_REFINE_SIGMAS = 3.0
_REFINE_STEPS = 3
_NARROWEST = 0.1
#: A working threshold of this many robust standard deviations of the residuals lets nearly every
#: inlier vote; it never exceeds the caller's threshold and never falls below a part of it.
_SIGMAS = 4.0
_SMALLEST_SCALE = 0.25
#: Eight-point samples solved at a time.
_BATCH = 64


@dataclass(frozen=True, slots=True)
class Consensus:
    """The hypothesis that won, and how."""

    F: NDArray[np.float64]
    votes: tuple[float, ...]
    n_draws: int
    reason: str


def search(
    X: Floats,
    reliability: Floats,
    *,
    threshold: float,
    confidence: float,
    max_iters: int,
    seed: int,
    watch: Stopwatch,
) -> Consensus | None:
    """Search for the fundamental matrix that the reliable and well spread matches vote for.

    Rounds of two draws on nested sets of the most reliable matches, on all of them, and on what
    the best hypothesis so far leaves near its epipolar lines: a nearly right F has the right one's
    inliers there. Each hypothesis is polished on all matches. The search ends when a second, independent draw arrives
    at the winner's inliers, or after `ROUNDS`.

    Parameters
    ----------
    X : array, shape (n, 4)
        Finite matches.
    reliability : array, shape (n,)
        Weight of each match's vote, in [0, 1]; also the order of the draws.
    threshold, confidence, max_iters
        As for cv2, threshold in pixels.
    seed : int
        Where the draws' random numbers start.
    watch : Stopwatch
        Is charged with the time of draws, polish and vote.

    Returns
    -------
    Consensus or None
        None if no draw found a fundamental matrix.
    """
    n = len(X)
    order = np.argsort(-reliability, kind="stable")
    points = X[order].astype(np.float32)
    frame = Frame(X)
    ballot = _Ballot(X, reliability)
    reliable = order[: max(MIN_DRAW, n // 2)]
    working = threshold
    G: Floats = np.empty((0, 3, 3))
    n_draws = 0
    agreed = False
    for number, fractions in enumerate(ROUNDS):
        found = []
        for fraction in fractions:
            if fraction == NEAR:
                if len(G) == 0:
                    continue
                part = points[squared[best, order] < (_NEAR_WIDTH * working) ** 2]
            else:
                part = points[: max(MIN_DRAW, int(n * fraction))]
            share = max(len(part) / n, 0.25)
            iters = min(max_iters, int(MAX_DRAW_ITERS * np.sqrt(0.25 / share)))
            F = draw(part, working, confidence, iters, seed + n_draws)
            n_draws += 1
            if F is not None:
                found.append(F)
        watch.lap("draws")
        if found:
            new = polish(
                frame, frame.enter(np.stack(found)), [_POLISH_WIDTH * working] * _POLISH_STEPS
            )
            G = np.concatenate([G, new[np.isfinite(new).all(axis=(1, 2))]])
            watch.lap("polish")
        if len(G) == 0:
            continue
        squared = frame.sampson(G)
        votes = ballot.count(squared, working)
        best = int(votes.argmax())
        if number == 0:
            scale = _SIGMAS * _noise(squared[best, reliable], threshold)
            scale = min(max(scale, _SMALLEST_SCALE * threshold), threshold)
            if scale < 0.9 * threshold:
                working = scale
                G = polish(frame, G, [_POLISH_WIDTH * working] * 3)
                squared = frame.sampson(G)
                votes = ballot.count(squared, working)
                best = int(votes.argmax())
        inliers = (squared < working * working).astype(np.float32)
        common = inliers @ inliers[best]
        union = inliers.sum(axis=1) + common[best] - common
        watch.lap("vote")
        agreed = int(np.count_nonzero(common >= _AGREEMENT * union)) > 1
        if agreed:
            break
    if len(G) == 0:
        return None
    winner = _refine(frame, G[best : best + 1], squared[best], reliable, threshold)
    watch.lap("polish")
    return Consensus(
        F=np.ascontiguousarray(frame.leave(winner)[0]),
        votes=tuple(votes.tolist()),
        n_draws=n_draws,
        reason=(f"two of {n_draws} draws agree" if agreed else f"best vote among {n_draws} draws"),
    )


def _noise(squared: Floats, threshold: float) -> float:
    """Robust standard deviation of the residuals that lie below the threshold, pixels."""
    r = np.sqrt(squared)
    cut, sigma = threshold, 0.4 * threshold
    for _ in range(4):
        below = r[r < cut]
        if len(below) < 8:
            break
        sigma = 1.4826 * float(np.median(below))
        cut = min(threshold, 2.5 * sigma)
    return sigma


def _refine(frame: Frame, G: Floats, squared: Floats, reliable: Ints, threshold: float) -> Floats:
    """Polish the winner at the width of its own residuals on the reliable matches."""
    for _ in range(_REFINE_STEPS):
        width = _REFINE_SIGMAS * _noise(squared[reliable], threshold)
        G = polish(frame, G, [max(width, _NARROWEST * threshold)])
        squared = frame.sampson(G)[0]
    return G


class _Ballot:
    """Votes that count reliable matches more, and crowds less.

    A match votes ``reliability * max(0, 1 - r^2 / width^2)``. Matches of a crowd are not
    independent witnesses, so the votes of each cell of a grid over either image are added up and
    their square root counts. The sum is taken over several widths, since noise differs from pair
    to pair.
    """

    def __init__(self, X: Floats, reliability: Floats) -> None:
        self._reliability = reliability
        self._cells = [_cells(X[:, :2]), _cells(X[:, 2:])]

    def count(self, squared: Floats, working: float) -> Floats:
        """Votes for each hypothesis from its squared residuals (m, n), (m,)."""
        widths = (_VOTE_WIDTHS * working)[:, None, None]
        votes = squared[None] / (-widths * widths)
        votes += 1.0
        np.maximum(votes, 0.0, out=votes)
        votes *= self._reliability
        total = np.zeros(len(squared))
        for order, starts in self._cells:
            total += np.sqrt(np.add.reduceat(votes[..., order], starts, axis=-1)).sum(axis=(0, -1))
        return total


def _cells(points: Floats) -> tuple[Ints, Ints]:
    """Rows sorted by grid cell, and where each occupied cell starts."""
    low = points.min(axis=0)
    side = max(float((points.max(axis=0) - low).max()), 1e-9)
    column = np.minimum((points - low) * (_GRID / side), _GRID - 1).astype(np.intp)
    cell = column[:, 0] * _GRID + column[:, 1]
    order = np.argsort(cell, kind="stable")
    cell = cell[order]
    return order, np.flatnonzero(np.concatenate([[True], cell[1:] != cell[:-1]]))


def eight_point_ransac(
    X: Floats, *, threshold: float, confidence: float, max_iters: int, seed: int
) -> Consensus | None:
    """RANSAC with samples of eight matches, as step 5 of Wu and Wan has it.

    The best sample's matrix is returned as it is, without a fit to its inliers. The number of
    samples k follows ``1 - confidence = (1 - (d / n)^8)^k`` for d inliers among n matches, and a
    match is an inlier if it is within ``threshold`` of its epipolar line in both images.

    Parameters
    ----------
    X : array, shape (n, 4)
        Finite matches.
    threshold : float
        Pixels.
    confidence : float
        Probability of one sample without outliers.
    max_iters : int
        Most samples.
    seed : int
        Of the samples.

    Returns
    -------
    Consensus or None
        None with fewer than eight matches, or if no sample has eight inliers.
    """
    n = len(X)
    if n < 8:
        return None
    rng = np.random.default_rng(seed)
    best, most, drawn = None, 7, 0
    needed: float = max_iters
    while drawn < needed:
        size = min(_BATCH, max_iters - drawn)
        samples = rng.permuted(np.broadcast_to(np.arange(n), (size, n)), axis=1)[:, :8]
        for F in eight_point(X[samples]):
            drawn += 1
            inliers = int(np.count_nonzero(point_line_squared(F, X) <= threshold * threshold))
            if inliers > most:
                best, most = F, inliers
                needed = min(max_iters, _samples_needed(inliers / n, confidence))
            if drawn >= needed:
                break
    if best is None:
        return None
    reason = f"{most} of the {n} matches that passed the paper's rule agree"
    return Consensus(F=best, votes=(float(most),), n_draws=drawn, reason=reason)


def _samples_needed(inlier_ratio: float, confidence: float) -> float:
    """Samples of eight until one is clean with the given confidence; at least one."""
    clean = min(inlier_ratio**8, 1.0 - 1e-12)
    return max(1.0, np.log1p(-confidence) / np.log1p(-clean))
