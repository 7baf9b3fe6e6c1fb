"""Fitting: what it improves, what it must not change, and that it stays stable."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import CAMERA, lifted, random_gaussians, wall_frame

from freeocc3d.core.errors import ConfigError
from freeocc3d.core.transforms import quats_to_rotations
from freeocc3d.core.types import Frame
from freeocc3d.gaussians import anchors, fitting, rendered_views
from freeocc3d.gaussians.rasterizers import cpu

RASTERIZER = cpu.load()


def walls(count: int = 3) -> tuple[list[Frame], np.ndarray]:
    """A wall, textured as pixels are, from cameras a little apart."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 2, 3] = -0.1 * np.arange(count)
    return [wall_frame(2.0 + 0.1 * n, n) for n in range(count)], poses


def seen(frames, poses) -> list[rendered_views.CapturedView]:
    return [
        rendered_views.prepare_captured_view(frame, T, 160, torch.device("cpu"))
        for frame, T in zip(frames, poses, strict=True)
    ]


def fitted(g, views, passes: int = 15, **options):
    return fitting.fit_gaussians(g, views, RASTERIZER, fitting.Options(**options), passes)


def test_fitting_renders_closer_to_the_images_with_means_where_they_were() -> None:
    frames, poses = walls()
    g, views = lifted(frames, poses), seen(frames, poses)
    after = fitted(g, views)
    before_db, after_db = (rendered_views.measure_fidelity(x, views, RASTERIZER) for x in (g, after))
    assert after_db.psnr > before_db.psnr + 1
    assert after_db.depth_l1_m <= before_db.depth_l1_m + 1e-3
    kept = {tuple(mean) for mean in g.means.tolist()}
    assert len(after) > 0.95 * len(g)
    assert all(tuple(mean) in kept for mean in after.means.tolist())


def test_an_anchored_gaussian_keeps_its_axis_extent_and_mean_precision() -> None:
    frames, poses = walls()
    g = lifted(frames, poses, gamma=0.5)
    after = fitted(g, seen(frames, poses))
    row = {tuple(mean): n for n, mean in enumerate(g.means.tolist())}
    g = g[np.array([row[tuple(mean)] for mean in after.means.tolist()])]
    axes, before = (quats_to_rotations(x.quats_wxyz.astype(float))[:, :, 2] for x in (after, g))
    np.testing.assert_allclose(axes, before, atol=1e-4)
    np.testing.assert_allclose(after.scales[:, 2], g.scales[:, 2], rtol=1e-4)
    np.testing.assert_allclose((after.scales[:, :2] ** -2.0).mean(1), (g.scales[:, :2] ** -2.0).mean(1), rtol=1e-3)
    assert np.abs(after.scales[:, 0] / after.scales[:, 1] - 1).max() > 0.05
    np.testing.assert_allclose(np.linalg.norm(after.quats_wxyz, axis=1), 1, atol=1e-5)


def test_free_means_move_and_their_anchors_can_follow() -> None:
    frames, poses = walls()
    g = lifted(frames, poses)
    after = fitted(g, seen(frames, poses), means="free")
    still = {tuple(mean) for mean in g.means.tolist()}
    assert sum(tuple(mean) in still for mean in after.means.tolist()) < 0.1 * len(after)
    followed = anchors.anchor_in_place(after, poses)
    same = anchors.reanchor(followed, poses, poses)
    np.testing.assert_allclose(same.means, after.means, atol=1e-5)


def test_what_lies_beyond_the_depth_does_not_make_gaussians_grow() -> None:
    frames, poses = walls(1)
    depth = frames[0].depth_m.copy()
    depth[:, 80:] = 0  # bright there, and nothing is anchored
    color = frames[0].color.copy()
    color[:, 80:] = 255
    frames = [replace(frames[0], depth_m=depth, color=color)]
    g = lifted(frames, poses)
    after = fitted(g, seen(frames, poses), passes=30)
    rendered = rendered_views.render_gaussians(after, seen(frames, poses)[0], RASTERIZER)
    assert float(rendered.alpha[:, 90:].max()) < 0.2


@pytest.mark.parametrize("means", ["anchored", "free"])
@pytest.mark.parametrize("case", ["one color", "no depth in a frame", "one keyframe", "duplicates", "outliers", "far"])
def test_nothing_runs_away(case: str, means: str) -> None:
    frames, poses = walls()
    rng = np.random.default_rng(0)
    if case == "one color":
        frames = [replace(frame, color=np.full_like(frame.color, 200)) for frame in frames]
    elif case == "no depth in a frame":
        frames[1] = replace(frames[1], depth_m=np.zeros_like(frames[1].depth_m))
    elif case == "one keyframe":
        frames, poses = frames[:1], poses[:1]
    elif case == "duplicates":
        frames, poses = [frames[0]] * 3, np.tile(poses[0], (3, 1, 1))
    elif case == "outliers":
        for n, frame in enumerate(frames):
            depth = frame.depth_m.copy()
            wrong = rng.uniform(size=depth.shape) < 0.1
            depth[wrong] = rng.uniform(0.3, 6.0, np.count_nonzero(wrong))
            frames[n] = replace(frame, depth_m=depth)
    elif case == "far":
        poses[:, 0, 3] = 500.0
    g = lifted(frames, poses)
    after = fitted(g, seen(frames, poses), means=means)
    for name in ("means", "scales", "quats_wxyz", "opacities"):
        assert np.isfinite(getattr(after, name)).all()
    assert after.scales.max() <= 4.001 * g.scales.max()
    assert after.scales.min() >= 0.249 * g.scales.min()
    assert len(after) > 0.5 * len(g)


def test_no_passes_views_or_gaussians_change_nothing() -> None:
    frames, poses = walls(1)
    g = lifted(frames, poses)
    assert fitted(g, seen(frames, poses), passes=0) is g
    assert fitted(g, []) is g
    nothing = random_gaussians(0, 0)
    assert fitted(nothing, seen(frames, poses)) is nothing
    unseen = rendered_views.measure_fidelity(g, [], RASTERIZER)
    assert unseen.psnr is None


def test_fitting_twice_gives_the_same() -> None:
    frames, poses = walls()
    g, views = lifted(frames, poses), seen(frames, poses)
    once, again = fitted(g, views, passes=3), fitted(g, views, passes=3)
    np.testing.assert_allclose(once.scales, again.scales, rtol=1e-4)
    assert torch.get_num_threads() >= 1


def test_a_view_keeps_rays_and_picks_depth() -> None:
    frame = wall_frame(2.0)
    depth = frame.depth_m.copy()
    depth[:, 80:] = 3.0
    view = rendered_views.prepare_captured_view(replace(frame, depth_m=depth), np.eye(4), 80, torch.device("cpu"))
    assert view.color.shape == (60, 80, 3)
    assert set(np.unique(view.depth_m.numpy())) == {np.float32(2.0), np.float32(3.0)}
    assert view.camera == CAMERA.resized(80, 60)
    assert rendered_views.prepare_captured_view(frame, np.eye(4), 4000, torch.device("cpu")).camera == CAMERA


@pytest.mark.parametrize("wrong", [{"means": "wild"}, {"passes": -1}, {"shape_weight": -0.1}, {"width": 0}])
def test_options_out_of_range_are_refused(wrong) -> None:
    with pytest.raises(ConfigError):
        fitting.Options(**wrong)


def test_isotropic_gaussians_are_spheres_of_their_neighbors_distance() -> None:
    frames, poses = walls(1)
    g = lifted(frames, poses, initialization="isotropic")
    assert (g.scales == g.scales[:, :1]).all()
    inner = np.abs(g.means[:, :2]).max(axis=1) < 0.5
    assert np.median(g.scales[inner]) == pytest.approx(0.04, rel=0.2)
    assert len(anchors.make_isotropic(random_gaussians(1, 0))) == 1


@pytest.mark.parametrize("means", ["anchored", "free"])
def test_shapes_and_opacities_stay_within_their_bounds(means: str) -> None:
    """Free scales change by a factor of four at most; anchored ones by two, before their precision is restored."""
    cloud = random_gaussians(40, seed=1)
    made = {"anchored": fitting._Anchored, "free": fitting._Free}[means](cloud, fitting.Options(), torch.device("cpu"))
    rng = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name, tensor in made.by_name(made.values).items():
            if name != "quats":
                tensor.copy_(20 * torch.randn(tensor.shape, generator=rng))
        if means == "free":
            made.by_name(made.values)["quats"].mul_(3.0)
    given = made.by_name(made.values.clone())
    now = made.by_name(made.clamped(made.values, slice(None)))
    torch.testing.assert_close(now["logits"], given["logits"].clip(-6, 6))
    if means == "free":
        logs = torch.log(torch.from_numpy(cloud.scales))
        wanted = torch.clip(given["shape"], logs - np.log(4), logs + np.log(4))
        torch.testing.assert_close(now["shape"], wanted)
        assert (now["shape"] != given["shape"]).float().mean() > 0.8
        torch.testing.assert_close(now["quats"].norm(dim=1), torch.ones(40))
        torch.testing.assert_close(now["means"], given["means"])
    else:
        torch.testing.assert_close(now["outline"], given["outline"].clip(-np.log(2), np.log(2)))
        torch.testing.assert_close(now["turn"], given["turn"])
        precision = (1 / made.shapes(now, slice(None))[1][:, :2] ** 2).mean(dim=1)
        before = torch.from_numpy(1 / cloud.scales[:, :2] ** 2)
        change = torch.exp(-2 * now["outline"])
        restored = (before * change / change.mean(dim=1, keepdim=True)).mean(dim=1)
        torch.testing.assert_close(precision, restored, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("most", "expected"), [(np.inf, 5 * 3), (12, 3 * 3), (3, 3)])
def test_renderings_are_limited_but_for_the_last_pass(most: float, expected: int) -> None:
    """The last pass over three views counts as six small renderings, each pass before it as three."""
    frames, poses = walls()
    g, views, done = lifted(frames, poses), seen(frames, poses), []
    fitting.fit_gaussians(g, views, RASTERIZER, fitting.Options(), 5, done.append, most)
    assert done == list(range(1, expected + 1))
