"""`tagid scan --heights` on a terminal against an emulator over loopback, whose antenna really moves."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_server import Ran

from tagid.constants import RANGE_STEP_M
from tagid.errors import UsageError
from tagid.pipeline.join import heights_of
from tagid.pipeline.prepared import load_capture
from tagid.pipeline.volume import VolumeSettings, reconstruct_volume
from tagid.radar.settings import RadarConfig
from tagid.recording.plan import plan_window
from tagid.simulate.source import HeightFile
from tagid.simulate.spec import SceneSpec, turning_scene
from tagid.storage.importers import read_any
from tests.cli.on_a_terminal import Drawn, run
from tests.processes import emulated_radar

HEIGHTS = (0.0, 0.15, 0.3)
POSITIONS = [[0.1, 0.0], [-0.02, 0.08], [-0.05, -0.09]]
ROWS = [0.0, 0.06, -0.05]
QUESTION = b"Is it there?"


@pytest.fixture
def layout(tmp_path: Path) -> Path:
    """A layout whose reflectors are at three heights."""
    path = tmp_path / "rows.toml"
    path.write_text(f'name = "rows"\nkind = "other"\npositions_m = {POSITIONS}\nheights_m = {ROWS}\n')
    return path


def on_terminal(
    home: dict[str, str], words: list[str], answer: Callable[[int, subprocess.Popen], None]
) -> Drawn:
    """`tagid WORDS` on a pseudo-terminal; `answer` is called with the number of each question asked."""
    asked = 0

    def react(sent: bytes, child: subprocess.Popen, keyboard: int) -> None:
        nonlocal asked
        while sent.count(QUESTION) > asked:
            answer(asked, child)
            asked += 1
            if child.poll() is None:
                os.write(keyboard, b"\n")

    return run(home, words, (24, 200), react, seconds=300, TAGID_RADAR_INTEGRATION="15")


def scene(layout: Path, lift: Path) -> tuple[object, ...]:
    """Options of the emulated radar, whose antenna is at the height in the file `lift`."""
    turning = ("--rpm", 45, "--rate", 0, "--seed", 2)
    return ("--scene", "rows", "--file", layout, *turning, "--antenna-height-file", lift)


def words_of(url: str, folder: Path) -> list[str]:
    # 24 scans a turn: of 18 the turns from two heights are alike by 0.31 to 0.4 only, and 0.35 is needed.
    heights = ",".join(map(str, HEIGHTS))
    return ["scan", "--radar", url, "--axis-distance", "1", "--motion", "free?rpm=45", "--heights", heights,
            "--save-dir", str(folder), "--output", "json"]  # fmt: skip


def test_heights_are_asked_for_recorded_and_joined(
    tagid: Callable[..., Ran], home: dict[str, str], layout: Path, tmp_path: Path
) -> None:
    lift = tmp_path / "height"
    lift.write_text("5.0")
    assert tagid("enroll", "--file", layout, "--yes").code == 0

    def move(number: int, _: subprocess.Popen) -> None:
        lift.write_text(str(HEIGHTS[number]))

    with emulated_radar(home, *scene(layout, lift)) as (url, _):
        ended = on_terminal(home, words_of(url, tmp_path / "out"), move)
    assert ended.code == 0, ended
    assert ended.sent.count(QUESTION) == 3
    data = json.loads(ended.out)["data"]
    assert (data["items"][0]["status"], data["items"][0]["layout"]) == ("identified", "rows")
    for height, row in zip(HEIGHTS, data["heights"], strict=True):
        assert read_any(Path(row["file"])).antenna_height_m == height
    # The emulated table turned on between the recordings, so their angles begin elsewhere.
    assert max(abs(row["rotation_deg"]) for row in data["heights"]) > 5
    joined = read_any(Path(data["files"]["capture"]))
    results = [float(joined.aperture().positions[views, 2].mean()) for views in heights_of(joined)]
    assert results == pytest.approx(HEIGHTS)
    assert Path(data["files"]["png"]).read_bytes().startswith(b"\x89PNG")
    assert not list((tmp_path / "out").glob("*.journal"))
    # Every reflector is at its own height: an antenna that had not moved would put them into one plane.
    settings = VolumeSettings("bp", 0.3, 30, (-0.12, 0.12), 12, held_out=False)
    made = reconstruct_volume(load_capture(joined), settings).volume
    levels = []
    for place in _placed(data["items"][0]):
        column = np.linalg.norm(made.grid.square.points - place, axis=1) < 0.02
        energy = (np.abs(made.values.reshape(12, -1)[:, column]) ** 2).max(axis=1)
        levels.append(float(made.grid.heights[int(np.argmax(energy))]))
    assert levels == pytest.approx(ROWS, abs=0.025)


def _placed(item: dict) -> np.ndarray:
    turn = np.deg2rad(item["rotation_deg"])
    spin = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    return np.array(POSITIONS) @ spin + item["centre_m"]


def test_ctrl_c_between_heights_keeps_what_is_recorded(
    tagid: Callable[..., Ran], home: dict[str, str], layout: Path, tmp_path: Path
) -> None:
    lift = tmp_path / "height"
    lift.write_text("0.0")

    def stop_at_the_third(number: int, child: subprocess.Popen) -> None:
        lift.write_text(str(HEIGHTS[number]))
        if number == 2:
            child.send_signal(signal.SIGINT)
            child.wait(timeout=120)

    with emulated_radar(home, *scene(layout, lift)) as (url, _):
        ended = on_terminal(home, words_of(url, tmp_path / "out"), stop_at_the_third)
    assert ended.code == 130, ended
    (error,) = json.loads(ended.out)["errors"]
    assert error["code"] == "interrupted"
    # Names tell the second; two recordings of one second have no order.
    kept = sorted(
        (tmp_path / "out").glob("*.tagid.h5"), key=lambda path: read_any(path).antenna_height_m or 0.0
    )
    assert [read_any(path).antenna_height_m for path in kept] == list(HEIGHTS[:2])
    assert all(read_any(path).complete and str(path) in error["remedy"] for path in kept)
    assert not list((tmp_path / "out").glob("*.journal"))
    # The command that the error names works.
    done = tagid("join", "--align", *kept, "--out", "all.npz", "--output", "json")
    assert done.code == 0, done
    assert done.json["data"]["heights_m"] == pytest.approx(HEIGHTS[:2])


def test_without_a_terminal_nothing_is_recorded(tagid, tmp_path: Path) -> None:
    words = ("scan", "--radar", "udp://127.0.0.1:9", "--axis-distance", 1, "--save-dir", tmp_path / "out")
    refused = tagid(*words, "--heights", "0,0.1")
    assert refused.code == 2
    assert "no terminal" in refused.err
    for wrong in ("0", "0,0", "0,x", "0,nan", "0,50"):
        assert tagid(*words, "--yes", "--heights", wrong).code == 2
    assert tagid(*words, "--yes", "--heights", "0,0.1", "--repeat", 2).code == 2
    assert not (tmp_path / "out").exists()


def test_the_demo_moves_its_own_antenna(tagid, tmp_path: Path) -> None:
    words = ("scan", "--demo", "--save-dir", tmp_path, "--scans", 12, "--heights", "0,0.2")
    done = tagid(*words, "--output", "json")
    assert done.code in (0, 3), done.err
    files = [Path(row["file"]) for row in done.json["data"]["heights"]]
    low, high = (read_any(path) for path in files)
    assert (low.antenna_height_m, high.antenna_height_m) == (0.0, 0.2)


def test_an_emulated_antenna_follows_its_file(tmp_path: Path) -> None:
    file = tmp_path / "height"
    with pytest.raises(UsageError, match="does not contain the height"):
        HeightFile(file)
    file.write_text("0.0")
    scene = turning_scene(SceneSpec("points-3", antenna_height_file=file, rpm=0, snr=60))
    config = plan_window(1.0, 0.5, 0.0, RadarConfig())
    low = scene.scan(0, 0.0, config)
    for text in ("soon", "nan", "50", ""):
        file.write_text(text)
        np.testing.assert_array_equal(scene.scan(0, 0.0, config), low)
    file.write_text("0.3")
    # 0.3 m up at 1 m everything is 44 mm, within 5 mm, farther away.
    high = scene.scan(0, 0.0, config)
    power = [np.convolve(item.astype(float) ** 2, np.ones(8), "same") for item in (low, high)]
    shift = int(np.argmax(np.correlate(power[1], power[0], "full"))) - len(low) + 1
    assert shift * RANGE_STEP_M == pytest.approx(np.hypot(1, 0.3) - 1, abs=0.01)
