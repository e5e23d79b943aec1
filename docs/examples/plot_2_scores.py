"""
Scores from your matcher
========================

Matchers rate their matches: SIFT by the ratio of the two nearest descriptors, learned ones by a
confidence. The usual thing is to cut at some value and forget the rest. Pass the ratings as
``scores=`` instead: nothing is lost, and hard pairs get easier.
"""

# %%
# Middlebury's "motorcycle" once more, matched as carelessly as possible: every feature with its
# nearest in the other image, neither ratio test nor mutual check. The truth tells how much a score
# is worth. A good deal, but no cut separates right from wrong.

import cv2
import matplotlib.pyplot as plt
import numpy as np

from cv_densityf import estimate_fundamental, match_images
from cv_densityf.datasets import motorcycle

pair = motorcycle()
matches = match_images(pair.image1, pair.image2, mutual=False)
lines = cv2.computeCorrespondEpilines(matches.points1, 1, pair.F)[:, 0]
distance = np.abs((lines * np.c_[matches.points2, np.ones(len(matches))]).sum(axis=1))
right = distance < 1

fig, ax = plt.subplots(figsize=(8, 3), layout="constrained")
bins = np.linspace(0, 1, 41)
for rows, name, color in ((~right, "wrong", "#D55E00"), (right, "right", "#0072B2")):
    ax.hist(matches.scores[rows], bins, color=color, alpha=0.65, label=f"{name} ({rows.sum()})")
ax.set(xlabel="score: 1 - ratio of the two nearest distances", ylabel="matches", xlim=(0, 1))
ax.spines[["top", "right"]].set_visible(False)
ax.legend(frameon=False)

# %%
# To make it hard, keep all wrong matches and only some of the right ones, until one in five, ten
# or twenty is right, ten times each. cv2's own way to use the order of the scores is PROSAC, which
# takes the best match first.


def thinned(share, seed):
    """Rows with all wrong matches and so many right ones that ``share`` are right, shuffled."""
    rng = np.random.default_rng(seed)
    n_right = round(share / (1 - share) * (~right).sum())
    kept = rng.choice(np.flatnonzero(right), n_right, replace=False)
    return rng.permutation(np.concatenate([np.flatnonzero(~right), kept]))


def usac_accurate(points1, points2, scores):
    return cv2.findFundamentalMat(points1, points2, cv2.USAC_ACCURATE, *numbers)[0]


def usac_prosac(points1, points2, scores):
    best = np.argsort(-scores)
    return cv2.findFundamentalMat(points1[best], points2[best], cv2.USAC_PROSAC, *numbers)[0]


def density(points1, points2, scores):
    return estimate_fundamental(points1, points2).F


def density_and_scores(points1, points2, scores):
    return estimate_fundamental(points1, points2, scores=scores).F


numbers = (1.0, 0.999, 5000)  # threshold, confidence, iterations, as estimate_fundamental has them
ways = {
    "cv2.USAC_ACCURATE": (usac_accurate, "#D55E00"),
    "cv2.USAC_PROSAC, best first": (usac_prosac, "#E69F00"),
    "cv_densityf": (density, "#56B4E9"),
    "cv_densityf, scores=": (density_and_scores, "#0072B2"),
}
shares = [0.2, 0.1, 0.05]
fig, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained", sharex=True, sharey=True)
for ax, share in zip(axes, shares, strict=True):
    subsets = [thinned(share, seed) for seed in range(10)]
    for row, (way, color) in enumerate(ways.values()):
        found = [way(*(a[s] for a in (matches.points1, matches.points2, matches.scores)))
                 for s in subsets]  # fmt: skip
        errors = [np.inf if F is None else pair.error(F) for F in found]
        ax.plot(errors, np.full(10, row), "o", color=color, ms=6, alpha=0.6, mew=0)
        ax.plot(np.median(errors), row, "|", color=color, ms=26, mew=3)
    ax.set(title=f"one in {1 / share:.0f} is right", xscale="log", xlabel="mean error, pixels")
    ax.xaxis.set_major_formatter("{x:g}")
    ax.spines[["top", "right"]].set_visible(False)
axes[0].set(yticks=range(len(ways)), yticklabels=ways, ylim=(-0.5, len(ways) - 0.5))
axes[0].invert_yaxis()
plt.show()
# sphinx_gallery_thumbnail_number = 2

# %%
# Only the order of the scores counts, so any monotonic rating will do, and it need not be a
# probability. In cv2's call it is one more keyword,
# ``findFundamentalMat(points1, points2, method, 1.0, 0.999, 5000, scores=scores)``; the estimators
# take it as ``fit(X, sample_weight=scores)``.
