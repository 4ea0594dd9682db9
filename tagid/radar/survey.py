"""A look at a radar that changes nothing: no stop, no waking up, no setting.

Connecting stops whatever runs; who only wants to know must not end somebody's recording.
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
    """What a radar answers.

    Attributes:
        status: versions, serial number, temperature, self test.
        opmode, sleep_mode: as in the P440 MRM API; None if the firmware does not tell.
        config: settings in force; None outside MRM mode, where it tells none.
        uptime_s: its clock, s since boot, modulo 2^32 ms; None as above.
    """

    status: RadarStatus
    opmode: int | None
    sleep_mode: int | None
    config: RadarConfig | None = None
    uptime_s: float | None = None

    def warnings(self) -> list[str]:
        """What a user should know of, one sentence each."""
        found = self.status.warnings()
        if self.opmode not in (OPMODE_MRM, None):
            found.append(f"the radar is in operating mode {self.opmode}, not MRM: the next recording sets it")
        if self.sleep_mode not in (SLEEP_ACTIVE, None):
            found.append(f"the radar sleeps (mode {self.sleep_mode}): the next recording wakes it")
        return found


def survey(radar: P440) -> RadarSurvey:
    """Asks a radar that is not connected, and closes it. Raises DeviceError and its kinds."""
    try:
        status, opmode, sleep = radar.status(), _told(radar.get_opmode), _told(radar.get_sleep_mode)
        if opmode not in (OPMODE_MRM, None):
            return RadarSurvey(status, opmode, sleep)
        return RadarSurvey(status, opmode, sleep, radar.get_config(), radar.uptime_s())
    finally:
        radar.close()


def _told(question: Callable[[], int]) -> int | None:
    try:
        return question()
    except (DeviceRejectedError, DeviceTimeoutError):
        return None
