"""Aggregation against a plain implementation of the recurrence, path by path."""

import numpy as np
import pytest
import torch

from freeocc3d.depth.semi_global import aggregate_costs, price_jumps

DIRECTIONS = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)]


def _plain(costs, step, down, right):
    height, width, labels = costs.shape
    total = np.zeros_like(costs)
    for dy, dx in DIRECTIONS:
        paths = np.zeros_like(costs)
        rows = range(height) if dy >= 0 else range(height - 1, -1, -1)
        columns = range(width) if dx >= 0 else range(width - 1, -1, -1)
        for y in rows:
            for x in columns:
                before = y - dy, x - dx
                if not (0 <= before[0] < height and 0 <= before[1] < width):
                    paths[y, x] = costs[y, x]
                    continue
                last = paths[before] - paths[before].min()
                jump = down[max(y, before[0]), x] if dy else right[y, max(x, before[1])]
                for k in range(labels):
                    beside = min((last[j] for j in (k - 1, k + 1) if 0 <= j < labels), default=np.inf)
                    paths[y, x, k] = costs[y, x, k] + min(last[k], beside + step, jump)
        total += paths
    return total


def test_sum_of_the_least_paths() -> None:
    step = 0.1
    rng = np.random.default_rng(1)
    costs = rng.random((7, 9, 5)).astype(np.float32)
    down, right = rng.random((2, 7, 9)).astype(np.float32)
    found = aggregate_costs(torch.from_numpy(costs), step, torch.from_numpy(down), torch.from_numpy(right)).numpy()
    np.testing.assert_allclose(found, _plain(costs, step, down, right), atol=1e-5)


def test_edges_make_jumps_cheap() -> None:
    gray = torch.zeros(4, 6)
    gray[:, 3:] = 1.0
    down, right = price_jumps(gray, 0.2, 2.0, 0.05)
    assert (down == 2.0).all()
    assert right[0, 3] == pytest.approx(0.2, abs=1e-3)
    assert right[0, 2] == 2.0
