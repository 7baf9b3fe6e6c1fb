"""Opens the storage of a bag: a .bag, .mcap or .db3 file, or a folder of rosbag2."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import CaptureError
from ...core.regular_files import check_content, open_regular, read_bytes
from ...core.typed_documents import InvalidDocument
from ...core.yaml_documents import parse_yaml
from ..files.file_bytes import DamagedFile
from ..files.numbered_files import list_folder
from . import bag1_store, database_store, mcap_store
from .bag1_store import Bag1Store
from .database_store import DatabaseStore, is_bag_database
from .mcap_store import McapStore
from .message_store import Messages, MessageStore, Place, decompress, join_messages

METADATA = "metadata.yaml"
SUFFIXES = (".mcap", ".db3")
"""Suffixes of the files of a rosbag2 folder."""

_METADATA_BYTES = 16 << 20
_PACKED = tuple(f"{suffix}.zstd" for suffix in SUFFIXES)


def is_bag(path: Path) -> bool:
    """Whether a file starts as a bag does, or is named like one, or a folder holds the files of rosbag2. Without
    metadata.yaml, it must hold nothing else: a bag may lie next to images that were taken from it."""
    if path.is_dir():
        names = list_folder(path)
        bags = [name.endswith((*SUFFIXES, *_PACKED)) for name in names]
        return any(bags) and (METADATA in names or all(bags))
    if path.suffix.lower() in (".bag", *SUFFIXES):
        return True
    try:
        start = _start(path)
    except OSError:
        return False
    if start.startswith(database_store.START):
        return is_bag_database(path)
    return start.startswith((bag1_store.START, mcap_store.START))


def open_store(path: Path) -> MessageStore:
    """The messages of a bag. Raises CaptureError for a bag that is damaged, or of another kind."""
    try:
        return _open_folder(path) if path.is_dir() else _open_file(path)
    except DamagedFile as error:
        raise CaptureError(f"{path} is not a readable ROS bag: {error}.") from error
    except OSError as error:
        raise CaptureError(f"Cannot read {error.filename or path}: {error.strerror}.") from error


def _start(path: Path) -> bytes:
    with open_regular(path) as stream:
        return stream.read(16)


def _open_file(path: Path) -> MessageStore:
    start = _start(path)
    if start.startswith(bag1_store.START):
        return Bag1Store(path)
    if start.startswith(mcap_store.START):
        return McapStore(path)
    if start.startswith(database_store.START):
        return DatabaseStore(path)
    raise DamagedFile(f"it holds {'nothing' if not start else 'none of the formats .bag 2.0, .mcap and .db3'}")


def _open_folder(folder: Path) -> MessageStore:
    stated = _read_metadata(folder)
    names = list_folder(folder)
    listed = stated.get("relative_file_paths")
    wanted = [str(name).replace("\\", "/").rpartition("/")[2] for name in listed] if isinstance(listed, list) else []
    found = [name for name in wanted or names if name.endswith(SUFFIXES) and name in names]
    if missing := [name for name in wanted if name not in names]:
        raise DamagedFile(f"its {METADATA} names {missing[0]}, which is missing")
    if not found and any(name.endswith(_PACKED) for name in names):
        raise DamagedFile("its files are compressed: unpack them with zstd -d, and remove metadata.yaml")
    if not found:
        raise DamagedFile("the folder holds no .mcap or .db3 file")
    compressed = str(stated.get("compression_mode") or "").lower() == "message"
    for name in found:
        check_content(folder / name)
    return JoinedStore([_open_file(folder / name) for name in found], compressed)


def _read_metadata(folder: Path) -> dict[str, Any]:
    """What metadata.yaml states about the bag; without the file, nothing."""
    if not (folder / METADATA).exists():
        return {}
    try:
        stated = parse_yaml(read_bytes(folder / METADATA, _METADATA_BYTES))
    except InvalidDocument as error:
        raise DamagedFile(f"its {METADATA} is damaged ({error}): run ros2 bag reindex") from error
    found = stated.get("rosbag2_bagfile_information") if isinstance(stated, dict) else None
    if not isinstance(found, dict):
        raise DamagedFile(f"its {METADATA} does not describe a bag: run ros2 bag reindex")
    return found


class JoinedStore(MessageStore):
    """The messages of several files, as if they were one. compressed: whether each message is compressed with zstd."""

    def __init__(self, stores: list[MessageStore], compressed: bool = False):
        self._stores, self._compressed = stores, compressed
        self.ros1 = any(store.ros1 for store in stores)
        if self.ros1 != all(store.ros1 for store in stores):
            raise DamagedFile("it mixes messages of ROS 1 and ROS 2")
        self.topics = {topic: kind for store in stores for topic, kind in store.topics.items()}

    def find(self, topic: str) -> Messages:
        parts = [store.find(topic) for store in self._stores]
        for number, part in enumerate(parts):
            part.places[:, 0] = number
        return join_messages(parts)

    def read(self, place: Place, first: int | None = None) -> bytes:
        store, there = self._stores[place[0]], (0, *place[1:])
        return decompress("zstd", store.read(there))[:first] if self._compressed else store.read(there, first)

    def heads(self, messages: Messages, size: int) -> NDArray[np.uint8]:
        if self._compressed:
            return super().heads(messages, size)
        found = np.zeros((len(messages), size), np.uint8)
        for number, store in enumerate(self._stores):
            own = messages.places[:, 0] == number
            found[own] = store.heads(Messages(messages.times[own], messages.places[own] * (0, 1, 1)), size)
        return found
