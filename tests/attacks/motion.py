"""Attacks on what turns, and on the child processes of everything: real processes, emulated devices."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tagid.motion.emulation.truth import TrueAngle
from tests.attacks import Outcome, attack

TAGID = str(Path(sys.executable).parent / "tagid")
MODULES = ("selectors", "pickle", "socket", "tempfile", "numpy", "h5py")


def children_of(pid: int) -> list[int]:
    """Children of a process."""
    return [
        int(child)
        for task in Path(f"/proc/{pid}/task").iterdir()
        for child in (task / "children").read_text().split()
    ]


@contextlib.contextmanager
def emulated(*words: str) -> Iterator[tuple[str, TrueAngle]]:
    """An emulated device: its URL and what it truly does."""
    process = subprocess.Popen(
        [TAGID, "emulate", *words, "--output", "json"], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        data = json.loads(process.stdout.readline())["data"]
        yield data["url"], TrueAngle(data["truth"])
    finally:
        process.terminate()
        process.communicate()


@contextlib.contextmanager
def spinning(url: str, truth: TrueAngle, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """`tagid motion spin` that turns its device for long."""
    process = subprocess.Popen(
        [TAGID, "motion", "spin", url, "--turns", "20", "--yes", "-q"],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, **options,
    )  # fmt: skip
    try:
        wait_for(lambda: bool(truth.state()["moving"]), 60)
        time.sleep(1)
        yield process
    finally:
        process.kill()
        process.communicate()


def wait_for(what: Any, seconds: float) -> bool:
    """Whether something becomes true in time."""
    until = time.monotonic() + seconds
    while not what():
        if time.monotonic() > until:
            return False
        time.sleep(0.02)
    return True


def hostile_folder(folder: Path) -> Path:
    """A folder with modules that children would import, each of which leaves a file and fails."""
    place = folder / "shared"
    (place / "tagid").mkdir(parents=True)
    for name in (*MODULES, "tagid/__init__"):
        mark = folder / f"owned-{name.partition('/')[0]}"
        (place / f"{name}.py").write_text(f"open({str(mark)!r}, 'w').close()\nraise SystemExit(9)\n")
    return place


@attack(
    "F3",
    "code of the current folder runs in child processes",
    before="exit codes {'report': 5, 'scan': 4}, ran: pickle, tagid",
    test="tests/unit/test_processes.py::test_no_child_runs_code_of_the_current_folder",
)
def current_folder(folder: Path) -> Outcome:
    place = hostile_folder(folder)
    subprocess.run(
        [TAGID, "simulate", "helmet-120", "--views", "72", "--out", place / "h1.tagid.h5", "-q"],
        check=True, stdout=subprocess.DEVNULL, cwd=folder,
    )  # fmt: skip
    codes = {}
    for words in (["report", ".", "--out", "../rep", "-j", "1", "--method", "bp"], ["scan", "--demo"]):
        done = subprocess.run([TAGID, *words, "-q"], cwd=place, capture_output=True, text=True)
        codes[words[0]] = done.returncode
    ran = sorted(path.name.removeprefix("owned-") for path in folder.glob("owned-*"))
    return Outcome(
        f"exit codes {codes}, ran: {', '.join(ran) or 'nothing'}", not ran and not any(codes.values())
    )


@attack(
    "F3b",
    "the Revopoint's emergency command, from a folder with a package tagid",
    before="stopped: False, ran: ['owned-tagid'], pass-key in the guardian's words: True",
    test="tests/unit/test_processes.py::test_the_guardian_and_its_command_run_no_code_of_the_current_folder",
)
def emergency_words(folder: Path) -> Outcome:
    place = hostile_folder(folder)
    with emulated("revopoint") as (url, truth), spinning(f"{url}&passkey=918273", truth, cwd=place) as spin:
        guardian = children_of(spin.pid)[0]
        secret = "918273" in Path(f"/proc/{guardian}/cmdline").read_text()
        spin.kill()
        stopped = wait_for(lambda: not truth.state()["moving"], 40)
        spin.wait()
    ran = [path.name for path in folder.glob("owned-*")]
    figure = f"stopped: {stopped}, ran: {ran}, pass-key in the guardian's words: {secret}"
    return Outcome(figure, stopped and not ran and not secret)


@attack(
    "F5",
    "`motion stop` from another environment of the user, and without a guardian",
    before="0 of 6 stopped; 0 of 2 name the holder",
    test="tests/protocol/test_motion_owner.py::test_the_guardian_is_found_from_every_environment",
)
def other_environments(folder: Path) -> Outcome:
    other = folder / "other"
    other.mkdir(mode=0o700)
    plain = {k: v for k, v in os.environ.items() if k != "XDG_RUNTIME_DIR"}
    environments = [
        {**plain, "XDG_RUNTIME_DIR": str(other)},
        {**plain, "TMPDIR": str(other)},
        {"PATH": os.environ["PATH"]},
    ]
    runtime = folder / "run"
    runtime.mkdir(mode=0o700)
    stopped, reported = 0, 0
    for device in ("comxim", "roomba"):
        with emulated(device) as (url, truth):
            for environment in environments:
                mine = {**os.environ, "XDG_RUNTIME_DIR": str(runtime)}
                with spinning(url, truth, env=mine):
                    stop = subprocess.run(
                        [TAGID, "motion", "stop", url], env=environment, capture_output=True
                    )
                    stopped += stop.returncode == 0 and not truth.state()["moving"]
            with spinning(url, truth) as spin:
                for number in (signal.SIGSTOP, signal.SIGKILL):
                    os.kill(spin.pid if number == signal.SIGSTOP else children_of(spin.pid)[0], number)
                stop = subprocess.run([TAGID, "motion", "stop", url], capture_output=True)
                reported += (
                    b"still be turning" in stop.stderr and f"process {spin.pid} ".encode() in stop.stderr
                )
    return Outcome(f"{stopped} of 6 stopped; {reported} of 2 name the holder", stopped == 6 and reported == 2)


@attack(
    "F7",
    "driver and guardian of a Comxim killed together",
    before="turns on after 30 s",
    test="tests/protocol/test_tables.py::"
    "test_a_comxim_table_is_commanded_for_seconds_where_it_takes_an_angle",
)
def both_killed(folder: Path) -> Outcome:
    with emulated("comxim") as (url, truth), spinning(url, truth) as spin:
        for pid in (*children_of(spin.pid), spin.pid):
            os.kill(pid, signal.SIGKILL)
        began = time.monotonic()
        still = wait_for(lambda: not truth.state()["moving"], 30)
        seconds = truth.state()["still_since_s"] - began
    return Outcome(f"still after {seconds:.1f} s" if still else "turns on after 30 s", still)


@attack(
    "F7b",
    "driver of a Roomba and everything in its cgroup killed, the guardian in a scope of its own",
    before="turns on after 10 s",
    test="tests/protocol/test_motion_owner.py::test_the_guardian_gets_a_scope_of_its_own_where_there_is_one",
)
def cgroup_killed(folder: Path) -> Outcome:
    program = folder / "systemd-run"
    program.write_text(
        f'#!/bin/sh\necho "$$" "$@" >> {folder}/words\n'
        'while [ "$1" != -- ]; do shift; done; shift; exec "$@"\n'
    )
    program.chmod(0o755)
    path = {**os.environ, "PATH": f"{folder}:{os.environ['PATH']}"}
    with emulated("roomba") as (url, truth), spinning(url, truth, env=path) as spin:
        words = (folder / "words").read_text().split() if (folder / "words").exists() else ["0"]
        scoped = int(words[0])
        for pid in (*(child for child in children_of(spin.pid) if child != scoped), spin.pid):
            os.kill(pid, signal.SIGKILL)
        began = time.monotonic()
        still = wait_for(lambda: not truth.state()["moving"], 10)
        seconds = truth.state()["still_since_s"] - began
    figure = f"still after {seconds:.1f} s" if still else "turns on after 10 s"
    return Outcome(figure, still and "--scope" in words)


class Proxy:
    """A serial proxy that prints a robot's log between its packets and loses one byte in 400."""

    def __init__(self, device: str) -> None:
        self.robot = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(self.robot)
        self.program, far = os.openpty()
        tty.setraw(far)
        os.set_blocking(self.program, False)
        self.path = os.ttyname(far)
        self.stop = threading.Event()
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def run(self) -> None:
        chance, last = random.Random(3), time.monotonic()
        while not self.stop.is_set():
            for source, sink, lossy in (
                (self.program, self.robot, False), (self.robot, self.program, True),
            ):  # fmt: skip
                with contextlib.suppress(BlockingIOError):
                    data = os.read(source, 4096)
                    os.write(sink, bytes(b for b in data if not lossy or chance.random() > 1 / 400))
            if time.monotonic() - last > 0.7:
                os.write(self.program, b"docking: no\r\n")
                last = time.monotonic()
            time.sleep(0.002)


@attack(
    "field 15",
    "bytes outside frames are counted in the result",
    before="turned 361 degrees, bytes_dropped 0",
    test="tests/protocol/test_roomba_device.py::test_bytes_outside_frames_are_counted_in_the_result",
)
def dropped_bytes(folder: Path) -> Outcome:
    with emulated("roomba") as (url, _):
        proxy, json_ = Proxy(url.partition("://")[2]), ("--output", "json")
        try:
            spin = subprocess.run(
                [TAGID, "motion", "spin", f"roomba+serial://{proxy.path}?step=3", "--yes", "-q", *json_],
                capture_output=True, text=True,
            )  # fmt: skip
        finally:
            proxy.stop.set()
            proxy.thread.join()
    data = json.loads(spin.stdout)["data"]
    figure = f"turned {data['turned_deg']:.0f} degrees, bytes_dropped {data['bytes_dropped']}"
    return Outcome(figure, data["bytes_dropped"] > 0)


BLUEZ = """
import sys
import bleak
from bleak.exc import BleakDBusError
starts = 0
async def fail(self, *a, **k):
    global starts
    starts += 1
    raise BleakDBusError(NAME, ["as asked"])
NAME = sys.argv.pop(1)
bleak.BleakScanner.start = bleak.BleakScanner.__aenter__ = fail
from tagid.cli.app import main
try: main()
finally: print(f"[scans started: {starts}]", file=sys.stderr)
"""


@attack(
    "field 16",
    "BlueZ is busy, or not ready",
    before="InProgress: 1 try; bridge blamed: True",
    test="tests/protocol/test_roomba_bluez.py::test_a_busy_bluetooth_is_tried_again",
)
def busy_bluetooth(folder: Path) -> Outcome:
    said = {}
    for name in ("InProgress", "NotReady"):
        words = [f"org.bluez.Error.{name}", "motion", "info", "roomba+ble://robot-7"]
        done = subprocess.run([sys.executable, "-P", "-c", BLUEZ, *words], capture_output=True, text=True)
        said[name] = done.stderr
    tries = said["InProgress"].count("scans started: 3")
    figure = f"InProgress: {'3 tries' if tries else '1 try'}; bridge blamed: " + str(
        any("power-cycle the bridge" in text for text in said.values())
    )
    held = bool(tries) and "restart bluetooth" in said["InProgress"] and "power on" in said["NotReady"]
    return Outcome(figure, held and "power-cycle" not in "".join(said.values()))


STRANGERS = """
import os, socket, sys
from tagid.motion.guardian import _socket_name
names = ["any\\n\\nname"]
if os.getuid() == 0:
    os.setuid(65534)
    names += [f"{_socket_name(sys.argv[1])}-{number}" for number in range(1100)]
lines = [socket.socket(socket.AF_UNIX) for name in names]
for line, name in zip(lines, names):
    line.bind("\\0" + name)
    line.listen()
print(flush=True)
sys.stdin.read()
"""


@attack(
    "A1",
    "`motion stop` among sockets of another user: a name of two lines, 1100 names like those of guardians",
    before="exit code 1, stopped: False",
    test="tests/protocol/test_motion_owner.py::"
    "test_no_socket_of_another_user_keeps_a_guardian_from_being_asked",
)
def hostile_sockets(folder: Path) -> Outcome:
    with emulated("comxim") as (url, truth), spinning(url, truth):
        port = url.partition("://")[2]
        words = ["bash", "-c", 'ulimit -n 4096; exec "$@"', "x", sys.executable, "-P", "-c", STRANGERS, port]
        others = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert others.stdout is not None
        others.stdout.readline()
        limited = ["bash", "-c", 'ulimit -n 1024; exec "$@"', "x", TAGID, "motion", "stop", url]
        code = subprocess.run(limited, capture_output=True).returncode
        stopped = not truth.state()["moving"]
        others.communicate()
    return Outcome(f"exit code {code}, stopped: {stopped}", stopped and code == 0)


@attack(
    "A2",
    "`motion stop URL` with a configuration that cannot be used",
    before="0 of 3 stopped",
    test="tests/cli/test_motion_commands.py::test_no_file_or_setting_prevents_a_stop",
)
def damaged_configuration(folder: Path) -> Outcome:
    damaged = folder / "damaged.toml"
    damaged.write_text("not TOML")
    stopped = 0
    with emulated("roomba") as (url, truth):
        for changed in (
            {"TAGID_CONFIG": "/dev/null/x"}, {"TAGID_CONFIG": str(damaged)}, {"TAGID_RADAR_TIMEOUT_S": "abc"},
        ):  # fmt: skip
            with spinning(url, truth):
                stop = subprocess.run(
                    [TAGID, "motion", "stop", url], env={**os.environ, **changed}, capture_output=True
                )
                stopped += stop.returncode == 0 and not truth.state()["moving"]
    return Outcome(f"{stopped} of 3 stopped", stopped == 3)


@attack(
    "A3",
    "`motion stop` by another name of a Bluetooth table, and by a relative path of a port",
    before="0 of 3 stopped",
    test="tests/protocol/test_motion_owner.py::test_motion_stop_finds_a_bluetooth_table_by_all_its_names",
)
def other_names(folder: Path) -> Outcome:
    stopped = 0
    with emulated("revopoint") as (url, truth):
        for name in ("REVO_DUAL", "F0:F1:F2:F3:F4:02"):
            with spinning(url, truth):
                words = [TAGID, "motion", "stop", url.replace("://", f"://{name}")]
                stop = subprocess.run(words, capture_output=True, timeout=60)
                stopped += stop.returncode == 0 and wait_for(lambda: not truth.state()["moving"], 5)
    with emulated("comxim") as (url, truth), spinning(url, truth):
        words = [TAGID, "motion", "stop", url.replace(":///", "://")]
        stop = subprocess.run(words, capture_output=True, timeout=60, cwd="/")
        stopped += stop.returncode == 0 and not truth.state()["moving"]
    return Outcome(f"{stopped} of 3 stopped", stopped == 3)
