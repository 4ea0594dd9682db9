"""The compiled firmware in the real MicroPython, with time that passes only where the firmware sleeps."""

from __future__ import annotations

import itertools
import json
import random
from pathlib import Path
from typing import Any

import pytest

from firmware_tools.build import compile_firmware, write_build
from tagid.motion.bridge.protocol import BridgeInfo, Flag, IndexPulse, Op, Reply, Status, decode_event, encode
from tests.firmware.conftest import CONFIG
from tests.firmware.microvm import needs_vm, run_in_vm

pytestmark = needs_vm

DRIVE = "9100 64ff9c".replace(" ", "")
STOP = "00000000" + "9100000000" + "83" + "9100000000" + "80"
HELLO: list[list[Any]] = [[10, "connect", 247], [11, "trust", 1]]


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("board")
    write_build(compile_firmware(), folder)
    (folder / "bridge.json").write_text(json.dumps(CONFIG))
    return folder


def of(result: dict[str, Any], what: str) -> list[tuple[float, str]]:
    return [(ms, text) for ms, kind, text in result["log"] if kind == what]


def command(ms: float, op: Op, *arguments: int, seq: int = 1) -> list[Any]:
    return [ms, "command", encode(op, seq, *arguments).hex()]


@pytest.mark.parametrize("start_us", [0, (1 << 30) - 700_000, (1 << 30) * 1000 - 1_200_000])
def test_a_link_cut_at_any_moment_stops_the_wheels_within_500_ms(board: Path, start_us: int) -> None:
    """Ten random moments; also where the microsecond and the millisecond ticks wrap meanwhile."""
    random.seed(11)
    cuts = [random.uniform(300, 1500) for _ in range(10)]
    plans = []
    for cut in cuts:
        beats = [command(ms, Op.HEARTBEAT) for ms in range(100, int(cut), 100)]
        actions = [*HELLO, command(20, Op.ARM, 400), [30, "rx", "80" + "83" + DRIVE], *beats]
        plans.append({"start_us": start_us, "end_ms": 2500, "actions": actions})
    for cut, result in zip(cuts, run_in_vm(board, *plans), strict=True):
        stops = [ms for ms, text in of(result, "uart") if text == STOP]
        on_the_wire_ms = 16 * 10 / 115.2
        assert len(stops) == 3 and 0 < stops[0] - cut <= 500 - on_the_wire_ms
        assert not [ms for ms, text in of(result, "uart") if text != STOP and ms > cut]


def test_a_lost_link_stops_the_wheels_at_once_and_is_advertised_again(board: Path) -> None:
    actions = [*HELLO, command(20, Op.ARM, 5000), [30, "rx", DRIVE], [200, "lose", 0]]
    (result,) = run_in_vm(board, {"end_ms": 600, "actions": actions})
    first = next(ms for ms, text in of(result, "uart") if text == STOP)
    assert first - 200 < 5
    assert len(of(result, "advertise")) == 2


def test_nothing_is_written_where_nothing_was_driven(board: Path) -> None:
    asked = {"end_ms": 900, "actions": [*HELLO, command(20, Op.TIME), [300, "lose", 0]]}
    goodbye = {"end_ms": 900, "actions": [*HELLO, [30, "rx", "80"], command(40, Op.DISARM), [300, "lose", 0]]}
    only_asked, said_goodbye = run_in_vm(board, asked, goodbye)
    assert of(only_asked, "uart") == []
    assert [text for _, text in of(said_goodbye, "uart")] == ["80"]


def test_without_the_passkey_no_byte_reaches_the_robot(board: Path) -> None:
    """Encrypted but not authenticated is what a stranger without a keyboard gets."""
    actions = [[10, "connect", 247], [11, "trust", 0], [20, "rx", DRIVE], command(30, Op.BRC, 100, 1, 0)]
    (result,) = run_in_vm(board, {"end_ms": 70_000, "actions": actions, "round_us": 9000})
    assert of(result, "uart") == [] and of(result, "pin") == []
    replies = [decode_event(bytes.fromhex(text)) for _, text in of(result, "event")]
    assert [r.status for r in replies if isinstance(r, Reply)] == [Status.NOT_PAIRED]
    # Who does not pair must not keep the owner out for ever.
    (ended,) = of(result, "disconnect")
    assert 60_000 <= ended[0] - 10 <= 60_100


def test_five_wrong_passkeys_close_the_door(board: Path) -> None:
    actions = [[10 * n, "passkey", 0] for n in range(1, 8)]
    (result,) = run_in_vm(board, {"end_ms": 200, "actions": [[5, "connect", 247], *actions]})
    assert [text for _, text in of(result, "passkey")] == ["482913"] * 5
    assert len(of(result, "disconnect")) == 2


def test_notifications_fill_the_mtu_and_a_refused_one_is_sent_again(board: Path) -> None:
    data = random.Random(3).randbytes(2000).hex()
    actions = [*HELLO, [20, "room", 2], [21, "robot", data], [60, "room", 3], [90, "room", 99]]
    (result,) = run_in_vm(board, {"end_ms": 300, "actions": actions})
    pieces = [text for _, text in of(result, "bytes")]
    assert "".join(pieces) == data
    assert [len(piece) // 2 for piece in pieces] == [244] * 8 + [2000 - 8 * 244]


def test_frames_of_a_stream_leave_within_ten_ms(board: Path) -> None:
    frames = [[100 + 15 * n, "robot", f"130d07{n:02x}"] for n in range(40)]
    (result,) = run_in_vm(board, {"end_ms": 900, "actions": [*HELLO, *frames]})
    sent = of(result, "bytes")
    assert [text for _, text in sent] == [frame[2] for frame in frames]
    assert max(ms - frame[0] for (ms, _), frame in zip(sent, frames, strict=True)) <= 10


def test_an_index_pulse_is_stamped_when_it_happens_not_when_it_is_told(board: Path) -> None:
    actions = [
        *HELLO,
        command(20, Op.TIME),
        [99.5, "room", 0],
        [100, "pulse", 0],
        [100.8, "pulse", 0],
        [160, "room", 9],
    ]
    (result,) = run_in_vm(board, {"end_ms": 300, "actions": actions})
    events = [(ms, decode_event(bytes.fromhex(text))) for ms, text in of(result, "event")]
    clock = int.from_bytes(next(e.payload for _, e in events if isinstance(e, Reply)), "little")
    asked = next(ms for ms, e in events if isinstance(e, Reply))
    ((told, pulse),) = [(ms, e) for ms, e in events if isinstance(e, IndexPulse)]  # the bounce is none
    assert told >= 160 and pulse.number == 1
    assert abs((pulse.stamp_us - clock) / 1000 - (100 - asked)) < 1.5


def test_brc_is_pulsed_through_the_transistor(board: Path) -> None:
    actions = [*HELLO, command(20, Op.BRC, 200, 3, 100)]
    (result,) = run_in_vm(board, {"end_ms": 1200, "actions": actions})
    edges = of(result, "pin")
    assert [text for _, text in edges] == ["6=1", "6=0"] * 3
    gaps = [round(b - a, -1) for (a, _), (b, _) in itertools.pairwise(edges)]
    assert gaps == [200, 100, 200, 100, 200]


def test_who_works_on_the_board_finds_a_prompt_and_a_patient_watchdog(board: Path) -> None:
    actions = [*HELLO, [30, "rx", DRIVE], [100, "interrupt", 0]]
    (result,) = run_in_vm(board, {"end_ms": 500, "actions": actions})
    assert result["ended"] == "prompt"
    assert of(result, "uart")[-1][1] == STOP
    assert [text for _, text in of(result, "wdt")] == ["8000", "600000"]
    assert result["fed"] > 50


def test_a_fault_stops_the_robot_and_restarts_the_board(board: Path) -> None:
    actions = [*HELLO, [30, "rx", DRIVE], [100, "fault", 0]]
    (result,) = run_in_vm(board, {"end_ms": 2000, "actions": actions})
    assert of(result, "uart")[-1][1] == STOP and of(result, "reset")


def test_after_a_watchdog_reset_the_robot_is_stopped_first(board: Path) -> None:
    (result,) = run_in_vm(board, {"end_ms": 300, "actions": [], "reset_cause": 3})
    assert of(result, "uart")[0] == (0, STOP) and len(of(result, "uart")) == 3
    assert Flag.AFTER_WATCHDOG in BridgeInfo.from_bytes(bytes.fromhex(result["info"])).flags


def test_an_invalid_configuration_drives_nothing_and_says_so(board: Path) -> None:
    valid = (board / "bridge.json").read_text()
    try:
        for text in ("{", json.dumps({**CONFIG, "baud": 115201}), json.dumps({**CONFIG, "uart_tx": 5})):
            (board / "bridge.json").write_text(text)
            actions = [[10, "connect", 247], command(20, Op.ARM, 0), [30, "rx", DRIVE]]
            (result,) = run_in_vm(board, {"end_ms": 600, "actions": actions})
            reply = decode_event(bytes.fromhex(of(result, "event")[0][1]))
            assert isinstance(reply, Reply) and reply.status == Status.NOT_PROVISIONED
            assert of(result, "uart") == []
            info = BridgeInfo.from_bytes(bytes.fromhex(result["info"]))
            assert info.name == "tagid-setup" and Flag.PROVISIONED not in info.flags
    finally:
        (board / "bridge.json").write_text(valid)


def test_work_leaves_the_memory_as_it_was(board: Path) -> None:
    """Commands, bytes both ways and pulses, again and again: what is free after does not shrink."""
    actions: list[list[Any]] = [*HELLO]
    for n in range(1, 301):
        at = 100.0 * n
        actions += [
            command(at, Op.HEARTBEAT, seq=n & 255),
            [at + 10, "rx", DRIVE],
            [at + 20, "robot", "ab" * 60],
        ]
        actions += [[at + 30, "pulse", 0], [at + 40, "command", "02" + f"{n & 255:02x}"]]
        if n in (50, 300):
            actions.append([at + 50, "collect", 0])
    (result,) = run_in_vm(board, {"end_ms": 31_000, "actions": actions, "round_us": 4000}, heap_bytes=2 << 20)
    early, late = (int(text) for _, text in of(result, "free"))
    # The scenario's own log grows with every line; the firmware must add nothing to it.
    lines = sum(1 for ms, _, _ in result["log"] if 5050 < ms <= 30_050)
    assert (early - late) / lines < 400
