"""The choice of a depth sensor for a capture, where the configuration leaves it open."""

from __future__ import annotations

from ..capture import Capture
from ..capture.checks.sensor_recognition import recognize_sensor
from ..core.depth_sensors import AUTO
from ..settings.config import Settings


def choose_sensor(settings: Settings, capture: Capture) -> tuple[Settings, str]:
    """The settings with the sensor that the capture's depth tells, and a sentence about it; an empty one if the
    settings name a sensor, or if there is no depth."""
    if settings.capture.sensor != AUTO or not capture.has_depth:
        return settings, ""
    name = recognize_sensor(capture).name
    words = name.replace("_", " ")
    return settings.changed("capture", sensor=name), f"The noise of the depth is taken to be that of {words}."
