"""What the tests of reports are made of: captures of known objects, and a batch that runs in this process."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tagid.batch.job import Job
from tagid.batch.local import Done, Results, Tasks
from tagid.batch.work import work
from tagid.config import load_config
from tagid.enrolling.registry import RegistryContents
from tagid.operate.turn import ReadingSetup
from tagid.pipeline.prepared import LoadSettings
from tagid.pipeline.settings import ImagingSettings
from tagid.storage.hdf5 import read_capture, write_capture
from tagid.tags.layouts.layout import builtin_layouts

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "unit"))

from hostile_files import REFUSED, unknown_dataset

HOSTILE = (*REFUSED, "unknown.tagid.h5")
"""Names of files that were made to break the program; the last one is a capture with more in it."""
OBJECTS = ("helmet-120", "container-90", "container-180", "empty")


def copy_captures(recorded: Path, folder: Path) -> Path:
    """A folder with the captures, one that is damaged, and a note."""
    shutil.copytree(recorded, folder)
    (folder / "bad.tagid.h5").write_bytes(b"not a capture")
    (folder / "notes.txt").write_text("no capture either")
    return folder


def keep(captures: Path, *names: str) -> None:
    """Remove the captures of a folder that are not named."""
    for path in captures.glob("*.tagid.h5"):
        if path.name.removesuffix(".tagid.h5") not in names:
            path.unlink()


def part_of_a_turn(whole: Path, part: Path, share: float) -> None:
    """Write the first part of a recording's views, with a time and a note."""
    capture = read_capture(whole)
    some = capture.select(np.arange(round(share * capture.views)))
    known = replace(capture.object, note="table stopped")
    write_capture(part, replace(some, object=known, created_utc="2026-11-03T08:15:30+01:00", uuid="part"))


def in_this_process(tasks: Tasks, job: Job) -> Results:
    for task in tasks:
        yield None if task is None else Done(task, work(task.source, job))


def a_job(pictures: bool = False) -> Job:
    settings = ImagingSettings(method="bp", pixels=48)
    enrolled = RegistryContents(4, list(builtin_layouts().values()), [])
    return Job(ReadingSetup(LoadSettings.of(load_config()), settings, enrolled), pictures)


def of_another_registry(job: Job) -> Job:
    """The same job after a change of the registry that left its entries as they are."""
    enrolled = job.setup.enrolled
    return replace(job, setup=replace(job.setup, enrolled=replace(enrolled, version=enrolled.version + 1)))


def add_hostile_files(folder: Path) -> None:
    """Put the files of `HOSTILE` into a folder."""
    for name, make in REFUSED.items():
        make(folder / name)
    unknown_dataset(folder / HOSTILE[-1])


def lines(out: Path) -> list[dict[str, Any]]:
    """The records of a report in its order; none before the first one is written."""
    path = out / "items.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def timeless(record: dict[str, Any]) -> dict[str, Any]:
    """A record without what differs in every run."""
    return {key: value for key, value in record.items() if key not in ("seconds", "time_utc")}


def records_of(out: Path) -> dict[str, dict[str, Any]]:
    """The records of a report by file name."""
    return {Path(record["file"]).name: record for record in lines(out)}


def check_hostile(out: Path) -> None:
    """Hostile files cost themselves, and the good ones beside them have their answers."""
    result = records_of(out)
    assert result["helmet-120.tagid.h5"]["layout"] == "helmet-120"
    assert result["empty.tagid.h5"]["status"] == "no_tag"
    for name in REFUSED:
        assert (result[name]["status"], result[name]["error"]["code"]) == ("failed", "bad_file"), result[name]
        assert name in result[name]["error"]["message"]
    assert result[HOSTILE[-1]]["status"] != "identified"
