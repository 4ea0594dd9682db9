"""Byte links to robots and tables: a serial port here, Bluetooth in `ble`; independent of the messages.

A driver uses ByteLink and does not distinguish a cable from a bridge.
"""

from __future__ import annotations

import errno
from typing import Final, Protocol

from tagid.errors import DeviceGoneError, DeviceTimeoutError, MissingExtraError
from tagid.motion.guardian import Guarded, Watch
from tagid.ports import open_port

_WRITE_TIMEOUT_S: Final = 1.0
WAKE_S: Final = 1.0
"""Width of the pulse on BRC that wakes a robot."""


class ByteLink(Protocol):
    """Carries bytes in both directions."""

    def write(self, data: bytes) -> None:
        """Send; may be called from any thread. Raises DeviceError if the link is down."""
        ...

    def read(self, timeout: float) -> bytes:
        """Received bytes, waiting up to `timeout` s for the first one; b"" if none arrived.

        Raises DeviceError if the link is down.
        """
        ...

    def arm(self, timeout_s: float) -> None:
        """From now on stop the robot automatically if nothing is written for this time, or the link ends."""
        ...

    def beat(self) -> None:
        """Send a heartbeat to the emergency stop; call it several times within the armed time.

        Raises MotionStoppedError if it has stopped the device, DeviceError if it has ended.
        """
        ...

    def disarm(self) -> None:
        """Undo `arm`, once the robot is stopped."""
        ...

    def wake(self) -> None:
        """Wake a sleeping robot (a low pulse on its BRC pin), if the link can."""
        ...

    def close(self) -> None:
        """Close the link; no effect if it is already closed."""
        ...


def require(module: str, extra: str, what: str) -> None:
    """Raise MissingExtraError if a package of an extra is not installed."""
    import importlib.util

    if importlib.util.find_spec(module) is None:
        raise MissingExtraError(
            f"{what} needs {module}, which is not installed", f"Install it: pip install 'tagid[{extra}]'."
        )


class SerialLink:
    """A serial port, 8N1.

    Args:
        port: device path or name.
        baud: baud rate.
        halt: bytes that a helper process writes if this process dies or hangs while armed; b"" for no helper.

    Raises:
        DeviceGoneError, DeviceError, PortInUseError: see `tagid.ports.open_port`.
    """

    def __init__(self, port: str, baud: int = 115200, halt: bytes = b"") -> None:
        self.port, self.baud = port, baud
        self._halt = halt
        self._serial = open_port(port, baud, _WRITE_TIMEOUT_S, "`tagid motion find` lists the ports")
        self._guard = Guarded()

    def __repr__(self) -> str:
        return self.port

    def write(self, data: bytes) -> None:
        """Send all of the data."""
        import serial

        try:
            self._serial.write(data)
        except serial.SerialTimeoutException:
            raise DeviceTimeoutError(f"{self.port} accepts no data", "Check the cable.") from None
        except (OSError, TypeError, ValueError) as error:  # raised by pyserial after a disconnection
            raise self._lost(error) from error

    def read(self, timeout: float) -> bytes:
        """Received bytes."""
        try:
            self._serial.timeout = timeout
            data = bytes(self._serial.read(1))
            waiting = self._serial.in_waiting if data else 0
            return data + bytes(self._serial.read(waiting)) if waiting else data
        except (OSError, TypeError, ValueError) as error:
            raise self._lost(error) from error

    def _lost(self, error: Exception) -> DeviceGoneError:
        return DeviceGoneError(f"the link at {self.port} disappeared ({error})", "Check plug and power.")

    def arm(self, timeout_s: float) -> None:
        """Start the helper that stops the device if this process dies or hangs; it needs an intact cable."""
        if self._halt:
            self._guard.start(Watch(self.port, timeout_s, self._serial.fileno(), self._halt))

    def beat(self) -> None:
        """Send a heartbeat to the helper."""
        self._guard.beat()

    def disarm(self) -> None:
        """End the helper."""
        self._guard.release()

    def wake(self) -> None:
        """A pulse on RTS, to which robot adapters connect BRC; no effect on a port without RTS.

        It lasts a second (Create 2 OI specification): three pulses of 50 to 500 ms would change the rate.
        """
        import time

        try:
            self._serial.rts = True
            time.sleep(WAKE_S)
            self._serial.rts = False
            time.sleep(0.1)
        except OSError as error:
            if error.errno not in (errno.ENOTTY, errno.EINVAL):
                raise self._lost(error) from error

    def set_baud(self, baud: int) -> None:
        """Change the baud rate of this side."""
        self._serial.baudrate = self.baud = baud

    def close(self) -> None:
        """Close the port; a helper that was not ended by `disarm` stops the device now."""
        self._guard.release(farewell=False)
        self._serial.close()
