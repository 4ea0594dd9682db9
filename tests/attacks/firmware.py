"""Attacks on the bridge's firmware, compiled and run in MicroPython; its ticks wrap at 2^30."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from firmware_tools.build import compile_firmware, write_build
from tagid.motion.bridge.protocol import Op, encode
from tests.attacks import Outcome, attack
from tests.firmware.microvm import run_in_vm

_GUARD = "tests/firmware/test_bridge_vm.py::test_nothing_depends_on_how_long_the_bridge_idled"
_MINUTE_MS, _DAY_MS = 60_000, 86_400_000


def _count(board: Path, idles_ms: list[float], actions: list[list[Any]], what: str, text: str) -> int:
    """After how many idle times the firmware does something in answer to the actions."""
    write_build(compile_firmware(), board)
    config = {"name": "robot-7", "passkey": "482913", "uart_tx": 4, "uart_rx": 5}
    (board / "bridge.json").write_text(json.dumps(config))
    plans = [
        {"end_ms": 5100, "round_us": 2000, "actions": [[20, "idle", round(idle_ms)], *actions]}
        for idle_ms in idles_ms
    ]
    results = run_in_vm(board, *plans)
    return sum([what, text] in [entry[1:] for entry in result["log"]] for result in results)


@attack(
    "F2",
    "bridge: after 9 to 18 minutes of silence nothing is forwarded to the robot",
    before="forwarded after 7 of 20 idle times",
    test=_GUARD,
)
def first_byte_after_silence(folder: Path) -> Outcome:
    """Arm, send a byte, and a heartbeat every 100 ms for 5 s, after 1 minute to 30 days of silence."""
    minutes = [1, 5, 8, 8.9, 9, 9.5, 12, 15, 17, 17.8, 18, 20, 26, 27, 30, 35, 100]
    idles_ms = [m * _MINUTE_MS for m in minutes] + [6.3 * _DAY_MS, 12.5 * _DAY_MS, 30 * _DAY_MS]
    beats = [[ms, "command", encode(Op.HEARTBEAT, 2).hex()] for ms in range(200, 5000, 100)]
    arm = [50, "command", encode(Op.ARM, 1, 400).hex()]
    actions = [[30, "connect", 247], [40, "trust", 1], arm, [60, "rx", "80"], *beats]
    forwarded = _count(folder, idles_ms, actions, "uart", "80")
    return Outcome(f"forwarded after {forwarded} of {len(idles_ms)} idle times", forwarded == len(idles_ms))


@attack(
    "F12",
    "bridge: no new computer can be paired from day 6.2 to 12.4",
    before="pass-key shown after 8 of 14 uptimes",
    test=_GUARD,
)
def new_computer_after_days(folder: Path) -> Outcome:
    """A request for the pass-key after a quarter of an hour to 30 days."""
    days = [0.01, 1, 6, 6.2, 6.3, 7, 10, 12, 12.4, 12.5, 13, 18.6, 19, 30]
    actions = [[30, "connect", 247], [40, "passkey", 0]]
    shown = _count(folder, [day * _DAY_MS for day in days], actions, "passkey", "482913")
    return Outcome(f"pass-key shown after {shown} of {len(days)} uptimes", shown == len(days))
