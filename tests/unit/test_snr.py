"""One SNR: what an emulator prints, `show` and the live view measure, and a plan predicts of one object."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tagid.live.engine import LiveSettings, LiveView
from tagid.motion.urls import open_motion
from tagid.pipeline.settings import ImagingSettings
from tagid.planning.plan import Setup, planned_snr_db
from tagid.radar.assembler import Statistics
from tagid.radar.settings import RadarConfig
from tagid.recording.inspection import inspect
from tagid.recording.monitoring import Monitor
from tagid.recording.plan import RecordingPlan, plan_window
from tagid.recording.radars import emulated_object, open_radar
from tagid.recording.recorder import Watch, record
from tagid.recording.stream import ScanStream
from tagid.signal import analytic, changing_power, noise_power_of, snr_db
from tagid.simulate import ReflectorSpec, parse_body
from tagid.simulate.budget import LinkBudget
from tagid.tags.layouts.layout import builtin_layouts
from tests.unit.paced import wait_for


@pytest.mark.parametrize("level", ["snr=20", "snr=5", "budget=1&reflector=octahedron:40mm"])
def test_emulator_show_live_view_and_plan_agree_on_the_snr_of_a_helmet(tmp_path: Path, level: str) -> None:
    url = f"emulator://helmet-120?rpm=40&seed=2&{level}"
    about = emulated_object(url)
    assert about is not None and about.truth is not None and about.truth.snr_db is not None
    emulated = about.truth.snr_db
    config = plan_window(1.0, 0.5, 0.0, RadarConfig(base_integration_index=11))
    streams: list[ScanStream] = []
    with LiveView(LiveSettings(open_motion("free?rpm=40"), imaging=ImagingSettings(pixels=32))) as view:

        def began(stream: ScanStream) -> None:
            streams.append(stream)
            view.began(stream)

        plan = RecordingPlan(config, 1.0, motion="free?rpm=40", max_seconds=2.0)
        motion = open_motion("free?rpm=40")
        capture = record(open_radar(url), motion, plan, tmp_path / "x.tagid.h5", Watch(began=began))
        wait_for(lambda: view.state.scans == capture.views)
    shown = inspect(capture)
    assert shown.snr_db == pytest.approx(emulated, abs=1.0)
    assert view.state.snr_db == pytest.approx(shown.snr_db, abs=0.2)
    if "budget" in level:
        helmet = builtin_layouts()["helmet-120"]
        setup = Setup(helmet, ReflectorSpec("octahedron", 0.04), parse_body("none"), 1.0, 40.0, LinkBudget())
        assert planned_snr_db(setup) == pytest.approx(emulated, abs=1.0)
    # The monitor sees a small part of a turn, and static echoes count: the last scans' strongest.
    times = iter(range(1_000_000))
    monitor = Monitor(config, clock=lambda: float(next(times)))
    for scan in streams[0].since():
        monitor.add(scan, Statistics())
    last = inspect(capture.select(slice(-32, None)))
    assert monitor.snapshot().snr_db == pytest.approx(last.strongest_over_noise_db, abs=0.01)
    assert "SNR" not in monitor.snapshot().strongest


def test_the_snr_is_that_of_its_equation() -> None:
    rng = np.random.default_rng(0)
    views, bins, sigma = 400, 256, 20.0
    n = np.arange(bins) - 120
    burst = np.exp(-((n / 10) ** 2) + 0.5j * np.pi * n)
    turn = np.exp(2j * np.pi * np.arange(views) / 50)[:, None]
    echo = 300 * turn * burst + 5000 * np.exp(-(((n - 60) / 10) ** 2)) * np.ones((views, 1))
    samples = echo.real + sigma * rng.standard_normal((views, bins))
    signal = analytic(samples)
    measured, at = snr_db(signal, noise_power_of(signal))
    assert 10 * np.log10(changing_power(echo) / sigma**2) == pytest.approx(20 * np.log10(300 / sigma))
    assert measured == pytest.approx(20 * np.log10(300 / sigma), abs=0.3)
    assert at is not None and abs(at - 120) <= 1
