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
    """What happened after the boot."""
    return [(ms, text) for ms, kind, text in result["log"] if kind == what and ms > 0]


def at_boot(result: dict[str, Any], what: str) -> list[tuple[float, str]]:
    return [(ms, text) for ms, kind, text in result["log"] if kind == what and ms <= 0]


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
    assert len(of(result, "advertise")) + len(at_boot(result, "advertise")) == 2


def test_nothing_is_written_where_nothing_was_driven(board: Path) -> None:
    asked = {"end_ms": 900, "actions": [*HELLO, command(20, Op.TIME), [300, "lose", 0]]}
    goodbye = {"end_ms": 900, "actions": [*HELLO, [30, "rx", "80"], command(40, Op.DISARM), [300, "lose", 0]]}
    only_asked, said_goodbye = run_in_vm(board, asked, goodbye)
    assert of(only_asked, "uart") == []
    assert [text for _, text in of(said_goodbye, "uart")] == ["80"]


@pytest.mark.parametrize("cause", [1, 2, 3, 4, 5])
def test_every_boot_stops_the_robot_three_times(board: Path, cause: int) -> None:
    (result,) = run_in_vm(board, {"end_ms": 300, "actions": [], "reset_cause": cause})
    stops = at_boot(result, "uart")
    assert [text for _, text in stops] == [STOP] * 3 and of(result, "uart") == []
    gaps = [b - a for (a, _), (b, _) in itertools.pairwise(stops)]
    assert 30 <= gaps[0] < 40 and 120 <= gaps[1] < 130
    flags = BridgeInfo.from_bytes(bytes.fromhex(result["info"])).flags
    assert (Flag.AFTER_WATCHDOG in flags) == (cause == 3)


def test_a_disarmed_robot_that_may_move_is_stopped_and_no_command_overtakes_the_stops(board: Path) -> None:
    """The drive command waits in the queue while the second and third stop are still due."""
    actions = [
        *HELLO, command(20, Op.ARM, 5000), [30, "rx", DRIVE], command(60, Op.DISARM),
        command(61, Op.ARM, 5000), [62, "rx", DRIVE], [600, "lose", 0],
    ]  # fmt: skip
    (result,) = run_in_vm(board, {"end_ms": 900, "actions": actions})
    assert [text for _, text in of(result, "uart")] == [DRIVE, STOP, STOP, STOP, DRIVE, STOP, STOP, STOP]


def test_a_stop_that_still_waits_when_the_link_is_lost_is_not_dropped(board: Path) -> None:
    """At 300 Bd the host's own last words are in the queue when it disarms and goes."""
    farewell = "9100000000" * 20
    actions = [
        *HELLO, command(20, Op.ARM, 5000), [30, "rx", DRIVE], [200, "rx", farewell],
        command(210, Op.DISARM), [215, "lose", 0],
    ]  # fmt: skip
    valid = (board / "bridge.json").read_text()
    try:
        (board / "bridge.json").write_text(json.dumps({**CONFIG, "baud": 300}))
        (result,) = run_in_vm(board, {"end_ms": 900, "actions": actions})
    finally:
        (board / "bridge.json").write_text(valid)
    assert [text for _, text in of(result, "uart")][-3:] == [STOP] * 3


def test_without_the_passkey_no_byte_reaches_the_robot(board: Path) -> None:
    """Encrypted but not authenticated is what an unpaired host without a keyboard gets."""
    actions = [[10, "connect", 247], [11, "trust", 0], [20, "rx", DRIVE], command(30, Op.BRC, 100, 1, 0)]
    (result,) = run_in_vm(board, {"end_ms": 70_000, "actions": actions, "round_us": 9000})
    assert of(result, "uart") == [] and of(result, "pin") == []
    replies = [decode_event(bytes.fromhex(text)) for _, text in of(result, "event")]
    assert [r.status for r in replies if isinstance(r, Reply)] == [Status.NOT_PAIRED]
    # Who does not pair must not keep the owner out for ever.
    (ended,) = of(result, "disconnect")
    assert 60_000 <= ended[0] - 10 <= 60_100


def test_failed_passkeys_wait_longer_each_time_and_then_close_the_door(board: Path) -> None:
    """Each try comes shortly before and again after it is due; only the second is answered."""
    actions: list[list[Any]] = []
    at = 250.0
    for n, wait in enumerate((0, 2_000, 10_000, 60_000, 300_000)):
        at += wait
        if n:
            actions += [[at - 600, "connect", 247], [at - 500, "passkey", 0], [at - 200, "lose", 0]]
        at += 300
        actions += [[at - 200, "connect", 247], [at, "passkey", 0], [at + 200, "lose", 0]]
    late = at + 900_000
    actions += [[late, "connect", 247], [late + 100, "passkey", 0]]
    (result,) = run_in_vm(board, {"end_ms": late + 300, "actions": actions, "round_us": 49_000})
    assert [text for _, text in of(result, "passkey")] == ["482913"] * 5
    assert len(of(result, "disconnect")) == 5


@pytest.mark.parametrize(
    ("files", "answered"),
    [
        ({}, 1),
        ({"tries.json": "0"}, 1),
        ({"tries.json": "4"}, 0),
        ({"tries.json": "5"}, 0),
        ({"tries.json": "{"}, 0),
        ({"tries.json": '"5"'}, 0),
    ],
)
def test_a_reboot_forgets_no_failed_try(board: Path, files: dict[str, str], answered: int) -> None:
    plan = {"end_ms": 900, "actions": [[5, "connect", 247], [500, "passkey", 0]], "files": files}
    (result,) = run_in_vm(board, plan)
    assert len(of(result, "passkey")) == answered


def test_only_secure_connections_are_trusted(board: Path) -> None:
    drive = [[30, "rx", DRIVE], command(40, Op.TIME)]
    connect = [[10, "connect", 247]]
    legacy = {"end_ms": 200, "actions": [*connect, [11, "legacy", 0], *drive]}
    # A peer that came back with the bond is trusted; one that only claims its address has no bond to show.
    back = [[50, "lose", 0], [60, "connect", 247], [61, "again", 0], [70, "rx", DRIVE]]
    again = {"end_ms": 200, "actions": [*connect, [11, "trust", 1], *back]}
    unknown = {"end_ms": 200, "actions": [*connect, [11, "again", 0], *drive]}
    refused, trusted, unpaired = run_in_vm(board, legacy, again, unknown)
    assert of(refused, "uart") == [] and len(of(refused, "disconnect")) == 1
    assert [text for _, text in of(trusted, "uart")][:1] == [DRIVE]
    assert of(unpaired, "uart") == []


def test_bonds_are_bounded(board: Path) -> None:
    pairs = [[10 + n, "pair", n] for n in range(1, 12)]
    (result,) = run_in_vm(board, {"end_ms": 100, "actions": [[5, "connect", 247], *pairs, [50, "bonds", 0]]})
    ((_, text),) = of(result, "bonds")
    peers = [int(row[1][2:4], 16) for row in json.loads(text)]
    assert peers == [4, 5, 6, 7, 8, 9, 10, 11], "the oldest make room"


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
    assert [text for _, text in of(result, "uart")] == [DRIVE, STOP, STOP, STOP]
    assert [text for _, text in at_boot(result, "wdt") + of(result, "wdt")] == ["1000", "600000"]
    assert result["fed"] > 50


def test_a_fault_of_an_interrupt_stops_the_robot_three_times_and_restarts_the_board(board: Path) -> None:
    """MicroPython would print the exception of the radio's handler and go on."""
    actions = [*HELLO, [30, "rx", DRIVE], [100, "break", 0]]
    (result,) = run_in_vm(board, {"end_ms": 2000, "actions": actions})
    stops = [(ms, text) for ms, text in of(result, "uart") if text == STOP]
    ((reset, _),) = of(result, "reset")
    assert len(stops) == 3 and stops[0][0] < 110 and stops[2][0] < reset


def test_a_fault_of_the_loop_stops_the_robot_three_times_and_restarts_the_board(board: Path) -> None:
    actions = [*HELLO, [30, "rx", DRIVE], [100, "fault", 0]]
    (result,) = run_in_vm(board, {"end_ms": 2000, "actions": actions})
    assert [text for _, text in of(result, "uart")] == [DRIVE, STOP, STOP, STOP] and of(result, "reset")


def test_index_pulses_of_a_busy_loop_come_late_and_are_lost_beyond_the_scheduler(board: Path) -> None:
    """Pin interrupts are scheduled on the ESP32: a stamp is only as good as the loop is quick."""
    actions = [
        *HELLO,
        [100, "busy", 900],
        *[[200 + 60 * n, "pulse", 0] for n in range(10)],
        [1500, "pulse", 0],
    ]
    (result,) = run_in_vm(board, {"end_ms": 2000, "actions": actions})
    pulses = [decode_event(bytes.fromhex(text)) for _, text in of(result, "event")]
    # All eight that waited bear the same moment, so seven are taken for bounces.
    assert [pulse.number for pulse in pulses if isinstance(pulse, IndexPulse)] == [1, 2]


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


HEAP_BYTES = 64 * 1024
"""First part of the heap that MicroPython's ESP32 port takes (MICROPY_GC_INITIAL_HEAP_SIZE, ports/esp32); it
takes more from the system only while the radio leaves some."""


def test_the_firmware_fits_the_chips_heap(board: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Commands, full queues both ways and pulses; the VM's own heap grows, so what is in use is measured."""
    actions: list[list[Any]] = [*HELLO, command(50, Op.ARM, 5000)]
    for n in range(16):
        at = 100.0 * (n + 1)
        actions += [
            command(at, Op.HEARTBEAT, seq=n),
            [at + 10, "rx", DRIVE * 40],
            [at + 20, "robot", "ab" * 900],
            [at + 30, "pulse", 0],
            command(at + 40, Op.STATUS, seq=n),
        ]
        if n == 8:
            actions += [[at + 50, "room", 0], [at + 51, "robot", "ab" * 3000], [at + 90, "room", 1 << 30]]
    plan = {"end_ms": 1800, "actions": actions, "measure": True, "round_us": 4000}
    first, second = run_in_vm(board, plan, {**plan, "actions": list(actions)}, heap_bytes=2 << 20)
    peak, alive = first["memory"]["peak"], first["memory"]["alive"]
    with capsys.disabled():
        print(f"\nfirmware memory: {peak} bytes at most in a round, {alive} of them alive")
    assert 0 < alive < peak < HEAP_BYTES
    # The same work again needs as much, not more.
    assert second["memory"]["alive"] < alive + 1024
