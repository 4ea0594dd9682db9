"""A file of lines that others may read while it grows: it never shows a part of a line.

Results are there as soon as they are known, for whoever follows the run.
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
        """Go on at the end of what now bears the name, e.g. after it was replaced."""
        self._open(0)

    def add(self, line: str) -> None:
        """Add a line, whole or not at all."""
        with interrupts.deferred():
            end = os.fstat(self._descriptor).st_size
            try:
                files.write_all(self._descriptor, line.encode())
            except OSError as error:
                os.ftruncate(self._descriptor, end)
                raise files.storage_error(error, self.path, "adding a result") from error

    def close(self) -> None:
        """Close the file; it stays."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def _open(self, how: int) -> None:
        try:
            self._descriptor = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | how, 0o666)
        except OSError as error:
            raise files.storage_error(error, self.path, "writing") from error
