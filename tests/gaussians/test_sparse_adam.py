"""Adam by rows is torch's Adam on the steps that each row takes."""

from __future__ import annotations

import torch

from freeocc3d.gaussians.sparse_adam import SparseAdam


def test_each_row_moves_as_torchs_adam_moves_it_alone() -> None:
    rng = torch.Generator().manual_seed(0)
    start = {"a": torch.randn((5, 3), generator=rng), "b": torch.randn(5, generator=rng)}
    rates = {"a": 0.1, "b": 0.02}
    made = {name: tensor.clone() for name, tensor in start.items()}
    sparse = SparseAdam(made)
    alone = {name: [tensor[row].clone().requires_grad_() for row in range(5)] for name, tensor in start.items()}
    usual = {
        name: [torch.optim.Adam([leaf], lr=rates[name], eps=1e-15) for leaf in leaves] for name, leaves in alone.items()
    }
    for rows in ([0, 1, 2], [2, 4], [1, 2], [0, 2, 4]):
        gradients = {name: torch.randn((len(rows), *tensor.shape[1:]), generator=rng) for name, tensor in made.items()}
        sparse.step(torch.tensor(rows), gradients, rates)
        for name, gradient in gradients.items():
            for n, row in enumerate(rows):
                alone[name][row].grad = gradient[n]
                usual[name][row].step()
    for name, tensor in made.items():
        torch.testing.assert_close(tensor, torch.stack([leaf.detach() for leaf in alone[name]]))
        assert torch.equal(tensor[3], start[name][3]), "no step shows this row"
