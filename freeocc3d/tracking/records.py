"""The log that every tracker keeps: each frame relative to its keyframe, and the keyframes' poses."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..types import Trajectory

STATUSES = ("unused", "lost", "tracked", "keyframe")


@dataclass
class Records:
    """Per frame seen: index in the capture, row of its keyframe (-1 = lost), T_keyframe_cam, status and confidence.
    Frames hang on keyframes, so that a pose graph that moves a keyframe moves its frames with it."""

    index: list[int] = field(default_factory=list)
    keyframe: list[int] = field(default_factory=list)
    T_keyframe_cam: list[NDArray[np.float64]] = field(default_factory=list)
    status: list[int] = field(default_factory=list)
    confidence: list[float] = field(default_factory=list)
    keyframe_index: list[int] = field(default_factory=list)
    T_world_keyframe: list[NDArray[np.float64]] = field(default_factory=list)

    def add_keyframe(self, index: int, T_world_cam: NDArray[np.float64], confidence: float) -> None:
        """The frame becomes the next keyframe."""
        self.keyframe_index.append(index)
        self.T_world_keyframe.append(T_world_cam)
        self._add(index, len(self.keyframe_index) - 1, np.eye(4), "keyframe", confidence)

    def add_tracked(self, index: int, keyframe: int, T_keyframe_cam: NDArray[np.float64], confidence: float) -> None:
        """The frame hangs on a keyframe."""
        self._add(index, keyframe, T_keyframe_cam, "tracked", confidence)

    def add_lost(self, index: int) -> None:
        """The frame has no pose."""
        self._add(index, -1, np.full((4, 4), np.nan), "lost", 0.0)

    def _add(self, index: int, keyframe: int, T: NDArray[np.float64], status: str, confidence: float) -> None:
        self.index.append(index)
        self.keyframe.append(keyframe)
        self.T_keyframe_cam.append(T)
        self.status.append(STATUSES.index(status))
        self.confidence.append(confidence)

    def trajectory(self, timestamps: NDArray[np.float64]) -> Trajectory:
        """Poses of all frames of the capture, composed with the keyframes' present poses."""
        n = len(timestamps)
        T_world_cam = np.full((n, 4, 4), np.nan)
        status = np.full(n, "unused", dtype="<U8")
        confidence = np.zeros(n, np.float32)
        if self.index:
            rows = np.array(self.index)
            status[rows] = np.array(STATUSES)[self.status]
            confidence[rows] = self.confidence
            posed = np.array(self.keyframe) >= 0
            keyframes = np.array(self.keyframe)[posed]
            if len(keyframes):
                T_world_keyframe = np.stack(self.T_world_keyframe)[keyframes]
                T_world_cam[rows[posed]] = T_world_keyframe @ np.stack(self.T_keyframe_cam)[posed]
        return Trajectory(timestamps, T_world_cam, np.array(self.keyframe_index, np.int32), status, confidence)

    def to_arrays(self) -> dict[str, NDArray[np.generic]]:
        """Plain arrays, for saving."""
        return {
            "index": np.array(self.index, np.int64),
            "keyframe": np.array(self.keyframe, np.int64),
            "T_keyframe_cam": np.array(self.T_keyframe_cam, np.float64).reshape(-1, 4, 4),
            "status": np.array(self.status, np.int64),
            "confidence": np.array(self.confidence, np.float64),
            "keyframe_index": np.array(self.keyframe_index, np.int64),
            "T_world_keyframe": np.array(self.T_world_keyframe, np.float64).reshape(-1, 4, 4),
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[np.generic]]) -> Records:
        """The inverse of ``to_arrays``."""
        return cls(
            index=arrays["index"].tolist(),
            keyframe=arrays["keyframe"].tolist(),
            T_keyframe_cam=list(np.asarray(arrays["T_keyframe_cam"], np.float64)),
            status=arrays["status"].tolist(),
            confidence=arrays["confidence"].tolist(),
            keyframe_index=arrays["keyframe_index"].tolist(),
            T_world_keyframe=list(np.asarray(arrays["T_world_keyframe"], np.float64)),
        )
