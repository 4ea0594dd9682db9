"""Reads a radar's state without changing it: no stop, no wake-up, no settings.

Connecting would stop a run; a user who only reads the status must not end another user's recording.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tagid.errors import DeviceRejectedError, DeviceTimeoutError
from tagid.radar.messages import OPMODE_MRM, SLEEP_ACTIVE
from tagid.radar.p440 import P440
from tagid.radar.settings import RadarConfig
from tagid.radar.status import RadarStatus


@dataclass(frozen=True)
class RadarSurvey:
    """State of a radar.

    Attributes:
        status: versions, serial number, temperature, self test.
        opmode, sleep_mode: as in the P440 MRM API; None if the firmware does not report it.
        config: settings in force; None outside MRM mode, in which it reports none.
        uptime_s: its clock, s since boot, modulo 2^32 ms; None as above.
    """

    status: RadarStatus
    opmode: int | None
    sleep_mode: int | None
    config: RadarConfig | None = None
    uptime_s: float | None = None

    def warnings(self) -> list[str]:
        """Warnings for the user, one sentence each."""
        sentences = self.status.warnings()
        if self.opmode not in (OPMODE_MRM, None):
            sentences.append(f"the radar is in operating mode {self.opmode}, not MRM: a recording sets MRM")
        if self.sleep_mode not in (SLEEP_ACTIVE, None):
            sentences.append(f"the radar is asleep (mode {self.sleep_mode}): the next recording wakes it")
        return sentences


def survey(radar: P440) -> RadarSurvey:
    """Query a radar without connecting, then close it. Raises DeviceError and its subclasses."""
    try:
        status, opmode, sleep = (
            radar.status(),
            _if_answered(radar.get_opmode),
            _if_answered(radar.get_sleep_mode),
        )
        if opmode not in (OPMODE_MRM, None):
            return RadarSurvey(status, opmode, sleep)
        return RadarSurvey(status, opmode, sleep, radar.get_config(), radar.uptime_s())
    finally:
        radar.close()


def _if_answered(question: Callable[[], int]) -> int | None:
    try:
        return question()
    except (DeviceRejectedError, DeviceTimeoutError):
        return None
