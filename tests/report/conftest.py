"""Captures of known objects, and reports made of them in this process: pool and cluster have own tests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from remembered import shared
from report_batches import OBJECTS, a_job, copy_captures, in_this_process

from tagid.batch.inputs import collect
from tagid.batch.job import Job
from tagid.batch.run import BatchPlan, Finished, run_batch
from tagid.simulate.acquisition import Acquisition
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import scene_from_name
from tagid.storage.hdf5 import write_capture


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One small capture of each of `OBJECTS`."""
    folder = tmp_path_factory.mktemp("recorded")
    for seed, name in enumerate(OBJECTS):
        capture, _ = simulate_capture(scene_from_name(name, seed), Acquisition(views=16, snr_db=20.0), seed)
        write_capture(folder / f"{name}.tagid.h5", capture)
    return folder


@pytest.fixture(autouse=True)
def _readings_are_shared(remembered: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also by the processes of pool and cluster."""
    for name, value in shared(remembered).items():
        monkeypatch.setenv(name, value)


@pytest.fixture
def captures(recorded: Path, tmp_path: Path) -> Path:
    return copy_captures(recorded, tmp_path / "captures")


@pytest.fixture
def job() -> Job:
    return a_job()


@pytest.fixture
def make_report(tmp_path: Path, job: Job) -> Callable[..., Finished]:
    def make(*words: object, **plan: Any) -> Finished:
        runner, hooks = plan.pop("runner", in_this_process), plan.pop("hooks", None)
        out = plan.pop("out", tmp_path / "report")
        asked = plan.pop("job", job)
        result = collect([str(word) for word in words], out)
        return run_batch(BatchPlan(result, out, **plan), asked, runner, hooks)

    return make
