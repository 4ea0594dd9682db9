"""`tagid motion ...` on emulated devices: what each says, remembers and refuses."""

from __future__ import annotations

import math
import stat
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tagid.errors import TagidError
from tagid.metadata import MotionInfo, ResolvedMotion
from tagid.motion.emulation.truth import TrueAngle
from tagid.motion.urls import open_motion
from tagid.simulate import Acquisition, simulate_capture
from tagid.simulate.presets import scene_from_layout
from tagid.storage.hdf5 import write_capture
from tests.processes import emulated

SCALENE = np.array([[0.11, 0.0], [0.02, 0.06], [-0.09, -0.03]])
"""Three reflectors that are not their own mirror image."""


def test_info_asks_and_moves_nothing(tagid, home: dict[str, str]) -> None:
    with emulated(home, "roomba", "--charge", "50") as (there, _):
        ran = tagid("motion", "info", there["url"], "--output", "json")
        data = ran.json["data"]
        assert ran.code == 0 and data["mode"] == "passive" and data["charge"] == pytest.approx(0.5, abs=0.01)
        assert not data["calibrated"] and data["seconds_a_turn"] == [25.9, 12.95, 8.63]
        assert TrueAngle(there["truth"]).state()["angle_rad"] == 0
    with emulated(home, "comxim") as (there, _):
        ran = tagid("motion", "info", there["url"], "--output", "json")
        assert ran.code == 0 and ran.json["data"]["angle_deg"] == 0
        assert "disconnect its power supply" in tagid("motion", "spin", there["url"]).err


@pytest.mark.realtime
@pytest.mark.parametrize("direction", ["ccw", "cw"])
def test_spin_turns_so_far_that_way_and_says_how_surely(tagid, home: dict[str, str], direction: str) -> None:
    with emulated(home, "roomba", "--slip", "0.05", "--wheel-base", "235") as (there, _):
        url = f"{there['url']}?step=3&direction={direction}"
        ran = tagid("motion", "spin", url, "--turns", "0.3", "--yes", "--output", "json")
        data = ran.json["data"]
        assert ran.code == 0 and abs(data["turned_deg"]) >= 108
        true = math.degrees(TrueAngle(there["truth"]).state()["angle_rad"])
        assert np.sign(true) == np.sign(data["turned_deg"]) == (1 if direction == "ccw" else -1)
        assert abs(true) < 200 and data["sigma_deg"] > 0.02 * abs(data["turned_deg"])
        assert TrueAngle(there["truth"]).state()["mode"] == 1


def test_spin_asks_first_and_says_what_nothing_stops(tagid, home: dict[str, str]) -> None:
    with emulated(home, "roomba") as (there, _):
        ran = tagid("motion", "spin", there["url"], "--output", "json")
        assert ran.code == 2 and ran.json["errors"][0]["code"] == "usage"
        assert "--yes" in ran.json["errors"][0]["remedy"]
        assert "If its cable is disconnected nothing stops it: then lift it" in ran.err
        assert TrueAngle(there["truth"]).state()["angle_rad"] == 0


@pytest.mark.parametrize(
    ("changed", "stored", "remark"),
    [
        ({"TAGID_CONFIG": "/dev/null/x"}, "", ""),
        ({}, "not TOML", ""),
        ({"TAGID_RADAR_TIMEOUT_S": "abc"}, '[motion]\nurl = "{url}"\nspeed = 3', "unknown setting"),
    ],
)
def test_no_file_or_setting_prevents_a_stop(
    tagid, home: dict[str, str], changed: dict[str, str], stored: str, remark: str
) -> None:
    """Even without a URL, if the stored one can be read; then the others are a remark."""
    data = Path(home["TAGID_DATA"])
    data.mkdir()
    for name in ("robots.toml", "directions.toml"):
        (data / name).write_text("damaged")
    with emulated(home, "roomba") as (there, _):
        Path(home["TAGID_CONFIG"]).write_text(stored.format(**there))
        ran = tagid("motion", "stop", *([] if remark else [there["url"]]), **changed)
        assert ran.code == 0 and "has stopped" in ran.out and remark in ran.err, ran


def test_no_configuration_prevents_the_emergency_command(
    home: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TAGID_CONFIG", home["TAGID_CONFIG"])
    monkeypatch.setenv("TAGID_DATA", home["TAGID_DATA"])
    monkeypatch.setenv("TAGID_MOTION_PASSKEY", "abc")
    Path(home["TAGID_DATA"]).mkdir()
    (Path(home["TAGID_DATA"]) / "directions.toml").write_text("damaged")
    Path(home["TAGID_CONFIG"]).write_text("not TOML")
    for url in ("revopoint+ble", "roomba+ble://robot-7", "index+ble://robot-7", "comxim+serial:///dev/tty"):
        with pytest.raises(TagidError):
            open_motion(url)
        open_motion(url, stopping=True)


@pytest.mark.parametrize("command", ["info", "spin", "stop"])
def test_devices_that_are_not_there_or_take_no_commands(tagid, command: str) -> None:
    yes = ["--yes"] if command == "spin" else []
    absent = tagid("motion", command, "roomba+serial:///dev/ttyNOWHERE", *yes, "--output", "json")
    assert absent.code == 4 and "no serial port" in absent.json["errors"][0]["message"]
    free = tagid("motion", command, "free?rpm=2", *yes, "--output", "json")
    assert free.code == 2 and "not a commanded device" in free.json["errors"][0]["message"]


def test_find_without_bluetooth_and_bad_numbers(tagid) -> None:
    ran = tagid("motion", "find", "--no-ble", "--output", "json")
    assert ran.code in (0, 4) and isinstance(ran.json["data"]["devices"], list)
    for words in (("find", "--seconds", "0"), ("spin", "--turns", "0"), ("calibrate", "--turns", "1")):
        assert tagid("motion", *words).code == 2
    for words in (("--direction",), ("--layout", "helmet-120")):
        assert "must be given together" in tagid("motion", "calibrate", *words).err


def test_the_passkey_is_kept_private(tagid, home: dict[str, str]) -> None:
    config = Path(home["TAGID_CONFIG"])
    assert tagid("config", "set", "motion.passkey", "482913").code == 0
    assert stat.S_IMODE(config.stat().st_mode) == 0o600
    config.chmod(0o644)
    ran = tagid("motion", "info", "roomba+ble://robot-7?hci=tcp-client:127.0.0.1:1", "--output", "json")
    assert ran.code == 2 and f"chmod 600 {config}" in ran.json["errors"][0]["remedy"]
    # Writing any setting makes it private again.
    assert tagid("config", "set", "radar.gain", "60").code == 0
    assert stat.S_IMODE(config.stat().st_mode) == 0o600


def a_turn(folder: Path, true_way: int, was_reversed: bool) -> Path:
    """A capture on a table that was told to turn counter-clockwise."""
    capture, _ = simulate_capture(scene_from_layout(SCALENE, seed=1), Acquisition(snr_db=20, views=24), 1)
    assert capture.angles_rad is not None
    resolved = ResolvedMotion(kind="comxim", table="/dev/table", direction=1, reversed=was_reversed)
    reported = replace(
        capture, angles_rad=true_way * capture.angles_rad, motion=MotionInfo(resolved=resolved)
    )
    path = folder / "turn.tagid.h5"
    write_capture(path, reported)
    return path


@pytest.mark.parametrize(("true_way", "was_reversed"), [(1, True), (-1, True), (-1, False)])
def test_the_direction_is_found_with_an_object_that_is_not_its_own_mirror_image(
    tagid,
    home: dict[str, str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    true_way: int,
    was_reversed: bool,
) -> None:
    """The table was told to turn counter-clockwise; where it did not, the next scan has `reversed` set."""
    layout = tmp_path / "scalene.toml"
    rows = ", ".join(f"[{x}, {y}]" for x, y in SCALENE)
    layout.write_text(f'name = "scalene"\nkind = "helmet"\nlabel = "S"\nnotes = ""\npositions_m = [{rows}]\n')
    assert tagid("layouts", "import", layout).code == 0
    words = ("motion", "calibrate", a_turn(tmp_path, true_way, was_reversed), "--direction", "--layout")
    ran = tagid(*words, "scalene", "--output", "json")
    assert ran.code == 0, ran.json
    data = ran.json["data"]
    assert data["other_way"] == (true_way < 0) and data["reversed"] == ((true_way < 0) != was_reversed)
    for name in ("TAGID_DATA", "TAGID_CONFIG"):
        monkeypatch.setenv(name, home[name])
    assert open_motion("comxim+serial:///dev/table").reversed == data["reversed"]


def test_the_direction_is_not_found_with_a_symmetric_or_unknown_layout(tagid, tmp_path: Path) -> None:
    words = ("motion", "calibrate", a_turn(tmp_path, 1, False), "--direction", "--layout")
    symmetric = tagid(*words, "helmet-120", "--output", "json")
    assert symmetric.code == 2 and "mirror image" in symmetric.json["errors"][0]["message"]
    assert tagid(*words, "nobody").code == 2
