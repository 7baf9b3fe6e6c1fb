"""A map that is shown: read again when its folder is replaced, and asked by one thread at a time."""

from __future__ import annotations

import contextlib
import threading
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from ...core.errors import FreeOccError, MapError
from ...core.regular_files import IMAGE_BYTES, read_bytes
from ...query.regions import Region
from ...query.scan_map import Map, load_map
from ...storage.map_files import KEYFRAMES, MANIFEST
from .answers import Asked, describe_views, find_answers
from .packets import compress, pack
from .scene_arrays import Arrays, describe_scene, describe_space

T = TypeVar("T")
_KEPT_ANSWERS = 64


class ShownMap:
    """A map folder as pages see it. ``version`` changes with its content; each packet states the one it is of.

    All methods are safe on any thread. check: open the folder now. Raises MapError if the folder is no map when it is
    opened, or later, while nobody has put a map in its place.
    """

    def __init__(self, path: Path, check: bool = True):
        self.path = path
        self._lock = threading.RLock()
        self._stamp: tuple[int, ...] = ()
        self._map: Map | None = None
        self._packets: dict[str, bytes] = {}
        self._answers: OrderedDict[int, list[Region]] = OrderedDict()
        self._asked = 0
        if check:
            self._current()

    @property
    def version(self) -> str:
        """Names the content of the folder now."""
        with self._lock:
            self._current()
            return self._read_version()

    @property
    def capture(self) -> str:
        """The name of the capture that the map was made from."""
        return self.use(lambda scan_map: Path(scan_map.manifest.capture.path).name)

    def scene(self) -> bytes:
        """The packet of ``describe_scene``, compressed. Then asks a word, so that the first question of the page finds
        encoder and kernels loaded."""
        made = self._packet("scene", lambda scan_map: pack(*self._stated(describe_scene(scan_map))))
        threading.Thread(target=self._warm_up, daemon=True).start()
        return made

    def space(self) -> bytes:
        """The packet of ``describe_space``, compressed."""
        return self._packet("space", lambda scan_map: pack(*self._stated(describe_space(scan_map))))

    def ask(self, asked: Asked) -> bytes:
        """The packet of an answer, compressed. Its document holds ``answer``, for ``views``. Raises FreeOccError."""

        with self._lock:
            found, version = self.use(lambda scan_map: (find_answers(scan_map, asked), self._read_version()))
            self._asked += 1
            self._answers[self._asked] = found.regions
            while len(self._answers) > _KEPT_ANSWERS:
                self._answers.popitem(last=False)
            return compress(found.packet({"version": version, "answer": self._asked}))

    def views(self, number: int, region: int) -> list[dict[str, Any]] | None:
        """The keyframes that show a region of an answer best; None if that answer is no longer kept."""
        with self._lock:
            regions = self._answers.get(number)
            if regions is None or not 0 <= region < len(regions):
                return None
            return self.use(lambda scan_map: describe_views(scan_map, scan_map.views_of(regions[region])))

    def photograph(self, keyframe: int) -> bytes:
        """The JPEG of a keyframe. Raises MapError for a row that the map does not have, or a damaged image."""

        def read(scan_map: Map) -> bytes:
            views = scan_map.keyframes.views()
            if not 0 <= keyframe < len(views):
                raise MapError(f"The map {self.path} has no keyframe {keyframe}.")
            path = scan_map.files.path(f"{KEYFRAMES}/{views[keyframe][0].name}")
            try:
                return read_bytes(path, IMAGE_BYTES)
            except OSError as error:
                raise MapError(f"Cannot read {path}: {error.strerror}.") from error

        return self.use(read)

    def use(self, work: Callable[[Map], T]) -> T:
        """The result of some work on the map; done again if the folder is replaced meanwhile, for parts of two maps do
        not go together."""
        with self._lock:
            while True:
                scan_map, stamp = self._current(), self._stamp
                try:
                    made = work(scan_map)
                except MapError:
                    if self._current() is scan_map and self._stamp == stamp:
                        raise
                else:
                    if self._current() is scan_map:
                        return made

    def _packet(self, name: str, make: Callable[[Map], bytes]) -> bytes:
        with self._lock:
            self._current()
            if name not in self._packets:
                made = compress(self.use(make))
                self._packets[name] = made
            return self._packets[name]

    def _warm_up(self) -> None:
        with self._lock, contextlib.suppress(FreeOccError):
            if self._map is not None and not self._asked and self._map.vocabulary:
                self._map.query_words(self._map.vocabulary[:1])

    def _stated(self, described: tuple[dict[str, Any], Arrays]) -> tuple[dict[str, Any], Arrays]:
        meta, arrays = described
        return {**meta, "version": self._read_version()}, arrays

    def _read_version(self) -> str:
        """Names the content that was read, whatever stands in the folder by now."""
        return "-".join(map(str, self._stamp))

    def _current(self) -> Map:
        """Returns the map that is in the folder now."""
        try:
            found = (self.path / MANIFEST).stat()
            stamp: tuple[int, ...] = (found.st_ino, found.st_mtime_ns, found.st_size)
        except OSError:
            stamp = ()
        if self._map is None or stamp != self._stamp:
            self._map = load_map(self.path)
            self._stamp = stamp
            self._packets.clear()
            self._answers.clear()
        return self._map
