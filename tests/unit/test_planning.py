"""The link budget and one SNR against emulated scans, the rates and their tables, the plan turned round."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tagid.errors import UsageError
from tagid.imaging.lengths import views_needed
from tagid.live.engine import LiveSettings, LiveView
from tagid.metadata import RadarInfo, RadarSettings
from tagid.motion.urls import open_motion
from tagid.pipeline.settings import ImagingSettings
from tagid.planning.plan import (
    DISTANCES_M,
    GAP_DB,
    Setup,
    gap,
    invert,
    moved_distance_m,
    plan,
    planned_snr_db,
)
from tagid.planning.rates import expected
from tagid.radar.assembler import Statistics
from tagid.radar.settings import RadarConfig
from tagid.recording.inspection import inspect
from tagid.recording.monitoring import Monitor
from tagid.recording.plan import RecordingPlan, plan_window
from tagid.recording.radars import emulated_object, open_radar
from tagid.recording.recorder import Watch, record
from tagid.recording.stream import ScanStream
from tagid.signal import analytic, changing_power, noise_power_of, snr_db
from tagid.simulate import Acquisition, BodySpec, ReflectorSpec, parse_body, scene_on_body, simulate_capture
from tagid.simulate.budget import LinkBudget, effective_length_m, rcs_dbsm
from tagid.simulate.rig import measured_pulses
from tagid.simulate.scatterers import Octahedron, unit_of
from tagid.simulate.snr import noise_std_for
from tagid.simulate.spec import SceneSpec, turning_scene
from tagid.tags.layouts.layout import builtin_layouts
from tests.unit.paced import wait_for

ROOT = Path(__file__).resolve().parents[2]
LAYOUT = builtin_layouts()["container-180"]


def setup(size_m: float = 0.04, body: str = "none", distance_m: float = 1.0, index: int = 11) -> Setup:
    return Setup(
        LAYOUT, ReflectorSpec("octahedron", size_m), parse_body(body), distance_m, 2.0,
        LinkBudget(integration=index),
    )  # fmt: skip


def emulated(
    size_mm: int, distance_m: float, index: int, body: str = "", layout: str = "container-180"
) -> NDArray[np.float64]:
    """(96, bins) scans of one turn as an emulated radar sends them."""
    reflector = f"octahedron:{size_mm}mm"
    spec = SceneSpec(layout, reflector=reflector, axis_distance=distance_m, budget=True, body=body or None)
    source = turning_scene(spec)
    config = plan_window(distance_m, 0.5, 0.0, RadarConfig(base_integration_index=index))
    times = np.arange(96) / 96 * 10.0
    return np.stack([source.scan(i, float(t), config) for i, t in enumerate(times)]).astype(np.float64)


@pytest.mark.parametrize(
    ("layout", "size_mm", "body", "distance_m"),
    [
        ("container-90", 40, "can:35mm", 1.0),
        # Of faint echoes, too, whose largest sample is raised by the noise.
        ("helmet-120", 20, "", 2.0),
        ("helmet-linear", 20, "helmet", 2.5),
    ],
)
def test_show_compares_what_the_plan_predicts_of_every_layout_and_body(
    layout: str, size_mm: int, body: str, distance_m: float
) -> None:
    asked = replace(setup(size_mm * 1e-3, body or "none", distance_m), layout=builtin_layouts()[layout])
    signal = analytic(emulated(size_mm, distance_m, 11, body, layout))
    measured = snr_db(signal, noise_power_of(signal))[0]
    assert measured == pytest.approx(planned_snr_db(asked), abs=1.0)


def test_the_radar_equation() -> None:
    budget = LinkBudget()
    assert rcs_dbsm(effective_length_m(Octahedron(0.02))) == pytest.approx(-40.5, abs=1.0)
    single = budget.snr_db(0.01, 1.0)
    assert budget.snr_db(0.01, 2.0) == pytest.approx(single - 40 * np.log10(2))
    assert budget.snr_db(0.02, 1.0) == pytest.approx(single + 20 * np.log10(2))
    assert replace(budget, integration=12).snr_db(0.01, 1.0) == pytest.approx(single + 10 * np.log10(2))
    assert replace(budget, transmit_gain=53).snr_db(0.01, 1.0) == pytest.approx(single - 3)
    # What the losses were fitted on: a trihedral of 0.3 m (4 pi a^4 / 3 lambda^2) at 10 m, with 33 dB.
    wavelength = 299_792_458 / 3.95e9
    corner = np.sqrt(0.3**4 / (3 * wavelength**2))
    assert budget.snr_db(float(corner), 10.0) == pytest.approx(33, abs=0.2)
    assert all(term.source and np.isfinite(term.value) for term in budget.terms())


def test_a_body_weighs_on_the_plan() -> None:
    bare, can = plan(setup()), plan(setup(body="can:35mm"))
    assert bare.body_db is None and can.body_db is not None
    # Over 20 dB above it at 4 GHz, with the wall's help less.
    assert plan(setup(0.02, "can:35mm")).body_db > 15
    assert can.margin_db < bare.margin_db
    # The solved can of 35 mm leaves -15 / +5 dB of a 20 mm octahedron at 0.1 / 1 mm off the axis.
    assert 0.1e-3 < moved_distance_m(26.4) < 1e-3


def test_rates_are_those_of_the_tables_and_between_them() -> None:
    at_18 = [expected("none", 18, snr).named.value for snr in (0, 2.5, 5)]
    assert at_18[0] < at_18[1] < at_18[2]
    assert at_18[1] == pytest.approx((at_18[0] + at_18[2]) / 2)
    assert expected("none", 12, 0).named.value < expected("none", 15, 0).named.value < at_18[0]
    # Twice the views count as 3 dB more, also between two rows of the table.
    more_db = expected("none", 36, 3.0103).named.value
    assert expected("none", 72, 0).named.value == pytest.approx(more_db, abs=1e-3)
    assert expected("none", 72, 0).named.value > expected("none", 36, 0).named.value
    assert expected("none", 36, -20).note and not expected("none", 36, 10).note
    few, more, still_more, most = (expected("none", views, 0).named.value for views in (18, 24, 27, 36))
    assert more - few == pytest.approx(most - still_more), "by a third more views, each time"
    for low in (expected("none", 18, 0), expected("none", 36, 0)):
        assert low.named.value + low.refused.value + low.wrong.value == pytest.approx(1)
    assert low.named.low < low.named.value < low.named.high and "planning-rates" in low.source
    assert expected("can", 36, 10).source != low.source
    with pytest.raises(UsageError, match="no rates"):
        expected("teapot", 36, 10)


def test_rates_are_those_of_the_published_pages() -> None:
    """`tests/benchmarks/planning_rates.py` was run after the last change of a page."""
    for source in json.loads((ROOT / "tagid" / "planning" / "rates.json").read_text())["sources"].values():
        page, commit = source.split(", ")[0], source.split(", ")[-1].removeprefix("commit ")
        assert f"Commit: {commit}" in (ROOT / page).read_text(), page


def test_a_handle_is_no_round_body_and_small_reflectors_are_told() -> None:
    handle = plan(setup(body="can:35mm,handle"))
    assert handle.rates.named.value < 0.5 < plan(setup(body="can:35mm")).rates.named.value
    assert handle.if_enrolled.named.value > 0.5
    assert "20 mm and more" in plan(setup(0.010, "can:35mm")).rates.note
    assert not plan(setup(0.020, "can:35mm")).rates.note


def test_what_is_wanted_is_reached_by_the_least_effort() -> None:
    far = setup(0.02, distance_m=3.0, index=6)
    wanted = invert(far, 0.99)
    for result in (wanted.plan, wanted.distance, wanted.integration):
        assert result.rates.named.value >= 0.99 and result.margin_db > 0
    assert wanted.distance.setup.reflector == far.reflector
    with pytest.raises(UsageError, match="`want`"):
        invert(far, 1.0)


def test_a_rate_below_the_measured_table_is_not_offered() -> None:
    # Less is wanted than the share that the table's last row has: only its SNR speaks against an offer.
    wanted = invert(setup(0.015, distance_m=15.0), expected("none", 36, -20).named.value - 0.02)
    assert wanted.plan.setup.reflector.size_m > 0.015
    assert not wanted.plan.rates.note and wanted.integration is None


def test_a_wish_that_nothing_reaches_ends_with_what_to_do(tagid: Callable[..., object]) -> None:
    done = tagid("plan", "--body", "can:35mm,handle", "--want", 0.6)
    assert "enroll the untagged body" in done.out.replace("\n", " ")
    weak = ("--reflector", "octahedron:10mm", "--distance", 15)
    done = tagid("plan", "--body", "can:35mm,handle", *weak, "--want", 0.97)
    assert "no setup reaches this rate" in done.out.replace("\n", " ")


def test_a_gap_between_plan_and_recording_has_a_cause() -> None:
    single = setup()
    scene = scene_on_body("container-180", BodySpec(), single.reflector, 1)
    capture, _ = simulate_capture(scene, Acquisition(views=12, snr_db=30), 1)
    planned = planned_snr_db(single)
    noise = 120.0
    assert gap(capture, noise, planned + 0.9 * GAP_DB, single).cause == ""
    assert "weaker" in gap(capture, noise, planned - 20, single).cause
    assert "noise is 12 dB above" in gap(capture, 4 * noise, planned - 32, single).cause
    turned_down = replace(capture, radar=RadarInfo(config=RadarSettings(transmit_gain=40)))
    assert "gain was 40 of 63" in gap(turned_down, noise, planned - 20, single).cause
    assert "more rotates" in gap(capture, noise, planned + 20, single).cause
    assert gap(capture, noise, planned, single).planned_db == planned


def test_the_command(tagid: Callable[..., object], tmp_path: Path) -> None:
    words = ("plan", "--reflector", "octahedron:40mm", "--body", "can:35mm", "--distance", 1.0, "--pii", 11)
    data = tagid(*words, "--rpm", 2, "--output", "json").json["data"]
    assert data["snr_sample_db"] > 30 and data["recording_s"] == pytest.approx(39)
    assert len(data["budget"]) == 9 and all(term["source"] for term in data["budget"])
    refused = tagid("plan", "--layout", "nobody")
    assert refused.code == 2 and "container-90" in refused.err


def test_views_are_as_many_as_the_image_needs_and_share_the_energy_of_the_turn() -> None:
    slow = plan(setup())
    needed = views_needed(slow.setup.extent_m, 299_792_458 / 3.95e9)
    fast = plan(replace(setup(), rpm=60.0, extent_m=1.0))
    assert slow.views == pytest.approx(needed, rel=0.05) and slow.views < slow.scans_per_turn
    assert fast.views == fast.scans_per_turn
    for item in (slow, fast):
        gain_db = 10 * np.log10(item.scans_per_turn / item.views)
        assert item.snr_view_db == pytest.approx(item.snr_sample_db + gain_db)


def test_a_setup_that_clips_is_not_offered() -> None:
    near = setup(0.04, "can:35mm", distance_m=0.26, index=15)
    assert plan(near).margin_db < 0 and plan(near).rates.named.value > 0.7
    wanted = invert(near, 0.7)
    assert wanted.plan is None, "the can's echo saturates the radar whatever the reflectors"
    farther = [plan(replace(near, distance_m=distance)) for distance in DISTANCES_M]
    good = [item for item in farther if item.rates.named.value >= 0.7 and not item.rates.note]
    assert wanted.distance.setup.distance_m == max(item.setup.distance_m for item in good)


def test_an_integration_that_leaves_too_few_views_for_a_helmet_is_not_offered() -> None:
    """The alias-free step of a helmet is 9 degrees; 72 views are half of it."""
    far = replace(setup(0.02, distance_m=8.0), rpm=30.0)
    plans = [plan(replace(far, budget=replace(far.budget, integration=index))) for index in (13, 14)]
    enough, few = (plan.rates.named.value for plan in plans)
    assert plans[0].views > 72 > plans[1].views and few > enough
    assert invert(far, (enough + few) / 2).integration is None


@pytest.mark.parametrize("delay_ps", [0.0, 12_000.0])
def test_the_window_covers_the_corners_of_the_image_and_a_pulse_whatever_the_cables(delay_ps: float) -> None:
    config = plan_window(1.5, 0.5, delay_ps, RadarConfig(base_integration_index=11))
    start_m = config.range_start_m(delay_ps)
    stop_m = start_m + (config.samples - 1) * config.range_step_m
    corner_m = 0.5 / np.sqrt(2) + 0.3
    assert 0.3 < start_m <= 1.5 - corner_m and 1.5 + corner_m <= stop_m < 2.7


def test_a_pulse_that_lasts_longer_is_planned_for() -> None:
    pulse = measured_pulses()[1]
    helmet, reflector = builtin_layouts()["helmet-120"], ReflectorSpec("octahedron", 0.04)
    asked = replace(setup(), layout=helmet, pulse=pulse)
    noise_std = noise_std_for(asked.budget.snr_db(unit_of(Octahedron(0.04)), 1.0), 1.0)
    acquisition = Acquisition(views=96, pulse=pulse, noise_std=noise_std, range_law=True)
    capture, _ = simulate_capture(scene_on_body("helmet-120", parse_body("none"), reflector, 0), acquisition)
    signal = analytic(capture.samples)
    measured = snr_db(signal, noise_power_of(signal))[0]
    assert measured == pytest.approx(planned_snr_db(asked), abs=0.5)
    assert measured > planned_snr_db(replace(asked, pulse=None)) + 1


@pytest.mark.parametrize("level", ["snr=5", "budget=1&reflector=octahedron:40mm"])
def test_emulator_show_live_view_and_plan_agree_on_the_snr_of_a_helmet(tmp_path: Path, level: str) -> None:
    url = f"emulator://helmet-120?rpm=40&seed=2&{level}"
    about = emulated_object(url)
    emulated = about.truth.snr_db
    config = plan_window(1.0, 0.5, 0.0, RadarConfig(base_integration_index=11))
    streams: list[ScanStream] = []
    with LiveView(LiveSettings(open_motion("free?rpm=40"), imaging=ImagingSettings(pixels=32))) as view:

        def began(stream: ScanStream) -> None:
            streams.append(stream)
            view.began(stream)

        plan = RecordingPlan(config, 1.0, scans=240, motion="free?rpm=40")
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
    assert abs(at - 120) <= 1
