"""Dense alignment: planes and poses of analytic scenes, normal equations against NumPy, undetermined directions."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA, wall_frame, with_sigma
from scipy.linalg import expm

from freeocc3d.capture import open_capture
from freeocc3d.core.depth_sensors import STRUCTURED_LIGHT
from freeocc3d.core.transforms import invert, measure_pose_difference, quats_to_rotations
from freeocc3d.core.types import Frame, Intrinsics
from freeocc3d.tracking.rgbd import dense_alignment, orb_features
from freeocc3d.tracking.rgbd.alignment_views import fit_planes, prepare_alignment_view
from freeocc3d.tracking.rgbd.dense_residuals import Weighting, linearize, make_equations


@pytest.fixture(scope="module")
def room():
    """The built-in room without noise: its poses are exact."""
    own = {"synthetic": {"frames": 60, "width": 320, "height": 240, "noise": False}}
    return open_capture("builtin:room", None, own)


def small_pose(degrees: float = 1.0, meters: float = 0.02, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis *= np.deg2rad(degrees) / np.linalg.norm(axis)
    T = np.eye(4)
    T[:3, :3] = quats_to_rotations(np.array([1.0, *(0.5 * axis)]) / np.linalg.norm([1.0, *(0.5 * axis)]))
    T[:3, 3] = rng.normal(size=3) * meters / np.sqrt(3)
    return T


def relative(capture, source: int, target: int) -> np.ndarray:
    return invert(capture.pose(target)) @ capture.pose(source)


# Views


@pytest.mark.parametrize("width", [160, 320, 640, 960])
def test_a_plane_is_fitted_exactly_where_the_views_camera_says(width) -> None:
    camera = Intrinsics(width, width * 3 // 4, 0.9 * width, 0.9 * width, 0.51 * width, 0.37 * width)
    v, u = np.mgrid[: camera.height, : camera.width]
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    depth = (2.0 / (1.0 + 0.4 * x - 0.3 * y)).astype(np.float32)  # the plane z + 0.4 x - 0.3 y = 2
    view = prepare_alignment_view(Frame(0, 0.0, np.zeros((*depth.shape, 3), np.uint8), depth, camera))
    assert view.covered > 0.95
    seen = view.points[..., 2] > 0
    np.testing.assert_allclose(view.points[seen] @ (0.4, -0.3, 1.0), 2.0, atol=1e-4)
    normal = np.array((0.4, -0.3, 1.0)) / np.linalg.norm((0.4, -0.3, 1.0))
    np.testing.assert_allclose(view.normals[seen], np.tile(normal, (seen.sum(), 1)), atol=1e-3)
    h, w = seen.shape
    at = np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1)[seen]
    fx, fy, cx, cy = view.camera
    projected = view.points[seen][:, :2] / view.points[seen][:, 2:] * (fx, fy) + (cx, cy)
    np.testing.assert_allclose(projected, at, atol=1e-3)


def test_fitting_takes_noise_away_and_keeps_edges() -> None:
    flat = prepare_alignment_view(wall_frame(2.0, seed=1))
    raw = wall_frame(2.0, seed=1).depth_m
    assert flat.points[..., 2][flat.points[..., 2] > 0].std() < 0.5 * raw.std()
    depth = np.full((120, 160), 2.0, np.float32)
    depth[:, 80:] = 3.0
    view = prepare_alignment_view(Frame(0, 0.0, np.zeros((120, 160, 3), np.uint8), depth, CAMERA))
    z = view.points[..., 2]
    assert set(np.unique(z.round(3)).tolist()) <= {0.0, 2.0, 3.0}


def plane_at(depth: np.ndarray, i: int, j: int, step: int, window: int) -> np.ndarray | None:
    """a, b, c of 1/z = a + b du + c dv around the middle of a square of pixels, by least squares; None where the depths
    that belong to one surface are too few, too near each other, or of a surface seen edge-on."""
    v0, u0 = (k * step + 0.5 * (step - 1) for k in (i, j))
    every, (v, u) = 2 if window >= 4 else 1, np.indices(depth.shape)
    square = (v // step == i) & (u // step == j) & (depth > 0)
    if not square.any():
        return None
    inverse, du, dv = 1.0 / np.where(depth > 0, depth.astype(float), np.inf), u - u0, v - v0
    near = inverse[square][np.argmin((du**2 + dv**2)[square])]
    rows, columns = (np.arange(int(c) - window + 1, int(c) + window + 1, every) for c in (v0, u0))
    around = np.isin(v, rows) & np.isin(u, columns) & (depth > 0)
    plane = np.array((near, 0.0, 0.0))
    for allowed in (0.04 * near, 0.012 * near):
        held = around & (np.abs(inverse - (plane[0] + plane[1] * du + plane[2] * dv)) <= allowed)
        if held.sum() < 8 or np.linalg.det(np.cov(du[held], dv[held], bias=True)) < 0.02 * window**4 / 9:
            return None
        rows_of = np.stack((np.ones(held.sum()), du[held], dv[held]), axis=1)
        plane = np.linalg.lstsq(rows_of, inverse[held], rcond=None)[0]
        if plane[0] <= 0:
            return None
    return plane


@pytest.mark.parametrize(("step", "window"), [(1, 3), (2, 4), (3, 5)])
def test_planes_are_those_of_least_squares_over_the_depths_of_one_surface(step: int, window: int) -> None:
    rng = np.random.default_rng(step)
    height, width, fx, fy, cx, cy = 24, 36, 30.0, 32.0, 17.3, 11.6
    v, u = np.indices((height, width))
    inverse = np.where(u < 14, 0.5 + 0.004 * v, 0.3 + 0.002 * (u - 14))  # two surfaces
    inverse[:, 26:] += 0.05 * (u[:, 26:] - 26)  # and one that is nearly seen edge-on
    depth = (1.0 / (inverse * (1 + 0.004 * rng.standard_normal(inverse.shape)))).astype(np.float32)
    depth[rng.random(depth.shape) < 0.3] = 0
    depth[:8, :8] *= rng.random((8, 8)) < 0.15
    points, normals = fit_planes(depth, step, window, fx, fy, cx, cy)
    refused = 0
    for i, j in np.ndindex(height // step, width // step):
        plane = plane_at(depth, i, j, step, window)
        expected, normal = np.zeros(3), np.zeros(3)
        if plane is not None:
            a, b, c = plane
            x, y = ((j * step + 0.5 * (step - 1)) - cx) / fx, ((i * step + 0.5 * (step - 1)) - cy) / fy
            across = np.array((b * fx, c * fy, a - b * fx * x - c * fy * y))  # n . X = 1 on the plane
            point = np.array((x, y, 1.0)) / a
            if 1.0 / (np.linalg.norm(across) * np.linalg.norm(point)) >= 0.12:
                expected, normal = point, across / np.linalg.norm(across)
        np.testing.assert_allclose(points[i, j], expected, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(normals[i, j], normal, atol=1e-4)
        refused += expected[2] == 0
    assert 0.03 < refused / points[..., 0].size < 0.9


def test_holes_and_depth_that_is_missing_altogether() -> None:
    frame = wall_frame(2.0)
    depth = frame.depth_m.copy()
    depth[:, :80] = 0
    half = prepare_alignment_view(replace(frame, depth_m=depth))
    assert 0.4 < half.covered < 0.55
    assert (half.points[half.points[..., 2] == 0] == 0).all()
    assert prepare_alignment_view(replace(frame, depth_m=np.zeros_like(depth))).covered == 0


# Alignment


@pytest.mark.parametrize(("source", "target"), [(1, 0), (13, 12), (31, 30), (47, 45)])
def test_the_pose_of_a_view_in_another_is_found(room, source, target) -> None:
    true = relative(room, source, target)
    a, b = prepare_alignment_view(room[source]), prepare_alignment_view(room[target])
    aligned = dense_alignment.align_views(a, b, small_pose() @ true)
    meters, degrees = measure_pose_difference(true, aligned.T_target_source)
    assert meters < 0.003
    assert degrees < 0.1
    assert aligned.determined
    assert aligned.inliers > 0.9
    assert aligned.correlation > 0.9


def test_another_exposure_moves_nothing(room) -> None:
    true = relative(room, 13, 12)
    darker = replace(room[13], color=(0.6 * room[13].color + 10).astype(np.uint8))
    b = prepare_alignment_view(room[12])
    plain = dense_alignment.align_views(prepare_alignment_view(room[13]), b, true)
    dark = dense_alignment.align_views(prepare_alignment_view(darker), b, true)
    meters, degrees = measure_pose_difference(plain.T_target_source, dark.T_target_source)
    assert meters < 5e-4
    assert degrees < 0.02


def test_holes_are_not_counted_as_disagreement(room) -> None:
    true = relative(room, 13, 12)
    target = room[12]
    depth = target.depth_m.copy()
    depth[::2] = 0
    depth[:, : depth.shape[1] // 2] = 0
    aligned = dense_alignment.align_views(
        prepare_alignment_view(room[13]), prepare_alignment_view(replace(target, depth_m=depth)), true
    )
    assert aligned.inliers > 0.9
    assert max(measure_pose_difference(true, aligned.T_target_source)) < 0.2


def test_a_bare_wall_tells_its_distance_and_not_a_slide_along_it() -> None:
    rng = np.random.default_rng(0)
    blank = [wall_frame(distance) for distance in (2.0, 2.05)]
    blank = [
        replace(frame, color=np.full_like(frame.color, 128), depth_m=frame.depth_m + 1e-3 * noise)
        for frame, noise in zip(blank, rng.normal(size=(2, 120, 160)).astype(np.float32), strict=True)
    ]
    guess = np.eye(4)
    guess[:3, 3] = 0.03, -0.02, 0.0
    aligned = dense_alignment.align_views(prepare_alignment_view(blank[1]), prepare_alignment_view(blank[0]), guess)
    assert not aligned.determined
    assert np.isnan(aligned.correlation)
    np.testing.assert_allclose(aligned.T_target_source[:3, 3], (0.03, -0.02, -0.05), atol=0.004)
    assert np.linalg.eigvalsh(aligned.information)[0] < 1e-3 * np.linalg.eigvalsh(aligned.information)[5]


def test_what_is_wrong_has_few_inliers_or_looks_different(room) -> None:
    a, b = prepare_alignment_view(room[30]), prepare_alignment_view(room[0])
    aligned = dense_alignment.align_views(a, b, np.eye(4))
    assert aligned.inliers < 0.6 or aligned.correlation < 0.8 or aligned.overlap < 0.3


def test_results_are_rigid_and_the_guess_is_left_alone(room) -> None:
    guess = small_pose() @ relative(room, 13, 12)
    kept = guess.copy()
    T = dense_alignment.align_views(
        prepare_alignment_view(room[13]), prepare_alignment_view(room[12]), guess
    ).T_target_source
    np.testing.assert_array_equal(guess, kept)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)


# The kernel against NumPy


def reference(source, target, T, brightness, scales, photometric, stride, stated=False):
    """Normal equations (8, 8), (8,) and the counts of ``linearize`` at full size, plainly."""
    fx, fy, cx, cy = target.camera
    h, w = source.points.shape[:2]
    i, j = np.mgrid[stride // 2 : h : stride, stride // 2 : w : stride].reshape(2, -1)
    p, ns, value_s = source.points[i, j].astype(float), source.normals[i, j].astype(float), source.gray[0][i, j]
    has = p[:, 2] > 0
    p, ns, value_s = p[has], ns[has], value_s[has].astype(float)
    counts = [has.sum()]
    x = p @ T[:3, :3].T + T[:3, 3]
    u, v = fx * x[:, 0] / x[:, 2] + cx, fy * x[:, 1] / x[:, 2] + cy
    inside = (x[:, 2] >= 0.1) & (u >= 0.5) & (v >= 0.5) & (u <= w - 1.5) & (v <= h - 1.5)
    counts.append(inside.sum())
    p, x, ns, u, v, value_s = p[inside], x[inside], ns[inside], u[inside], v[inside], value_s[inside]
    it, jt = (v + 0.5).astype(int), (u + 0.5).astype(int)
    q, n = target.points[it, jt].astype(float), target.normals[it, jt].astype(float)
    met = q[:, 2] > 0
    counts.append(met.sum())
    met &= ((ns @ T[:3, :3].T) * n).sum(axis=1) >= 0.6
    p, x, q, n, u, v, value_s = p[met], x[met], q[met], n[met], u[met], v[met], value_s[met]
    r = (n * (x - q)).sum(axis=1)
    if stated:
        sigma = np.hypot(target.sigma_m[it, jt][met], source.sigma_m[i, j][has][inside][met])
    else:
        sigma = np.hypot(STRUCTURED_LIGHT.compute_sigma(q[:, 2]), STRUCTURED_LIGHT.compute_sigma(p[:, 2])).astype(float)
    k = np.abs(r) / sigma
    counts.append((k < 3 * scales[0]).sum())
    weight = 1 / (1 + (k / (2.4 * scales[0])) ** 2) ** 2 / (sigma * scales[0]) ** 2
    J = np.concatenate((np.cross(x, n), n, np.zeros((len(n), 2))), axis=1)
    H, g = (J * weight[:, None]).T @ J, (J * weight[:, None]).T @ r
    same = k <= 6 * scales[0]
    x, u, v, value_s = x[same], u[same], v[same], value_s[same]
    iu, iv = u.astype(int), v.astype(int)
    fu, fv = u - iu, v - iv
    G = target.gray[0].astype(float)
    a, b, c, d = G[iv, iu], G[iv, iu + 1], G[iv + 1, iu], G[iv + 1, iu + 1]
    value_t = (1 - fv) * ((1 - fu) * a + fu * b) + fv * ((1 - fu) * c + fu * d)
    gu, gv = (1 - fv) * (b - a) + fv * (d - c), (1 - fu) * (c - a) + fu * (d - b)
    rp = value_t - (brightness[0] * value_s + brightness[1])
    kp = np.abs(rp) * 100
    weight = photometric / (1 + (kp / (2.4 * scales[1])) ** 2) ** 2 / (1e-4 * scales[1] ** 2)
    direction = np.stack((gu * fx / x[:, 2], gv * fy / x[:, 2], np.zeros(len(x))), axis=1)
    direction[:, 2] = -(direction[:, 0] * x[:, 0] + direction[:, 1] * x[:, 1]) / x[:, 2]
    J = np.concatenate((np.cross(x, direction), direction, -value_s[:, None], -np.ones((len(x), 1))), axis=1)
    return H + (J * weight[:, None]).T @ J, g + (J * weight[:, None]).T @ rp, [*counts, len(x)]


@pytest.mark.parametrize("stated", [False, True])
@pytest.mark.parametrize("stride", [1, 2])
def test_normal_equations_are_those_of_a_plain_computation(room, stride, stated) -> None:
    frames = [with_sigma(room[n]) if stated else room[n] for n in (13, 12)]
    a, b = (prepare_alignment_view(frame) for frame in frames)
    T = small_pose(0.5, 0.01) @ relative(room, 13, 12)
    brightness, scales = np.array((0.9, 0.05)), np.array((2.0, 4.0))
    H, g, counts = reference(a, b, T, brightness, scales, 0.2, stride, stated)
    found, given = make_equations(), scales.copy()
    linearize(a.levels[0], b.levels[0], b.camera, T, stride, Weighting(given, brightness, 0.2), found)
    np.testing.assert_allclose(found.statistics[:5], counts, atol=2)
    np.testing.assert_allclose(found.H, H, rtol=2e-3, atol=1e-4 * np.abs(H).max())
    np.testing.assert_allclose(found.g, g, rtol=2e-3, atol=2e-3 * np.abs(g).max())
    assert not np.array_equal(given, scales)  # updated for the next step


def test_a_stated_standard_deviation_is_averaged_where_there_is_depth() -> None:
    frame = with_sigma(wall_frame(2.0))
    depth = frame.depth_m.copy()
    depth[::3] = 0
    wide = replace(frame, depth_m=depth, depth_sigma_m=np.where(depth > 0, 0.01, np.nan).astype(np.float32))
    view = prepare_alignment_view(wide)
    known = view.points[..., 2] > 0
    np.testing.assert_allclose(view.sigma_m[known & (view.sigma_m > 0)], 0.01, rtol=1e-5)
    unstated = prepare_alignment_view(wall_frame(2.0)).sigma_m
    np.testing.assert_array_equal(unstated, STRUCTURED_LIGHT.coefficients)


def test_gain_and_offset_are_eliminated_as_a_full_solution_would() -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(30, 8))
    H, g = A.T @ A, rng.normal(size=8)
    H6, g6 = dense_alignment.eliminate_brightness(H.copy(), g.copy())
    np.testing.assert_allclose(np.linalg.solve(H6, g6), np.linalg.solve(H, g)[:6], rtol=1e-6)


def test_a_step_is_the_exponential_map() -> None:
    xi = np.array((0.3, -0.2, 0.1, 0.5, 0.4, -0.3))
    twist = np.zeros((4, 4))
    twist[:3, :3] = np.cross(np.eye(3), xi[:3])
    twist[:3, 3] = xi[3:]
    T = small_pose(20, 0.5)
    moved = T.copy()
    dense_alignment.apply_twist(moved, xi)
    np.testing.assert_allclose(moved, expm(twist) @ T, atol=1e-9)


def test_directions_without_information_are_left_out_and_reported() -> None:
    H = np.diag((4.0, 4.0, 4.0, 1.0, 1.0, 1.0)) * 1e5
    kept, _, determined = dense_alignment.remove_undetermined(H, np.ones(6))
    assert determined
    np.testing.assert_allclose(kept, H, rtol=2e-3)
    H[3, 3] = 50.0  # what noise in the normals of a wall pretends
    kept, gradient, determined = dense_alignment.remove_undetermined(H, np.ones(6))
    assert not determined
    assert kept[3, 3] == 0
    assert gradient[3] == 0


# Features


def test_reprojection_is_the_derivative_of_its_error() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform((-1, -1, 1.5), (1, 1, 4), (40, 3)).astype(np.float32)
    T = small_pose(5, 0.2)
    moved = points @ T[:3, :3].T + T[:3, 3]
    rays = (moved[:, :2] / moved[:, 2:] + rng.normal(0, 1e-4, (40, 2))).astype(np.float32)
    H, g = np.zeros((6, 6)), np.zeros(6)
    assert orb_features.add_reprojection(points, rays, T, 500.0, H, g) == (40, 40)

    def errors(xi) -> np.ndarray:
        there = T.copy()
        dense_alignment.apply_twist(there, xi)
        x = points @ there[:3, :3].T + there[:3, 3]
        return 500.0 * (x[:, :2] / x[:, 2:] - rays).ravel()

    J = np.stack([(errors(1e-5 * e) - errors(-1e-5 * e)) / 2e-5 for e in np.eye(6)], axis=1)
    np.testing.assert_allclose(H, J.T @ J, rtol=0.01, atol=1e-3 * np.abs(H).max())
    np.testing.assert_allclose(g, J.T @ errors(np.zeros(6)), rtol=0.02, atol=1e-2 * np.abs(g).max())


def test_features_find_a_pose_that_is_far_away(room) -> None:
    a, b = room[17], room[12]
    view_a, view_b = prepare_alignment_view(a), prepare_alignment_view(b)
    fa, fb = orb_features.detect_features(a), orb_features.detect_features(b)
    rows = orb_features.match_binary(fa, fb)
    points = orb_features.lift_rays(fa.rays(a.intrinsics), view_a)[rows[:, 0]]
    known = points[:, 2] > 0
    found = orb_features.estimate_pose(points[known], fb.rays(b.intrinsics)[rows[known, 1]], 1.0 / b.intrinsics.fx)
    assert found is not None
    meters, degrees = measure_pose_difference(relative(room, 17, 12), found[0])
    assert meters < 0.08
    assert degrees < 2
    aligned = dense_alignment.align_views(view_a, view_b, found[0])
    assert measure_pose_difference(relative(room, 17, 12), aligned.T_target_source)[0] < 0.005


def test_an_image_without_corners_has_no_features() -> None:
    frame = Frame(0, 0.0, np.full((120, 160, 3), 90, np.uint8), np.full((120, 160), 2, np.float32), CAMERA)
    none = orb_features.detect_features(frame)
    assert none.pixels.shape == (0, 2)
    assert orb_features.match_binary(none, none).shape == (0, 2)
    assert orb_features.estimate_pose(np.zeros((0, 3), np.float32), np.zeros((0, 2), np.float32), 0.01) is None
