"""Images and their descriptions, read by map_server's own rules."""

import cv2
import numpy as np
import pytest
import yaml

from freeocc3d.export.map_server_files import COSTS, PLAN, CellGrid, encode_costs, write_map


def map_server(path):
    """The occupancy grid that map_server publishes of a map.yaml: data[row, column] of -1 or 0 to 100, row 0 at the
    smallest y; resolution; and the position of the grid's corner. Modes of nav2_map_server's map_io."""
    told = yaml.safe_load(path.read_text())
    free, occupied = told["free_thresh"], told["occupied_thresh"]
    assert occupied > free
    image = cv2.imread(str(path.with_name(told["image"])), cv2.IMREAD_UNCHANGED)
    height, width = image.shape
    data = np.full((height, width), -1)
    for y in range(height):
        for x in range(width):
            shade = image[y, x] / 255.0
            p = shade if told["negate"] else 1.0 - shade
            between = {"trinary": -1, "scale": np.rint((p - free) / (occupied - free) * 100.0)}[told["mode"]]
            data[height - y - 1, x] = 100 if p > occupied else 0 if p < free else between
    assert told["origin"][2] == 0
    return data, told["resolution"], np.array(told["origin"][:2])


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
def test_a_plans_pixels_are_told_apart(tmp_path, pixel, read) -> None:
    pixels = np.full((2, 3), 205, np.uint8)
    pixels[1, 0] = pixel  # the smallest y, the last x
    write_map(tmp_path / "map.yaml", pixels, CellGrid(np.zeros(2), 0.1, (2, 3), "gravity"), PLAN, "a plan")
    assert map_server(tmp_path / "map.yaml")[0].tolist() == [[-1, read], [-1, -1], [-1, -1]]
