"""Client of the Open Interface over any byte link: wake, query, drive, stop.

It has no thread and no safety policy; those are in `device`.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from tagid import hostclock
from tagid.errors import DeviceError, DeviceRejectedError, DeviceTimeoutError
from tagid.motion.links import ByteLink
from tagid.motion.roomba import messages as oi
from tagid.motion.roomba.messages import Mode, Op, Packet

_ANSWER_S: Final = 0.4
_SETTLE_S: Final = 0.05
"""The OI wants 20 ms between mode commands; a bridge adds some."""
_STATUS: Final = (
    Packet.MODE,
    Packet.CHARGER,
    Packet.CHARGING_STATE,
    Packet.VOLTAGE,
    Packet.CURRENT,
    Packet.TEMPERATURE,
    Packet.CHARGE,
    Packet.CAPACITY,
    Packet.BUMPS_AND_DROPS,
)

_FRAME: Final = 19
"""First byte of a stream frame."""
FAREWELL: Final = oi.HALT + oi.command(Op.PAUSE_STREAM, 0) + oi.command(Op.START)
"""Wheels to zero, stream off, Passive mode: the final state of the robot."""


class StreamDecoder:
    """Extracts stream frames from a byte stream: invalid data is skipped byte by byte until a frame fits.

    A robot that wakes up prints text, connecting a plug causes noise, and a bridge may lose data.

    Args:
        packets: ids in a valid frame; a frame with other ids is noise with a matching checksum (probability
            1 in 256 per byte).

    Attributes:
        dropped: bytes outside any frame.
    """

    def __init__(self, packets: Sequence[int]) -> None:
        self._packets = packets
        body_size = sum(1 + oi.packet_size(packet) for packet in packets)
        self._start = bytes((_FRAME, body_size))
        self._size = body_size + 3
        self._buffer = b""
        self.dropped = 0

    def feed(self, data: bytes) -> list[dict[int, int]]:
        """The frames that are complete, oldest first, as {packet: value}."""
        buffer = self._buffer + data
        frames: list[dict[int, int]] = []
        at = 0
        while at < len(buffer):
            frame = buffer[at : at + self._size]
            if len(frame) < self._size and self._start.startswith(frame[:2]):
                break  # the rest of it may follow
            values = self._parse(frame)
            if values is None:
                at += 1
                self.dropped += 1
            else:
                at += self._size
                frames.append(values)
        self._buffer = buffer[at:]
        return frames

    def _parse(self, frame: bytes) -> dict[int, int] | None:
        if not frame.startswith(self._start) or sum(frame) & 0xFF:
            return None
        values: dict[int, int] = {}
        at = len(self._start)
        for packet in self._packets:
            end = at + 1 + oi.packet_size(packet)
            if frame[at] != packet:
                return None
            values |= oi.unpack_packet(packet, frame[at + 1 : end])
            at = end
        return values


@dataclass(frozen=True)
class RobotStatus:
    """Status that a robot reports.

    Attributes:
        mode: the true mode, corrected for the firmware's off-by-one.
        on_charger: home base or internal charger connected.
        voltage_v, current_a, temperature_c: of the battery.
        charge: 0..1 of the capacity; None if the robot does not know.
        wheel_dropped: a wheel has dropped.
        mode_offset: offset that the firmware adds to the reported mode.
    """

    mode: Mode
    on_charger: bool
    voltage_v: float
    current_a: float
    temperature_c: int
    charge: float | None
    wheel_dropped: bool
    mode_offset: int


class OpenInterface:
    def __init__(self, link: ByteLink) -> None:
        self.link = link
        self.mode_offset = 0
        self.decoder = StreamDecoder(())

    def wake(self) -> RobotStatus:
        """Put the robot into Passive mode, waking it if needed, and read its status.

        The robot is then in Passive mode, so the mode it reports reveals the firmware's off-by-one.

        Raises:
            DeviceTimeoutError: no valid answer; the message says what to check.
        """
        for attempt in range(4):
            # The stream may still be on from a session that was cut off; its frames are not answers.
            self.link.write(oi.command(Op.START) + oi.command(Op.PAUSE_STREAM, 0))
            self._drain()
            with contextlib.suppress(DeviceTimeoutError, DeviceRejectedError):
                return self.status()
            if attempt == 1:
                self.link.wake()
        raise DeviceTimeoutError(
            f"the robot at {self.link} does not answer",
            "Switch it on (press Clean once), check the plug, and the rate: 115200 baud, or ?baud=19200 "
            "after a long press on Clean.",
        )

    def status(self) -> RobotStatus:
        """Read the status; the robot must be in Passive mode."""
        values = self.query(_STATUS)
        offset = values[Packet.MODE] - Mode.PASSIVE
        if offset not in (-1, 0, 1) or not 5_000 <= values[Packet.VOLTAGE] <= 30_000:
            raise DeviceRejectedError(
                f"the robot at {self.link} sends invalid answers",
                "Check the rate (?baud=115200 or 19200) and that this port is the robot's.",
            )
        self.mode_offset = offset
        capacity = values[Packet.CAPACITY]
        return RobotStatus(
            Mode.PASSIVE,
            bool(values[Packet.CHARGER] & 3) or values[Packet.CHARGING_STATE] in (1, 2, 3),
            values[Packet.VOLTAGE] * 1e-3,
            values[Packet.CURRENT] * 1e-3,
            values[Packet.TEMPERATURE],
            values[Packet.CHARGE] / capacity if capacity else None,
            bool(values[Packet.BUMPS_AND_DROPS] & 0b1100),
            offset,
        )

    def query(self, packets: Sequence[int]) -> dict[int, int]:
        """Send one query; no stream may be on, because answers carry no header.

        Raises DeviceTimeoutError if the answer does not come or has the wrong length.
        """
        sizes = [oi.packet_size(packet) for packet in packets]
        self.link.write(oi.command(Op.QUERY_LIST, len(packets), *packets))
        answer = b""
        deadline = time.monotonic() + _ANSWER_S
        while len(answer) < sum(sizes) and (remaining_s := deadline - time.monotonic()) > 0:
            answer += self.link.read(remaining_s)
        # Without a header, an answer that is too long cannot be used either.
        answer += self.link.read(_SETTLE_S) if len(answer) == sum(sizes) else b""
        if len(answer) != sum(sizes):
            self._drain()
            raise DeviceTimeoutError(
                f"the robot at {self.link} answered {len(answer)} bytes, expected {sum(sizes)}",
                "Check the rate and the plug.",
            )
        values: dict[int, int] = {}
        for packet, size in zip(packets, sizes, strict=True):
            values |= oi.unpack_packet(packet, answer[:size])
            answer = answer[size:]
        return values

    def safe(self) -> None:
        """Enter Safe mode and verify it. Raises DeviceRejectedError with the likely cause."""
        self.link.write(oi.command(Op.SAFE))
        time.sleep(_SETTLE_S)
        mode = self.query([Packet.MODE])[Packet.MODE] - self.mode_offset
        if mode != Mode.SAFE:
            raise DeviceRejectedError(
                f"the robot does not enter Safe mode (it reports {mode})",
                "Remove it from the charger and place it on the floor with all wheels down.",
            )

    def stream(self, packets: Sequence[int]) -> None:
        """Start the stream; read it with `frames`."""
        self.decoder = StreamDecoder(packets)
        self.link.write(oi.command(Op.STREAM, len(packets), *packets))

    def frames(self, timeout: float) -> list[tuple[int, dict[int, int]]]:
        """Stream frames received, as (host time ns, values)."""
        data = self.link.read(timeout)
        now = hostclock.now_ns()
        return [(now, values) for values in self.decoder.feed(data)]

    def spin(self, direction: int, speed_mm_s: int) -> None:
        """Turn in place; +1 is counter-clockwise from above."""
        self.link.write(oi.drive_direct(direction * speed_mm_s, -direction * speed_mm_s))

    def leave(self) -> None:
        """Wheels to zero, stream off, Passive; repeated until the robot confirms. Raises DeviceError."""
        for _ in range(3):
            self.link.write(FAREWELL)
            self._drain()
            with contextlib.suppress(DeviceTimeoutError):
                if self.query([Packet.MODE])[Packet.MODE] - self.mode_offset <= Mode.PASSIVE:
                    return
        raise DeviceError(
            f"the robot at {self.link} does not confirm the stop command",
            "Then check the connector or the distance.",
        )

    def _drain(self) -> None:
        deadline = time.monotonic() + 0.5
        while time.monotonic() < deadline and self.link.read(_SETTLE_S):
            pass
