"""
When one plane out-votes the scene
==================================

A facade, a floor, a poster: if nearly all right matches lie on one plane, a fundamental matrix can
have hundreds of inliers and still be wrong everywhere else, because every matrix that is right on
the plane explains them. Counting inliers cannot tell; looking where they are can.
"""

# %%
# A wall with nine tenths of the right matches, some small things in front of it, and wrong matches.

import cv2
import matplotlib.pyplot as plt
import numpy as np

import cv_densityf

K = np.array([[1000, 0, 640], [0, 1000, 480], [0, 0, 1.0]])
N_WALL, N_THINGS, N_WRONG = 225, 25, 164
kinds = np.repeat(["wall", "things", "wrong"], [N_WALL, N_THINGS, N_WRONG])


def wall_scene(seed):
    """Matches with half a pixel of noise, and the same without noise."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform((0, 0), (1280, 960), (N_WALL, 2))
    at = rng.uniform((150, 150), (1130, 810), (6, 2))[rng.integers(0, 6, N_THINGS)]
    xy = np.concatenate([xy, at + rng.normal(0, 25, (N_THINGS, 2))])
    depth = np.concatenate([10 + 0.003 * xy[:N_WALL, 0], rng.uniform(5, 9, N_THINGS)])
    points = np.c_[xy, np.ones(len(xy))] @ np.linalg.inv(K).T * depth[:, None]
    R, _ = cv2.Rodrigues(rng.normal(0, 0.05, 3))
    moved = (points @ R.T + [0.9, 0.2, 0.1]) @ K.T
    exact = np.c_[xy, moved[:, :2] / moved[:, 2:]]
    wrong = rng.uniform(0, [1280, 960, 1280, 960], (N_WRONG, 4))
    return np.concatenate([exact + rng.normal(0, 0.5, exact.shape), wrong]), exact


def error(F, exact):
    """Median distance of exact matches from their epipolar lines in the second image, pixels."""
    if F is None:
        return np.inf
    lines = cv2.computeCorrespondEpilines(exact[:, :2], 1, F)[:, 0]
    return np.median(np.abs((lines * np.c_[exact[:, 2:], np.ones(len(exact))]).sum(axis=1)))


# %%
# One of these scenes, as cv2's RANSAC and as this package see it. Filled marks are inliers: both
# explain the wall, blue, but only one of them the things in front, orange.

functions = {
    "cv2, FM_RANSAC": (cv2.findFundamentalMat, cv2.FM_RANSAC),
    "cv_densityf, FM_RANSAC": (cv_densityf.findFundamentalMat, cv2.FM_RANSAC),
    "cv2, USAC_MAGSAC": (cv2.findFundamentalMat, cv2.USAC_MAGSAC),
    "cv_densityf, USAC_MAGSAC": (cv_densityf.findFundamentalMat, cv2.USAC_MAGSAC),
}
styles = {"wall": ("o", "#56B4E9"), "things": ("s", "#D55E00"), "wrong": (".", "0.6")}

X, exact = wall_scene(1)
fig, axes = plt.subplots(1, 2, figsize=(11, 4.9), layout="constrained", sharey=True)
for ax, name in zip(axes, list(functions)[:2], strict=True):
    function, method = functions[name]
    F, mask = function(X[:, :2], X[:, 2:], method, 1.0, 0.999, 5000)
    inlier = mask.ravel() == 1
    for kind, (marker, color) in styles.items():
        rows = kinds == kind
        for drawn, face in ((rows & inlier, color), (rows & ~inlier, "none")):
            ax.plot(*X[drawn, :2].T, marker, ms=6, color=color, mfc=face, alpha=0.8)
    counts = ", ".join(f"{(inlier & (kinds == k)).sum()} of {k}" for k in styles)
    ax.set(title=f"{name}\ninliers: {counts}", aspect="equal", xlim=(0, 1280), ylim=(960, 0))

# %%
# Forty such scenes. What counts is the error off the wall, where the matrix is put to the test.

errors = {name: [] for name in functions}
for seed in range(40):
    X, exact = wall_scene(seed)
    for name, (function, method) in functions.items():
        F, _ = function(X[:, :2], X[:, 2:], method, 1.0, 0.999, 5000)
        errors[name].append(error(F, exact[N_WALL:]))

fig, ax = plt.subplots(figsize=(9, 3.4), layout="constrained")
rng = np.random.default_rng(0)
for row, values in enumerate(errors.values()):
    ax.plot(values, row + rng.uniform(-0.18, 0.18, 40), "o", ms=5, alpha=0.6, color="#0072B2")
    ax.plot(np.median(values), row, "|", ms=34, mew=3, color="#D55E00")
ax.set(xscale="log", xlabel="error off the wall, pixels (bar: median)")
ax.xaxis.set_major_formatter("{x:g}")
ax.set(yticks=range(len(errors)), yticklabels=errors, ylim=(len(errors) - 0.5, -0.5))
ax.spines[["top", "right"]].set_visible(False)
plt.show()
