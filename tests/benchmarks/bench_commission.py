"""Commissions random emulated rigs with scripted answers, and rigs with planted faults.

    python tests/benchmarks/bench_commission.py [RIGS] [FAULT_RIGS]

For every rig it prints how far each value is from the truth, in units of its own standard error; at the end
the share within two of them and within the limits. Of the planted faults it prints which code the steps
report; those of the test card need a reading and are left to `tagid commission` on the emulator.
"""

from __future__ import annotations

import math
import os
import sys
import tempfile
from pathlib import Path
from urllib.parse import quote

import numpy as np

TAPE_M = 0.001
LIMITS = {"path_delay_ps": 15.0, "axis_distance_m": 2e-3, "antenna_height_m": 20e-3, "period_s": 1e-3}
"""Largest errors wanted; that of the period is relative."""
PLANTED = {
    "cable": "cable",
    "loose-antenna": "loose-antenna",
    "polarisation": "polarisation",
    "gain": "gain",
    "other-radar": "other-radar",
    "microwave": "microwave",
    "person": "person",
    "axis": "axis",
    "slip": "slip",
}
"""Fault of the emulated rig: code of the row that names it."""


def commissioned(text: str, folder: Path, turning: bool = True) -> tuple[dict, list[str]]:
    """(values by name, codes of the faults) of a rig, up to the turning."""
    os.environ |= {"TAGID_DATA": str(folder), "TAGID_CONFIG": str(folder / "config.toml")}
    from tagid.commissioning.bench import Bench
    from tagid.commissioning.steps import run_step, step_named
    from tagid.config import load_config
    from tagid.simulate.rig import NOMINAL_DISTANCE_M, parse_rig

    rig = parse_rig(text)
    rng = np.random.default_rng([rig.seed, 7])
    tape = {
        "target_distance_m": math.hypot(rig.axis_distance_m, rig.antenna_height_m)
        + TAPE_M * rng.standard_normal(),
        "axis_distance_m": NOMINAL_DISTANCE_M,
        "antenna_height_m": rig.antenna_height_m + TAPE_M * rng.standard_normal(),
        "error_m": TAPE_M,
    }
    values, codes = {}, []
    for step, scene in (("room", "empty"), ("target", "target"), ("turning", "test-card"))[: 2 + turning]:
        config = load_config(
            {
                "radar.integration": 15,
                "radar.url": f"emulator://{scene}?rig={quote(text, safe='')}&seed={rng.integers(1000)}",
                "motion.url": f"free?rpm={60 / rig.period_s:.2g}",
            }
        )
        report = run_step(step_named(step), Bench(config, tape, scans=64))
        values |= report.values
        codes += report.faults
    return values, codes


def main() -> None:
    rigs, fault_rigs = (int(word) for word in (*sys.argv[1:], "10", "1")[:2])
    from tagid.simulate.rig import parse_rig

    normal: dict[str, list[tuple[float, float]]] = {}
    alarms = 0
    for seed in range(rigs):
        text = f"realistic?seed={seed}"
        with tempfile.TemporaryDirectory() as folder:
            values, codes = commissioned(text, Path(folder))
        rig = parse_rig(text)
        truth = {
            "path_delay_ps": rig.cable_delay_ps,
            "axis_distance_m": rig.axis_distance_m,
            "antenna_height_m": rig.antenna_height_m,
            "period_s": rig.period_s,
            "system_gain_db": rig.gain_db,
            "speed_variation": rig.speed_variation,
        }
        alarms += bool(codes)
        line = [f"rig {seed}:"]
        for name, true in truth.items():
            if name in values:
                error, sigma = values[name].value - true, values[name].sigma
                normal.setdefault(name, []).append(
                    (error / (true if name == "period_s" else 1), error / sigma)
                )
                line.append(f"{name} {error:+.3g} ({error / sigma:+.1f} sigma)")
        print(*line, f"faults {codes}" if codes else "", flush=True)
    for name, found in normal.items():
        errors, ratios = np.array(found).T
        limit = LIMITS.get(name)
        inside = "" if limit is None else f", {np.mean(np.abs(errors) <= limit):.0%} within {limit:g}"
        print(
            f"{name}: {np.mean(np.abs(ratios) <= 2):.0%} of {len(ratios)} within 2 sigma, "
            f"largest error {np.abs(errors).max():.3g}{inside}",
            flush=True,
        )
    print(f"false alarms: {alarms} of {rigs} rigs", flush=True)
    for fault, code in PLANTED.items():
        for seed in range(fault_rigs):
            with tempfile.TemporaryDirectory() as folder:
                turning = fault in ("axis", "slip")
                codes = commissioned(f"realistic?seed={seed}&fault={fault}", Path(folder), turning)[1]
            print(
                f"fault {fault}, rig {seed}: {'named' if code in codes else 'NOT NAMED'} ({codes})",
                flush=True,
            )


if __name__ == "__main__":
    main()
