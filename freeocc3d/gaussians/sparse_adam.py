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
    """Steps for the rows of a tensor (N, D). rates: (D,) sizes of the steps."""

    def __init__(self, count: int, rates: Tensor):
        self._rates = rates
        self._mean = torch.zeros((count, len(rates)), device=rates.device)
        self._square = torch.zeros_like(self._mean)
        self._steps = torch.zeros((count, 1), device=rates.device)

    @torch.no_grad()
    def step(self, rows: Tensor, gradient: Tensor, share: float) -> Tensor:
        """(M, D) what to add to the M different rows, whose gradients are (M, D). share: multiplies the rates."""
        steps = self._steps[rows] + 1
        mean = self._mean[rows].lerp_(gradient, 1 - _BETA_1)
        square = self._square[rows].mul_(_BETA_2).addcmul_(gradient, gradient, value=1 - _BETA_2)
        self._steps[rows], self._mean[rows], self._square[rows] = steps, mean, square
        usual = square.div_(1 - _BETA_2**steps).sqrt_().add_(_EPSILON)
        return mean.div_(1 - _BETA_1**steps).div_(usual).mul_(-share * self._rates)
