"""Nothing turns without a live owner: drivers that hang, die or are asked to stop, in their own processes."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tagid.motion.emulation.truth import TrueAngle
from tagid.motion.guardian import Guardian, Watch, ask_to_stop

pytestmark = pytest.mark.realtime

TAGID = [sys.executable, "-m", "tagid"]
LIMIT_S = 0.5


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    run = tmp_path / "run"
    run.mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(run))
    environment = {k: v for k, v in os.environ.items() if not k.startswith("TAGID_")}
    folder = {"TAGID_CONFIG": str(tmp_path / "config.toml"), "TAGID_DATA": str(tmp_path / "data")}
    return {**environment, **folder, "OMP_NUM_THREADS": "1"}


@contextmanager
def emulated(home: dict[str, str], *words: str) -> Iterator[tuple[dict[str, Any], subprocess.Popen[str]]]:
    process = subprocess.Popen(
        [*TAGID, "emulate", *words, "--output", "json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=home,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        yield json.loads(process.stdout.readline())["data"], process
    finally:
        process.terminate()
        process.communicate(timeout=10)


@contextmanager
def spinning(
    home: dict[str, str], there: dict[str, Any]
) -> Iterator[tuple[subprocess.Popen[str], TrueAngle]]:
    """`tagid motion spin` that turns its device, and what it truly does."""
    truth = TrueAngle(there["truth"])
    process = subprocess.Popen(
        [*TAGID, "motion", "spin", there["url"], "--turns", "20", "--yes", "--output", "json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=home,
    )  # fmt: skip
    try:
        wait_until(lambda: abs(truth.state()["angle_rad"]) > 0.1, process)
        yield process, truth
    finally:
        process.kill()
        process.communicate(timeout=10)


def wait_until(
    what: Callable[[], bool], process: subprocess.Popen[str] | None = None, timeout: float = 40.0
) -> None:
    deadline = time.monotonic() + timeout
    while not what():
        assert time.monotonic() < deadline, "waited in vain"
        assert process is None or process.poll() is None, process.communicate()
        time.sleep(0.01)


def guardian_of(process: subprocess.Popen[str]) -> int:
    (child,) = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return int(child)


def ended(process: subprocess.Popen[str]) -> dict[str, Any]:
    """The document of a spin that ended with the exit code of a device, without a traceback of anybody."""
    out, err = process.communicate(timeout=40)
    assert "Traceback" not in err and process.returncode == 4, (out, err)
    error = json.loads(out)["errors"][0]
    assert isinstance(error, dict)
    return error


def stands_after(truth: TrueAngle, since: float) -> float:
    wait_until(lambda: not truth.state()["moving"])
    return truth.state()["still_since_s"] - since


@pytest.mark.parametrize("device", ["roomba", "comxim"])
def test_a_hung_driver_is_stopped_and_does_not_drive_on(home: dict[str, str], device: str) -> None:
    """SIGSTOP is what Ctrl-Z does, and what a debugger and a busy computer look like."""
    with emulated(home, device) as (there, _), spinning(home, there) as (process, truth):
        process.send_signal(signal.SIGSTOP)
        assert stands_after(truth, time.monotonic()) < LIMIT_S
        process.send_signal(signal.SIGCONT)
        error = ended(process)
        assert "paused" in error["message"] and "angle is lost" in error["message"]
        assert not truth.state()["moving"]


@pytest.mark.parametrize("device", ["roomba", "comxim"])
def test_a_killed_driver_is_stopped(home: dict[str, str], device: str) -> None:
    with emulated(home, device) as (there, _), spinning(home, there) as (process, truth):
        process.kill()
        assert stands_after(truth, time.monotonic()) < LIMIT_S


def test_a_killed_driver_of_a_bluetooth_table_is_stopped_by_a_new_connection(home: dict[str, str]) -> None:
    pytest.importorskip("bumble", reason="needs bumble: pip install 'tagid[virtual]'")
    with emulated(home, "revopoint") as (there, _), spinning(home, there) as (process, truth):
        process.kill()
        assert stands_after(truth, time.monotonic()) < 30, "supervision timeout, a scan and a connection"


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_a_dead_guardian_stops_the_motion(home: dict[str, str], how: signal.Signals) -> None:
    with emulated(home, "roomba") as (there, _), spinning(home, there) as (process, truth):
        helper = guardian_of(process)
        os.kill(helper, how)
        try:
            assert "helper process" in ended(process)["message"]
            assert not truth.state()["moving"] and truth.state()["mode"] == 1
        finally:
            with contextlib.suppress(ProcessLookupError):  # ended by its driver
                os.kill(helper, signal.SIGKILL)


@pytest.mark.parametrize("device", ["roomba", "comxim"])
def test_motion_stop_works_while_another_process_holds_the_port(home: dict[str, str], device: str) -> None:
    with emulated(home, device) as (there, _), spinning(home, there) as (process, truth):
        stop = subprocess.run(
            [*TAGID, "motion", "stop", there["url"]], env=home, capture_output=True, text=True, timeout=60
        )
        assert stop.returncode == 0, stop.stderr
        stands_after(truth, time.monotonic())
        assert "stopped by another process" in ended(process)["message"]


def test_motion_stop_works_while_the_driver_hangs(home: dict[str, str]) -> None:
    """The guardian alone is asked; it has stopped the robot already, and does it again."""
    with emulated(home, "roomba") as (there, _), spinning(home, there) as (process, truth):
        process.send_signal(signal.SIGSTOP)
        stop = subprocess.run([*TAGID, "motion", "stop", there["url"]], env=home, timeout=60)
        assert stop.returncode == 0 and not truth.state()["moving"]


def test_a_link_that_is_lost_says_first_that_it_may_still_turn(home: dict[str, str]) -> None:
    with emulated(home, "roomba") as (there, robot), spinning(home, there) as (process, _):
        robot.kill()
        assert ended(process)["message"].startswith("It may still be turning: lift it")


def test_an_emulated_radar_that_watches_it_says_so_too(home: dict[str, str], tmp_path: Path) -> None:
    with emulated(home, "roomba") as (there, robot):
        radar = f"emulator://helmet-120?rate=1&turned_by={there['truth']}"
        words = [
            "--radar",
            radar,
            "--motion",
            there["url"],
            "--axis-distance",
            "1",
            "--save-dir",
            str(tmp_path),
        ]
        scan = subprocess.Popen(
            [*TAGID, "scan", *words, "--yes", "--output", "json"],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=home,
        )  # fmt: skip
        truth = TrueAngle(there["truth"])
        wait_until(lambda: abs(truth.state()["angle_rad"]) > 0.3, scan)
        robot.kill()
        assert ended(scan)["message"].startswith("It may still be turning: lift it")


def test_the_socket_is_its_owners_alone(home: dict[str, str], tmp_path: Path) -> None:
    assert ask_to_stop("/dev/ttyNOBODY") is False
    folder = runtime_folder()
    assert folder is not None and stat.S_IMODE(folder.stat().st_mode) == 0o700
    read, write = os.pipe()
    guard = Guardian(Watch("/dev/ttyTEST", 30.0, write, b"halt"))
    path = stop_socket("/dev/ttyTEST")
    assert path is not None and stat.S_ISSOCK(path.stat().st_mode)
    assert ask_to_stop("/dev/ttyTEST") is True
    assert os.read(read, 100) == b"halt" * 3
    guard.release()
    assert not path.exists() and ask_to_stop("/dev/ttyTEST") is False
    folder.chmod(0o755)  # whoever may enter could be in the way: then there is no socket at all
    assert stop_socket("/dev/ttyTEST") is None
    for descriptor in (read, write):
        os.close(descriptor)


def test_a_guardian_left_without_a_farewell_writes_three_halts(home: dict[str, str]) -> None:
    read, write = os.pipe()
    Guardian(Watch("one", 30.0, write, b"halt")).release(farewell=False)
    assert os.read(read, 100) == b"halt" * 3
    Guardian(Watch("two", 30.0, write, b"halt")).release()
    os.close(write)
    assert os.read(read, 100) == b""
    os.close(read)
