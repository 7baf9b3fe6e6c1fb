"""Reads the cameras that a calibration file of any usual form states.

JSON: Open3D's PinholeCameraIntrinsic, RealSense's (``ppx``, ``coeffs``), NeRF's (``fl_x``), a matrix or four numbers
under any usual key. YAML: ROS's camera_info, OpenCV's FileStorage, ORB-SLAM's settings (``Camera.fx``,
``DepthMapFactor``). Text: a matrix, ``fx fy cx cy``, lines of ``key = value`` such as ScanNet's, BundleFusion's and
3RScan's info files.

Sources: Open3D's and librealsense's JSON writers; ROS's camera_calibration_parsers; OpenCV's FileStorage; ORB-SLAM3's
settings files; the info files of BundleFusion and 3RScan.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError
from ...core.image_files import Size
from ...core.transforms import invert, is_rigid
from ...core.typed_documents import InvalidDocument, parse_json
from ...core.yaml_documents import parse_yaml
from ..files.number_files import read_text
from .camera_files import Calibration
from .lenses import Lens

MOST_BYTES = 1 << 16
"""Largest file that is taken for a calibration."""

_DEEPEST = 4
_SMALLEST_FOCAL = 8.0
"""Focal lengths below are in other units than pixels."""

_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_LINE = re.compile(r"\s*[\"']?([A-Za-z_][\w.\- ]*?)[\"']?\s*(?:[:=]\s*|\s+(?=[-+.\d\[]))(.*)")
_OTHER_SENSOR = re.compile(r"infra|\bir\d?\b|imu|right|camera2|lidar|extrin|pose|transform")

_FX = ("fx", "fl_x", "flx", "focal_x", "f_x", "focal_length_x", "focallengthx", "focal", "focal_length", "fl", "f")
_FY = ("fy", "fl_y", "fly", "focal_y", "f_y", "focal_length_y", "focallengthy")
_CX = ("cx", "ppx", "c_x", "mx", "center_x", "principal_x", "principal_point_x", "principalpointx", "u0")
_CY = ("cy", "ppy", "c_y", "my", "center_y", "principal_y", "principal_point_y", "principalpointy", "v0")
_WIDTH = ("width", "w", "image_width", "img_width", "imagewidth", "cols", "resolution_x")
_HEIGHT = ("height", "h", "image_height", "img_height", "imageheight", "rows", "resolution_y")
_MATRIX = ("intrinsic_matrix", "camera_matrix", "cameramatrix", "k", "intrinsic", "intrinsics", "camera_intrinsics",
           "camera_intrinsic", "intrinsics_matrix", "cam_k", "matrix")  # fmt: skip
_DISTORTION = ("distortion_coefficients", "distortion_coeffs", "dist_coeffs", "distcoeffs", "coeffs", "distortion", "d",
               "disto", "dist")  # fmt: skip
_UNITS = ("depthmapfactor", "depth_scale", "depthscale", "png_depth_scale", "depth_factor", "depthfactor",
          "depth_unit_scale_factor", "depth_shift", "depthshift", "integer_depth_scale")  # fmt: skip
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_ROLE = re.compile(r"(.+?)_?(colou?r|rgb|depth|d)")
_FISHEYE = re.compile(r"fisheye|equidistant|kannala|fish_eye")


@dataclass(frozen=True)
class StatedCamera:
    """One camera of a document. calibration: fx, fy, cx, cy, its image size and file.  distortion, fisheye: as in
    ``Lens``."""

    calibration: Calibration
    distortion: tuple[float, ...] = ()
    fisheye: bool = False

    def lens(self, size: Size) -> Lens:
        """The lens of images of ``size``. Raises CaptureError, as ``Calibration.camera`` does."""
        return Lens(self.calibration.camera(size), self.distortion, self.fisheye)


@dataclass
class CameraDocument:
    """What a file states. T_color_depth: (4, 4) depth to color camera frame.  units_per_meter: of stored depth."""

    color: StatedCamera | None = None
    depth: StatedCamera | None = None
    T_color_depth: NDArray[np.float64] | None = field(default=None, compare=False)
    units_per_meter: float | None = None


def read_cameras(path: Path) -> CameraDocument | None:
    """Read a calibration file; None if it states no camera and no unit. Raises CaptureError if it cannot be read."""
    text = read_text(path, MOST_BYTES)
    kind = path.suffix.lower()
    content = _json(text) if kind == ".json" else _yaml(text) if kind in (".yaml", ".yml") else None
    if content is None and kind != ".json":
        content = _numbers(text)
        content = read_key_values(text) if content is None else content
    if content is None:
        return None
    found = CameraDocument(units_per_meter=_units(content))
    for role, camera in _cameras(_sort_roles(content), str(path)):
        if role == "depth":
            found.depth = found.depth or camera
        else:
            found.color = found.color or camera
    found.T_color_depth = _extrinsics(content, path)
    if "depth" in path.stem.lower():
        found.color, found.depth = None, found.color or found.depth
    return found if found.color or found.depth or found.units_per_meter else None


def read_key_values(text: str) -> dict[str, Any]:
    """Lines of ``key = value``, ``key: value`` or ``key value`` with numbers; a list of numbers may go on over lines
    that hold nothing else. The last value of a key counts."""
    found, key = dict[str, Any](), ""
    for line in text.splitlines():
        match = _LINE.fullmatch(line)
        numbers = [float(number) for number in _NUMBER.findall(match[2] if match else line)]
        if match:
            key = match[1].strip().lower()
            found[key] = numbers if numbers else match[2].strip()
        elif key and numbers and not line.lstrip().startswith("#"):
            found[key] = (found[key] if isinstance(found[key], list) else []) + numbers
    return {key: value[0] if isinstance(value, list) and len(value) == 1 else value for key, value in found.items()}


def _json(text: str) -> Any:
    try:
        return parse_json(text)
    except InvalidDocument:
        return None


def _yaml(text: str) -> Any:
    """ROS prints ``---`` after a message; OpenCV writes ``%YAML:1.0`` and a tag of its own."""
    lines = [line for line in text.replace("!!opencv-matrix", "").splitlines() if not line.startswith("%")]
    parts = re.split(r"(?m)^---\s*$", "\n".join(lines))
    try:
        content = parse_yaml(next((part for part in parts if part.strip()), ""))
    except InvalidDocument:
        return None
    return content if isinstance(content, dict) else None


def _numbers(text: str) -> dict[str, Any] | None:
    """A file of nothing but numbers: a matrix, ``fx fy cx cy`` with distortion or size; None for any other file."""
    rows = []
    for line in text.replace(",", " ").splitlines():
        words = line.split("#")[0].split()
        if not all(map(_NUMBER.fullmatch, words)):
            return None
        rows += [[float(word) for word in words]] if words else []
    size: dict[str, Any] = {}
    if len(rows) == 4 and list(map(len, rows)) == [2, 3, 3, 3]:
        size, rows = {"width": rows[0][0], "height": rows[0][1]}, rows[1:]
    values = [value for row in rows for value in row]
    if len(rows) > 4 or (len(rows) == 2 and len(rows[0]) != 4):
        return None
    if len(values) in (9, 12, 16) and _matrix(values) is not None:
        return {**size, "k": values}
    if len(values) == 6 and all(side.is_integer() for side in values[:2]):
        return {"width": values[0], "height": values[1], **dict(zip(("fx", "fy", "cx", "cy"), values[2:], strict=True))}
    if len(values) not in (4, 8, 9):
        return None
    return {**dict(zip(("fx", "fy", "cx", "cy"), values[:4], strict=True)), "d": values[4:]}


def _sort_roles(content: Any) -> Any:
    """Nests ``Camera.fx`` as {"camera": {"fx": …}}, and ``fx_depth`` or ``m_calibrationDepthIntrinsic`` below its
    camera. Keys become lower case."""
    if not isinstance(content, Mapping):
        return content
    nested = dict[str, Any]()
    for key, value in content.items():
        name = str(key).lower()
        if name.startswith("m_"):
            name = name.removeprefix("m_")
            role = "depth" if "depth" in name else "color"
            own = name.replace("calibration", "").replace(role, "")
            nested.setdefault(role, {})[own] = value
        elif "." in name and not name.startswith("."):
            group, _, own = name.partition(".")
            _put(nested, group, own, value)
            if own in ("width", "height"):  # of all cameras, as in ORB-SLAM3's settings
                nested[own] = value
        elif (match := _ROLE.fullmatch(name)) and match[1] in (*_FX, *_FY, *_CX, *_CY, *_MATRIX, *_COEFFICIENTS):
            _put(nested, "depth" if match[2] in ("depth", "d") else "color", match[1], value)
        elif match and match[1] in ("width", "height"):
            _put(nested, match[2], match[1], value)
        elif (match := re.fullmatch(r"(colou?r|rgb|depth)_?(width|height)", name)) is not None:
            _put(nested, "depth" if match[1] == "depth" else "color", match[2], value)
        elif isinstance(nested.get(name), dict) and isinstance(value, Mapping):
            nested[name].update(_sort_roles(value))
        else:
            nested[name] = _sort_roles(value)
    return nested


def _put(nested: dict[str, Any], group: str, key: str, value: Any) -> None:
    inner = nested.setdefault(group, {})
    if isinstance(inner, dict):
        inner[key] = value


def _cameras(
    node: Any, source: str, role: str = "color", size: Size | None = None, depth: int = 0
) -> Iterator[tuple[str, StatedCamera]]:
    """All cameras of a document with their roles. size: that of the node around."""
    if not isinstance(node, Mapping) or depth > _DEEPEST:
        return
    sides = _list(node.get("resolution"))
    width, height = sides if sides and len(sides) == 2 else (_number(node, _WIDTH), _number(node, _HEIGHT))
    if width and height and not isinstance(node.get("data"), list):
        size = int(width), int(height)
    if values := _values(node):
        distortion, fisheye = _distortion(node)
        yield role, StatedCamera(Calibration(values, size, source), distortion, fisheye)
    for key, value in node.items():
        if not _OTHER_SENSOR.search(key):
            inner = "depth" if "depth" in key else role
            yield from _cameras(value, source, inner, size, depth + 1)


def _values(node: Mapping[str, Any]) -> tuple[float, float, float | None, float | None] | None:
    """fx, fy, cx, cy, pixels, that a node states; None if it states no focal length."""
    for key in _MATRIX:
        K = _matrix(_list(node.get(key)))
        if K is not None:
            return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
        four = _list(node.get(key))
        if four is not None and len(four) == 4 and min(four[:2]) >= _SMALLEST_FOCAL:
            return four[0], four[1], four[2], four[3]
    for key in ("focal_length", "focal", "fl"):
        both = _list(node.get(key))
        if both is not None and len(both) == 2:
            center = _list(node.get("principal_point"))
            return both[0], both[1], center[0] if center else None, center[-1] if center else None
    fx = _number(node, _FX)
    if fx is None or not _SMALLEST_FOCAL <= fx <= 1e6:
        return None
    return fx, _number(node, _FY) or fx, _number(node, _CX), _number(node, _CY)


def _matrix(values: list[float] | None) -> NDArray[np.float64] | None:
    """(3, 3) camera matrix of 9, 12 or 16 numbers, by rows or by columns; None if it is none."""
    if values is None or len(values) not in (9, 12, 16):
        return None
    M = np.array(values).reshape(3 if len(values) < 16 else 4, -1)
    K = M[:3, :3].T if len(values) != 12 and np.any(M[2, :2]) else M[:3, :3]
    usual = np.abs(K[2, :2]).max() < 1e-6 and abs(K[2, 2] - 1) < 1e-6 and abs(K[1, 0]) <= 1
    return K if usual and abs(K[0, 1]) <= 1 and min(K[0, 0], K[1, 1]) >= _SMALLEST_FOCAL else None


def _distortion(node: Mapping[str, Any]) -> tuple[tuple[float, ...], bool]:
    """Coefficients in OpenCV's order, and whether they are a fisheye's."""
    model = " ".join(str(node.get(key, "")) for key in ("distortion_model", "model", "type", "camera_model")).lower()
    fisheye = bool(_FISHEYE.search(model)) or node.get("is_fisheye") is True
    values = next((found for key in _DISTORTION if (found := _list(node.get(key)))), None)
    if values is None:
        values = [_number(node, (name,)) or 0.0 for name in _COEFFICIENTS]
        if fisheye:
            values = [_number(node, (name,)) or 0.0 for name in ("k1", "k2", "k3", "k4")]
    if not any(values) or "inverse" in model:
        return (), fisheye and any(values)
    count = 4 if fisheye else next((n for n in (4, 5, 8) if not any(values[n:])), len(values))
    return tuple((values + [0.0] * 4)[:count] if len(values) < count else values[:count]), fisheye


def _list(value: Any) -> list[float] | None:
    """The numbers of a list, of a list of lists, or of a matrix with ``data``; None for anything else."""
    if isinstance(value, Mapping):
        value = value.get("data")
    if not isinstance(value, list | tuple) or len(value) > 20:
        return None
    flat = [_finite(item) for row in value for item in (row if isinstance(row, list | tuple) else [row])]
    numbers = [item for item in flat if item is not None]
    return numbers if len(numbers) == len(flat) else None


def _number(node: Mapping[str, Any], keys: tuple[str, ...]) -> float | None:
    """The first of these keys that holds a finite number."""
    for key in keys:
        if (number := _finite(node.get(key))) is not None:
            return number
    return None


def _finite(value: Any) -> float | None:
    """A number that fits a float; None for anything else. Whole numbers of documents may have any length."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def _units(content: Any, depth: int = 0) -> float | None:
    """Depth units per meter that a document states, as units per meter or meters per unit; None if it states none."""
    if not isinstance(content, Mapping) or depth > _DEEPEST:
        return None
    simple = {str(key).lower().rpartition(".")[2].removeprefix("m_"): value for key, value in content.items()}
    stated = _number(simple, _UNITS)
    if stated is None and _number(simple, _FX) and (_number(simple, ("scale",)) or 0.0) >= 100:
        stated = _number(simple, ("scale",))
    if stated is not None and 1e-6 <= stated <= 1e6 and stated != 1:
        return round(stated if stated > 1 else 1 / stated, 3)
    return next((found for value in content.values() if (found := _units(value, depth + 1))), None)


def _extrinsics(content: Any, path: Path) -> NDArray[np.float64] | None:
    """(4, 4) depth to color camera frame of an info file, where each extrinsic maps a camera to the rig."""
    if not isinstance(content, Mapping):
        return None
    keys = {str(key).lower(): value for key, value in content.items()}
    found = []
    for kind in ("color", "depth"):
        values = _list(keys.get(f"m_calibration{kind}extrinsic"))
        T = np.eye(4) if values is None or len(values) != 16 else np.array(values).reshape(4, 4)
        if not is_rigid(T):
            raise CaptureError(f"{path}: m_calibration{kind.title()}Extrinsic is no rigid transform of 4 x 4 numbers.")
        found.append(T)
    T_color_depth: NDArray[np.float64] = invert(found[0]) @ found[1]
    return None if np.allclose(T_color_depth, np.eye(4)) else T_color_depth
