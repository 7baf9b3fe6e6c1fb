"""Pose graph over keyframes: Open3D's Levenberg–Marquardt with a line process that switches off wrong edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Edge:
    """A measured relative pose of two keyframes.

    T_target_source: (4, 4); ``information`` (6, 6), rotation before translation as Open3D has it.
    uncertain: the line process may switch the edge off; odometry between neighbours is certain.
    """

    source: int
    target: int
    T_target_source: NDArray[np.float64]
    information: NDArray[np.float64]
    uncertain: bool


def optimize(poses: list[NDArray[np.float64]], edges: list[Edge]) -> list[NDArray[np.float64]]:
    """Keyframe poses T_world_keyframe that agree best with the edges; the first keeps its pose.

    Source: S. Choi, Q.-Y. Zhou, V. Koltun, Robust Reconstruction of Indoor Scenes, CVPR 2015.
    """
    import open3d as o3d

    if len(poses) < 3 or len(edges) < len(poses):
        return poses  # a chain has nothing to distribute
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
                max_correspondence_distance=0.05,
                edge_prune_threshold=0.25,
                preference_loop_closure=1.0,
                reference_node=0,
            ),
        )
    return [np.asarray(node.pose) for node in graph.nodes]
