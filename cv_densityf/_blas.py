"""Linear algebra for which BLAS starts no threads.

On so little work threads save microseconds, and cost milliseconds where the cores are busy; and
what is summed up would depend on their number.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]

#: The OpenBLAS of numpy 1 starts threads for the LU decomposition of any matrix, and for products
#: with a vector sooner than for others.
_NUMPY_1 = np.lib.NumpyVersion(np.__version__) < "2.0.0"
#: Multiplications that one thread does.
_MOST = 2**18
_MOST_WITH_VECTOR = 9_000


def parts(n: int, m: int, r: int) -> list[slice]:
    """Cut n columns of r rows, to be multiplied with m vectors, to what one thread does."""
    most = _MOST_WITH_VECTOR if _NUMPY_1 and m == 1 else _MOST
    size = max(1, most // max(1, m * r))
    return [slice(start, start + size) for start in range(0, n, size)]


def times_vector(rows: Floats, vector: Floats) -> Floats:
    """Product of rows (m, n) with a vector (n,)."""
    return np.asarray(np.einsum("mn,n->m", rows, vector) if _NUMPY_1 else rows @ vector)


def solved(matrices: Floats, right: Floats) -> Floats:
    """Solve m positive definite systems of equations, (m, k, k) and (m, k, 1)."""
    if not _NUMPY_1:
        return np.linalg.solve(matrices, right)
    values, vectors = np.linalg.eigh(matrices)
    return np.asarray(vectors @ (vectors.transpose(0, 2, 1) @ right / values[..., None]))
