"""Serial ports for radars and motion devices: opening them, with one clear error for each failure."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import TYPE_CHECKING

from tagid.errors import DeviceError, DeviceGoneError, PortInUseError

if TYPE_CHECKING:
    import serial


def open_port(path: str, baud: int, write_timeout_s: float, find: str) -> serial.Serial:
    """A serial port, 8N1, with exclusive access and empty buffers.

    Args:
        path: device file.
        baud: baud rate.
        write_timeout_s: longest wait for a write, s.
        find: how to list the ports, for the remedy.

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
            raise PortInUseError(
                f"{path} is in use by another program",
                "Close the other program (a terminal, another tagid, ModemManager) and try again.",
            ) from error
        if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.EIO) or not Path(path).exists():
            raise DeviceGoneError(f"no serial port {path}", f"Plug it in; {find}.") from error
        if number in (errno.EACCES, errno.EPERM):
            raise DeviceError(
                f"no permission to open {path}",
                "Add yourself to the group dialout (sudo usermod -aG dialout $USER) and log in again.",
            ) from error
        raise DeviceError(f"cannot open {path}: {text}", "Give the device file of a serial port.") from error
