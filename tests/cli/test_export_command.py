"""``freeocc3d export`` and ``view``."""

import numpy as np
from command_line import refused, run


def test_export_and_view(room, tmp_path) -> None:
    run("export", room, "--format", "npz", "-o", tmp_path / "m.npz")
    run("export", room, "--format", "ply", "-o", tmp_path / "m.ply", "--set", "form=points")
    run("view", room, "--picture", tmp_path / "m.png", "--by", "class")
    assert {p.name for p in tmp_path.iterdir()} == {"m.npz", "m.ply", "m.png"}
    assert "--overwrite" in refused("export", room, "--format", "npz", "-o", tmp_path / "m.npz")
    assert "did you mean 'npz'" in refused("export", room, "--format", "npzz", "-o", tmp_path / "x")
    for name in ("m.bt", "m.ot", "m.yaml", "m.vdb", "m.glb", "m.geojson", "poses"):
        kind = {"m.bt": "octomap", "m.ot": "octomap", "m.yaml": "nav2", "m.vdb": "esdf"}.get(name, name.split(".")[-1])
        told = run("export", room, "--format", kind, "--frame", "start", "-o", tmp_path / name)
        assert int(told.stdout.split(": ")[1].split()[0].replace(",", "")) > 100
    assert "start or first-camera" in refused("export", room, "--format", "npz", "--frame", "up", "-o", tmp_path / "x")


def test_words_of_an_export_may_be_given_plainly(room, tmp_path) -> None:
    out, red = tmp_path / "m.yaml", ("export", room, "--format", "nav2", "-o", tmp_path / "m.yaml", "--set")
    assert run(*red, "avoid=red, white:0.3:50%").stderr == ""
    assert {p.name for p in tmp_path.iterdir()} >= {"m.red.yaml", "m.white.pgm", "m.avoid.yaml"}
    told = run(*red, "avoid=[orange]", "--overwrite").stderr
    assert told.startswith("warning: Nothing in this map looks like 'orange'")
    run("export", room, "--format", "npz", "-o", tmp_path / "b.npz", "--set", "box=0.5, -0.5, -0.5, 1.5, 0.5, 0.9")
    with np.load(tmp_path / "b.npz") as part:
        assert max(part["occupancy"].shape[:2]) <= 13  # 1 m of voxels of 8 cm
    before = out.read_bytes()
    assert "of 'avoid' is not valid YAML" in refused(*red, "avoid=[red", "--overwrite")
    assert "'carpet' is not understood" in refused(*red, "avoid=carpet", "--overwrite")
    assert out.read_bytes() == before
