"""Finds the control groups of this process, in which a container or a service limits processors and memory."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

MEMBERSHIP, MOUNT = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")


class ControlGroup(NamedTuple):
    """A group, whose files state its limits. version: 1 or 2, which name the files differently."""

    folder: Path
    version: int


def find_groups(controller: str, membership: Path = MEMBERSHIP, mount: Path = MOUNT) -> Iterator[ControlGroup]:
    """Yield the groups of this process that may limit what a controller such as "cpu" or "memory" gives: its own ones
    and those that contain them.

    membership: lines of hierarchy:controllers:path (man 7 cgroups).  mount: mount point of the hierarchies.
    """
    for line in (read_line(membership) or "").splitlines():
        _, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if controllers and controller not in controllers.split(","):
            continue
        root = mount / controllers if controllers else mount
        own = root / path.lstrip("/")
        for folder in (own, *(parent for parent in own.parents if parent.is_relative_to(root))):
            yield ControlGroup(folder, 1 if controllers else 2)


def read_line(path: Path) -> str | None:
    """The text of a file of a group; None if there is none."""
    try:
        return path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        return None
