"""The compiled firmware in the real MicroPython, with time that passes only where the firmware sleeps."""

from __future__ import annotations

import itertools
import json
import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from firmware_tools.bridge.tagid_bridge import settings
from firmware_tools.bridge.tagid_bridge.ring import Ring
from firmware_tools.build import SOURCE, compile_firmware, write_build
from tagid.motion.bridge.protocol import (
    BridgeInfo,
    BridgeStatus,
    Event,
    Flag,
    IndexPulse,
    Op,
    Overflow,
    Reply,
    Status,
    Tripped,
    decode_event,
    encode,
)
from tests.firmware.conftest import CONFIG
from tests.firmware.microvm import needs_vm, run_in_vm

pytestmark = needs_vm

DRIVE = "910064ff9c"
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


def texts(result: dict[str, Any], what: str) -> list[str]:
    return [text for _, text in of(result, what)]


def events_of(result: dict[str, Any]) -> list[Event]:
    return [decode_event(bytes.fromhex(text)) for text in texts(result, "event")]


def replies_of(result: dict[str, Any]) -> list[Reply]:
    return [event for event in events_of(result) if isinstance(event, Reply)]


def at_boot(result: dict[str, Any], what: str) -> list[tuple[float, str]]:
    return [(ms, text) for ms, kind, text in result["log"] if kind == what and ms <= 0]


def command(ms: float, op: Op, *arguments: int, seq: int = 1) -> list[Any]:
    return [ms, "command", encode(op, seq, *arguments).hex()]


def test_a_link_cut_at_any_moment_stops_the_wheels_within_500_ms(board: Path) -> None:
    """Twelve random moments; of some, the microsecond and the millisecond ticks wrap meanwhile."""
    random.seed(11)
    cuts = [random.uniform(300, 1500) for _ in range(12)]
    starts_us = [0, (1 << 30) - 700_000, (1 << 30) * 1000 - 1_200_000] * 4
    plans = []
    for cut, start_us in zip(cuts, starts_us, strict=True):
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
    assert texts(said_goodbye, "uart") == ["80"]


def test_every_boot_stops_the_robot_three_times(board: Path) -> None:
    causes = [1, 2, 3, 4, 5]
    plans = [{"end_ms": 300, "actions": [], "reset_cause": cause} for cause in causes]
    for cause, result in zip(causes, run_in_vm(board, *plans), strict=True):
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
    assert texts(result, "uart") == [DRIVE, STOP, STOP, STOP, DRIVE, STOP, STOP, STOP]


def test_what_waits_for_a_slow_line_gives_way_to_the_stops(board: Path) -> None:
    """At 300 Bd commands are still in the queue when the host disarms and goes, disarms, or is silent."""
    drives = "9100000000" * 20
    driven = [*HELLO, command(20, Op.ARM, 5000), [30, "rx", DRIVE], [200, "rx", drives]]
    gone = [*driven, command(210, Op.DISARM), [215, "lose", 0]]
    queued = [*HELLO, [30, "rx", "80"], [32, "rx", drives], command(40, Op.DISARM)]
    silent = [*HELLO, command(20, Op.ARM, 400), [30, "rx", drives]]
    slow = {"end_ms": 900, "files": {"bridge.json": json.dumps({**CONFIG, "baud": 300})}}
    results = run_in_vm(board, *[{**slow, "actions": item} for item in (gone, queued, silent)])
    for result, bytes_sent in zip(results, (6, 1, 12), strict=True):
        sent = of(result, "uart")
        pieces = [text for _, text in sent]
        assert pieces[-3:] == [STOP] * 3 and STOP not in pieces[:-3]
        assert abs(len(pieces[:-3]) - bytes_sent) <= 1
        paces = [b - a for (a, _), (b, text) in itertools.pairwise(sent) if text != STOP]
        assert min(paces, default=34) >= 10 / 300 * 1000


def test_after_each_opcode_that_moves_the_robot_disarming_stops_it(board: Path) -> None:
    drives = (134, 135, 136, 137, 143, 144, 145, 146)
    actions = [[*HELLO, [30, "rx", f"80{drive:02x}0000"], command(50, Op.DISARM)] for drive in drives]
    for result in run_in_vm(board, *[{"end_ms": 300, "actions": action} for action in actions]):
        assert texts(result, "uart")[1:] == [STOP] * 3


def test_bytes_alone_keep_the_wheels_turning(board: Path) -> None:
    bytes_only = [[ms, "rx", DRIVE] for ms in range(30, 1500, 300)]
    (result,) = run_in_vm(board, {"end_ms": 1600, "actions": [*HELLO, *bytes_only]})
    assert texts(result, "uart") == [DRIVE] * 5


def test_without_the_passkey_no_byte_reaches_the_robot(board: Path) -> None:
    """Encrypted but not authenticated is what an unpaired host without a keyboard gets."""
    actions = [[10, "connect", 247], [11, "trust", 0], [20, "rx", DRIVE], command(30, Op.BRC, 100, 1, 0)]
    (result,) = run_in_vm(board, {"end_ms": 70_000, "actions": actions, "round_us": 9000})
    assert of(result, "uart") == [] and of(result, "pin") == []
    assert [r.status for r in replies_of(result)] == [Status.NOT_PAIRED]
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
    assert texts(result, "passkey") == ["482913"] * 5
    assert len(of(result, "disconnect")) == 5


def test_a_reboot_forgets_no_failed_try(board: Path) -> None:
    """A damaged count is the largest; the longest wait is over after 300 s."""
    counts = [None, "0", "4", "5", "-1", "{", '"5"']
    actions = [[5, "connect", 247], [500, "passkey", 0]]
    plans = [
        {"end_ms": 900, "actions": before + actions, "files": {} if text is None else {"tries.json": text}}
        for before in ([], [[3, "idle", 300_000]])
        for text in counts
    ]
    answered = [1, 1, 0, 0, 0, 0, 0, 1, 1, 1, 0, 0, 0, 0]
    for shown, result in zip(answered, run_in_vm(board, *plans), strict=True):
        assert len(of(result, "passkey")) == shown and len(of(result, "disconnect")) == 1 - shown
        assert of(result, "reset") == []


def test_a_right_passkey_takes_back_its_own_attempt_only(board: Path) -> None:
    actions = [[10, "connect", 247], [10_100, "passkey", 0], [10_110, "trust", 1]]
    plan = {"end_ms": 10_300, "round_us": 9000, "files": {"tries.json": "2"}}
    (result,) = run_in_vm(board, {**plan, "actions": [*actions, [10_200, "file", "tries.json"]]})
    assert len(of(result, "passkey")) == 1 and of(result, "tries.json")[0][1] == "2"


def test_only_secure_connections_are_trusted(board: Path) -> None:
    drive = [[30, "rx", DRIVE], command(40, Op.TIME)]
    connect = [[10, "connect", 247]]
    legacy = {"end_ms": 200, "actions": [*connect, [11, "legacy", 0], *drive]}
    # A peer that came back with the bond is trusted; one that only claims its address has no bond to show.
    back = [[50, "lose", 0], [60, "connect", 247], [61, "again", 0], [70, "rx", DRIVE]]
    again = {"end_ms": 200, "actions": [*connect, [11, "trust", 1], *back]}
    unknown = {"end_ms": 200, "actions": [*connect, [11, "again", 0], *drive]}
    # Legacy pairing of a computer that had a bond leaves it none, and the system may remove one.
    without = [
        {"end_ms": 300, "actions": [*connect, [11, "trust", 1], [20, what, 0], [90, "file", "bonds.json"]]}
        for what in ("legacy", "unpair")
    ]
    refused, trusted, unpaired, *without = run_in_vm(board, legacy, again, unknown, *without)
    assert [of(result, "bonds.json")[0][1] for result in without] == ["[]", "[]"]
    flags = [BridgeInfo.from_bytes(bytes.fromhex(result["info"])).flags for result in (trusted, unpaired)]
    assert [Flag.TRUSTED in flag for flag in flags] == [True, False]
    assert of(refused, "uart") == [] and len(of(refused, "disconnect")) == 1
    assert texts(trusted, "uart")[:1] == [DRIVE]
    assert of(unpaired, "uart") == []


def test_bonds_are_bounded(board: Path) -> None:
    pairs = [[10 + n, "pair", n] for n in range(1, 12)]
    looks = [[50, "file", "bonds.json"], [60, "erase", "bonds.json"], [90, "file", "bonds.json"]]
    (result,) = run_in_vm(board, {"end_ms": 100, "actions": [[5, "connect", 247], *pairs, *looks]})
    (_, text), (_, later) = of(result, "bonds.json")
    assert later == "", "the flash is written only when a bond changes"
    peers = [int(row[1][2:4], 16) for row in json.loads(text)]
    assert peers == [4, 5, 6, 7, 8, 9, 10, 11], "the oldest make room"


def test_notifications_fill_the_mtu_and_a_refused_one_is_sent_again(board: Path) -> None:
    data = random.Random(3).randbytes(2000).hex()
    rooms = [[20, "room", 2], [21, "robot", data], [60, "room", 3], [90, "room", 99]]
    actions = [[10, "connect", 512], HELLO[1], *rooms]
    (result,) = run_in_vm(board, {"end_ms": 300, "actions": actions})
    pieces = texts(result, "bytes")
    assert "".join(pieces) == data
    assert [len(piece) // 2 for piece in pieces] == [244] * 8 + [2000 - 8 * 244]


def test_frames_of_a_stream_leave_within_ten_ms(board: Path) -> None:
    frames = [[100 + 15 * n, "robot", f"130d07{n:02x}"] for n in range(40)]
    (result,) = run_in_vm(board, {"end_ms": 900, "actions": [*HELLO, *frames]})
    sent = of(result, "bytes")
    assert [text for _, text in sent] == [frame[2] for frame in frames]
    assert max(ms - frame[0] for (ms, _), frame in zip(sent, frames, strict=True)) <= 10


def test_an_index_pulse_is_stamped_when_it_happens_not_when_it_is_told(board: Path) -> None:
    pulses = [[99.5, "room", 0], [100, "pulse", 0], [100.8, "pulse", 0], [160, "room", 9]]
    actions = [*HELLO, command(20, Op.TIME), *pulses]
    (result,) = run_in_vm(board, {"end_ms": 300, "actions": actions})
    events = [(ms, decode_event(bytes.fromhex(text))) for ms, text in of(result, "event")]
    clock = int.from_bytes(next(e.payload for _, e in events if isinstance(e, Reply)), "little")
    asked = next(ms for ms, e in events if isinstance(e, Reply))
    ((reported, pulse),) = [(ms, e) for ms, e in events if isinstance(e, IndexPulse)]  # the bounce is none
    assert reported >= 160 and pulse.number == 1
    assert abs((pulse.stamp_us - clock) / 1000 - (100 - asked)) < 1.5


def test_brc_is_pulsed_through_the_transistor(board: Path) -> None:
    actions = [*HELLO, command(20, Op.BRC, 200, 3, 100), command(30, Op.BRC, 200, 1, 0)]
    (result,) = run_in_vm(board, {"end_ms": 1200, "actions": actions})
    assert sorted(reply.status for reply in replies_of(result)) == [Status.OK, Status.BUSY]
    edges = of(result, "pin")
    assert [text for _, text in edges] == ["6=1", "6=0"] * 3
    gaps = [round(b - a, -1) for (a, _), (b, _) in itertools.pairwise(edges)]
    assert gaps == [200, 100, 200, 100, 200]


def test_who_works_on_the_board_finds_a_prompt_and_a_patient_watchdog(board: Path) -> None:
    actions = [*HELLO, [30, "rx", DRIVE], [100, "interrupt", 0]]
    (result,) = run_in_vm(board, {"end_ms": 500, "actions": actions})
    assert result["ended"] == "prompt"
    assert texts(result, "uart") == [DRIVE, STOP, STOP, STOP]
    assert [text for _, text in at_boot(result, "wdt") + of(result, "wdt")] == ["1000", "600000"]
    assert result["fed"] > 50


def test_a_fault_stops_the_robot_three_times_and_restarts_the_board(board: Path) -> None:
    """Of the radio's handler, whose exception MicroPython would print and go on; and of the loop."""
    actions = [[*HELLO, [30, "rx", DRIVE], [100, fault, 0]] for fault in ("break", "fault")]
    for result in run_in_vm(board, *[{"end_ms": 2000, "actions": action} for action in actions]):
        (_, *stops), ((reset, _),) = of(result, "uart"), of(result, "reset")
        assert texts(result, "uart") == [DRIVE, STOP, STOP, STOP]
        assert stops[0][0] < 110 and stops[2][0] < reset


def test_index_pulses_of_a_busy_loop_come_late_and_are_lost_beyond_the_scheduler(board: Path) -> None:
    """Pin interrupts are scheduled on the ESP32: a stamp is only as good as the loop is quick."""
    waiting = [[200 + 60 * n, "pulse", 0] for n in range(10)]
    actions = [*HELLO, [100, "busy", 900], *waiting, [1500, "pulse", 0]]
    (result,) = run_in_vm(board, {"end_ms": 2000, "actions": actions})
    pulses = events_of(result)
    # All eight that waited bear the same moment, so seven are taken for bounces.
    assert [pulse.number for pulse in pulses if isinstance(pulse, IndexPulse)] == [1, 2]


def test_an_invalid_configuration_drives_nothing_and_says_so(board: Path) -> None:
    driving = [
        command(20, Op.ARM, 0), command(21, Op.BRC, 9, 1, 0), command(22, Op.LOOPBACK, 9),
        command(23, Op.BAUD, 9600),
    ]  # fmt: skip
    plan = {"end_ms": 600, "actions": [[10, "connect", 247], *driving, [30, "rx", DRIVE]]}
    wrong = ("{", json.dumps({**CONFIG, "baud": 115201}), json.dumps({**CONFIG, "uart_tx": 5}))
    for result in run_in_vm(board, *[{**plan, "files": {"bridge.json": text}} for text in wrong]):
        assert [r.status for r in replies_of(result)] == [Status.NOT_PROVISIONED] * 4
        assert of(result, "uart") == []
        info = BridgeInfo.from_bytes(bytes.fromhex(result["info"]))
        assert info.name == "tagid-setup" and Flag.PROVISIONED not in info.flags


IDLE_MS = [round(m * 60_000) for m in (9, 17, 27)] + [round(d * 86_400_000) for d in (6.3, 12.5, 30)]
"""Ticks of us compare rightly over 8.9 min and wrap after 17.9 min, ticks of ms 6.2 and 12.4 days."""
IDLE_AT_MS = 1600
BOUNCE_MS = (1 << 30) // 1000 - 1670
"""After this idle time a pulse comes 20 ms after the previous one, but for a whole period of ticks_us."""


def session(at: float) -> list[list[Any]]:
    """Every kind of action: pairing, dead-man, ARM and DISARM, BRC, index pulse, short pieces, loop-back."""
    return [
        [at, "connect", 247], [at + 10, "passkey", 0], [at + 50, "trust", 1], command(at + 60, Op.TIME),
        [at + 70, "rx", DRIVE * 12], command(at + 700, Op.ARM, 400), [at + 710, "rx", DRIVE],
        command(at + 740, Op.HEARTBEAT), command(at + 800, Op.DISARM), command(at + 980, Op.BRC, 50, 2, 30),
        [at + 1000, "pulse", 0], [at + 1000.8, "pulse", 0], [at + 1200, "robot", "1301"],
        [at + 1203, "robot", "1302"], command(at + 1250, Op.LOOPBACK, 16),
    ]  # fmt: skip


def without_idle_time(result: dict[str, Any], idle_ms: int) -> list[tuple[float, str, Any]]:
    """What a bridge did after it idled (the scenario's clock stood still); its own stamps less that time."""
    log: list[tuple[float, str, Any]] = []
    for ms, what, text in result["log"]:
        detail: Any = text
        if ms < IDLE_AT_MS:
            continue
        if what == "event":
            detail = decode_event(bytes.fromhex(text))
            if isinstance(detail, Reply) and detail.op in (Op.TIME, Op.HEARTBEAT):
                uptime_us = int.from_bytes(detail.payload, "little") - idle_ms * 1000
                detail = replace(detail, payload=uptime_us.to_bytes(8, "little"))
            elif isinstance(detail, IndexPulse):
                detail = replace(detail, stamp_us=detail.stamp_us - idle_ms * 1000)
        log.append((ms, what, detail))
    return log


def test_nothing_depends_on_how_long_the_bridge_idled(board: Path) -> None:
    """Whatever is done after minutes or weeks goes as after ten seconds, to the microsecond."""
    # Before the used bridge idles, its link is lost with a short piece waiting, and a pass-key fails.
    lost = [[1500, "room", 0], [1505, "robot", "1303"], [1530, "lose", 0], [1535, "room", 99]]
    failed = [[1540, "connect", 247], [1550, "passkey", 0], [1570, "lose", 0]]
    stranger = [[3100, "lose", 0], [3200, "connect", 247], [3250, "busy", 59_850]]

    def plans(idle_ms: int) -> list[dict[str, Any]]:
        idle = [IDLE_AT_MS, "idle", idle_ms]
        used = [*session(10), *lost, *failed, idle, *session(1700), *stranger]
        fresh = [*HELLO, idle, *session(1700)[3:]]
        return [
            {"end_ms": 63_300, "round_us": 1500, "actions": used},
            {"end_ms": 3100, "round_us": 1500, "actions": fresh},
        ]

    idles = [10_000, *IDLE_MS, BOUNCE_MS]
    results = run_in_vm(board, *[plan for idle_ms in idles for plan in plans(idle_ms)])
    logs = [
        [without_idle_time(result, idle_ms) for result in results[2 * n : 2 * n + 2]]
        for n, idle_ms in enumerate(idles)
    ]
    for idle_ms, log in zip(idles, logs, strict=True):
        assert log == logs[0], f"after {idle_ms} ms"
    stops, pattern = [STOP] * 3, bytes(range(0x40, 0x50)).hex()
    for log in logs[0]:
        wire = "".join(text for _, what, text in log if what == "uart")
        assert wire == "".join((DRIVE * 12, *stops, DRIVE, *stops, pattern))
        assert [text for _, what, text in log if what == "bytes"] == ["13011302"]
        pulses = [event for _, _, event in log if isinstance(event, IndexPulse)]
        assert len(pulses) == 1 and pulses[0].age_us < 5000
        ((quiet, _),) = [(ms, e) for ms, _, e in log if isinstance(e, Reply) and e.op == Op.LOOPBACK]
        assert 100 < quiet - 2950 < 110
    shown, ended = ([ms for ms, what, _ in logs[0][0] if what == name] for name in ("passkey", "disconnect"))
    assert len(shown) == 1 and len(ended) == 1 and 60_000 < ended[0] - 3200 < 60_010


def test_a_pulse_and_a_fault_tell_how_long_ago_it_was(board: Path) -> None:
    """At most what 32 bits hold: 71 min and 49.7 days. The pulse waits behind 16 replies."""
    idles = [17 * 60_000, IDLE_MS[3], 50 * 86_400_000]
    replies = [command(21 + n / 10, Op.TIME) for n in range(16)]
    waiting = [*HELLO, [20, "room", 0], *replies, [30, "pulse", 0]]
    plans = [
        {"end_ms": 900, "actions": [*waiting, [40, "idle", idle_ms], [60, "room", 99], [100, "fault", 0]]}
        for idle_ms in idles
    ]
    for idle_ms, result in zip(idles, run_in_vm(board, *plans), strict=True):
        *_, pulse, fault = events_of(result)
        assert isinstance(pulse, IndexPulse) and isinstance(fault, Tripped)
        assert pulse.age_us == pytest.approx(min((idle_ms + 30) * 1000, 0xFFFFFFFF), abs=3000)
        assert pulse.stamp_us < 1_000_000
        assert fault.silent_ms == min(idle_ms, 0xFFFFFFFF) or 0 < fault.silent_ms - idle_ms < 500


def test_only_the_clock_reads_ticks() -> None:
    """And its mark, a minute old at most and renewed in every round, is never too old."""
    assert 60_000 + settings.NUMBERS["watchdog_ms"][2] < (1 << 29) / 1000
    for source in (SOURCE / "tagid_bridge").glob("*.py"):
        assert ("ticks" in source.read_text()) == (source.name == "clock.py"), source.name


def test_nothing_of_a_lost_link_reaches_the_next_one(board: Path) -> None:
    """The next computer is trusted before the loop has seen that the last one is gone."""

    def change(ms: float) -> list[list[Any]]:
        return [[ms, "lose", 0], [ms, "connect", 247], [ms, "again", 0], [ms, "room", 99]]

    waiting = [[20, "room", 0], [21, "robot", "1301"], command(22, Op.TIME, seq=3)]
    pulsing = [command(30, Op.BRC, 100, 1, 0, seq=4), command(50, Op.ARM, 5000, seq=5), *change(50)]
    after = [[60, "rx", "80"], command(70, Op.BRC, 50, 1, 0, seq=6)]
    looping = [command(20, Op.LOOPBACK, 16, seq=7), *change(40)]
    first, second = run_in_vm(
        board,
        {"end_ms": 400, "actions": [*HELLO, *waiting, *pulsing, *after]},
        {"end_ms": 400, "actions": [*HELLO, *looping, *after]},
    )
    for result in (first, second):
        assert [(r.seq, r.status) for r in replies_of(result)] == [(6, Status.OK)]
        assert of(result, "bytes") == []
        assert "80" in texts(result, "uart")


def test_arguments_are_bounded_as_the_protocol_says(board: Path) -> None:
    good, bad = Status.OK, Status.BAD_ARGUMENT
    bounds: list[tuple[tuple[int, ...], Status]] = [
        ((Op.BAUD, 299), bad), ((Op.BAUD, 115201), bad), ((Op.BAUD, 300), good), ((Op.BAUD, 115200), good),
        ((Op.LOOPBACK, 0), bad), ((Op.LOOPBACK, 513), bad),
        ((Op.BRC, 0, 1, 0), bad), ((Op.BRC, 2001, 1, 0), bad), ((Op.BRC, 9, 0, 0), bad),
        ((Op.BRC, 9, 6, 0), bad), ((Op.BRC, 9, 1, 2001), bad),
        ((Op.ARM, 99), bad), ((Op.ARM, 5001), bad), ((Op.ARM, 100), good), ((Op.ARM, 5000), good),
        ((Op.BAUD, 9600), Status.BUSY), ((Op.LOOPBACK, 1), Status.BUSY),
    ]  # fmt: skip
    asked = [(encode(Op.ECHO, 0, data=bytes(241)), good), (encode(Op.ECHO, 0, data=bytes(242)), bad)]
    asked += [(encode(Op(op), 0, *arguments), status) for (op, *arguments), status in bounds]
    asked += [(encode(Op.TIME, 0) + b"x", bad), (bytes((11, 0)), Status.UNKNOWN)]
    actions = [[20 + 4 * n, "command", frame.hex()] for n, (frame, _) in enumerate(asked)]
    (result,) = run_in_vm(board, {"end_ms": 200, "actions": [*HELLO, *actions]})
    statuses = [(r.op, r.status) for r in replies_of(result)]
    assert statuses == [(frame[0], status) for frame, status in asked]


def test_the_status_counts_and_each_loss_is_told_once(board: Path) -> None:
    actions = [
        *HELLO, [20, "rx", DRIVE], [100, "busy", 200], [500, "rx", DRIVE], [600, "robot", "1301"],
        [700, "pulse", 0], [800, "command", "ff"], [900, "room", 0], [905, "robot", "13"], [920, "room", 99],
        command(1000, Op.STATUS),
    ]  # fmt: skip
    (result,) = run_in_vm(board, {"end_ms": 1100, "actions": actions})
    events = events_of(result)
    assert [e for e in events if isinstance(e, Overflow)] == [Overflow("to the robot", 5)]
    (reply,) = (e for e in events if isinstance(e, Reply))
    status = BridgeStatus.from_bytes(reply.payload)
    assert (status.state, status.trips, status.index_count, status.index_lost) == ("tripped", 1, 1, 0)
    stops = len(bytes.fromhex(STOP))
    assert (status.to_robot, status.from_robot) == (5 + 6 * stops, 3)
    assert (status.lost_to_robot, status.lost_from_robot, status.bad_commands) == (5, 0, 1)
    assert (status.mtu, status.baud, status.queue_free) == (247, 115200, 1024)
    assert 200 <= status.longest_round_ms < 205 and status.notify_retries > 0


def test_pulses_that_nobody_takes_are_lost_from_the_oldest_on(board: Path) -> None:
    """Sixteen replies wait for the radio, then sixteen pulses."""
    replies = [command(21 + n / 10, Op.TIME) for n in range(16)]
    pulses = [[100 + 60 * n, "pulse", 0] for n in range(20)]
    actions = [*HELLO, [20, "room", 0], *replies, *pulses, [1400, "room", 99]]
    (result,) = run_in_vm(board, {"end_ms": 1600, "actions": actions})
    events = events_of(result)
    assert [e.number for e in events if isinstance(e, IndexPulse)] == list(range(5, 21))
    assert [e for e in events if isinstance(e, Overflow)] == [Overflow("index pulses", 4)]


def test_a_ring_keeps_bytes_in_order_and_takes_all_or_nothing() -> None:
    random.seed(5)
    ring, model = Ring(20), b""
    for _ in range(3000):
        data = random.randbytes(random.randrange(0, 22))
        assert ring.put(data) == (len(model) + len(data) <= 20)
        model += data if len(model) + len(data) <= 20 else b""
        assert (len(ring), ring.free(), ring.peek(99), ring.peek(7)) == (
            len(model), 20 - len(model), model, model[:7],
        )  # fmt: skip
        count = random.randrange(0, 22)
        ring.drop(count)
        model = model[count:]
        if random.random() < 0.02:
            ring.clear()
            model = b""


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
