"""Connected components of voxels. The module imports little, so that queries of small maps start fast."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.voxel_keys import AXIS_BITS, contains, pack_voxels
from ..language import word_matching


def label_components(voxels: NDArray[np.int32], edges: NDArray[np.int32] | None = None) -> NDArray[np.int32]:
    """Returns the (V,) component number of each of (V, 3) distinct voxels. Voxels that share a face, edge or corner are
    connected. The function never allocates the dense box.

    edges: (V,) edge lengths, powers of two that divide their voxel's lower corner; 1 by default.
    """
    n = len(voxels)
    if n == 0:
        return np.zeros(0, np.int32)
    edges = np.ones(n, np.int32) if edges is None else edges
    sizes = np.unique(edges)
    if len(sizes) == 1 and word_matching.is_worth_compiling(n):
        from . import component_labels

        found = component_labels.label_lattice(voxels // sizes[0])
        if found is not None:
            return found
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    of_size = {size: np.flatnonzero(edges == size) for size in sizes}
    pairs = [of_size[size][_touching(voxels[of_size[size]] // size)] for size in sizes]
    for size in sizes:
        for larger in sizes[sizes > size]:
            pairs.append(_touching_larger(voxels, of_size[size], size, of_size[larger], larger))
    touching = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(touching.shape[1], bool), tuple(touching)), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1])


def _touching_larger(
    voxels: NDArray[np.int32], rows: NDArray[np.int64], size: int, rows_larger: NDArray[np.int64], larger: int
) -> NDArray[np.int64]:
    """Returns (2, P) pairs of rows: voxels of one size, and voxels of a larger size that they touch."""
    keys = pack_voxels(voxels[rows_larger] // larger)
    order = np.argsort(keys)
    ascending, pairs = keys[order], [np.zeros((2, 0), np.int64)]
    for step in np.ndindex(3, 3, 3):
        wanted = pack_voxels((voxels[rows] + (np.array(step) - 1) * size) // larger)
        found = contains(ascending, wanted)
        pairs.append(np.stack((rows[found], rows_larger[order[np.searchsorted(ascending, wanted[found])]])))
    return np.concatenate(pairs, axis=1)


def _touching(voxels: NDArray[np.int32]) -> NDArray[np.int64]:
    """Returns (2, P) pairs of rows of touching voxels among (V, 3) distinct voxels of one size.

    In sorted keys, a voxel's three neighbors in a column along k are successive. Half of the 26 neighbors are the voxel
    above and four such columns. So one search per column finds them.
    """
    n = len(voxels)
    keys = pack_voxels(voxels)
    order = np.argsort(keys)
    ascending = np.append(keys[order], np.full(3, np.iinfo(np.int64).max))
    here = np.arange(n)
    above = ascending[1 : n + 1] == ascending[:n] + 1
    pairs = [np.stack((here[above], here[above] + 1))]
    for i, j in ((0, 1), (1, -1), (1, 0), (1, 1)):
        first = ascending[:n] + (i << 2 * AXIS_BITS) + (j << AXIS_BITS) - 1
        at = np.searchsorted(ascending[:n], first)
        for step in range(3):
            touches = ascending[at + step] <= first + 2
            pairs.append(np.stack((here[touches], at[touches] + step)))
    return np.asarray(order[np.concatenate(pairs, axis=1)])
