"""Serial ports: one way to open them, for radars and for what turns the object.

What keeps a port from opening is told once, with its remedy.
"""

from __future__ import annotations

import errno
from pathlib import Path
from typing import TYPE_CHECKING

from tagid.errors import DeviceError, DeviceGoneError, PortInUseError

if TYPE_CHECKING:
    import serial


def open_port(path: str, baud: int, write_timeout_s: float, find: str) -> serial.Serial:
    """A serial port, 8N1, for us alone, with nothing left over from before.

    Args:
        path: device file.
        baud: baud rate.
        write_timeout_s: longest wait for the port to take bytes, s.
        find: what lists the ports, for the remedy.

    Raises:
        PortInUseError: another program has it open.
        DeviceGoneError: there is no such port (now).
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
            raise PortInUseError(
                f"{path} is held by another program",
                "Close the other program (a terminal, another tagid, ModemManager) and try again.",
            ) from error
        if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.EIO) or not Path(path).exists():
            raise DeviceGoneError(f"there is no serial port {path}", f"Plug it in; {find}.") from error
        if number in (errno.EACCES, errno.EPERM):
            raise DeviceError(
                f"no permission to open {path}",
                "Add yourself to the group dialout (sudo usermod -aG dialout $USER) and log in again.",
            ) from error
        raise DeviceError(f"cannot open {path}: {text}", "Give the device file of a serial port.") from error
