"""The link to the robot: its serial line, the dead-man that stops its wheels, and the BRC pin that wakes it.

Data queued for the robot waits here and not in the serial driver, because the dead-man must be able to
discard an outdated drive command.
"""

from time import sleep_ms

from machine import UART, Pin
from micropython import const
from tagid_bridge import clock
from tagid_bridge.ring import Ring

IDLE = const(0)
ARMED = const(1)
TRIPPED = const(2)

SILENCE = const(1)
FAULT = const(3)

# Roomba Open Interface: the zeros complete a truncated command (0 is not an opcode), Drive Direct 0 0 stops
# the wheels, Safe and a second stop follow in case the robot missed the first, and Start leaves it in
# Passive: motors off, and it may sleep and charge.
STOP = b"\x00\x00\x00\x00\x91\x00\x00\x00\x00\x83\x91\x00\x00\x00\x00\x80"
_AGAIN_MS = (30, 150)
# Spot, Clean, Max, Drive, Seek Dock, PWM Motors, Drive Direct, Drive PWM: after one of these bytes (possibly
# data of another command, which only errs towards stopping) the robot may be moving.
_MOVING = b"\x86\x87\x88\x89\x8f\x90\x91\x92"
_SLICE_MS = const(4)


class Robot:
    """The serial line to the robot, with its safety functions."""

    def __init__(self, config):
        self.baud = config["baud"]
        self._config = config
        self.uart = None
        if config["uart_tx"] is not None:
            self._open()
        pin = config["brc_pin"]
        self._released = 0 if config["brc_inverted"] else 1
        # Open drain if the pin is connected directly to BRC; through a transistor the level is inverted.
        mode = Pin.OUT if config["brc_inverted"] else Pin.OPEN_DRAIN
        self.brc = None if pin is None else Pin(pin, mode, value=self._released)
        self._brc_steps = 0
        self._brc_times = (0, 0)
        self._brc_next = 0
        self.to_robot = Ring(1024)
        self.from_robot = Ring(4096)
        self.state = IDLE
        self.timeout_ms = config["deadman_ms"]
        self._fed = clock.ms()
        self._free_at = 0
        self._repeats = []
        self.drove = False
        self.sent = self.received = self.lost_out = self.lost_in = self.trips = 0
        self._overflows = [False, False]

    def _open(self):
        c = self._config
        self.uart = UART(
            c["uart_id"],
            baudrate=self.baud,
            tx=c["uart_tx"],
            rx=c["uart_rx"],
            rxbuf=2048,
            txbuf=256,
            timeout=0,
        )

    def set_baud(self, baud):
        """Change the baud rate of the line, after the robot was commanded or woken into it."""
        self.baud = baud
        self.uart.init(baudrate=baud)

    # The dead-man.

    def feed(self):
        """Note that the host is alive."""
        self._fed = clock.ms()

    def arm(self, timeout_ms):
        """From now on stop the wheels if the host is silent for longer than `timeout_ms`."""
        self.timeout_ms = timeout_ms or self._config["deadman_ms"]
        self.state = ARMED
        self.feed()

    def disarm(self):
        """End the dead-man at the host's request; a robot that may be moving is stopped first."""
        if self.drove or len(self.to_robot):
            self.halt(IDLE)
        self.state = IDLE

    def silent_ms(self):
        """Time since the host last sent anything, ms."""
        return clock.ms() - self._fed

    def overdue(self):
        """Whether an armed host has been silent for too long."""
        return self.state == ARMED and self.silent_ms() >= self.timeout_ms

    def trip(self, next_state):
        """The dead-man: see `halt`."""
        self.trips += 1
        self.halt(next_state)

    def halt(self, next_state):
        """Discard the bytes queued for the robot and stop it, now and twice more."""
        # Set the state first: bytes from an interrupt after the queue is emptied must not enter it.
        self.state = TRIPPED
        self.to_robot.clear()
        self.stop()
        now = clock.ms()
        self._repeats = [now + wait for wait in _AGAIN_MS]
        self.drove = False
        self.state = next_state

    def stop_and_wait(self):
        """Stop the robot three times and return after the third: used at the start and end of the program."""
        self.state = TRIPPED
        self.to_robot.clear()
        self._repeats = []
        before = 0
        self.stop()
        for wait in _AGAIN_MS:
            sleep_ms(wait - before)
            before = wait
            self.stop()
        self.drove = False
        self.state = IDLE

    def stop(self):
        """Write the stop bytes, bypassing the queue."""
        if self.uart is not None:
            self.uart.write(STOP)
            self.sent += len(STOP)

    # The byte stream.

    def from_host(self, data):
        """Queue bytes from the host for the robot; called from the radio's interrupt."""
        if self.state == TRIPPED or not self.to_robot.put(data):
            self.lost_out += len(data)
            self._overflows[0] = True
            return
        if self.state == IDLE:
            self.arm(0)
        self.feed()

    def move(self, keep):
        """Transfer bytes; without `keep` there is no listener, and bytes from the robot are dropped."""
        if self.uart is None:
            return
        # While stops are pending nothing else is sent: a drive command must not overtake them.
        if len(self.to_robot) and not self._repeats and clock.ms() >= self._free_at:
            # Send only as much as the line carries in a few milliseconds: see the module's docstring.
            data = self.to_robot.peek(max(1, self.baud * _SLICE_MS // 10000))
            self.drove = self.drove or any(byte in _MOVING for byte in data)
            self.uart.write(data)
            self.to_robot.drop(len(data))
            self.sent += len(data)
            # Rounded up to whole milliseconds.
            self._free_at = clock.ms() - (-len(data) * 10000 // self.baud)
        waiting = self.uart.any()
        while waiting:
            data = self.uart.read(min(waiting, 256))
            if not data:
                break
            self.received += len(data)
            if keep and not self.from_robot.put(data):
                self.lost_in += len(data)
                self._overflows[1] = True
            waiting -= len(data)

    def overflows(self):
        """(direction, bytes lost so far) of each direction that lost bytes since the last call."""
        losses = []
        for direction, lost in enumerate((self.lost_out, self.lost_in)):
            if self._overflows[direction]:
                self._overflows[direction] = False
                losses.append((direction, lost))
        return losses

    # Periodic work.

    def pulse(self, width_ms, count, gap_ms):
        """Start `count` low pulses on BRC."""
        self._brc_times = (width_ms, gap_ms)
        self._brc_steps = 2 * count
        self._brc_next = clock.ms()

    def pulsing(self):
        """Whether pulses are in progress."""
        return self._brc_steps > 0

    def tick(self):
        """Do the work that is due: repeats of the stop bytes, edges on BRC."""
        now = clock.ms()
        if self._repeats and now >= self._repeats[0]:
            self._repeats.pop(0)
            self.stop()
        if self._brc_steps and now >= self._brc_next:
            low = self._brc_steps % 2 == 0
            self.brc.value(1 - self._released if low else self._released)
            self._brc_next = now + self._brc_times[0 if low else 1]
            self._brc_steps -= 1
