"""The steps on an emulated rig: each value is within its own standard errors, and each fault is named."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest

from tagid.capture import Capture
from tagid.commissioning import card as card_step
from tagid.commissioning.bench import Bench, reported
from tagid.commissioning.page import write_page
from tagid.commissioning.pictures import Picture, to_svg
from tagid.commissioning.pulse import echo_pulse
from tagid.commissioning.rows import Level, Row, StepReport
from tagid.commissioning.steps import STEPS, goes_on, next_step, run_step, step_named, verdict, write_result
from tagid.commissioning.targets import parse_target
from tagid.commissioning.turning import evaluated
from tagid.config import load_config
from tagid.constants import RANGE_STEP_M, SAMPLE_STEP_S, SPEED_OF_LIGHT
from tagid.enrolling.registry import Registry
from tagid.errors import ConfigError, UsageError
from tagid.metadata import MotionInfo
from tagid.motion.urls import open_motion
from tagid.reading.reading import Explanation, Reflector
from tagid.rig import Measured
from tagid.simulate.acquisition import Placement
from tagid.simulate.capture import simulate_capture
from tagid.simulate.rig import EmulatedRig, RigScene, parse_rig
from tagid.simulate.spec import SceneSpec
from tagid.tags.layouts.layout import rotation_matrix
from tagid.tags.layouts.test_card import test_card
from tagid.waveform import nominal_pulse, pulse_at
from tests.measured_rig import measured_rig
from tests.target_delay import delay_ps


def bench(scene: str, rig: str = "realistic?seed=3", **tape: object) -> Bench:
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


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which link, room and target of the rig of `bench` are measured."""
    folder = tmp_path_factory.mktemp("rig")
    with measured_rig(folder, bench) as (_, report):
        assert bench("empty").report("target").to_json() == report.to_json()
    return folder


@pytest.fixture
def at(measured: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    """The bench of that rig, with the card on its table."""
    monkeypatch.setenv("TAGID_DATA", str(measured))
    return bench("test-card")


def test_link_room_and_target_measure_the_rig(at: Bench, tmp_path: Path) -> None:
    true, report = parse_rig("realistic?seed=3"), at.report("target")
    assert next_step(at).name == "turning"
    delay, gain = report.values["path_delay_ps"], report.values["system_gain_db"]
    assert abs(delay.value - true.cable_delay_ps) < min(15.0, 2 * delay.sigma)
    assert abs(gain.value - true.gain_db) < 2 * gain.sigma
    page = tmp_path / "rig.html"
    write_page(page, [("Reference target", report)], None)
    text = page.read_text()
    assert 'class="pass"' in text and "data:image/svg" in text and "not commissioned yet" in text
    write_page(page.with_suffix(".pdf"), [("Reference target <1>", report)], None)
    content = page.with_suffix(".pdf").read_bytes()
    assert content.startswith(b"%PDF") and b"/Subtype /Image" not in content, "vectors alone"
    assert b"path delay" in content and b"not commissioned yet" in content


def test_steps_that_need_nobody_follow_the_one_before() -> None:
    rig, following = bench("empty"), {}
    for step in STEPS:
        rig.keep(reported(step.name, [Row("a row", Level.PASS)]))
        following[step.name] = getattr(goes_on(step, rig), "name", None)
    # Something is put on the table before room, target and turning.
    assert following == dict.fromkeys(("link", "room", "target", "result")) | {
        "turning": "card",
        "card": "result",
    }
    # A step that is repeated alone leaves the others as they are, but for the profile.
    assert goes_on(step_named("turning"), rig) is None
    assert goes_on(step_named("card"), rig) == step_named("result")
    rig.keep(reported("card", [Row("a row", Level.FAIL)]))
    assert goes_on(step_named("card"), rig) is None


def test_another_cable_is_taken_when_it_is_measured_again() -> None:
    """Otherwise a rig with new cables could never be commissioned again."""
    rig = "realistic?seed=3&fault=cable"
    run_step(step_named("room"), bench("empty", rig))
    first, again = (run_step(step_named("target"), bench("target", rig)) for _ in range(2))
    assert first.faults == ("cable",) and again.passed
    assert row_of(again, "path delay").text.endswith("measured twice")


def test_a_step_is_repeated_when_what_it_takes_is_newer_or_of_another_radar() -> None:
    rig = bench("empty")

    def done(name: str, minute: int, serial: int = 1099) -> None:
        report = reported(name, [Row("a row", Level.PASS)], facts={"serial": serial})
        rig.keep(replace(report, date_utc=f"2026-03-12T10:{minute:02}:00+00:00"))

    for minute, step in enumerate(STEPS):
        done(step.name, minute)
    assert next_step(rig).name == "result"
    assert verdict(rig.reports(), "result").level is Level.PASS
    done("target", 10)
    assert next_step(rig).name == "turning"
    assert verdict(rig.reports(), "turning").text == "older than target"
    assert [row.name for row in write_result(rig).rows if row.level is Level.FAIL] == ["turning", "card"]
    done("link", 11, serial=1111)
    assert next_step(rig).name == "room"
    assert verdict(rig.reports(), "room").text == "of radar 1099, the link is to 1111"


@pytest.mark.parametrize("tape", [{"antenna_height_m": math.nan}, {"antenna_separation_m": -1.0}])
def test_what_no_tape_shows_is_refused_and_not_remembered(tape: dict[str, float]) -> None:
    with pytest.raises(UsageError, match="antenna"):
        bench("empty", **tape)
    assert bench("empty").tape.antenna_separation_m == 0.0


def test_a_rig_shows_a_tag_on_a_body() -> None:
    alone, held = (
        SceneSpec("container-90", rig="realistic?seed=3", body=body).build(views=12)
        for body in (None, "can:35mm")
    )
    assert held[1].pulse is alone[1].pulse and held[1].noise_std == alone[1].noise_std
    echoes = [float((simulate_capture(*shown, 1)[0].samples ** 2).sum()) for shown in (alone, held)]
    assert echoes[1] > 2 * echoes[0], "the can is louder than its tag"


@pytest.mark.parametrize(
    ("fault", "step", "scene"),
    [("gain", "room", "empty"), ("microwave", "room", "empty"), ("other-radar", "room", "empty"),
     ("person", "room", "empty"), ("polarisation", "target", "target")],
)  # fmt: skip
def test_a_fault_is_named(fault: str, step: str, scene: str) -> None:
    rig = f"realistic?seed=3&fault={fault}"
    report = run_step(step_named("room"), bench("empty", rig))
    if step == "target":
        assert report.passed
        report = run_step(step_named(step), bench(scene, rig))
    assert fault in report.faults, report.rows
    assert all(row.advice for row in report.rows if row.level is Level.FAIL)


def test_a_target_needs_its_distance_and_the_empty_room() -> None:
    with pytest.raises(UsageError, match="distance is missing"):
        run_step(step_named("target"), bench("target", target_distance_m=None))
    with pytest.raises(ConfigError, match="empty room"):
        run_step(step_named("target"), bench("target"))
    with pytest.raises(ConfigError, match="not done yet: link"):
        run_step(step_named("result"), bench("empty"))


@pytest.mark.parametrize("text", ["octahedron:40mm", "sphere:10cm"])
def test_the_delay_of_a_target_is_taken_out_of_the_pulse(text: str) -> None:
    target = parse_target(text)
    t = (np.arange(600) - 250.3) * SAMPLE_STEP_S
    length = 4096
    frequency = np.fft.rfftfreq(length, SAMPLE_STEP_S)
    response = target.scattering_length(np.maximum(frequency, 1e9))
    response /= target.scattering_length(np.array([4e9]))
    # The solved scattering lengths have the phase of exp(-j omega t).
    spectrum = np.fft.rfft(pulse_at(nominal_pulse(), t).real, length) * np.conj(response)
    samples = np.fft.irfft(spectrum, length)[:600] * 5000
    echo = echo_pulse(samples, 250.3 + delay_ps(target) * 1e-12 / SAMPLE_STEP_S, target)
    assert echo.delay_ps == pytest.approx(delay_ps(target), abs=2)
    middle = len(echo.pulse.samples) // 2
    assert abs(int(np.argmax(echo.pulse.samples)) - middle) <= 1


def turned(at: Bench, rig: EmulatedRig, views: int = 100) -> Capture:
    """2.3 turns of the card as the emulated radar records them, without its link."""
    delay = at.value("target", "path_delay_ps")
    config = at.workplace().plan().config
    scene = RigScene(rig.scene("test-card", {"test-card": test_card()}), rig, Placement(), seed=1)
    times_s = np.arange(views) * 2.3 * rig.period_s / views
    start_m = (config.scan_start_ps - delay.value) * 1e-12 * SPEED_OF_LIGHT / 2
    samples = np.stack([scene.scan(i, float(t), config) for i, t in enumerate(times_s)])
    stamps = {"radar_time_ms": times_s * 1e3, "scan_id": np.arange(views)}
    motion = MotionInfo(nominal_rpm=round(60 / rig.period_s, 1))
    return Capture(samples, start_m, RANGE_STEP_M, axis_distance_m=1.0, motion=motion, **stamps)


def row_of(report: StepReport, name: str) -> Row:
    (row,) = (row for row in report.rows if row.name == name)
    return row


@pytest.mark.parametrize(
    ("fault", "code"), [("slip", "slip"), ("mirrored-card", "mirrored"), ("axis", "axis")]
)
def test_the_card_gives_axis_and_period_and_names_faults(at: Bench, fault: str, code: str) -> None:
    true = parse_rig(f"realistic?seed=3&fault={fault}")
    motion = open_motion(f"free?rpm={60 / true.period_s:.2g}")
    report = evaluated(at, motion, turned(at, true), motion.nominal_s, "")
    assert report.faults == (code,)
    if fault == "slip":
        assert not report.values
    else:
        check_values(report, true)


def check_values(report: StepReport, true: EmulatedRig) -> None:
    for name in ("axis_distance_m", "period_s", "speed_variation", "antenna_height_m"):
        value, truth = report.values[name], getattr(true, name)
        assert abs(value.value - truth) < max(3 * value.sigma, 1e-6), name
    assert report.values["axis_distance_m"].sigma < 2e-3
    assert report.values["period_s"].sigma < 1e-4 * true.period_s
    assert row_of(report, "start and stop").level is Level.PASS


def test_scans_before_the_table_turns_are_told_of(at: Bench) -> None:
    rig = parse_rig("realistic?seed=3")
    motion = open_motion(f"free?rpm={60 / rig.period_s:.2g}")
    capture = turned(at, rig, views=300)
    first, noise = 60, at.value("room", "noise_counts")
    still = capture.samples[:1] + np.random.default_rng(1).normal(0, noise.value, (first, capture.bins))
    samples = np.vstack([np.rint(still).astype(capture.samples.dtype), capture.samples])[: capture.views]
    report = evaluated(at, motion, replace(capture, samples=samples), motion.nominal_s, "")
    row = row_of(report, "start and stop")
    stood_s = float(capture.radar_time_ms[first] - capture.radar_time_ms[0]) * 1e-3
    assert row.level is Level.NOTE and abs(row.value - stood_s) < 2 * row.sigma


@pytest.mark.parametrize(("left", "code"), [(0.004, ""), (0.03, "residual")])
def test_what_the_card_leaves_is_compared_with_model_error_and_wobble(left: float, code: str) -> None:
    read = reading("identified", "test-card")
    read.hypotheses = [Explanation("tag", "card", "test-card", "", 0.0, left, (0.0, 0.0))]
    capture = Capture(np.zeros((1, 1), np.int32), 0.0, RANGE_STEP_M)
    row = card_step._residual_row(read, Measured(0.015, 1e-4), capture)
    assert row.code == code
    # 5 % of the amplitude, and 0.015 x 0.5 x 168 / m times the mean radius of the marks.
    radius_m = math.sqrt((test_card().positions ** 2).sum(axis=1).mean())
    expected = 0.05**2 + (0.0075 * 165.5 * radius_m) ** 2
    assert row.value == pytest.approx(10 * math.log10(left / expected), abs=0.1)


@pytest.mark.parametrize(("reported", "code"), [(1.0, ""), (1.05, "angle")])
def test_the_angle_that_a_device_reports_is_compared_with_the_scans(
    at: Bench, reported: float, code: str
) -> None:
    rig = parse_rig("realistic?seed=3")
    capture = turned(at, rig)
    angles = reported * 2 * np.pi * capture.radar_time_ms * 1e-3 / rig.period_s
    motion = open_motion("comxim+serial:///dev/ttyUSB9")
    report = evaluated(at, motion, replace(capture, angles_rad=angles), rig.period_s, "")
    assert report.faults == ((code,) if code else ())
    check_values(report, rig)
    row = row_of(report, "reported angle against scans")
    assert abs(row.value - 100 * (reported - 1)) < max(3 * row.sigma, 0.05)


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


@pytest.mark.parametrize(("off_m", "level"), [(0.0008, Level.PASS), (0.003, Level.FAIL)])
def test_reflectors_off_their_marks_fail_the_card(off_m: float, level: Level) -> None:
    read = reading("identified", "test-card")
    read.rotation_deg, read.centre_m = 30.0, (0.004, -0.002)
    there = test_card().positions @ rotation_matrix(math.radians(30.0)).T + read.centre_m
    # Opposite ones apart: no turn and no shift makes that good.
    there += off_m * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    read.reflectors = [Reflector(x, y, 1.0, 0.0, 20.0, matched=True) for x, y in there]
    row = card_step._places_row(*card_step._places(read))
    assert (row.level, row.code) == (level, "" if level is Level.PASS else "positions")


def test_the_name_of_the_card_is_reserved(tmp_path: Path) -> None:
    registry = Registry(tmp_path / "registry.sqlite")
    assert "test-card" not in {layout.name for layout in registry.contents().layouts}
    with pytest.raises(UsageError, match="reserved"):
        registry.add(test_card(), "test")
    assert registry.add(replace(test_card(), name="mine"), "test")


def test_a_report_is_read_back() -> None:
    rows = (Row("a", Level.FAIL, 1.234, 0.05, "m", "t", "do", "c"), Row("b", Level.NOTE))
    values, curve = {"noise_counts": Measured(1.0, 0.1)}, (np.arange(900.0), np.arange(900.0) ** 2)
    picture = Picture.of("s: what", curve)
    report = StepReport("room", "2026-01-01", rows, values, {"serial": 3}, (0.0, 1.0), pictures=(picture,))
    assert len(picture.curves[0][0]) == 300 and "polyline" in to_svg(picture)
    assert StepReport.from_json(report.to_json()) == report
    assert report.faults == ("c",) and not report.passed
    assert rows[0].number == "1.234 +- 0.050 m"
