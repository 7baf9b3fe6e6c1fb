"""The benchmark's floor and walls, on a room whose voxels are known."""

import numpy as np
from benchmark import upright_layers


def room() -> np.ndarray:
    """Labels of a room of 20 x 16 x 12: 1 floor, 2 walls, 3 a cupboard and a lamp at the wall of least x, 0 free."""
    labels = np.full((24, 20, 12), 255, np.uint8)
    labels[2:22, 2:18] = 0
    labels[2:22, 2:18, 0] = 1
    labels[2, 2:18, 1:] = labels[21, 2:18, 1:] = 2
    labels[2:22, 2, 1:] = labels[2:22, 17, 1:] = 2
    labels[3:6, 4:8, 1:6] = 3
    labels[3, 12, 8] = 3
    return labels


def test_only_floor_with_nothing_on_or_beside_it_is_bare() -> None:
    bare = upright_layers.find_bare_floor(room(), room() == 1, 4)
    assert bare[15, 10]
    assert not bare[4, 5]  # the cupboard
    assert not bare[6, 5]  # beside it
    assert not bare[3, 10]  # beside the wall
    assert bare.sum() == (18 - 2) * (14 - 2) - (2 * 4 + 4 + 2)


def test_walls_are_bare_where_nothing_touches_them() -> None:
    across_x, across_y = upright_layers.find_bare_walls(room(), room() == 2)
    assert across_x[2, 12, 3]
    assert not across_x[2, 5, 3]  # the cupboard
    assert not across_x[2, 9, 3]  # within two voxels of it
    assert across_x[2, 5, 8]  # above it
    assert not across_x[2, 12, 8]  # the lamp
    assert not across_x[2, 4, 8]  # two voxels from a corner
    assert not across_x[10, 2, 3]
    assert across_y[10, 2, 3]
    assert not (across_x & across_y).any()
    assert upright_layers.widened(across_x, 0)[3, 12, 3]


def test_thickness_is_the_length_of_a_row_through_a_wall() -> None:
    rng = np.random.default_rng(0)
    wall = np.array([(x, y, z) for y in range(8) for z in range(5) for x in range(y % 3, y % 3 + 1 + z % 3)])
    other = np.array([(9, 3, 3), (9, 4, 3)])
    voxels = rng.permutation(np.concatenate((wall, other))).astype(np.int32) - 4
    for axis in (0, 1):
        chosen = voxels[:, 0] < 5
        turned = voxels if axis == 0 else voxels[:, (1, 0, 2)]
        found = upright_layers.find_thickness(turned, axis, chosen)
        np.testing.assert_array_equal(np.bincount(found), [0, 16, 16, 8])


def test_the_table_has_a_row_for_each_size() -> None:
    figures = {"up_by": "floor", "floor_in_one_layer": 0.99}
    figures |= {"walls_of_one": 0.6, "walls_of_two": 0.4, "walls_of_more": 0.0}
    lines = upright_layers.tabulate_layers([{"capture": "house", "sizes": {"0.08": figures, "0.04": figures}}])
    assert lines[-1] == "| house | 0.04 | floor | 99.0% | 60.0% | 40.0% | 0.0% |"
    assert len(lines) == 5
