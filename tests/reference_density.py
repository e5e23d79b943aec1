"""Density peaks as the definitions read, point by point: slow, and obvious."""

from __future__ import annotations

import math
from itertools import combinations


def distance(a, b):
    return math.sqrt(sum((s - t) ** 2 for s, t in zip(a, b, strict=True)))


def cutoff_interval(X, dc_percent):
    """(low, high]: every dc in it gives the smallest mean rho that reaches dc_percent % of n."""
    n = len(X)
    distances = sorted(distance(a, b) for a, b in combinations(X, 2))
    if not distances:
        return 0.0, math.inf
    target = dc_percent / 100 * n * (1 - 1e-12)
    reached = (d for nearer, d in enumerate(distances, start=1) if 2 * nearer / n >= target)
    low = next(reached, distances[-1])
    return low, min((d for d in distances if d > low), default=math.inf)


def density(X, dc, kernel):
    def weight(d):
        return float(d < dc) if kernel == "cutoff" else math.exp(-((d / dc) ** 2))

    return [sum(weight(distance(a, b)) for j, b in enumerate(X) if j != i) for i, a in enumerate(X)]


def delta_and_predecessor(X, rho):
    delta, predecessor = [], []
    for i, a in enumerate(X):
        denser = [j for j in range(len(X)) if rho[j] > rho[i] or (rho[j] == rho[i] and j < i)]
        if denser:
            best = min(denser, key=lambda j: (distance(a, X[j]), -rho[j], j))
            delta.append(distance(a, X[best]))
            predecessor.append(best)
        else:
            delta.append(max(distance(a, b) for b in X))
            predecessor.append(-1)
    return delta, predecessor


def labels(predecessor, centers):
    def follow(i):
        if i in centers:
            return centers.index(i)
        return -1 if predecessor[i] < 0 else follow(predecessor[i])

    return [follow(i) for i in range(len(predecessor))]


def halo(X, rho, labels, dc):
    def on_border(i):
        return any(0 <= labels[j] != labels[i] and distance(X[i], b) < dc for j, b in enumerate(X))

    result = []
    for i, label in enumerate(labels):
        members = [j for j, other in enumerate(labels) if other == label]
        border = [rho[j] for j in members if on_border(j)]
        result.append(label < 0 or (bool(border) and rho[i] <= max(border)))
    return result
