"""Attacks on reports, on clusters of workers, and on the files of the registry and the history."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.attacks import Outcome, attack

TAGID = Path(sys.executable).parent / "tagid"
THREE = ("--point=0.1,0", "--point=-0.02,0.06", "--point=-0.05,-0.04")
OTHER = ("--point=0.12,0", "--point=-0.03,0.05", "--point=0.02,-0.1")
NO_LOCKS = Path(__file__).parents[1] / "data" / "nolock.c"


def tagid(*words: object, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [TAGID, *map(str, words)], capture_output=True, text=True, check=False, env=settings(**environment)
    )


def settings(**more: str) -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "200", **more}


def captures(folder: Path, count: int, *more: str) -> Path:
    """Small captures of one object with noise of their own; `more` are copies of the first."""
    folder.mkdir()
    for number in range(count):
        out = folder / f"{number}.tagid.h5"
        tagid("simulate", "helmet-120", "--views", 24, "--seed", number, "--out", out, "-q")
    for name in more:
        shutil.copy(folder / "0.tagid.h5", folder / name)
    return folder


def history_file() -> Path:
    return Path(os.environ["TAGID_DATA"]) / "history.sqlite"


def stored() -> int:
    with contextlib.closing(sqlite3.connect(history_file())) as connection:
        return int(connection.execute("SELECT COUNT(*) FROM identification").fetchone()[0])


@attack(
    "F15a",
    "answers of a killed and resumed report are missing in the history",
    before="7 of 8 in 4 of 4 runs",
    test="tests/report/test_report_history.py::test_what_a_killed_run_left_is_stored_by_the_next",
)
def _(folder: Path) -> Outcome:
    caps, out = captures(folder / "caps", 8), folder / "rep"
    words = ("report", caps, "--out", out, "--method", "bp", "--no-pictures", "-q", "-j")
    process = subprocess.Popen([TAGID, *map(str, words), "2"], env=settings(), start_new_session=True)
    while not (out / "items.jsonl").exists() or not (out / "items.jsonl").stat().st_size:
        time.sleep(0.001)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    tagid(*words, 2, "--resume")
    answers = len((out / "items.jsonl").read_text().splitlines())
    return Outcome(f"{stored()} of {answers}", stored() == answers == 8)


@attack(
    "F15c",
    "copies of one file are missing in the history of a killed and resumed report",
    before="2, 3 and 7 of 8 after three kills",
    test="tests/report/test_report_history.py::test_a_resumed_run_stores_copies_as_a_fresh_one_does",
)
def _(folder: Path) -> Outcome:
    caps = captures(folder / "caps", 1, *(f"copy-{number}.tagid.h5" for number in range(7)))
    out = folder / "rep"
    words = ("report", caps, "--out", out, "--method", "bp", "--no-pictures", "-q", "-j", 2)
    for _ in range(3):
        process = subprocess.Popen(
            [TAGID, *map(str, words), "--resume"], env=settings(), start_new_session=True
        )
        while process.poll() is None and not (out / "items.jsonl").exists():
            time.sleep(0.001)
        while process.poll() is None and not (out / "items.jsonl").stat().st_size:
            time.sleep(0.001)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    tagid(*words, "--resume")
    resumed = stored()
    tagid(*words, "--force")
    figure = f"{resumed} rows of 8, {stored() - resumed} in a fresh run"
    return Outcome(figure, resumed == 8 and stored() == 16)


@attack(
    "A8",
    "a pipe in the place of a file of a report",
    before="waits for ever and ignores SIGTERM; disk I/O error",
    test="tests/unit/test_database.py::test_a_pipe_in_the_place_of_a_file_is_told_and_not_waited_for",
)
def _(folder: Path) -> Outcome:
    caps = captures(folder / "caps", 1)
    wrong = []
    for name in ("items.jsonl", ".tagid-report.sqlite", "items.csv", "report.html", "summary.json"):
        out = folder / f"rep-{name}"
        out.mkdir()
        os.mkfifo(out / name)
        words = [TAGID, "report", caps, "--out", out, "--method", "bp", "--no-pictures", "-j", "1"]
        try:
            done = subprocess.run(
                words, capture_output=True, text=True, check=False, env=settings(), timeout=20
            )
        except subprocess.TimeoutExpired:
            wrong.append(f"{name}: hangs")
            continue
        if done.returncode != 1 or "not a regular file" not in " ".join(done.stderr.split()):
            wrong.append(f"{name}: {done.returncode} {done.stderr[-100:]}")
    return Outcome("; ".join(wrong) or "5 of 5 refused", not wrong)


@attack(
    "A7",
    "a report in a folder on a file system without locks",
    before="another report is writing, or disk I/O error: remove the file",
    test="tests/unit/test_database.py::test_without_locks_it_is_read_and_not_written",
)
def _(folder: Path) -> Outcome:
    library = folder / "nolock.so"
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", library, NO_LOCKS, "-ldl"], check=True)
    caps = captures(folder / "caps", 1)
    tagid("identify", caps / "0.tagid.h5", "-q")  # makes the registry and the history
    wrong = []
    for code in (37, 95, 38, 5):
        out = folder / f"rep-{code}"
        done = tagid("report", caps, "--out", out, "-q", LD_PRELOAD=str(library), LOCKERR=str(code))
        said = " ".join(done.stderr.split())
        if done.returncode != 1 or "has no locks" not in said or "--out" not in said:
            wrong.append(f"{code}: {done.returncode} {said[-100:]}")
    return Outcome("; ".join(wrong) or "4 of 4 told", not wrong)


@attack(
    "F15b",
    "a locked history costs 10 s per item, and nobody is told",
    before="told: False, 45 s; after --resume 0 of 4",
    test="tests/report/test_report_history.py::test_a_locked_history_is_told_and_waited_for_once",
)
def _(folder: Path) -> Outcome:
    caps, out = captures(folder / "caps", 4), folder / "rep"
    tagid("history")
    locked = sqlite3.connect(history_file(), isolation_level=None, check_same_thread=False)

    def lock() -> None:
        """Hold the history from the moment the run begins."""
        while not locked.execute("SELECT COUNT(*) FROM run").fetchone()[0]:
            time.sleep(0.002)
        locked.execute("BEGIN IMMEDIATE")

    holder = threading.Thread(target=lock)
    holder.start()
    words = ("report", caps, "--out", out, "--method", "bp", "--no-pictures", "-j", 1, "--output", "json")
    began = time.monotonic()
    first = json.loads(tagid(*words).stdout)
    seconds = time.monotonic() - began
    holder.join()
    locked.close()
    reported = any("not stored in the history" in text for text in first["messages"])
    tagid(*words, "--resume")
    figure = f"told: {reported}, {seconds:.0f} s; after --resume {stored()} of 4"
    return Outcome(figure, reported and stored() == 4 and seconds < 30)


class Cluster:
    """A scheduler and one worker, which is started again some seconds after it died."""

    def __init__(self, folder: Path, back_s: float) -> None:
        self._folder, self._back_s, self._stop = folder, back_s, threading.Event()
        (folder / "site").mkdir(parents=True)
        (folder / "site" / "sitecustomize.py").write_text(
            "import sys, os\nif any('dask_worker' in a for a in sys.orig_argv):\n"
            "    sys.addaudithook(lambda e, a: os._exit(9) if e == 'open' and 'poison' in str(a[0]) else 0)\n"
        )
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self.port}"
        self.scheduler = self._begin("dask_scheduler", "--port", str(self.port), "--no-dashboard")
        self._keeper = threading.Thread(target=self._keep)
        self._keeper.start()

    def _begin(self, module: str, *words: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{module}", "--host", "127.0.0.1", *words],
            cwd=self._folder,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=settings(PYTHONPATH=str(self._folder / "site")),
        )

    def _keep(self) -> None:
        words = (
            self.address,
            "--nthreads",
            "1",
            "--no-nanny",
            "--no-dashboard",
            "--local-directory",
            str(self._folder / "w"),
        )
        worker = self._begin("dask_worker", *words)
        while not self._stop.wait(0.1):
            if worker.poll() is not None and not self._stop.wait(self._back_s):
                worker = self._begin("dask_worker", *words)
        worker.kill()
        worker.wait()

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._keeper.join()
        self.scheduler.kill()
        self.scheduler.wait()


def poisoned(folder: Path, back_s: float) -> Outcome:
    caps = captures(folder / "caps", 5, "2poison.tagid.h5")
    words = ("report", caps, "--out", folder / "rep", "--method", "bp", "--no-pictures", "--output", "json")
    with Cluster(folder / "cluster", back_s) as cluster:
        done = tagid(*words, "--dask", cluster.address)
    if done.returncode != 5:
        return Outcome(f"exit {done.returncode}: {done.stdout[-200:]}{done.stderr[-200:]}", False)
    failed = {Path(item["file"]).name for item in json.loads(done.stdout)["data"]["items"] if item["error"]}
    return Outcome(f"listed as failed: {', '.join(sorted(failed))}", failed == {"2poison.tagid.h5"})


@attack(
    "F6a",
    "a capture that kills its worker: good captures are blamed (workers come back at once)",
    before="a good capture blamed in 3 of 4 runs",
    test="tests/report/test_report_cluster.py::test_a_cluster_gives_the_local_answers_though_workers_die_and_files_are_hostile",
)
def _(folder: Path) -> Outcome:
    return poisoned(folder, 0.0)


@attack(
    "F6b",
    "a capture that kills its worker: the scheduler is taken for lost (workers come back after 4 s)",
    before="exit 1 in 7 of 11 runs, a good capture blamed in 2",
    test="tests/report/test_report_cluster.py::test_a_cluster_gives_the_local_answers_though_workers_die_and_files_are_hostile",
)
def _(folder: Path) -> Outcome:
    return poisoned(folder, 4.0)


@attack(
    "F13",
    "`report --dask` towards a port that says nothing hangs and ignores signals",
    before="149 s until the other side closed; SIGTERM without effect",
    test="tests/report/test_report_cluster.py::test_a_silent_scheduler_is_told_and_a_stop_ends_the_wait",
)
def _(folder: Path) -> Outcome:
    caps = captures(folder / "caps", 1)
    lines = []
    held = True
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        for stop in (None, signal.SIGTERM, signal.SIGINT):
            began = time.monotonic()
            process = subprocess.Popen(
                [TAGID, "report", str(caps), "--out", str(folder / "rep"), "--dask", address, "-q"],
                env=settings(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
            )  # fmt: skip
            if stop is not None:
                time.sleep(5)
                process.send_signal(stop)
                began = time.monotonic()
            try:
                _, errors = process.communicate(timeout=40)
            except subprocess.TimeoutExpired:
                process.kill()
                _, errors = process.communicate()
                held = False
            seconds = time.monotonic() - began
            held &= "Traceback" not in errors and seconds < (3 if stop else 20)
            lines.append(f"{stop.name if stop else 'alone'}: exit {process.returncode} in {seconds:.1f} s")
    wrong = tagid("report", caps, "--out", folder / "rep", "--dask", "x")
    held &= wrong.returncode == 1 and "Traceback" not in wrong.stderr
    return Outcome("; ".join(lines), held)


@attack(
    "F16a",
    "one undo takes back two commands of the same second",
    before="two commands in 5 of 6 tries",
    test="tests/unit/test_registry.py::test_two_commands_of_one_moment_are_two_steps",
)
def _(folder: Path) -> Outcome:
    from tagid.enrolling.registry import Registry

    undone = []
    for number in range(4):
        data = str(folder / f"data-{number}")
        tagid("layouts", TAGID_DATA=data)
        words = ("--yes", "--force")
        both = [
            subprocess.Popen(
                [TAGID, "enroll", name, *words, *points, "-q"],
                env=settings(TAGID_DATA=data), stdout=subprocess.DEVNULL,
            )
            for name, points in (("one-a", THREE), ("two-b", OTHER))
        ]  # fmt: skip
        assert [process.wait() for process in both] == [0, 0]
        undone.append(len(Registry(Path(data) / "registry.sqlite").undo().removed))
    return Outcome(f"commands taken back by one undo: {undone}", undone == [1] * 4)


@attack(
    "F16b",
    "two alike objects that are enrolled at once are both stored",
    before="both stored, no conflict",
    test="tests/unit/test_signature_storage.py::test_alike_objects_enrolled_at_once_are_seen",
)
def _(folder: Path) -> Outcome:
    import numpy as np

    from tagid.enrolling.registry import Registry
    from tagid.errors import TagidError
    from tagid.pipeline.enrollment import propose_signature
    from tagid.tags.bodies.signature import Signature
    from tagid.tags.layouts.layout import Layout

    rng = np.random.default_rng(1)
    echo = (rng.standard_normal((9, 13)) + 1j * rng.standard_normal((9, 13))).astype("c8")

    def mug(name: str) -> Signature:
        return Signature(name, "object", np.linspace(65, 100, 9), echo, np.full(9, 1e-3), 0.04, 1.0)

    registry = Registry(folder / "registry.sqlite")
    before = registry.contents()
    refused = 0
    for name in ("mug-a", "mug-b"):
        try:
            propose_signature(before, mug(name)).store(registry, name)
        except TagidError:
            refused += 1
    registry.remove("mug-a")
    late = propose_signature(registry.contents(), mug("cup"))
    registry.add(Layout("cup", np.array([[0.1, 0.0], [-0.02, 0.06], [-0.05, -0.04]])), "meanwhile")
    try:
        late.store(registry, "late")
    except TagidError:
        refused += 1
    return Outcome(f"refused {refused} of 2", refused == 2)


@attack(
    "field 18",
    "a data folder on a file system without locks",
    before="database is locked, after up to 24 s, for every command",
    test="tests/unit/test_database.py::test_without_locks_it_is_read_and_not_written",
)
def _(folder: Path) -> Outcome:
    library = folder / "nolock.so"
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", library, NO_LOCKS, "-ldl"], check=True)
    capture = captures(folder / "caps", 1) / "0.tagid.h5"
    tagid("identify", capture, "-q")
    longest, wrong = 0.0, []
    for code in (37, 95, 38, 5):
        locks = {"LD_PRELOAD": str(library), "LOCKERR": str(code)}
        for words, exit_code, text in (
            (("identify", capture), 0, "TAGID_DATA"),
            (("history",), 0, ""),
            (("layouts", "--history"), 0, ""),
            (("enroll", "mine", "--yes", *THREE), 1, "has no locks"),
        ):
            began = time.monotonic()
            done = tagid(*words, **locks)
            longest = max(longest, time.monotonic() - began)
            said = " ".join(done.stderr.split())
            if done.returncode != exit_code or text not in said or "move the file" in said:
                wrong.append(f"{code} {words[0]}: {done.returncode} {said[-100:]}")
    figure = f"16 commands, {len(wrong)} wrong, longest {longest:.0f} s {'; '.join(wrong)}"
    return Outcome(figure.strip(), not wrong and longest < 20)


@attack(
    "F20a",
    "the data folder is full: the history cannot be read, and it is to be moved away",
    before="disk I/O error; move the file away",
    test="tests/unit/test_database.py::test_without_room_for_the_log_it_is_read",
)
def _(folder: Path) -> Outcome:
    capture = captures(folder / "caps", 1) / "0.tagid.h5"
    data = folder / "full"
    data.mkdir()
    script = (
        'mount -t tmpfs -o size=300k tmpfs "$1" || exit 99\n'
        '"$2" identify "$3" -q >/dev/null; dd if=/dev/zero of="$1/fill" bs=1k 2>/dev/null\n'
        '"$2" identify "$3" >/dev/null; echo "identify $?"; "$2" history; echo "history $?"\n'
    )
    done = subprocess.run(
        ["unshare", "--map-root-user", "-m", "bash", "-c", script, "attack", data, TAGID, capture],
        capture_output=True, text=True, check=False, env=settings(TAGID_DATA=str(data)),
    )  # fmt: skip
    said = " ".join(done.stderr.split())
    held = "identify 0" in done.stdout and "history 0" in done.stdout and "0.tagid.h5" in done.stdout
    full, moved = "no space left" in said, "move the file" in said
    return Outcome(f"answered and read: {held}, said to be full: {full}", held and full and not moved)


def damages() -> Iterator[tuple[str, tuple[Any, ...]]]:
    yield "UPDATE identification SET score = ?", ("much",)
    yield "UPDATE identification SET file = ?", (b"\xff\x00",)
    yield "UPDATE identification SET time_utc = ?", (b"\xff",)
    yield "UPDATE identification SET time_utc = ?", ("soon",)
    yield "UPDATE identification SET margin = ?", (float("inf"),)
    yield "UPDATE identification SET missing = ?", ("few",)
    yield "UPDATE run SET command = ?", (b"scan",)


@attack(
    "F17 history",
    "'This is a bug in tagid' for dates, numbers and rows of the history and the registry",
    before="OverflowError, ValueError, TypeError, ArrowInvalid",
    test="tests/unit/test_history.py::test_damaged_entries_are_told",
)
def _(folder: Path) -> Outcome:
    capture = captures(folder / "caps", 1) / "0.tagid.h5"
    tagid("identify", capture, "-q")
    bad, count = [], 0

    def wanted(code: int, *words: object) -> None:
        nonlocal count
        count += 1
        done = tagid(*words)
        if done.returncode != code or "bug in tagid" in done.stderr or "what to do" not in done.stderr:
            bad.append(f"{' '.join(map(str, words))}: {done.returncode}")

    for name in ("--since", "--until"):
        for moment in ("9999-12-31T23:59:59-23:59", "0001-01-01T00:00+14:00"):
            wanted(2, "history", name, moment)
    wanted(2, "history", "--limit", "9" * 30)
    whole = history_file().read_bytes()
    for statement, values in damages():
        with contextlib.closing(sqlite3.connect(history_file(), isolation_level=None)) as connection:
            connection.execute(statement, values)
        wanted(1, "history")
        wanted(1, "history", "export", folder / "x.csv")
        for path in history_file().parent.glob("history.sqlite*"):
            path.unlink()
        history_file().write_bytes(whole)
    registry = history_file().with_name("registry.sqlite")
    tagid("enroll", "mine", "--yes", *THREE)
    with contextlib.closing(sqlite3.connect(registry, isolation_level=None)) as connection:
        connection.execute(
            "UPDATE change SET source = ? WHERE version = 5", ("back to version " + "9" * 5000,)
        )
    count += 1
    if tagid("layouts", "undo").returncode != 0:
        bad.append("layouts undo")
    return Outcome(f"{count - len(bad)} of {count} answered {'; '.join(bad)}".strip(), not bad)
