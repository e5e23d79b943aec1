"""Made-up matches with a known fundamental matrix."""

from __future__ import annotations

import cv2
import numpy as np


def scene(n, inlier_ratio=0.6, noise=0.5, seed=0):
    """Two views of ``n`` points in a box, some paired wrongly: X (n, 4) float32, inliers, F."""
    rng = np.random.default_rng(seed)
    K = np.array([[800.0, 0, 512], [0, 800, 384], [0, 0, 1]])
    R = cv2.Rodrigues(rng.uniform(-0.15, 0.15, 3))[0]
    t = np.array([1.0, rng.uniform(-0.4, 0.4), rng.uniform(-0.3, 0.3)])
    points = rng.uniform((-2.5, -2, 4), (2.5, 2, 10), (n, 3))
    one, two = points @ K.T, (points @ R.T + t) @ K.T
    X = np.hstack([one[:, :2] / one[:, 2:], two[:, :2] / two[:, 2:]])
    X += rng.normal(0, noise, X.shape)
    inliers = rng.permutation(n) < round(inlier_ratio * n)
    wrong = np.count_nonzero(~inliers)
    X[~inliers] = rng.uniform(0, (1024, 768, 1024, 768), (wrong, 4))
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    F = np.linalg.inv(K).T @ cross @ R @ np.linalg.inv(K)
    return X.astype(np.float32), inliers, F / np.linalg.norm(F)


def degenerate(kind, n):
    """Points that fix no fundamental matrix, or hardly one: X (n, 4) float32."""
    return np.hstack(_degenerate(n)[kind]).astype(np.float32)


def _degenerate(n):
    rng = np.random.default_rng(n)
    some, other = rng.uniform(0, 500, (2, n, 2))
    steps = np.arange(n)[:, None]
    line = np.hstack([steps, 2.0 * steps])
    return {
        "no motion": (some, some),
        "translation": (some, some + 10),
        "zoom": (some, 1.5 * some - 100),
        "plane": (some, some @ [[0.9, 0.1], [-0.1, 0.9]] + 20),
        "line in both": (line, line + 3),
        "line in one": (line, other),
        "one point": (some[:1].repeat(n, 0), other[:1].repeat(n, 0)),
        "two points": (some[:2].repeat(n, 0)[:n], other[:2].repeat(n, 0)[:n]),
        "lattice": (rng.integers(0, 3, (n, 2)), rng.integers(0, 3, (n, 2))),
        "every match thrice": (some.repeat(3, 0)[:n], other.repeat(3, 0)[:n]),
        "one point moves": (some, np.where(steps == 0, other, some)),
        "random": (some, other),
        "huge": (some * 1e20, other * 1e20),
        "tiny": (some * 1e-20, other * 1e-20),
        "far away": (some + 1e6, other + 1e6),
        "zeros": (0 * some, 0 * some),
        "NaN": (some * np.nan, other),
        "infinity": (some, other + np.inf),
    }


DEGENERATE = tuple(_degenerate(1))
