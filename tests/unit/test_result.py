"""Results of commands: their status, and errors as documents state them."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import tagid
from tagid.errors import EXIT_DEVICE, DeviceError
from tagid.result import Problem, Result

ROOT = Path(tagid.__file__).parents[1]
SOURCES = [path for part in ("tagid", "firmware_tools") for path in sorted((ROOT / part).rglob("*.py"))]


@pytest.mark.parametrize(
    ("errors", "completed", "status"),
    [(0, 0, "success"), (0, 3, "success"), (1, 2, "partial"), (2, 0, "error")],
)
def test_the_status_follows_from_what_failed_and_what_was_completed(
    errors: int, completed: int, status: str
) -> None:
    result = Result("identify", errors=(Problem("bad_file", "cut short"),) * errors, completed=completed)
    assert result.envelope()["status"] == result.status == status


def test_an_error_keeps_its_exit_code_and_what_there_is_to_show() -> None:
    error = DeviceError("no radar replied", "Switch it on.")
    envelope = Result.from_error("radar find", error, {"asked": 3}, messages=("a remark",)).envelope()
    item = {"code": "device", "message": "no radar replied", "remedy": "Switch it on."}
    assert envelope["errors"] == [item] and Problem.from_json(item) == Problem.of(error)
    assert (envelope["status"], envelope["exit_code"]) == ("error", EXIT_DEVICE)
    assert envelope["data"] == {"asked": 3} and envelope["messages"] == ["a remark"]


def test_the_item_of_an_error_is_made_in_one_place() -> None:
    made = [
        path.name
        for path in SOURCES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Dict)
        and {"code", "message", "remedy"} <= {key.value for key in node.keys if isinstance(key, ast.Constant)}
    ]
    assert made == ["result.py"]
