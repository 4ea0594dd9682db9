"""`tagid scan --until-sure` as a user runs it: with the live view, on a robot, and when something fails."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_server import Ran

from tagid.motion.calibration import Calibration, remember
from tagid.motion.emulation.truth import TrueAngle
from tagid.reading.looks import LOOKS
from tagid.storage.importers import read_any
from tests.cli.on_a_terminal import run
from tests.e2e.test_scan_roomba import scan_words
from tests.processes import TAGID, emulated, wait_until

pytestmark = pytest.mark.realtime

RADAR = "emulator://helmet-120?rpm=0.5&rate=1&seed=2"
"""A slow table: looks have time on any computer."""


@pytest.fixture
def home(home: dict[str, str]) -> dict[str, str]:
    """Few scans per second, which the emulated radar makes in time on a busy computer, too."""
    return home | {"TAGID_RADAR_INTEGRATION": "15"}


def live_words(radar: str, folder: Path) -> list[str]:
    return ["scan", "--until-sure", "--live", "--radar", radar, "--motion", "free?rpm=0.5", "--axis-distance",
            "1", "--method", "bp", "--save-dir", str(folder), "--output", "json"]  # fmt: skip


def shown_end(tagid: Callable[..., Ran], path: str) -> dict[str, Any]:
    """What `tagid show` says of the end of a capture, after a look at its text."""
    assert "was certain" in " ".join(tagid("show", path).out.split())
    return tagid("show", path, "--output", "json").json["data"]["ended"]


def sure(ended: dict[str, Any]) -> bool:
    """Whether a scan of the helmet ended early, with the bound of the shipped calibration."""
    assert (ended["reason"], ended.get("layout")) == ("sure", "helmet-120"), ended
    return ended["share"] in LOOKS[1:] and ended["p_value"] <= 5e-4


def test_a_live_scan_ends_when_it_is_sure_and_says_so_on_the_screen(
    tagid: Callable[..., Ran], home: dict[str, str], tmp_path: Path
) -> None:
    ended = run(home, live_words(RADAR, tmp_path / "out"), (40, 140))
    assert ended.code == 0, ended
    data = json.loads(ended.out)["data"]
    assert (data["items"][0]["status"], data["items"][0]["layout"]) == ("identified", "helmet-120")
    assert sure(data["ended"])
    bound, ended_by = data["items"][0]["bound"], data["ended"]
    assert (bound["p_value"], bound["calibration_objects"]) == (ended_by["p_value"], ended_by["turns"])
    screen = ended.sent.decode(errors="replace")
    assert "because helmet-120 was certain" in screen and "\x1b[?1049l" in screen, "the screen is given back"
    assert data["live"]["frames"] > 3
    assert shown_end(tagid, data["files"]["capture"]) == data["ended"]
    capture = read_any(Path(data["files"]["capture"]))
    assert capture.complete and data["ended"]["share"] < np.ptp(capture.angles_rad) / (2 * np.pi) < 1


def test_a_calibrated_robot_stands_at_once_when_it_is_sure(
    tagid: Callable[..., Ran], home: dict[str, str], tmp_path: Path
) -> None:
    # Wheels far apart turn slowly, and more turns than one are asked for: looks have time on any computer.
    with emulated(home, "roomba", "--wheel-base", "470", "--slip", "0.01", "--seed", "3") as (there, _):
        port = there["url"].partition("://")[2].partition("?")[0]
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("TAGID_DATA", home["TAGID_DATA"])
            remember(port, Calibration(470.0, 0.005, 2.3))
        words = [word.replace("step=3", "step=1&turns=4") for word in scan_words(there, tmp_path)]
        done = subprocess.run(
            [*words, "--yes", "--until-sure"], capture_output=True, text=True, env=home, timeout=240
        )
        assert "Traceback" not in done.stderr
        document = json.loads(done.stdout)
        assert done.returncode == 0, (document["errors"], document["data"], done.stderr[-300:])
        assert not any("whole" in message for message in document["messages"]), document["messages"]
        truth = TrueAngle(there["truth"])
        wait_until(lambda: not truth.state()["moving"])
        state = truth.state()
        clock_s = time.time() - time.monotonic()
    data = document["data"]
    assert sure(data["ended"])
    assert 0.6 < abs(state["angle_rad"]) / (2 * np.pi) < 3.9
    capture = read_any(Path(data["files"]["capture"]))
    last_scan_s = int(capture.host_time_ns[-1]) * 1e-9 - clock_s
    assert state["still_since_s"] - last_scan_s < 0.5
    assert state["mode"] == 1
    assert shown_end(tagid, data["files"]["capture"]) == data["ended"]


def test_a_robot_that_is_stopped_half_way_ends_the_scan_with_its_reason(
    home: dict[str, str], tmp_path: Path
) -> None:
    with emulated(home, "roomba", "--wheel-base", "235", "--slip", "0", "--event", "cliff@5") as (there, _):
        words = [word.replace("step=3", "step=2") for word in scan_words(there, tmp_path)]
        words = words[len(TAGID) :]
        ended = run(home, [*words, "--yes", "--until-sure", "--live"], (40, 140))
        truth = TrueAngle(there["truth"])
        wait_until(lambda: not truth.state()["moving"])
        assert 0.2 < abs(truth.state()["angle_rad"]) / (2 * np.pi) < 0.6
    (error,) = json.loads(ended.out)["errors"]
    assert ended.code == 4 and error["code"] == "motion_stopped", error
    assert "\x1b[?1049l" in ended.sent.decode(errors="replace"), "the screen is given back"
    (path,) = tmp_path.glob("*.tagid.h5")
    assert str(path) in error["remedy"] and not list(tmp_path.glob("*.journal"))
    kept = read_any(path)
    assert not kept.complete and kept.radar.ended is None
    assert np.ptp(kept.angles_rad) > 1, "the angles so far are kept"
