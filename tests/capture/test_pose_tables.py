"""Tables of poses as other programs write them, and what is wrong with those that cannot be read."""

from pathlib import Path

import numpy as np
import pytest
from small_captures import data_folder, pose_matrix, write_scannet, write_seven_scenes

from freeocc3d.capture import PoseFile, open_capture, read_trajectory
from freeocc3d.core.errors import CaptureError
from freeocc3d.core.transforms import rotations_to_quats
from freeocc3d.tracking.trackers import file, known

COUNT = 6
POSES = np.stack([pose_matrix(i) for i in range(COUNT)])
QUATS = rotations_to_quats(POSES[:, :3, :3])
COLUMNS = {
    "t": np.arange(COUNT, dtype=float), "f": np.arange(COUNT, dtype=float), "1": np.arange(COUNT) + 1.0,
    **{axis: POSES[:, i, 3] for i, axis in enumerate("xyz")},
    **{f"q{axis}": QUATS[:, i] for i, axis in enumerate("wxyz")},
    "0": np.full(COUNT, 0.25),
}  # fmt: skip
TUM = "t x y z qx qy qz qw"
EUROC = "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
BIASES = ", v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1]"
SCALED = "timestamp frame x y z qx qy qz qw fx fy cx cy"


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return open_capture(write_seven_scenes(tmp_path_factory.mktemp("capture") / "scan", COUNT, poses=False))


def write_table(path: Path, columns: str, heading: str = "", unit: float = 1.0, between=" ", start=0.0) -> Path:
    values = {**COLUMNS, "t": (COLUMNS["t"] + start) * unit}
    rows = [[f"{values[name][row]:.12g}" if name != "_" else "" for name in columns.split()] for row in range(COUNT)]
    lines = [heading, *map(between.join, rows)] if heading else list(map(between.join, rows))
    path.write_bytes(("\n".join(lines) + "\n").encode())
    return path


@pytest.mark.parametrize(
    ("columns", "heading", "between"),
    [
        (TUM, "timestamp,tx,ty,tz,qx,qy,qz,qw", ","),
        (TUM, "timestamp, tx, ty, tz, qx, qy, qz, qw", ", "),
        (TUM, "timestamp;tx;ty;tz;qx;qy;qz;qw", ";"),
        (TUM, "time\tx\ty\tz\tq_x\tq_y\tq_z\tq_w", "\t"),
        (TUM, "# timestamp tx ty tz qx qy qz qw (camera to world, OpenCV axes, metres, seconds)", " "),
        (TUM, "# ground truth trajectory", " "),
        (TUM, "a heading of words", " "),
        (TUM, '"Time","X","Y","Z","QX","QY","QZ","QW"', ","),
        ("t x y z qw qx qy qz", "# timestamp tx ty tz qw qx qy qz", " "),
        ("t x y z qw qx qy qz", "#timestamp,p_x [m],p_y [m],p_z [m],q_w,q_x,q_y,q_z", ","),
        ("t x y z qx qy qz qw 1", "#timestamp x y z qx qy qz qw id", " "),
        ("t x y z qx qy qz qw 1", "", " "),
        ("t f x y z qx qy qz qw", "timestamp, frame, x, y, z, qx, qy, qz, qw", ", "),
        ("t f x y z qx qy qz qw", "", ","),
        ("t f x y z qx qy qz qw _ _ _ _", SCALED.replace(" ", ", "), ", "),
        ("t f x y z qx qy qz qw 0 _ 0 _", SCALED.replace(" ", ","), ","),
        ("f x y z qx qy qz qw", "frame_id x y z qx qy qz qw", " "),
        ("qw qx qy qz x y z t", "rot_w rot_x rot_y rot_z pos_x pos_y pos_z stamp", " "),
        (
            "t f x y z qx qy qz qw",
            "%time,field.header.seq,field.pose.position.x,field.pose.position.y,field.pose.position.z,"
            "field.pose.orientation.x,field.pose.orientation.y,field.pose.orientation.z,field.pose.orientation.w",
            ",",
        ),
    ],
)
def test_columns_are_read_by_their_names(scan, tmp_path, columns, heading, between) -> None:
    path = write_table(tmp_path / "poses.csv", columns, heading, between=between)
    np.testing.assert_allclose(read_trajectory(path).of_frames(scan), POSES, atol=1e-6)


def test_euroc_states_nanoseconds_and_w_first(scan, tmp_path) -> None:
    path = write_table(tmp_path / "data.csv", "t x y z qw qx qy qz", EUROC, 1e9, ",")
    np.testing.assert_allclose(read_trajectory(path).of_frames(scan), POSES, atol=1e-6)
    path = write_table(tmp_path / "gt.csv", "t x y z qw qx qy qz 0 0 0 0 0", EUROC + BIASES, 1e9, ",")
    np.testing.assert_allclose(read_trajectory(path).timestamps, np.arange(COUNT))


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e6, 1e9])
def test_times_in_other_units_become_seconds(scan, tmp_path, unit) -> None:
    path = write_table(tmp_path / "t.txt", TUM, unit=unit)
    np.testing.assert_allclose(read_trajectory(path).of_frames(scan), POSES, atol=1e-6)
    path = write_table(tmp_path / "u.txt", TUM, unit=unit, start=1_700_000_000.0)
    np.testing.assert_allclose(read_trajectory(path).times(), np.arange(COUNT) + 1.7e9)  # it can only be so


@pytest.mark.parametrize("name", ["timestamp_ns", "time [ns]", "t (nanoseconds)", "timestamp_nsec"])
def test_a_stated_unit_is_used(tmp_path, name) -> None:
    heading = ",".join([name, *TUM.split()[1:]])
    path = write_table(tmp_path / "t.txt", TUM, heading, 1e9, ",", start=0.5)
    np.testing.assert_allclose(read_trajectory(path).times(), np.arange(COUNT) + 0.5)


def test_times_that_match_as_seconds_stay_seconds(scan, tmp_path) -> None:
    path = write_table(tmp_path / "t.txt", TUM, start=1000.0)  # as milliseconds they would meet frame 1
    with pytest.raises(CaptureError, match=r"its times are 1000\.00 to 1005\.00 s, the capture's 0\.00 to 5\.00 s"):
        read_trajectory(path).of_frames(scan)


def test_rows_of_nan_are_frames_without_a_pose(scan, tmp_path) -> None:
    path = write_table(tmp_path / "t.txt", TUM)
    lines = path.read_text().splitlines()
    lines[2] = "2 nan nan nan nan nan nan nan"
    lines[4] = "4" + " NaN" * 7
    path.write_text("\n".join(lines))
    found = read_trajectory(path)
    T = found.of_frames(scan)
    assert np.isfinite(T[:, 0, 0]).tolist() == [True, True, False, True, False, True]
    tracker = file.load(file.Options(path=str(path)), scan)
    (notice,) = tracker.warnings
    assert notice.code == "poses-missing"
    assert "4 of 6 frames" in notice.text
    assert "holds 4 poses, and 2 rows without one; the other 2 have none of their own" in notice.text
    whole = file.load(file.Options(path=str(write_table(tmp_path / "w.txt", TUM))), scan)
    assert whole.warnings == ()


def test_fewer_poses_than_frames_are_told(scan, tmp_path) -> None:
    path = write_table(tmp_path / "t.txt", TUM)
    path.write_text("\n".join(path.read_text().splitlines()[:3]))
    (notice,) = file.load(file.Options(path=str(path)), scan).warnings
    assert "3 of 6 frames" in notice.text
    assert "holds 3 poses; the other 3 have none of their own" in notice.text


@pytest.mark.parametrize(
    "write",
    [
        lambda text: b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode(),
        lambda text: text.encode("utf-16"),
        lambda text: text.replace("\n", "\r").encode(),
        lambda text: "# Küche, 20° gedreht, \x85\n".encode("latin-1") + text.encode(),
        lambda text: text.replace(" ", ";").replace(".", ",").encode(),
        lambda text: text.replace(" ", "\t").encode(),
        lambda text: text.replace("\n", "  \n\n").encode(),
    ],
)
def test_files_of_other_systems_and_countries(scan, tmp_path, write) -> None:
    path = write_table(tmp_path / "t.txt", TUM)
    path.write_bytes(write(path.read_text()))
    np.testing.assert_allclose(read_trajectory(path).of_frames(scan), POSES, atol=1e-6)


def test_numbers_name_frames_where_times_do_not(scan, tmp_path) -> None:
    path = write_table(tmp_path / "t.csv", "t f x y z qx qy qz qw", "timestamp,frame,x,y,z,qx,qy,qz,qw", 1, ",", 1e6)
    np.testing.assert_allclose(read_trajectory(path).of_frames(scan), POSES, atol=1e-6)
    found = PoseFile(Path("x"), POSES[::-1], numbers=np.arange(COUNT)[::-1])
    np.testing.assert_allclose(found.of_frames(scan), POSES)
    np.testing.assert_allclose(found.times(), np.arange(COUNT)[::-1])


GOOD = "0 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (GOOD + "1 0 0 0 0 0 0 0.1 0.9\n", "line 2 has 9 numbers, the others have 8"),
        (GOOD * 2 + "1 0 0\n", "line 3 has 3 numbers, the others have 8"),
        ("0 0 0 0 0 0 0 1 0.5\n", "line 1 has 9 numbers, TUM has 8"),
        ("# a\n\n0 0 0 0 0 0 1\n", "line 3 has 7 numbers, TUM has 8"),
        ("# timestamp tx ty tz qx qy qz qw\n" + "0 0 0 0 0 0 0 1 5\n", "line 2 has 9 numbers, but its columns are 8"),
        ("timestamp tx ty tz qw qx qy qz\n" + "0 0 0 0 1 0 0\n", "line 2 has 7 numbers"),
        (GOOD + "\n1 0 0 here 0 0 0 1\n", "line 3 holds 'here', which is no number"),
        ("words\nmore words\n" + GOOD, "line 2 holds 'more'"),
        (GOOD + "1 0 0 nan 0 0 0 1\n", "line 2 holds a number that is not finite beside others that are"),
        (GOOD + "nan 0 0 0 0 0 0 1\n", "line 2 has no possible time"),
        (GOOD + "1 0 0 0 0 0 0 0\n", "line 2 has a quaternion that is all zeros"),
        (GOOD + "1 0 0 0 0 0 0 2\n", "line 2 has a quaternion that is not of length 1"),
        (GOOD + "1 0 0 1e10 0 0 0 1\n", "line 2 is too far away"),
        ("1 " * 65, "line 1 holds more than 64 numbers"),
        ("0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1\n", "line 4 has 3 numbers, where Open3D's .log has 4"),
        ("0 0 1\n1 0 0 0\n0 1 0 0\n", "the matrix after line 1 is cut off"),
        ("nan " * 7 + "\n", "line 1 has 7 numbers"),
        ("0 " + "nan " * 7 + "\n", "holds no pose"),
        ("# only\n", "it holds no numbers"),
    ],
)
def test_a_row_that_is_no_pose_is_named_with_its_line(tmp_path, text, said) -> None:
    (tmp_path / "t.txt").write_text(text)
    with pytest.raises(CaptureError, match="is not a trajectory") as told:
        read_trajectory(tmp_path / "t.txt")
    assert said in str(told.value)


MIRROR, SCALE = np.diag((1.0, 1.0, -1.0, 1.0)), np.diag((2.5, 2.5, 2.5, 1.0))
SHEAR = np.eye(4) + np.eye(4, k=1) * np.array([1, 0, 0, 0])[:, None]
FAULTS = [
    (POSES @ MIRROR, "has determinant -1 (mirrored axes, those of a left-handed world)"),
    (POSES @ SCALE, "has axes of length 2.5, not 1 (is it scaled?)"),
    (POSES @ SHEAR, "has axes that are not at right angles or not of one length"),
    (np.zeros_like(POSES), "is all zeros"),
    (POSES.transpose(0, 2, 1), "has the last row 0.05 0 0 1 (it is transposed, with the position in its last row)"),
]


@pytest.mark.parametrize(("T", "said"), FAULTS)
def test_matrices_that_are_not_rigid_say_why(tmp_path, T, said) -> None:
    np.savetxt(tmp_path / "k.txt", T.reshape(COUNT, 16)[1:])
    with pytest.raises(CaptureError, match="5 matrices, of which 5 are no rigid right-handed") as told:
        read_trajectory(tmp_path / "k.txt")
    assert f"number 1 {said}" in str(told.value)
    T = np.concatenate((POSES, T[1:2]))
    np.savetxt(tmp_path / "k.txt", T.reshape(len(T), 16))
    with pytest.raises(CaptureError, match="7 matrices, of which 1 is not a rigid right-handed"):
        read_trajectory(tmp_path / "k.txt")


@pytest.mark.parametrize(("T", "said"), FAULTS)
@pytest.mark.parametrize("form", ["scannet", "seven_scenes"])
def test_pose_files_of_which_none_is_rigid_say_why(tmp_path, form, T, said) -> None:
    write, folder, name = {
        "scannet": (write_scannet, "pose", "{}.txt"),
        "seven_scenes": (write_seven_scenes, "", "frame-{:06d}.pose.txt"),
    }[form]
    path = write(tmp_path / "scan", COUNT)
    files = [path / folder / name.format(index) for index in range(COUNT)]
    for index, one in enumerate(files):
        np.savetxt(one, T[index] if index else np.full((4, 4), -np.inf))
    with pytest.raises(CaptureError, match="holds 6 pose files, of which none is a rigid right-handed") as told:
        known.load(known.Options(), open_capture(path))
    assert f"{files[1].name} {said}" in str(told.value)
    np.savetxt(files[4], POSES[4])  # one is enough, the others are lost
    assert np.isfinite(known.load(known.Options(), open_capture(path)).poses_ahead()[:, 0, 0]).sum() == 1


@pytest.mark.parametrize(
    ("case", "name", "posed"),
    [
        ("traj_header_csv", "poses.csv", 20),
        ("traj_nan_row", "nan.txt", 18),
        ("traj_with_id", "rtabmap_format_11.txt", 20),
    ],
)
def test_files_of_other_people(case, name, posed) -> None:
    cases = data_folder().parent / "cases"
    if not cases.is_dir():
        pytest.skip(f"no cases in {cases}")
    scan = open_capture(cases / "_scan")
    assert np.isfinite(read_trajectory(cases / case / name).of_frames(scan)[:, 0, 0]).sum() == posed
