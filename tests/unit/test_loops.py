"""Compiled loops that are missing or older than the program are not used, and the doctor says so."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

from tagid import doctor, loops

ROOT = Path(__file__).resolve().parents[2]
SHEET = "tagid.reading._sheet"


def test_every_extension_of_the_package_is_listed() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert {item["name"] for item in project["tool"]["setuptools"]["ext-modules"]} == set(loops.LOOPS)


def test_the_installed_loops_are_those_of_the_sources() -> None:
    for name in loops.LOOPS:
        source = (ROOT / name.replace(".", "/")).with_suffix(".c").read_text()
        number = loops.LOOPS[name]
        assert f'"ARGUMENTS", {number})' in source or f"{number})" in source[source.rindex("MODULE(") :]


@pytest.mark.parametrize("number", [None, 0, 99])
def test_a_loop_of_other_arguments_is_not_used(number: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    other = ModuleType(SHEET)
    if number is not None:
        other.ARGUMENTS = number  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, SHEET, other)
    assert loops.loop(SHEET) is None and SHEET in loops.unusable()


def test_the_doctor_names_loops_that_cannot_be_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loops, "unusable", lambda: (SHEET,))
    result = doctor._engines()
    assert result.level == "warning" and "compiled loops missing or outdated: sheet," in result.text
    monkeypatch.setattr(loops, "unusable", lambda: tuple(loops.LOOPS))
    assert "no compiled loops," in doctor._engines().text
    monkeypatch.setattr(loops, "unusable", tuple)
    assert doctor._engines().level == "ok"
