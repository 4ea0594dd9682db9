"""Scans that continue after the radar was disconnected: an unplugged cable, a restart, a loose connector.

A loose plug for two seconds must not end a recording of ten minutes. Missing scans are marked, and scan
numbers and clock continue as if the radar had scanned without interruption.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Final

from tagid.errors import (
    DeviceError,
    DeviceGoneError,
    DeviceRejectedError,
    DeviceRestartedError,
    DeviceTimeoutError,
)
from tagid.metadata import ScanGap
from tagid.radar.assembler import Scan, unwrap
from tagid.radar.messages import SCAN_FOREVER
from tagid.radar.p440 import P440

RESUME_S: Final = 20.0
"""How long to wait for a radar that is disconnected or booting: it boots for 7 to 11 s (measured)."""

_POLL_S: Final = 0.2
_SAME_CLOCK_MS: Final = 1500
"""Clock deviation above which the radar is considered restarted."""


def steady_scans(
    radar: P440,
    count: int = SCAN_FOREVER,
    interval_us: int = 0,
    resume_s: float = RESUME_S,
    on_gap: Callable[[ScanGap], None] = lambda gap: None,
    until: Callable[[], bool] = lambda: False,
) -> Iterator[Scan]:
    """The scans of a run as from `P440.scans`, continued after the radar reconnects.

    After a gap, the scan numbers include the scans that were missed, and the radar's clock continues; if the
    radar restarted, by the host's clock. A radar that is only silent gets one more request; one that lost its
    connection or power is waited for.

    Args:
        count, interval_us: as for `P440.scans`; scans missed in a gap do not count.
        resume_s: how long to wait for a radar that is disconnected or booting, s; 0 never waits.
        on_gap: called before the first scan after a gap.
        until: as for `P440.scans`; also called while waiting for the radar.

    Raises the errors of `P440.scans` if the radar does not reconnect, reconnects with other settings, or
    sends no complete scan for `resume_s` after reconnecting.
    """
    last: Scan | None = None
    last_at = 0.0
    shift_ms = done = 0
    reason, rebooted = "", False
    while True:
        before, join = last, None
        first_id = newest_id = 0
        try:
            remaining = count if count == SCAN_FOREVER else count - done
            for scan in radar.scans(remaining, interval_us, until):
                if join is None:
                    first_id = scan.scan_id
                    join = _Join(0, shift_ms)
                    if before is not None:
                        period_s = max(radar.config.scan_period_s, interval_us * 1e-6)
                        join, gap = _joined(before, scan, period_s, None if rebooted else shift_ms)
                        on_gap(replace(gap, reason=reason))
                newest_id = scan.scan_id
                last = join.shifted(scan)
                yield last
                last_at = time.monotonic()
            return
        except (DeviceGoneError, DeviceRestartedError, DeviceTimeoutError) as error:
            if resume_s <= 0 or last is None:
                raise
            if join is None and time.monotonic() - last_at > resume_s:
                raise
            if join is not None:
                done += newest_id - first_id + 1
                shift_ms = join.time_ms
            if count != SCAN_FOREVER and done >= count:
                return
            reason, rebooted = error.message, isinstance(error, DeviceRestartedError)
            if not _come_back(radar, error, resume_s, until):
                return


@dataclass(frozen=True)
class _Join:
    """Offsets of a run's scan numbers and clock that make it continue the previous one."""

    scans: int
    time_ms: int

    def shifted(self, scan: Scan) -> Scan:
        if not (self.scans or self.time_ms):
            return scan
        return replace(
            scan, scan_id=scan.scan_id + self.scans, radar_time_ms=scan.radar_time_ms + self.time_ms
        )


def _joined(before: Scan, first: Scan, period_s: float, shift_ms: int | None) -> tuple[_Join, ScanGap]:
    """Offsets with which a run that starts with `first` continues after `before`.

    `shift_ms` is the clock offset of `before`; None if the radar's clock certainly restarted.
    """
    elapsed_ms = max((first.host_time_ns - before.host_time_ns) / 1e6, 0.0)
    expected = round(before.radar_time_ms + elapsed_ms)
    now_ms = unwrap(first.radar_time_ms + (shift_ms or 0), expected, 32)
    off_ms = abs(now_ms - expected)
    restarted = shift_ms is None or off_ms > _SAME_CLOCK_MS or now_ms <= before.radar_time_ms
    if restarted:
        now_ms = max(expected, before.radar_time_ms + 1)
    gap_ms = now_ms - before.radar_time_ms
    # Count at least one missing scan, so that the scan numbers also show the gap.
    step = max(2, round(gap_ms / (period_s * 1e3)))
    join = _Join(before.scan_id + step - first.scan_id, now_ms - first.radar_time_ms)
    return join, ScanGap(before.scan_id, gap_ms * 1e-3, "", restarted)


def _come_back(radar: P440, error: DeviceError, resume_s: float, until: Callable[[], bool]) -> bool:
    """Wait for the radar and restore its settings; return False if the caller ended the wait.

    Raises `error` if the radar does not reconnect.
    """
    asked, taken = replace(radar.asked, persist=0), radar.config
    deadline = time.monotonic() + resume_s
    while not until():
        try:
            radar.reconnect()
            back = radar.set_config(asked)
        except DeviceRejectedError:
            raise
        except DeviceError as still:
            if isinstance(error, DeviceTimeoutError) or time.monotonic() >= deadline:
                raise error from still
            time.sleep(_POLL_S)
            continue
        if replace(back, persist=taken.persist) != taken:
            raise DeviceError(
                "the radar reconnected with another scan window or other settings",
                "The scans before that are kept; run the command again.",
            )
        return True
    return False
