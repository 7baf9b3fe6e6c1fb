"""Adam by rows is torch's Adam on the steps that each row takes."""

from __future__ import annotations

import torch

from freeocc3d.gaussians.sparse_adam import SparseAdam


def test_each_row_moves_as_torchs_adam_moves_it_alone() -> None:
    rng = torch.Generator().manual_seed(0)
    start, rates = torch.randn((5, 3), generator=rng), torch.tensor((0.1, 0.02, 0.5))
    made, sparse = start.clone(), SparseAdam(5, rates)
    alone = [[start[row, column].clone().requires_grad_() for column in range(3)] for row in range(5)]
    usual = [
        torch.optim.Adam(
            [{"params": [leaf], "lr": float(rate)} for leaf, rate in zip(leaves, rates, strict=True)], eps=1e-15
        )
        for leaves in alone
    ]
    for rows in ([0, 1, 2], [2, 4], [1, 2], [0, 2, 4]):
        gradient = torch.randn((len(rows), 3), generator=rng)
        made[rows] += sparse.step(torch.tensor(rows), gradient, 1.0)
        for n, row in enumerate(rows):
            for column in range(3):
                alone[row][column].grad = gradient[n, column]
            usual[row].step()
    torch.testing.assert_close(made, torch.stack([torch.stack(leaves) for leaves in alone]).detach())
    assert torch.equal(made[3], start[3]), "no step shows this row"
