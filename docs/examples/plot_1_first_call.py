"""
The one-line change
===================

Your program calls ``cv2.findFundamentalMat``. Here is what it gains from a changed import: the same
matches, the same arguments, both functions, and the distance of each result from the truth.
"""

# %%
# Two photographs whose geometry was measured (Middlebury's "motorcycle", the second one turned),
# and their SIFT matches, mutual nearest neighbours without a ratio test. Three in ten are wrong.

import cv2
import matplotlib.pyplot as plt
import numpy as np

import cv_densityf
from cv_densityf.datasets import motorcycle
from cv_densityf.plotting import plot_matches

pair = motorcycle()
matches = cv_densityf.match_images(pair.image1, pair.image2)
points1, points2 = matches.points1, matches.points2
len(matches)

# %%
# The call, before and after:

F, mask = cv2.findFundamentalMat(points1, points2, cv2.FM_RANSAC, 1.0, 0.999, 5000)
F, mask = cv_densityf.findFundamentalMat(points1, points2, cv2.FM_RANSAC, 1.0, 0.999, 5000)
mask.shape, mask.dtype, int(mask.sum())

# %%
# Some of cv2's methods depend on the order of the rows more than one would like, so each method
# gets the matches in ten orders. ``pair.error`` is the mean distance of measured, true
# correspondences from their epipolar lines.

methods = ["FM_LMEDS", "FM_RANSAC", "USAC_DEFAULT", "USAC_MAGSAC", "USAC_ACCURATE"]
functions = {"cv2": cv2.findFundamentalMat, "cv_densityf": cv_densityf.findFundamentalMat}
rng = np.random.default_rng(0)
orders = [rng.permutation(len(matches)) for _ in range(10)]
errors = {
    name: np.array(
        [
            [
                pair.error(function(points1[o], points2[o], getattr(cv2, m), 1.0, 0.999, 5000)[0])
                for o in orders
            ]
            for m in methods
        ]
    )
    for name, function in functions.items()
}

fig, ax = plt.subplots(figsize=(8, 3.6), layout="constrained")
rows = np.arange(len(methods))
medians = {name: np.median(values, axis=1) for name, values in errors.items()}
ax.hlines(rows, medians["cv_densityf"], medians["cv2"], color="0.8", lw=6, zorder=0)
for name, color in (("cv2", "#D55E00"), ("cv_densityf", "#0072B2")):
    ax.plot(errors[name], rows, "o", color=color, ms=4, alpha=0.35, mew=0)
    ax.plot(medians[name], rows, "o", color=color, ms=10, label=name)
ax.set(xscale="log", xlabel="mean error, pixels", xlim=(0.04, 1))
ax.set(yticks=rows, yticklabels=methods, ylim=(len(rows) - 0.5, -0.5))
ax.set_xticks([0.05, 0.1, 0.2, 0.5, 1])
ax.xaxis.set_major_formatter("{x:g}")
ax.xaxis.set_minor_formatter("")
ax.spines[["top", "right"]].set_visible(False)
ax.legend(frameon=False, loc="lower right")

# %%
# What happened in between is told by :func:`cv_densityf.estimate_fundamental`, the same estimate
# without cv2's shapes. Blue matches agree with the result; the light ones are outside the dense
# part, in which the search began.

estimate = cv_densityf.estimate_fundamental(points1, points2, scores=matches.scores)
print(estimate.reason)

fig, ax = plt.subplots(figsize=(12, 4.6), layout="constrained")
classes = {"kept": estimate.kept, "mask": estimate.mask, "reliability": estimate.reliability}
plot_matches(pair.image1, pair.image2, matches.X, **classes, ax=ax)
plt.show()
# sphinx_gallery_thumbnail_number = 2
