"""The only module that opens files by name: whole reads with a size limit, and atomic writes.

Every operating system error becomes a clear error here, so that formats need not know about errno.
"""

from __future__ import annotations

import errno
import fcntl
import io
import os
import secrets
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from io import FileIO
from pathlib import Path
from typing import Any, BinaryIO, TextIO, TypeVar, cast

from tagid import interrupts
from tagid.errors import DiskFullError, FileFormatError, StorageError, TagidError

_T = TypeVar("_T")
_TEMPORARY = ".tagid.tmp"
"""Suffix of files that are being written."""

MAX_FILE_BYTES = 2 << 30
"""Largest file read at once and largest array in a file, bytes: hours of a P440 at full rate."""

_LOCK_ATTEMPTS = 8

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def storage_error(error: OSError, path: Path, doing: str) -> StorageError:
    """The error to show for an OSError that was raised while `doing` something with `path`."""
    if error.errno in _FULL:
        return DiskFullError(
            f"{path}: the disk is full (or a quota or file size limit was reached) while {doing}",
            "Free some space or choose another folder; data written before is kept.",
        )
    if isinstance(error, FileNotFoundError):
        return StorageError(f"{path}: no such file or folder while {doing}", "Check the path.")
    if isinstance(error, FileExistsError):
        return StorageError(f"{path}: already exists", "Choose another name or move the file away.")
    if error.errno == errno.EROFS:
        return StorageError(
            f"{path}: the file system is read-only", "Choose a folder on another disk, or mount it writable."
        )
    if isinstance(error, PermissionError):
        return StorageError(
            f"{path}: no permission while {doing}", "Check the permissions of the file and folder."
        )
    if isinstance(error, IsADirectoryError):
        return StorageError(f"{path}: is a folder, not a file", "Give the path of a file.")
    if isinstance(error, NotADirectoryError):
        return StorageError(f"{path}: part of the path is not a folder", "Check the path.")
    return StorageError(f"{path}: {error.strerror or error} while {doing}", "Check the path and the device.")


def is_read_only(folder: Path) -> bool:
    """Whether a folder is on a read-only file system; False if that cannot be found out."""
    try:
        return bool(os.statvfs(folder).f_flag & os.ST_RDONLY)
    except OSError:
        return False


def read_bytes(path: Path, limit: int = MAX_FILE_BYTES) -> bytes:
    """The content of a regular file.

    Raises:
        StorageError: missing, not readable, or not a regular file (a folder, a device, a pipe).
        FileFormatError: larger than `limit` bytes.
    """
    data = read_head(path, limit + 1)
    if len(data) > limit:
        raise FileFormatError(f"{path}: exceeds the limit of {limit} bytes", "Record or export in parts.")
    return data


def read_toml(path: Path, limit: int, missing_ok: bool = False) -> dict[str, Any]:
    """The tables of a TOML file; none where there is no file and that is `missing_ok`.

    Raises StorageError as `read_bytes` does, and FileFormatError: too large, or as `parse_toml` does.
    """
    try:
        raw = read_bytes(path, limit)
    except StorageError as error:
        if missing_ok and isinstance(error.__cause__, FileNotFoundError):
            return {}
        raise
    return parse_toml(raw, str(path))


def parse_toml(raw: bytes, where: str) -> dict[str, Any]:
    """The tables of a text in TOML.

    Raises FileFormatError: not UTF-8, not TOML, nested too deeply, or an integer exceeds 64 bits.
    """
    import tomllib

    return cast(dict[str, Any], _parsed(tomllib.loads, raw, where, "TOML"))


def parse_json(raw: bytes, where: str) -> Any:
    """The value of a text in JSON. Raises FileFormatError as `parse_toml` does."""
    import json

    return _parsed(json.loads, raw, where, "JSON")


def _parsed(loads: Callable[[str], Any], raw: bytes, where: str, kind: str) -> Any:
    try:
        value = loads(raw.decode("utf-8"))
        _check_integers(value)
    except UnicodeDecodeError:
        raise FileFormatError(f"{where} is not text in UTF-8", "Save it as UTF-8.") from None
    except (ValueError, OverflowError, RecursionError) as error:
        raise FileFormatError(f"{where} is not valid {kind}: {str(error)[:200]}", "Correct it.") from None
    return value


def _check_integers(value: Any) -> None:
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise ValueError("an integer exceeds 64 bits")
    if isinstance(value, (dict, list)):
        for item in value.values() if isinstance(value, dict) else value:
            _check_integers(item)


def read_head(path: Path, count: int) -> bytes:
    """The first `count` bytes of a regular file, or all of a shorter one. Raises StorageError."""
    with open_regular(path) as (stream, size):
        return stream.read(min(count, size + 1))


@contextmanager
def open_regular(path: Path) -> Iterator[tuple[BinaryIO, int]]:
    """Open a regular file for reading in parts, with its size in bytes; for files larger than memory.

    Raises StorageError: missing, not readable, or not a regular file; or reading fails.
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


def write_bytes(path: Path, data: bytes | memoryview, private: bool = False) -> None:
    """Write a file so that its final name holds all of `data` or its previous content; see `replacing`."""
    with replacing(path, private=private) as stream:
        stream.write(data)


class PatientFile(io.RawIOBase):
    """A new file that stores the first exception of its operations; `check` raises it later.

    For writers that cannot clean up after an exception: HDF5 calls it from C, where an exception leaves a
    file that can never be closed. After the first failure, it writes nothing more and reports success.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.failure: BaseException | None = None
        self._file = FileIO(path, "x+b")

    def write(self, data: Any) -> int:
        """Write all of `data`, or nothing after a failure. Returns the size of `data` in bytes."""
        whole = memoryview(data).cast("B")
        self._try(lambda: write_all(self._file, whole))
        return len(whole)

    def truncate(self, size: int | None = None) -> int:
        """Truncate or extend the file to `size` bytes; does nothing after a failure."""
        return self._try(lambda: self._file.truncate(size)) or 0

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """As for any file; 0 after a failure."""
        return self._try(lambda: self._file.seek(offset, whence)) or 0

    def tell(self) -> int:
        """As for any file; 0 after a failure."""
        return self._try(self._file.tell) or 0

    def readinto(self, buffer: Any) -> int:
        """Fill `buffer`, with zeros after the end of the file or after a failure."""
        target = memoryview(buffer).cast("B")
        count = self._try(lambda: self._file.readinto(target)) or 0
        target[count:] = bytes(len(target) - count)
        return len(target)

    def flush(self) -> None:
        """Does nothing: the file is unbuffered."""

    def fileno(self) -> int:
        """The file descriptor."""
        return self._file.fileno()

    def readable(self) -> bool:
        """True."""
        return True

    def writable(self) -> bool:
        """True."""
        return True

    def seekable(self) -> bool:
        """True."""
        return True

    def close(self) -> None:
        """Close the file. Raises OSError."""
        super().close()
        self._file.close()

    def check(self) -> None:
        """Raise the first failure, if any."""
        if self.failure is not None:
            raise self.failure

    def _try(self, work: Callable[[], _T]) -> _T | None:
        """The result of `work`; None if it, or anything before it, raised."""
        if self.failure is None:
            try:
                return work()
            except BaseException as error:
                self.failure = error
        return None


def resolved(path: Path) -> Path:
    """The file that a name typed by the user means: the target of a symbolic link, else the name itself."""
    if not os.path.islink(path) or path.is_dir():  # noqa: PTH114 - False for names that are too long
        return path
    target = Path(os.path.realpath(path))
    # /dev/fd/N opens a file that may have no name any more.
    return path if path.exists() and not target.exists() else target


def in_place(path: Path) -> Path:
    """A name that this program chooses, for a file opened in place: a symbolic link of that name is removed.

    Raises StorageError: not a regular file (opening a pipe may wait for ever), or the link cannot be removed.
    """
    try:
        if path.is_symlink():
            path.unlink()
    except OSError as error:
        raise storage_error(error, path, "writing") from error
    check_regular(path)
    return path


def open_in_place(path: Path, flags: int) -> int:
    """Open a file of a name as for `in_place` for writing, with more `flags` of os.open; its descriptor.

    Raises StorageError as `in_place` does, also if the file changes meanwhile, or cannot be opened.
    """
    flags |= os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        descriptor = os.open(in_place(path), flags, 0o666)
    except OSError as error:
        raise storage_error(error, path, "writing") from error
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise _not_regular(path)
    return descriptor


def check_regular(path: Path, kind: type[TagidError] = StorageError) -> None:
    """Raises an error of this kind if something exists there that is not a regular file."""
    # Unlike those of Path, these are False in a folder that may not be searched: opening the file tells.
    if os.path.exists(path) and not os.path.isfile(path):  # noqa: PTH110, PTH113
        raise _not_regular(path, kind)


def _not_regular(path: Path, kind: type[TagidError] = StorageError) -> TagidError:
    return kind(f"{path}: exists and is not a regular file", "Move it away, or choose another path.")


@contextmanager
def replacing(
    path: Path, verify: Callable[[Path], None] | None = None, private: bool = False
) -> Iterator[PatientFile]:
    """A file to write, whose final name holds all of it or its previous content, even after a power cut.

    A symbolic link of that name is replaced, not followed: others may have planted it where this program
    chooses the name. A name that the user typed passes `resolved` where it comes in.

    The bytes go to a temporary file in the same folder, are synced, and the file is renamed over the final
    name. If anything is raised, the temporary file is removed and the final name is unchanged. Stop signals
    wait until the file is complete, see `tagid.interrupts`. Temporary files of killed processes are removed.

    Args:
        path: the final name.
        verify: called with the path of the synced temporary file; an exception prevents the replacement.
        private: whether only the owner may read the file.

    Raises:
        DiskFullError: no space left.
        StorageError: the folder is missing or not writable, or the name is not a regular file.
    """
    # As root, renaming over a device node would replace it: only regular files are overwritten.
    check_regular(path)
    with interrupts.deferred():
        clear_abandoned(path.parent)
        temporary, stream = _open_temporary(path)
        try:
            # The file is renamed before it is closed: closing it releases its lock.
            with stream:
                if private:
                    os.fchmod(stream.fileno(), 0o600)
                try:
                    yield stream
                except Exception as error:
                    stream.check()  # the exception raised there is a consequence
                    raise error
                stream.check()
                os.fsync(stream.fileno())
                if verify is not None:
                    verify(temporary)
                temporary.replace(path)
            sync_folder(path.parent)
        except BaseException as error:
            temporary.unlink(missing_ok=True)
            if isinstance(error, OSError):
                raise storage_error(error, path, "writing") from error
            raise


def _open_temporary(path: Path) -> tuple[Path, PatientFile]:
    """A new locked file next to `path`: its lock, held until the process ends, marks it as in use."""
    for attempt in range(_LOCK_ATTEMPTS):
        temporary = path.with_name(f".{path.name[:80]}.{secrets.token_hex(6)}{_TEMPORARY}")
        try:
            stream = PatientFile(temporary)
        except OSError as error:
            raise storage_error(error, path, "writing") from error
        # Another process may have removed it as abandoned before it was locked. Where every lock is refused,
        # no process can do that.
        last = attempt == _LOCK_ATTEMPTS - 1
        if (lock(stream.fileno()) is not False or last) and temporary.exists():
            return temporary, stream
        stream.close()
        temporary.unlink(missing_ok=True)
    raise StorageError(f"{path}: its temporary file is removed again and again while writing", "Try again.")


def clear_abandoned(folder: Path) -> None:
    """Remove the temporary files in a folder that `replacing` made in processes that were killed.

    Files locked by a running process are kept, as are those that cannot be locked or removed.
    """
    try:
        leftovers = [
            path for path in folder.iterdir() if path.name[0] == "." and path.name.endswith(_TEMPORARY)
        ]
    except OSError:
        return
    for path in leftovers:
        with suppress(OSError):
            descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
            try:
                if stat.S_ISREG(os.fstat(descriptor).st_mode) and lock(descriptor):
                    path.unlink()
            finally:
                os.close(descriptor)


def lock(descriptor: int) -> bool | None:
    """Lock a file until it is closed: True; False if it is locked already; None if unknown."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return None
    return True


@contextmanager
def replacing_text(path: Path) -> Iterator[TextIO]:
    """As `replacing`, for text in UTF-8 without newline translation; invalid characters are escaped."""
    with replacing(path) as stream:
        text = io.TextIOWrapper(io.BufferedWriter(stream, 1 << 20), "utf-8", "backslashreplace", newline="")
        try:
            yield text
        finally:
            text.detach().detach()  # flushes both and leaves the stream open


def write_all(file: int | FileIO, data: bytes | memoryview) -> None:
    """Write all of `data` to the operating system, in as many calls as needed. Raises OSError."""
    rest = memoryview(data)
    descriptor = file if isinstance(file, int) else file.fileno()
    while rest:
        written = os.write(descriptor, rest)
        if not written:
            raise OSError(errno.EIO, "the device takes no more")
        rest = rest[written:]


def forget_cached(path: Path) -> None:
    """Ask the operating system to drop its cache, so that the next read is from disk. Raises OSError."""
    if hasattr(os, "posix_fadvise"):  # not on macOS
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        finally:
            os.close(descriptor)


def make_folder(folder: Path) -> None:
    """Create a folder and those above it that are missing, durably: each name is synced.

    Raises StorageError, DiskFullError.
    """
    missing = []
    place = folder
    while not place.is_dir() and place != place.parent:
        missing.append(place)
        place = place.parent
    try:
        for created in reversed(missing):
            created.mkdir(exist_ok=True)
            sync_folder(created.parent)
    except OSError as error:
        raise storage_error(error, folder, "making the folder") from error


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable, if the file system supports it."""
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
