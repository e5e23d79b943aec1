"""
Rectifying two photographs
==========================

What to do with a fundamental matrix when the cameras are not known: turn both photographs until
corresponding points lie in the same row, which is what dense stereo methods ask for. A matrix that
is only nearly right shows at once, because rows do not meet.
"""

# %%
# Match, estimate, and hand F and the inliers to OpenCV.

import cv2
import matplotlib.pyplot as plt
import numpy as np

from cv_densityf import findFundamentalMat, match_images
from cv_densityf.datasets import motorcycle

pair = motorcycle()
matches = match_images(pair.image1, pair.image2)
F, mask = findFundamentalMat(matches.points1, matches.points2, cv2.USAC_ACCURATE, 1.0, 0.999, 5000)
inliers1, inliers2 = (p[mask.ravel() == 1] for p in (matches.points1, matches.points2))

size = pair.image1.shape[1::-1]
_, H1, H2 = cv2.stereoRectifyUncalibrated(inliers1, inliers2, F, size)

# %%
# How far from their row the partners of the inliers are then:

rows1, rows2 = (
    cv2.perspectiveTransform(points[:, None], H)[:, 0, 1]
    for points, H in ((inliers1, H1), (inliers2, H2))
)
print(f"median {np.median(np.abs(rows1 - rows2)):.2f} px, {len(rows1)} inliers")

# %%
# Before and after. Along each line the same things are to be seen left and right.

before = [pair.image1, pair.image2]
after = [cv2.warpPerspective(image, H, size) for image, H in zip(before, (H1, H2), strict=True)]
fig, axes = plt.subplots(2, 1, figsize=(9, 6.6), layout="constrained")
for ax, images, title in zip(axes, (before, after), ("before", "after"), strict=True):
    ax.imshow(cv2.cvtColor(np.hstack(images), cv2.COLOR_BGR2RGB))
    for row, color in zip(range(60, size[1], 95), ["#E69F00", "#56B4E9"] * 3, strict=False):
        ax.axhline(row, color=color, lw=1.2)
    ax.set(title=title, xticks=[], yticks=[])
plt.show()
