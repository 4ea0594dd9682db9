"""A scan with an emulated radar that sees what an emulated robot truly turns, in processes of their own."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tagid.motion.emulation.truth import TrueAngle
from tagid.pipeline.resolve import with_measured_angles
from tagid.storage.importers import read_any
from tests.processes import TAGID, emulated, wait_until

pytestmark = pytest.mark.realtime


def scan_words(there: dict[str, Any], folder: Path, *options: str) -> list[str]:
    radar = f"emulator://helmet-120?rate=1&turned_by={there['truth']}"
    motion = there["url"] + ("&" if "?" in there["url"] else "?") + "step=3"
    return [
        *TAGID, "scan", "--radar", radar, "--motion", motion, "--axis-distance", "1",
        "--save-dir", str(folder), "--method", "bp", "--output", "json", *options,
    ]  # fmt: skip


def test_the_helmet_on_a_robot_is_named(home: dict[str, str], tmp_path: Path) -> None:
    with emulated(home, "roomba", "--wheel-base", "250", "--slip", "0.02", "--seed", "3") as (there, _):
        done = subprocess.run(
            scan_words(there, tmp_path, "--yes"), capture_output=True, text=True, env=home, timeout=120
        )
        assert "Traceback" not in done.stderr
        document = json.loads(done.stdout)
        assert done.returncode == 0, document
        (item,) = document["data"]["items"]
        assert (item["status"], item["layout"]) == ("identified", "helmet-120")
        motion = document["data"]["motion"]
        # 250 mm and 2 % slip: a true turn is 6.4 % + 2 % more of the robot's own radians.
        assert motion["scale"] == pytest.approx(235 / 250 * 0.98, rel=5e-3)
        # A busy machine hands over late what arrived in time, which the residual says.
        assert motion["checked_by_radar"] and 0 < motion["clock_sigma_ms"] < 500
        truth = TrueAngle(there["truth"])
        wait_until(lambda: not truth.state()["moving"])
        assert truth.state()["mode"] == 1
    capture = read_any(Path(document["data"]["files"]["capture"]))
    assert capture.complete and capture.motion.track is None
    assert np.all(capture.angle_sigma_rad < np.radians(3))


def test_nothing_moves_without_a_yes(home: dict[str, str], tmp_path: Path) -> None:
    with emulated(home, "roomba") as (there, _):
        done = subprocess.run(
            scan_words(there, tmp_path), capture_output=True, text=True, env=home, timeout=60,
            stdin=subprocess.DEVNULL,
        )  # fmt: skip
        document = json.loads(done.stdout)
        assert (done.returncode, document["errors"][0]["code"]) == (2, "usage")
        assert "--yes" in document["errors"][0]["remedy"]
        state = TrueAngle(there["truth"]).state()
        assert (state["angle_rad"], state["moving"], state["mode"]) == (0.0, False, 0)


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_a_scan_that_is_ended_leaves_a_robot_that_stands(
    home: dict[str, str], tmp_path: Path, how: signal.Signals
) -> None:
    with emulated(home, "roomba") as (there, _):
        truth = TrueAngle(there["truth"])
        scan = subprocess.Popen(
            scan_words(there, tmp_path, "--yes"), stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=home
        )
        wait_until(lambda: abs(truth.state()["angle_rad"]) > 0.3)
        ended = time.monotonic()
        scan.send_signal(how)
        wait_until(lambda: not truth.state()["moving"])
        assert truth.state()["still_since_s"] - ended < 0.5
        out, err = scan.communicate(timeout=30)
        wait_until(lambda: truth.state()["mode"] == 1)
    if how is signal.SIGINT:
        assert scan.returncode == 130, err
        assert json.loads(out)["errors"][0]["code"] == "interrupted"
        (path,) = tmp_path.glob("*.tagid.h5")
        kept = read_any(path)
    else:
        (journal,) = tmp_path.glob("*.journal")
        kept = with_measured_angles(read_any(journal))
    assert kept.views > 5 and not kept.complete
    assert kept.angles_rad is not None and np.ptp(kept.angles_rad) > 0.02


def test_the_helmet_on_a_sleeping_robot_behind_the_bridge_is_named(
    home: dict[str, str], tmp_path: Path
) -> None:
    """The unmodified firmware, paired by pass-key, wakes the robot by BRC and carries its stream."""
    pytest.importorskip("bumble", reason="needs bumble: pip install ./firmware_tools")
    options = ("--passkey", "482913", "--asleep", "--wheel-base", "237", "--slip", "0")
    with emulated(home, "roomba", "--ble", *options) as (there, _):
        words = scan_words(there, tmp_path, "--yes")
        done = subprocess.run(words, capture_output=True, text=True, env=home, timeout=120)
        assert "Traceback" not in done.stderr
        document = json.loads(done.stdout)
        assert done.returncode == 0, document
        assert document["data"]["items"][0]["layout"] == "helmet-120"
        truth = TrueAngle(there["truth"])
        wait_until(lambda: not truth.state()["moving"])
        assert truth.state()["mode"] == 1
    assert "482913" not in json.dumps(read_any(Path(document["data"]["files"]["capture"])).motion.to_json())
