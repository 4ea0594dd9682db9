"""A radar on a serial port: the P440's USB (CDC ACM) or its UART behind an adapter.

The port is opened exclusively. A port that disappeared is distinguished from a silent radar, because it can
be reopened when the device is reconnected.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from typing import Final

import serial

from tagid.errors import DeviceError, DeviceGoneError
from tagid.ports import open_port
from tagid.radar.framing import Framing, StreamDecoder, frame
from tagid.radar.messages import MAX_PACKET_BYTES

DEFAULT_BAUD: Final = 115_200
"""Factory baud rate of the P440's UART, 8N1 (P440 MRM API)."""

BAUD_RATES: Final = range(9_600, 921_601)
"""Baud rates of the P440's UART (P440 MRM API)."""

_QUIET_S: Final = 0.05
"""Idle time after which an incomplete frame is evaluated; a USB port buffers bytes for up to 16 ms."""
_FRAME_BITS: Final = 10 * (MAX_PACKET_BYTES + 6)
"""Bits of the longest frame, including start and stop bits (8N1)."""
_CHUNK: Final = 65_536
_WRITE_TIMEOUT_S: Final = 5.0


@dataclass(frozen=True)
class SerialPort:
    """A serial port and its framing.

    Attributes:
        path: device file, e.g. /dev/ttyACM0, or a link in /dev/serial/by-id, whose name does not change.
        framing: USB (CDC ACM) or UART.
        baud: baud rate on UART; on USB it has no meaning.
    """

    path: str
    framing: Framing = Framing.USB
    baud: int = DEFAULT_BAUD

    @property
    def url(self) -> str:
        options = "" if self.framing is Framing.USB else f"?framing=uart&baud={self.baud}"
        return f"serial://{self.path}{options}"


class SerialLink:
    """Carries packets over a serial port.

    Raises:
        PortInUseError: another program has it open.
        DeviceGoneError: the port does not exist (at present).
        DeviceError: no permission, or not a serial port.
    """

    exhausted = False
    foreign = 0

    def __init__(self, port: SerialPort) -> None:
        self.port = port
        uart = port.framing is Framing.UART
        self.guarded = uart
        self.packet_time_s = _FRAME_BITS / port.baud if uart else 0.0
        self.decoder = StreamDecoder(port.framing)
        self._packets: deque[bytes] = deque()
        self._heard_at = 0.0
        self._serial: serial.Serial | None = _open(port)

    def __repr__(self) -> str:
        return self.port.url

    @property
    def skipped_bytes(self) -> int:
        """Number of bytes on the line outside any frame."""
        return self.decoder.skipped

    def send(self, packet: bytes) -> None:
        """Send one packet. Raises DeviceGoneError if the port disappeared, DeviceError if writing fails."""
        line = self._line()
        try:
            line.write(frame(packet, self.port.framing))
        except serial.SerialTimeoutException as error:
            raise DeviceError(
                f"{self.port.path} accepts no data",
                "Check cable and power, then reconnect it.",
            ) from error
        except (OSError, TypeError) as error:  # pyserial's errors are subclasses of OSError
            raise self._gone(error) from error

    def receive(self, timeout: float) -> bytes | None:
        """The next packet, or None after `timeout` seconds. Raises DeviceGoneError if the port is missing."""
        deadline = time.monotonic() + timeout
        while not self._packets:
            remaining_s = deadline - time.monotonic()
            data = self._read(min(max(remaining_s, 0.0), _QUIET_S))
            if data:
                self._heard_at = time.monotonic()
                self._packets.extend(self.decoder.feed(data))
            elif time.monotonic() - self._heard_at >= _QUIET_S:
                self._packets.extend(self.decoder.flush())
            if not self._packets and time.monotonic() >= deadline:
                return None
        return self._packets.popleft()

    def reopen(self) -> None:
        """Reopen the port after it disappeared. Raises the same errors as the constructor."""
        self.close()
        self.decoder.reset()
        self._packets.clear()
        self._serial = _open(self.port)

    def close(self) -> None:
        line, self._serial = self._serial, None
        if line is not None:
            try:
                line.close()
            except OSError:
                return  # the device is already disconnected

    def _line(self) -> serial.Serial:
        if self._serial is None:
            raise DeviceGoneError(f"{self.port.path} is closed", "Open the radar again.")
        return self._serial

    def _read(self, wait_s: float) -> bytes:
        line = self._line()
        try:
            waiting = line.in_waiting
            if not waiting:
                line.timeout = wait_s
                first = bytes(line.read(1))
                if not first:
                    return b""
                return first + bytes(line.read(min(line.in_waiting, _CHUNK)))
            return bytes(line.read(min(waiting, _CHUNK)))
        except (OSError, TypeError) as error:  # TypeError: pyserial, if the port is closed during a read
            raise self._gone(error) from error

    def _gone(self, error: Exception) -> DeviceGoneError:
        self.close()
        return DeviceGoneError(
            f"the radar's port {self.port.path} disappeared ({error})", "Check plug and power."
        )


def _open(port: SerialPort) -> serial.Serial:
    find = "`tagid radar find` lists the ports that look like a radar's"
    return open_port(port.path, port.baud, _WRITE_TIMEOUT_S, find)
