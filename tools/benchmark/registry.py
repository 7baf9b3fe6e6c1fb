"""Every variant by name: ablations, peers, and other measurements."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from . import ablations
from .ablations import OURS, TRUE_CLASSES, TRUE_POSES
from .peer_rows import PEERS


@dataclass(frozen=True)
class Measurement:
    """A measurement in its own process, besides the rows of ablations and peers.

    measure: ``module:function`` that returns figures.  given: its arguments: none, ``capture``, ``captures`` (two),
    ``map_path``, or ``capture`` and ``before``, a checkout of an earlier tree.  map_of: the ablation whose map it uses.
    lines: ``module:function`` from one process's figures to lines of what was measured and its goal.  table: instead of
    it, from all rows to lines of Markdown.
    """

    title: str
    given: Literal["nothing", "capture", "captures", "map", "earlier"]
    measure: str
    lines: str = ""
    table: str = ""
    map_of: str = ""


MEASUREMENTS = {
    "splat": Measurement(
        "Gaussians a second through layer 4's projection, and the least time that its arithmetic and memory need",
        "nothing",
        "splat_speed:measure_splat",
        lines="splat_speed:splat_lines",
    ),
    "voxels": Measurement(
        "layer 4 without the projection: features in voxels, carving, codes, updates, adaptive voxels",
        "nothing",
        "voxel_speed:measure_voxels",
        lines="voxel_speed:voxels_lines",
    ),
    "query": Measurement(
        "seconds of a query, from a cold start and in a loaded map",
        "map",
        "query_speed:measure_query",
        lines="query_speed:query_lines",
        map_of=OURS,
    ),
    "rasterizer": Measurement(
        "forward and backward of 300,000 Gaussians: compiled, plain PyTorch, and gsplat on a GPU",
        "nothing",
        "rasterizer_speed:measure_rasterizer",
        lines="rasterizer_speed:rasterizer_lines",
    ),
    "encoders": Measurement(
        "model packages: size, seconds and error of each precision; what guided upsampling gains",
        "nothing",
        "encoder_precision:measure_encoders",
        lines="encoder_precision:encoders_lines",
    ),
    "lifting": Measurement(
        "bytes a second of the fusion of 512-dimensional features",
        "nothing",
        "lifting_speed:measure_lifting",
        lines="lifting_speed:lifting_lines",
    ),
    "encoding": Measurement(
        "what encoding by a quantized ViT-B/16 takes of a run",
        "capture",
        "encoding_time:measure_encoding",
        lines="encoding_time:encoding_lines",
    ),
    "patches": Measurement(
        f"class images averaged over patches, fused in the map of {TRUE_CLASSES}: image sizes, numbers of keyframes",
        "map",
        "averaged_patches:measure_patches",
        table="averaged_patches:tabulate_patches",
        map_of=TRUE_CLASSES,
    ),
    "stress": Measurement(
        "layer 1 on altered captures: what it reaches, what it loses, and whether it reports the loss",
        "capture",
        "tracking_stress:measure_stress",
        table="tracking_stress:tabulate_stress",
    ),
    "glued": Measurement(
        "layer 1 on two captures as if they were one, which must stay two submaps",
        "captures",
        "tracking_stress:measure_glued",
        table="tracking_stress:tabulate_stress",
    ),
    "lengths": Measurement(
        "layer 1 on the first 250, 500 and 1000 frames: seconds, and bytes of a keyframe",
        "capture",
        "tracking_stress:measure_lengths",
        table="tracking_stress:tabulate_lengths",
    ),
    "absent_words": Measurement(
        "names of things that are not there: how often they return a region",
        "capture",
        "absent_words:measure_absent_words",
        table="absent_words:tabulate_absent_words",
    ),
    "present_words": Measurement(
        "names of the classes that are there: how much of each is found, and how fast",
        "capture",
        "present_words:measure_present_words",
        table="present_words:tabulate_present_words",
    ),
    "objects": Measurement(
        "things found with class images and by shape and color, at own and at given poses: recall, precision, seconds",
        "capture",
        "objects:measure_objects",
        table="objects:tabulate_objects",
    ),
    "object_answers": Measurement(
        f"words asked of voxels and of whole objects, with simulated features of CLIP in the map of {TRUE_CLASSES}",
        "map",
        "object_answers:measure_object_answers",
        table="object_answers:tabulate_object_answers",
        map_of=TRUE_CLASSES,
    ),
    "words_by_chance": Measurement(
        "names that are there and names that are not, asked of maps with simulated CLIP features",
        "capture",
        "words_by_chance:measure_words_by_chance",
        table="words_by_chance:tabulate_words_by_chance",
    ),
    "viewer": Measurement(
        f"the map of {TRUE_CLASSES} and a building of a million voxels in a browser: seconds, memory, bytes",
        "map",
        "viewer:measure_viewer",
        lines="viewer:viewer_lines",
        map_of=TRUE_CLASSES,
    ),
    "exports": Measurement(
        "every exporter at 4 cm: seconds, memory, bytes; the plan for robots against the truth's",
        "capture",
        "exports:measure_exports",
        lines="exports:exports_lines",
    ),
    "plan": Measurement(
        f"the plan for robots of the map of {OURS} against the truth's",
        "map",
        "plan_agreement:measure_plan",
        lines="plan_agreement:plan_lines",
        map_of=OURS,
    ),
    "check": Measurement(
        f"what the map of {OURS} says of itself: at its own poses, at the capture's, at poses that drift",
        "map",
        "self_check:measure_check",
        lines="self_check:check_lines",
        map_of=OURS,
    ),
    "air": Measurement(
        "what moving people, panes and mixed edges, put into the depth, leave in the air of the map",
        "capture",
        "air:measure_air",
        table="air:tabulate_air",
    ),
    "upright": Measurement(
        "layers of voxels that hold the floor, and thickness of walls, of maps with voxels of 8 and of 4 cm",
        "capture",
        "upright_layers:measure_layers",
        table="upright_layers:tabulate_layers",
    ),
    "poses_from_color": Measurement(
        "poses from color alone: placed images, ATE and seconds, and those of pycolmap's pipeline at its defaults",
        "capture",
        "poses_from_color:measure_poses_from_color",
        table="poses_from_color:tabulate_poses_from_color",
    ),
    "stereo_depth": Measurement(
        "depth by multi-view stereo from color at true poses, against the capture's depth",
        "capture",
        "stereo_depth:measure_stereo",
        table="stereo_depth:tabulate_stereo",
    ),
    "fusion": Measurement(
        f"class images with regions flipped at random, fused in the map of {TRUE_CLASSES}",
        "map",
        "fusion_of_mistakes:measure_fusion",
        table="fusion_of_mistakes:tabulate_fusion",
        map_of=TRUE_CLASSES,
    ),
    "pose_check": Measurement(
        "given poses against depth: right ones that pass, distorted ones that are refused with their cause",
        "capture",
        "pose_mistakes:measure_pose_check",
        table="pose_mistakes:tabulate_pose_check",
    ),
    "formats": Measurement(
        "a piece in every format: ATE, and what opening and reading it cost (a quarter of an hour)",
        "capture",
        "formats:measure_formats",
        table="formats:tabulate_formats",
    ),
    "damaged_input": Measurement(
        "10,000 damaged inputs, runs that are killed, torn checkpoints: how they end (a quarter of an hour)",
        "nothing",
        "damaged_input:measure_damaged_input",
        lines="damaged_input:damaged_input_lines",
    ),
    "equal_maps": Measurement(
        "maps by one thread and by many, with an empty and a full cache of kernels: which files differ",
        "capture",
        "equal_maps:measure_equal_maps",
        lines="equal_maps:equal_maps_lines",
    ),
    "budget": Measurement(
        "seconds of a run by stage, against decoding alone; and with every third frame, for many keyframes",
        "capture",
        "budget:measure_budget",
        lines="budget:budget_lines",
    ),
    "first_run": Measurement(
        "seconds that a first run takes longer than a later one, with kernels compiled ahead of time and without",
        "nothing",
        "first_run:measure_first_run",
        lines="first_run:first_run_lines",
    ),
    "earlier_tree": Measurement(
        "seconds of reconstruct and of a cold query over those of the tree of --before",
        "earlier",
        "earlier_tree:measure_earlier_tree",
        lines="earlier_tree:earlier_tree_lines",
    ),
}

SUITES: dict[str, tuple[tuple[str, ...], tuple[str, ...] | None]] = {
    "quick": (
        ("house/bedroom",),
        (OURS, TRUE_POSES, TRUE_CLASSES, *PEERS, "splat", "voxels", "query", "rasterizer", "encoders", "lifting")
        + ("lengths",),
    ),
    "full": (("7scenes-kitchen", "house/bedroom", "house/living"), None),
}
"""Captures of the data folder, and variants (None = all)."""


def list_names() -> list[str]:
    """The names of all variants."""
    return [*ablations.list_ablations(), *PEERS, *MEASUREMENTS]


def describe_variants() -> list[str]:
    """A line for each variant, with what it lacks."""
    lines = []
    for name, ablation in ablations.read_ablations().items():
        lacking = f": not available, {ablation.lacking}" if ablation.lacking else ""
        lines.append(f"{name:<38} {ablation.title}{lacking}")
    titles = PEERS | {name: measurement.title for name, measurement in MEASUREMENTS.items()}
    return [*lines, *(f"{name:<38} {title}" for name, title in titles.items())]
