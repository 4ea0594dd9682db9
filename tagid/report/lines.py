"""A file of lines that may be read while it grows: it never contains a partial line.

Results are available as soon as they are known.
"""

from __future__ import annotations

import os
from pathlib import Path

from tagid import files, interrupts


class GrowingLines:
    """A new, empty file to which whole lines are added.

    Raises:
        StorageError: it cannot be written.
        DiskFullError: no space left; the file then ends with the line before.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._descriptor = -1
        self._open(os.O_TRUNC)

    def reopen(self) -> None:
        """Reopen the path for appending, e.g. after the file was replaced."""
        self._open(0)

    def add(self, line: str) -> None:
        """Add a line, atomically."""
        with interrupts.deferred():
            end = os.fstat(self._descriptor).st_size
            try:
                files.write_all(self._descriptor, line.encode())
            except OSError as error:
                os.ftruncate(self._descriptor, end)
                raise files.storage_error(error, self.path, "adding a result") from error

    def close(self) -> None:
        """Close the file; it is kept."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def _open(self, how: int) -> None:
        self._descriptor = files.open_in_place(self.path, os.O_APPEND | how)
