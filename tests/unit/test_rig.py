"""A rig profile is read back as written, gives defaults, and is contradicted where a recording differs."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tagid.capture import Capture
from tagid.config import load_config
from tagid.doctor import examine
from tagid.errors import ConfigError, FileFormatError
from tagid.metadata import MotionInfo, RadarInfo, RadarSettings, ResolvedMotion
from tagid.pipeline.prepared import LoadSettings, load_capture
from tagid.rig import Measured, Radar, RigProfile, installed_profile, read_profile, write_profile
from tagid.simulate.budget import LinkBudget
from tagid.simulate.rig import EmulatedRig, Fault, measured_pulses, parse_rig
from tagid.simulate.spec import SceneSpec


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TAGID_DATA", str(tmp_path))
    monkeypatch.setenv("TAGID_CONFIG", str(tmp_path / "config.toml"))
    return tmp_path


def profile() -> RigProfile:
    return RigProfile(
        "2026-03-12T10:00:00+00:00", Radar(1088, "P440", 2, 63, 11), Measured(11_841.5, 9.0),
        Measured(1.0075, 0.004), Measured(0.045, 0.005), Measured(0.0, 0.005), Measured(24.1, 0.003), 1,
        Measured(0.015, 0.001), Measured(-1.5, 1.0), Measured(120.0, 0.3), measured_pulses()[0],
    )  # fmt: skip


def capture(**radar: object) -> Capture:
    known = {"serial": 1088, "config": RadarSettings(antenna_mode=2), "cable_delay_ps": 11_841.5, **radar}
    return Capture(np.ones((4, 8), np.float32), 0.5, 0.009, radar=RadarInfo(**known))


def test_doctor_compares_the_radar_that_answers_with_the_profile(folder: Path) -> None:
    write_profile(profile(), folder)
    for seed, level in ((0, "ok"), (11, "warning")):
        url = f"emulator://empty?rig=realistic%3Fseed%3D{seed}"
        assert parse_rig(f"realistic?seed={seed}").identity.serial == 1088 + seed
        (finding,) = [f for f in examine(load_config({"radar.url": url})) if f.topic == "rig"]
        assert finding.level == level
        assert ("connected radar is 1099" in finding.text) == (level == "warning")


def test_a_profile_is_read_back_and_gives_the_defaults(folder: Path) -> None:
    assert installed_profile(folder) is None
    path = write_profile(profile(), folder)
    back = read_profile(path)
    assert back.to_toml() == profile().to_toml()
    config = load_config()
    assert config["radar.cable_delay_ps"] == 11_841.5
    assert config.values["motion.axis_distance_m"].source == "rig profile"
    (folder / "config.toml").write_text("[radar]\ncable_delay_ps = 5000\n")
    assert load_config()["radar.cable_delay_ps"] == 5000
    assert load_config({"motion.axis_distance_m": 2.0})["motion.axis_distance_m"] == 2.0


@pytest.mark.parametrize(
    "change", [("direction = 1", "direction = 3"), ("tagid.rig", "x"), ("sigma", "error")]
)
def test_a_damaged_profile_is_one_clear_error(folder: Path, change: tuple[str, str]) -> None:
    path = write_profile(profile(), folder)
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(FileFormatError, match=r"rig\.toml"):
        read_profile(path)
    with pytest.raises(ConfigError, match=r"rig\.toml"):
        load_config()
    assert load_config(tolerant=True)["radar.cable_delay_ps"] == 0.0


def test_what_contradicts_it_is_said_and_the_pulse_not_used(folder: Path) -> None:
    rig = profile()
    turned = MotionInfo(resolved=ResolvedMotion(source="data", period_s=24.15))
    assert rig.contradictions(replace(capture(), motion=turned)) == ()
    slow = MotionInfo(resolved=ResolvedMotion(source="data", period_s=30.0))
    (period,) = rig.contradictions(replace(capture(), motion=slow))
    assert "30.00 s" in period and "2026-03-12" in period
    (delay,) = rig.contradictions(capture(cable_delay_ps=12_000.0))
    assert "12000 ps" in delay
    assert LoadSettings(rig=rig).against_the_rig(capture(cable_delay_ps=12_000.0)) == (delay,)
    assert LoadSettings().against_the_rig(capture(cable_delay_ps=12_000.0)) == ()
    (axis,) = rig.contradictions(replace(capture(), axis_distance_m=1.04))
    assert "1.040 m" in axis and "1.008 m" in axis and "moved" in axis
    assert rig.contradictions(replace(capture(), axis_distance_m=1.012)) == ()
    (other,) = rig.contradictions(capture(serial=7))
    assert "another radar" in other
    (band,) = rig.contradictions(replace(capture(), center_frequency_hz=8e9))
    assert "8.00 GHz" in band
    settings = LoadSettings(rig=rig)
    assert load_capture(capture(), settings, turn=False).pulse is rig.pulse
    for foreign in (capture(serial=7), replace(capture(), center_frequency_hz=8e9)):
        assert load_capture(foreign, settings, turn=False).pulse is None


def test_the_plan_has_the_measured_gain() -> None:
    assumed, measured = LinkBudget.on(None, 63, 11), LinkBudget.on(profile(), 63, 11)
    assert measured.snr_db(0.01, 1.0) == pytest.approx(assumed.snr_db(0.01, 1.0) - 1.5)
    assert "2026-03-12" in measured.terms()[-1].source


def test_a_scene_is_recorded_as_on_the_rig(folder: Path) -> None:
    path = write_profile(profile(), folder)
    scene, acquisition = SceneSpec("test-card", rig=str(path)).build()
    assert len(scene.tag.positions) == 4
    assert acquisition.axis_distance_m == 1.0075 and acquisition.antenna_height_m == 0.045
    assert np.allclose(acquisition.pulse.samples, profile().pulse.samples, atol=1e-5)


def test_realistic_rigs_differ_by_their_seed_and_faults_change_nothing_else() -> None:
    first, same = parse_rig("realistic?seed=3"), parse_rig("realistic?seed=3")
    assert first.cable_delay_ps == same.cable_delay_ps != EmulatedRig.random(4).cable_delay_ps
    loose = parse_rig("realistic?seed=3&fault=loose-antenna")
    assert loose.gain_db == pytest.approx(first.gain_db - 10) and loose.cable_delay_ps == first.cable_delay_ps
    assert all(parse_rig(f"realistic?fault={fault}").fault is fault for fault in Fault)
    assert math.isclose(float(np.abs(measured_pulses()[0].samples).max()), 1.0)
