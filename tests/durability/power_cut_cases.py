"""What is recorded, what each program promises, and the real recovery that has to keep the promise.

Run as a script with the name of a case, this module is the traced process: its working folder is the recorded
one, and each line it prints means that what it did before is to last.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from syscalls import Close, Operation, Recording, Sync, Write, record

from tagid.batch.inputs import Source, collect
from tagid.batch.job import Answered, Job, Known, Outcome
from tagid.batch.local import Done, Results, Tasks
from tagid.batch.run import FILES, BatchPlan, run_batch
from tagid.batch.work import content_of, make_record
from tagid.capture import Capture
from tagid.config import change_settings, read_file
from tagid.enrolling.registry import Registry, RegistryContents
from tagid.errors import TagidError
from tagid.operate.turn import Answer, ReadingSetup
from tagid.pipeline.answer import Identification
from tagid.pipeline.prepared import LoadSettings
from tagid.pipeline.settings import ImagingSettings
from tagid.report.records import Thumbnails
from tagid.storage.hdf5 import read_capture, write_capture
from tagid.storage.history import Filter, History
from tagid.storage.journal import PREAMBLE, JournalWriter, intact_records, record_bytes
from tagid.tags.layouts.layout import Layout, builtin_layouts

REPOSITORY = Path(__file__).resolve().parents[2]
_SCAN_KIND = 2
_RECORDING_SYNC_S = 0.5
"""What docs/architecture.md promises of recordings: the most that a power cut may lose, s."""
_DONE = "done"


@dataclass(frozen=True)
class Promise:
    """What has to be there after a power cut of one recording.

    `stage` is what is promised at a cut (a line of the trace), as a value to compare. `broken` recovers in a
    folder in the state after the cut, and returns what is lost or wrong, empty where nothing is.
    """

    stage: Callable[[int], object]
    broken: Callable[[Path, int], str]


@dataclass(frozen=True)
class Case:
    """A program, which runs in the recorded folder, and what it promises."""

    program: Callable[[], None]
    promise: Callable[[Recording], Promise]


def recorded(name: str, place: Path) -> Recording:
    """Record a case in `place`, which is empty."""
    folder = place / "folder"
    folder.mkdir()
    environment = {key: value for key, value in os.environ.items() if not key.startswith("TAGID_")}
    environment |= {
        "TAGID_CONFIG": str(folder / "home" / "tagid" / "config.toml"),
        "TAGID_DATA": str(folder / "home" / "data"),
        "PYTHONPATH": os.pathsep.join([str(REPOSITORY), str(Path(__file__).parent)]),
        "OMP_NUM_THREADS": "1",
    }
    return record(
        [sys.executable, str(Path(__file__).resolve()), name], folder, environment, place / "strace"
    )


def _tell(text: str) -> None:
    os.write(1, f"{text}\n".encode())


@cache
def _program() -> Any:
    import typer

    from tagid.cli.app import app

    return typer.main.get_command(app)


def _command(*words: str) -> int:
    """Run a command line in this process; returns its exit code, and drops its output."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        code = _program()(list(words), standalone_mode=False)
    return code if isinstance(code, int) else 0


# Recordings: the scans of the journal, then of the capture file.


def _record_radar() -> None:
    out = ["--save-dir", "captures/today", "--seconds", "2"]
    code = _command("radar", "record", "--radar", "emulator://points-3?rate=1", "--axis-distance", "1", *out)
    assert code == 0, code
    _tell(_DONE)


def _scan() -> None:
    out = ["--save-dir", "captures", "--method", "bp", "--scans", "400", "--motion", "free?rpm=30"]
    code = _command("scan", "--radar", "emulator://helmet-120?rate=1&rpm=30", "--axis-distance", "1", *out)
    assert code in (0, 3), code
    _tell(_DONE)


def _journal() -> None:
    """A journal that is synced after every fourth record, which ends without its end record."""
    rng = np.random.default_rng(1)
    header = {"range_start_m": 0.5, "range_step_m": 0.009}
    with JournalWriter(Path("a.tagid.journal"), header, sync_every=4) as journal:
        for number in range(40):
            samples = rng.integers(-999, 999, 96).astype(np.int32)
            journal.append(number, 10**18 + number, 20.0 * number, samples)
            if number % 7 == 6:
                journal.append_motion({"host_time_ns": [1], "angle_rad": [0.1], "sigma_rad": [0.01]})


def _journal_promise(sync_every: int, sync_s: float) -> Callable[[Recording], Promise]:
    """The check of a journal that is synced once `sync_every` records and `sync_s` have passed, and of the
    capture that it becomes."""

    def promise(recording: Recording) -> Promise:
        ((inode, name),) = (item for item in recording.paths.items() if item[1].endswith(".tagid.journal"))
        content = recording.contents[inode]
        matching = [
            operation for operation in recording.operations if getattr(operation, "inode", None) == inode
        ]
        steps = [operation for operation in matching if isinstance(operation, Write | Close)]
        writes = [step for step in steps if isinstance(step, Write)]
        # The write that ends each record, and how many records there are then: of the scans, and of all.
        kept: list[tuple[Write, int]] = []
        written: list[tuple[Write, int]] = []
        truth = []
        end = PREAMBLE.size
        for records, (kind, payload) in enumerate(intact_records(io.BytesIO(content), len(content)), 1):
            end += record_bytes(payload)
            by = next(write for write in writes if write.offset + len(write.data) >= end)
            written.append((by, records))
            if kind == _SCAN_KIND:
                kept.append((by, records))
                truth.append(np.frombuffer(payload, "<i4", offset=32))
        assert end == len(content) and len(kept) > 30, (end, len(content), len(kept))
        closed = next(step for step in steps if isinstance(step, Close))
        following: dict[int, Operation] = dict(zip((step.end for step in steps), steps[1:], strict=False))
        captures = [path for path in recording.final if path.endswith(".tagid.h5")]

        def acknowledged(cut: int) -> int:
            """How many scans have to be there."""
            if closed.start < cut:
                return len(kept)
            # A write has returned, and what it is to sync is synced, once the next call has begun.
            back = [(by, count) for by, count in written if following[by.end].start < cut]
            if not back:
                return 0
            last, count = back[-1]
            return sum(
                records <= count - sync_every and last.time_s - by.time_s > sync_s for by, records in kept
            )

        def check(place: Path, cut: int) -> str:
            wanted = acknowledged(cut)
            result = place / captures[0] if captures else None
            if result is None or not result.exists():
                if recording.marked(cut):
                    return "the capture is gone"
                result = place / "recovered.tagid.h5"
                if _command("recover", str(place / name), "--out", str(result)) != 0:
                    return f"{wanted} acknowledged scans are gone" if wanted else ""
            try:
                samples = read_capture(result).samples
            except TagidError as error:
                return f"the capture is damaged: {error.message}"
            rows = list(samples)
            if len(rows) < wanted or (result.name != "recovered.tagid.h5" and len(rows) != len(truth)):
                return f"{len(rows)} of {wanted} acknowledged scans are there"
            # What is there beyond the acknowledged ones is true as well, but may have gaps.
            if any(not np.array_equal(row, true) for row, true in zip(rows[:wanted], truth, strict=False)):
                return "acknowledged scans differ"
            known = {true.tobytes() for true in truth}
            return "" if all(row.tobytes() in known for row in rows) else "scans that were never recorded"

        return Promise(acknowledged, check)

    return promise


# Files that are replaced: each is the old or the new one, and the new one from the report of success on.


def _captures() -> list[Capture]:
    rng = np.random.default_rng(2)
    made = []
    for number in range(3):
        samples = rng.integers(-999, 999, (12, 64)).astype(np.int32)
        made.append(Capture(samples, 0.5, 0.009, axis_distance_m=1.0, uuid=f"capture-{number}"))
    return made


def _replace_capture() -> None:
    for capture in _captures():
        write_capture(Path("a.tagid.h5"), capture)
        _tell(_DONE)


def _changes() -> list[dict[str, Any]]:
    return [{"radar.gain": 40}, {"radar.gain": 41, "motion.axis_distance_m": 1.25}, {"radar.gain": None}]


def _config() -> None:
    for change in _changes():
        change_settings(change)
        _tell(_DONE)


def _one_of(values: list[Any], read: Callable[[Path], Any]) -> Callable[[Recording], Promise]:
    """The check of a file whose value was changed step by step, with a report after each: `values[0]` is that
    before the first step, and `read` returns what is there."""

    def promise(recording: Recording) -> Promise:
        def check(place: Path, cut: int) -> str:
            done = recording.marked(cut).count(_DONE)
            try:
                recovered = read(place)
            except TagidError as error:
                return f"{type(error).__name__}: {error.message}"
            allowed = values[done : done + 2]
            wrong = f"after {done} of {len(values) - 1} steps: {str(recovered)[:100]}"
            return "" if recovered in allowed else wrong

        assert len(recording.marked(1 << 60)) == len(values) - 1
        return Promise(lambda cut: len(recording.marked(cut)), check)

    return promise


def _capture_uuid(place: Path) -> str | None:
    path = place / "a.tagid.h5"
    return read_capture(path).uuid if path.exists() else None


def _configs() -> list[dict[str, Any]]:
    results: list[dict[str, Any]] = [{}]
    for change in _changes():
        results.append({name: value for name, value in (results[-1] | change).items() if value is not None})
    return results


# Databases: after each report the change is there, and the file can always be opened and changed.


_ENROLLED = tuple(f"new-{number}" for number in range(3))


def _registry() -> None:
    for number, name in enumerate(_ENROLLED):  # of 4 to 6 reflectors: nothing to compare them with
        points = [f"{0.06 - 0.02 * at},{0.09 * (-1) ** at}" for at in range(number + 4)]
        words = [word for point in points for word in ("--point", point)]
        assert _command("enroll", name, "--kind", "helmet", *words, "--yes", "--force") == 0
        _tell(_DONE)
    assert _command("layouts", "--remove", "new-0") == 0
    _tell(_DONE)


def _registries() -> list[list[str]]:
    results = [sorted(builtin_layouts())]
    for name in _ENROLLED:
        results.append(sorted([*results[-1], name]))
    return [*results, [name for name in results[-1] if name != "new-0"]]


def _read_registry(place: Path) -> list[str]:
    (place / "home" / "data").mkdir(parents=True, exist_ok=True)
    registry = Registry(place / "home" / "data" / "registry.sqlite")
    contents = registry.contents()
    registry.add(Layout("after", np.array([[0.1, 0.0], [-0.02, 0.06], [-0.05, -0.04]])), "a test")
    assert registry.version == contents.version + 1
    assert [item.name for item in registry.history()][-1] == "after"
    return [layout.name for layout in contents.layouts]


_RUNS = 12


def _history() -> None:
    history = History(Path("data/history.sqlite"))
    run = history.begin("identify", {"a": 1})
    for number in range(_RUNS):
        history.add(run, [_record(number)])
        _tell(_DONE)


def _record(number: int) -> dict[str, Any]:
    source = Source(f"/{number}", f"{number}")
    answer = Answer(Identification("no_tag", None, f"uuid-{number}", 4))
    return dict(make_record(source, answer, {}, None).document)


def _histories() -> list[list[str]]:
    return [[f"uuid-{number}" for number in range(count)] for count in range(_RUNS + 1)]


def _read_history(place: Path) -> list[str]:
    history = History(place / "data" / "history.sqlite")
    results = [str(entry.capture_uuid) for entry in history.find(Filter(), oldest_first=True)]
    history.add(history.begin("a test", {}), [_record(999)])
    assert history.count() == len(results) + 1
    return results


# A report, which goes on where it was.

_ITEMS = 10


def _job() -> Job:
    settings = ImagingSettings(method="bp", pixels=48)
    enrolled = RegistryContents(4, list(builtin_layouts().values()), [])
    return Job(ReadingSetup(LoadSettings(), settings, enrolled), pictures=False)


def _answers(again: list[str], tell: bool) -> Callable[[Tasks, Job], Results]:
    """A runner whose answers follow from the content; names of those that were not known go to `again`."""

    def runner(tasks: Tasks, job: Job) -> Results:
        for task in tasks:
            assert task is not None
            source = task.source
            content = content_of(Path(source.location))
            outcome: Outcome = Known(content.sha256)
            if content.sha256 not in job.known:
                again.append(source.name)
                answer = Answer(Identification("no_tag", None, f"uuid-{content.sha256[:8]}", 4))
                record = make_record(source, answer, {"load": 0.1}, content)
                outcome = Answered(record, Thumbnails(image=bytes.fromhex(content.sha256) * 200))
            yield Done(task, outcome)
            if tell:
                _tell(_DONE)

    return runner


def _report() -> None:
    inputs = Path("captures")
    inputs.mkdir()
    for number in range(_ITEMS):
        (inputs / f"{number}.tagid.h5").write_bytes(b"%d" % number)
    finished = run_batch(BatchPlan(collect([str(inputs)]), Path("report")), _job(), _answers([], tell=True))
    _tell(f"written {finished.summary['items']}")


def _report_promise(recording: Recording) -> Promise:
    def check(place: Path, cut: int) -> str:
        marks = recording.marked(cut)
        out = place / "report"
        wrong = _wrong_files(out, whole=bool(marks) and marks[-1].startswith("written"))
        if wrong:
            return wrong
        (place / "captures").mkdir(exist_ok=True)
        for number in range(_ITEMS):  # the inputs are not this program's to keep
            (place / "captures" / f"{number}.tagid.h5").write_bytes(b"%d" % number)
        again: list[str] = []
        plan = BatchPlan(collect([str(place / "captures")]), out, resume=True)
        try:
            finished = run_batch(plan, _job(), _answers(again, tell=False))
        except TagidError as error:
            return f"cannot be resumed: {error.message}"
        if finished.summary["items"] != _ITEMS or len(set(again)) != len(again):
            return "the resumed report lacks items"
        lost = marks.count(_DONE) - (_ITEMS - len(again))
        return f"{lost} finished items were done again" if lost > 0 else _wrong_files(out, whole=True)

    return Promise(lambda cut: len(recording.marked(cut)), check)


def _wrong_files(out: Path, whole: bool) -> str:
    """What is wrong with a report's files: each is absent, unless all have to be there, or whole."""
    for name in FILES:
        path = out / name
        if name == "items.jsonl" and not whole:
            continue  # it grows line by line until the end
        if not path.exists():
            if whole:
                return f"{name} is gone"
            continue
        content = path.read_text()
        ends = {"report.html": "</html>", "junit.xml": "</testsuites>", "items.csv": "", "items.jsonl": "}"}
        if name == "summary.json":
            json.loads(content)
        elif not content.rstrip().endswith(ends[name]) or not content:
            return f"{name} is not whole"
        lines = {"items.csv": _ITEMS + 1, "items.jsonl": _ITEMS}.get(name)
        if lines is not None and len(content.splitlines()) != lines:
            return f"{name} lacks items"
    return ""


CASES: Mapping[str, Case] = {
    "radar record": Case(_record_radar, _journal_promise(1, _RECORDING_SYNC_S)),
    "scan": Case(_scan, _journal_promise(1, _RECORDING_SYNC_S)),
    "journal": Case(_journal, _journal_promise(4, 0.0)),
    "capture": Case(
        _replace_capture, _one_of([None, *(capture.uuid for capture in _captures())], _capture_uuid)
    ),
    "configuration": Case(
        _config, _one_of(_configs(), lambda place: read_file(place / "home" / "tagid" / "config.toml"))
    ),
    "registry": Case(_registry, _one_of(_registries(), _read_registry)),
    "history": Case(_history, _one_of(_histories(), _read_history)),
    "report": Case(_report, _report_promise),
}
"""By name; "scan" and "report" write most."""


def unsynced(recording: Recording, kind: str) -> Recording:
    """The recording as if one kind of sync were missing from the code: "files" or "folders"."""
    kept = tuple(
        operation
        for operation in recording.operations
        if not (isinstance(operation, Sync) and (operation.inode in recording.contents) == (kind == "files"))
    )
    return replace(recording, operations=kept)


if __name__ == "__main__":
    CASES[sys.argv[1]].program()
