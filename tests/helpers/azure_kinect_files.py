"""Writes Matroska files as the recorder of the Azure Kinect does, element by element (RFC 9559)."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

SCALE_NS = 1000
"""The recorder's unit of times."""

CALIBRATION: dict[str, Any] = {
    "CalibrationInformation": {
        "Cameras": [
            {
                "Intrinsics": {
                    "ModelParameterCount": 14,
                    "ModelParameters": [
                        0.5122697949409485, 0.49451231956481934, 0.4921168386936188, 0.4921667277812958,
                        3.1305770874023438, 2.324939012527466, 0.1304156482219696, 3.458651542663574,
                        3.350114583969116, 0.6629416346549988, 0, 0, -5.11557373101823e-05, 8.132171933539212e-05,
                    ],
                    "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
                },
                "Location": "CALIBRATION_CameraLocationD0", "Purpose": "CALIBRATION_CameraPurposeDepth",
                "MetricRadius": 1.74, "SensorWidth": 1024, "SensorHeight": 1024,
                "Rt": {"Rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "Translation": [0, 0, 0]},
            },
            {
                "Intrinsics": {
                    "ModelParameterCount": 14,
                    "ModelParameters": [
                        0.4967627227306366, 0.5108628273010254, 0.470907062292099, 0.6274453997612,
                        0.7227460145950317, -2.8855903148651123, 1.6327226161956787, 0.6021990180015564,
                        -2.7196261882781982, 1.565053105354309, 0, 0, -0.0001431911950930953, 0.0007828465895727277,
                    ],
                    "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
                },
                "Location": "CALIBRATION_CameraLocationPV0", "Purpose": "CALIBRATION_CameraPurposePhotoVideo",
                "MetricRadius": 0, "SensorWidth": 4096, "SensorHeight": 3072,
                "Rt": {
                    "Rotation": [
                        0.9999893307685852, 0.0016191748436540365, -0.004320160020142794, -0.001163218286819756,
                        0.9946256279945374, 0.103530153632164, 0.004464575555175543, -0.10352402180433273,
                        0.9946169257164001,
                    ],
                    "Translation": [-0.032072898864746094, -0.0020814547538757324, 0.0038745241165161133],
                },
            },
        ],
        "InertialSensors": [],
    }
}  # fmt: skip
"""The calibrations of real devices: intrinsics of one, extrinsics of another."""


def element(name: int, content: bytes, unknown_size: bool = False) -> bytes:
    head = name.to_bytes((name.bit_length() + 7) // 8, "big")
    size = b"\x01" + b"\xff" * 7 if unknown_size else struct.pack(">Q", len(content) | 1 << 56)
    return head + size + content


def number(name: int, value: int) -> bytes:
    return element(name, value.to_bytes(max(1, (value.bit_length() + 7) // 8), "big"))


def text(name: int, value: str) -> bytes:
    return element(name, value.encode())


def track(row: int, name: str, fourcc: str, size: tuple[int, int]) -> bytes:
    bits = {"b16g": 16, "MJPG": 24, "NV12": 12, "YUY2": 16}.get(fourcc, 24)
    length = size[0] * size[1] * bits // 8 % (1 << 32)
    header = struct.pack("<IiiHH4sIiiII", 40, *size, 1, bits, fourcc.encode(), length, 0, 0, 0, 0)
    video = element(0xE0, number(0xB0, size[0]) + number(0xBA, size[1]))
    content = number(0xD7, row) + number(0x73C5, 1000 + row) + number(0x83, 1) + text(0x536E, name)
    return element(0xAE, content + text(0x86, "V_MS/VFW/FOURCC") + element(0x63A2, header) + video)


def tag(name: str, value: str) -> bytes:
    return element(0x7373, element(0x63C0, b"") + element(0x67C8, text(0x45A3, name) + text(0x4487, value)))


def write_recording(
    path: Path,
    tracks: Sequence[tuple[str, str, tuple[int, int]]],
    blocks: Sequence[tuple[float, int, bytes]],
    tags: Mapping[str, str] | None = None,
    calibration: Any = CALIBRATION,
    unknown_sizes: bool = False,
) -> Path:
    """Write a file. tracks: (name, fourcc, size).  blocks: (seconds, row of the track from 0, data), ascending; those
    of 32 ms share a cluster, as the recorder does.  calibration: None = no attachment.  unknown_sizes: as if the
    recorder had been stopped by force."""
    content = element(0x1549A966, number(0x2AD7B1, SCALE_NS) + text(0x4D80, "libmatroska"))
    content += element(0x1654AE6B, b"".join(track(row + 1, *one) for row, one in enumerate(tracks)))
    if calibration is not None:
        data = element(0x465C, json.dumps(calibration).encode() + b"\0")
        file = text(0x466E, "calibration.json") + text(0x4660, "application/octet-stream") + number(0x46AE, 7) + data
        content += element(0x1941A469, element(0x61A7, file))
    every = {f"K4A_{name}_TRACK": str(1001 + row) for row, (name, _, _) in enumerate(tracks)} if tags is None else tags
    content += element(0x1254C367, b"".join(tag(*one) for one in every.items()))
    clusters: dict[int, list[tuple[float, int, bytes]]] = {}
    for block in blocks:
        clusters.setdefault(int(block[0] * 1e9 / SCALE_NS) // 32_000, []).append(block)
    for start, own in sorted(clusters.items()):
        inner = number(0xE7, start * 32_000)
        for row, (seconds, which, data) in enumerate(own):
            offset = round(seconds * 1e9 / SCALE_NS) - start * 32_000
            block = bytes((0x81 + which,)) + struct.pack(">hB", offset, 0) + data
            inner += element(0xA3, block) if row % 2 else element(0xA0, element(0xA1, block))
        content += element(0x1F43B675, inner, unknown_sizes)
    header = element(0x1A45DFA3, number(0x4286, 1) + text(0x4282, "matroska") + number(0x4287, 2))
    path.write_bytes(header + element(0x18538067, content, unknown_sizes))
    return path
