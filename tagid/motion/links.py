"""Byte links to robots and tables: a serial port here, Bluetooth in `ble`; independent of the messages."""

from __future__ import annotations

import errno
import time
from abc import ABC, abstractmethod
from typing import Final

from tagid.errors import DeviceGoneError, DeviceTimeoutError
from tagid.motion.guard import Watch
from tagid.motion.guardian import Guardian
from tagid.ports import open_port

_WRITE_TIMEOUT_S: Final = 1.0
WAKE_S: Final = 1.0
"""Width of the pulse on BRC that wakes a robot."""


class ByteLink(ABC):
    """Carries bytes in both directions; a helper process may watch the program that drives."""

    _guardian: Guardian | None = None

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Send; may be called from any thread. Raises DeviceError if the link is down."""

    @abstractmethod
    def read(self, timeout: float) -> bytes:
        """Received bytes, waiting up to `timeout` s for the first one; b"" if none arrived.

        Raises DeviceError if the link is down.
        """

    @abstractmethod
    def arm(self, timeout_s: float) -> None:
        """From now on stop the robot automatically if nothing is written for this time, or the link ends."""

    def beat(self) -> None:
        """Send a heartbeat to the emergency stop; call it several times within the armed time.

        Raises MotionStoppedError if it has stopped the device, DeviceError if it has ended.
        """
        if self._guardian is not None:
            self._guardian.beat()

    def disarm(self) -> None:
        """Undo `arm`, once the robot is stopped."""
        self._release()

    @abstractmethod
    def wake(self) -> None:
        """Wake a sleeping robot (a low pulse on its BRC pin), if the link can."""

    @abstractmethod
    def close(self) -> None:
        """Close the link; if it is armed, the device is stopped. No effect if it is already closed."""

    def _guard(self, watch: Watch) -> None:
        """Start the guardian unless it is running. Raises DeviceError if it does not start."""
        if self._guardian is None:
            self._guardian = Guardian(watch)

    def _release(self, farewell: bool = True) -> None:
        """End the guardian; without a farewell message it stops the device first."""
        guardian, self._guardian = self._guardian, None
        if guardian is not None:
            guardian.release(farewell)


class SerialLink(ByteLink):
    """A serial port, 8N1.

    Args:
        halt: bytes that a helper process writes if this process dies or hangs while armed.

    Raises:
        DeviceGoneError, DeviceError, PortInUseError: see `tagid.ports.open_port`.
    """

    def __init__(self, port: str, baud: int, halt: bytes) -> None:
        self.port = port
        self._halt = halt
        self._serial = open_port(port, baud, _WRITE_TIMEOUT_S, "`tagid motion find` lists the ports")

    def __repr__(self) -> str:
        return self.port

    def write(self, data: bytes) -> None:
        import serial

        try:
            self._serial.write(data)
        except serial.SerialTimeoutException:
            raise DeviceTimeoutError(f"{self.port} accepts no data", "Check the cable.") from None
        except (OSError, TypeError, ValueError) as error:  # raised by pyserial after a disconnection
            raise self._lost(error) from error

    def read(self, timeout: float) -> bytes:
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
        self._guard(Watch(self.port, timeout_s, self._serial.fileno(), self._halt.hex()))

    def wake(self) -> None:
        """A pulse on RTS, to which robot adapters connect BRC; no effect on a port without RTS.

        It lasts a second (Create 2 OI specification): three pulses of 50 to 500 ms would change the rate.
        """
        try:
            self._serial.rts = True
            time.sleep(WAKE_S)
            self._serial.rts = False
            time.sleep(0.1)
        except OSError as error:
            if error.errno not in (errno.ENOTTY, errno.EINVAL):
                raise self._lost(error) from error

    def close(self) -> None:
        self._release(farewell=False)
        self._serial.close()
