"""The firmware's only clock: time since power-up that does not wrap; no other module reads the board's ticks.

The ticks wrap at 2^30, and a difference of two readings is right only within half of that: 8.9 min of
microseconds, 6.2 days of milliseconds. A reading is therefore relative to a mark that the loop renews every
minute. The watchdog, at most one minute (settings.py), bounds the time between two rounds of the loop, so a
mark is never older than two minutes, however long nothing happens.

The mark is one tuple, replaced as a whole, so an interrupt may read the clock at any moment. The milliseconds
are small integers, which need no memory, for the first 12 days.
"""

from time import ticks_diff, ticks_ms, ticks_us

from micropython import const

_RENEW_MS = const(60000)

# Ticks in ms, the uptime then in ms, ticks in us, the uptime then in us.
_mark = (ticks_ms(), 0, ticks_us(), 0)


def ms():
    """Uptime, ms."""
    mark = _mark
    return mark[1] + ticks_diff(ticks_ms(), mark[0])


def us():
    """Uptime, us."""
    mark = _mark
    return mark[3] + ticks_diff(ticks_us(), mark[2])


def advance():
    """Renew the mark when it is due; called in every round of the loop, and only there."""
    global _mark
    ticks_in_ms, total_ms, ticks_in_us, total_us = _mark
    now_ms, now_us = ticks_ms(), ticks_us()
    elapsed_ms = ticks_diff(now_ms, ticks_in_ms)
    if elapsed_ms >= _RENEW_MS:
        _mark = (now_ms, total_ms + elapsed_ms, now_us, total_us + ticks_diff(now_us, ticks_in_us))
