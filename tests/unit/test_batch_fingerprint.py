"""What makes two answers the same answer: a resumed report takes over nothing that could differ."""

from __future__ import annotations

from copy import copy
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from tagid.batch import job as job_module
from tagid.batch.job import Job, _sha256
from tagid.config import load_config
from tagid.enrolling.registry import RegistryContents
from tagid.imaging.ats.settings import AtsSettings
from tagid.models_store import manifest
from tagid.operate.turn import ReadingSetup
from tagid.pipeline.prepared import LoadSettings
from tagid.pipeline.settings import ImagingSettings
from tagid.tags.layouts.layout import Layout, builtin_layouts

LAYOUTS = tuple(builtin_layouts().values())


def job(
    settings: ImagingSettings | None = None,
    layouts: tuple[Layout, ...] = LAYOUTS,
    registry_version: int = 4,
    load: LoadSettings | None = None,
    **more: Any,
) -> Job:
    load = load or LoadSettings.of(load_config({"motion.axis_distance_m": 1.0}))
    enrolled = RegistryContents(registry_version, list(layouts), [])
    return Job(ReadingSetup(load, settings or ImagingSettings(), enrolled), **more)


def test_the_same_job_has_the_same_fingerprint() -> None:
    assert job().fingerprint() == job().fingerprint()
    assert job(known=frozenset({"a"})).fingerprint() == job().fingerprint()
    assert len(job().fingerprint()) == 64


def test_every_setting_of_imaging_changes_it() -> None:
    settings = ImagingSettings()
    for field in fields(settings):
        value = getattr(settings, field.name)
        other = object()
        if isinstance(value, bool):
            other = not value
        elif isinstance(value, int | float):
            other = value + 1
        elif isinstance(value, str):
            other = f"{value}-other"
        elif isinstance(value, AtsSettings):
            other = replace(value, seed=value.seed + 1)
        else:
            continue
        changed = copy(settings)
        object.__setattr__(changed, field.name, other)
        assert job(settings=changed).fingerprint() != job().fingerprint(), field.name


def test_layouts_registry_geometry_and_pictures_change_it() -> None:
    moved = Layout("helmet-120", LAYOUTS[0].positions + np.array([0.0, 1e-3]))
    others = {
        "a moved layout": job(layouts=(moved, *LAYOUTS[1:])),
        "one layout less": job(layouts=LAYOUTS[1:]),
        "another registry": job(registry_version=5),
        "another distance": job(load=LoadSettings.of(load_config({"motion.axis_distance_m": 1.01}))),
        "another height": job(
            load=LoadSettings.of(load_config({"motion.axis_distance_m": 1.0, "motion.antenna_height_m": 0.1}))
        ),
        "another motion": job(
            load=LoadSettings.of(load_config({"motion.axis_distance_m": 1.0, "motion.url": "free?rpm=3"}))
        ),
        "no pictures": job(pictures=False),
    }
    prints = {name: other.fingerprint() for name, other in others.items()}
    assert len({*prints.values(), job().fingerprint()}) == len(prints) + 1


def test_a_distance_from_the_command_line_is_another_than_one_from_the_file(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It stands over what a capture says, so the answer may differ."""
    monkeypatch.setenv("TAGID_MOTION_AXIS_DISTANCE_M", "1.0")
    assert job(load=LoadSettings.of(load_config({}))).fingerprint() != job().fingerprint()


def test_version_and_models_change_it(monkeypatch: pytest.MonkeyPatch) -> None:
    usual = job().fingerprint()
    with monkeypatch.context() as patch:
        patch.setattr(job_module, "__version__", "0.0.0")
        assert job().fingerprint() != usual
    entries = {
        name: replace(entry, sha256="0" * 64) if name == "ats_step" else entry
        for name, entry in manifest().items()
    }
    assert "ats_step" in entries
    monkeypatch.setattr(job_module, "manifest", lambda: entries)
    assert job().fingerprint() != usual


def test_the_order_of_settings_changes_nothing_and_their_values_do() -> None:
    """A worker of another version of Python may list the same settings in another order."""
    assert _sha256({"a": 1, "b": [2, 3]}) == _sha256({"b": [2, 3], "a": 1})
    assert _sha256({"a": 1, "b": [2, 3]}) != _sha256({"a": 1, "b": [3, 2]})
