"""Depth cameras by the way in which they measure, and the noise of each, which all layers use:

    sigma(z) = a + b (z - z_0)^2.

Triangulation (structured light, stereo) measures a disparity, so its noise grows with the square of the depth. A time
of flight has nearly the same noise at all depths of a room.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class DepthSensor:
    """The standard deviation of depth. a: meters.  b: 1 / meters.  z_0: meters."""

    name: str
    a: float
    b: float
    z_0: float

    def compute_sigma(self, depth_m: NDArray[np.floating]) -> NDArray[np.float32]:
        """Standard deviations, meters, of depths, meters, of any shape."""
        return np.asarray(self.a + self.b * (depth_m - self.z_0) ** 2, np.float32)

    @property
    def coefficients(self) -> NDArray[np.float32]:
        """(1, 3) a, b and z_0."""
        return np.array([[self.a, self.b, self.z_0]], np.float32)


STRUCTURED_LIGHT = DepthSensor("structured_light", 0.0012, 0.0019, 0.4)
"""A projected pattern: Kinect v1, PrimeSense, Structure Sensor. Source: C. V. Nguyen, S. Izadi, D. Lovell, Modeling
Kinect Sensor Noise for Improved 3D Reconstruction and Tracking, 3DIMPVT 2012, axial noise."""

TIME_OF_FLIGHT = DepthSensor("time_of_flight", 0.00129, 0.0003, 0.833)
"""Kinect v2 and Azure Kinect, LiDAR of phones. Source: P. Fankhauser et al., Kinect v2 for Mobile Robot Navigation:
Evaluation and Modeling, ICAR 2015: 1.5 - 0.5 z + 0.3 z^2 millimeters on a surface that faces the camera."""

STEREO = DepthSensor("stereo", 0.0005, 0.0038, 0.0)
"""Two cameras: RealSense D400. Source: A. Grunnet-Jepsen, J. N. Sweetser, J. Woodfill, Tuning Depth Cameras for Best
Performance, Intel: 0.08 pixels of disparity, here of a focal length of 425 pixels and a baseline of 5 cm; and half the
millimeter of the stored depth."""

SENSORS = {sensor.name: sensor for sensor in (STRUCTURED_LIGHT, TIME_OF_FLIGHT, STEREO)}
"""The sensors by name."""

AUTO = "auto"
"""Stands for the sensor that the data tell."""


def find_sensor(name: str) -> DepthSensor:
    """The sensor of a name; structured light, which was the only one in older maps, for ``AUTO``."""
    return SENSORS.get(name, STRUCTURED_LIGHT)
