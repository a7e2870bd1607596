"""Volumes kept in memory, bounded by bytes, and read ahead while another renders."""

import threading
from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import pileus_core as core

from pileus_service.jobs import Cache
from pileus_worker.paths import NOWHERE_ELSE, PathMap
from pileus_worker.scene import Opener, as_named

Key = tuple[str, int, int, str]


class Caches:
    """Least recently used go first; a file that has changed is read anew."""

    def __init__(
        self, limit: int, paths: PathMap = NOWHERE_ELSE, reading: Opener = as_named
    ) -> None:
        self._limit = limit
        self._paths = paths
        self._reading = reading
        self._held: OrderedDict[Key, Future[core.Volume]] = OrderedDict()
        self._lock = threading.Lock()
        self._reader = ThreadPoolExecutor(2, thread_name_prefix="reader")
        self.bytes_read = 0

    def get(self, cache: Cache, grid: str) -> core.Volume:
        """The volume, read now unless it is held or on its way."""
        key = (cache.path, cache.mtime_ns, cache.size, grid)
        with self._lock:
            volume = self._begin(key)
            self._held.move_to_end(key)
        try:
            return volume.result()
        except BaseException:
            with self._lock:
                self._held.pop(key, None)
            raise
        finally:
            self._evict(key)

    def read_ahead(self, cache: Cache, grid: str) -> None:
        """Begins to read a volume that is wanted soon, if there is room for one more like it."""
        with self._lock:
            sizes = [self._size(held) for held in self._held.values()]
            if sum(sizes) + max(sizes, default=0) <= self._limit:
                self._begin((cache.path, cache.mtime_ns, cache.size, grid))

    def _begin(self, key: Key) -> Future[core.Volume]:
        if key not in self._held:
            self._held[key] = self._reader.submit(self._read, key)
        return self._held[key]

    def _read(self, key: Key) -> core.Volume:
        with self._reading(Path(self._paths.here(key[0]))) as location:
            volume = core.Volume(location, key[3])
        with self._lock:
            self.bytes_read += key[2]
        return volume

    def _evict(self, keep: Key) -> None:
        with self._lock:
            total = sum(self._size(held) for held in self._held.values())
            for key in list(self._held):
                if total <= self._limit:
                    return
                if key != keep and self._held[key].done():
                    total -= self._size(self._held.pop(key))

    @staticmethod
    def _size(held: Future[core.Volume]) -> int:
        return held.result().bytes if held.done() and held.exception() is None else 0
