"""
Reading a decision graph
========================

Density peaks find clusters of any shape and tell lone points from crowds, and one picture, the
decision graph, shows how many clusters there are. This is how to read it, first for points in the
plane, then for the matches of two photographs.
"""

# %%
# Each point has a density, the number of points nearer than a cut-off distance, and a distance to
# the nearest point that is denser. Centres of clusters have both large: in the graph they stand
# apart, above and to the right. Lone points are far from everything, but not dense: top left.

import cv2
import matplotlib.pyplot as plt
import numpy as np

from cv_densityf import DecisionGraphDisplay, DensityPeaks, density_peaks, match_images
from cv_densityf.datasets import motorcycle
from cv_densityf.plotting import plot_decision_graph

rng = np.random.default_rng(0)
shapes = [((0, 0), (1.0, 1.0), 200), ((7, 1), (0.5, 2.0), 150), ((1, 7), (2.2, 0.6), 150)]
blobs = [rng.normal(center, spread, (n, 2)) for center, spread, n in shapes]
X = np.concatenate([*blobs, rng.uniform(-5, 12, (50, 2))])

clusters = DensityPeaks(n_clusters=3, kernel="gaussian").fit(X)

fig, (left, right) = plt.subplots(1, 2, figsize=(11, 4.4), layout="constrained")
colors = np.array(["#0072B2", "#E69F00", "#009E73"])[clusters.labels_]
left.scatter(*X.T, s=16, color=colors)
left.plot(*X[clusters.cluster_centers_indices_].T, "k*", ms=13, mec="white")
left.set(aspect="equal", title="three clusters and their centres")
DecisionGraphDisplay.from_estimator(clusters, ax=right)
right.set_title("the decision graph")

# %%
# A match of two images is a point (x, y, x', y') in four dimensions, so it has a place in such a
# graph, too. Here the truth is known, and tells the right matches (circles, triangles) from the
# wrong ones. Most wrong ones are alone. The dashed line is the rule of Wu and Wan's paper, to keep
# what lies on it or above: fewer wrong matches, but fewer right ones, too. That is why this package
# does not delete what is below, and asks another question about density by default: see
# :doc:`/how-it-works`.

pair = motorcycle()
matches = match_images(pair.image1, pair.image2)
lines = cv2.computeCorrespondEpilines(matches.points1, 1, pair.F)[:, 0]
distance = np.abs((lines * np.c_[matches.points2, np.ones(len(matches))]).sum(axis=1))

fig, ax = plt.subplots(figsize=(10, 5.2), layout="constrained")
plot_decision_graph(density_peaks(matches.X), alpha=0.011, mask=distance < 1, ax=ax)
plt.show()
