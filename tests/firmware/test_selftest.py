"""`tagid-firmware selftest` against the firmware and a robot on a pty; `p440` against an emulated radar."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator

import pytest

from firmware_tools.virtual.process import BoardProcess
from tests.firmware.conftest import CONFIG, PASSKEY, Command, Wire


@pytest.fixture
def robot(wire: Wire) -> Iterator[bytearray]:
    """Answers the query for voltage and mode; the bytes are all that it ever heard."""
    heard = bytearray()

    def answer() -> None:
        while True:
            data = wire.read(1, 60)
            if data == b"\xff" or not data:
                return
            heard.extend(data)
            if heard.endswith(bytes((149, 2, 22, 35))):
                wire.write(bytes((0x3E, 0x80, 1)))

    thread = threading.Thread(target=answer, daemon=True)
    thread.start()
    yield heard
    os.write(wire.slave, b"\xff")
    thread.join(10)


def test_every_step_of_a_good_bridge(board: BoardProcess, robot: bytearray, firmware: Command) -> None:
    words = ("selftest", "robot-7", "--passkey", PASSKEY, "--hci", board.hci, "--listen", "1")
    code, document = firmware(*words)
    steps = {step["name"]: step for step in document["data"]["steps"]}
    assert code == 0, document["errors"]
    assert [step["verdict"] for step in steps.values()].count("passed") == 7
    assert steps["UART loopback"]["verdict"] == "skipped"
    assert steps["robot"]["text"] == "battery 16.0 V, mode Passive"
    assert steps["MTU"]["text"] == "247 bytes"
    # It asks and wakes; nothing that it sends can turn a wheel.
    assert bytes(robot) == bytes((128, 149, 2, 22, 35))


def test_steps_that_fail_say_what_to_look_at(firmware: Command) -> None:
    with BoardProcess({**CONFIG, "brc_pin": None}) as board:
        words = ("selftest", board.address, "--passkey", PASSKEY, "--hci", board.hci)
        # TX and RX are joined, but the robot is asked: it "answers" with the question.
        code, document = firmware(*words)
        verdicts = {step["name"]: step["verdict"] for step in document["data"]["steps"]}
        assert code == 1 and verdicts["robot"] == "failed" and verdicts["BRC"] == "skipped"
        code, document = firmware(*words, "--loopback")
        assert code == 0, document["errors"]
        code, document = firmware("selftest", board.address, "--passkey", "111111", "--hci", board.hci)
        assert code == 4 and "refused the pairing" in document["errors"][0]["message"]
        code, document = firmware("selftest", "robot-9", "--hci", board.hci, "--listen", "1")
        assert code == 4 and "no bridge called 'robot-9'" in document["errors"][0]["message"]
    code, document = firmware("selftest", "robot-7", "--hci", board.hci)
    assert code == 4 and "no virtual controller" in document["errors"][0]["message"]


def test_a_p440_is_compared_and_stored(firmware: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TAGID_RADAR_GAIN", "40")
    code, document = firmware("p440", "--radar", "emulator://helmet-120")
    assert code == 0 and document["data"]["differs"] == ["transmit_gain"] and not document["data"]["stored"]
    assert any("transmit_gain" in message for message in document["messages"])
    words = ("p440", "--radar", "emulator://helmet-120", "--store", "--start-ps", "15000", "--node", "7")
    code, document = firmware(*words)
    after = document["data"]["after"]
    assert code == 0 and document["data"]["stored"]
    # What the radar keeps lies on its own grid (measured on recordings: 15000 becomes 14999).
    kept = [after[name] for name in ("scan_start_ps", "transmit_gain", "node_id", "persist")]
    assert kept == [14999, 40, 7, 1]
    assert document["data"]["status"]["mrm_version"]
    code, document = firmware("p440", "--radar", "emulator://helmet-120", "--start-ps", "50000")
    assert code == 2 and "scan window ends" in document["errors"][0]["message"]
