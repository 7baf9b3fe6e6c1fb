"""Pose graph over keyframes: Open3D's Levenberg–Marquardt, with a line process that disables wrong edges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from ..core.transforms import invert, measure_pose_difference, nearest_rigid

_SWEEPS = 6  # largest number of rounds that remove closures which do not hold
_HELD_M, _HELD_DEG = 0.1, 5.0
"""Largest difference between optimized poses and a closure that holds."""

_DETOUR = 1000.0
"""Weight of an uncertain edge in certain edges: more than there are between two closures, so that paths avoid it."""

_CLOSURE_M = 0.05
"""Largest distance between corresponding points of two keyframes, meters. It scales the penalty for switching off a
closure (Choi et al., below). Open3D's default is 0.03."""

_PRUNED = 0.25  # weight of the line process below which Open3D removes a closure; its default

_AGREE_M, _AGREE_DEG = 0.3, 10.0
"""Largest disagreement of two closures about a submap's pose: the possible drift of its path between them."""


@dataclass(frozen=True)
class Edge:
    """A measured relative pose of two keyframes.

    T_target_source: (4, 4).  information: (6, 6), rotation before translation, as in Open3D.
    uncertain: whether the line process may disable the edge; odometry between neighbors is certain.
    """

    source: int
    target: int
    T_target_source: NDArray[np.float64]
    information: NDArray[np.float64]
    uncertain: bool


def drop_unsupported_closures(
    poses: Sequence[NDArray[np.float64]], submap: Sequence[int], edges: Sequence[Edge]
) -> list[Edge]:
    """Remove a loop closure between two submaps if no other closure of the two agrees with it, because a single closure
    may be wrong. poses: of the keyframes, each in its submap's frame.  submap: number of each keyframe's submap."""
    between: dict[tuple[int, int], list[tuple[int, NDArray[np.float64]]]] = {}
    kept = set()
    for n, e in enumerate(edges):
        a, b = submap[e.target], submap[e.source]
        if a == b or not e.uncertain:
            kept.add(n)
            continue
        T_a_b = poses[e.target] @ e.T_target_source @ invert(poses[e.source])
        ends, T = ((a, b), T_a_b) if a < b else ((b, a), invert(T_a_b))
        for other, T_other in between.setdefault(ends, []):
            meters, degrees = measure_pose_difference(T_other, T)
            if meters <= _AGREE_M and degrees <= _AGREE_DEG:
                kept |= {n, other}
        between[ends].append((n, T))
    return [edge for n, edge in enumerate(edges) if n in kept]


def find_connected_components(submap: Sequence[int], edges: Sequence[Edge]) -> list[list[int]]:
    """Keyframe rows of each connected component, the largest first. Edges connect submaps; the keyframes of one submap
    are always connected."""
    names, own = np.unique(np.asarray(submap, np.int64), return_inverse=True)
    ends = own[np.array([(edge.source, edge.target) for edge in edges], np.int64).reshape(-1, 2)].T
    graph = coo_array((np.ones(ends.shape[1], bool), tuple(ends)), shape=(len(names), len(names)))
    piece = connected_components(graph, directed=False)[1][own]
    rows = [np.flatnonzero(piece == number).tolist() for number in np.unique(piece)]
    return sorted(rows, key=lambda rows: (-len(rows), rows[0]))


def optimize_component(
    poses: Sequence[NDArray[np.float64]], edges: Sequence[Edge], rows: Sequence[int]
) -> list[NDArray[np.float64]]:
    """Poses of the connected keyframes ``rows``, in the frame of the first one: ``optimize`` for these only. The
    initial poses follow the edges where submaps meet."""
    place = {row: k for k, row in enumerate(rows)}
    own = [
        Edge(place[e.source], place[e.target], e.T_target_source, e.information, e.uncertain)
        for e in edges
        if e.source in place and e.target in place
    ]
    return optimize(_laid_out([poses[row] for row in rows], own), own)


def _laid_out(poses: list[NDArray[np.float64]], edges: Sequence[Edge]) -> list[NDArray[np.float64]]:
    """Chain poses along the edges from the first keyframe. Uncertain edges serve only where no certain edge does."""
    if len(poses) < 2:
        return poses
    measured = {}
    for e in sorted(edges, key=lambda e: not e.uncertain):  # the certain edge of two keyframes wins
        measured[e.source, e.target] = (e.uncertain, e.T_target_source)
    ends = np.array(list(measured))
    weights = [_DETOUR if uncertain else 1.0 for uncertain, _ in measured.values()]
    graph = coo_matrix((weights, (ends[:, 0], ends[:, 1])), shape=(len(poses), len(poses)))
    order, before = breadth_first_order(minimum_spanning_tree(graph.tocsr()), 0, directed=False)
    laid = [np.array(pose) for pose in poses]
    for k in order[1:].tolist():
        b = int(before[k])
        T_b_k = measured[k, b][1] if (k, b) in measured else invert(measured[b, k][1])
        laid[k] = nearest_rigid(laid[b] @ T_b_k)
    return laid


def optimize(poses: list[NDArray[np.float64]], edges: list[Edge]) -> list[NDArray[np.float64]]:
    """Keyframe poses T_world_keyframe that agree best with the edges; the first keeps its pose.

    A wrong closure may bend the path before the line process disables it. So closures that disagree with the result are
    left out, and the optimization restarts from the initial poses, until the used closures are those that agree.
    """
    used = edges
    for _ in range(_SWEEPS):
        placed = _optimized(poses, used)
        holding = [edge for edge in edges if not edge.uncertain or agrees_with_edge(placed, edge)]
        if len(holding) == len(used) and all(a is b for a, b in zip(holding, used, strict=True)):
            break
        used = holding
    return placed


def agrees_with_edge(poses: Sequence[NDArray[np.float64]], edge: Edge) -> bool:
    """Whether poses T_world_keyframe agree with the measurement of an edge."""
    meters, degrees = measure_pose_difference(invert(poses[edge.target]) @ poses[edge.source], edge.T_target_source)
    return meters <= _HELD_M and degrees <= _HELD_DEG


def _optimized(poses: list[NDArray[np.float64]], edges: list[Edge]) -> list[NDArray[np.float64]]:
    """One run of Levenberg–Marquardt with the line process.

    Source: S. Choi, Q.-Y. Zhou, V. Koltun, Robust Reconstruction of Indoor Scenes, CVPR 2015.
    """
    import open3d as o3d

    if len(poses) < 3 or len(edges) < len(poses):
        return poses  # a chain has no error to distribute
    registration = o3d.pipelines.registration
    graph = registration.PoseGraph()
    for pose in poses:
        graph.nodes.append(registration.PoseGraphNode(pose))
    for edge in edges:
        graph.edges.append(
            registration.PoseGraphEdge(edge.source, edge.target, edge.T_target_source, edge.information, edge.uncertain)
        )
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        registration.global_optimization(
            graph,
            registration.GlobalOptimizationLevenbergMarquardt(),
            registration.GlobalOptimizationConvergenceCriteria(),
            registration.GlobalOptimizationOption(
                max_correspondence_distance=_CLOSURE_M,
                edge_prune_threshold=_PRUNED,
                preference_loop_closure=1.0,
                reference_node=0,
            ),
        )
    return [np.asarray(node.pose) for node in graph.nodes]


def edges_to_arrays(edges: Sequence[Edge]) -> dict[str, NDArray[np.generic]]:
    """The edges as plain arrays, for saving."""
    return {
        "edge_nodes": np.array([(e.source, e.target, e.uncertain) for e in edges], np.int64).reshape(-1, 3),
        "edge_T_target_source": np.array([e.T_target_source for e in edges]).reshape(-1, 4, 4),
        "edge_information": np.array([e.information for e in edges]).reshape(-1, 6, 6),
    }


def edges_from_arrays(arrays: Mapping[str, NDArray[np.generic]]) -> list[Edge]:
    """The inverse of ``edges_to_arrays``."""
    return [
        Edge(int(source), int(target), np.asarray(T), np.asarray(information), bool(uncertain))
        for (source, target, uncertain), T, information in zip(
            arrays["edge_nodes"].tolist(), arrays["edge_T_target_source"], arrays["edge_information"], strict=True
        )
    ]
