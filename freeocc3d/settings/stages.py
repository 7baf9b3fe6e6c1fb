"""The options of the stages: one class for each section of a configuration.

The options of a backend (a tracker, an encoder, …) are in the backend's own file. Options that only one caller needs,
such as those of a query, are in that caller's file.
"""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from ..core.errors import ConfigError
from .option_types import (
    Advanced,
    Device,
    FilePath,
    Meters,
    NotNegativeInt,
    Positive,
    PositiveInt,
    PositiveShare,
    Share,
    Stride,
    VoxelEdge,
)
from .typed_options import TypedOptions

Focal = Annotated[float, Meta(ge=1, le=1e6)]
Center = Annotated[float, Meta(ge=-1e6, le=1e6)]
Factor = Annotated[float, Meta(ge=0.01, le=100)]
VariableName = Annotated[
    str, Meta(pattern="^[A-Za-z_][A-Za-z0-9_]*$", description="the name of an environment variable")
]


class CaptureOptions(TypedOptions, frozen=True):
    """How captures are read."""

    format: str = "auto"
    """Name of the reader; "auto" = recognize the layout of the folder."""
    start: NotNegativeInt = 0
    """Index of the first frame to use."""
    stop: NotNegativeInt | None = None
    """Index of the frame before which to stop; null = use all frames to the last."""
    stride: PositiveInt = 1
    """Use every n-th frame."""
    depth: bool = True
    """Read the capture's depth; false = use color only, even if the capture has depth."""
    depth_scale: Annotated[float, Meta(ge=0.001, le=1e6)] | None = None
    """Depth units per meter (1000 for millimeters); null = as the format or its files state."""
    sensor: Literal["auto", "structured_light", "time_of_flight", "stereo"] = "auto"
    """How the depth camera measures, which tells the noise of its depth where frames state none: "structured_light"
    (Kinect v1, PrimeSense), "time_of_flight" (Kinect v2, Azure Kinect, LiDAR of phones) or "stereo" (RealSense D400).
    "auto" = recognize it by the steps and the noise of the depth."""
    max_depth: Meters = 6.0
    """Depth beyond this many meters counts as not measured."""
    max_size: Annotated[int, Meta(ge=16, le=16384)] | None = 960
    """Larger images of videos, photographs and reconstructions are reduced to this many pixels on the longer side; null
    = keep their size."""
    scale: Annotated[float, Meta(ge=1e-6, le=1e6)] | None = None
    """Meters per unit of poses without a known scale, as in a scan without depth; null = unknown."""
    intrinsics: tuple[Focal, Focal, Center, Center] | None = None
    """fx, fy, cx, cy of the color image in pixels; they replace those in the files. null = as the files state."""
    focal: Focal | None = None
    """Focal length of the color image in pixels, for images of one size with the principal point at their center; it
    replaces what the files state. null = as ``intrinsics`` or the files state."""
    color_focal: Annotated[float, Meta(ge=0.5, le=2)] | None = None
    """Focal length of the color camera divided by the one in the files, for files that suit the depth but not the color
    (7-Scenes' Kinect: 0.90); null = measure it in the scan, 1 = as in the files."""
    max_broken: Share = 0.1
    """The run stops if more than this share of the frames is unreadable."""


class TrackingOptions(TypedOptions, frozen=True):
    """Layer 1: camera poses."""

    backend: str = "auto"
    """Source of the poses: "rgbd" estimates them from color and depth, "colmap" from color only; "known" uses the poses
    in the capture, "file" those of another system. "auto" = "rgbd" for captures with depth; without depth "known" for
    reconstructions (nerfstudio, COLMAP), and else "colmap"."""


class StereoOptions(TypedOptions, frozen=True):
    """Depth by multi-view stereo, for captures without depth."""

    size: Annotated[int, Meta(ge=64, le=4096)] = 640
    """Longer side of the stereo depth maps in pixels; they are then enlarged to the size of the frames."""
    neighbors: Annotated[int, Meta(ge=1, le=64)] = 4
    """Number of views that each frame is compared with."""
    agreeing: Advanced[Annotated[int, Meta(ge=1, le=128)]] = 2
    """Number of views, of 2 * neighbors, that must confirm the depth of a pixel to make it part of the surface."""
    network: FilePath | None = None
    """ONNX network that predicts (inverse) depth from one image. Its depth is fitted to the stereo depth of each frame
    and fills the gaps in it. null = no network."""
    device: Device = "cpu"
    """Device that computes stereo: "cpu", or a CUDA device of torch such as "cuda:0"."""


class GaussianOptions(TypedOptions, frozen=True):
    """Layer 2: how the depth of keyframes becomes Gaussians."""

    cell_size: Meters | None = None
    """Edge in meters of the cells that hold one Gaussian each; null = half the voxel size. If the scale is unknown,
    voxels may turn out to be large, so null then also limits the edge to a hundredth of the usual depth."""
    pixel_stride: Stride | None = None
    """Use every n-th row and column of a keyframe; null = about 320 columns, more if cells are small, and all pixels of
    stereo depth."""
    every: NotNegativeInt = 1
    """Use every n-th tracked frame for the surface, in addition to the keyframes; 0 = keyframes only, as in the paper,
    which loses two to nine points of IoU on the shipped captures."""
    denoise: Advanced[bool] = True
    """Move the points of the cells to the surface on which the depth maps of all frames agree, and remove points that
    most depth maps see through. This adds 6 to 22 points of IoU on the shipped captures and halves the number of
    Gaussians."""
    coverage: Advanced[Annotated[float, Meta(ge=0.01, le=10)]] = 0.7
    """Standard deviation of a Gaussian along the surface, s_perp, divided by the spacing of the Gaussians. The spacing
    is the edge of a cell, or the footprint of a pixel on the surface where that is larger."""
    uncertainty: Advanced[Annotated[float, Meta(ge=0, le=10)]] = 0.0
    """Standard deviations of an anchor's averaged depth to add (in quadrature) to the spacing, with "ray_aligned"."""
    gamma: Advanced[Annotated[float, Meta(ge=0.1, le=10)]] = 1.0
    """Elongation along the viewing ray, s_par = gamma * s_perp, with "ray_aligned"; at 1 a Gaussian is a sphere."""
    opacity: Advanced[PositiveShare] = 0.9
    """Opacity of a new Gaussian, 0…1. Fitting starts from it, and it weights the Gaussian when voxels receive features
    and colors; alpha does not depend on it."""
    initialization: Advanced[Literal["disc", "ray_aligned", "isotropic"]] = "disc"
    """Shape of a new Gaussian. "disc": flat on the surface, as thick as its place is uncertain, on the plane of its
    neighbors; "ray_aligned": the paper's geometry-aware initialization, along the viewing ray; "isotropic": spheres
    with the mean distance to the three nearest Gaussians, as in 3D Gaussian splatting. The last two need
    occupancy.projection=probabilistic."""
    edge: Advanced[Factor] = 0.05
    """Drop pixels whose depth differs from a neighbor's by more than this share of the depth. At an edge, a sensor
    reports depths that belong to neither side."""
    min_pixels: Advanced[Annotated[int, Meta(ge=1, le=1_000_000)]] = 2
    """Number of measurements that a cell needs; a cell too small for that many needs fewer."""


class FittingOptions(TypedOptions, frozen=True):
    """Layer 2: how Gaussians are fitted to the images."""

    rasterizer: str = "cpu"
    """The renderer: "cpu" (compiled), "gsplat" (CUDA), or "reference" (plain PyTorch, slow)."""
    passes: Annotated[int, Meta(ge=0, le=1000)] = 5
    """Number of times, at most, that keyframes are rendered and compared: at half the width, and the last time at the
    full width. Where many show the same, some are left out. Passes end early if they improve other views no more. 0 =
    keep the initial Gaussians."""
    means: Advanced[Literal["anchored", "free"]] = "anchored"
    """"anchored": means stay on the measured surface, and shapes stay near the initialization; "free": the images move
    every parameter, as in other systems (for comparison; makes occupancy worse)."""
    width: Annotated[int, Meta(ge=16, le=4096)] = 320
    """Width of the rendered images in pixels."""
    depth_weight: Advanced[Annotated[float, Meta(ge=1e-6, le=1e6)]] = 1.0
    """beta: a depth error of one meter weighs as much as a color error of the whole color range."""
    shape_weight: Advanced[Annotated[float, Meta(ge=0, le=1e6)]] = 0.1
    """Weight that keeps the outlines of anchored Gaussians near the initialization; it multiplies the mean squared
    logarithm of their change. A smaller value renders better (0.02: + 0.4 dB) and makes occupancy worse (by 0.5 to 1
    point of IoU)."""


class LanguageOptions(TypedOptions, frozen=True):
    """Layer 3: what the Gaussians mean in words."""

    encoder: str = "auto"
    """Turns images and words into features. "auto": the best model that is installed (freeocc3d models list), else
    "color", which needs no network and knows color names only."""
    keyframes: Annotated[float, Meta(gt=0, le=1e6)] | None = None
    """Keyframes to encode: a value up to 1 is a share of all keyframes, a larger one a number. If not all are encoded,
    sharp keyframes that together show the most surface are chosen. The time of layer 3 is proportional to this number.
    null = all, or as many as show 97 % of the surface for networks that answer any words."""
    visible_within: Advanced[Meters] = 0.02
    """A Gaussian is visible if the depth map shows something within this many meters of it…"""
    visible_share: Advanced[Annotated[float, Meta(ge=0, le=10)]] = 0.01
    """…plus this share of its depth, plus its own standard deviation along the ray; otherwise it is hidden. Where no
    depth was measured, the rendered depth of the Gaussians is used."""
    near: Advanced[Meters] = 0.5
    """Views count in proportion to 1 / depth^2; all views nearer than this many meters count the same."""
    border: Advanced[Annotated[float, Meta(ge=0, le=0.5)]] = 0.1
    """Width of the border of an image, as a share of its shorter side, in which views count less toward the edge:
    encoders see things there that the edge cuts off."""
    disagreement: Advanced[Factor | None] = 0.6
    """Leave out a region of a view if its features differ too much from those of the other views: by more than this
    share of the difference between two random places of the scene. null = leave out none."""


class VocabularyOptions(TypedOptions, frozen=True):
    """Names of what is in the scene, from a vision-language model. The word in a query competes with them."""

    endpoint: Annotated[str, Meta(min_length=1, description="an address")] | None = None
    """Address of an OpenAI-compatible server, such as http://localhost:11434/v1 (Ollama). Keyframes are sent to it.
    null = ask no model."""
    model: str = ""
    """Name of the model on the server."""
    api_key_env: VariableName | None = None
    """Name of the environment variable that holds the server's key; null = the server needs no key."""
    keyframes: Annotated[int, Meta(ge=1, le=10_000)] = 24
    """Largest number of keyframes to ask about; they are evenly spread."""
    timeout: Annotated[float, Meta(ge=0.1, le=86400)] = 60.0
    """Longest time in seconds to wait for one answer."""
    retries: Annotated[int, Meta(ge=0, le=100)] = 2
    """Number of times to repeat a question that got no answer."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.endpoint is not None and not self.model:
            raise ConfigError("'endpoint' names a server, so 'model' must name the model to ask there.")


class OccupancyOptions(TypedOptions, frozen=True):
    """Layer 4: how Gaussians become voxels."""

    voxel_size: VoxelEdge = 0.08
    """Edge of a voxel in meters."""
    finest: VoxelEdge | None = None
    """Edge of the smallest voxels in meters, such as 0.01 where the others have 0.08. Voxels are halved down to this
    size where the surface is not flat or its meaning changes. null = all voxels have one size."""
    projection: Advanced[Literal["integrated", "probabilistic", "poisson", "released"]] = "integrated"
    """What a Gaussian adds to a voxel: "integrated" (its mass inside the voxel), "probabilistic" (the paper's
    equations), "poisson" (with its opacity, in the form of the paper's code), "released" (a dilation, as the paper's
    code runs)."""
    cutoff: Advanced[Annotated[float, Meta(ge=0.1, le=10)]] = 3.0
    """Distance, in standard deviations, to which a Gaussian affects voxels."""
    threshold: Annotated[float, Meta(gt=0, lt=1)] = 0.5
    """A voxel is occupied if its alpha is at least this."""
    device: Device = "cpu"
    """Device that projects the Gaussians: "cpu" (compiled), or a GPU of torch such as "cuda:0"."""
    contradiction: Advanced[Positive] = 4.0
    """A voxel above the threshold is nevertheless free if the log-odds of the depth maps there (see carving) are at
    most minus this. 4 is ten depth maps that saw through the voxel, or more if others ended in it."""


class CarvingOptions(TypedOptions, frozen=True):
    """Layer 4: free space from depth maps."""

    margin: Advanced[Factor] = 1.0
    """A depth map sees through a voxel if its depth exceeds that of the voxel's center by this many voxel edges (plus
    three standard deviations of the depth)."""
    hit: Advanced[Factor] = 3.2
    """Log-odds that a depth map adds to the voxel in which it ends: eight times ``miss``, because most depth maps see
    past the center of a voxel that a surface fills in part. OctoMap's value of 0.85 loses 0.1 points of IoU."""
    miss: Advanced[Factor] = 0.4
    """Log-odds that a depth map subtracts from a voxel that it sees through: OctoMap's value, a probability of 0.4."""
    min_free: PositiveInt = 1
    """A voxel without surface is free if at least this many depth maps see through it."""
    every: NotNegativeInt = 1
    """Use every n-th tracked frame for free space, in addition to the keyframes; 0 = keyframes only."""
    no_return: Annotated[float, Meta(ge=0, le=1000)] = 0.0
    """Where a wide patch of a depth map has no measurement, space up to this many meters counts as seen through; 0 =
    such a patch has no effect. Use it only for sensors that fail just beyond their range: black, shiny and very near
    things have no depth either, and would be carved away."""
    ray_step: Advanced[Stride] = 16
    """Follow the ray of every n-th pixel (of more pixels if blocks are small) to find the blocks that a camera saw."""
