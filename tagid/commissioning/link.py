"""Step 1, the link: which radar answers, how fast it scans, what is lost, how its clock runs."""

from __future__ import annotations

from typing import Final

import numpy as np

from tagid.angles.clock import fit_clock
from tagid.capture import Capture
from tagid.commissioning.bench import Bench, echo_line, reported
from tagid.commissioning.pictures import Picture
from tagid.commissioning.rows import Level, Row, StepReport
from tagid.constants import RANGE_STEP_M
from tagid.errors import DataError
from tagid.radar.p440 import P440
from tagid.radar.survey import survey
from tagid.recording.radars import open_radar

_MOST_LOST: Final = 0.02
"""A turn has 4 scans for each view that its image needs: of 2 % lost ones nothing is seen."""
_RATE_TOLERANCE: Final = 0.01
_MOST_DRIFT_PPM: Final = 100.0
"""Crystals of radars and computers are within 50 ppm each."""
_NO_CLOCK: Final = 0.02
"""An emulator that does not wait runs at another speed than the computer's clock."""


def watch_link(bench: Bench) -> StepReport:
    """Survey the radar, then take scans for some seconds. Raises DeviceError and its subclasses."""
    place = bench.workplace()
    url, timeout = place.radar_url(), bench.config["radar.timeout_s"]
    device = survey(open_radar(url, timeout))
    status = device.status
    odd = device.warnings()
    rows = [
        Row(
            "radar",
            Level.FAIL if status.built_in_test else Level.PASS,
            text=f"serial {status.serial}, MRM {status.mrm_version}, FPGA {status.fpga_version}",
            advice="; ".join(odd),
            code="radar" if status.built_in_test else "",
        ),
        Row("temperature", Level.PASS, status.temperature_c, 0.25, "degC"),
    ]
    with open_radar(url, timeout) as radar:
        asked_s = radar.config.scan_period_s
        capture, lost = _scans(bench, radar, max(32, round(bench.seconds / asked_s)))
    drift, late = _drift(capture)
    rows += [_rate(capture, asked_s), _loss(capture.views, lost), drift]
    facts = {"serial": status.serial, "package": status.package, "mrm_version": status.mrm_version}
    return reported("link", rows, facts=facts, pictures=(late,))


def _scans(bench: Bench, radar: P440, count: int) -> tuple[Capture, int]:
    """(the times of the scans, without their samples; number of lost scans)."""
    before = radar.statistics.lost_scans
    host, clock, ids = [], [], []
    for scan in radar.scans(count):
        host.append(scan.host_time_ns)
        clock.append(scan.radar_time_ms)
        ids.append(scan.scan_id)
        bench.progress(len(host), count, f"{len(host)} scans {echo_line(scan.samples)}")
    if len(host) < 2:
        raise DataError("no complete scan arrived", "Check the radar with `tagid radar monitor`.")
    times = Capture(
        np.zeros((len(host), 1), np.int32),
        0.0,
        RANGE_STEP_M,
        host_time_ns=np.array(host, np.int64),
        radar_time_ms=np.array(clock, np.float64),
        scan_id=np.array(ids, np.int64),
    )
    return times, radar.statistics.lost_scans - before


def _rate(capture: Capture, asked_s: float) -> Row:
    assert capture.radar_time_ms is not None
    clock = fit_clock(capture.radar_time_ms, capture.scan_id)
    rate, sigma = 1 / clock.period_s, clock.period_sigma_s / clock.period_s**2
    good = abs(clock.period_s / asked_s - 1) <= _RATE_TOLERANCE
    advice = "The link is too slow for these scans: use Ethernet or USB, not a UART."
    return Row.judged("scan rate", good, rate, sigma, "Hz", f"asked {1 / asked_s:.2f} Hz", advice, "rate")


def _loss(received: int, lost: int) -> Row:
    total = received + lost
    share = lost / total
    sigma = float(np.sqrt(max(lost, 1)) / total)
    good, text = share <= _MOST_LOST, f"{lost} of {total}"
    advice = "Connect the radar directly, without a router or a wireless bridge."
    return Row.judged("lost scans", good, 100 * share, 100 * sigma, "%", text, advice, "loss")


def _drift(capture: Capture) -> tuple[Row, Picture]:
    """Rate of the radar's clock over the computer's, and the residual of the line.

    The residual gives the standard error.
    """
    assert capture.radar_time_ms is not None and capture.host_time_ns is not None
    radar_s = capture.radar_time_ms * 1e-3
    host_s = (capture.host_time_ns - capture.host_time_ns[0]) * 1e-9
    span = radar_s - radar_s.mean()
    slope = float(span @ host_s / (span @ span))
    rest = host_s - host_s.mean() - slope * span
    late = Picture.of("s: arrival of scans against a steady clock, ms", (radar_s - radar_s[0], 1e3 * rest))
    if abs(slope - 1) > _NO_CLOCK:
        no_clock = "not measured: the radar does not run in real time"
        return Row("clock drift", Level.NOTE, text=no_clock), late
    # Arrivals are late together when the computer is busy: neighbours count as one in ten.
    sigma = float(np.sqrt(rest @ rest / max(len(rest) - 2, 1) * 10 / (span @ span)))
    ppm = (1 / slope - 1) * 1e6
    fits = abs(ppm) <= _MOST_DRIFT_PPM + 3e6 * sigma
    advice = "Check that the computer's clock is not being set while recording."
    text = "radar against computer"
    return Row.judged("clock drift", fits, ppm, sigma * 1e6, "ppm", text, advice, "clock"), late
