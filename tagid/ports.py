"""Serial ports for radars and motion devices: opening them, with one clear error for each failure."""

from __future__ import annotations

import contextlib
import errno
import os
import pwd
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from tagid.errors import DeviceError, DeviceGoneError, PortInUseError

if TYPE_CHECKING:
    import serial


_PROC: Final = Path("/proc")


@dataclass(frozen=True)
class Holder:
    """A process that has a device file open: its number, program and owner; `locks`: exclusively."""

    pid: int
    name: str
    user: str
    locks: bool = False

    def __str__(self) -> str:
        return f"process {self.pid} ({self.name}, user {self.user})"


def holders(path: str) -> list[Holder]:
    """Processes that have a device file open or locked, as far as this user may see them; not this one.

    The open files of another user's process are visible to root only, its locks to everybody.
    """
    try:
        device = Path(path).stat()
    except OSError:
        return []
    pids: dict[int, bool] = {}
    for folder in _PROC.glob("[0-9]*"):
        with contextlib.suppress(OSError):
            for number in (folder / "fd").iterdir():
                with contextlib.suppress(OSError):
                    there = number.stat()
                    if (there.st_dev, there.st_ino) == (device.st_dev, device.st_ino):
                        pids[int(folder.name)] = False
    mark = f"{os.major(device.st_dev):02x}:{os.minor(device.st_dev):02x}:{device.st_ino}"
    with contextlib.suppress(OSError):
        for line in (_PROC / "locks").read_text().splitlines():
            words = line.split()
            if mark in words:
                pids[int(words[words.index(mark) - 1])] = True
    pids.pop(os.getpid(), None)
    return [holder for pid in sorted(pids) if (holder := _holder(pid, pids[pid])) is not None]


def _holder(pid: int, locks: bool) -> Holder | None:
    try:
        name = (_PROC / str(pid) / "comm").read_text(errors="replace").strip()
        uid = (_PROC / str(pid)).stat().st_uid
    except OSError:  # it has ended
        return None
    try:
        user = pwd.getpwuid(uid).pw_name
    except KeyError:
        user = str(uid)
    return Holder(pid, name, user, locks)


def open_port(path: str, baud: int, write_timeout_s: float, find: str) -> serial.Serial:
    """The serial port of a device file, 8N1, with exclusive access and empty buffers.

    `find` says how to list the ports, for the remedy.

    Raises:
        PortInUseError: another program has it open.
        DeviceGoneError: the port does not exist (now).
        DeviceError: no permission, or not a serial port.
    """
    import serial

    try:
        line = serial.Serial(path, baud, timeout=0, write_timeout=write_timeout_s, exclusive=True)
        line.reset_input_buffer()
        return line
    except (OSError, ValueError) as error:
        number = getattr(error, "errno", None)
        text = str(error)
        if number in (errno.EAGAIN, errno.EBUSY) or "exclusively lock" in text:
            opened = holders(path)
            opened = [holder for holder in opened if holder.locks] or opened
            who = ", ".join(map(str, opened))
            kill = " or ".join(f"`kill {holder.pid}`" for holder in opened)
            raise PortInUseError(
                f"{path} is in use by another program{f': {who}' if who else ''}",
                "Close the other program (a terminal, another tagid, ModemManager"
                f"{f'; {kill}' if kill else ''}) and try again.",
            ) from error
        if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.EIO) or not Path(path).exists():
            raise DeviceGoneError(f"no serial port {path}", f"Plug it in; {find}.") from error
        if number in (errno.EACCES, errno.EPERM):
            raise DeviceError(
                f"no permission to open {path}",
                "Add yourself to the group dialout (sudo usermod -aG dialout $USER) and log in again.",
            ) from error
        raise DeviceError(f"cannot open {path}: {text}", "Give the device file of a serial port.") from error
