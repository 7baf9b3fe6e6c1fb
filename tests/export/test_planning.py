"""A planner's own software on an exported map: OMPL plans, FCL finds collisions in the OctoMap file."""

import numpy as np
import pytest
from exported_maps import map_of
from scenes import occupancy_of

from freeocc3d.core.transforms import quats_to_rotations, transform
from freeocc3d.core.types import OCCUPIED
from freeocc3d.export import export_map

fcl = pytest.importorskip("fcl")
pytest.importorskip("ompl")

RADIUS = 0.12
START, GOAL = (0.35, 0.35, 0.6), (2.05, 1.6, 0.6)
DOOR = range(13, 18)


def apartment():
    """Two rooms of 1.2 x 2.2 x 1.2 m, voxels of 0.1 m; the wall between them has a door at one end."""
    shell = {v for v in np.ndindex(25, 22, 13) if v[0] in (0, 24) or v[1] in (0, 21) or v[2] in (0, 12)}
    wall = {(12, j, k) for j in range(22) for k in range(13) if j not in DOOR or k > 9}
    free = [v for v in np.ndindex(25, 22, 13) if v not in shell and v not in wall]
    return occupancy_of(sorted(shell | wall), free=free)


def collision_free(path, tree_size):
    """Whether a sphere at a point touches nothing occupied, according to FCL and the file."""
    nodes = path.read_bytes().split(b"data\n", 1)[1]
    tree = fcl.CollisionObject(fcl.OcTree(tree_size, np.frombuffer(nodes, np.int8)))
    sphere = fcl.Sphere(RADIUS)

    def is_free(point):
        there = fcl.CollisionObject(sphere, fcl.Transform(np.asarray(point, float)))
        return fcl.collide(there, tree, fcl.CollisionRequest(), fcl.CollisionResult()) == 0

    return is_free


def planned(is_free, start, goal, low, high):
    """(N, 3) points of a path that OMPL's RRT-Connect finds, a centimeter apart; None without a path."""
    from ompl import base, geometric

    space = base.RealVectorStateSpace(3)
    bounds = base.RealVectorBounds(3)
    for axis in range(3):
        bounds.setLow(axis, float(low[axis]))
        bounds.setHigh(axis, float(high[axis]))
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(lambda state: is_free([state[axis] for axis in range(3)]))
    information = setup.getSpaceInformation()
    information.setStateValidityCheckingResolution(0.01 / space.getMaximumExtent())
    ends = []
    for point in (start, goal):
        state = space.allocState()
        for axis in range(3):
            state[axis] = float(point[axis])
        ends.append(state)
    setup.setStartAndGoalStates(*ends)
    setup.setPlanner(geometric.RRTConnect(information))
    setup.solve(20.0)
    if not setup.haveExactSolutionPath():
        return None
    path = setup.getSolutionPath()
    path.interpolate(int(path.length() / 0.01) + 2)
    return np.array([[state[axis] for axis in range(3)] for state in path.getStates()])


@pytest.mark.parametrize("turned", [False, True], ids=["map", "gravity"])
def test_a_planned_path_goes_through_the_door_and_no_occupied_voxel(tmp_path, turned) -> None:
    T = np.eye(4)
    if turned:  # the map's frame is that of a camera held anyhow
        quat = np.array((0.8, 0.3, -0.4, 0.33))
        T[:3, :3], T[:3, 3] = quats_to_rotations(quat / np.linalg.norm(quat)), (0.3, -0.7, 0.2)
    occupancy = apartment()
    scan_map = map_of(occupancy, T)
    export_map(scan_map, "octomap", tmp_path / "map.bt", {"frame": "gravity"})
    is_free = collision_free(tmp_path / "map.bt", 0.1)
    start, goal = transform(T, np.array([START, GOAL]))
    corners = transform(T, np.array(list(np.ndindex(2, 2, 2)), float) * (2.5, 2.2, 1.3))
    assert is_free(start)
    assert is_free(goal)
    assert not is_free(transform(T, np.array((1.25, 0.5, 0.6))))  # in the wall
    path = planned(is_free, start, goal, corners.min(axis=0), corners.max(axis=0))
    assert path is not None
    np.testing.assert_allclose(path[[0, -1]], (start, goal), atol=1e-6)
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 0.03
    in_map = transform(np.linalg.inv(T), path)
    occupied = {tuple(voxel) for voxel in occupancy.voxels(OCCUPIED).tolist()}
    assert not {tuple(voxel) for voxel in np.floor(in_map / 0.1).astype(int).tolist()} & occupied
    crossing = in_map[np.abs(in_map[:, 0] - 1.25) < 0.05]
    assert len(crossing)
    assert (crossing[:, 1] > DOOR[0] * 0.1).all()
