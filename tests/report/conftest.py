"""Captures of known objects, and a batch in this process: pool and cluster have tests of their own."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tagid.batch.inputs import collect
from tagid.batch.job import Job
from tagid.batch.local import Results, Tasks
from tagid.batch.run import Finished, Plan, run_batch
from tagid.batch.work import work
from tagid.config import load_config
from tagid.pipeline import ImagingSettings
from tagid.simulate.acquisition import Acquisition
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import scene_from_name
from tagid.storage.hdf5 import write_capture
from tagid.tags.layout import builtin_layouts

OBJECTS = ("helmet-120", "container-90", "helmet-linear", "empty")


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One small capture of each of `OBJECTS`."""
    folder = tmp_path_factory.mktemp("recorded")
    for seed, name in enumerate(OBJECTS):
        capture, _ = simulate_capture(scene_from_name(name, seed), Acquisition(views=12, snr_db=20.0), seed)
        write_capture(folder / f"{name}.tagid.h5", capture)
    return folder


@pytest.fixture
def captures(recorded: Path, tmp_path: Path) -> Path:
    """A folder of its own with the captures, one that is damaged, and a note."""
    folder = tmp_path / "captures"
    shutil.copytree(recorded, folder)
    (folder / "bad.tagid.h5").write_bytes(b"not a capture")
    (folder / "notes.txt").write_text("no capture either")
    return folder


def in_this_process(tasks: Tasks, job: Job) -> Results:
    for task in tasks:
        yield None if task is None else (*task, work(task[1], job))


@pytest.fixture
def job() -> Job:
    settings = ImagingSettings(method="bp", pixels=48)
    return Job(settings, tuple(builtin_layouts().values()), 4, load_config())


@pytest.fixture
def make_report(tmp_path: Path, job: Job) -> Callable[..., Finished]:
    def make(*words: object, **plan: Any) -> Finished:
        runner, hooks = plan.pop("runner", in_this_process), plan.pop("hooks", None)
        out = plan.pop("out", tmp_path / "report")
        asked = plan.pop("job", job)
        found = collect([str(word) for word in words], out)
        return run_batch(Plan(found, out, **plan), asked, runner, hooks)

    return make
