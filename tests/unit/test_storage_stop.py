"""A write that is stopped or fails at any of its operations leaves the whole file or the previous one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import h5py
import numpy as np
import pytest
from storage_samples import FLOAT, capture

from tagid import files, interrupts
from tagid.errors import StorageError, TagidError
from tagid.storage import hdf5
from tagid.storage.hdf5 import growing_capture, read_capture, write_capture
from tagid.storage.journal import JournalWriter
from tagid.storage.journal_capture import write_captures


@pytest.fixture
def unsynced(monkeypatch: pytest.MonkeyPatch) -> None:
    """No waiting for the disk, in tests that write hundreds of files and cut no power."""
    monkeypatch.setattr(files.os, "fsync", lambda descriptor: None)


class Injected(BaseException):
    """Not an Exception, as KeyboardInterrupt is not."""


def injecting(monkeypatch: pytest.MonkeyPatch, at: int, do: Callable[[], Any]) -> list[str]:
    """Call `do` in operation number `at` of every file that is written; returns the operations so far."""
    operations: list[str] = []

    class Sabotaged(files.PatientFile):
        def _try(self, work: Callable[[], Any]) -> Any:
            operations.append(sys._getframe(1).f_code.co_name)
            if len(operations) - 1 != at:
                return super()._try(work)

            def sabotaged() -> Any:
                do()
                return work()

            return super()._try(sabotaged)

    monkeypatch.setattr(files, "PatientFile", Sabotaged)
    return operations


def parts(count: int = 2) -> list[Any]:
    """Parts of a long capture; appending makes HDF5 read back what it wrote."""
    rng = np.random.default_rng(4)
    rows = rng.integers(-(2**20), 2**20, (count, 9, 40)).astype(np.int32)
    first = capture()
    changes = {"radar": first.radar, "pulse": first.pulse, "uuid": first.uuid}
    return [capture(samples=samples, **changes) for samples in rows]


def write_parts(path: Path, pieces: list[Any]) -> None:
    with growing_capture(path) as append:
        for piece in pieces:
            append(piece)


def operations_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    with monkeypatch.context() as patch:
        operations = injecting(patch, -1, lambda: None)
        write_parts(tmp_path / "count", parts())
    (tmp_path / "count").unlink()
    return operations


@pytest.mark.parametrize(
    ("kind", "expected", "every"), [(OSError, StorageError, 2), (KeyboardInterrupt, KeyboardInterrupt, 3)]
)
def test_an_exception_in_any_operation_leaves_what_was_there(
    tmp_path: Path,
    unsynced: None,
    monkeypatch: pytest.MonkeyPatch,
    kind: type[BaseException],
    expected: type[BaseException],
    every: int,
) -> None:
    operations = operations_of(tmp_path, monkeypatch)
    assert {"write", "seek", "truncate"} <= set(operations)
    path, pieces = tmp_path / "a", parts()
    write_capture(path, capture(**FLOAT))
    before = path.read_bytes()
    for position in range(0, len(operations), every):
        with monkeypatch.context() as patch:
            injecting(patch, position, Mock(side_effect=kind("injected")))
            with pytest.raises(expected):
                write_parts(path, pieces)
        assert path.read_bytes() == before, (position, operations[position])
        assert [item.name for item in tmp_path.iterdir()] == ["a"]


def test_signals_in_any_operation_leave_the_whole_file(
    tmp_path: Path, unsynced: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    operations = operations_of(tmp_path, monkeypatch)
    path, pieces = tmp_path / "a", parts()
    samples = np.concatenate([piece.samples for piece in pieces])

    def signals() -> None:
        for number in (*interrupts.SIGNALS, signal.SIGINT):
            signal.raise_signal(number)

    for position in range(0, len(operations), 3):
        with monkeypatch.context() as patch, interrupts.handled():
            injecting(patch, position, signals)
            with pytest.raises(KeyboardInterrupt):
                write_parts(path, pieces)
        np.testing.assert_array_equal(read_capture(path).samples, samples, err_msg=operations[position])
        assert [item.name for item in tmp_path.iterdir()] == ["a"]
        path.unlink()


def test_reads_of_appended_parts_may_fail_as_well(tmp_path: Path) -> None:
    with files.replacing(tmp_path / "a") as stream:
        stream.write(b"abc")
        stream.seek(0)
        stream.failure = Injected("reading")
        buffer = bytearray(b"\xff" * 5)
        assert stream.readinto(buffer) == 5 and buffer == bytes(5)
        stream.failure = None
        stream.seek(0)
        assert stream.readinto(buffer) == 5 and bytes(buffer) == b"abc\0\0"


def edited(change: Callable[[Any], object]) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        with h5py.File(path, "r+", locking=False) as file:
            change(file)

    return damage


ZERO_ROWS = edited(lambda file: file["scans/samples"].__setitem__(slice(3, 5), 0))


def flipped_bit(path: Path) -> None:
    """In the compressed samples."""
    with h5py.File(path, locking=False) as file:
        at = file["scans/samples"].id.get_chunk_info(0).byte_offset + 20
    content = bytearray(path.read_bytes())
    content[at] ^= 0x10
    path.write_bytes(content)


DAMAGE: dict[str, Callable[[Path], None]] = {
    "rows of zeros": ZERO_ROWS,
    "fewer rows": edited(lambda file: [dataset.resize(8, axis=0) for dataset in file["scans"].values()]),
    "samples gone": edited(lambda file: file.pop("scans/samples")),
    "angles gone": edited(lambda file: file.pop("scans/angles_rad")),
    "pulse gone": edited(lambda file: file.pop("pulse")),
    "complete": edited(lambda file: file.attrs.update(complete=True)),
    "range": edited(lambda file: file.attrs.update(range_start_m=0.3100001)),
    "settings": edited(lambda file: file.attrs.update(radar=np.bytes_(b"{}"))),
    "one attribute more": edited(lambda file: file.attrs.update(more=1.0)),
    "a flipped bit": flipped_bit,
    "cut off": lambda path: os.truncate(path, path.stat().st_size // 2),
    "empty": lambda path: os.truncate(path, 0),
}
"""Of a file after it was synced, as a bad disk would."""


@pytest.mark.parametrize("name", DAMAGE)
def test_a_file_that_reads_back_differently_is_not_accepted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr(files, "forget_cached", DAMAGE[name])
    with pytest.raises(StorageError, match="read back"):
        write_capture(tmp_path / "a", capture())
    assert list(tmp_path.iterdir()) == []


def test_a_long_recording_is_read_back_part_by_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal = tmp_path / "a.tagid.journal"
    with JournalWriter(journal, {"range_start_m": 0.0, "range_step_m": 0.01}) as writer:
        for number in range(30):
            writer.append(number, number, float(number), np.arange(96, dtype=np.int32) * number)
        writer.close({})
    checked: list[str] = []
    real = hdf5._read_back

    def noted(temporary: Path, path: Path, written: Any) -> None:
        if len(checked) == 2:
            ZERO_ROWS(temporary)
        checked.append(path.name)
        real(temporary, path, written)

    monkeypatch.setattr(hdf5, "_read_back", noted)
    with pytest.raises(StorageError, match="samples"):
        write_captures(journal, lambda part: tmp_path / f"{part}.h5", part_bytes=10 * 96 * 4)
    assert checked == ["1.h5", "2.h5", "3.h5"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1.h5", "2.h5", "a.tagid.journal"]


KILLED = """
import os, signal, sys
from pathlib import Path
from tagid import files
with files.replacing(Path(sys.argv[1])) as stream:
    stream.write(b"half")
    if sys.argv[2] == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    print("writing", flush=True)
    sys.stdin.readline()
    stream.write(b" and half")
"""


def writer(path: Path, how: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", KILLED, str(path), how]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def test_the_next_writer_clears_what_killed_ones_left_and_nothing_else(tmp_path: Path) -> None:
    foreign = [".a.0123456789ab.tmp", "b.tagid.tmp", ".c.tagid.tmp.bak"]
    for name in foreign:
        (tmp_path / name).write_bytes(b"not ours")
    for _ in range(2):
        with writer(tmp_path / "a", "die") as dead:
            dead.communicate()
        assert dead.returncode == -signal.SIGKILL
    (remaining,) = [path.name for path in tmp_path.iterdir() if path.name not in foreign]
    assert remaining.endswith(".tmp")
    with writer(tmp_path / "b", "wait") as alive:
        assert alive.stdout.readline() == "writing\n"
        files.write_bytes(tmp_path / "c", b"whole")
        names = {path.name for path in tmp_path.iterdir()}
        assert remaining not in names
        assert len(names - {*foreign, "c"}) == 1, "the file of the living writer"
        alive.communicate("go on\n")
    assert (tmp_path / "b").read_bytes() == b"half and half"
    assert {path.name for path in tmp_path.iterdir()} == {*foreign, "b", "c"}


def test_a_file_taken_for_abandoned_before_its_lock_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = files.lock
    stolen: list[str] = []

    def lock(descriptor: int) -> bool | None:
        if not stolen:
            (path,) = tmp_path.iterdir()
            stolen.append(path.name)
            path.unlink()
        return real(descriptor)

    monkeypatch.setattr(files, "lock", lock)
    files.write_bytes(tmp_path / "a", b"whole")
    assert (tmp_path / "a").read_bytes() == b"whole" and len(list(tmp_path.iterdir())) == 1


def test_what_is_raised_in_the_block_leaves_nothing(tmp_path: Path) -> None:
    for error in (Injected("x"), KeyboardInterrupt(), TagidError("x"), GeneratorExit()):
        with pytest.raises(type(error)), files.replacing(tmp_path / "a") as stream:
            stream.write(b"half")
            raise error
        assert list(tmp_path.iterdir()) == []
