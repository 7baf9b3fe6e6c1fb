"""What is in a map and how it was made, as text and as the document of ``info --json``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from msgspec import to_builtins

from ..core.warnings import read_notices

if TYPE_CHECKING:
    from ..query.scan_map import Map

_SHOWN_NAMES = 12


MEASURE_NAMES = {
    "step": "depth, from keyframe to keyframe",
    "revisit": "depth, at revisits",
    "step_gray": "gray values, from keyframe to keyframe",
    "revisit_gray": "gray values, at revisits",
    "seen_through": "occupied voxels that frames see through",
    "unmeasured": "occupied voxels in which no depth ends",
    "closures_refused": "loop closures that the poses contradict",
    "distortion": "smooth error of depth across the image",
    "psnr_held_out": "rendered frames between keyframes",
    "psnr_keyframes": "rendered keyframes",
    "rendered": "measured pixels that Gaussians cover",
    "posed": "used frames that have a pose",
}
"""What the measures of ``check`` are, in words."""


def summary_document(loaded: Map) -> dict[str, Any]:
    """What ``info --json`` prints."""
    manifest, report = loaded.manifest, loaded.report
    counts = manifest.counts
    return {
        "version": manifest.freeocc3d,
        "map": str(loaded.path),
        "capture": to_builtins(manifest.capture),
        "frames": counts.frames,
        "frames_with_pose": counts.frames_with_pose,
        "frame_status": report["frames"],
        "keyframes": len(manifest.keyframes),
        "submaps": counts.submaps,
        "submap_frames": [
            {key: submap[key] for key in ("first", "last", "frames", "keyframes", "mapped")}
            for submap in report.get("submaps", [])
        ],
        "color_focal": report.get("color_focal", 1.0),
        "gaussians": counts.gaussians,
        "voxels": {"occupied": counts.voxels.occupied, "free": counts.voxels.free},
        "metric": loaded.metric,
        "scale": to_builtins(manifest.scale),
        "up": list(manifest.up),
        "upright": to_builtins(manifest.upright),
        "T_first_camera": None if loaded.T_first_camera is None else loaded.T_first_camera.tolist(),
        "voxel_size_m": manifest.voxel_size_m,
        "finest_voxel_m": manifest.finest_m,
        "refined": to_builtins(manifest.refined),
        "encoder": manifest.encoder.name,
        "encoder_knows": loaded.text_encoder.knows,
        "vocabulary": to_builtins(manifest.vocabulary),
        "bytes": {
            name: sum(size for file, size in manifest.files.items() if file.split("/")[0] == name)
            for name in dict.fromkeys(file.split("/")[0] for file in manifest.files)
        },
        "seconds": report["seconds"],
        "relabeled": report.get("relabeled"),
        "peak_memory_bytes": report["peak_memory_bytes"],
        "check": report.get("check"),
        "warnings": report["warnings"],
    }


def summary_lines(loaded: Map) -> list[str]:
    """What ``info`` prints for people."""
    said = summary_document(loaded)
    lines = [
        f"map        {said['map']}  ({sum(said['bytes'].values()) / 1e6:.1f} MB)",
        f"capture    {said['capture']['path']}  ({said['capture']['format']})",
        _frames_text(said),
        *([_refined_text(said["refined"])] if said["refined"] else []),
        f"gaussians  {said['gaussians']:,}",
        _voxels_text(said),
        _upright_text(said["upright"]),
        *([] if said["scale"]["by"] == "sensor" else [_scale_text(said["scale"])]),
        f"encoder    {said['encoder']}, which knows {said['encoder_knows']}",
        *([_vocabulary_text(said["vocabulary"])] if said["vocabulary"] else []),
        f"time       {_seconds_text(said['seconds'])}",
        *([_relabeled_text(said["relabeled"])] if said["relabeled"] else []),
        f"memory     {said['peak_memory_bytes'] / 1e9:.2f} GB at peak",
        *([_check_text(said["check"], said["metric"])] if said["check"] else []),
    ]
    if said["submaps"] > 1:
        lines += [
            f"submap     frames {submap['first']} to {submap['last']}: {submap['frames']} with a pose, of these "
            f"{submap['keyframes']} as keyframes; {'mapped' if submap['mapped'] else 'apart, not in the map'}"
            for submap in said["submap_frames"]
        ]
    return lines + [f"warning    {notice.text}" for notice in read_notices(said["warnings"])]


def _frames_text(said: dict[str, Any]) -> str:
    used = said["frames"] - said["frame_status"].get("unused", 0)
    counts = ", ".join(f"{said[name]} {name[:-1]}{'s' if said[name] != 1 else ''}" for name in ("keyframes", "submaps"))
    return f"frames     {said['frames']} in the capture, {used} used, {said['frames_with_pose']} with a pose, {counts}"


def _refined_text(refined: dict[str, Any]) -> str:
    return (
        f"refined    {'a box of ' if 'box' in refined else 'from '}{refined['map']}, which has these frames and times"
    )


def _seconds_text(seconds: dict[str, float]) -> str:
    stages = ", ".join(f"{name} {value:.1f}" for name, value in seconds.items())
    return f"{sum(seconds.values()):.1f} s: {stages}"


def _relabeled_text(relabeled: dict[str, Any]) -> str:
    return f"relabeled  from {relabeled['map']} in {_seconds_text(relabeled['seconds'])}; the other times are its own"


def _voxels_text(said: dict[str, Any]) -> str:
    largest, smallest = said["voxel_size_m"], said["finest_voxel_m"]
    unit = "m" if said["metric"] else "units"
    edges = f"edge {largest:.3g} {unit}" if largest == smallest else f"edges {largest:.3g} to {smallest:.3g} {unit}"
    return f"voxels     {said['voxels']['occupied']:,} occupied, {said['voxels']['free']:,} free, {edges}"


def _upright_text(upright: dict[str, Any] | None) -> str:
    if upright is None:
        return "upright    no: an earlier map, in the frame of its first camera or poses (see freeocc3d upright)"
    floor = "the floor at z = 0" if upright["floor"] else "no floor is seen"
    walls = "walls along x and y" if upright["walls"] else "x along the first view"
    degrees = f"{upright['off_deg']:.1f} degrees"
    alone = {"cameras": f"which were rolled by {degrees}", "one view": "whose pitch nothing tells"}
    off = alone.get(upright["by"], f"{degrees} from that of the cameras")
    return f"upright    z up by the {upright['by']}, {off}; {floor}, {walls}"


def _scale_text(scale: dict[str, Any]) -> str:
    if not scale["metric"]:
        return "scale      unknown: lengths are not meters"
    told = {"given": "as given", "length": "by a known length", "camera height": "by the cameras' height"}
    times = "" if scale["factor"] == 1 else f", {scale['factor']:.4g} per unit of the tracker"
    return f"scale      meters, {told.get(scale['by'], 'by the poses')}{times}"


def _check_text(check: dict[str, Any], metric: bool) -> str:
    """The verdict, how far the keyframes' depth differs, and how much of the map frames see through."""
    told = {name: said for name, said in check["measures"].items() if said["value"] is not None}
    parts = [
        f"{length_text(told[name]['value'], metric)} {where}"
        for name, where in (("step", "from one keyframe to the next"), ("revisit", "at revisits"))
        if name in told
    ]
    depth = f", depth differs by {', by '.join(parts)}" if parts else ""
    through = told.get("seen_through")
    seen = f", {through['value']:.1%} of the occupied voxels are seen through" if through else ""
    verdict = check["verdict"]
    doubtful = [MEASURE_NAMES[name] for name, said in told.items() if said["verdict"] == verdict != "good"]
    why = f" ({'; '.join(doubtful)})" if doubtful else ""
    return f"check      {verdict or 'nothing to compare'}{why}{depth}{seen}"


def length_text(value: float, metric: bool) -> str:
    """A small length with its unit."""
    return f"{100 * value:.2f} cm" if metric else f"{value:.2g} units"


def _vocabulary_text(vocabulary: dict[str, Any]) -> str:
    names = vocabulary["names"]
    shown = ", ".join(f"{name} {entry['count']}" for name, entry in list(names.items())[:_SHOWN_NAMES])
    return (
        f"words      {len(names)} named by {vocabulary['model']} in {len(vocabulary['keyframes'])} keyframes"
        + (f": {shown}" if shown else "")
        + (", …" if len(names) > _SHOWN_NAMES else "")
    )
