"""
Many pairs at once
==================

A photo collection is thousands of pairs. Some show nothing in common, and some are broken.
:func:`cv_densityf.estimate_many` works through them on all cores, in order, and makes every failure
a result of its own, so that no pair ends the run of a night. What remains is to tell which results
mean something.
"""

# %%
# Eighty made-up pairs, from ones in which half of the matches are right to ones with hardly any,
# and two that no loop likes: no matches at all, and arrays of different lengths.

import matplotlib.pyplot as plt
import numpy as np

from cv_densityf import coherence, epipolar_distance, estimate_many
from cv_densityf.datasets import two_view_scene

shares = np.geomspace(0.5, 0.03, 80)
scenes = [two_view_scene(500, inlier_ratio=s, random_state=i) for i, s in enumerate(shares)]


def load_pairs():
    """A generator, so that not all pairs have to be in memory."""
    for scene in scenes:
        yield scene.points1, scene.points2
    yield np.empty((0, 2)), np.empty((0, 2))
    yield scenes[0].points1, scenes[1].points2[:-1]


estimates = list(estimate_many(load_pairs(), n_jobs=2))
for estimate in estimates[-2:]:
    print(bool(estimate), "-", estimate.reason)

# %%
# A fundamental matrix always has some inliers, since wrong matches lie near its lines by chance.
# Inliers of a common scene keep their neighbours from one image to the other, which chance ones do
# not: :func:`cv_densityf.coherence` is 0 by chance and 1 at most. Compare it with their number.

values = [
    coherence(scene.points1, scene.points2, estimate.mask)
    for estimate, scene in zip(estimates[:80], scenes, strict=True)
]
n_inliers = [estimate.n_inliers for estimate in estimates[:80]]

# %%
# The truth, known here, agrees: above .5 most inliers are right, below .35 F means nothing. Between
# them are pairs of which a few right matches were found, too few for F. The number of inliers would
# tell as well here, but the number to ask for grows with the threshold and that of the matches, and
# nobody knows it beforehand. How exact F is, coherence hardly says: above .5 it is some 3 px off in
# the median, and up to 26 px where few matches are right.

distances = [
    epipolar_distance(estimate.F, scene.F, scene.size, scene.size)
    for estimate, scene in zip(estimates[:80], scenes, strict=True)
]

fig, axes = plt.subplots(1, 2, figsize=(9, 4.2), layout="constrained", sharey=True)
for ax, x, label in zip(
    axes, (values, n_inliers), ("coherence of the inliers", "inliers of 500 matches"), strict=True
):
    dots = ax.scatter(x, distances, c=100 * shares, cmap="viridis", s=40, ec="white", lw=0.5)
    ax.set(yscale="log", xlabel=label)
    ax.spines[["top", "right"]].set_visible(False)
axes[0].axvspan(0.35, 0.5, color="0.9", lw=0, zorder=0)
axes[0].set(ylabel="Zhang's distance from the true F, pixels")
axes[0].yaxis.set_major_formatter("{x:g}")
axes[1].set(xscale="log", xticks=[10, 20, 50, 100, 200])
axes[1].xaxis.set_major_formatter("{x:g}")
axes[1].xaxis.set_minor_formatter("")
fig.colorbar(dots, label="right matches, per cent")
plt.show()

# %%
# With ``n_jobs=-1`` all cores work; the results are the same for any number. What a million pairs
# cost, and how to use a cluster, is told in :doc:`/scale`.
