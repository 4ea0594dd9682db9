"""Objects that had no part in making the reader, read as an operator reads them: file, then answer.

    python tests/benchmarks/unseen_objects.py --out build/unseen
    python tests/benchmarks/unseen_bodies.py --set sealed --write docs/results

Blind, with nothing but the built-in layouts; with the untagged body enrolled from three captures; with the
tagged object enrolled from three. Objects of development and opened ones served to find faults, sealed ones
are only reported. Every answer becomes a line of a JSONL file in --work, so that a run can be stopped and
continued; answers of another version of the reader are not used again. `--grid` reads each tagged object at
every SNR and number of views, everything else alike, and lists where more signal made an answer worse.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import cache
from itertools import pairwise
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
from bodies import cell, most, reader_hash
from provenance import ROOT, commit
from unseen_objects import DEVELOPMENT, OBJECTS, OPENED, ROUND, SEALED
from unseen_scenes import Circumstances, Recording, base_of, drawn, recorded, truth_of

from tagid.errors import TagidError
from tagid.pipeline.identify import identify
from tagid.pipeline.load import LoadSettings, load_capture
from tagid.pipeline.measuring import measure, prepare_files, sight, signature
from tagid.pipeline.prepared import PreparedCapture
from tagid.pipeline.settings import ImagingSettings
from tagid.storage.exporters import export
from tagid.tags.bodies.signature import Signature
from tagid.tags.layouts.layout import Layout, builtin_layouts

SETS = {"development": DEVELOPMENT, "opened": OPENED, "sealed": SEALED}
RECORDINGS = (
    Recording(36, 20),
    Recording(36, 10),
    Recording(18, 20),
    Recording(18, 10),
    Recording(24, 20),
    Recording(72, 20),
    Recording(72, 10),
    Recording(12, 20),
    Recording(36, 5),
    Recording(36, 0),
)
BODY_RECORDINGS, OBJECT_RECORDINGS = 6, 2
"""So many of them are read with the body enrolled, and with the object."""
GRID_VIEWS, GRID_SNRS_DB = (12, 18, 24, 36, 72), (0.0, 5.0, 10.0, 15.0, 20.0, 30.0)
MODES = ("blind", "body", "object")
ENROLMENT = Recording(72, 20)
TOGETHER = "two objects"


@dataclass(frozen=True)
class Task:
    """One reading.

    Attributes:
        mode: one of MODES.
        name: object that is recorded.
        known: object whose captures were enrolled, "" for none.
        second: object beside it, "" for none.
        recording: views and SNR.
        number: of the draw.
    """

    mode: str
    name: str
    known: str
    second: str
    recording: Recording
    number: int

    @property
    def key(self) -> str:
        words = (self.mode, self.name, self.known, self.second, self.recording.label, self.number)
        return "/".join(map(str, words))

    @property
    def draw(self) -> str:
        """What the circumstances are drawn from: alike for all views and SNRs."""
        return f"unseen/1/{self.mode}/{self.name}/{self.known}/{self.second}/{self.number}"


@dataclass(frozen=True)
class Answer:
    """What became of one reading; `outcome` is correct, wrong, ambiguous or the code of the refusal."""

    key: str
    outcome: str
    layout: str
    kind: str
    reason: str
    seconds: float


@dataclass(frozen=True, eq=False)
class Known:
    """What an enrolment left: a signature, a layout where the reflectors were seen, or why there is none."""

    signature: Signature | None = None
    layout: Layout | None = None
    reason: str = ""


class Judge:
    """Records, enrols and reads.

    Args:
        folder: of the solved objects.
        polarisation: "V" or "H" of readings with an enrolment, at the antenna's height; "" draws it.
    """

    def __init__(self, folder: Path, polarisation: str = "") -> None:
        self._folder = folder
        self._polarisation = polarisation
        self._known: Callable[[str, str], Known] = cache(self._enrolled)

    def read(self, task: Task) -> Answer:
        """The answer to one recording."""
        where = drawn(task.draw, enrolled=task.mode != "blind")
        known = Known()
        if task.known:
            known = self._known(task.mode, task.known)
            if known.signature is None and known.layout is None:
                return Answer(task.key, "not enrolled", "", "", known.reason, 0.0)
            where = alike(where, self._conditions(task.mode, task.known))
        capture = recorded(self._folder, task.name, task.recording, where, task.second or None)
        layouts = [*builtin_layouts().values(), *([known.layout] if known.layout else [])]
        signatures = [known.signature] if known.signature else []
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "scan.tagid.h5"
            export(capture, path)
            loaded = load_capture(path, LoadSettings())
        begun = time.process_time()
        try:
            answer = identify(PreparedCapture(loaded, ImagingSettings()), layouts, signatures=signatures)
        except TagidError as error:
            return Answer(task.key, "failed", "", "", error.message, time.process_time() - begun)
        seconds = round(time.process_time() - begun, 3)
        reading = answer.reading
        assert reading is not None
        outcome = reading.code.value or reading.status
        if reading.status == "identified":
            outcome = "correct" if reading.layout in right_names(task) else "wrong"
        elif reading.status == "ambiguous":
            outcome = "ambiguous"
        return Answer(task.key, outcome, reading.layout or "", str(reading.kind), reading.reason, seconds)

    def _conditions(self, mode: str, name: str) -> Circumstances:
        """Those of an enrolment, or the same with the polarisation that was asked for."""
        own = conditions(mode, name)
        if self._polarisation in ("", own.polarisation):
            return own
        level = replace(own.acquisition.placement, height_m=0.0)
        return Circumstances(replace(own.acquisition, placement=level), self._polarisation, own.seed)

    def _enrolled(self, mode: str, name: str) -> Known:
        """A body or an object enrolled from three captures, as `tagid enroll` does it."""
        own = self._conditions(mode, name)
        imaging = ImagingSettings()
        with tempfile.TemporaryDirectory() as folder:
            paths = []
            for i in range(3):
                where = alike(drawn(f"unseen/enrol/1/{mode}/{name}/{i}", enrolled=True), own)
                offset = 1e-3 * (2 + 2 * i) * np.exp(2j * np.pi * (i / 3 + 0.1))
                placement = replace(where.acquisition.placement, centre_m=(offset.real, offset.imag))
                where = replace(where, acquisition=replace(where.acquisition, placement=placement))
                paths.append(Path(folder) / f"{i}.tagid.h5")
                export(recorded(self._folder, name, ENROLMENT, where), paths[-1])
            prepared = prepare_files(paths, LoadSettings())
            try:
                if mode == "body":
                    return Known(signature(name, "body", prepared, imaging).signature)
                entry = name.replace("_", "-")
                measured = measure(entry, [sight(one, imaging) for one in prepared], imaging)
            except TagidError as error:
                return Known(reason=error.message)
        joint, estimate = measured.joint, measured.estimate
        # A layout that is enrolled already is not enrolled again under another name.
        layout = estimate.layout if estimate is not None and not truth_of(name) else None
        return Known(None if joint is None else joint.signature, layout, measured.missing)


def conditions(mode: str, name: str) -> Circumstances:
    """Height, polarisation and pulse of the radar with which a body or an object is enrolled and read."""
    return drawn(f"unseen/enrol/1/{mode}/{name}", enrolled=True)


def alike(where: Circumstances, enrolled: Circumstances) -> Circumstances:
    """Circumstances with the radar and the height of an enrolment."""
    own = enrolled.acquisition
    placement = replace(where.acquisition.placement, height_m=own.placement.height_m)
    acquisition = replace(where.acquisition, placement=placement, pulse=own.pulse)
    return Circumstances(acquisition, enrolled.polarisation, where.seed)


def right_names(task: Task) -> set[str]:
    """Names that are right; none for foreign, untagged and several objects."""
    if task.second:
        return set()
    own = {truth_of(task.name)} - {""}
    return own | (
        {task.name.replace("_", "-")} if task.mode == "object" and task.name == task.known else set()
    )


def is_null(task: Task) -> bool:
    """Whether nothing may be named."""
    return not right_names(task)


def tasks(names: Sequence[str], numbers: int, nulls: int) -> list[Task]:
    """Every reading of a set of objects, in an order drawn once."""
    found = []
    for i, recording in enumerate(RECORDINGS):
        for name in names:
            own = range(numbers if truth_of(name) else nulls)
            found += [Task("blind", name, "", "", recording, n) for n in own]
            base = base_of(name)
            if base and i < BODY_RECORDINGS:
                found += [Task("body", name, base, "", recording, n) for n in range(numbers)]
            if base and i < OBJECT_RECORDINGS:
                known = [n for n in names if base_of(n) == base and n != base]
                found += [Task("object", name, one, "", recording, 0) for one in known]
    tagged = [name for name in names if truth_of(name)]
    for recording in RECORDINGS[:3]:
        found += [Task("blind", a, "", b, recording, 0) for a, b in pairwise(tagged)]
    return [found[i] for i in np.random.default_rng(3).permutation(len(found))]


def grid(names: Sequence[str], numbers: int) -> list[Task]:
    """Every tagged object at every number of views and every SNR, blind and with its body."""
    return [
        Task(mode, name, base_of(name) if mode == "body" else "", "", Recording(views, snr), number)
        for number in range(1000, 1000 + numbers)
        for name in names
        if truth_of(name)
        for mode in (("blind",) if base_of(name) in ("", *ROUND) else ("body",))
        for views in GRID_VIEWS
        for snr in GRID_SNRS_DB
    ]


def answered(wanted: Sequence[Task], judge: Judge, path: Path, until: float) -> dict[Task, Answer]:
    """The answers to tasks, from the file or by reading; those that time did not allow are left out."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = path.read_text().splitlines() if path.is_file() else []
    known = {found["key"]: Answer(**found) for found in map(json.loads, lines)}
    with path.open("a") as file:
        for task in wanted:
            if task.key not in known and time.monotonic() < until:
                known[task.key] = answer = judge.read(task)
                file.write(json.dumps(asdict(answer)) + "\n")
                file.flush()
    return {task: known[task.key] for task in wanted if task.key in known}


def kind_of(task: Task) -> str:
    """Row of the tables."""
    if task.second:
        return TOGETHER
    body = task.name.split("_")[0]
    return (
        body if truth_of(task.name) else f"{body}, {'foreign' if OBJECTS[task.name].places else 'untagged'}"
    )


def rows(found: dict[Task, Answer], wanted: Callable[[Task], bool], null: bool) -> list[str]:
    """A table: kinds of objects against recordings, named rightly, or not named."""
    own = {task: answer for task, answer in found.items() if wanted(task)}
    columns = [r for r in RECORDINGS if any(task.recording == r for task in own)]
    lines = ["| | " + " | ".join(r.label for r in columns) + " | wrong |", "|---" * (len(columns) + 2) + "|"]
    for kind in sorted({kind_of(task) for task in own}):
        cells = []
        for recording in columns:
            some = [a for t, a in own.items() if kind_of(t) == kind and t.recording == recording]
            hits = sum(
                (a.outcome not in ("correct", "wrong")) if null else a.outcome == "correct" for a in some
            )
            cells.append(f"{hits}/{len(some)}" if some else "")
        wrong = sum(a.outcome == "wrong" for t, a in own.items() if kind_of(t) == kind)
        lines.append(f"| {kind} | " + " | ".join(cells) + f" | {wrong} |")
    return [*lines, ""]


def share(found: dict[Task, Answer], wanted: Callable[[Task], bool]) -> str:
    """Share of a group that is named rightly, with its interval."""
    own = [answer for task, answer in found.items() if wanted(task)]
    return cell(sum(a.outcome == "correct" for a in own), len(own)) if own else "none read"


def refusals(found: dict[Task, Answer], wanted: Callable[[Task], bool]) -> str:
    """What was said instead of a right name."""
    count = Counter(a.outcome for t, a in found.items() if wanted(t) and a.outcome != "correct")
    return ", ".join(f"{code} {n}" for code, n in count.most_common()) or "none"


def report(found: dict[Task, Answer]) -> list[str]:
    """Tables of a set."""

    def named(mode: str) -> Callable[[Task], bool]:
        return lambda t: t.mode == mode and not is_null(t)

    def at(mode: str, round_: bool, *recordings: Recording) -> Callable[[Task], bool]:
        def inside(t: Task) -> bool:
            own = t.name.split("_")[0] in ROUND
            return named(mode)(t) and own == round_ and t.recording in recordings

        return inside

    lines = []
    titles = {
        "blind": "Blind: tags alone and on bodies",
        "body": "The untagged body enrolled from three captures",
        "object": "The tagged object enrolled from three captures",
    }
    for mode, title in titles.items():
        if not any(named(mode)(task) for task in found):
            continue
        lines += [f"## {title}", "", "Named rightly:", "", *rows(found, named(mode), False)]
        lines += [f"Not named rightly: {refusals(found, named(mode))}.", ""]
    full, half = RECORDINGS[:2], RECORDINGS[2:4]
    lines += [
        "## Groups",
        "",
        "| group | named rightly |",
        "|---|---|",
        f"| blind, tags alone and round bodies, 36 views, 20 and 10 dB | "
        f"{share(found, at('blind', True, *full))} |",
        f"| the same, 18 views | {share(found, at('blind', True, *half))} |",
        f"| blind, other bodies, 36 views, 20 and 10 dB | {share(found, at('blind', False, *full))} |",
        f"| body enrolled, not round, 36 views, 20 and 10 dB | {share(found, at('body', False, *full))} |",
        f"| body enrolled, round, 36 views, 20 and 10 dB | {share(found, at('body', True, *full))} |",
        f"| object enrolled, 36 views, 20 and 10 dB | "
        f"{share(found, lambda t: named('object')(t) and t.recording in full)} |",
        "",
        "## Objects that must not be named",
        "",
    ]
    null = [a for t, a in found.items() if is_null(t)]
    wrong = sum(a.outcome == "wrong" for a in null)
    lines += [f"Named: {wrong} of {len(null)}; 95 % upper bound: {most(wrong, len(null))}. Not named:", ""]
    for mode in MODES:
        own = {t: a for t, a in found.items() if t.mode == mode and is_null(t)}
        if own:
            lines += [f"{mode.capitalize()}:", "", *rows(own, is_null, True)]
    wrong = sum(a.outcome == "wrong" for a in found.values())
    lines += [f"Named wrongly in all: {wrong} of {len(found)}; at most {most(wrong, len(found))}.", ""]
    lines += [f"- {a.key}: {a.layout} ({a.kind})" for a in found.values() if a.outcome == "wrong"]
    return lines


def monotone(found: dict[Task, Answer]) -> list[str]:
    """Rates over the grid, and each place where more signal or views lost a name."""
    by = {(t.mode, t.name, t.number, t.recording): a for t, a in found.items()}
    lines = ["| views | " + " | ".join(f"{s:.0f} dB" for s in GRID_SNRS_DB) + " |"]
    lines += ["|---" * (len(GRID_SNRS_DB) + 1) + "|"]
    for views in GRID_VIEWS:
        some = [[a for k, a in by.items() if k[3] == Recording(views, s)] for s in GRID_SNRS_DB]
        cells = [f"{sum(a.outcome == 'correct' for a in own)}/{len(own)}" for own in some]
        lines.append(f"| {views} | " + " | ".join(cells) + " |")
    lines += [""]
    for (mode, name, number, recording), answer in by.items():
        if answer.outcome != "correct":
            continue
        i, j = GRID_SNRS_DB.index(recording.snr_db), GRID_VIEWS.index(recording.views)
        louder = [Recording(recording.views, s) for s in GRID_SNRS_DB[i + 1 : i + 2]]
        denser = [Recording(v, recording.snr_db) for v in GRID_VIEWS[j + 1 : j + 2]]
        for more in (*louder, *denser):
            later = by.get((mode, name, number, more))
            if later is not None and later.outcome != "correct":
                told = f"{later.outcome}: {later.reason}"
                lines.append(
                    f"- {mode}, {name}, {number}: named at {recording.label}, at {more.label} {told}"
                )
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--set", choices=tuple(SETS), default="development")
    parser.add_argument("--only", nargs="*", help="beginnings of objects' names")
    parser.add_argument("--modes", nargs="*", choices=MODES, default=list(MODES))
    parser.add_argument("--numbers", type=int, default=2, help="recordings of each kind of a tagged object")
    parser.add_argument("--nulls", type=int, default=4, help="of an object without an enrolled tag, blind")
    parser.add_argument("--grid", type=int, default=0, help="draws of the grid instead of the tables")
    parser.add_argument("--polarisation", choices=("", "V", "H"), default="", help="of enrolled readings")
    parser.add_argument("--objects", type=Path, default=ROOT / "build" / "unseen", help="solved objects")
    parser.add_argument("--work", type=Path, default=ROOT / "build" / "unseen-answers")
    parser.add_argument("--seconds", type=float, default=1e9, help="start no further reading after this time")
    parser.add_argument("--list", action="store_true", help="each reading that was not right")
    parser.add_argument("--write", type=Path, help="folder for unseen-bodies.md")
    given = parser.parse_args()
    solved = [name for name in SETS[given.set] if (given.objects / f"{name}.npz").is_file()]
    bodies = [n for n in solved if not base_of(n) or base_of(n) in solved]
    # An untagged body takes its SNR from its first tag.
    names = [n for n in bodies if OBJECTS[n].places or any(base_of(m) == n and m != n for m in bodies)]
    if given.only:
        names = [name for name in names if name.startswith(tuple(given.only))]
    wanted = grid(names, given.grid) if given.grid else tasks(names, given.numbers, given.nulls)
    wanted = [task for task in wanted if task.mode in given.modes]
    path = given.work / f"{reader_hash()}{given.polarisation}.jsonl"
    found = answered(wanted, Judge(given.objects, given.polarisation), path, time.monotonic() + given.seconds)
    lines = [
        "# Objects that the reader was not made with",
        "",
        f"Command: `{' '.join(['python', *sys.argv])}`.",
        f"Commit: {commit()}. Reader: {reader_hash()}.",
        f"Machine: {platform.machine()}, {os.cpu_count()} cores, one thread, Python "
        f"{platform.python_version()}, numpy {np.__version__}. Date: {datetime.now(UTC):%Y-%m-%d}.",
        f"Seeds: draws of unseen/1; set {given.set}: {len(names)} objects, {len(found)} of {len(wanted)} "
        "readings.",
        "",
    ]
    lines += monotone(found) if given.grid else report(found)
    if given.list:
        for task, answer in found.items():
            if answer.outcome != "correct" and not (is_null(task) and answer.outcome != "wrong"):
                lines.append(
                    f"    {answer.key} | {answer.outcome} {answer.layout} {answer.kind} | {answer.reason}"
                )
    text = "\n".join(lines).rstrip() + "\n"
    print(text)
    if given.write:
        given.write.mkdir(parents=True, exist_ok=True)
        (given.write / "unseen-bodies.md").write_text(text)


if __name__ == "__main__":
    main()
