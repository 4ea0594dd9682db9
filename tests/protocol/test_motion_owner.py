"""Nothing turns without a live owner: drivers that hang, die or are asked to stop, in their own processes."""

from __future__ import annotations

import contextlib
import json
import os
import pwd
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tagid.motion.driven import DrivenMotion
from tagid.motion.emulation.truth import TrueAngle
from tagid.motion.guardian import Guardian, Watch, _socket_name, ask_to_stop
from tagid.motion.links import SerialLink
from tagid.motion.urls import open_motion
from tests.e2e.test_scan_roomba import scan_words
from tests.processes import TAGID, emulated, wait_until

pytestmark = pytest.mark.realtime

LIMIT_S = 0.5


@pytest.fixture
def home(home: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    run = tmp_path / "run"
    run.mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(run))
    return home | {"XDG_RUNTIME_DIR": str(run)}


def motion_stop(home: dict[str, str], url: str) -> subprocess.CompletedProcess[str]:
    """`tagid motion stop URL` in a process of its own."""
    words = [*TAGID, "motion", "stop", url]
    return subprocess.run(words, env=home, capture_output=True, text=True, timeout=60)


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
    pytest.importorskip("bumble", reason="needs bumble: pip install ./firmware_tools")
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
def test_motion_stop_works_while_another_process_holds_the_port(
    home: dict[str, str], device: str, tmp_path: Path
) -> None:
    with emulated(home, device) as (there, _), spinning(home, there) as (process, truth):
        elsewhere = {k: v for k, v in home.items() if k != "XDG_RUNTIME_DIR"} | {"TMPDIR": str(tmp_path)}
        stop = motion_stop(elsewhere, there["url"])
        assert stop.returncode == 0, stop.stderr
        stands_after(truth, time.monotonic())
        assert "stopped by another process" in ended(process)["message"]


def test_motion_stop_finds_a_bluetooth_table_by_all_its_names(home: dict[str, str]) -> None:
    """Typed here is a prefix of its advertised name; nobody advertises while a program is connected."""
    pytest.importorskip("bumble", reason="needs bumble: pip install ./firmware_tools")
    with emulated(home, "revopoint") as (there, _), spinning(home, there) as (process, truth):
        stop = motion_stop(home, there["url"].replace("://", "://revo_dual"))
        assert stop.returncode == 0, stop.stderr
        stands_after(truth, time.monotonic())
        assert "stopped by another process" in ended(process)["message"]


def test_motion_stop_works_while_the_driver_hangs(home: dict[str, str]) -> None:
    """The guardian alone is asked; it has stopped the robot already, and does it again."""
    with emulated(home, "roomba") as (there, _), spinning(home, there) as (process, truth):
        process.send_signal(signal.SIGSTOP)
        stop = motion_stop(home, there["url"])
        assert stop.returncode == 0 and not truth.state()["moving"]


def test_a_link_that_is_lost_says_first_that_it_may_still_turn(home: dict[str, str], tmp_path: Path) -> None:
    """The emulated radar that watches the robot says so, too."""
    with emulated(home, "roomba") as (there, robot):
        scan = subprocess.Popen(
            [*scan_words(there, tmp_path), "--yes"],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=home,
        )  # fmt: skip
        truth = TrueAngle(there["truth"])
        wait_until(lambda: abs(truth.state()["angle_rad"]) > 0.3, scan)
        robot.kill()
        assert ended(scan)["message"].startswith("It may still be turning: lift it")


def halts_in(pipe: int) -> bytes:
    """Three halts, which the guardian writes one after the other; fewer where the pipe ends."""
    data = b""
    while len(data) < 12 and (more := os.read(pipe, 12 - len(data))):
        data += more
    return data


@pytest.fixture
def guarded() -> Iterator[tuple[str, int]]:
    """A guarded port: its name, and a pipe from which its halt bytes can be read."""
    read, write = os.pipe()
    name = f"/dev/ttyTEST{os.getpid()}"
    guard = Guardian(Watch(name, 30.0, write, b"halt".hex(), aliases=("robot-7", "C0:FF:EE:00:00:01", "")))
    yield name, read
    guard.release()
    assert ask_to_stop(name) is False
    os.close(write)
    assert os.read(read, 100) == b"", "a guardian that was told farewell writes nothing"
    os.close(read)


def asked_by(uid: int, name: str, **environment: str) -> str:
    """What `ask_to_stop` answers another process, of another user and in another environment."""
    code = """
import os, sys
from tagid.motion.guardian import ask_to_stop
if os.getuid() != int(sys.argv[1]):
    os.setuid(int(sys.argv[1]))
print(ask_to_stop(sys.argv[2]))
"""
    return subprocess.run(
        [sys.executable, "-c", code, str(uid), name],
        stdout=subprocess.PIPE, text=True, check=True, env={**os.environ, **environment},
    ).stdout.strip()  # fmt: skip


def test_the_guardian_is_found_from_every_environment(guarded: tuple[str, int], tmp_path: Path) -> None:
    name, halts = guarded
    other = {"XDG_RUNTIME_DIR": str(tmp_path), "TMPDIR": str(tmp_path), "HOME": str(tmp_path)}
    assert asked_by(os.getuid(), name, **other) == "True"
    assert halts_in(halts) == b"halt" * 3


def test_the_guardian_is_found_by_every_name(guarded: tuple[str, int]) -> None:
    for name in ("Robot-7", "c0:ff:ee:00:00:01"):
        assert ask_to_stop(name) is True
        assert halts_in(guarded[1]) == b"halt" * 3
    assert ask_to_stop("") is False


def test_a_port_has_the_same_name_from_every_folder(
    home: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for scheme in ("roomba", "comxim"):
        device = open_motion(f"{scheme}+serial://any/port", stopping=True)
        assert isinstance(device, DrivenMotion) and device.target == f"{tmp_path}/any/port"


@pytest.mark.skipif(os.getuid() != 0, reason="needs root, to be another user")
def test_another_user_neither_stops_nor_pretends(guarded: tuple[str, int]) -> None:
    name, halts = guarded
    os.set_blocking(halts, False)
    assert asked_by(65534, name) == "False"
    with pytest.raises(BlockingIOError):
        os.read(halts, 100)
    # Another user's process listens under the name of a guardian and says that it has stopped the device.
    code = """
import os, socket, sys
os.setuid(65534)
line = socket.socket(socket.AF_UNIX)
line.bind("\\0" + sys.argv[1] + "-0"); line.listen(); print(flush=True)
while True: line.accept()[0].sendall(b"stopped")
"""
    false = subprocess.Popen(
        [sys.executable, "-c", code, _socket_name("/dev/ttyFALSE")], stdout=subprocess.PIPE, text=True
    )
    assert false.stdout is not None and false.stdout.readline()
    try:
        assert ask_to_stop("/dev/ttyFALSE") is False
    finally:
        false.kill()
        false.communicate()


def test_a_held_port_without_a_guardian_is_told_with_its_holder(home: dict[str, str]) -> None:
    with emulated(home, "comxim") as (there, _):
        port = SerialLink(there["url"].partition("://")[2], 115200, b"")
        stop = motion_stop(home, there["url"])
        port.close()
    user = pwd.getpwuid(os.getuid()).pw_name
    assert stop.returncode == 4 and "It may still be turning: " in stop.stderr
    assert f"process {os.getpid()} (" in stop.stderr and f"user {user})" in stop.stderr


@pytest.mark.parametrize(
    ("systemd_run", "line"),
    [
        ("execs", 'while [ "$1" != -- ]; do shift; done; shift; exec "$@"'),
        ("hangs", "sleep 600"),
        ("fails", "echo Failed to connect to bus >&2; exit 1"),
    ],
)
def test_the_guardian_gets_a_scope_of_its_own_where_there_is_one(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    systemd_run: str,
    line: str,
) -> None:
    program = tmp_path / "bin" / "systemd-run"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/words\n{line}\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}:{os.environ['PATH']}")
    read, write = os.pipe()
    began = time.monotonic()
    guard = Guardian(Watch("one", 30.0, write, b"halt".hex()))
    assert time.monotonic() - began < 10
    words = (tmp_path / "words").read_text().split()
    assert "--scope" in words and ("--user" in words) == (os.getuid() != 0)
    guard.beat()
    guard.release(farewell=False)
    assert halts_in(read) == b"halt" * 3
    for descriptor in (read, write):
        os.close(descriptor)
    assert "bus" not in capfd.readouterr().err


STRANGERS = """
import os, resource, socket, sys
os.setuid(int(sys.argv[1]))
resource.setrlimit(resource.RLIMIT_NOFILE, (resource.getrlimit(resource.RLIMIT_NOFILE)[1],) * 2)
names = ["any\\n\\nname", *(f"{sys.argv[2]}-{number}" for number in range(1100))]
lines = [socket.socket(socket.AF_UNIX) for name in names]
for line, name in zip(lines, names):
    line.bind("\\0" + name)
    line.listen()
print(flush=True)
sys.stdin.read()
"""
"""A user's process that listens under a name of two lines, and under 1100 names like those of guardians."""


@contextmanager
def strangers(name: str) -> Iterator[None]:
    other = str(os.getuid() or 65534)
    process = subprocess.Popen(
        [sys.executable, "-c", STRANGERS, other, _socket_name(name)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None and process.stdout.readline()
        yield
    finally:
        process.communicate()


@pytest.mark.skipif(os.getuid() != 0, reason="needs root, to be another user")
def test_no_socket_of_another_user_keeps_a_guardian_from_being_asked(guarded: tuple[str, int]) -> None:
    name, halts = guarded
    files = resource.getrlimit(resource.RLIMIT_NOFILE)
    with strangers(name):
        resource.setrlimit(resource.RLIMIT_NOFILE, (256, files[1]))
        try:
            assert ask_to_stop(name) is True
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, files)
    assert halts_in(halts) == b"halt" * 3


def test_a_search_for_guardians_that_fails_leaves_the_direct_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tagid.motion.guardian._SOCKETS", None)
    assert ask_to_stop("/dev/ttyTEST") is False
