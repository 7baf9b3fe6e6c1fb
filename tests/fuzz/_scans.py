"""Sound captures of the formats of phones, sensors and data sets: a few tiny frames in each."""

from __future__ import annotations

import json
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np

DEPTHS = ("npy", "npz", "exr", "pgm", "pfm", "tiff", "tif")


def write_scans(folder: Path) -> list[str]:
    """Write each capture into a folder of its own, and return their names. A capture that is a file is alone there."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "capture"))
    for write in (_write_image_folders, _write_phones, _write_data_sets, _write_recordings, _write_bags):
        write(folder)
    return sorted(path.name for path in folder.iterdir())


def _write_image_folders(folder: Path) -> None:
    import test_image_folders
    import test_tum_rgbd
    from small_captures import SIZE, camera_matrix, pose_matrix, write_image, write_matrix

    for lists in (True, False):
        test_tum_rgbd.write_tum(folder / f"tum_{'with' if lists else 'without'}_lists", 4, lists)
    rgb = "rgb/{:04d}.png"
    for suffix in DEPTHS:
        test_image_folders.write_frames(folder / f"pairs_{suffix}", rgb, "depth/{:04d}." + suffix)
    plain = test_image_folders.write_frames(folder / "pairs_posed", rgb, "depth/{:04d}.png")
    K = camera_matrix()
    camera = {"width": SIZE[0], "height": SIZE[1], "intrinsic_matrix": K.T.reshape(-1).tolist()}
    (plain / "camera_intrinsic.json").write_text(json.dumps(camera))
    for i in range(4):
        write_matrix(plain / "pose" / f"{i:04d}.txt", pose_matrix(i))
        write_image(plain / "confidence" / f"{i:04d}.png", np.full(SIZE[::-1], 100, np.uint8))
    redwood = test_image_folders.write_frames(
        folder / "redwood", "color/{0:06d}-{0:012d}.png", "depth/{0:06d}-{0:012d}.png"
    )
    with (redwood / "trajectory.log").open("w") as log:
        for i in range(4):
            log.write(f"{i} {i} {i + 1}\n")
            np.savetxt(log, pose_matrix(i))
    numbers = test_image_folders.write_frames(folder / "calibrated", "rgb/{}.png", "depth/{}.png")
    (numbers / "calib").mkdir()
    for i in range(4):
        (numbers / "calib" / f"{i}.yaml").write_text(
            f"%YAML:1.0\n---\nimage_width: {SIZE[0]}\nimage_height: {SIZE[1]}\n"
            f"camera_matrix:\n   rows: 3\n   cols: 3\n   data: {K.reshape(-1).tolist()}\n"
        )
    np.savetxt(numbers / "poses.txt", [pose_matrix(i).reshape(16) for i in range(4)])


def _write_phones(folder: Path) -> None:
    import test_arkitscenes
    import test_polycam
    import test_record3d
    import test_stray_scanner

    test_arkitscenes.write_scan(folder / "arkitscenes")
    test_polycam.write_polycam(folder / "polycam")
    for name, video in (("stray", True), ("stray_images", False)):
        test_stray_scanner.write_stray(folder / name, 4, video=video)
    members = test_record3d.members(4)
    test_record3d.write_folder(folder / "record3d", members)
    (folder / "r3d").mkdir()
    test_record3d.write_r3d(folder / "r3d" / "scan.r3d", members)


def _write_data_sets(folder: Path) -> None:
    import test_bundlefusion
    import test_nerfstudio_depth
    from posed_captures import write_nerfstudio

    test_bundlefusion.write_bundlefusion(folder / "bundlefusion", 4)
    test_bundlefusion.write_bundlefusion(folder / "threerscan", 4, "sequence", "_info.txt", "pgm", 0.01)
    nerfcapture = write_nerfstudio(folder / "nerfcapture", 4, integer_depth_scale=0.001)
    test_nerfstudio_depth.change(nerfcapture, test_nerfstudio_depth.rename_to_depth_path)
    fisheye: dict[str, Any] = {"camera_model": "OPENCV_FISHEYE", "k1": 0.01, "k2": 0.0, "k3": 0.0, "k4": 0.0}
    write_nerfstudio(folder / "fisheye", 4, depth_unit_scale_factor=0.001, **fisheye)


def _write_recordings(folder: Path) -> None:
    import test_azure_kinect
    import test_scannet_sens
    from azure_kinect_files import write_recording

    for name, kinds in (("sens", (2, 1)), ("sens_plain", (0, 0))):
        (folder / name).mkdir()
        test_scannet_sens.write_sens(folder / name / "scan.sens", kinds=kinds)
    (folder / "kinect").mkdir()
    write_recording(folder / "kinect" / "scan.mkv", test_azure_kinect.TRACKS, test_azure_kinect.blocks())


def _write_bags(folder: Path) -> None:
    from ros_bags import Messages, stored_file, write_bag

    messages = Messages("bag")
    for name, compression in (("bag", ""), ("bag_lz4", "lz4"), ("bag_bz2", "bz2")):
        (folder / name).mkdir()
        write_bag(folder / name / "scan.bag", messages, _sent(messages), compression)
    for kind in ("db3", "mcap"):
        messages = Messages(kind)
        bag = write_bag(folder / f"{kind}_folder", messages, _sent(messages))
        (folder / kind).mkdir()
        stored = stored_file(bag)
        (folder / kind / f"scan{stored.suffix}").write_bytes(stored.read_bytes())
    _write_packed_bag(folder / "bag_packed")


def _write_packed_bag(folder: Path) -> None:
    """Color as JPEG, depth as compressedDepth of both kinds, in turn."""
    import test_ros_bag
    from ros_bags import COLOR, DEPTH, Messages, encode, write_bag
    from small_captures import SIZE, color_image, depth_image

    messages = Messages("bag")
    sent = [one for one in test_ros_bag.scan(messages) if one[0] not in (COLOR, DEPTH)]
    for i in range(4):
        color, depth, at = color_image(i), depth_image(i), test_ros_bag.second(i)
        form = ("png", "rvl")[i % 2]
        packed = encode(depth, ".png") if form == "png" else struct.pack("<II", *SIZE) + test_ros_bag.rvl(depth)
        sent += [
            (f"{COLOR}/compressed", i, messages.compressed(encode(color, ".jpg"), "rgb8; jpeg compressed bgr8", at)),
            (f"{DEPTH}/compressedDepth", i, messages.compressed(
                struct.pack("<iff", 0, 0, 0) + packed, f"16UC1; compressedDepth {form}", at)),
        ]  # fmt: skip
    folder.mkdir()
    write_bag(folder / "scan.bag", messages, sent)


def _sent(messages: Any) -> list[Any]:
    """Raw and compressed images of one camera, its place, and its way."""
    import test_ros_bag
    from ros_bags import START_S
    from small_captures import pose_matrix

    sent = test_ros_bag.scan(messages)
    for i in range(4):
        edge = ("map", "camera", pose_matrix(i))
        sent.append(("/tf", START_S * 10**9 + i * 10**8 + 9, messages.transforms(edge)))
    return sorted(sent, key=lambda one: one[1])
