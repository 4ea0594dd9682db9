"""Timestamps of a turntable's index pulse."""

from array import array

from machine import Pin
from tagid_bridge import clock

_SLOTS = 16


class IndexPulse:
    """Timestamps pulses of a Hall sensor in the pin's interrupt; bounces within the gap are ignored."""

    def __init__(self, pin, rising, gap_ms):
        self._stamps = array("q", [0] * _SLOTS)
        self._gap_us = gap_ms * 1000
        self._last = None
        self.count = 0
        self._taken = 0
        self.lost = 0
        self._pin = Pin(pin, Pin.IN, Pin.PULL_UP)
        self._pin.irq(self._pulse, Pin.IRQ_RISING if rising else Pin.IRQ_FALLING)

    def _pulse(self, pin):
        stamp = clock.us()
        if self._last is not None and stamp - self._last < self._gap_us:
            return
        self._last = stamp
        self._stamps[self.count % _SLOTS] = stamp
        self.count += 1

    def take(self):
        """(number, uptime in us) of the oldest pulse not reported, or None; overwritten ones are counted."""
        waiting = self.count - self._taken
        if waiting > _SLOTS:
            self.lost += waiting - _SLOTS
            self._taken = self.count - _SLOTS
        if self._taken == self.count:
            return None
        number = self._taken
        self._taken += 1
        return number + 1, self._stamps[number % _SLOTS]
