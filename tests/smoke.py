"""What an installed copy must do, in an environment of its own and away from the repository.

Run as ``python -I tests/smoke.py`` by ``nox -s package``: the tests prove that the code is right,
this proves that the code has arrived.
"""

from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path

import cv2
import numpy as np

import cv_densityf
from cv_densityf.datasets import two_view_scene


def main() -> None:
    """Fail unless the copy is whole and works."""
    folder = Path(cv_densityf.__file__).parent
    assert folder.parent != Path(__file__).parents[1], "this is the repository, not an installation"
    assert (folder / "py.typed").is_file()
    assert metadata.version("cv-densityf") == cv_densityf.__version__
    heavy = {"scipy", "sklearn", "matplotlib", "skimage", "pycolmap"} & set(sys.modules)
    assert not heavy, f"import cv_densityf also imports {heavy}"
    assert all(getattr(cv_densityf, name) for name in cv_densityf.__all__)

    scene = two_view_scene()
    F, mask = cv_densityf.findFundamentalMat(
        scene.points1, scene.points2, cv2.USAC_MAGSAC, 1.0, 0.999, 5000
    )
    assert F.shape == (3, 3)
    assert mask.shape == (len(scene.X), 1)
    F = F / np.linalg.norm(F)
    assert min(np.abs(F - scene.F).max(), np.abs(F + scene.F).max()) < 0.01
    estimator = cv_densityf.FundamentalMatrixEstimator().fit(scene.X)
    agree = estimator.predict(scene.X) == scene.inliers
    assert agree.mean() > 0.9
    print(f"cv-densityf {cv_densityf.__version__} works in {folder}")


if __name__ == "__main__":
    main()
