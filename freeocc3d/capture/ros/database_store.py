"""Storage of ROS 2: a .db3 file, an SQLite database with the tables topics and messages. Source: rosbag2's
sqlite_storage.cpp."""

from __future__ import annotations

import sqlite3
import threading
import weakref
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.regular_files import open_regular
from ..files.file_bytes import DamagedFile
from .message_store import MOST_BYTES, Messages, MessageStore, Place, sort_messages

START = b"SQLite format 3\0"

_TABLES = "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND rootpage > 0 AND name IN ('messages', 'topics')"


def is_bag_database(path: Path) -> bool:
    """Whether an SQLite database holds topics and messages; other programs use SQLite too."""
    try:
        connection = _connect(path)
        try:
            return bool(connection.execute(_TABLES).fetchone()[0] == 2)
        finally:
            connection.close()
    except (sqlite3.Error, OSError):
        return False


class DatabaseStore(MessageStore):
    """Messages of a .db3."""

    ros1 = False

    def __init__(self, path: Path):
        self._lock = threading.Lock()
        self._database = _connect(path)
        weakref.finalize(self, self._database.close)
        if self._rows(_TABLES) != [(2,)]:
            raise DamagedFile("it is a database without ROS messages")
        self._numbers: dict[str, list[int]] = {}
        self.topics = {}
        for number, name, kind, form in self._rows("SELECT id, name, type, serialization_format FROM topics"):
            if form == "cdr" and isinstance(name, str) and isinstance(kind, str) and isinstance(number, int):
                self.topics[name] = kind
                self._numbers.setdefault(name, []).append(number)

    def find(self, topic: str) -> Messages:
        rows = [
            row
            for number in self._numbers.get(topic, ())
            for row in self._rows("SELECT timestamp, id FROM messages WHERE topic_id = ? ORDER BY timestamp", number)
        ]
        try:
            table = np.array(rows, np.int64).reshape(-1, 2)
        except (ValueError, TypeError, OverflowError) as error:
            raise DamagedFile("it is damaged: a message has no time") from error
        zeros = np.zeros(len(table), np.int64)
        return sort_messages(table[:, 0], np.column_stack((zeros, zeros - 1, table[:, 1])))

    def read(self, place: Place, first: int | None = None) -> bytes:
        rows = self._rows("SELECT length(data) FROM messages WHERE id = ?", place[2])
        if not rows or not isinstance(rows[0][0], int) or rows[0][0] > MOST_BYTES:
            raise DamagedFile("it is damaged: a message is missing or too large")
        if first is None:
            data = self._rows("SELECT data FROM messages WHERE id = ?", place[2])[0][0]
        else:
            data = self._rows("SELECT substr(data, 1, ?) FROM messages WHERE id = ?", first, place[2])[0][0]
        if not isinstance(data, bytes):
            raise DamagedFile("it is damaged: a message is not made of bytes")
        return data

    def heads(self, messages: Messages, size: int) -> NDArray[np.uint8]:
        found = np.zeros((len(messages), size), np.uint8)
        rows = {offset: row for row, offset in enumerate(messages.places[:, 2].tolist())}
        low, high = (min(rows), max(rows)) if rows else (0, -1)
        query = "SELECT id, substr(data, 1, ?) FROM messages WHERE id BETWEEN ? AND ?"
        for number, data in self._rows(query, size, low, high):
            row = rows.get(number)
            if row is not None and isinstance(data, bytes):
                found[row, : len(data)] = np.frombuffer(data, np.uint8)
        return found

    def _rows(self, query: str, *values: int) -> list[tuple[object, ...]]:
        try:
            with self._lock:
                return self._database.execute(query, values).fetchall()
        except (sqlite3.Error, ValueError, OverflowError) as error:  # ValueError: a text is not UTF-8
            raise DamagedFile(f"its database is damaged ({error})") from error


def _connect(path: Path) -> sqlite3.Connection:
    """Open a database for reading; no other file is touched. Raises OSError, sqlite3.Error."""
    with open_regular(path):
        pass
    return sqlite3.connect(f"{path.absolute().as_uri()}?immutable=1&mode=ro", uri=True, check_same_thread=False)
