"""What attackers once broke: each has a test of its own."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import sqlite3
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile_files import REFUSED, ZEROS_BYTES, unknown_dataset
from rich.table import Table
from storage_samples import capture

from tagid.batch.spool import FILE_NAME as SPOOL_NAME
from tagid.batch.spool import Spool
from tagid.capture import Capture
from tagid.enrolling.registry import Registry
from tagid.errors import FileFormatError, ModelError, RegistryError, StorageError, TagidError, UsageError
from tagid.models_store import OPSET, open_model
from tagid.report.records import ItemRecord
from tagid.report.tables import CSV_COLUMNS, write_csv
from tagid.result import Problem, Result, render
from tagid.storage.history import FIELDS, FILE_NAME, Filter, History, export
from tagid.storage.importers import read_any
from tagid.tags.layouts.layout import Layout

ROOT = Path(__file__).resolve().parents[2]
POINTS = np.array([[0.1, 0.0], [-0.02, 0.06], [-0.05, -0.04]])
ENDLESS = "WITH RECURSIVE n (x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT"


def read_in_little_memory(path: Path) -> Capture:
    tracemalloc.start()
    try:
        return read_any(path)
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < ZEROS_BYTES / 10


@pytest.mark.parametrize("name", REFUSED)
def test_a_hostile_file_is_refused_in_little_memory(tmp_path: Path, name: str) -> None:
    REFUSED[name](tmp_path / name)
    with pytest.raises(FileFormatError, match=name):
        read_in_little_memory(tmp_path / name)


def test_a_dataset_that_is_not_known_is_not_read(tmp_path: Path) -> None:
    unknown_dataset(tmp_path / "a.tagid.h5")
    np.testing.assert_array_equal(read_in_little_memory(tmp_path / "a.tagid.h5").samples, capture().samples)


def neutral(path: Path) -> list[str]:
    """The cells of the one row of a table, none of which a spreadsheet takes for a formula."""
    with path.open(newline="") as file:
        (row,) = csv.DictReader(file)
    for value in row.values():
        assert not value.lstrip().startswith(("=", "+", "-", "@")), value
        assert value.isprintable()
    return [*row]


@pytest.mark.parametrize("start", ["=", "+", "-", "@", " =", "\t=", "\t", "\r"])
def test_every_csv_neutralises_what_a_spreadsheet_runs(tmp_path: Path, start: str) -> None:
    history = History(tmp_path / FILE_NAME)
    text = f"{start}1+1"
    record = dict.fromkeys(("label", "reason", "layout", "file"), text)
    numbers = dict.fromkeys(("score", "margin", "missing", "extra"), 0)
    history.add(history.begin(text, {}), [record | numbers | {"status": "unknown", "tool_version": "1"}])
    export(history, Filter(), tmp_path / "a.csv")
    assert neutral(tmp_path / "a.csv") == list(FIELDS)
    reported: dict[str, Any] = dict.fromkeys(CSV_COLUMNS, text)
    reported |= dict.fromkeys(("centre_m", "error", "correct", "coverage")) | {
        "reflectors": [],
        "seconds": {},
    }
    write_csv(tmp_path / "items.csv", [ItemRecord(reported)])
    assert neutral(tmp_path / "items.csv") == list(CSV_COLUMNS)


def test_such_texts_are_refused_at_enrolment(tmp_path: Path) -> None:
    registry = Registry(tmp_path / "r.sqlite")
    before = registry.version
    for text in ("=1+1", " -1", "@x", "+1", "a\tb", "a\x1b[31m", "a\x00", "\u202eabc"):
        for field in ("label", "notes"):
            with pytest.raises(UsageError, match=field):
                registry.add(Layout("mine", POINTS, **{field: text}), "a test")
            assert registry.version == before, text


def test_no_control_character_reaches_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    hostile = "\x1b]0;evil\x07\x1b[2J\x9b31m\u202e"
    table = Table(hostile)
    table.add_row(hostile)
    errors = (Problem("x", hostile, hostile),)
    render(Result("show", {}, table, messages=(hostile,), errors=errors), "human")
    printed = capsys.readouterr()
    for stream in (printed.out, printed.err):
        assert "evil" in stream
        assert not set(stream) & set("\x1b\x07\x9b\u202e")
    render(Result("show", {"path": hostile}, table, messages=(hostile,), errors=errors), "json")
    printed = capsys.readouterr()
    assert not set(printed.out) & set("\x1b\x07\x9b\u202e")
    assert json.loads(printed.out)["data"]["path"] == hostile


def add_to_spool(path: Path) -> None:
    with Spool(path, fresh=False):
        pass


@pytest.mark.parametrize(
    ("name", "opened", "table", "error"),
    [
        ("registry.sqlite", Registry, "layout", RegistryError),
        (FILE_NAME, History, "identification", StorageError),
        (SPOOL_NAME, add_to_spool, "item", StorageError),
    ],
)
def test_a_database_of_endless_views_is_refused(
    tmp_path: Path, name: str, opened: Callable[[Path], object], table: str, error: type[TagidError]
) -> None:
    path = tmp_path / name
    opened(path)
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("PRAGMA foreign_keys = OFF")
        columns = [f"x AS {row[1]}" for row in connection.execute(f"PRAGMA table_info ({table})")]
        connection.execute(f"DROP TABLE {table}")
        connection.execute(f"CREATE VIEW {table} AS {ENDLESS} {', '.join(columns)} FROM n")
    with pytest.raises(error, match="view or trigger") as caught:
        opened(path)
    assert caught.value.remedy
    if name == SPOOL_NAME:
        with pytest.raises(error, match="view or trigger"):
            Spool(path, fresh=True)


def model_with_data_elsewhere(location: str, nested: bool) -> bytes:
    """An ONNX graph that adds four numbers which another file holds."""
    pytest.importorskip("onnx", reason="writing a graph needs the extra 'export'")
    from onnx import TensorProto, helper

    tensor = helper.make_tensor("w", TensorProto.FLOAT, [4], bytes(16), raw=True)
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in (("location", location), ("offset", "0"), ("length", "16")):
        entry = tensor.external_data.add()
        entry.key, entry.value = key, value
    node = helper.make_node("Add", ["x", "w"], ["y"])
    nodes = [helper.make_node("Constant", [], ["w"], value=tensor), node] if nested else [node]
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [4]) for name in "xy"]
    graph = helper.make_graph(nodes, "g", ends[:1], ends[1:], [] if nested else [tensor])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=10)
    content: bytes = model.SerializeToString()
    return content


@pytest.mark.parametrize(
    ("location", "nested"), [("data.bin", False), ("../data.bin", True), ("/etc/hostname", False)]
)
def test_a_model_whose_data_lie_elsewhere_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, location: str, nested: bool
) -> None:
    folder = tmp_path / "models"
    folder.mkdir()
    for place in (tmp_path, folder):
        (place / "data.bin").write_bytes(np.arange(4, dtype=np.float32).tobytes())
    content = model_with_data_elsewhere(location, nested)
    (folder / "a.onnx").write_bytes(content)
    tensor = {"dtype": "float32", "shape": [4]}
    entry = {
        "file": "a.onnx", "sha256": hashlib.sha256(content).hexdigest(), "size": len(content),
        "opset": OPSET, "inputs": {"x": tensor}, "outputs": {"y": tensor},
    }  # fmt: skip
    (folder / "manifest.json").write_text(json.dumps({"manifest_version": 1, "models": {"a": entry}}))
    monkeypatch.chdir(folder)
    with pytest.raises(ModelError, match="other files"):
        open_model("a", folder=folder)


RUN_A_MODEL = """
import numpy as np
from tagid.models_store import manifest, open_model
name = sorted(manifest())[0]
model = open_model(name)
assert model.metadata is not None
import os, time
time.sleep(0.3)  # a background thread writes, too
"""


def test_onnxruntime_writes_nothing_into_the_users_folders(tmp_path: Path) -> None:
    environment: dict[str, Any] = {
        name: value for name, value in os.environ.items() if "TELEMETRY" not in name
    }
    folders = ("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME", "TMPDIR")
    for name in folders:
        (tmp_path / name).mkdir()
        environment[name] = str(tmp_path / name)
    environment |= {"PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
    words, home = [sys.executable, "-c", RUN_A_MODEL], tmp_path / "HOME"
    done = subprocess.run(words, env=environment, cwd=home, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert [path for path in tmp_path.rglob("*") if path.name not in folders] == []
