"""A folder in which captures arrive: each becomes an item when it has stopped changing.

The folder is polled, which works on every file system, including network drives.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tagid.batch.inputs import Source, files_below, is_recording
from tagid.errors import StorageError

_State = tuple[int, int]


@dataclass(frozen=True)
class FolderWatch:
    """The folder to watch, and when to stop.

    Attributes:
        folder: watched with all its subfolders.
        outside: a subfolder that is excluded, the report's own.
        interval_s: polling interval, s. A file is taken when two consecutive polls find it unchanged.
        idle_stop_s: end after this time without an arrival, s; None to continue indefinitely.
    """

    folder: Path
    outside: Path | None = None
    interval_s: float = 0.5
    idle_stop_s: float | None = None

    def arrivals(self, seen: Iterable[Source]) -> Iterator[Source | None]:
        """Inputs as they become complete; None if there is none at the moment.

        The files of `seen` come again if they change after this call: call it before reading them.

        Raises StorageError if the folder cannot be listed at the start; later it may disappear and return.
        """
        return self._changes({source.location: _state(Path(source.location)) for source in seen})

    def _changes(self, taken: dict[str, _State | None]) -> Iterator[Source | None]:
        """As `arrivals`; `taken` are the files that were given, as they were then."""
        before: dict[str, _State] = {}
        looked = -self.interval_s
        last = time.monotonic()
        first = True
        while self.idle_stop_s is None or time.monotonic() - last < self.idle_stop_s:
            if time.monotonic() - looked < self.interval_s:
                yield None
                continue
            looked = time.monotonic()
            now: dict[str, _State] = {}
            for path in self._files(first):
                state = _state(path)
                if state is None or taken.get(str(path.absolute())) == state:
                    continue
                now[str(path)] = state
                if before.get(str(path)) != state or not is_recording(path):
                    continue
                taken[str(path.absolute())] = state
                last = time.monotonic()
                yield Source.of(str(path))
            before = now
            first = False
            yield None

    def _files(self, first: bool) -> list[Path]:
        try:
            return list(files_below(self.folder, [], self.outside))
        except StorageError:
            if first:
                raise
            return []


def _state(path: Path) -> _State | None:
    """Size and modification time of a file; None if it no longer exists."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns
