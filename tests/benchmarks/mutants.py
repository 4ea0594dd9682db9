"""Mutation testing: how many broken lines of a module its tests notice.

    python tests/benchmarks/mutants.py assembler --sample 80 --seed 1

Each mutant is one small change (a comparison, an operator, a number, a deleted `not`) made by cosmic-ray
(pip install cosmic-ray) in a copy of the tree; the module's tests run on it, and a mutant that fails none
survives. Without --sample every mutant of the module is tried, which takes hours. Survivors are listed with
their lines, so that each can be judged: a gap in the tests, or a change that makes no difference.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TARGETS = {
    "assembler": (
        "tagid/radar/assembler.py",
        "tests/property/test_radar_assembler.py tests/protocol/test_radar_client.py",
    ),
    "clock": ("tagid/angles/clock.py", "tests/unit/test_motion_clock_angles.py"),
    "period": ("tagid/angles/period.py", "tests/unit/test_motion_period.py"),
    "journal": (
        "tagid/storage/journal.py",
        "tests/unit/test_storage_journal.py tests/property/test_storage_journal_any.py",
    ),
    "decision": ("tagid/tags/reading/decision.py", "tests/unit/test_tags_vote.py"),
    "operator": ("tagid/imaging/operator.py", "tests/unit/test_imaging_operator.py"),
    "job": ("tagid/batch/job.py", "tests/unit/test_batch_fingerprint.py"),
    "work": ("tagid/batch/work.py", "tests/report/test_report_runs.py"),
}
"""Name -> (module, the tests that are to notice)."""


def main() -> int:
    """Try mutants of one module; returns 1 where fewer than --aim percent are killed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("target", choices=TARGETS)
    parser.add_argument("--sample", type=int, help="mutants, chosen at random")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=600.0, help="stop after so long")
    parser.add_argument("--aim", type=float, default=85.0, help="percent to be killed")
    asked = parser.parse_args()
    module, tests = TARGETS[asked.target]
    with tempfile.TemporaryDirectory(prefix="tagid-mutants-") as name:
        copy = Path(name)
        _copy_tree(copy)
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-p", "no:cacheprovider"]
        command += tests.split()
        began = time.monotonic()
        if subprocess.run(command, cwd=copy, env=_environment(copy), stdout=subprocess.DEVNULL).returncode:
            sys.stderr.write("the tests fail without a mutant\n")
            return 2
        limit = 30 + 5 * (time.monotonic() - began)
        session = _session(copy, module, " ".join(command), limit, asked)
        run = [sys.executable, "-m", "cosmic_ray.cli", "exec", "mutants.toml", session.name]
        with contextlib.suppress(subprocess.TimeoutExpired):
            subprocess.run(run, cwd=copy, env=_environment(copy), timeout=asked.minutes * 60, check=False)
        return _report(session, asked)


def _copy_tree(copy: Path) -> None:
    files = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    for name in filter(None, files.decode().split("\0")):
        target = copy / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, target, follow_symlinks=False)
    for built in (ROOT / "tagid").rglob("*.so"):
        shutil.copy2(built, copy / built.relative_to(ROOT))


def _environment(copy: Path) -> dict[str, str]:
    return {
        **os.environ,
        "PYTHONPATH": str(copy),
        "PYTHONDONTWRITEBYTECODE": "1",
        "OMP_NUM_THREADS": "1",
    }


def _session(copy: Path, module: str, command: str, limit: float, asked: argparse.Namespace) -> Path:
    (copy / "mutants.toml").write_text(
        f"[cosmic-ray]\nmodule-path = {json.dumps(module)}\ntimeout = {limit:.1f}\nexcluded-modules = []\n"
        f'test-command = {json.dumps(command)}\n[cosmic-ray.distributor]\nname = "local"\n'
    )
    session = copy / "mutants.sqlite"
    run = [sys.executable, "-m", "cosmic_ray.cli", "init", "mutants.toml", session.name]
    subprocess.run(run, cwd=copy, env=_environment(copy), check=True)
    with sqlite3.connect(session) as db:
        jobs = sorted(row[0] for row in db.execute("SELECT job_id FROM work_items"))
        order = db.execute("SELECT job_id FROM mutation_specs ORDER BY start_pos_row, start_pos_col, "
                           "operator_name, occurrence").fetchall()  # fmt: skip
        chosen = [row[0] for row in order if row[0] in set(jobs)]
        print(f"{module}: {len(chosen)} mutants")
        if asked.sample and asked.sample < len(chosen):
            kept = set(random.Random(asked.seed).sample(range(len(chosen)), asked.sample))
            for index, job in enumerate(chosen):
                if index not in kept:
                    db.execute("DELETE FROM mutation_specs WHERE job_id = ?", (job,))
                    db.execute("DELETE FROM work_items WHERE job_id = ?", (job,))
    return session


def _report(session: Path, asked: argparse.Namespace) -> int:
    with sqlite3.connect(session) as db:
        # A time limit may have ended the run; what was tried counts.
        rows = db.execute(
            "SELECT m.operator_name, m.start_pos_row, r.test_outcome, r.diff FROM work_results r"
            " JOIN mutation_specs m ON m.job_id = r.job_id ORDER BY m.start_pos_row"
        ).fetchall()
    survivors = [row for row in rows if "SURVIVED" in str(row[2]).upper()]
    for operator, line, _, diff in survivors:
        changed = [
            text for text in str(diff).splitlines() if text[:1] in "+-" and text[:3] not in ("+++", "---")
        ]
        print(f"line {line}, {operator.rpartition('/')[2]}:")
        for text in changed:
            print(f"    {text}")
    killed = len(rows) - len(survivors)
    share = 100 * killed / max(len(rows), 1)
    print(f"{asked.target}: {killed} of {len(rows)} killed ({share:.0f} %)")
    return int(share < asked.aim)


if __name__ == "__main__":
    raise SystemExit(main())
