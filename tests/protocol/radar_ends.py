"""Both ends of a wire for the tests: sources whose scans tell their number, and emulators on real wires."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tagid.radar.emulation.core import EmulatorCore
from tagid.radar.emulation.emulator import ServeOptions
from tagid.radar.emulation.faults import Faults
from tagid.radar.emulation.firmware import Firmware, Identity
from tagid.radar.framing import Framing
from tagid.radar.settings import RadarConfig
from tests.emulators import SerialEmulator, UdpEmulator

THREE_FRAGMENTS = RadarConfig(scan_start_ps=10_000, scan_stop_ps=60_000, base_integration_index=6)
"""864 samples: 350 + 350 + 164."""


class Numbered:
    """Sample k of scan i is 1000 i + k, modulo what the lowest integration index can hold."""

    def scan(self, index: int, time_s: float, config: RadarConfig) -> np.ndarray:
        return numbered(index, config.samples)


def numbered(index: int, samples: int) -> np.ndarray:
    return ((1000 * index + np.arange(samples)) % 8000 - 4000).astype(np.int32)


def core(
    firmware: Firmware | None = None, identity: Identity | None = None, booted_s: float = 10.0
) -> EmulatorCore:
    return EmulatorCore(Numbered(), RadarConfig(base_integration_index=6), identity, booted_s, firmware)


def udp(the_core: EmulatorCore | None = None, rate: float = 0.0, **faults: float) -> UdpEmulator:
    return UdpEmulator(the_core or core(), ServeOptions(port=0, rate=rate, faults=Faults(**faults)))


def pty(
    framing: Framing = Framing.USB,
    the_core: EmulatorCore | None = None,
    rate: float = 0.0,
    link: Path | None = None,
    **faults: float,
) -> SerialEmulator:
    options = ServeOptions(rate=rate, faults=Faults(**faults))
    return SerialEmulator(the_core or core(), options, framing, link=link)


def check(scans: list, first_id: int, samples: int) -> None:
    """Every scan holds what its number says; ids rise."""
    ids = [scan.scan_id for scan in scans]
    assert ids == sorted(set(ids))
    for scan in scans:
        np.testing.assert_array_equal(scan.samples, numbered(scan.scan_id - first_id, samples))
