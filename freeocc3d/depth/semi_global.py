"""Semi-global aggregation: adds to each pixel's label costs those of paths from eight directions.

Source: H. Hirschmüller, Stereo Processing by Semiglobal Matching and Mutual Information, PAMI 2008, eq. 13.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def aggregate_costs(costs: Tensor, step: float, jump_down: Tensor, jump_right: Tensor) -> Tensor:
    """Sum over eight directions of the smallest costs of paths that end in a pixel.

    costs: (H, W, L) costs of L ordered labels.  step: price of a change to an adjacent label.  jump_down, jump_right:
    (H, W) price of any larger change between a pixel and the one above it, or to its left; low at image edges.
    Returns (H, W, L).
    """
    total = _swept(costs, step, jump_down, diagonal=True)
    turned = _swept(costs.transpose(0, 1).contiguous(), step, jump_right.t().contiguous(), diagonal=False)
    return total + turned.transpose(0, 1)


def price_jumps(gray: Tensor, least: float, most: float, contrast: float) -> tuple[Tensor, Tensor]:
    """(H, W) prices between vertical and between horizontal neighbors: ``most`` for equal intensities, down to
    ``least`` for differences far above ``contrast``."""
    down = F.pad((gray[1:] - gray[:-1]).abs(), (0, 0, 1, 0))
    right = F.pad((gray[:, 1:] - gray[:, :-1]).abs(), (1, 0))
    return tuple(least + (most - least) * torch.exp(-change / contrast) for change in (down, right))


def _swept(costs: Tensor, step: float, jump: Tensor, diagonal: bool) -> Tensor:
    """Aggregate along paths down and up the rows: straight and, with ``diagonal``, along both diagonals."""
    height, width, labels = costs.shape
    directions = 3 if diagonal else 1
    total = torch.zeros_like(costs)
    for downward in (True, False):
        paths = costs.new_zeros((directions, width, labels))
        for row in range(height) if downward else range(height - 1, -1, -1):
            if diagonal:
                left, right = F.pad(paths[1, :-1], (0, 0, 1, 0)), F.pad(paths[2, 1:], (0, 0, 0, 1))
                paths = torch.stack((paths[0], left, right))
            paths = paths - paths.amin(dim=-1, keepdim=True)
            price = jump[row] if downward else jump[min(row + 1, height - 1)]
            beside = F.pad(paths + step, (1, 1), value=torch.inf)
            change = torch.minimum(torch.minimum(beside[..., :-2], beside[..., 2:]), price[None, :, None])
            paths = costs[row] + torch.minimum(paths, change)
            total[row] += paths.sum(dim=0) if diagonal else paths[0]
    return total
