"""The only place that opens files by name: whole reads with a limit, and writes that are all or nothing.

Every failure of the operating system becomes one clear error here, so that no format has to know about errno.
"""

from __future__ import annotations

import errno
import io
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, TextIO

from tagid.errors import DiskFullError, FileFormatError, StorageError

MAX_FILE_BYTES = 2 << 30
"""Largest file read whole, and largest array accepted from one, bytes: hours of a P440 at full rate."""

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def storage_error(error: OSError, path: Path, doing: str) -> StorageError:
    """The error to show for what the operating system answered while `doing` something with `path`."""
    if error.errno in _FULL:
        return DiskFullError(
            f"{path}: the disk is full (or a quota or file size limit is reached) while {doing}",
            "Free some space or choose another folder; what was written before is kept.",
        )
    if isinstance(error, FileNotFoundError):
        return StorageError(f"{path}: no such file or folder while {doing}", "Check the path.")
    if isinstance(error, FileExistsError):
        return StorageError(f"{path}: already exists", "Choose another name or move the file away.")
    if isinstance(error, PermissionError) or error.errno == errno.EROFS:
        return StorageError(
            f"{path}: no permission while {doing}", "Check the rights of the file and folder."
        )
    if isinstance(error, IsADirectoryError):
        return StorageError(f"{path}: is a folder, not a file", "Give the path of a file.")
    if isinstance(error, NotADirectoryError):
        return StorageError(f"{path}: a part of the path is not a folder", "Check the path.")
    return StorageError(f"{path}: {error.strerror or error} while {doing}", "Check the path and the device.")


def read_bytes(path: Path, limit: int = MAX_FILE_BYTES) -> bytes:
    """The content of a regular file.

    Raises:
        StorageError: missing, not readable, or not a regular file (a folder, a device, a pipe).
        FileFormatError: larger than `limit` bytes.
    """
    data = read_head(path, limit + 1)
    if len(data) > limit:
        raise FileFormatError(
            f"{path}: has more than the limit of {limit} bytes", "Record or export in parts."
        )
    return data


def read_head(path: Path, count: int) -> bytes:
    """The first `count` bytes of a regular file, or all that it has. Raises StorageError."""
    with open_regular(path) as (stream, size):
        return stream.read(min(count, size + 1))


@contextmanager
def open_regular(path: Path) -> Iterator[tuple[BinaryIO, int]]:
    """A regular file to be read in parts, and its size in bytes, for what may be larger than the memory.

    Raises StorageError: missing, not readable, or not a regular file; also where reading it fails.
    """
    try:
        status = path.stat()
        if stat.S_ISDIR(status.st_mode):
            raise IsADirectoryError(errno.EISDIR, "is a folder")
        if not stat.S_ISREG(status.st_mode):
            raise StorageError(f"{path}: is not a regular file", "Give the path of a file.")
        with path.open("rb") as stream:
            yield stream, status.st_size
    except OSError as error:
        raise storage_error(error, path, "reading") from error


def write_bytes(path: Path, data: bytes | memoryview) -> None:
    """Write a file so that its final name holds all of `data` or what it held before; see `replacing`."""
    with replacing(path) as stream:
        stream.write(data)


class PatientFile(io.FileIO):
    """A new file that remembers a failed write instead of raising it, for writers that could not clean up.

    HDF5 cannot be closed once a write has failed; so it is told that all is well, and `check` tells us.
    """

    failure: OSError | None = None

    def __init__(self, path: Path) -> None:
        super().__init__(path, "x+b")

    def write(self, data: Any) -> int:
        """Writes all of `data`; once a write has failed, nothing."""
        whole = memoryview(data).cast("B")
        try:
            if self.failure is None:
                write_all(self.fileno(), whole)
        except OSError as error:
            self.failure = error
        return len(whole)

    def truncate(self, size: int | None = None) -> int:
        """Cuts or extends the file; once a write has failed, does nothing."""
        try:
            return super().truncate(size) if self.failure is None else self.tell()
        except OSError as error:
            self.failure = error
            return self.tell()

    def check(self) -> None:
        """Raises the OSError of the first write that failed."""
        if self.failure is not None:
            raise self.failure


@contextmanager
def replacing(path: Path) -> Iterator[PatientFile]:
    """A file to fill, whose final name holds all of it or what it held before, even after a power cut.

    The bytes go to a temporary file in the same folder, are synced, and the file is renamed over the final
    name; where anything is raised inside, the temporary file goes and the final name stays as it was.

    Raises:
        DiskFullError: no space left.
        StorageError: the folder is missing or not writable, or the name belongs to something not a file.
    """
    target = Path(os.path.realpath(path))
    # Renaming over a device node would replace it, which root may do: only plain files are overwritten.
    if target.exists() and not target.is_file():
        raise StorageError(f"{path}: exists and is not a regular file", "Give the path of a file.")
    temporary = target.with_name(f".{target.name[:80]}.{secrets.token_hex(6)}.tmp")
    try:
        stream = PatientFile(temporary)
    except OSError as error:
        raise storage_error(error, path, "writing") from error
    try:
        with stream:
            try:
                yield stream
            except Exception as error:
                stream.check()  # what was raised then is a consequence
                raise error
            stream.check()
            os.fsync(stream.fileno())
        temporary.replace(target)
        sync_folder(target.parent)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise storage_error(error, path, "writing") from error
        raise


@contextmanager
def replacing_text(path: Path) -> Iterator[TextIO]:
    """As `replacing`, for text in UTF-8 with line ends as written; what is no text stands as an escape."""
    with replacing(path) as stream:
        text = io.TextIOWrapper(io.BufferedWriter(stream, 1 << 20), "utf-8", "backslashreplace", newline="")
        try:
            yield text
        finally:
            text.detach().detach()  # flushes both and leaves the stream open


def write_all(descriptor: int, data: bytes | memoryview) -> None:
    """Hand all of `data` to the operating system, however many writes it takes. Raises OSError."""
    rest = memoryview(data)
    while rest:
        rest = rest[os.write(descriptor, rest) :]


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable, where the file system offers that."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:  # e.g. a folder with write but no read permission: the file itself is synced already
        return
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EBADF):
            raise
    finally:
        os.close(descriptor)
