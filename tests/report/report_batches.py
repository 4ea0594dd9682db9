"""What the tests of reports are made of: captures of known objects, and a batch that runs in this process."""

from __future__ import annotations

import shutil
from pathlib import Path

from tagid.batch.job import Job
from tagid.batch.local import Results, Tasks
from tagid.batch.work import work
from tagid.config import load_config
from tagid.pipeline.load import LoadSettings
from tagid.pipeline.settings import ImagingSettings
from tagid.tags.layouts.layout import builtin_layouts

OBJECTS = ("helmet-120", "container-90", "helmet-linear", "empty")


def copy_captures(recorded: Path, folder: Path) -> Path:
    """A folder with the captures, one that is damaged, and a note."""
    shutil.copytree(recorded, folder)
    (folder / "bad.tagid.h5").write_bytes(b"not a capture")
    (folder / "notes.txt").write_text("no capture either")
    return folder


def in_this_process(tasks: Tasks, job: Job) -> Results:
    for task in tasks:
        yield None if task is None else (*task, work(task[1], job))


def a_job() -> Job:
    settings = ImagingSettings(method="bp", pixels=48)
    return Job(settings, tuple(builtin_layouts().values()), 4, LoadSettings.of(load_config()))
