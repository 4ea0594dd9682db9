"""A new user's day in four roles: commands, the station's page, and what became of the first walk's findings.

Every role begins with an empty folder, registry and configuration, on emulated devices. A finding is gone
where each of its checks holds in what is printed or shown. The pictures of the page are taken at three sizes
in both themes; with `--before CHECKOUT` that checkout's page is used and taken likewise.
"""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from tests.benchmarks.provenance import ROOT
from tests.benchmarks.run import Run
from tests.benchmarks.tables import LONG, Table
from tests.benchmarks.walk_findings import FINDINGS, Seen
from tests.benchmarks.walk_roles import ROLES, base_needs
from tests.benchmarks.walk_station import at_the_station, sheet
from tests.benchmarks.walk_steps import Step, Walk

PAGE = "operator, on the page"
QUICK = ("engineer", "batch clerk")
OUTCOME = 84
"""Most characters of an outcome."""
QUIET = ("read ", "look ", "open report", "tagid simulate ")
"""Beginnings of steps that only a check needs."""
PROGRESS = re.compile(r"(record|image|identify|measuring|target|empty scene|volume|training|If its cable)\b")
"""Beginnings of lines that say nothing of the outcome."""
END_OF_SCREEN = "\x1b[?1049l"
"""With which a terminal goes back to what it showed before the live view."""
SHOWN = {
    "demo", "identify", "explain", "half", "rpm-12", "axis-10cm", "unenrolled",
    "design-8", "template", "enroll", "enrolled", "undo", "calibrate-2",
    "bp", "progress", "dataset", "fit", "report", "resume", "watch",
    "no-radar", "scan-page", "refused", "enroll-done", "report-page", "replay", "drag", "settings",
}  # fmt: skip
"""Steps that the page shows; the CSV files have those of the longer roles, too."""
PICTURES = """![The page before: each view on three screens, light and dark](../pictures/walk-before.png)
![The page after, with the same rows and those of new views](../pictures/walk-after.png)"""
SCREENS = "phone 390 x 844, tablet 1180 x 820, desk 1440 x 900, light and dark"


def add_options(parser: argparse.ArgumentParser) -> None:
    """The checkout of the walk before, and where the full pictures go."""
    parser.add_argument("--before", type=Path, help="checkout with compiled loops: its page, too")
    parser.add_argument("--shots", type=Path, help="folder of the pictures at their full size")


def steps_of(tree: Path, role: str, folder: Path, shots: Path) -> dict[str, Any]:
    """What is done and seen in one role in one checkout."""
    one = Walk(tree, folder)
    if role == PAGE:
        one.note("needs", "read pyproject.toml", " ".join(base_needs(tree)))
        at_the_station(one, shots)
    else:
        ROLES[role](one)
    return one.kept()


def walk(run: Run) -> Iterator[Table]:
    """A table for each role, and the findings."""
    run.seeds = "0 to 4"
    before = run.options.before.resolve() if run.options.before else None
    trees = {"before": before, "after": ROOT} if before else {"after": ROOT}
    # Byte code is compiled once, as in any installation, whatever the surroundings say of it.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = str(run.folder / "pyc")
    shots = (run.options.shots or run.folder / "shots").resolve()

    def walked(job: tuple[str, str]) -> dict[str, Any]:
        when, role = job
        run.say(f"{when}: {role}")
        return steps_of(trees[when], role, run.folder / f"{when}-{role.replace(' ', '-')}", shots / when)

    steps: dict[str, list[Step]] = {when: [] for when in trees}
    for role in QUICK if run.quick else (*ROLES, PAGE):
        jobs = [(when, role) for when in trees if when == "after" or role == PAGE]
        done = {
            when: [Step(**one) for one in found["steps"]]
            for (when, _), found in run.each(walked, jobs).items()
        }
        for when, some in done.items():
            steps[when] += some
        yield table_of(role, done["after"], done.get("before", []))
    if run.pictures is not None:
        for when in trees:
            sheet(shots / when, run.pictures / f"walk-{when}.png", f"The station's page {when}: {SCREENS}")
    if not run.quick:
        yield findings_of(Seen(steps["after"]))


def table_of(role: str, now: Sequence[Step], before: Sequence[Step]) -> Table:
    """A row for each command of a role; a page shows some of many."""
    old = {step.key: step for step in before}
    steps = [step for step in now if not step.shown.startswith(QUIET) and not step.key.startswith("wide-")]
    if len(steps) <= LONG:
        steps = [step for step in steps if step.key in SHOWN]
    rows: list[tuple[object, ...]] = []
    for step in steps:
        took = f"{step.seconds:.1f}"
        if before:
            then = old.get(step.key)
            was = (f"{then.seconds:.1f}", outcome(then)) if then else ("-", "-")
            rows.append((step.shown, took, outcome(step), *was))
        elif step.code is None:
            rows.append((step.shown, took, "-", "-", outcome(step)))
        else:
            rows.append(
                (f"`{short(step.shown).strip()}`", took, f"{step.cpu_s:.1f}", step.code, outcome(step))
            )
    columns = ("command", "s", "user CPU s", "exit code", "outcome")
    if before:
        columns = ("act", "s", "outcome", "s before", "outcome before")
    shown = {f"`{short(step.shown).strip()}`" for step in now if step.key in SHOWN}
    note = f"### {role.capitalize()}"
    return Table(
        columns, rows, note, shown=lambda row: row[0] in shown, name=role.replace(",", "").replace(" ", "-")
    )


def outcome(step: Step) -> str:
    """The line that says what came of it: an error, a problem, or the first one."""
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", step.text.rpartition(END_OF_SCREEN)[2])
    if text.lstrip().startswith("{"):
        return "a JSON document"
    lines = [short(line) for line in text.splitlines() if re.search(r"[A-Za-z]", line)]
    lines = [line for line in lines if not PROGRESS.match(line)]
    first = next((line for line in lines if line.startswith(("error:", "problem"))), (lines or ["done"])[0])
    if first.startswith(("UNKNOWN TAG", "NO TAG")) and len(lines) > 1:
        first = f"{first.partition(' TAG')[0]} TAG, {lines[1]}"
    return first if len(first) <= OUTCOME else f"{first[: OUTCOME - 1].rsplit(' ', 1)[0]} …"


def short(text: str) -> str:
    """A command or a line without what differs from run to run."""
    text = re.sub(r"(scan|report)-\d{8}-\d{6}", r"\1-TIME", " ".join(text.replace("━", "").split()))
    return re.sub(r"127\.0\.0\.1:(?!9\b|21999)\d+", "127.0.0.1:PORT", text)


def findings_of(now: Seen) -> Table:
    """A row for each finding."""
    rows = []
    for one in FINDINGS:
        rows.append((one.number, one.what, one.before, one.state(now), one.how))
    gone = sum(row[3] == "gone" for row in rows)
    columns = ("finding", "what", "before", "now", "checked by")
    note = f"### The findings of the first walk\n\n{gone} of {len(rows)} are gone."
    return Table(columns, rows, note, name="findings", shown=lambda row: True, below=PICTURES)
