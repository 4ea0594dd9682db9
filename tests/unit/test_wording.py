"""Remedies name settings; the command line and the page say what they offer instead."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import typer.main

import tagid
from tagid.cli.app import app
from tagid.cli.wording import OPTIONS, in_options, result_in_options
from tagid.enrolling.enrollment import outlook
from tagid.result import Problem, Result, render
from tagid.simulate.spec import SceneSpec
from tagid.station import wire
from tagid.tags.layouts.layout import Layout, builtin_layouts

ROOT = Path(tagid.__file__).parent
LIBRARY = [path for path in sorted(ROOT.rglob("*.py")) if ROOT / "cli" not in path.parents]
COMMAND = re.compile(r"`[^`]*`|^tagid [^`]*$")
NAME = re.compile(r"`([a-z][a-z0-9_]*(?:\.[a-z0-9_]+)?)(?:=[^`\s]+)?`")
OTHERS = {"bluetooth", "cluster", "format"}
"""A service, an extra and a key of a file: no settings."""


def texts(path: Path) -> Iterator[str]:
    """The strings of a module that are no docstring; a computed part of one is {}."""

    def walk(node: ast.AST) -> Iterator[str]:
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            return
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value
        elif isinstance(node, ast.JoinedStr):
            yield "".join(part.value if isinstance(part, ast.Constant) else "{}" for part in node.values)
            for part in node.values:
                yield from () if isinstance(part, ast.Constant) else walk(part)
        else:
            for child in ast.iter_child_nodes(node):
                yield from walk(child)

    yield from walk(ast.parse(path.read_text()))


def test_the_library_names_no_option_but_in_a_whole_command() -> None:
    named = [
        f"{path.relative_to(ROOT)}: {text}"
        for path in LIBRARY
        if path.name != "processes.py"  # the arguments of systemd-run
        for text in texts(path)
        if re.search(r"(?<![\w-])--[a-z]", COMMAND.sub(lambda span: "" if " " in span[0] else span[0], text))
    ]
    assert named == []


def test_every_setting_that_the_library_names_has_an_option() -> None:
    named = {match[1] for path in LIBRARY for text in texts(path) for match in NAME.finditer(text)}
    # An error may name any field of a scene; `stop` and `stop_s` are in URLs only.
    scene = {item.name for item in fields(SceneSpec)} - {"stop", "stop_s"}
    assert set(OPTIONS) == named - OTHERS | scene


def declared(command: Any) -> Iterator[str]:
    """The options of a command and of those below it."""
    for parameter in command.params:
        yield from (*parameter.opts, *parameter.secondary_opts)
    for name in command.list_commands(None) if hasattr(command, "list_commands") else ():
        yield from declared(command.get_command(None, name))


def test_the_options_exist() -> None:
    assert {option.split(",")[0] for option in OPTIONS.values()} <= set(declared(typer.main.get_group(app)))


def test_a_result_names_options_in_text_and_in_json(capsys: pytest.CaptureFixture[str]) -> None:
    from rich.text import Text

    sentence = "Use `motion.axis_distance_m=1.10`, `force` or `nothing`."
    problem = Problem("data", "`want` is 2", sentence)
    data = {"items": [{"file": "`force`", "advice": sentence, "remarks": [sentence], "cause": sentence}]}
    result = result_in_options(
        Result("identify", data, Text(sentence), messages=(sentence,), errors=(problem,))
    )
    shown = "Use --axis-distance 1.10, --force or `nothing`."
    assert result.data == {
        "items": [{"file": "`force`", "advice": shown, "remarks": [shown], "cause": shown}]
    }
    assert (result.errors, result.messages) == ((Problem("data", "--want is 2", shown),), (shown,))
    render(result, "human")
    printed = capsys.readouterr()
    assert printed.out == f"{shown}\n" and printed.err.count(shown) == 2


def test_a_conflict_is_overridden_by_an_option_or_a_button() -> None:
    layout, *others = builtin_layouts().values()
    twin = Layout("twin", layout.positions)
    conflict = outlook(twin, [layout, *others]).conflict()
    assert "`force`" in conflict.remedy
    assert "override with --force;" in in_options(conflict.remedy)
    sent = wire.to_text({"trouble": wire.error_entry(conflict)})
    page = (ROOT / "station" / "page_files" / "index.html").read_text()
    assert "force" not in sent and "Enroll it anyway" in wire.in_page_words(conflict.remedy)
    assert ">Enroll it anyway</button>" in page
