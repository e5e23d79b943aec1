"""
Searching parameters
====================

You have labelled some of your image pairs and want to know which settings suit them, by
scikit-learn's tools. An estimator that filters matches and then estimates is one object with
parameters like ``prefilter__keep``, so a grid search runs as for any other; what needs thought is
over what it should average.
"""

# %%
# ``GridSearchCV`` splits the matches of *one* pair into folds: quick, and fine to get a feeling.

import matplotlib.pyplot as plt
import numpy as np
from sklearn.base import clone
from sklearn.metrics import f1_score
from sklearn.model_selection import GridSearchCV, ParameterGrid

from cv_densityf import DensityPeaksFilter, FundamentalMatrixEstimator
from cv_densityf.datasets import two_view_scene

estimator = FundamentalMatrixEstimator(DensityPeaksFilter(), method="usac_magsac")
grid = {
    "prefilter__keep": [0.1, 0.2, 0.3, 0.4, 0.6, 1.0],
    "threshold": [0.25, 0.5, 1.0, 2.0, 4.0, 8.0],
}
pair = two_view_scene(400, inlier_ratio=0.3, random_state=0)
search = GridSearchCV(estimator, grid, scoring="f1", cv=2).fit(pair.X, pair.inliers)
search.best_params_

# %%
# But a fold holds half of the matches, at half of the density, and all folds share one fundamental
# matrix. What you want to know is what suits the *next* pair. So fit every combination on every
# labelled pair as a whole, and average over the pairs: a loop.

pairs = [two_view_scene(400, inlier_ratio=0.3, random_state=seed) for seed in range(20)]


def quality(parameters, pair):
    """How well the inliers agree with the labels, from 0 to 1."""
    try:
        return f1_score(
            pair.inliers, clone(estimator).set_params(**parameters).fit(pair.X).predict(pair.X)
        )
    except ValueError:  # no fundamental matrix
        return 0.0


over_pairs = [np.mean([quality(p, pair) for pair in pairs]) for p in ParameterGrid(grid)]

# %%
# Side by side:

shape = [len(values) for values in grid.values()]
tables = {
    "folds of one pair": search.cv_results_["mean_test_score"],
    f"{len(pairs)} whole pairs": over_pairs,
}
fig, axes = plt.subplots(1, 2, figsize=(10.5, 4.2), layout="constrained", sharey=True)
for ax, (title, values) in zip(axes, tables.items(), strict=True):
    table = np.reshape(values, shape)
    mesh = ax.imshow(table, cmap="viridis", vmin=0, vmax=1, origin="lower", aspect="auto")
    for (row, column), value in np.ndenumerate(table):
        best = value == table.max()
        ax.text(column, row, f"{value:.2f}".lstrip("0"), ha="center", va="center",
                color="black" if value > 0.6 else "white", weight="bold" if best else None,
                bbox={"fc": "none", "ec": "black"} if best else None)  # fmt: skip
    ax.set(title=title, xlabel="threshold, pixels")
    ax.set(xticks=range(shape[1]), xticklabels=grid["threshold"])
    ax.set(yticks=range(shape[0]), yticklabels=grid["prefilter__keep"])
axes[0].set_ylabel("share of matches kept")
fig.colorbar(mesh, ax=axes, label="mean F1 of the inliers", shrink=0.9)
plt.show()

# %%
# ``prefilter="auto"``, the default, has no share to be chosen. On the same pairs, with the
# threshold found above:

best = list(ParameterGrid(grid))[int(np.argmax(over_pairs))]
auto = FundamentalMatrixEstimator(threshold=best["threshold"])
f1 = np.mean([f1_score(pair.inliers, auto.fit(pair.X).predict(pair.X)) for pair in pairs])
print(f"grid: {max(over_pairs):.3f} with {best}\nauto: {f1:.3f}")
