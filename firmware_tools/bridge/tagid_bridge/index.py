"""Timestamps of a turntable's index pulse, and the clock to which they and the host's clock fit refer."""

from array import array
from time import ticks_diff, ticks_us

from machine import Pin

_SLOTS = 16


class Clock:
    """Microseconds since power-up, without wrapping; call `now` at least every 8 minutes."""

    def __init__(self):
        self._last = ticks_us()
        self._total = 0

    def now(self):
        """Uptime, us."""
        ticks = ticks_us()
        self._total += ticks_diff(ticks, self._last)
        self._last = ticks
        return self._total

    def at(self, ticks):
        """Uptime of a recent reading of ticks_us, us."""
        now = self.now()
        return now - ticks_diff(self._last, ticks)


class IndexPulse:
    """Timestamps pulses of a Hall sensor in the pin's interrupt; bounces within the gap are ignored."""

    def __init__(self, pin, rising, gap_ms):
        self._stamps = array("i", [0] * _SLOTS)
        self._gap_us = gap_ms * 1000
        self._last = None
        self.count = 0
        self._taken = 0
        self.lost = 0
        self._pin = Pin(pin, Pin.IN, Pin.PULL_UP)
        self._pin.irq(self._pulse, Pin.IRQ_RISING if rising else Pin.IRQ_FALLING)

    def _pulse(self, pin):
        ticks = ticks_us()
        if self._last is not None and 0 <= ticks_diff(ticks, self._last) < self._gap_us:
            return
        self._last = ticks
        self._stamps[self.count % _SLOTS] = ticks
        self.count += 1

    def take(self):
        """(number, ticks) of the oldest pulse not yet reported, or None; overwritten pulses are counted."""
        waiting = self.count - self._taken
        if waiting > _SLOTS:
            self.lost += waiting - _SLOTS
            self._taken = self.count - _SLOTS
        if self._taken == self.count:
            return None
        number = self._taken
        self._taken += 1
        return number + 1, self._stamps[number % _SLOTS]
