"""Fits Gaussians to the images of the keyframes; their means stay where layer 1 put them.

Paper, "Geometrically Anchored Gaussian Updates": over scales, rotations, opacities and colors,

    min sum_t |I^_t - I_t|^2 + beta |D^_t - D_t|^2   s.t.  mu = P

over the pixels that have a depth. The space beyond has no anchors, and nearby Gaussians would grow to paint it.

A camera sees the outline of a Gaussian, but not its extent along the ray, nor the space it takes in front of others.
The initialization keeps what images cannot show: the axis of an anchored Gaussian stays along its keyframe's ray, with
the same extent. Across the ray, the two axes of the outline turn and change their ratio, but their mean precision
stays, because alpha(x) of the occupancy is exp(-1/2 d^T Sigma^-1 d). Opacities and colors are free.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ..core.types import Gaussians
from ..settings.stages import FittingOptions as Options
from .rasterizers.base import ALPHA_MIN, Rasterizer, Rendered, Splats
from .rendered_views import CapturedView

_RATES = {"outline": 1e-2, "turn": 1e-2, "shape": 1e-2, "quats": 5e-3, "means": 2e-4, "logits": 5e-2, "colors": 1e-2}
"""Adam's step for each parameter: natural logarithms, radians, meters, logits, 0…1."""
_DECAY, _DECAY_FROM = 0.1, 0.3
"""Steps shrink to the first share of their size; they start to shrink after the second share of all steps."""
_ADAM_EPSILON = 1e-15  # as in the authors' code of 3D Gaussian Splatting: gradients are small
_OPACITY_MARGIN = 1e-3  # smallest distance of initial opacities from 0 and 1, where logits are infinite
_LARGEST_LOGIT = 6.0
_LARGEST_CHANGE = math.log(4.0)
"""Largest change of a scale, natural logarithm. It limits growth where images show nothing, as in a frame of one
color."""


def fit_gaussians(
    gaussians: Gaussians,
    views: Sequence[CapturedView],
    rasterizer: Rasterizer,
    options: Options,
    passes: int,
    progress: Callable[[int], None] = lambda done: None,
) -> Gaussians:
    """Returns the Gaussians after ``passes`` over the views in random order (always the same), without those that
    became invisible. progress: called with the number of rendered images."""
    if passes == 0 or not views or not len(gaussians):
        return gaussians
    with _one_torch_thread():
        return _fitted(gaussians, views, rasterizer, options, passes, progress)


@contextlib.contextmanager
def _one_torch_thread() -> Iterator[None]:
    """Limits torch to one thread. torch's and numba's threads wait for each other by spinning: on a machine that runs
    other programs, two threads of each take six times as long as one of torch's, whose work here is small."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _fitted(
    gaussians: Gaussians,
    views: Sequence[CapturedView],
    rasterizer: Rasterizer,
    options: Options,
    passes: int,
    progress: Callable[[int], None],
) -> Gaussians:
    parameters = (_Free if options.means == "free" else _Anchored)(gaussians, options, rasterizer.device)
    groups = [{"params": [tensor], "lr": _RATES[name]} for name, tensor in parameters.optimized.items()]
    optimizer = torch.optim.Adam(groups, eps=_ADAM_EPSILON, fused=True)
    generator = np.random.default_rng(0)
    steps = passes * len(views)
    order = np.concatenate([generator.permutation(len(views)) for _ in range(passes)])
    for step, index in enumerate(order):
        late = max(0.0, step / steps - _DECAY_FROM) / (1 - _DECAY_FROM)
        for group, rate in zip(optimizer.param_groups, map(_RATES.get, parameters.optimized), strict=True):
            group["lr"] = rate * _DECAY**late
        view = views[index]
        rendered = rasterizer.render(parameters.splats(), view.T_cam_world, view.camera)
        loss = _loss(rendered, view, options.depth_weight) + parameters.prior()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        parameters.clamp()
        progress(step + 1)
    return parameters.gaussians(gaussians)


def _loss(rendered: Rendered, view: CapturedView, depth_weight: float) -> Tensor:
    """Mean over the image's pixels of the squared errors, which are 0 where there is no depth."""
    color = ((rendered.image - view.image) ** 2).sum(dim=2)
    depth = (rendered.depth - view.depth_m) ** 2
    return ((color + depth_weight * depth) * view.measured).mean()


class _Parameters:
    """The optimized tensors, by their names in ``_RATES``; ``splats`` makes Gaussians from them."""

    def __init__(self, gaussians: Gaussians, device: torch.device):
        def tensor(array: np.ndarray) -> Tensor:
            return torch.from_numpy(np.array(array, np.float32)).to(device)

        self.means = tensor(gaussians.means)
        self.log_scales = tensor(np.log(gaussians.scales))
        self.quats = tensor(gaussians.quats_wxyz)
        self.optimized = {
            "logits": torch.logit(tensor(gaussians.opacities), _OPACITY_MARGIN),
            "colors": tensor(gaussians.colors) / 255,
        }

    def _optimize(self, **tensors: Tensor) -> None:
        self.optimized |= tensors
        for tensor in self.optimized.values():
            tensor.requires_grad_()

    def shapes(self) -> tuple[Tensor, Tensor, Tensor]:
        """Means, scales, quaternions."""
        raise NotImplementedError

    def splats(self) -> Splats:
        """The current Gaussians, ready to be rendered."""
        return Splats(*self.shapes(), torch.sigmoid(self.optimized["logits"]), self.optimized["colors"])

    def prior(self) -> Tensor:
        """The penalty that keeps shapes near the initialization."""
        return torch.zeros((), device=self.means.device)

    @torch.no_grad()
    def clamp(self) -> None:
        """Clamps the parameters to their valid ranges."""
        self.optimized["logits"].clamp_(-_LARGEST_LOGIT, _LARGEST_LOGIT)
        self.optimized["colors"].clamp_(0, 1)

    @torch.no_grad()
    def gaussians(self, before: Gaussians) -> Gaussians:
        """The current Gaussians."""
        means, scales, quats, opacities, colors = (tensor.cpu().numpy() for tensor in self.splats())
        after = replace(
            before,
            means=means,
            scales=scales,
            quats_wxyz=quats / np.linalg.norm(quats, axis=1, keepdims=True),
            opacities=opacities,
            colors=np.rint(255 * colors).astype(np.uint8),
        )
        return after[opacities >= ALPHA_MIN]  # the others are never drawn


class _Anchored(_Parameters):
    """outline (N, 2): logarithms of the change of the two scales across the ray.  turn (N,): radians about the ray."""

    def __init__(self, gaussians: Gaussians, options: Options, device: torch.device):
        super().__init__(gaussians, device)
        n = len(gaussians)
        self._weight = options.shape_weight
        self._optimize(outline=torch.zeros((n, 2), device=device), turn=torch.zeros(n, device=device))

    def shapes(self) -> tuple[Tensor, Tensor, Tensor]:
        outline, turn = self.optimized["outline"], self.optimized["turn"]
        kept = outline + 0.5 * torch.log(torch.exp(-2 * outline).mean(dim=1, keepdim=True))  # mean of 1 / change^2 is 1
        change = torch.cat((kept, torch.zeros_like(turn)[:, None]), dim=1)
        w, x, y, z = self.quats.unbind(1)
        c, s = torch.cos(0.5 * turn), torch.sin(0.5 * turn)
        turned = torch.stack((w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s), dim=1)  # q * (c, 0, 0, s)
        return self.means, torch.exp(self.log_scales + change), turned

    def prior(self) -> Tensor:
        return self._weight * (self.optimized["outline"] ** 2).mean()

    @torch.no_grad()
    def clamp(self) -> None:
        super().clamp()
        self.optimized["outline"].clamp_(-0.5 * _LARGEST_CHANGE, 0.5 * _LARGEST_CHANGE)


class _Free(_Parameters):
    """means, shape (N, 3) logarithms of the scales, quats: as in 3D Gaussian splatting."""

    def __init__(self, gaussians: Gaussians, options: Options, device: torch.device):
        super().__init__(gaussians, device)
        self._optimize(means=self.means.clone(), shape=self.log_scales.clone(), quats=self.quats.clone())

    def shapes(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.optimized["means"], torch.exp(self.optimized["shape"]), self.optimized["quats"]

    @torch.no_grad()
    def clamp(self) -> None:
        super().clamp()
        shape = self.optimized["shape"]
        shape.copy_(
            torch.maximum(torch.minimum(shape, self.log_scales + _LARGEST_CHANGE), self.log_scales - _LARGEST_CHANGE)
        )
        self.optimized["quats"].copy_(torch.nn.functional.normalize(self.optimized["quats"], dim=1))
