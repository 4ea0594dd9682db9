"""`tagid radar monitor` on a terminal, and the figures that it shows."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from on_a_terminal import run, stop_at
from rich.console import Console

from tagid.radar.assembler import Scan, Statistics
from tagid.radar.emulation.core import EmulatorCore, Identity
from tagid.radar.emulation.emulator import ServeOptions
from tagid.radar.emulation.faults import Faults
from tagid.radar.settings import RadarConfig
from tagid.recording.monitoring import ROWS, Monitor
from tagid.report.waterfall import draw
from tagid.waveform import nominal_pulse, pulse_at
from tests.emulators import UdpEmulator

CONFIG = RadarConfig(scan_start_ps=10_000, scan_stop_ps=21_000, base_integration_index=8)
CLIP = 127 << 8


class Echo:
    """A pulse at sample 60 that saturates, in noise."""

    def scan(self, index: int, time_s: float, config: RadarConfig) -> np.ndarray:
        rng = np.random.default_rng(index)
        t = (np.arange(config.samples) - 60) * 61.035e-12
        return np.rint(2 * CLIP * pulse_at(nominal_pulse(), t).real + rng.normal(0, 40, config.samples))


def device(**faults: float) -> UdpEmulator:
    core = EmulatorCore(Echo(), CONFIG, Identity(temperature_c=51.5))
    return UdpEmulator(core, ServeOptions(port=0, faults=Faults(**faults)))


@pytest.mark.parametrize("colour", [True, False])
def test_it_draws_in_colour_and_without_until_ctrl_c(tagid, home: dict[str, str], colour: bool) -> None:
    """It ends when it has drawn losses, clipping and an echo, however long a busy machine takes for that."""

    def enough(sent: bytes) -> bool:
        drawn = re.findall(rb"echo (\d+\.\d) dB", sent)
        losses = re.findall(rb"lost \d+\.\d% \((\d+)\)", sent)
        clipping = re.findall(rb"clipped (\d+\.\d+)%", sent)
        return len(drawn) > 3 and float(drawn[-1]) > 30 and losses[-1] > b"0" and float(clipping[-1]) > 0

    with device(lose=0.1, seed=5) as radar:
        words = ["radar", "monitor", "--radar", radar.url, "--output", "json"]
        drawn = run(home, words, (24, 80), stop_at(enough), **({} if colour else {"NO_COLOR": "1"}))
        again = tagid(*words[:4], "--seconds", "0.5")
    sent = drawn.sent
    assert drawn.code == 0, sent[-2000:]
    data = json.loads(drawn.out)["data"]
    assert data["frames"] >= 2  # how many a second is for the benchmark: a busy machine draws late
    assert data["scans"] > 10 and data["lost"] > 0 and data["clipped_fraction"] > 0
    assert data["temperature_c"] == 51.5 and data["snr_db"] > 30
    text = sent.decode(errors="replace")
    for part in ("echo", "clipped", "lost", "51.5 degC", "scans/s"):
        assert part in text
    assert ("▀" in text) is ("38;2;" in text) is colour
    assert "Traceback" not in text
    assert "\x1b[?1049l" in text  # the terminal is given back
    # The radar stands still then, and is watched again; without a terminal only the end is told.
    assert again.code == 0 and "\x1b" not in again.err and "scans in" in again.out
    assert not again.out.startswith("0 scans")


def scan(number: int, samples: np.ndarray) -> Scan:
    return Scan(number, 10 * number, 0, samples.astype(np.int32), 10_000, 21_000, 2)


def test_the_figures_are_those_of_the_scans() -> None:
    now = 0.0
    view = Monitor(CONFIG, cable_delay_ps=1000.0, clock=lambda: now)
    statistics = Statistics()
    for number in range(400):
        now += 0.1
        statistics.lost_scans = number // 4
        view.add(scan(number, Echo().scan(number, 0, CONFIG).clip(-CLIP, CLIP)), statistics)
    seen = view.snapshot()
    assert len(seen.rows) == ROWS
    assert seen.scan_rate_hz == pytest.approx(100)
    assert (seen.scans, seen.lost) == (400, 99)
    # Sample 60 is 3.66 ns behind the start at 10 ns; 1 ns is cable.
    assert seen.peak_m == pytest.approx((10_000 - 1000 + 60 * 61.035) * 1e-12 * 299_792_458 / 2, abs=0.05)
    assert seen.clipped_fraction == pytest.approx(np.mean(np.abs(Echo().scan(1, 0, CONFIG)) >= CLIP), rel=0.2)
    now += 30
    later = view.snapshot()
    assert later.silent_s == pytest.approx(30)
    assert later.clipped_fraction == seen.clipped_fraction


def test_what_changes_is_told_from_what_stands() -> None:
    now = 0.0
    still, moving = Monitor(CONFIG, clock=lambda: now), Monitor(CONFIG, changing=True, clock=lambda: now)
    for number in range(200):
        now += 0.1
        t = (np.arange(CONFIG.samples) - 100 - 10 * np.sin(number / 3)) * 61.035e-12
        samples = 500 * pulse_at(nominal_pulse(), t).real
        samples += Echo().scan(number, 0, CONFIG).clip(-CLIP, CLIP)
        for view in (still, moving):
            view.add(scan(number, samples), Statistics())
    assert abs(int(still.snapshot().rows.mean(axis=0).argmax()) - 60) <= 6
    assert abs(int(moving.snapshot().rows[:100].mean(axis=0).argmax()) - 100) <= 15


@pytest.mark.parametrize(
    ("size", "colour"), [((80, 24), True), ((20, 8), False), ((1, 1), True), ((300, 100), False)]
)
def test_the_screen_fits_any_terminal(size: tuple[int, int], colour: bool) -> None:
    now = 0.0
    view = Monitor(CONFIG, clock=lambda: now)
    console = Console(
        width=400, height=200, color_system="truecolor", force_terminal=True, no_color=not colour
    )
    for count in (0, 1, 30):
        for number in range(count):
            now += 0.1
            view.add(scan(number, Echo().scan(number, 0, CONFIG)), Statistics())
        with console.capture() as capture:
            console.print(draw(view.snapshot(), "title", size, colour))
        lines = capture.get().rstrip("\n").split("\n")
        assert len(lines) <= max(size[1], 8) + 1


def test_lost_scans_do_not_lower_the_rate_of_the_radar() -> None:
    view = Monitor(CONFIG, clock=lambda: 0.0)
    for number in range(0, 200, 4):
        view.add(scan(number, np.zeros(CONFIG.samples)), Statistics())
    assert view.snapshot().scan_rate_hz == pytest.approx(100)
