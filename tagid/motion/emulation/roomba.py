"""A Roomba as seen on its serial port: modes and their transitions, sleep, sensors, the stream every 15 ms.

It answers like a Create 2, for other clients as well (iRobot, "Create 2 Open Interface").
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tagid.errors import UsageError
from tagid.motion.emulation.body import Body, BodySettings
from tagid.motion.emulation.pty import PtyPort
from tagid.motion.emulation.truth import TruthServer
from tagid.motion.roomba import messages as oi
from tagid.motion.roomba.messages import Mode, Op, Packet
from tagid.motion.roomba.odometry import WHEEL_BASE_MM

SLEEP_AFTER_S: Final = 300.0
_RESET_S: Final = 3.0
_BANNER: Final = b"bl-start\r\nSTR730\r\nbootloader id: #x4756435E\r\nr3_robot/tags/release-3.5.4\r\n"
_DATA_BYTES: Final = {
    7: 0, 128: 0, 129: 1, 130: 0, 131: 0, 132: 0, 133: 0, 134: 0, 135: 0, 136: 0, 137: 4, 138: 1, 139: 3,
    141: 1, 142: 1, 143: 0, 144: 3, 145: 4, 146: 4, 147: 1, 150: 1, 151: 1, 162: 2, 163: 4, 164: 4, 165: 1,
    167: 15, 168: 3, 173: 0,
}  # fmt: skip
_COUNTED: Final = {140: (1, 2), 148: (0, 1), 149: (0, 1)}
"""Commands with a count: its offset in the data, and the bytes per counted item."""
_CLEANING: Final = (134, 135, 136, 143)
EVENTS: Final = {
    "bump": ("bump", 1),
    "wheel-drop": ("wheel_drop", 2),
    "cliff": ("cliff", True),
    "charger": ("on_charger", True),
}
"""What changes in the robot's world at an event."""


@dataclass
class World:
    """External conditions of the robot; may be changed at any time.

    Attributes:
        bump, wheel_drop: bits 0..1 of packet 7 (right, left), and of wheel drops.
        cliff: whether the front left cliff sensor sees no floor.
        on_charger: home base contacts.
        charge, capacity: mAh. temperature_c, voltage_mv: of the battery.
        mode_offset: offset that the firmware adds to the reported mode.
    """

    bump: int = 0
    wheel_drop: int = 0
    cliff: bool = False
    on_charger: bool = False
    charge: int = 2500
    capacity: int = 2696
    temperature_c: int = 24
    voltage_mv: int = 15_800
    mode_offset: int = 0


def happen(world: World, event: str) -> None:
    setattr(world, *EVENTS[event])


class RoombaCore:
    """One emulated robot; times are seconds of one clock that never runs backwards.

    Args:
        asleep: whether it has to be woken by a pulse on BRC.

    Attributes:
        mode: the true mode.
        asleep: whether it ignores all commands until woken.
        event: one of EVENTS, and after how many seconds of turning it happens; None for none.
    """

    def __init__(
        self,
        body: BodySettings | None = None,
        world: World | None = None,
        now_s: float = 0.0,
        baud: int = 115200,
        asleep: bool = False,
    ) -> None:
        self.body = Body(body, now_s)
        self.world = world or World()
        self.mode, self.asleep, self.baud = Mode.OFF, asleep, baud
        self.event: tuple[str, float] | None = None
        self._turning_since_s: float | None = None
        self._now = self._used_s = now_s
        self._starts_at_s: float | None = None
        self._buffer = bytearray()
        self._streamed: tuple[int, ...] = ()
        self._streaming, self._next_frame_s = False, 0.0
        self._speeds = (0, 0)
        self._reported_mm = (0.0, 0.0)
        """Distance and wheel difference already reported in packets 19 and 20."""

    def pulse_brc(self) -> None:
        """A low pulse on BRC: wakes a sleeping robot, and keeps an awake one from falling asleep."""
        self.asleep = False
        self._used_s = self._now

    def handle(self, data: bytes, now_s: float) -> bytes:
        out = self.advance(now_s)
        if self.asleep or self._starts_at_s is not None or not data:
            return out
        self._used_s = self._now
        self._buffer += data
        while (command := self._next_command()) is not None:
            out += self._obey(*command)
        return out

    def advance(self, now_s: float) -> bytes:
        if self._turning_since_s is None and self.body.moving:
            self._turning_since_s = now_s
        if self._turning_since_s is not None and self.event is not None:
            what, after_s = self.event
            if now_s - self._turning_since_s >= after_s:
                happen(self.world, what)
        out = b""
        while True:
            due = self._next_frame_s if self._streaming and self._streamed else None
            if due is None or due > now_s:
                break
            self._move_to(max(due, self._now))
            self._next_frame_s += oi.FRAME_S
            out += self._fit_frame()
        self._move_to(now_s)
        if self._starts_at_s is not None and self._now >= self._starts_at_s:
            self._starts_at_s = None
            out += _BANNER
        if self.mode is Mode.PASSIVE and self._now - self._used_s > SLEEP_AFTER_S and not self._streaming:
            self.asleep, self.mode = True, Mode.OFF
        return out

    def _fit_frame(self) -> bytes:
        frame = oi.stream_frame(self._streamed, self._sensors(self._streamed))
        # Data that does not fit into 15 ms at this rate is truncated, as on the real line.
        return frame[: int(self.baud / 10 * oi.FRAME_S)]

    def _move_to(self, now_s: float) -> None:
        if now_s <= self._now:
            return
        self._now = now_s
        self.body.advance(now_s)
        w = self.world
        if self.mode is Mode.SAFE and (w.wheel_drop or w.cliff or w.on_charger):
            self._enter(Mode.PASSIVE)
        if self.mode is Mode.FULL and w.on_charger and not self.body.moving:
            self._enter(Mode.PASSIVE)

    def _enter(self, mode: Mode) -> None:
        """Every change of mode stops the wheels."""
        if mode not in (Mode.SAFE, Mode.FULL) or self.mode not in (Mode.SAFE, Mode.FULL):
            self._drive(0, 0)
        self.mode = mode
        if mode is Mode.OFF:
            self._streaming = False

    def _drive(self, right: int, left: int) -> None:
        self._speeds = (right, left)
        self.body.drive(right, left)

    def _next_command(self) -> tuple[int, bytes] | None:
        buffer = self._buffer
        while buffer:
            opcode = buffer[0]
            size = _DATA_BYTES.get(opcode)
            if opcode in _COUNTED:
                place, item_bytes = _COUNTED[opcode]
                if len(buffer) < place + 2:
                    return None
                size = place + 1 + item_bytes * buffer[place + 1]
            if size is None:
                del buffer[0]
                continue
            if len(buffer) < size + 1:
                return None
            data = bytes(buffer[1 : size + 1])
            del buffer[: size + 1]
            return opcode, data
        return None

    def _obey(self, opcode: int, data: bytes) -> bytes:
        if opcode == Op.RESET:
            self._enter(Mode.OFF)
            self._starts_at_s = self._now + _RESET_S
            self._buffer.clear()
            return b""
        if opcode == Op.START:
            self._enter(Mode.PASSIVE)
            return b""
        if self.mode is Mode.OFF:
            return b""
        if opcode == Op.STOP:
            self._enter(Mode.OFF)
        elif opcode == Op.BAUD and data[0] < len(oi.BAUD_CODES):
            self.baud = oi.BAUD_CODES[data[0]]
        elif opcode in (Op.SAFE, 130, Op.FULL):
            self._enter(Mode.FULL if opcode == Op.FULL else Mode.SAFE)
        elif opcode == 133:
            self._enter(Mode.PASSIVE)
            self.asleep, self.mode, self._streaming = True, Mode.OFF, False
        elif opcode in _CLEANING:
            self._enter(Mode.PASSIVE)
        elif opcode in (Op.DRIVE, Op.DRIVE_DIRECT, 146) and self.mode in (Mode.SAFE, Mode.FULL):
            self._drive(*_wheel_speeds(opcode, data))
        elif opcode == Op.SENSORS:
            return self._answer([data[0]])
        elif opcode == Op.QUERY_LIST:
            return self._answer(data[1:])
        elif opcode == Op.STREAM:
            self._streamed = tuple(p for p in data[1:] if p in oi.PACKETS or p in oi.GROUPS)
            self._streaming, self._next_frame_s = bool(self._streamed), self._now + oi.FRAME_S
        elif opcode == Op.PAUSE_STREAM:
            self._streaming = bool(data[0]) and bool(self._streamed)
            self._next_frame_s = self._now + oi.FRAME_S
        return b""

    def _answer(self, packets: bytes | list[int]) -> bytes:
        known = [packet for packet in packets if packet in oi.PACKETS or packet in oi.GROUPS]
        values = self._sensors(known)
        return b"".join(oi.pack_packet(packet, values) for packet in known)

    def _since_reported(self, packets: Iterable[int]) -> dict[int, int]:
        """Packets 19 and 20: distance, mm, and angle, degrees, of the wheels since the last request for each.

        A request resets them; the rounding remainder is kept for the next answer.
        """
        asked = {single for packet in packets for single in oi.members(packet)}
        left, right = self.body.ways_mm()
        way, difference = (left + right) / 2, right - left
        reported_way, reported_difference = self._reported_mm
        degree_mm = math.radians(1) * WHEEL_BASE_MM
        distance = max(-32768, min(32767, math.trunc(way - reported_way)))
        angle = max(-32768, min(32767, math.trunc((difference - reported_difference) / degree_mm)))
        self._reported_mm = (
            reported_way + distance if oi.Packet.DISTANCE in asked else reported_way,
            reported_difference + angle * degree_mm if oi.Packet.ANGLE in asked else reported_difference,
        )
        return {oi.Packet.DISTANCE: distance, oi.Packet.ANGLE: angle}

    def _sensors(self, packets: Iterable[int]) -> dict[int, int]:
        w = self.world
        left, right = self.body.encoders()
        return {
            Packet.BUMPS_AND_DROPS: (w.bump & 3) | (w.wheel_drop & 3) << 2,
            Packet.CLIFF_FRONT_LEFT: int(w.cliff),
            Packet.CHARGING_STATE: 2 if w.on_charger else 0,
            Packet.VOLTAGE: w.voltage_mv,
            Packet.CURRENT: 1200 if w.on_charger else (-350 if self.body.moving else -180),
            Packet.TEMPERATURE: w.temperature_c,
            Packet.CHARGE: w.charge,
            Packet.CAPACITY: w.capacity,
            Packet.CHARGER: 2 if w.on_charger else 0,
            Packet.MODE: self.mode + w.mode_offset & 0xFF,
            Packet.LEFT_ENCODER: left,
            Packet.RIGHT_ENCODER: right,
            38: len(self._streamed),
            41: self._speeds[0],
            42: self._speeds[1],
            **self._since_reported(packets),
        }


class RoombaHost:
    """A running robot; a context manager.

    Args:
        body, world, baud, asleep: see RoombaCore.
        event: WHAT@SECONDS; None for no event.
        truth_port: UDP port of the true angle; 0 selects any free port.
        link: a symbolic link to create for the serial port.

    Attributes:
        core: the robot; inspect it while holding port.lock.
        port: its serial port.
        truth: provides `angle_rad`, `moving` and `still_since_s` (time.monotonic()).

    Raises UsageError for an event that is not valid.
    """

    def __init__(
        self,
        body: BodySettings | None = None,
        world: World | None = None,
        baud: int = 115200,
        asleep: bool = False,
        event: str | None = None,
        truth_port: int = 0,
        link: Path | None = None,
    ) -> None:
        self.core = RoombaCore(body, world, time.monotonic(), baud, asleep)
        if event is not None:
            what, _, after = event.partition("@")
            try:
                self.core.event = what, float(after or 0)
            except ValueError:
                what = ""
            if what not in EVENTS:
                raise UsageError(f"the event is {event!r}", f"Give {', '.join(EVENTS)} with @SECONDS.")
        self.port = PtyPort(self.core, link)
        self.truth = TruthServer(self._state, truth_port)
        self._stack = ExitStack()

    def _state(self, moment_s: float) -> dict[str, float | int | bool]:
        with self.port.lock:
            body = self.core.body
            return {
                "angle_rad": body.heading_at(moment_s),
                "moving": body.moving,
                "still_since_s": body.still_since_s,
                "mode": int(self.core.mode),
            }

    def __enter__(self) -> RoombaHost:
        self._stack.enter_context(self.port)
        self._stack.enter_context(self.truth)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


def _wheel_speeds(opcode: int, data: bytes) -> tuple[int, int]:
    """Right and left speeds, mm/s, of Drive, Drive Direct and Drive PWM, within the robot's limits."""
    first = int.from_bytes(data[:2], "big", signed=True)
    second = int.from_bytes(data[2:], "big", signed=True)
    if opcode == Op.DRIVE_DIRECT:
        right, left = first, second
    elif opcode == 146:
        right, left = round(first / 255 * 500), round(second / 255 * 500)
    elif second in (-32768, 32767):
        right = left = first
    elif second in (1, -1):
        right, left = second * first, -second * first
    else:
        half = 117.5 / second if second else 0.0
        right, left = round(first * (1 + half)), round(first * (1 - half))
    return max(-500, min(500, right)), max(-500, min(500, left))
