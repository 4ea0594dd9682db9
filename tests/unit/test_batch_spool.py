"""The working file of a report: what a resumed run may take over, what it must do again, and what makes two
answers the same answer."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from copy import copy
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tagid.batch import job as job_module
from tagid.batch.job import Answered, Job, Known, _sha256
from tagid.batch.spool import Spool
from tagid.config import load_config
from tagid.enrolling.registry import RegistryContents
from tagid.errors import StorageError
from tagid.imaging.ats.settings import AtsSettings
from tagid.models_store import manifest
from tagid.operate.turn import ReadingSetup
from tagid.pipeline.prepared import LoadSettings
from tagid.pipeline.settings import ImagingSettings
from tagid.report.records import ItemRecord, StoredItem, Thumbnails
from tagid.tags.layouts.layout import Layout, builtin_layouts


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "spool.sqlite"


@pytest.fixture
def spool(path: Path) -> Iterator[Spool]:
    with Spool(path, fresh=True) as opened:
        yield opened


def drawing_of(name: str) -> dict[str, object]:
    return {"method": name, "layout_m": [[0.1, 0.0], [0.0, 0.1]], "angle_deg": None}


def answered(name: str, content: str | None, status: str = "identified", **more: object) -> Answered:
    record = {"file": name, "content_sha256": content, "status": status, "error": None, **more}
    return Answered(ItemRecord(record), Thumbnails(b"image " + name.encode(), b"s", drawing_of(name)))


def failed(name: str, content: str | None, code: str) -> Answered:
    error = {"code": code, "message": f"{name}: no", "remedy": "none"}
    return answered(name, content, "failed", error=error, reason=f"{name}: no")


def places(spool: Spool) -> list[tuple[int, str]]:
    return [(item.position, item.record.file) for item in spool.items()]


def test_what_is_put_is_read_in_the_order_of_the_inputs(spool: Spool) -> None:
    for position, name in ((7, "c"), (0, "a"), (3, "b")):
        assert spool.put(position, name, "job", answered(name, name * 64)).file == name
    assert list(spool.items()) == [
        StoredItem(position, answered(name, name * 64).record, drawing_of(name), picture_bytes=8)
        for position, name in ((0, "a"), (3, "b"), (7, "c"))
    ]
    assert spool.pictures(3) == (b"image b", b"s")
    assert len(spool.names()) == 3
    spool.put(3, "b", "job", answered("b", "f" * 64, "no_tag"))  # a watched file that changed
    assert len(spool.names()) == 3
    assert [item.record.status for item in spool.items()] == ["identified", "no_tag", "identified"]


def test_answers_of_the_same_content_and_job_are_taken_over(spool: Spool) -> None:
    spool.put(0, "a", "job", answered("a", "A"))
    spool.put(1, "other", "another job", answered("other", "B"))
    spool.put(2, "unread", "job", answered("unread", None, "failed", error={"code": "storage"}))
    assert spool.take_over("job") == {"A"}
    assert len(spool.names()) == 0
    record = spool.put(5, "moved", "job", Known("A"))
    assert (record.file, record.status) == ("moved", "identified")
    assert spool.pictures(5) == (b"image a", b"s")
    assert places(spool) == [(5, "moved")]
    # The answer is kept for the run after the next one, too; that of the other job is gone.
    assert spool.take_over("job") == {"A"}
    assert spool.take_over("another job") == frozenset()
    assert spool.take_over("job") == frozenset()


def test_every_answer_is_final_and_the_newest_of_a_content_stays(spool: Spool) -> None:
    for status in ("ambiguous", "no_tag", "unknown", "identified"):
        spool.put(0, "a", "job", answered("a", "A", status))
        assert spool.take_over("job") == {"A"}
    assert spool.put(0, "a", "job", Known("A")).status == "identified"


@pytest.mark.parametrize(
    ("code", "kept"), [("bad_file", True), ("bad_data", True), ("storage", False), ("lost_worker", False)]
)
def test_failures_that_another_try_may_mend_are_tried_again(spool: Spool, code: str, kept: bool) -> None:
    spool.put(0, "old", "job", failed("old", "A", code))
    assert spool.take_over("job") == ({"A"} if kept else frozenset())
    if kept:
        record = spool.put(0, "new", "job", Known("A"))
        assert record.document["error"]["message"] == record.reason == "new: no"


def test_a_run_goes_on_in_the_file_unless_it_is_to_be_fresh(path: Path) -> None:
    with Spool(path, fresh=True) as spool:
        spool.put(0, "a", "job", answered("a", "A"))
        assert spool._db.execute("PRAGMA synchronous").fetchone() == (3,), "each answer is on disk at once"
    with Spool(path, fresh=False) as spool:
        assert len(spool.names()) == 1
    with Spool(path, fresh=True) as spool:
        assert len(spool.names()) == 0 and spool.take_over("job") == frozenset()
        spool.put(0, "a", "job", answered("a", "A"))
        with pytest.raises(StorageError, match="locked") as caught:
            Spool(path, fresh=False)
        assert "Another tagid report" in caught.value.remedy
    with sqlite3.connect(path) as db:
        assert db.execute("PRAGMA application_id").fetchone() == (0x74616773,)
        assert db.execute("PRAGMA user_version").fetchone() == (1,)
        db.execute("PRAGMA user_version = 9")
    db.close()
    with Spool(path, fresh=False) as spool:  # of another version: nothing can be taken over
        assert len(spool.names()) == 0
    with sqlite3.connect(path) as db:
        db.execute("PRAGMA application_id = 7")
    db.close()
    with pytest.raises(StorageError, match="another program"):
        Spool(path, fresh=True)


def test_a_record_keeps_the_order_of_its_fields_and_no_number_that_json_lacks(spool: Spool) -> None:
    spool.put(0, "a", "job", answered("a", "A", zone=1, area=2))
    (item,) = spool.items()
    assert list(item.record.document) == ["file", "content_sha256", "status", "error", "zone", "area"]
    with pytest.raises(ValueError, match="JSON"):
        spool.put(1, "b", "job", answered("b", "B", score=float("nan")))


@pytest.mark.parametrize(
    ("primary", "message", "remedy"),
    [
        (sqlite3.SQLITE_FULL, "no space left", "`resume`"),
        (sqlite3.SQLITE_LOCKED, "malformed", "wait for it"),
        (sqlite3.SQLITE_READONLY, "cannot use", "permission"),
        (sqlite3.SQLITE_CANTOPEN, "cannot use", "permission"),
        (sqlite3.SQLITE_CORRUPT, "malformed", "Remove the file"),
    ],
)
def test_each_failure_of_the_file_says_what_to_do(
    spool: Spool, monkeypatch: pytest.MonkeyPatch, primary: int, message: str, remedy: str
) -> None:
    class Failing:
        def execute(self, *words: object) -> None:
            error = sqlite3.DatabaseError("malformed")
            error.sqlite_errorcode = primary | 5 << 8  # an extended code has its details above the byte
            raise error

        def close(self) -> None:
            pass

    real = spool._db
    monkeypatch.setattr(spool, "_db", Failing())
    with pytest.raises(StorageError, match=message) as caught:
        len(spool.names())
    assert remedy in caught.value.remedy
    real.close()


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
    assert job(known=frozenset({"a"})).fingerprint() == job().fingerprint()
    # A worker of another version of Python may list the same settings in another order.
    assert _sha256({"a": 1, "b": [2, 3]}) == _sha256({"b": [2, 3], "a": 1}) != _sha256({"a": 1, "b": [3, 2]})


def test_every_setting_of_imaging_changes_it() -> None:
    settings = ImagingSettings()
    for field in fields(settings):
        value = getattr(settings, field.name)
        if isinstance(value, bool):
            other: object = not value
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


def test_layouts_registry_geometry_and_pictures_change_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def loaded(**settings: object) -> Job:
        given = {"motion.axis_distance_m": 1.0} | {
            f"motion.{name}": value for name, value in settings.items()
        }
        return job(load=LoadSettings.of(load_config(given)))

    moved = Layout("helmet-120", LAYOUTS[0].positions + np.array([0.0, 1e-3]))
    monkeypatch.setenv("TAGID_MOTION_AXIS_DISTANCE_M", "1.0")
    others = [
        job(layouts=(moved, *LAYOUTS[1:])),
        job(layouts=LAYOUTS[1:]),
        job(registry_version=5),
        loaded(axis_distance_m=1.01),
        loaded(antenna_height_m=0.1),
        loaded(url="free?rpm=3"),
        job(load=LoadSettings.of(load_config({}))),  # a distance that yields to what a capture says
        job(pictures=False),
    ]
    prints = {other.fingerprint() for other in (job(), *others)}
    assert len(prints) == 1 + len(others)


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
