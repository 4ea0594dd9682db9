"""`tagid scan --until-sure` as a user runs it: with the live view, on a robot, and when something fails."""

from __future__ import annotations

import json
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tagid.motion.calibration import Calibration, remember
from tagid.motion.emulation.truth import TrueAngle
from tagid.storage.importers import read_any
from tagid.tags.sequential.looks import LOOKS
from tests.cli.on_a_terminal import run
from tests.e2e.test_scan import TAGID, environment
from tests.e2e.test_scan_roomba import robot, scan_words, wait_until

pytestmark = pytest.mark.realtime

RADAR = "emulator://helmet-120?rpm=4&rate=1&seed=2"


@pytest.fixture
def home(tmp_path: Path) -> dict[str, str]:
    """Few scans per second, which the emulated radar makes in time on a busy computer, too."""
    return environment(tmp_path) | {"TAGID_RADAR_INTEGRATION": "15"}


def shown_end(home: dict[str, str], path: str) -> dict[str, Any]:
    """What `tagid show` says of the end of a capture, after a look at its text."""
    words = [*TAGID, "show", path]
    text = subprocess.run(words, capture_output=True, text=True, env=home, check=True).stdout
    assert "was certain" in " ".join(text.split())
    words += ["--output", "json"]
    found = subprocess.run(words, capture_output=True, text=True, env=home, check=True).stdout
    return json.loads(found)["data"]["ended"]


def sure(ended: dict[str, Any]) -> bool:
    """Whether a scan of the helmet ended early, with the bound of the shipped calibration."""
    assert (ended["reason"], ended.get("layout")) == ("sure", "helmet-120"), ended
    return ended["share"] in LOOKS[1:] and ended["p_value"] <= 5e-4


def test_a_live_scan_ends_when_it_is_sure_and_says_so_on_the_screen(
    home: dict[str, str], tmp_path: Path
) -> None:
    words = ["scan", "--until-sure", "--live", "--radar", RADAR, "--motion", "free?rpm=4", "--axis-distance",
             "1", "--method", "bp", "--save-dir", str(tmp_path / "out"), "--output", "json"]  # fmt: skip
    ended = run(home, words, (40, 140))
    assert ended.code == 0, ended
    data = json.loads(ended.out)["data"]
    assert (data["items"][0]["status"], data["items"][0]["layout"]) == ("identified", "helmet-120")
    assert sure(data["ended"])
    screen = ended.sent.decode(errors="replace")
    assert "because helmet-120 was certain" in screen and "\x1b[?1049l" in screen, "the screen is given back"
    assert data["live"]["frames"] > 3
    assert shown_end(home, data["files"]["capture"]) == data["ended"]
    capture = read_any(Path(data["files"]["capture"]))
    assert capture.complete and data["ended"]["share"] < np.ptp(capture.angles_rad) / (2 * np.pi) < 1


def test_a_calibrated_robot_stands_at_once_when_it_is_sure(home: dict[str, str], tmp_path: Path) -> None:
    with robot(home, "--wheel-base", "235", "--slip", "0.01", "--seed", "3") as there:
        port = there["url"].partition("://")[2].partition("?")[0]
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("TAGID_DATA", home["TAGID_DATA"])
            remember(port, Calibration(235.0, 0.005, 2.3))
        words = [word.replace("step=3", "step=2") for word in scan_words(there, tmp_path)]
        done = subprocess.run(
            [*words, "--yes", "--until-sure"], capture_output=True, text=True, env=home, timeout=120
        )
        assert "Traceback" not in done.stderr
        document = json.loads(done.stdout)
        assert done.returncode == 0, (document["errors"], done.stderr[-300:])
        assert not any("whole" in message for message in document["messages"]), document["messages"]
        truth = TrueAngle(there["truth"])
        wait_until(lambda: not truth.state()["moving"])
        state = truth.state()
        clock_s = time.time() - time.monotonic()
    data = document["data"]
    assert sure(data["ended"])
    assert 0.6 < abs(state["angle_rad"]) / (2 * np.pi) < 1
    capture = read_any(Path(data["files"]["capture"]))
    last_scan_s = int(capture.host_time_ns[-1]) * 1e-9 - clock_s
    assert state["still_since_s"] - last_scan_s < 0.5
    assert state["mode"] == 1
    assert shown_end(home, data["files"]["capture"]) == data["ended"]
