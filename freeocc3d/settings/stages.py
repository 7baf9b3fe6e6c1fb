"""The options of the stages, one class for each section of a configuration.

Options of a backend (a tracker, an encoder, ...) stand in the backend's own file; what only some caller needs, such as
the options of a query, stands with it.
"""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from ..core.errors import ConfigError
from .option_types import (
    Advanced,
    Finite,
    NotNegative,
    NotNegativeInt,
    Positive,
    PositiveInt,
    PositiveShare,
    Share,
)
from .typed_options import TypedOptions


class CaptureOptions(TypedOptions, frozen=True):
    """How any capture is read."""

    format: str = "auto"
    """Name of the reader, or "auto" to recognize the layout of the folder."""
    start: NotNegativeInt = 0
    """First frame that is used."""
    stop: int | None = None
    """Frame before which to stop; null = the last."""
    stride: PositiveInt = 1
    """Use every n-th frame."""
    depth: bool = True
    """Read the capture's depth; false = color alone, as of a plain video, though depth may be there."""
    depth_scale: Positive | None = None
    """Depth units per metre (1000 for millimetres); null = what the format or its files say."""
    max_depth: Positive = 6.0
    """Depth beyond this many metres counts as not measured."""
    max_size: Annotated[int, Meta(ge=16)] | None = 960
    """Longer side in pixels that images of videos, photographs and reconstructions are reduced to if they are larger;
    null = as they are."""
    scale: Positive | None = None
    """Metres per unit of poses that come without a scale, those of a scan without depth; null = unknown."""
    intrinsics: tuple[Positive, Positive, Finite, Finite] | None = None
    """fx, fy, cx, cy of the color image in pixels, in place of what the files say."""
    color_focal: Annotated[float, Meta(ge=0.5, le=2)] | None = None
    """Focal length of the color camera over what the files say, where depth fits them and color does not (7-Scenes'
    Kinect: 0.90); null = measured in the scan itself, 1 = as the files say."""
    max_broken: Share = 0.1
    """Share of the frames that may be unreadable before the run stops."""


class TrackingOptions(TypedOptions, frozen=True):
    """Layer 1."""

    backend: str = "rgbd"
    """Where poses come from: "rgbd" estimates them from color and depth, "colmap" from color alone, "known" takes the
    capture's own, "file" those of another system."""


class StereoOptions(TypedOptions, frozen=True):
    """Depth for captures that have none, by multi-view stereo."""

    size: Annotated[int, Meta(ge=64)] = 640
    """Longer side of the depth images in pixels; frames get them enlarged to their own size."""
    neighbors: PositiveInt = 4
    """Views that each frame is compared with."""
    agreeing: Advanced[PositiveInt] = 2
    """Views whose depth must confirm a pixel's, of twice as many as each frame is compared with, for it to become part
    of the surface."""
    network: str | None = None
    """ONNX network that guesses (inverse) depth from one image, fitted to each frame's stereo depth; it fills what
    stereo leaves empty."""
    device: str = "cpu"
    """Where stereo is computed: "cpu", or a CUDA device of torch's."""


class GaussianOptions(TypedOptions, frozen=True):
    """Layer 2: how keyframe depth becomes Gaussians."""

    cell_size: Positive | None = None
    """Edge of the cells that hold one Gaussian each, metres; null = half the voxel size, and no more than a hundredth
    of the usual depth where the scale is unknown, for voxels may turn out to be large there."""
    pixel_stride: PositiveInt | None = None
    """Every n-th pixel of a keyframe, in both directions, is lifted; null = as many as leave 320 columns, more where
    cells are small, and all of depth by stereo."""
    every: NotNegativeInt = 1
    """Every n-th tracked frame shows the surface, besides the keyframes; 0 = keyframes alone, as in the paper, which
    loses two to nine points of IoU on the shipped captures."""
    denoise: Advanced[bool] = True
    """Move the cells' points to where all frames' depth images together have the surface, and leave out those that
    most see through: adds 6 to 22 points of IoU on the shipped captures and halves the number of Gaussians."""
    coverage: Advanced[Positive] = 0.7
    """s_perp over the spacing of the Gaussians, which is the cell's edge or, where that is greater, the footprint of a
    pixel on the surface. At 0.7 a flat wall reaches alpha = 0.5 at 0.6 voxels from its surface: a voxel's centre is
    within 0.5 voxels of a surface through it where that is along the lattice, and up to 0.87 where it is oblique."""
    uncertainty: Advanced[NotNegative] = 0.0
    """Standard deviations of an anchor's averaged depth that are added (in quadrature) to that spacing. Uncertain
    surfaces, those that few keyframes saw from afar, come out thicker: 1 loses two to eight points of IoU on the house
    captures and gains 0.3 on the kitchen."""
    gamma: Advanced[Positive] = 1.0
    """Elongation along the viewing ray, s_par = gamma * s_perp; at 1 a Gaussian is a sphere, which measures best on the
    shipped captures (0.6 and 1.5 lose one to five points of IoU on the kitchen)."""
    opacity: Advanced[PositiveShare] = 0.9
    """Opacity of a new Gaussian, 0…1: where fitting starts, and its weight when voxels take up features and colors;
    alpha does not depend on it."""
    initialization: Advanced[Literal["ray_aligned", "isotropic"]] = "ray_aligned"
    """"ray_aligned": as above, the paper's geometry-aware initialization; "isotropic": spheres of the mean distance to
    the three nearest Gaussians, as in 3D Gaussian splatting (for comparison)."""
    edge: Advanced[Positive] = 0.05
    """Pixels whose depth differs from a neighbor's by more than this share of it are dropped: at an edge the sensor
    reports depths that belong to neither side."""
    min_pixels: Advanced[PositiveInt] = 2
    """Measurements that a cell needs, unless it is too small to hold that many."""


class FittingOptions(TypedOptions, frozen=True):
    """Layer 2: how Gaussians are fitted to the images."""

    rasterizer: str = "cpu"
    """What renders: "cpu" (compiled), "gsplat" (CUDA), or "reference" (plain PyTorch, slow)."""
    passes: NotNegativeInt = 6
    """Times that every keyframe is rendered and compared; 0 = Gaussians stay as they were initialized."""
    means: Advanced[Literal["anchored", "free"]] = "anchored"
    """"anchored": means stay on the measured surface, and shapes near the initialization; "free": everything is moved
    by the images, as elsewhere (for comparison; costs occupancy)."""
    width: PositiveInt = 320
    """Columns of the rendered images."""
    depth_weight: Advanced[Positive] = 1.0
    """beta: a depth wrong by a metre weighs as much as a color wrong by its whole range."""
    shape_weight: Advanced[NotNegative] = 0.1
    """Pull of anchored Gaussians' outlines to the initialization: weight of the mean squared logarithm of their
    change. Smaller renders better (0.02: + 0.4 dB) and loses occupancy (0.5 to 1 point of IoU)."""


class LanguageOptions(TypedOptions, frozen=True):
    """Layer 3: what is known of the Gaussians in words."""

    encoder: str = "color"
    """What turns images and words into features; "color" needs no network and knows color names only."""
    keyframes: Positive = 1.0
    """Keyframes that are encoded: up to 1 their share of all, above it their number. Fewer are chosen so that they are
    sharp and together show the most surface; layer 3's time falls in proportion."""
    visible_within: Advanced[Positive] = 0.02
    """A Gaussian is seen if the depth image shows something within this many metres of it…"""
    visible_share: Advanced[NotNegative] = 0.01
    """…plus this share of its depth, plus its own standard deviation along the ray; otherwise it is hidden. Where
    nothing was measured, the Gaussians' own rendered depth decides."""
    near: Advanced[Positive] = 0.5
    """Views count in proportion to 1 / depth^2; all views nearer than this, in metres, count the same."""
    border: Advanced[Annotated[float, Meta(ge=0, le=0.5)]] = 0.1
    """Share of the image's height, from its edge inwards, over which views come to count in full: encoders see things
    cut off there."""
    disagreement: Advanced[Positive | None] = 0.6
    """Regions of a view are left out that differ from what the other views say by more than this share of what two
    random places of the scene differ by; null = none are."""


class VocabularyOptions(TypedOptions, frozen=True):
    """Names of what is in the scene, by a vision-language model; they are what a word competes with."""

    endpoint: str | None = None
    """Address of an OpenAI-compatible server, such as http://localhost:11434/v1 (Ollama); null = no model is asked. The
    keyframes that are asked about are sent there."""
    model: str = ""
    """What the server calls the model."""
    api_key_env: str | None = None
    """Name of the environment variable that holds the server's key; null = it wants none."""
    keyframes: PositiveInt = 24
    """The most keyframes that are asked about, evenly spread."""
    timeout: Positive = 60.0
    """Seconds that one answer may take."""
    retries: NotNegativeInt = 2
    """Times that a question is asked again after an answer that did not come."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.endpoint is not None and not self.model:
            raise ConfigError("'endpoint' names a server, so 'model' must name the model to ask there.")


class OccupancyOptions(TypedOptions, frozen=True):
    """Layer 4: how Gaussians become voxels."""

    voxel_size: Positive = 0.08
    """Edge of a voxel, metres."""
    finest: Positive | None = None
    """Edge of the smallest voxels, metres, such as 0.01 where the others have 0.08: voxels are cut by halves down to it
    where the surface is not flat or its meaning changes; null = all are of one size."""
    projection: Advanced[Literal["probabilistic", "poisson", "integrated", "released"]] = "probabilistic"
    """What a Gaussian adds to a voxel: "probabilistic" (the paper's equations), "poisson" (with its opacity, in the
    form of the paper's code), "integrated" (its mass within the voxel), "released" (a dilation, as that code runs)."""
    cutoff: Advanced[Positive] = 3.0
    """Neighborhood of a Gaussian in standard deviations."""
    threshold: Annotated[float, Meta(gt=0, lt=1)] = 0.5
    """Occupied from this alpha on."""
    device: str = "cpu"
    """Where Gaussians are projected: "cpu" (compiled), or a GPU for torch, such as "cuda:0"."""
    contradiction: Advanced[Positive] = 4.0
    """A voxel above the threshold is free all the same when the log-odds of what depth images saw there (see carving)
    are at most minus this: 4 is ten images that saw through it, or more where others ended in it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.projection == "integrated" and self.device != "cpu":
            raise ConfigError("The projection 'integrated' runs on the processor only: set occupancy.device=cpu.")


class CarvingOptions(TypedOptions, frozen=True):
    """Layer 4: free space from depth."""

    margin: Advanced[Positive] = 1.0
    """A voxel is seen through when the depth behind its centre is greater by this many voxel edges (and by the
    depth's uncertainty)."""
    noise: Advanced[NotNegative] = 0.0019
    """Growth of a depth's standard deviation with its square, 1/m, where nothing else says how great it is; three of
    them are added to the margin."""
    hit: Advanced[Positive] = 0.85
    """Log-odds that a depth image which ends in a voxel adds: OctoMap's, a probability of 0.7."""
    miss: Advanced[Positive] = 0.4
    """Log-odds that one which sees through a voxel takes away: OctoMap's, a probability of 0.4."""
    min_free: PositiveInt = 1
    """Depth images that must see through a voxel that holds no surface before it counts as free."""
    every: NotNegativeInt = 1
    """Every n-th tracked frame shows what is free, besides the keyframes; 0 = keyframes alone."""
    no_return: NotNegative = 0.0
    """Metres up to which space counts as seen through where a wide patch of a depth image holds no measurement; 0 =
    such a patch says nothing. For sensors that fail beyond their range alone: what is black, shiny or too near has no
    depth either, and would be carved away."""
    ray_step: Advanced[PositiveInt] = 16
    """Every n-th pixel's ray (more where blocks are small) is followed to find the blocks that a camera looked into."""
