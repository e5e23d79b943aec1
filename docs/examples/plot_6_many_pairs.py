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

from cv_densityf import epipolar_distance, estimate_many
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
# How many, you can ask your own data: shuffle the partners, which leaves no match right, and
# estimate again.

rng = np.random.default_rng(0)
shuffled = [(scene.points1, rng.permutation(scene.points2)) for scene in scenes[::4]]
by_chance = [estimate.n_inliers for estimate in estimate_many(shuffled)]
print("inliers by chance:", sorted(by_chance))

# %%
# Results with no more inliers than that mean nothing, and the truth, known here, agrees. With three
# times as many they are right, or nearly.

n_inliers = [estimate.n_inliers for estimate in estimates[:80]]
distances = [
    epipolar_distance(estimate.F, scene.F, scene.size, scene.size)
    for estimate, scene in zip(estimates[:80], scenes, strict=True)
]

fig, ax = plt.subplots(figsize=(9, 4.2), layout="constrained")
ax.axvspan(min(by_chance), max(by_chance), color="#E69F00", alpha=0.25, lw=0)
ax.text(max(by_chance) * 1.03, 0.5, "by chance", color="#9c6a00")
dots = ax.scatter(n_inliers, distances, c=100 * shares, cmap="viridis", s=50, ec="white", lw=0.5)
ax.set(xscale="log", yscale="log", xlabel="inliers of 500 matches")
ax.set(ylabel="Zhang's distance from the true F, pixels", xticks=[10, 20, 50, 100, 200])
ax.xaxis.set_major_formatter("{x:g}")
ax.xaxis.set_minor_formatter("")
ax.yaxis.set_major_formatter("{x:g}")
ax.spines[["top", "right"]].set_visible(False)
fig.colorbar(dots, label="right matches, per cent")

# %%
# With ``n_jobs=-1`` all cores work; the results are the same for any number. What a million pairs
# cost, and how to use a cluster, is told in :doc:`/scale`.
