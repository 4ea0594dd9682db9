"""The history of identifications: kept whole, filtered, exported, safe with several processes; and sqlite
files where locks, room or permissions are missing: read all the same, and never given up."""

from __future__ import annotations

import csv
import errno
import hashlib
import json
import os
import resource
import shutil
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from datetime import datetime
from pathlib import Path

import pytest

from tagid.batch.spool import Spool
from tagid.enrolling.registry import Registry
from tagid.errors import MissingExtraError, StorageError, UsageError
from tagid.files import storage_error
from tagid.storage.history import FIELDS, TYPES, Filter, History, HistoryEntry, export


def record(number: int = 0, **changes: object) -> dict[str, object]:
    return {
        "file": f"captures/{number}.tagid.h5",
        "time_utc": f"2026-11-{number % 28 + 1:02d}T08:00:00.000+00:00",
        "content_sha256": "ab" * 32, "capture_uuid": f"uuid-{number}",
        "status": "identified", "reason": "", "advice": "Turn it.", "recording_note": "gate 4",
        "causes": [
            {"code": "turn_stopped", "text": "it stood still", "remedy": "Start the table."},
            {"code": "speed", "text": "another speed", "remedy": "Give it."},
        ],
        "layout": "helmet-120", "label": "", "score": 0.9, "margin": 0.5, "missing": 0, "extra": 1,
        "rotation_deg": 40.0, "centre_m": [0.001, -0.002],
        "reflectors": [
            {"x_m": 0.11, "y_m": 0.0, "amplitude_db": 0.0, "matched": True},
            {"x_m": -0.05, "y_m": 0.09, "amplitude_db": -3.0, "matched": False},
        ],
        "registry_version": 4, "model_sha256": None, "tool_version": "0.1.0",
        "seconds": {"read": 0.25, "load": 0.5}, "error": None, **changes,
    }  # fmt: skip


@pytest.fixture
def history(tmp_path: Path) -> History:
    return History(tmp_path / "data" / "history.sqlite")


def test_what_is_kept_comes_back(history: History) -> None:
    run = history.begin("report", {"imaging": {"pixels": 128}})
    (number,) = history.add(run, [record()])
    (entry,) = history.find()
    assert tuple(entry.to_json()) == FIELDS == tuple(TYPES)
    assert entry == HistoryEntry(
        id=number,
        command="report",
        centre_x_m=0.001,
        centre_y_m=-0.002,
        total_s=0.75,
        error_code=None,
        error_message=None,
        cause="it stood still. Start the table.",
        **{name: value for name, value in record().items() if name in FIELDS},
    )
    assert history.reflectors(number) == record()["reflectors"]


def test_filters(history: History) -> None:
    scan, report = history.begin("scan", {}), history.begin("report", {})
    history.add(scan, [record(n) for n in range(3)])
    failed = {"code": "bad_file", "message": "damaged", "remedy": ""}
    history.add(report, [record(9, status="unknown", layout=None), record(12, status="failed", error=failed)])

    def found(**wanted: object) -> list[str]:
        return [entry.capture_uuid for entry in history.find(Filter(**wanted))]  # type: ignore[arg-type]

    assert found() == ["uuid-12", "uuid-9", "uuid-2", "uuid-1", "uuid-0"]
    assert found(status="unknown") == ["uuid-9"]
    assert found(layout="helmet-120", command="scan", limit=2) == ["uuid-2", "uuid-1"]
    assert found(since="2026-11-03", until="2026-11-13T07:59") == ["uuid-9", "uuid-2"]
    assert found(since="2026-11-10T09:00+01:00", limit=5) == ["uuid-12", "uuid-9"], "08:00 UTC"
    assert found(file="/1.tagid") == ["uuid-1"]
    assert found(capture_uuid="uuid-12") == ["uuid-12"]
    assert history.count(Filter(command="scan", limit=1)) == 3
    for wrong in ({"status": "fine"}, {"limit": 0}, {"limit": 1 << 70}):
        with pytest.raises(UsageError):
            Filter(**wrong)  # type: ignore[arg-type]
    for text in ("soon", "9999-12-31T23:59:59-23:59", "0001-01-01T00:00+14:00"):
        with pytest.raises(UsageError, match="not a date"):
            found(since=text)


def test_all_or_none_and_only_with_a_run(history: History) -> None:
    run = history.begin("identify", {})
    with pytest.raises(StorageError):
        history.add(run, [record(1), record(2, status="fine")])
    with pytest.raises(StorageError, match="FOREIGN KEY"):
        history.add(run + 1, [record()])
    assert history.count() == 0
    with closing(sqlite3.connect(history.path)) as connection:
        assert connection.execute("PRAGMA journal_mode").fetchone()[0] == "wal"
        assert connection.execute("PRAGMA user_version").fetchone()[0] == 3


def test_several_processes_lose_nothing(history: History) -> None:
    code = (
        "import json, sys\nfrom pathlib import Path\nfrom tagid.storage.history import History\n"
        "history = History(Path(sys.argv[1]))\nrun = history.begin('scan', {})\n"
        "for n in range(12): history.add(run, [json.loads(sys.argv[2])])\n"
    )
    words = [sys.executable, "-c", code, str(history.path), json.dumps(record())]
    processes = [subprocess.Popen(words) for _ in range(3)]
    assert [process.wait(120) for process in processes] == [0, 0, 0]
    assert history.count() == 36


def test_newer_and_damaged_files_are_told(history: History, tmp_path: Path) -> None:
    with closing(sqlite3.connect(history.path)) as connection:
        connection.execute("PRAGMA user_version = 9")
    (tmp_path / "noise").write_bytes(b"noise" * 1000)
    (tmp_path / "file").touch()
    for path, said in (
        (history.path, "schema 9"),
        (tmp_path / "noise", "move the file away"),
        (tmp_path / "file" / "history.sqlite", "TAGID_DATA"),
    ):
        with pytest.raises(StorageError) as caught:
            History(path)
        assert said in f"{caught.value.message} {caught.value.remedy}"


def test_export_to_csv_and_parquet(history: History, tmp_path: Path) -> None:
    run = history.begin("report", {})
    history.add(run, [record(n, file='a,"b"\n' if n == 1 else "c") for n in range(3)])
    assert export(history, Filter(), tmp_path / "h.csv") == 3
    with (tmp_path / "h.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["capture_uuid"] for row in rows] == ["uuid-0", "uuid-1", "uuid-2"]
    assert rows[1]["file"] == 'a,"b"\n'
    with pytest.raises(UsageError, match="format"):
        export(history, Filter(), tmp_path / "h.xls")
    parquet = pytest.importorskip("pyarrow.parquet")
    assert export(history, Filter(limit=2), tmp_path / "h.parquet") == 2
    table = parquet.read_table(tmp_path / "h.parquet")
    assert table.column_names == list(FIELDS)
    assert str(table.schema.field("time_utc").type) == "timestamp[ms, tz=UTC]"
    first, last = table.to_pylist()
    assert (first["capture_uuid"], last["capture_uuid"]) == ("uuid-1", "uuid-2"), "the newest, in order"
    assert first["score"] == 0.9
    assert first["time_utc"] == datetime.fromisoformat(str(record(1)["time_utc"]))


def test_parquet_without_its_library(
    history: History, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtraError, match="pyarrow"):
        export(history, Filter(), tmp_path / "h.parquet")
    assert not (tmp_path / "h.parquet").exists()


def test_a_time_without_a_zone_is_utc_wherever_the_computer_stands(
    history: History, monkeypatch: pytest.MonkeyPatch
) -> None:
    history.add(history.begin("report", {}), [record(time_utc="2026-11-03T08:00:00.000+00:00")])
    monkeypatch.setenv("TZ", "America/New_York")
    time.tzset()
    try:
        assert history.count(Filter(since="2026-11-03T08:00")) == 1
        assert history.count(Filter(until="2026-11-03T08:00")) == 0, "before, and not at, that time"
        assert history.count(Filter(since="2026-11-03T08:01", until="2026-11-03T12:00")) == 0
    finally:
        monkeypatch.undo()
        time.tzset()


def test_pass_keys_of_earlier_runs_are_hidden(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    History(path).begin("identify", {"motion.url": "roomba+ble://R2?passkey=918273&wait=1"})
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        for column in ("advice", "cause", "recording_note"):
            connection.execute(f"ALTER TABLE identification DROP COLUMN {column}")
        connection.execute("PRAGMA user_version = 1")
    history = History(path)
    history.add(1, [record()])
    assert [entry.recording_note for entry in history.find()] == ["gate 4"]
    with closing(sqlite3.connect(path)) as connection:
        (settings,) = connection.execute("SELECT settings FROM run").fetchone()
    assert json.loads(settings) == {"motion.url": "roomba+ble://R2?passkey=***&wait=1"}
    assert b"918273" not in b"".join(file.read_bytes() for file in tmp_path.iterdir())


@pytest.mark.parametrize(
    ("column", "value"),
    [("score", "much"), ("margin", float("inf")), ("missing", "few"), ("file", b"\xff"),
     ("time_utc", b"\xff"), ("time_utc", "soon")],
)  # fmt: skip
def test_damaged_entries_are_told(history: History, tmp_path: Path, column: str, value: object) -> None:
    history.add(history.begin("scan", {}), [record(0), record(1)])
    connection = sqlite3.connect(history.path, isolation_level=None)
    connection.execute(f"UPDATE identification SET {column} = ? WHERE id = 2", (value,))
    connection.close()
    with pytest.raises(StorageError, match=f"number 2: {column}"):
        list(history.find())
    for name in ("h.csv", "h.parquet"):
        with pytest.raises((StorageError, MissingExtraError)):
            export(history, Filter(), tmp_path / name)
        assert not (tmp_path / name).exists()
    assert [entry.id for entry in history.find(Filter(numbers=(1,)))] == [1]


def test_what_is_stored_is_not_stored_again(history: History) -> None:
    run = history.begin("report", {"a": 1})
    history.begin("scan", {"a": 1})
    history.add(run, [record(0), record(0, file="a copy", seconds={"read": 0.3})])
    again = [record(0), record(1), record(2, content_sha256=None)]
    assert len(history.add(run, again, once=True)) == 2
    assert history.add(run, again, once=True) == []
    assert history.count() == 4
    settings = hashlib.sha256(b'{"a": 1}').hexdigest()
    assert (history.run_with("report", settings), history.run_with("report", "other")) == (run, None)


NO_LOCKS = Path(__file__).parents[1] / "data" / "nolock.c"
READ = """
import os, sys
from pathlib import Path
from tagid.batch.spool import Spool
from tagid.errors import TagidError
from tagid.storage.history import History
from tagid.enrolling.registry import Registry
folder, *codes = sys.argv[1:]
folder = Path(folder)
for code in codes or ["0"]:
    os.environ["LOCKERR"] = code
    history = History(folder / "history.sqlite")
    print([entry.capture_uuid for entry in history.find()])
    registry = Registry(folder / "registry.sqlite")
    print(len(registry.layouts()), len(registry.history()))
    report = folder / ".tagid-report.sqlite"
    for change in (
        lambda: registry.remove("helmet-120"), lambda: history.begin("scan", {}), lambda: Spool(report, False)
    ):
        try:
            change()
        except TagidError as error:
            print(f"{error.message} {error.remedy}")
"""

PIPES = """
import os
import sys
from pathlib import Path
from tagid.batch.spool import Spool
from tagid.errors import TagidError
from tagid.recording.session import start_journal
from tagid.batch.run import GrowingLines
from tagid.storage.history import History
from tagid.enrolling.registry import Registry
for kind, name in (
    (GrowingLines, "items.jsonl"),
    (lambda path: Spool(path, fresh=True), ".tagid-report.sqlite"),
    (History, "history.sqlite"),
    (Registry, "registry.sqlite"),
    (lambda path: start_journal(path.with_name("a.tagid.h5"), None), "a.tagid.journal"),
):
    path = Path(sys.argv[1]) / name
    os.mkfifo(path)
    try:
        kind(path)
    except TagidError as error:
        print(error.message == f"{path}: exists and is not a regular file")
"""


@pytest.fixture
def logged(tmp_path: Path) -> History:
    """A history whose newest entry is in its write-ahead log only, with a registry beside it."""
    Registry(tmp_path / "registry.sqlite")
    with Spool(tmp_path / ".tagid-report.sqlite", fresh=True):
        pass
    made = History(tmp_path / "made" / "history.sqlite")
    reader = sqlite3.connect(made.path)
    made.add(made.begin("scan", {}), [record(0)])
    reader.execute("SELECT * FROM run").fetchall()  # an open connection keeps the log
    made.add(made.begin("scan", {}), [record(1)])
    for suffix in ("", "-wal"):
        shutil.copy(f"{made.path}{suffix}", tmp_path / f"history.sqlite{suffix}")
    reader.close()
    assert (tmp_path / "history.sqlite-wal").stat().st_size
    return made


def read_by_another(folder: Path, *codes: int, **how: object) -> list[str]:
    words = [sys.executable, "-c", READ, str(folder), *map(str, codes)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, **how)  # type: ignore[call-overload]
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.skipif(not shutil.which("cc"), reason="needs a C compiler")
def test_without_locks_it_is_read_and_not_written(logged: History, tmp_path: Path) -> None:
    library = tmp_path / "nolock.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-o", library, NO_LOCKS, "-ldl"], check=True)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()}
    codes = (errno.ENOLCK, errno.EOPNOTSUPP, errno.EIO)
    recovered = read_by_another(tmp_path, *codes, env={**os.environ, "LD_PRELOAD": str(library)})
    assert len(recovered) == 5 * len(codes)
    for at in range(0, len(recovered), 5):
        assert recovered[at : at + 2] == ["['uuid-1', 'uuid-0']", "4 4"]
        for line, remedy in zip(
            recovered[at + 2 : at + 5], ("TAGID_DATA", "TAGID_DATA", "`out`"), strict=True
        ):
            assert "has no locks" in line and remedy in line
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == before


def test_a_pipe_in_the_place_of_a_file_is_told_and_not_waited_for(tmp_path: Path) -> None:
    words = [sys.executable, "-c", PIPES, str(tmp_path)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=30)
    assert done.stdout.split() == ["True"] * 5, done.stderr


def test_a_read_only_file_system_is_told() -> None:
    error = storage_error(OSError(errno.EROFS, "Read-only file system"), Path("/media/a"), "writing")
    assert error.message == "/media/a: the file system is read-only"


def test_without_room_for_the_log_it_is_read(logged: History, tmp_path: Path) -> None:
    def no_room() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))

    recovered = read_by_another(tmp_path, preexec_fn=no_room)
    assert recovered[:2] == ["['uuid-1', 'uuid-0']", "4 4"]
    for line in recovered[2:]:
        assert line.startswith("no space left") and "Free some space" in line


def test_of_a_lock_that_is_held_nothing_is_lost(logged: History) -> None:
    holder = sqlite3.connect(logged.path, isolation_level=None)
    holder.execute("BEGIN IMMEDIATE")
    hasty = History(logged.path, wait_s=0)
    assert hasty.count() == 2
    with pytest.raises(StorageError, match="locked") as caught:
        hasty.begin("scan", {})
    assert "try again later" in caught.value.remedy
    holder.close()
    hasty.begin("scan", {})


def test_a_value_that_sqlite_cannot_hold_is_an_error_of_use(history: History) -> None:
    for wanted in (Filter(file="\udcff"), Filter(numbers=(1 << 70,))):
        with pytest.raises(UsageError):
            list(history.find(wanted))
