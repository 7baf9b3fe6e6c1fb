"""Objects of the room: JSON, a glTF binary with a node for each (.glb), or 3D boxes in COCO's layout.

The ending of the name chooses between JSON and glTF. In glTF, a node is named after its object, such as "chair 3"; its
origin is the center of the object's box, its axes are the box's, and its mesh is the surface of the object's voxels.
The nodes' parent turns the frame so that up is +y.

`layout=coco` writes the layout of Omni3D, which extends COCO's: `images` are the keyframes that the map folder holds,
`categories` the most probable names, and `annotations` the boxes of objects in each keyframe that shows them, in pixels
(`bbox` of the visible voxels as COCO has it; `bbox2D_tight`, `bbox2D_proj`, `bbox2D_trunc` as corners) and in the
camera's frame (`center_cam`, `dimensions` = width, height, length along the object's z, y, x, `R_cam`, `bbox3D_cam`).
The object's x is its longer level edge, its y points down. Sources: T.-Y. Lin et al., Microsoft COCO, ECCV 2014;
G. Brazil et al., Omni3D, CVPR 2023, and the description of its annotations.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..core.errors import ConfigError, ExportError
from ..core.transforms import invert, project, transform
from ..core.types import Intrinsics
from ..occupancy.surface_faces import find_exposed_faces
from ..query.best_views import RegionView, best_views
from ..query.objects.description import describe_objects
from ..query.objects.object import Object
from ..query.scan_map import Map
from ..settings.typed_options import TypedOptions
from ..viewer.distinct_colors import distinct_colors
from .export_frames import UprightFrame, to_frame
from .gltf_files import Z_UP_TO_Y_UP, MeshNode, write_glb

REQUIRES: tuple[str, ...] = ()
ENDINGS = (".json", ".glb")

_CORNERS = np.array(
    [(-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1), (-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1)]
) / 2  # fmt: skip
"""Omni3D's order of corners, in edges of the box along the object's x, y, z."""
_BOX_OBJECT = np.array([(1.0, 0, 0), (0, 0, 1), (0, -1, 0)])  # R_box_object: x is kept, y points down


class Options(TypedOptions, frozen=True):
    """Layout, frame and color."""

    layout: Literal["objects", "coco"] = "objects"
    """Of JSON: "objects" as `freeocc3d objects --json` prints them, or "coco" for images, categories and annotations
    with 3D boxes, as Omni3D extends COCO."""
    frame: UprightFrame = "gravity"
    """Of centroids and meshes: "gravity" (walls along x and y) or "start" (z up, first camera at the origin)."""
    color: Literal["rgb", "object"] = "rgb"
    """Of meshes: "rgb" for the surface's own color, "object" for one color for each object."""


def write(scan_map: Map, path: Path, options: Options) -> None:
    """Writes the objects. Raises ExportError for a map in which none are found, ConfigError for a layout that the file
    cannot have, MapError for a broken keyframe."""
    if path.suffix.lower() == ".glb" and options.layout == "coco":
        raise ConfigError(f"The layout coco is JSON: end the name in .json, got '{path.name}'.")
    objects = scan_map.objects()
    if not objects:
        raise ExportError("No objects were found in the map.")
    T_frame_map = to_frame(scan_map, options.frame)
    if path.suffix.lower() == ".glb":
        _write_meshes(scan_map, objects, path, options, T_frame_map)
        return
    document = _coco(scan_map, objects) if options.layout == "coco" else {
        "version": __version__,
        "metric": scan_map.metric,
        "frame": options.frame,
        "T_frame_map": T_frame_map.tolist(),
        "objects": describe_objects(objects, scan_map.relations_of(objects), T_frame_map),
    }  # fmt: skip
    path.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _write_meshes(
    scan_map: Map, objects: Sequence[Object], path: Path, options: Options, T_frame_map: NDArray[np.float64]
) -> None:
    plain = distinct_colors(len(objects))
    described = describe_objects(objects, scan_map.relations_of(objects), T_frame_map)
    meshes = []
    for number, thing in enumerate(objects):
        chosen = np.zeros(len(scan_map.occupancy.colors), bool)
        chosen[thing.rows] = True
        positions, quads, rows = find_exposed_faces(scan_map.occupancy, chosen)
        own = transform(invert(thing.box.T_map_box), positions.astype(np.float64)).astype(np.float32)
        colors = scan_map.occupancy.colors[rows] if options.color == "rgb" else np.tile(plain[number], (len(rows), 1))
        name = f"{thing.name} {number + 1}"
        meshes.append(MeshNode(name, own, quads, colors, thing.box.T_map_box, described[number]))
    parent = {
        "name": "objects",
        "matrix": (Z_UP_TO_Y_UP @ T_frame_map).T.ravel().tolist(),
        "extras": {"frame": options.frame, "T_frame_map": T_frame_map.tolist(), "metric": scan_map.metric},
    }
    write_glb(path, meshes, parent)


def _coco(scan_map: Map, objects: Sequence[Object]) -> dict[str, Any]:
    """Returns the document of the layout "coco"."""
    views = scan_map.keyframes.views()
    cameras = dict(zip(scan_map.keyframes.frames, (camera for _, camera in views), strict=True))
    poses = dict(zip(scan_map.keyframes.frames, scan_map.trajectory.T_world_keyframe, strict=True))
    seen = best_views(scan_map.occupancy, scan_map.trajectory, scan_map.keyframes, objects, most=len(views))
    names = sorted({thing.name for thing in objects})
    found = [(number, view) for number, own in enumerate(seen) for view in own]
    annotations = [
        {
            "id": k,
            "image_id": view.frame,
            "category_id": names.index(objects[number].name) + 1,
            "category_name": objects[number].name,
            "dataset_id": 0,
            "object": number + 1,
            "score": round(objects[number].confidence, 4),
            **_boxes(objects[number], view, cameras[view.frame], poses[view.frame]),
        }
        for k, (number, view) in enumerate(found, start=1)
    ]
    return {
        "info": {"id": 0, "name": scan_map.path.name, "source": f"freeocc3d {__version__}", "metric": scan_map.metric},
        "images": [
            {
                "id": frame,
                "dataset_id": 0,
                "width": camera.width,
                "height": camera.height,
                "file_path": f"{path.parent.name}/{path.name}",
                "file_name": f"{path.parent.name}/{path.name}",
                "K": camera.matrix.tolist(),
                "T_map_cam": poses[frame].tolist(),
            }
            for frame, (path, camera) in zip(scan_map.keyframes.frames, views, strict=True)
        ],
        "categories": [{"id": k, "name": name, "supercategory": ""} for k, name in enumerate(names, start=1)],
        "annotations": annotations,
    }


def _boxes(thing: Object, view: RegionView, camera: Intrinsics, T_map_cam: NDArray[np.float64]) -> dict[str, Any]:
    """Returns the boxes of an object in a keyframe; -1 for what cannot be told."""
    T_cam_box = invert(T_map_cam) @ thing.box.T_map_box
    R_cam_object = T_cam_box[:3, :3] @ _BOX_OBJECT
    length, width, height = thing.box.extent.tolist()
    corners = _CORNERS * (length, height, width) @ R_cam_object.T + T_cam_box[:3, 3]
    behind = bool((corners[:, 2] <= 0).any())
    shown, cut, truncation = [-1.0] * 4, [-1.0] * 4, -1.0
    if not behind:
        pixels = project(corners, camera)[0]
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        edge = np.array((camera.width, camera.height))
        inner_low, inner_high = np.clip(low, 0, edge), np.clip(high, 0, edge)
        shown, cut = [*low.tolist(), *high.tolist()], [*inner_low.tolist(), *inner_high.tolist()]
        truncation = float(1 - np.prod(inner_high - inner_low) / max(np.prod(high - low), 1e-9))
    x0, y0, x1, y1 = view.box
    return {
        "bbox": [x0, y0, x1 + 1 - x0, y1 + 1 - y0],
        "area": (x1 + 1 - x0) * (y1 + 1 - y0),
        "iscrowd": 0,
        "valid3D": True,
        "bbox2D_tight": [x0, y0, x1 + 1, y1 + 1],
        "bbox2D_proj": np.round(shown, 2).tolist(),
        "bbox2D_trunc": np.round(cut, 2).tolist(),
        "bbox3D_cam": corners.round(4).tolist(),
        "center_cam": T_cam_box[:3, 3].round(4).tolist(),
        "dimensions": [round(width, 4), round(height, 4), round(length, 4)],
        "R_cam": R_cam_object.round(6).tolist(),
        "behind_camera": behind,
        "visibility": round(view.visible, 4),
        "truncation": round(truncation, 4),
        "segmentation_pts": -1,
        "lidar_pts": -1,
        "depth_error": -1,
    }
