"""The bridge: commands from the host, the loop that transfers bytes, and a robot stop on every exit."""

import sys
from struct import pack, unpack
from time import sleep_ms

import machine
from micropython import const
from tagid_bridge import PROTOCOL, VERSION, clock, settings
from tagid_bridge.index import IndexPulse
from tagid_bridge.radio import Radio
from tagid_bridge.robot import ARMED, FAULT, IDLE, SILENCE, TRIPPED, Robot

_OK = const(0)
_UNKNOWN = const(1)
_BAD = const(2)
_NOT_PAIRED = const(3)
_BUSY = const(4)
_NO_PIN = const(5)
_NO_ECHO = const(6)
_NOT_PROVISIONED = const(7)
_TRIPPED = const(8)

_TRIPPED_EVENT = const(0xC1)
_INDEX_EVENT = const(0xC2)
_OVERFLOW_EVENT = const(0xC3)

_BRC = const(0x06)
_LOOPBACK = const(0x08)
_QUEUE = const(16)
_WHILE_AWAKE_MS = const(600000)
_MOST = 0xFFFFFFFF  # the protocol's counters and durations have 32 bits


class Bridge:
    """All functions of one board; `step` does what is due and returns at once."""

    def __init__(self, config, problem, robot, after_watchdog=False):
        self._config = config
        self._provisioned = problem is None
        self._after_watchdog = after_watchdog
        self.robot = robot
        self.index = None
        if config["index_pin"] is not None:
            self.index = IndexPulse(config["index_pin"], config["index_rising"], config["index_gap_ms"])
        self._commands = []
        self._events = []
        self._bad_commands = 0
        self._lost_link = False
        self._index_lost_told = 0
        self._pulse_reply = None
        self._loop = None
        self._waiting_since = None
        self._round_at = clock.ms()
        self._longest_ms = 0
        self.radio = Radio(config["name"], config["passkey"], self._on_bytes, self._on_command, self._on_lost)
        self._flags_told = None

    # Called from the radio's interrupt.

    def _on_bytes(self, data):
        if self._provisioned and self._loop is None:
            self.robot.from_host(data)
        else:
            self.radio.refused += 1

    def _on_command(self, data):
        if len(self._commands) < _QUEUE:
            self._commands.append(data)
        else:
            self._bad_commands += 1

    def _on_lost(self):
        self._lost_link = True

    # The loop.

    def step(self):
        """One pass of the loop; all state is in the objects, so it can run for hours."""
        clock.advance()
        now = clock.ms()
        self._longest_ms = max(self._longest_ms, now - self._round_at)
        self._round_at = now
        if self.radio.fault is not None:
            raise self.radio.fault
        if self._lost_link:
            self._lost_link = False
            self._end_of_link()
        if self.robot.overdue():
            silent = self.robot.silent_ms()
            self.robot.trip(TRIPPED)
            self._tell(pack("<BBI", _TRIPPED_EVENT, SILENCE, silent))
        while self._commands:
            self._execute(self._commands.pop(0))
        self.robot.tick()
        if self._pulse_reply is not None and not self.robot.pulsing():
            self._reply(_BRC, self._pulse_reply, _OK)
            self._pulse_reply = None
        if self._loop is not None:
            self._loop_back()
        else:
            self.robot.move(self.radio.trusted())
        for direction, lost in self.robot.overflows():
            self._tell(pack("<BBI", _OVERFLOW_EVENT, direction, min(lost, _MOST)))
        self._tell_pulses()
        self._send()
        self.radio.tick()
        self._refresh_info()

    def _end_of_link(self):
        if self.robot.state == ARMED:
            self.robot.trip(IDLE)
        self.robot.disarm()
        self.robot.to_robot.clear()
        self.robot.from_robot.clear()
        self._commands = []
        self._events = []
        self._pulse_reply = None
        self._loop = None
        self._waiting_since = None

    def tell_fault(self):
        """Tell the host, if connected, that the firmware failed and stopped the robot."""
        self._tell(pack("<BBI", _TRIPPED_EVENT, FAULT, min(self.robot.silent_ms(), _MOST)))
        self._send()

    def _send(self):
        while self._events and self.radio.send_event(self._events[0]):
            self._events.pop(0)
        queue = self.robot.from_robot
        limit = self.radio.mtu - 3
        while len(queue) and self.radio.trusted():
            if len(queue) < limit and not self._waited():
                return
            data = queue.peek(limit)
            if not self.radio.send_bytes(data):
                return
            # Remove from the queue only what the stack accepted: a rejected notification is sent again.
            queue.drop(len(data))
            self._waiting_since = None

    def _waited(self):
        """Delay short pieces a little so that fewer notifications carry more bytes."""
        if self._waiting_since is None:
            self._waiting_since = clock.ms()
        return clock.ms() - self._waiting_since >= self._config["linger_ms"]

    def _tell(self, data):
        if self.radio.connected() and len(self._events) < 2 * _QUEUE:
            self._events.append(data)
            return True
        return False

    def _tell_pulses(self):
        if self.index is None:
            return
        while len(self._events) < _QUEUE:
            pulse = self.index.take()
            if pulse is None:
                break
            if self.radio.trusted():
                number, stamp = pulse
                age = min(clock.us() - stamp, _MOST)
                self._tell(pack("<BIQI", _INDEX_EVENT, number, stamp, age))
        if self.index.lost != self._index_lost_told:
            self._index_lost_told = self.index.lost
            self._tell(pack("<BBI", _OVERFLOW_EVENT, 2, self.index.lost))

    # Commands.

    def _execute(self, frame):
        if len(frame) < 2:
            self._bad_commands += 1
            return
        op, seq, args = frame[0], frame[1], frame[2:]
        if not self.radio.trusted():
            self._reply(op, seq, _NOT_PAIRED)
            return
        self.robot.feed()
        status, payload = self._answer(op, seq, args)
        if status is not None:
            self._bad_commands += status in (_UNKNOWN, _BAD)
            self._reply(op, seq, status, payload)

    def _answer(self, op, seq, args):
        """(status, payload); the status is None if the reply comes later."""
        if op not in _ARGUMENTS:
            return _UNKNOWN, b""
        form = _ARGUMENTS[op]
        if form is not None and len(args) != form[1]:
            return _BAD, b""
        values = () if form is None else unpack(form[0], args)
        if not self._provisioned and op in _DRIVING:
            return _NOT_PROVISIONED, b""
        if self.robot.state == TRIPPED and op == 0x04:
            return _TRIPPED, pack("<Q", clock.us())
        return _HANDLERS[op](self, seq, args if form is None else values)

    def _version(self, seq, values):
        return _OK, self._info()

    def _status(self, seq, values):
        robot = self.robot
        index = self.index
        counts = (
            robot.sent,
            robot.received,
            robot.lost_out,
            robot.lost_in,
            self.radio.retries,
            robot.trips,
            0 if index is None else index.count,
            0 if index is None else index.lost,
            self._bad_commands,
        )
        head = pack("<BQ", robot.state, clock.us())
        body = pack("<9I", *[count & _MOST for count in counts])
        room = robot.to_robot.free()
        return _OK, head + body + pack(
            "<HHIH", room, self.radio.mtu, robot.baud, min(self._longest_ms, 0xFFFF)
        )

    def _arm(self, seq, values):
        timeout = values[0]
        if timeout and not 100 <= timeout <= 5000:
            return _BAD, b""
        self.robot.arm(timeout)
        return _OK, pack("<H", self.robot.timeout_ms)

    def _time(self, seq, values):
        return _OK, pack("<Q", clock.us())

    def _disarm(self, seq, values):
        self.robot.disarm()
        return _OK, b""

    def _brc(self, seq, values):
        width, count, gap = values
        if self.robot.brc is None:
            return _NO_PIN, b""
        if self._pulse_reply is not None:
            return _BUSY, b""
        if not (1 <= width <= 2000 and 1 <= count <= 5 and gap <= 2000):
            return _BAD, b""
        self._pulse_reply = seq
        self.robot.pulse(width, count, gap)
        return None, b""

    def _echo(self, seq, data):
        if len(data) > self.radio.mtu - 6:
            return _BAD, b""
        return _OK, data

    def _loopback(self, seq, values):
        count = values[0]
        if not 1 <= count <= 512:
            return _BAD, b""
        if self.robot.state == ARMED or self._loop is not None:
            return _BUSY, b""
        uart = self.robot.uart
        while uart.any():
            uart.read(uart.any())
        # Reply tag, bytes to send, bytes sent, bytes that came back correctly, start, time of the last byte.
        self._loop = [seq, count, 0, 0, clock.us(), clock.ms()]
        return None, b""

    def _loop_back(self):
        """Send a few bytes of the pattern and expect them back; the pattern contains no robot opcode."""
        loop, uart = self._loop, self.robot.uart
        if loop[2] < loop[1] and loop[2] - loop[3] < 32:
            piece = min(16, loop[1] - loop[2])
            uart.write(bytes([_pattern(loop[2] + i) for i in range(piece)]))
            loop[2] += piece
        data = uart.read(uart.any()) if uart.any() else b""
        right = 0
        while right < len(data) and data[right] == _pattern(loop[3] + right):
            right += 1
        loop[3] += right
        if right:
            loop[5] = clock.ms()
        quiet = clock.ms() - loop[5] > 100 + 320000 // self.robot.baud
        if loop[3] == loop[1] or right < len(data) or quiet:
            self._loop = None
            took = clock.us() - loop[4]
            status = _OK if loop[3] == loop[1] else _NO_ECHO
            self._reply(_LOOPBACK, loop[0], status, pack("<HHI", loop[2], loop[3], took & 0xFFFFFFFF))

    def _baud(self, seq, values):
        if not 300 <= values[0] <= 115200:
            return _BAD, b""
        if self.robot.state == ARMED:
            # At a different baud rate the robot would not understand a stop.
            return _BUSY, b""
        self.robot.set_baud(values[0])
        return _OK, pack("<I", values[0])

    def _reply(self, op, seq, status, payload=b""):
        if not self._tell(pack("BBB", op | 0x80, seq, status) + payload):
            self._bad_commands += 1

    # Identity.

    def _flags(self):
        c = self._config
        return (
            self._provisioned * 1
            | (c["passkey"] is not None) * 2
            | self.radio.trusted() * 4
            | (c["brc_pin"] is not None) * 8
            | (c["index_pin"] is not None) * 16
            | self._after_watchdog * 32
        )

    def _info(self):
        what = sys.implementation
        chip = getattr(what, "_machine", sys.platform)
        python = ".".join([str(part) for part in what.version[:3]])
        text = ";".join((self._config["name"], chip, python))
        return bytes((PROTOCOL,)) + bytes(VERSION) + bytes((self._flags(),)) + text.encode()

    def _refresh_info(self):
        flags = self._flags()
        if flags != self._flags_told:
            self._flags_told = flags
            self.radio.set_info(self._info())


# Arguments of each command: struct format and length, or None for any bytes.
_ARGUMENTS = {
    0x01: ("<", 0),
    0x02: ("<", 0),
    0x03: ("<H", 2),
    0x04: ("<", 0),
    0x05: ("<", 0),
    _BRC: ("<HBH", 5),
    0x07: None,
    _LOOPBACK: ("<H", 2),
    0x09: ("<I", 4),
    0x0A: ("<", 0),
}
_HANDLERS = {
    0x01: Bridge._version,
    0x02: Bridge._status,
    0x03: Bridge._arm,
    0x04: Bridge._time,
    0x05: Bridge._disarm,
    _BRC: Bridge._brc,
    0x07: Bridge._echo,
    _LOOPBACK: Bridge._loopback,
    0x09: Bridge._baud,
    0x0A: Bridge._time,
}
_DRIVING = (0x03, _BRC, _LOOPBACK, 0x09)


def _pattern(position):
    return 0x40 + position % 64


def run():
    """Serve until power-off; the robot is stopped at the start and before every other exit."""
    config, problem = settings.load()
    try:
        robot = Robot(config)
    except Exception as error:
        # A pin or UART that this chip lacks: serve like an unprovisioned board, and report why.
        problem = str(error) or repr(error)
        config = settings.default()
        robot = Robot(config)
    if problem is not None:
        print("tagid bridge: not provisioned:", problem)
    # Whatever reset the board (a brown-out counts as power-on, a crash as a hard reset), the robot may be
    # moving: stop it before the radio starts, because that may fail.
    robot.stop_and_wait()
    bridge = None
    try:
        bridge = Bridge(config, problem, robot, machine.reset_cause() == machine.WDT_RESET)
        watchdog = machine.WDT(timeout=config["watchdog_ms"])
        while True:
            bridge.step()
            watchdog.feed()
            sleep_ms(1)
    except KeyboardInterrupt:
        robot.stop_and_wait()
        # The board is in use over USB; the watchdog cannot be stopped, but its timeout can be extended.
        machine.WDT(timeout=_WHILE_AWAKE_MS)
        raise
    except Exception as error:
        robot.stop_and_wait()
        sys.print_exception(error)
        try:
            if bridge is not None:
                bridge.tell_fault()
        finally:
            sleep_ms(500)
            machine.reset()
