"""Images and their descriptions, read by map_server's own rules."""

import numpy as np
import pytest
from exported_maps import map_server

from freeocc3d.export.map_server_files import COSTS, PLAN, CellGrid, encode_costs, write_map


def test_costs_are_read_as_they_were_written(tmp_path) -> None:
    costs = np.arange(101, dtype=np.uint8).reshape(101, 1)
    grid = CellGrid(np.array((-1.5, 0.25)), 0.05, (101, 1), "gravity")
    write_map(tmp_path / "costs.yaml", encode_costs(costs), grid, COSTS, "costs")
    data, size, origin = map_server(tmp_path / "costs.yaml")
    assert data.tolist() == [list(range(101))]
    assert (size, *origin) == (0.05, -1.5, 0.25)
    # ROS 1 maps what lies between the thresholds to 1…99: it reads nearly the same, and white is 0 there, too.
    ratio = (1 - encode_costs(costs)[1:-1, 0] / 255 - COSTS.free) / (COSTS.occupied - COSTS.free)
    assert np.abs(1 + 98 * ratio - np.arange(1, 100)).max() < 1.1


@pytest.mark.parametrize(("pixel", "read"), [(0, 100), (254, 0), (205, -1)])
def test_a_plans_pixels_are_distinguished(tmp_path, pixel, read) -> None:
    pixels = np.full((2, 3), 205, np.uint8)
    pixels[1, 0] = pixel  # the smallest y, the last x
    write_map(tmp_path / "map.yaml", pixels, CellGrid(np.zeros(2), 0.1, (2, 3), "gravity"), PLAN, "a plan")
    assert map_server(tmp_path / "map.yaml")[0].tolist() == [[-1, read], [-1, -1], [-1, -1]]
