"""sqlite files where locks, room or permissions are missing: read all the same, and never given up."""

from __future__ import annotations

import errno
import os
import resource
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
from test_history import record

from tagid.batch.spool import Spool
from tagid.errors import DiskFullError, StorageError, UsageError
from tagid.files import storage_error
from tagid.storage.history import Filter, History

NO_LOCKS = Path(__file__).parents[1] / "data" / "nolock.c"
READ = """
import sys
from pathlib import Path
from tagid.batch.spool import Spool
from tagid.errors import TagidError
from tagid.storage.history import History
from tagid.enrolling.registry import Registry
folder = Path(sys.argv[1])
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
def history(tmp_path: Path) -> History:
    """A history whose newest entry is in its write-ahead log only, with a registry beside it."""
    from tagid.enrolling.registry import Registry

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


def read(folder: Path, **how: object) -> list[str]:
    words = [sys.executable, "-c", READ, str(folder)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, **how)  # type: ignore[call-overload]
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.skipif(not shutil.which("cc"), reason="needs a C compiler")
@pytest.mark.parametrize("code", [37, 95, 5])
def test_without_locks_it_is_read_and_not_written(history: History, tmp_path: Path, code: int) -> None:
    library = tmp_path / "nolock.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-o", library, NO_LOCKS, "-ldl"], check=True)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()}
    recovered = read(tmp_path, env={**os.environ, "LD_PRELOAD": str(library), "LOCKERR": str(code)})
    assert recovered[:2] == ["['uuid-1', 'uuid-0']", "4 4"]
    assert len(recovered) == 5
    for line, remedy in zip(recovered[2:], ("TAGID_DATA", "TAGID_DATA", "`out`"), strict=True):
        assert "has no locks" in line and remedy in line
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == before


def test_a_pipe_in_the_place_of_a_file_is_told_and_not_waited_for(tmp_path: Path) -> None:
    words = [sys.executable, "-c", PIPES, str(tmp_path)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=30)
    assert done.stdout.split() == ["True"] * 5, done.stderr


def test_a_read_only_file_system_is_told() -> None:
    error = storage_error(OSError(errno.EROFS, "Read-only file system"), Path("/media/a"), "writing")
    assert error.message == "/media/a: the file system is read-only"


def test_without_room_for_the_log_it_is_read(history: History, tmp_path: Path) -> None:
    def no_room() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))

    recovered = read(tmp_path, preexec_fn=no_room)
    assert recovered[:2] == ["['uuid-1', 'uuid-0']", "4 4"]
    for line in recovered[2:]:
        assert line.startswith("no space left") and "Free some space" in line


def test_of_a_lock_that_is_held_nothing_is_lost(history: History) -> None:
    holder = sqlite3.connect(history.path, isolation_level=None)
    holder.execute("BEGIN IMMEDIATE")
    hasty = History(history.path, wait_s=0)
    assert hasty.count() == 2
    with pytest.raises(StorageError, match="locked") as caught:
        hasty.begin("scan", {})
    assert "try again later" in caught.value.remedy
    holder.close()
    hasty.begin("scan", {})


def test_only_a_damaged_file_is_to_be_moved_away(tmp_path: Path) -> None:
    (tmp_path / "noise").write_bytes(b"noise" * 1000)
    with pytest.raises(StorageError) as caught:
        History(tmp_path / "noise")
    assert "move the file away" in caught.value.remedy
    (tmp_path / "file").touch()
    with pytest.raises(StorageError) as caught:
        History(tmp_path / "file" / "history.sqlite")
    assert "TAGID_DATA" in caught.value.remedy


def test_a_value_that_sqlite_cannot_hold_is_an_error_of_use(history: History) -> None:
    for wanted in (Filter(file="\udcff"), Filter(numbers=(1 << 70,))):
        with pytest.raises(UsageError):
            list(history.find(wanted))
    assert DiskFullError.code == "disk_full"
