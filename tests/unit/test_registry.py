"""The registry: round trips, history, damage, foreign files, and two concurrent writers."""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from datetime import datetime, tzinfo
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tagid.enrolling import enrollment
from tagid.enrolling import registry as registry_module
from tagid.enrolling.enrollment import Basis, Outlook, enroll, merge, outlook
from tagid.enrolling.layout_file import read_layouts, write_layouts
from tagid.enrolling.registry import Registry
from tagid.errors import FileFormatError, LayoutConflictError, RegistryError, UsageError
from tagid.tags.layouts.design import DesignRules, design
from tagid.tags.layouts.layout import Layout, builtin_layouts
from tagid.tags.layouts.objects import object_named

SCALENE = np.array([[0.1, 0.0], [-0.02, 0.06], [-0.05, -0.04]])


def alter(path: Path, *statements: str) -> None:
    """Change the file as no registry does."""
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        for statement in statements:
            connection.execute(statement)


def test_begins_with_the_built_in_layouts_of_which_a_removed_one_stays_away(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "registry.db"
    registry = Registry(path)
    assert [layout.name for layout in registry.layouts()] == sorted(builtin_layouts())
    assert registry.version == 4
    registry.remove("helmet-120")
    assert "helmet-120" not in [layout.name for layout in Registry(path).layouts()]


def test_each_change_raises_the_version_and_is_kept(tmp_path: Path) -> None:
    registry = Registry(tmp_path / "r.db")
    layout = Layout("mine", SCALENE, "helmet", notes="n")
    assert registry.add(layout, "file mine.toml") == 5
    assert registry.get("mine").to_dict() == layout.to_dict()
    moved = Layout("mine", SCALENE * 1.2)
    assert registry.add(moved, "again", replace=True) == 6
    assert registry.remove("mine") == 7
    changes = registry.history("mine")
    assert [(c.version, c.action) for c in changes] == [(5, "add"), (6, "replace"), (7, "remove")]
    assert np.allclose(changes[0].layout.positions, SCALENE)
    assert np.allclose(changes[2].layout.positions, SCALENE * 1.2)
    assert len(registry.history()) == 7
    assert registry.version == 7


def test_taken_and_missing_names(tmp_path: Path) -> None:
    registry = Registry(tmp_path / "r.db")
    with pytest.raises(RegistryError, match="already enrolled"):
        registry.add(builtin_layouts()["helmet-120"], "x")
    for call in (registry.get, registry.remove):
        with pytest.raises(RegistryError, match="no layout is named") as caught:
            call("nobody")
        assert "helmet-120" in caught.value.remedy
    assert registry.version == 4


def test_foreign_and_damaged_files_are_reported(tmp_path: Path) -> None:
    noise, other, newer, damaged, truncated = (tmp_path / f"{name}.db" for name in "nowdt")
    noise.write_bytes(b"not a database, " * 400)
    alter(other, "CREATE TABLE t (x)")
    for path in (newer, damaged, truncated):
        Registry(path)
    alter(newer, "PRAGMA user_version = 99")
    alter(damaged, "UPDATE layout SET definition = '{' WHERE name = 'helmet-120'")
    truncated.write_bytes(truncated.read_bytes()[:5000])
    for path, said in (
        (noise, r"n\.db"),
        (other, "another program"),
        (newer, "schema 99"),
        (damaged, "helmet-120"),
        (truncated, r"t\.db"),
        (tmp_path, str(tmp_path)),
        (noise / "below-a-file" / "r.db", "cannot create the folder"),
    ):
        with pytest.raises(RegistryError, match=said):
            Registry(path).layouts()
    assert noise.read_bytes().startswith(b"not a database")


def test_a_damaged_layout_can_be_taken_out_and_got_back(tmp_path: Path) -> None:
    registry = Registry(tmp_path / "r.db")
    alter(
        registry.path,
        "UPDATE layout SET definition = replace(definition, '0.045', '0.0')",
        "UPDATE layout SET name = 'strange' WHERE name = 'helmet-120'",
    )
    with pytest.raises(RegistryError, match="container-180") as caught:
        registry.layouts()
    assert "layouts remove" in caught.value.remedy
    for name in ("container-180", "container-90"):
        registry.remove(name)
    with pytest.raises(RegistryError, match="it belongs to helmet-120"):
        registry.layouts()
    registry.remove("strange")
    assert [layout.name for layout in registry.layouts()] == ["helmet-linear"]
    assert [c.layout is None for c in registry.history()] == [False] * 4 + [True] * 3
    registry.undo(4)
    assert {a.name: a.to_dict() for a in registry.layouts()} == {
        name: layout.to_dict() for name, layout in builtin_layouts().items()
    }


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs another user")
def test_a_registry_that_may_only_be_read_is_read() -> None:
    folder = Path(tempfile.mkdtemp())
    try:
        path = folder / "r.db"
        Registry(path)
        path.chmod(0o444)
        folder.chmod(0o555)
        child = os.fork()
        if child == 0:  # root may write anything, so another user tries
            code = 1
            try:
                if os.geteuid() == 0:
                    os.setuid(65534)
                registry = Registry(path)
                known = registry.snapshot()[1]
                try:
                    registry.add(Layout("new", SCALENE), "x")
                except RegistryError as error:
                    code = 0 if len(known) == 4 and "write permission" in error.remedy else 2
            finally:
                os._exit(code)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        assert path.stat().st_size and [p.name for p in folder.iterdir()] == ["r.db"]
    finally:
        folder.chmod(0o755)
        shutil.rmtree(folder)


def test_many_writers_lose_nothing(tmp_path: Path) -> None:
    path = tmp_path / "r.db"

    def work(worker: int) -> None:
        registry = Registry(path)
        for i in range(5):
            registry.add(Layout(f"w{worker}-{i}", SCALENE), "thread")

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(work, range(4)))
    registry = Registry(path)
    assert registry.version == len(registry.layouts()) == 4 + 20


def test_enrolment_refuses_what_could_be_confused(tmp_path: Path) -> None:
    registry = Registry(tmp_path / "r.db")
    near = builtin_layouts()["helmet-120"].positions.copy()
    near[0, 0] += 0.006
    with pytest.raises(LayoutConflictError, match="helmet-120"):
        enroll(registry, Layout("near", near), "numbers")
    assert registry.version == 4
    forced, version = enroll(registry, Layout("near", near), "numbers", force=True)
    assert forced.confusable == ("helmet-120",)
    assert registry.version == version == 5
    fine, _ = enroll(registry, Layout("fine", SCALENE), "numbers")
    assert not fine.confusable
    assert {n.name for n in fine.neighbours} == {*builtin_layouts(), "near"}


def test_of_those_that_enrol_alike_layouts_at_once_only_one_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "r.db"
    Registry(path)
    compared: list[object] = []
    together = threading.Barrier(3)

    def first_together(*words: Any) -> Outlook:
        compared.append(words)
        if len(compared) <= 3:  # nobody stores before all have compared
            together.wait(60)
        return outlook(*words)

    monkeypatch.setattr(enrollment, "outlook", first_together)

    def work(worker: int) -> str:
        turned = Layout(f"w{worker}", Layout("x", SCALENE).placed(worker, np.zeros(2)), "helmet")
        try:
            enroll(Registry(path), turned, "thread")
        except LayoutConflictError as error:
            return error.message
        return ""

    with ThreadPoolExecutor(3) as pool:
        refused = [message for message in pool.map(work, range(3)) if message]
    assert len(refused) == 2 and all("could be confused with w" in message for message in refused)
    assert Registry(path).version == 5


def test_a_reflector_outside_the_object_is_refused_but_stays_readable(tmp_path: Path) -> None:
    registry = Registry(tmp_path / "r.db")
    wide = Layout("wide", np.array([[0.3, 0.0], [0.0, 0.1]]), "helmet")
    with pytest.raises(UsageError, match="outside the object: a helmet has a radius up to"):
        enroll(registry, wide, "numbers", force=True)
    with pytest.raises(UsageError, match="outside the object"):
        merge(registry, [wide], "file")
    assert registry.version == 4
    registry.add(wide, "an older tagid")
    assert registry.get("wide").radius_m == pytest.approx(0.3)


def test_a_layout_known_too_badly_is_refused() -> None:
    def helmet(name: str, positions: np.ndarray, **more: np.ndarray) -> Layout:
        return Layout(name, positions, "helmet", **more)

    old = helmet("old", SCALENE + np.array([[0.0, 0.0], [0.0, 0.02], [0.0, 0.0]]))
    assert outlook(helmet("new", SCALENE), [old]).conflict() is None
    badly = helmet("new", SCALENE, covariance=np.tile(36e-6 * np.eye(2), (3, 1, 1)))
    assert "positions known to 6.0 mm" in outlook(badly, [old]).conflict().message
    mirrored, original = helmet("flip", SCALENE * [1, -1]), helmet("old", SCALENE)
    assert outlook(mirrored, [original]).conflict() is None
    image = outlook(mirrored, [original], Basis(direction_known=False)).conflict()
    assert "mirror image of old" in image.message


def test_several_are_added_all_or_none_and_taken_back_as_one(tmp_path: Path) -> None:
    registry = Registry(tmp_path / "r.sqlite")
    before = {layout.name: layout.to_dict() for layout in registry.layouts()}
    family = design(object_named("helmet").with_rows(2), DesignRules(), 4, None, registry.layouts()).layouts
    last = merge(registry, family, "design")
    assert last == registry.version == 8, last
    assert merge(registry, family, "again") == last
    clash = Layout("new", family[0].positions, "helmet")
    with pytest.raises(LayoutConflictError, match="new could be confused with helmet"):
        merge(registry, [Layout("fine", family[1].positions * 0.5, "helmet"), clash], "file")
    other = Layout("helmet-120", family[0].positions)
    with pytest.raises(LayoutConflictError, match="different layout named helmet-120"):
        merge(registry, [other], "file")
    assert registry.version == last
    assert merge(registry, [other], "file", force=True) == last + 1
    step = registry.undo()
    assert (step.undone, step.changed, step.added, step.removed) == ("file", ("helmet-120",), (), ())
    assert registry.get("helmet-120").to_dict() == before["helmet-120"]
    registry.undo(4)
    assert {layout.name: layout.to_dict() for layout in registry.layouts()} == before
    assert len(registry.redo().added) == 4
    assert len(registry.layouts()) == 8
    with pytest.raises(RegistryError, match="no version 99"):
        registry.undo(99)


def test_undo_goes_back_command_by_command_and_redo_forward(tmp_path: Path) -> None:
    registry = Registry(tmp_path / "r.sqlite")
    for number, name in enumerate(("one", "two", "three")):
        registry.add(Layout(name, SCALENE * (0.6 + 0.1 * number)), f"file {name}")

    def names() -> list[str]:
        return [layout.name for layout in registry.layouts() if layout.name not in builtin_layouts()]

    with pytest.raises(RegistryError, match="nothing to redo"):
        registry.redo()
    assert registry.undo().undone == "file three" and names() == ["one", "two"]
    assert registry.undo().removed == ("two",) and names() == ["one"]
    assert registry.redo().added == ("two",) and names() == ["one", "two"]
    assert registry.redo().added == ("three",) and names() == ["one", "three", "two"]
    for _ in range(2):
        registry.undo()
    registry.add(Layout("four", SCALENE), "file four")
    with pytest.raises(RegistryError, match="nothing to redo"):
        registry.redo()  # a new change ends the row of what was undone
    assert registry.undo().undone == "file four" and names() == ["one"]
    assert registry.undo().undone == "file one" and names() == []
    with pytest.raises(RegistryError, match="nothing to undo"):
        registry.undo()
    assert registry.redo().added == ("one",) and registry.redo().added == ("four",)
    assert names() == ["four", "one"]


def test_two_commands_of_one_moment_are_two_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Stopped(datetime):
        """A clock that stands still."""

        @classmethod
        def now(cls, tz: tzinfo | None = None) -> datetime:
            return datetime(2026, 11, 26, tzinfo=tz)

    monkeypatch.setattr(registry_module, "datetime", Stopped)
    registry = Registry(tmp_path / "r.sqlite")
    registry.add(Layout("one", SCALENE), "command line")
    registry.add(Layout("two", SCALENE * 0.8), "command line")
    registry.add_all([Layout("three", SCALENE * 0.7), Layout("four", SCALENE * 0.6)], "command line")
    assert [change.command for change in registry.history()] == [4, 4, 4, 4, 5, 6, 8, 8]
    assert [change.command for change in registry.history("three")] == [8]
    assert set(registry.undo().removed) == {"three", "four"}
    assert registry.undo().removed == ("two",)
    # In files of older versions, times are whole seconds.
    alter(registry.path, "UPDATE change SET time_utc = '2026-11-26T00:00:00+00:00', source = 'x'")
    assert {change.command for change in registry.history()} == {registry.version}


def test_a_source_with_an_endless_number_is_no_undo(tmp_path: Path) -> None:
    registry = Registry(tmp_path / "r.sqlite")
    registry.add(Layout("one", SCALENE), "back to version " + "9" * 5000)
    assert registry.undo().removed == ("one",)
    alter(registry.path, "UPDATE change SET name = x'ff' WHERE version = 5")
    with pytest.raises(RegistryError, match="damaged change, version 5"):
        registry.history()


def test_a_file_of_layouts_comes_back_unchanged(tmp_path: Path) -> None:
    made = design(object_named("mug").with_rows(2), DesignRules(), 5, "mug-r3s12").layouts
    seen = np.tile([[1e-6, 2e-7], [2e-7, 3e-6]], (3, 1, 1))
    family = [*made[:4], replace(made[4], covariance=seen)]
    path = tmp_path / "family.toml"
    write_layouts(family, path)
    assert [a.to_dict() for a in read_layouts(path)] == [a.to_dict() for a in family]
    good = path.read_text()
    for old, new, words in (
        ("version = 1", "version = 9", "newer"),
        ("tagid.layouts", "tagid.images", "format"),
        ("mug-r3s12-02", "mug-r3s12-01", "twice"),
        ("mug-r3s12-02", "../mug", "layout 2"),
        ("mug-r3s12-02", "mug\\u0007", "layout 2"),
        ("heights_m = [", "heights_m = [9.0,", "heights_m"),
        ("version = 1", "version = 1 ]]", "TOML"),
        (good, 'format = "tagid.layouts"\nversion = 1\n', "no"),
    ):
        path.write_text(good.replace(old, new, 1))
        with pytest.raises(FileFormatError) as caught:
            read_layouts(path)
        assert words in f"{caught.value.message} {caught.value.remedy}"
        assert path.name in caught.value.message
