"""Fits Gaussians to the images of the keyframes; their means stay where layer 1 put them.

Paper, "Geometrically Anchored Gaussian Updates": over scales, rotations, opacities and colors,

    min sum_t |I^_t - I_t|^2 + beta |D^_t - D_t|^2   s.t.  mu = P

over the pixels that have a depth. The space beyond has no anchors, and nearby Gaussians would grow to paint it.

A camera sees the outline of a Gaussian, but not its extent along the ray, nor the space it takes in front of others.
The initialization keeps what images cannot show: the local z axis of an anchored Gaussian, the surface's normal or its
keyframe's ray, and the extent on it stay. The two other axes turn and change their ratio, but their mean precision
stays, so that occupancy does. Opacities and colors are free.

Time is bounded: some views are enough (``view_choice``), each step touches only what its view shows, and all passes but
the last compare views of half the size, which show what Gaussians of this spacing can show. These passes end when other
views show no better for it.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ..core.sampling import spread_evenly
from ..core.threads import count_threads
from ..core.types import Gaussians
from ..settings.stages import FittingOptions as Options
from .rasterizers.base import ALPHA_MIN, Rasterizer, Rendered, Splats
from .rendered_views import CapturedView, halve_view, measure_fidelity
from .sparse_adam import SparseAdam
from .view_choice import choose_views, find_in_view

_RATES = {"outline": 0.03, "turn": 0.03, "shape": 0.03, "quats": 0.015, "means": 6e-4, "logits": 0.15, "colors": 0.03}
"""Adam's step for each parameter: natural logarithms, radians, meters, logits, 0…1. A third of it takes twice as many
passes to the same PSNR on house/bedroom."""
_LAST_DECAY = 0.1
"""During the last pass, steps shrink to this share of their size."""
_LARGE = 2
"""Time of a step with a view of the full width, over that with one of half the width."""
_JUDGES = 8
"""Largest number of views, of those that are not fitted to, that tell whether a pass improves anything."""
_PATIENCE = 2
"""Passes over small views end after so many that did not improve the judges; one may not, because steps are long."""
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
    most: float = math.inf,
) -> Gaussians:
    """Returns the Gaussians after at most ``passes`` over some of the views in random order (always the same), without
    those that became invisible. progress: called with the number of rendered images.  most: renderings of half the
    width, of which a full one counts as ``_LARGE``; passes are left out that exceed them, but for the last."""
    chosen = choose_views(gaussians, views) if passes else []
    if not chosen:
        return gaussians
    passes = max(1, int(min(passes, 1 + most / len(chosen) - _LARGE)))
    others = sorted(set(range(len(views))) - set(chosen)) or chosen
    judges = [halve_view(views[others[n]]) for n in spread_evenly(len(others), _JUDGES)]
    with _one_torch_thread():
        fit = _Fit(gaussians, rasterizer, options, progress)
        fitted = [views[row] for row in chosen]
        with ThreadPoolExecutor(count_threads()) as pool:
            large = list(zip(fitted, pool.map(fit.find_rows, fitted), strict=True))
        small, scores = [(halve_view(view), rows) for view, rows in large], [-math.inf]
        while len(scores) < passes and len(scores) - int(np.argmax(scores)) <= _PATIENCE:
            fit.show(small, 1.0)
            scores.append(measure_fidelity(fit.gaussians(), judges, rasterizer).psnr_measured or -math.inf)
        fit.show(large, _LAST_DECAY)
        made = fit.gaussians()
    return made[made.opacities >= ALPHA_MIN]  # the others are never drawn


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


class _Fit:
    """A fit in progress."""

    def __init__(self, gaussians: Gaussians, rasterizer: Rasterizer, options: Options, progress: Callable[[int], None]):
        self._before, self._rasterizer, self._depth_weight = gaussians, rasterizer, options.depth_weight
        self._parameters = (_Free if options.means == "free" else _Anchored)(gaussians, options, rasterizer.device)
        self._optimizer = SparseAdam(len(gaussians), self._parameters.rates)
        self._generator, self._progress, self._done, self._share = np.random.default_rng(0), progress, 0, 1.0

    def find_rows(self, view: CapturedView) -> Tensor:
        """Rows of the Gaussians that the view may show. They stay nearly the same while shapes change."""
        return torch.from_numpy(find_in_view(self._before, view)).to(self._rasterizer.device)

    def show(self, views: Sequence[tuple[CapturedView, Tensor]], decay: float) -> None:
        """One pass over views with the rows that they may show. decay: the share to which steps shrink meanwhile."""
        for n in self._generator.permutation(len(views)):
            self._step(*views[n])
            self._share *= decay ** (1 / len(views))
            self._done += 1
            self._progress(self._done)

    def _step(self, view: CapturedView, rows: Tensor) -> None:
        parameters = self._parameters
        values = parameters.values[rows].requires_grad_()
        part = parameters.by_name(values)
        rendered = self._rasterizer.render(parameters.splats(part, rows), view.T_cam_world, view.camera)
        (_loss(rendered, view, self._depth_weight) + parameters.prior(part)).backward()
        assert values.grad is not None
        moved = values.detach() + self._optimizer.step(rows, values.grad, self._share)
        parameters.values[rows] = parameters.clamped(moved, rows)

    def gaussians(self) -> Gaussians:
        """The Gaussians as they are now."""
        return self._parameters.gaussians(self._before)


def _loss(rendered: Rendered, view: CapturedView, depth_weight: float) -> Tensor:
    """Mean over the image's pixels of the squared errors, which are 0 where there is no depth."""
    color = ((rendered.image - view.image) ** 2).sum(dim=2)
    depth = (rendered.depth - view.depth_m) ** 2
    return ((color + depth_weight * depth) * view.measured).mean()


_Tensors = dict[str, Tensor]
_ALL = slice(None)


class _Parameters:
    """The optimized numbers of N Gaussians, and how Gaussians are made of them.

    values: (N, D).  rates: (D,) sizes of Adam's steps.  A subclass names the columns by ``_RATES``.
    """

    def __init__(self, gaussians: Gaussians, options: Options, device: torch.device):
        def tensor(array: np.ndarray) -> Tensor:
            return torch.from_numpy(np.array(array, np.float32)).to(device)

        self._weight = options.shape_weight
        self.means = tensor(gaussians.means)
        self.log_scales = tensor(np.log(gaussians.scales))
        self.quats = tensor(gaussians.quats_wxyz)
        self._optimize(
            logits=torch.logit(tensor(gaussians.opacities), _OPACITY_MARGIN)[:, None],
            colors=tensor(gaussians.colors) / 255,
            **self._shape_values(),
        )

    def _optimize(self, **parts: Tensor) -> None:
        """Let these (N, d) tensors be the columns of ``values``."""
        ends = np.cumsum([part.shape[1] for part in parts.values()])
        self._columns = {
            name: slice(end - part.shape[1], end) for (name, part), end in zip(parts.items(), ends, strict=True)
        }
        self.values = torch.cat(list(parts.values()), dim=1)
        rates = [torch.full((part.shape[1],), _RATES[name]) for name, part in parts.items()]
        self.rates = torch.cat(rates).to(self.values.device)

    def by_name(self, values: Tensor) -> _Tensors:
        """The columns of (M, D) values."""
        return {name: values[:, columns] for name, columns in self._columns.items()}

    def _shape_values(self) -> _Tensors:
        """The initial numbers of the shapes, (N, d) each."""
        raise NotImplementedError

    def shapes(self, part: _Tensors, rows: Tensor | slice) -> tuple[Tensor, Tensor, Tensor]:
        """Means, scales, quaternions of some rows. part: their optimized numbers."""
        raise NotImplementedError

    def splats(self, part: _Tensors, rows: Tensor | slice) -> Splats:
        """Some Gaussians, ready to be rendered. part: their optimized numbers."""
        return Splats(*self.shapes(part, rows), torch.sigmoid(part["logits"][:, 0]), part["colors"])

    def prior(self, part: _Tensors) -> Tensor:
        """The penalty that keeps shapes near the initialization."""
        return torch.zeros((), device=self.means.device)

    def clamped(self, values: Tensor, rows: Tensor | slice) -> Tensor:
        """The (M, D) values of some rows, clamped to their valid ranges in place."""
        part = self.by_name(values)
        part["logits"].clamp_(-_LARGEST_LOGIT, _LARGEST_LOGIT)
        part["colors"].clamp_(0, 1)
        return values

    def gaussians(self, before: Gaussians) -> Gaussians:
        """All Gaussians."""
        splats = self.splats(self.by_name(self.values), _ALL)
        means, scales, quats, opacities, colors = (x.cpu().numpy() for x in splats)
        return replace(
            before,
            means=means,
            scales=scales,
            quats_wxyz=quats / np.linalg.norm(quats, axis=1, keepdims=True),
            opacities=opacities,
            colors=np.rint(255 * colors).astype(np.uint8),
        )


class _Anchored(_Parameters):
    """outline (N, 2): logarithms of the change of the two scales across the ray.  turn (N, 1): radians about it."""

    def _shape_values(self) -> _Tensors:
        return {"outline": torch.zeros_like(self.means[:, :2]), "turn": torch.zeros_like(self.means[:, :1])}

    def shapes(self, part: _Tensors, rows: Tensor | slice) -> tuple[Tensor, Tensor, Tensor]:
        outline, turn = part["outline"], part["turn"][:, 0]
        kept = outline + 0.5 * torch.log(torch.exp(-2 * outline).mean(dim=1, keepdim=True))  # mean of 1 / change^2 is 1
        change = torch.cat((kept, torch.zeros_like(turn)[:, None]), dim=1)
        w, x, y, z = self.quats[rows].unbind(1)
        c, s = torch.cos(0.5 * turn), torch.sin(0.5 * turn)
        turned = torch.stack((w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s), dim=1)  # q * (c, 0, 0, s)
        return self.means[rows], torch.exp(self.log_scales[rows] + change), turned

    def prior(self, part: _Tensors) -> Tensor:
        return self._weight * (part["outline"] ** 2).mean()

    def clamped(self, values: Tensor, rows: Tensor | slice) -> Tensor:
        self.by_name(values)["outline"].clamp_(-0.5 * _LARGEST_CHANGE, 0.5 * _LARGEST_CHANGE)
        return super().clamped(values, rows)


class _Free(_Parameters):
    """means, shape (N, 3) logarithms of the scales, quats: as in 3D Gaussian splatting."""

    def _shape_values(self) -> _Tensors:
        return {"means": self.means, "shape": self.log_scales, "quats": self.quats}

    def shapes(self, part: _Tensors, rows: Tensor | slice) -> tuple[Tensor, Tensor, Tensor]:
        return part["means"], torch.exp(part["shape"]), part["quats"]

    def clamped(self, values: Tensor, rows: Tensor | slice) -> Tensor:
        part, usual = self.by_name(values), self.log_scales[rows]
        part["shape"].copy_(
            torch.maximum(torch.minimum(part["shape"], usual + _LARGEST_CHANGE), usual - _LARGEST_CHANGE)
        )
        part["quats"].copy_(torch.nn.functional.normalize(part["quats"], dim=1))
        return super().clamped(values, rows)
