"""The octree against a plain one, built cell by cell."""

import numpy as np
import pytest

from freeocc3d.export.octree import DEPTH, KEY_ORIGIN, Leaves, build_octree


def leaves(corners, values):
    return Leaves(np.int32(corners).reshape(-1, 3), np.float32(values), np.full((len(values), 3), 9, np.uint8))


def plain(cubes):
    """Nodes (value, children) depth first of cubes {(corner, edge): value}, by recursion."""

    def node(low, edge, inside):
        if not inside:
            return None
        if inside.get((low, edge)) is not None:
            return [(inside[low, edge], 0)]
        parts, half = [], edge // 2
        for i in range(8):
            at = tuple(low[axis] + (half if i >> axis & 1 else 0) for axis in range(3))
            own = {
                cube: value
                for cube, value in inside.items()
                if all(at[axis] <= cube[0][axis] < at[axis] + half for axis in range(3))
            }
            parts.append(node(at, half, own))
        there = [part for part in parts if part]
        if len(there) == 8 and all(part == there[0] and part[0][1] == 0 for part in there):
            return there[0]
        mask = sum(1 << i for i, part in enumerate(parts) if part)
        return [(max(part[0][0] for part in there), mask), *(entry for part in there for entry in part)]

    return node((-KEY_ORIGIN,) * 3, 2 * KEY_ORIGIN, cubes)


@pytest.mark.parametrize("seed", range(4))
def test_nodes_are_those_of_a_plain_tree_in_its_order(seed) -> None:
    rng = np.random.default_rng(seed)
    taken = np.unique(rng.integers(-3, 3, (150, 3)), axis=0)  # cells of 4 voxels
    cubes: dict = {}
    parts = {1: ([], []), 2: ([], []), 4: ([], [])}
    for cell in taken * 4:
        edge = int(rng.choice((1, 2, 4)))
        one_value = rng.random() < 0.5
        for part in np.ndindex(*(4 // edge,) * 3):
            if one_value or rng.random() < 0.6:
                corner = tuple(int(v) for v in cell + np.array(part) * edge)
                value = 1.0 if one_value else float(rng.choice((-2.0, 1.0)))
                cubes[corner, edge] = value
                parts[edge][0].append(corner)
                parts[edge][1].append(value)
    tree = build_octree([leaves(*parts[edge]) for edge in (1, 2, 4)])
    expected = plain(cubes)
    np.testing.assert_array_equal(tree.values, [value for value, _ in expected])
    np.testing.assert_array_equal(tree.children, [mask for _, mask in expected])
    inner = tree.children > 0
    for i in range(8):
        np.testing.assert_array_equal(tree.kinds[inner] >> 2 * i & 3 > 0, tree.children[inner] >> i & 1 == 1)


def test_one_voxel_is_a_branch_and_other_colors_are_not_merged() -> None:
    assert len(build_octree([leaves([(0, 0, 0)], [1.0])])) == DEPTH + 1
    cube = np.stack(np.meshgrid(*[(0, 1)] * 3), axis=-1).reshape(-1, 3)
    assert len(build_octree([leaves(cube, np.ones(8))])) == DEPTH
    colors = np.zeros((8, 3), np.uint8)
    colors[3] = 80
    apart = build_octree([Leaves(cube.astype(np.int32), np.ones(8, np.float32), colors)])
    assert len(apart) == DEPTH + 1 + 7
    assert apart.colors[0].tolist() == [10, 10, 10]
