"""All exceptions shown to users, in one hierarchy.

Every class has a stable code (part of the JSON contract) and the exit code of the process. Every instance
states the cause and the remedy, so that no command shows a traceback.
"""

from __future__ import annotations

import re
from typing import Self

EXIT_OK = 0
EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_UNCERTAIN = 3
EXIT_DEVICE = 4
EXIT_BATCH = 5
EXIT_INTERRUPTED = 130


def displayable(text: str) -> str:
    """Text that can be written as UTF-8: other bytes of a file name appear as \\xNN.

    >>> displayable("caf\\udce9.npz")
    'caf\\\\xe9.npz'
    """
    if text.isascii():
        return text
    try:
        raw = text.encode("utf-8", "surrogateescape")
    except UnicodeEncodeError:  # half a surrogate pair, e.g. from JSON: it represents no byte
        raw = text.encode("utf-8", "backslashreplace")
    return raw.decode("utf-8", "backslashreplace")


def visible(text: str) -> str:
    """Text without terminal control: control characters except the line feed appear as \\xNN or \\uNNNN.

    C0, DEL and C1 controls begin escape sequences; line separators and the marks that change the direction of
    writing can disguise a text (Unicode Technical Report 36).

    >>> visible("red \\x1b[31m")
    'red \\\\x1b[31m'
    """
    return _CONTROLS.sub(lambda match: _escaped(ord(match.group())), text)


_CONTROLS = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069]")


def _escaped(code: int) -> str:
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"


class TagidError(Exception):
    """Base of all errors that `tagid` raises on purpose.

    Args:
        message: what went wrong and where (file, address, field), one sentence.
        remedy: what the user should do next, one sentence; may be empty.
    """

    code = "failed"
    exit_code = EXIT_FAILED

    def __init__(self, message: str, remedy: str = "") -> None:
        self.message = displayable(message)
        self.remedy = displayable(remedy)
        super().__init__(self.message)

    def with_remedy(self, more: str) -> Self:
        """The same error with more that the user should do; may be empty."""
        return type(self)(self.message, f"{self.remedy} {more}".strip())

    @classmethod
    def unexpected(cls, error: BaseException) -> TagidError:
        """The error to show for an exception that no part of the program foresees."""
        return cls(
            f"unexpected {type(error).__name__}: {error}",
            "This is a bug in tagid. Run again with -vv and report the output.",
        )


class UsageError(TagidError):
    """An option or argument is invalid."""

    code = "usage"
    exit_code = EXIT_USAGE


class ConfigError(TagidError):
    """A setting is missing, unknown or out of range."""

    code = "config"
    exit_code = EXIT_USAGE


class MissingExtraError(TagidError):
    """A feature needs an optional package that is not installed."""

    code = "missing_extra"
    exit_code = EXIT_USAGE


class FileFormatError(TagidError):
    """A file is not of the expected format: truncated, wrong version, wrong dtype, not finite."""

    code = "bad_file"


class StorageError(TagidError):
    """A file cannot be read or written (missing, no permission, not a folder)."""

    code = "storage"


class DiskFullError(StorageError):
    """The disk is full; data written before is kept."""

    code = "disk_full"


class DataError(TagidError):
    """The scans are readable but cannot be processed: too few views or bins, no angles, all zero."""

    code = "bad_data"


class RegistryError(TagidError):
    """The registry of layouts cannot be read, or a layout is missing or taken."""

    code = "registry"


class LayoutConflictError(RegistryError):
    """A layout is so similar to an enrolled one that they could be confused."""

    code = "layout_conflict"


class ModelError(TagidError):
    """A shipped model is damaged, of another release, or given input of the wrong shape."""

    code = "model"


class DeviceError(TagidError):
    """A radar or a motion device is unavailable, silent or misbehaving."""

    code = "device"
    exit_code = EXIT_DEVICE


class DeviceTimeoutError(DeviceError):
    """A device did not reply, or stopped replying, within its timeout."""

    code = "device_timeout"


class DeviceGoneError(DeviceError):
    """A device was unplugged, or its port vanished; the same device may come back."""

    code = "device_gone"


class DeviceRestartedError(DeviceError):
    """A device restarted unexpectedly; it responds again after booting."""

    code = "device_restarted"


class DeviceRejectedError(DeviceError):
    """A device replied to a request with an error status."""

    code = "device_rejected"


class PortInUseError(DeviceError):
    """A network or serial port is held by another program."""

    code = "port_in_use"


class ClusterError(TagidError):
    """The requested cluster is unavailable or unsuitable."""

    code = "cluster"


class CaptureInterrupted(TagidError):  # noqa: N818 - it is an event, not a fault
    """The user stopped the command (Ctrl-C); data recorded until then are kept."""

    code = "interrupted"
    exit_code = EXIT_INTERRUPTED
