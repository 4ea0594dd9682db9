"""The steps on an emulated rig: each value is within its own standard errors, and each fault is named."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest

from tagid.commissioning import card as card_step
from tagid.commissioning.bench import Bench
from tagid.commissioning.page import write_page
from tagid.commissioning.pulse import echo_pulse
from tagid.commissioning.rows import Level, Row, StepReport
from tagid.commissioning.steps import next_step, run_step, step_named
from tagid.commissioning.targets import parse_target
from tagid.config import load_config
from tagid.constants import SAMPLE_STEP_S
from tagid.enrolling.registry import Registry
from tagid.errors import ConfigError, UsageError
from tagid.rig import Measured
from tagid.simulate.rig import parse_rig
from tagid.tags.layouts.test_card import test_card
from tagid.waveform import nominal_pulse, pulse_at


def bench(tmp_path: Path, scene: str, rig: str = "realistic?seed=3", **tape: object) -> Bench:
    true = parse_rig(rig)
    slant = math.hypot(true.axis_distance_m, true.antenna_height_m)
    given = {"target_distance_m": slant, "axis_distance_m": 1.0, "antenna_height_m": true.antenna_height_m}
    url = f"emulator://{scene}?rig={quote(rig, safe='')}&seed=1"
    config = load_config({"radar.url": url, "radar.integration": 15})
    return Bench(config, {**given, "error_m": 0.001, **tape}, seconds=1, scans=40)


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TAGID_DATA", str(tmp_path))
    monkeypatch.setenv("TAGID_CONFIG", str(tmp_path / "config.toml"))


def test_link_room_and_target_measure_the_rig(tmp_path: Path) -> None:
    true = parse_rig("realistic?seed=3")
    for name, scene in (("link", "empty"), ("room", "empty"), ("target", "target")):
        report = run_step(step_named(name), bench(tmp_path, scene))
        assert report.passed, [row for row in report.rows if row.level is Level.FAIL]
    again = bench(tmp_path, "empty")
    assert again.report("target").to_json() == report.to_json()
    assert next_step(again).name == "turning"
    delay, gain = report.values["path_delay_ps"], report.values["system_gain_db"]
    assert abs(delay.value - true.cable_delay_ps) < min(15.0, 2 * delay.sigma)
    assert abs(gain.value - true.gain_db) < 2 * gain.sigma
    page = tmp_path / "rig.html"
    write_page(page, [report], ["Reference target"], None)
    text = page.read_text()
    assert 'class="pass"' in text and "polyline" in text and "not commissioned yet" in text


@pytest.mark.parametrize(
    ("fault", "step", "scene"),
    [("gain", "room", "empty"), ("microwave", "room", "empty"), ("other-radar", "room", "empty"),
     ("person", "room", "empty"), ("cable", "target", "target"), ("polarisation", "target", "target")],
)  # fmt: skip
def test_a_fault_is_named(tmp_path: Path, fault: str, step: str, scene: str) -> None:
    rig = f"realistic?seed=3&fault={fault}"
    report = run_step(step_named("room"), bench(tmp_path, "empty", rig))
    if step == "target":
        assert report.passed
        report = run_step(step_named(step), bench(tmp_path, scene, rig))
    assert fault in report.faults, report.rows
    assert all(row.advice for row in report.rows if row.level is Level.FAIL)


def test_a_target_needs_its_distance_and_the_empty_room(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="distance is missing"):
        run_step(step_named("target"), bench(tmp_path, "target", target_distance_m=None))
    with pytest.raises(ConfigError, match="empty room"):
        run_step(step_named("target"), bench(tmp_path, "target"))
    with pytest.raises(ConfigError, match="not done yet: link"):
        run_step(step_named("result"), bench(tmp_path, "empty"))


@pytest.mark.parametrize("text", ["octahedron:40mm", "corner:20cm", "sphere:10cm", "can:33mm"])
def test_the_delay_of_a_target_is_taken_out_of_the_pulse(text: str) -> None:
    target = parse_target(text)
    t = (np.arange(600) - 250.3) * SAMPLE_STEP_S
    length = 4096
    frequency = np.fft.rfftfreq(length, SAMPLE_STEP_S)
    response = target.scatterer.scattering_length(
        np.maximum(frequency, 1e9)
    ) / target.scatterer.scattering_length(np.array([4e9]))
    # The solved scattering lengths have the phase of exp(-j omega t).
    spectrum = np.fft.rfft(pulse_at(nominal_pulse(), t).real, length) * np.conj(response)
    echo = echo_pulse(
        np.fft.irfft(spectrum, length)[:600] * 5000, 250.3 + target.delay_ps() * 1e-12 / SAMPLE_STEP_S, target
    )
    assert echo.delay_ps == pytest.approx(target.delay_ps(), abs=2)
    middle = len(echo.pulse.samples) // 2
    assert abs(int(np.argmax(echo.pulse.samples)) - middle) <= 1


def reading(status: str, name: str | None, missing: int = 0):
    class Read:
        lead, needed, reason, advice = 1.0, 7.0, "why", "what"

    Read.status, Read.layout, Read.missing = status, name, missing
    return Read()


def test_the_card_tells_mirror_image_and_missing_reflector() -> None:
    row = card_step._named_row
    assert row("all", 90, reading("identified", "test-card")).level is Level.PASS
    assert row("all", 90, reading("identified", "test-card-mirrored")).code == "mirrored"
    assert row("all", 90, reading("unknown", None, 1)).code == "missing-reflector"
    assert row("all", 90, reading("unknown", None)).code == "not-named"


def test_the_name_of_the_card_is_reserved(tmp_path: Path) -> None:
    registry = Registry(tmp_path / "registry.sqlite")
    assert "test-card" not in {layout.name for layout in registry.contents().layouts}
    with pytest.raises(UsageError, match="reserved"):
        registry.add(test_card(), "test")
    assert registry.add(replace(test_card(), name="mine"), "test")


def test_a_report_is_read_back() -> None:
    rows = (Row("a", Level.FAIL, 1.234, 0.05, "m", "t", "do", "c"), Row("b", Level.NOTE))
    report = StepReport(
        "room", "2026-01-01", rows, {"noise_counts": Measured(1.0, 0.1)}, {"serial": 3}, (0.0, 1.0)
    )
    assert StepReport.from_json(report.to_json()) == report
    assert report.faults == ("c",) and not report.passed
    assert rows[0].number == "1.234 +- 0.050 m"
