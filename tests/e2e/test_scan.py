"""The main job over a real UDP socket, against an emulator in a process of its own, with what goes wrong."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_server import Ran

from tagid.operate.workplace import NOT_COMMISSIONED
from tagid.storage.importers import read_any
from tests.processes import TAGID, emulated_radar, journal_bytes, wait_until

ROOT = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("TAGID_SHARED", ROOT.parent / "shared"))


def scan(tagid: Callable[..., Ran], url: str, *options: str, **environment: str) -> Ran:
    """`tagid scan` of a radar at 1 m, into the folder `out`."""
    words = ("--radar", url, "--axis-distance", 1, "--save-dir", "out", "--method", "bp", "--output", "json")
    return tagid("scan", *words, *options, **environment)


QUICK = {"TAGID_RADAR_INTEGRATION": "15"}
"""36 scans of a turn at 30 rpm, which are soon read."""


@pytest.mark.parametrize("motion", ["free?rpm=30", "free"])
def test_a_turning_helmet_is_named_and_everything_is_left_on_disk(
    tagid: Callable[..., Ran], home: dict[str, str], tmp_path: Path, motion: str
) -> None:
    with emulated_radar(home, "--scene", "helmet-120", "--rpm", "30", "--rate", "0", "--lose", "0.05",
                  "--duplicate", "0.02", "--reorder", "0.05", "--seed", "4") as (url, _):  # fmt: skip
        done = scan(tagid, url, "--motion", motion, **QUICK)
    assert done.code == 0, done
    (item,) = done.json["data"]["items"]
    assert (item["status"], item["layout"]) == ("identified", "helmet-120")
    files = done.json["data"]["files"]
    assert (tmp_path / files["png"]).read_bytes().startswith(b"\x89PNG")
    capture = read_any(tmp_path / files["capture"])
    assert capture.complete
    assert capture.angles_rad is not None
    assert np.ptp(capture.angles_rad) >= 2 * np.pi
    assert capture.radar.scans_lost > 0
    lost = int(capture.scan_id[-1] - capture.scan_id[0]) + 1 - capture.views
    assert lost <= capture.radar.scans_lost
    assert not list((tmp_path / "out").glob("*.journal"))
    assert NOT_COMMISSIONED not in done.json["messages"], "a name needs no rig that is trusted"


def test_a_rig_that_is_not_commissioned_is_said_where_nothing_is_named(
    tagid: Callable[..., Ran], home: dict[str, str]
) -> None:
    with emulated_radar(home, "--scene", "empty", "--rpm", "40", "--rate", "0", "--seed", "3") as (url, _):
        twice = scan(tagid, url, "--motion", "free?rpm=40", "--repeat", "2", **QUICK)
    assert twice.code == 3, twice
    assert twice.json["messages"].count(NOT_COMMISSIONED) == 1


def recording(
    home: dict[str, str], url: str, folder: Path, *more: str, rpm: int = 1
) -> subprocess.Popen[str]:
    """A scan, of which some scans have arrived."""
    words = ("--radar", url, "--axis-distance", "1", "--motion", f"free?rpm={rpm}", "--save-dir", str(folder))
    client = subprocess.Popen(
        [*TAGID, "scan", *words, *more, "--output", "json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=home,
    )  # fmt: skip
    wait_until(lambda: journal_bytes(folder) > 100_000, client)
    return client


def test_a_radar_that_dies_costs_nothing_that_arrived(home: dict[str, str], tmp_path: Path) -> None:
    with emulated_radar(home, "--scene", "helmet-120", "--rpm", "1") as (url, process):
        client = recording(home | {"TAGID_RADAR_TIMEOUT_S": "0.5"}, url, tmp_path / "out")
        process.kill()
        out, err = client.communicate(timeout=30)
    document = json.loads(out)
    assert (client.returncode, document["errors"][0]["code"]) == (4, "device_timeout"), err
    (path,) = (tmp_path / "out").glob("*.tagid.h5")
    assert str(path) in document["errors"][0]["remedy"]
    capture = read_any(path)
    assert capture.views > 20
    assert not capture.complete


def test_an_error_names_the_revolutions_before_it(home: dict[str, str], tmp_path: Path) -> None:
    folder = tmp_path / "out"
    with emulated_radar(home, "--scene", "helmet-120", "--rpm", "40", "--rate", "0") as (url, process):
        client = recording(home | {"TAGID_RADAR_TIMEOUT_S": "0.5"}, url, folder, "--repeat", "9", rpm=40)
        wait_until(lambda: len(list(folder.glob("*.tagid.h5"))) == 2, client)
        process.kill()
        out, err = client.communicate(timeout=60)
    (problem,) = json.loads(out)["errors"]
    assert (client.returncode, problem["code"]) == (4, "device_timeout"), err
    kept = re.search(r"`tagid identify --vote (.*)` gives their joint answer", problem["remedy"])
    assert kept, problem
    named = kept.group(1).split()
    assert len(named) >= 2 and all(read_any(Path(path)).complete for path in named)


def test_ctrl_c_stops_the_radar_and_keeps_the_scans(
    tagid: Callable[..., Ran], home: dict[str, str], tmp_path: Path
) -> None:
    with emulated_radar(home, "--scene", "helmet-120", "--rpm", "1") as (url, _):
        client = recording(home, url, tmp_path / "out")
        client.send_signal(signal.SIGINT)
        out, err = client.communicate(timeout=30)
        assert client.returncode == 130, err
        assert json.loads(out)["errors"][0]["code"] == "interrupted"
        (path,) = (tmp_path / "out").glob("*.tagid.h5")
        assert read_any(path).views > 20
        # The radar stands still: the next user connects and scans at once.
        next_one = tagid("radar", "record", "--radar", url, "--scans", 30, "--save-dir", "next")
        (path,) = (tmp_path / "next").glob("*.tagid.h5")
        assert next_one.code == 0 and read_any(path).views == 30, next_one


@pytest.mark.skipif(not SHARED.is_dir(), reason="no real recordings beside the checkout")
@pytest.mark.parametrize("name", ["corner-reflector-scan08", "light-pole-scan04"])
def test_a_replayed_recording_is_captured_sample_for_sample(
    tagid: Callable[..., Ran], home: dict[str, str], tmp_path: Path, name: str
) -> None:
    source = SHARED / "p440" / f"{name}.out"
    source = source if source.exists() else SHARED / "data" / "p440" / f"{name}.out"
    if not source.exists():
        pytest.skip(f"{source} is not there")
    with emulated_radar(home, "--replay", str(source), "--rate", "0") as (url, _):
        done = scan(tagid, url, "--scans", "200")
    capture = read_any(tmp_path / done.json["data"]["files"]["capture"])
    recorded = read_any(source)
    np.testing.assert_array_equal(capture.samples, recorded.samples)
    assert capture.range_start_m == pytest.approx(recorded.range_start_m)
    np.testing.assert_array_equal(np.diff(capture.radar_time_ms), np.diff(recorded.radar_time_ms))


def test_the_demo_says_which_scenes_there_are(tagid: Callable[..., Ran]) -> None:
    done = tagid("scan", "--demo", "--demo-scene", "nonsense", "--output", "json")
    (error,) = done.json["errors"]
    assert done.code == 2 and error["code"] == "usage"
    assert "scene 'nonsense' is unknown" in error["message"]
    assert "container-90, helmet-120" in error["remedy"] and "points-N" in error["remedy"]


def test_the_demo(tagid: Callable[..., Ran], tmp_path: Path) -> None:
    words = ("scan", "--demo", "--demo-scene", "container-90", "--method", "bp", "--output", "json")
    done = tagid(*words, TAGID_RADAR_INTEGRATION="13")
    assert done.code == 0, done
    assert done.json["data"]["items"][0]["layout"] == "container-90"
    assert "scans" in done.err
    shown = read_any(tmp_path / done.json["data"]["files"]["capture"]).object
    assert shown.demo and shown.scene == "container-90"
    assert shown.truth is not None and shown.truth.centre_m == (0.005, -0.003)
