"""Byte links to what turns the object: a serial port here, Bluetooth in `ble`; they know nothing of messages.

A driver is written against ByteLink and cannot tell a cable from a bridge.
"""

from __future__ import annotations

import errno
from typing import Final, Protocol

from tagid.errors import DeviceGoneError, DeviceTimeoutError, MissingExtraError
from tagid.ports import open_port

_WRITE_TIMEOUT_S: Final = 1.0


class ByteLink(Protocol):
    """Carries bytes both ways."""

    def write(self, data: bytes) -> None:
        """Send; may be called from any thread. Raises DeviceError where the link is down."""
        ...

    def read(self, timeout: float) -> bytes:
        """What has arrived, waiting up to `timeout` s for the first byte; b"" where nothing came.

        Raises DeviceError where the link is down.
        """
        ...

    def arm(self, timeout_s: float) -> None:
        """From now on stop the robot by itself where nothing is written for so long, or the link ends."""
        ...

    def disarm(self) -> None:
        """End of `arm`, when the robot stands still."""
        ...

    def wake(self) -> None:
        """Wake a sleeping robot (a low pulse on its BRC pin), where the link can."""
        ...

    def close(self) -> None:
        """Let go of the link; harmless when closed already."""
        ...


def require(module: str, extra: str, what: str) -> None:
    """Raise MissingExtraError where a package of an extra is not installed."""
    import importlib.util

    if importlib.util.find_spec(module) is None:
        raise MissingExtraError(
            f"{what} needs {module}, which is not installed", f"Install it: pip install 'tagid[{extra}]'."
        )


class SerialLink:
    """A serial port, 8N1.

    Args:
        port: device path or name.
        baud: rate.
        halt: what a helper process writes where this process dies while armed; b"" for no helper.

    Raises:
        DeviceGoneError, DeviceError, PortInUseError: see `tagid.ports.open_port`.
    """

    def __init__(self, port: str, baud: int = 115200, halt: bytes = b"") -> None:
        self.port, self.baud = port, baud
        self._halt = halt
        self._serial = open_port(port, baud, _WRITE_TIMEOUT_S, "`tagid motion find` lists the ports")
        self._guard: object | None = None

    def __repr__(self) -> str:
        return self.port

    def write(self, data: bytes) -> None:
        """Send all of it."""
        import serial

        try:
            self._serial.write(data)
        except serial.SerialTimeoutException:
            raise DeviceTimeoutError(f"{self.port} takes no bytes", "Check the cable.") from None
        except (OSError, TypeError, ValueError) as error:  # pyserial's own traps after an unplugging
            raise self._lost(error) from error

    def read(self, timeout: float) -> bytes:
        """What has arrived."""
        try:
            self._serial.timeout = timeout
            data = bytes(self._serial.read(1))
            waiting = self._serial.in_waiting if data else 0
            return data + bytes(self._serial.read(waiting)) if waiting else data
        except (OSError, TypeError, ValueError) as error:
            raise self._lost(error) from error

    def _lost(self, error: Exception) -> DeviceGoneError:
        return DeviceGoneError(f"the link at {self.port} is gone ({error})", "Check the plug and its power.")

    def arm(self, timeout_s: float) -> None:
        """Start the helper that stops the robot where this process dies; a cut cable nobody can help."""
        from tagid.motion.guardian import Guardian

        if self._guard is None and self._halt:
            self._guard = Guardian(self._serial.fileno(), self._halt)

    def disarm(self) -> None:
        """Send the helper home."""
        from tagid.motion.guardian import Guardian

        guard, self._guard = self._guard, None
        if isinstance(guard, Guardian):
            guard.release()

    def wake(self) -> None:
        """A pulse on RTS, to which adapters for robots wire BRC; a port without RTS is left alone."""
        import time

        try:
            self._serial.rts = True
            time.sleep(0.2)
            self._serial.rts = False
            time.sleep(0.1)
        except OSError as error:
            if error.errno not in (errno.ENOTTY, errno.EINVAL):
                raise self._lost(error) from error

    def set_baud(self, baud: int) -> None:
        """Change this side's rate."""
        self._serial.baudrate = self.baud = baud

    def close(self) -> None:
        """Let go of the port; a helper that was not sent home stops the robot now."""
        from tagid.motion.guardian import Guardian

        guard, self._guard = self._guard, None
        if isinstance(guard, Guardian):
            guard.release(farewell=False)
        self._serial.close()
