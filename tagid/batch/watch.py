"""A folder in which captures arrive: each is an item once it has stopped changing.

The folder is looked through again and again, which works on every file system, network drives included.
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
    """What to watch.

    Attributes:
        folder: with all folders in it.
        outside: a folder in it that is left out, the report's own.
        interval_s: between two looks, s. A file is taken when two looks found it the same.
        idle_stop_s: end after so long without an arrival, s; None to go on for ever.
    """

    folder: Path
    outside: Path | None = None
    interval_s: float = 0.5
    idle_stop_s: float | None = None

    def arrivals(self, seen: Iterable[Source]) -> Iterator[Source | None]:
        """Inputs as they become complete, None where there is none at the moment.

        Raises StorageError where the folder cannot be listed at first; later on it may come and go.
        """
        taken = {source.location: _state(Path(source.location)) for source in seen}
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
    """Size and time of a file's last change; None where it is gone."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns
