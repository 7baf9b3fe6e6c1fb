"""``freeocc3d view``: pictures from above, from a corner and from a place, and a video, of a map and of words."""

import itertools

import av
import cv2
import numpy as np
import pytest
from command_line import refused, run

from freeocc3d.query.scan_map import load_map
from freeocc3d.viewer import map_pictures, turntables
from freeocc3d.viewer.distinct_colors import distinct_colors
from freeocc3d.viewer.map_colorings import color_answers, color_map


def read(path) -> np.ndarray:
    return cv2.imread(str(path))[..., ::-1].astype(int)


def near(image, color, tolerance=40) -> int:
    return int((np.abs(image - np.array(color)).max(axis=-1) < tolerance).sum())


def test_a_picture_has_the_voxels_on_the_left_and_the_gaussians_on_the_right(room, tmp_path) -> None:
    run("view", room, "--picture", tmp_path / "m.png")
    picture = read(tmp_path / "m.png")
    views = picture[map_pictures.BAR : -map_pictures.BAR]
    assert views.shape == (2 * 620, 1600, 3)
    drawn = (views != 250).any(axis=2)
    for rows in (np.s_[:620], np.s_[620:]):
        left, right = drawn[rows, :800], drawn[rows, 800:]
        assert (left & right).sum() / (left | right).sum() > 0.7  # both show the same room at the same scale
        both = left & right
        assert np.abs(views[rows, :800][both] - views[rows, 800:][both]).mean() < 40


def test_words_are_colored_and_named_in_every_view(room, tmp_path) -> None:
    words = "yellow", "brown"
    run("view", room, "--picture", tmp_path / "w.png", *(part for word in words for part in ("--query", word)))
    run("view", room, "--picture", tmp_path / "one.png", "--query", words[0])
    both, one = read(tmp_path / "w.png"), read(tmp_path / "one.png")
    first, second = distinct_colors(2)
    for rows in (np.s_[60:670], np.s_[680:1290]):
        for columns in (np.s_[:800], np.s_[800:]):
            assert near(both[rows, columns], first) > 100
            assert near(both[rows, columns], second) > 100
        assert near(one[rows, :800], second) == 0


def test_from_a_place_one_sees_what_a_keyframe_there_saw(room, tmp_path) -> None:
    loaded = load_map(room)
    frame = loaded.trajectory.keyframes[1]
    T_world_cam = loaded.trajectory.T_world_cam[frame]
    place, target = T_world_cam[:3, 3], T_world_cam[:3, 3] + T_world_cam[:3, 2]
    run("view", room, "--picture", tmp_path / "p.png", "--from", *place, "--to", *target)
    picture = read(tmp_path / "p.png")
    assert picture.shape == (900, 1600, 3)
    views = picture[map_pictures.BAR : -map_pictures.BAR]
    photograph = np.asarray(loaded.keyframes[1].color)
    camera = loaded.keyframes[1].intrinsics
    scale = 0.6 * 800 / camera.fx
    size = round(scale * camera.width), round(scale * camera.height)
    seen = cv2.resize(photograph, size, interpolation=cv2.INTER_AREA).astype(int)
    height, width = (min(a, b) // 4 for a, b in zip(seen.shape, views.shape[:1] + (800,), strict=False))
    for panel in (views[:, :800], views[:, 800:]):
        shown, expected = (
            image[image.shape[0] // 2 - height : image.shape[0] // 2 + height,
                  image.shape[1] // 2 - width : image.shape[1] // 2 + width]
            for image in (panel, seen)
        )  # fmt: skip
        small = [
            cv2.resize(image.astype(np.float32), (16, 12), interpolation=cv2.INTER_AREA) for image in (shown, expected)
        ]
        assert np.corrcoef(small[0].ravel(), small[1].ravel())[0, 1] > 0.8


@pytest.mark.parametrize(
    ("place", "target", "said"),
    [
        ((0.5, 0.5, 1.2), (0.5, 0.5, 1.2), "towards the same place"),
        ((float("nan"), 0, 1), (0, 0, 1), "three finite numbers"),
        ((50, 50, 1), (60, 60, 1), "Nothing of the map is in view"),
        ((1e30, 0, 0), (0, 0, 0), "Nothing of the map is in view"),
    ],
)
def test_a_place_from_which_nothing_can_be_drawn_is_told(room, tmp_path, place, target, said) -> None:
    output = refused("view", room, "--picture", tmp_path / "p.png", "--from", *place, "--to", *target)
    assert said in output
    assert not list(tmp_path.iterdir())


def test_a_place_in_a_voxel_is_told_and_one_straight_above_is_drawn(room, tmp_path) -> None:
    loaded = load_map(room)
    occupancy = loaded.occupancy
    inside = occupancy.centers(occupancy.occupied_voxels(), occupancy.occupied_edges())[7]
    output = refused("view", room, "--picture", tmp_path / "p.png", "--from", *inside, "--to", *(inside + 1))
    assert "inside an occupied voxel" in output
    middle = loaded.trajectory.T_world_cam[loaded.trajectory.has_pose][:, :3, 3].mean(axis=0)
    run("view", room, "--picture", tmp_path / "p.png", "--from", *middle[:2], 2.5, "--to", *middle[:2], 0)
    views = read(tmp_path / "p.png")[map_pictures.BAR : -map_pictures.BAR]
    assert ((views[:, :800] != 250).any(axis=2)).mean() > 0.05


def test_a_video_goes_once_around_and_is_whole_or_not_there(room, tmp_path, monkeypatch) -> None:
    target = tmp_path / "v.mp4"
    done = run("view", room, "--video", target, "--seconds", "1", "--fps", "8", "--query", "brown")
    assert "video" in done.stderr
    with av.open(str(target)) as container:
        stream = container.streams.video[0]
        frames = [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(stream)]
        assert (stream.average_rate, stream.width, stream.height) == (8, *turntables.SIZE)
    assert len(frames) == 8
    assert all(near(frame, distinct_colors(1)[0], 60) > 100 for frame in frames)
    assert all(np.abs(a - b).mean() > 2 for a, b in itertools.pairwise(frames))
    assert "--overwrite" in refused("view", room, "--video", target)
    before = target.read_bytes()

    def broken(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(av.VideoFrame, "from_ndarray", staticmethod(broken), raising=False)
    loaded = load_map(room)
    with pytest.raises(Exception, match="the disk is full"):
        turntables.write_turntable(loaded, color_map(loaded), target, 1, 8, overwrite=True)
    assert target.read_bytes() == before
    assert list(tmp_path.iterdir()) == [target]


def test_without_h264_a_video_is_mpeg4(room, tmp_path, monkeypatch) -> None:
    loaded = load_map(room)
    monkeypatch.setattr(turntables, "_can_encode", lambda name: name == "mpeg4")
    turntables.write_turntable(loaded, color_map(loaded), tmp_path / "v.mp4", 1, 2)
    with av.open(str(tmp_path / "v.mp4")) as container:
        assert container.streams.video[0].codec_context.name == "mpeg4"
        assert len(list(container.decode(video=0))) == 2
    assert not turntables.__dict__["_can_encode"]("nothing")


def test_a_map_without_gaussians_shows_its_voxels_alone(room, tmp_path, monkeypatch) -> None:
    loaded = load_map(room)
    monkeypatch.setattr(map_pictures, "has_gaussians", lambda scan_map: False)
    map_pictures.write_both_picture(loaded, color_answers(loaded, []), tmp_path / "m.png")
    assert read(tmp_path / "m.png").shape == (900, 1600, 3)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--query", "red"], "in the viewer, type the word"),
        (["--html", "page.txt"], "use the name page.html"),
        (["--html", "page.html", "--live"], "--live opens the viewer"),
        (["other", "--html", "page.html"], "a file shows one map"),
        (["--picture", "m.png", "--from", "0", "0", "1"], "give both"),
        (["--video", "m.mp4", "--from", "0", "0", "1", "--to", "1", "1", "1"], "--picture OUT.png, too"),
        (["--picture", "m.png", "--query", "red", "--by", "class"], "leave it out with"),
        (["--video", "m.mp4", "--fps", "0"], "greater than or equal to 1"),
    ],
)
def test_options_that_do_not_fit_are_told(room, tmp_path, monkeypatch, options, said) -> None:
    monkeypatch.chdir(tmp_path)
    done = run("view", room, *options, code=2)
    assert said in " ".join(done.stderr.replace("│", " ").split())


def test_a_video_of_another_kind_is_refused_before_any_work(room, tmp_path) -> None:
    assert "v.mp4 in place of" in refused("view", room, "--video", tmp_path / "v.gif")
