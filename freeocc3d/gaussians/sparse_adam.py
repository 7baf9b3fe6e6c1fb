"""Adam whose steps touch only the rows that an image shows; the others cost nothing and keep their momentum.

Source: D. Kingma, J. Ba, Adam: A Method for Stochastic Optimization, ICLR 2015, Algorithm 1, with a step count of its
own for each row. A row that is first seen late then starts with steps of the usual size.
"""

from __future__ import annotations

import torch
from torch import Tensor

_BETA_1, _BETA_2 = 0.9, 0.999
_EPSILON = 1e-15
"""As in the authors' code of 3D Gaussian Splatting: gradients are small."""


class SparseAdam:
    """Changes tensors (N, …) in place, some rows at a time."""

    def __init__(self, tensors: dict[str, Tensor]):
        self._tensors = tensors
        self._mean = {name: torch.zeros_like(tensor) for name, tensor in tensors.items()}
        self._square = {name: torch.zeros_like(tensor) for name, tensor in tensors.items()}
        first = next(iter(tensors.values()))
        self._steps = torch.zeros(len(first), device=first.device)

    @torch.no_grad()
    def step(self, rows: Tensor, gradients: dict[str, Tensor], rates: dict[str, float]) -> None:
        """Takes a step. rows: (M,) different rows.  gradients: (M, …) of these rows.  rates: size of the step."""
        steps = self._steps[rows] + 1
        self._steps[rows] = steps
        for name, gradient in gradients.items():
            count = steps.reshape(-1, *[1] * (gradient.ndim - 1))
            mean = self._mean[name][rows].lerp_(gradient, 1 - _BETA_1)
            square = self._square[name][rows].mul_(_BETA_2).addcmul_(gradient, gradient, value=1 - _BETA_2)
            self._mean[name][rows], self._square[name][rows] = mean, square
            usual = (square / (1 - _BETA_2**count)).sqrt_().add_(_EPSILON)
            self._tensors[name].index_add_(0, rows, mean / (1 - _BETA_1**count) / usual, alpha=-rates[name])
