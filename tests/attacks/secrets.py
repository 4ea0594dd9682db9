"""Attacks on pass-keys, on names that tagid chooses, on files that have no end, and with absurd numbers."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import numpy as np

from tests import typed_numbers
from tests.attacks import Outcome, attack
from tests.command_server import CommandServer

TAGID = [sys.executable, "-m", "tagid"]
DATA = Path(__file__).parents[1] / "data"
KEY = "918273"
URL = f"roomba+ble://R2?passkey={KEY}&wait=1"
_LAYOUTS = "tests/cli/test_first_use.py::test_layouts_are_listed_as_the_registry_holds_them"
_SECRETS, _ABSURD = "tests/cli/test_secrets.py", "tests/cli/test_absurd_input.py"


def _run(folder: Path, *words: str, limit_s: float = 60, **more: str) -> subprocess.CompletedProcess[str]:
    """A command; exit code 124 where it did not end."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", **more}
    try:
        return subprocess.run(
            [*TAGID, *words], cwd=folder, env=environment, capture_output=True, text=True, timeout=limit_s
        )
    except subprocess.TimeoutExpired:
        return subprocess.CompletedProcess(words, 124, "", "")


@attack(
    "F4", "the pass-key stands in files and output", before="3 files, 8 outputs of 11",
    test=f"{_SECRETS}::test_nothing_that_is_written_or_printed_holds_the_pass_key",
)  # fmt: skip
def pass_key(folder: Path) -> Outcome:
    _run(folder, "simulate", "helmet-120", "--views", "36", "--out", "a.tagid.h5")
    faulty = f"roomba+ble://R2?passkey={KEY}x"
    commands = [
        ("identify", "a.tagid.h5", "--motion", URL, "--output", "json"),
        ("motion", "info", faulty),
        ("motion", "info", f"roomba+ble://R2?passkey={KEY}&passkey={KEY}"),
        ("motion", "info", f"roomba+ble://R2?pass%6bey={KEY}&step=99"),
        ("config", "set", "motion.url", faulty),
        ("config", "set", "motion.url", URL),
        ("config", "set", "motion.passkey", KEY),
        ("config",),
        ("config", "--output", "json"),
        ("report", "a.tagid.h5", "--out", "rep", "-j", "1"),
        ("scan", "--demo", "--scans", "200", "--save-dir", "scans", "-vv"),
    ]
    outputs = [_run(folder, *words) for words in commands]
    printed = sum(KEY in done.stdout + done.stderr for done in outputs)
    config = Path(os.environ["TAGID_CONFIG"])
    roots = (folder, Path(os.environ["TAGID_DATA"]))
    files = [path for root in roots for path in root.rglob("*") if path.is_file() and path != config]
    held = [path.name for path in files if KEY.encode() in path.read_bytes()]
    return Outcome(f"{len(held)} files, {printed} outputs of {len(commands)}", not held and not printed)


@attack(
    "F18", "pictures and reports are written through planted links", before="3 of 3 files destroyed",
    test=f"{_SECRETS}::test_a_planted_link_is_replaced_and_one_that_the_user_names_is_followed",
)  # fmt: skip
def planted_links(folder: Path) -> Outcome:
    precious = [folder / name for name in ("a", "b", "c")]
    for path in precious:
        path.write_text("precious")
    shared, report = folder / "shared", folder / "rep"
    shared.mkdir()
    report.mkdir()
    for second in range(120):
        name = time.strftime("scan-%Y%m%d-%H%M%S", time.localtime(time.time() + second))
        (shared / f"{name}.png").symlink_to(precious[0])
        (shared / f"{name}.image.npz").symlink_to(precious[0])
    for name in ("report.html", "summary.json", "items.jsonl", "items.csv", "junit.xml"):
        (report / name).symlink_to(precious[1])
    (folder / "x.show.png").symlink_to(precious[2])
    _run(folder, "scan", "--demo", "--save-dir", "shared")
    _run(folder, "simulate", "points-3", "--views", "24", "--out", "x.tagid.h5")
    _run(folder, "report", "x.tagid.h5", "--out", "rep", "-j", "1")
    _run(folder, "show", "x.tagid.h5")
    drawn = sum(path.is_file() and not path.is_symlink() for path in shared.glob("scan-*.png"))
    lost = sum(path.read_text(errors="replace") != "precious" for path in precious)
    return Outcome(f"{lost} of 3 files destroyed", lost == 0 and drawn == 1)


@attack(
    "F10", "a small response file takes all the memory", before="0 of 4 refused, 4.5 to 9.3 GB",
    test=f"{_ABSURD}::test_a_response_between_whose_frequencies_no_object_fits",
)  # fmt: skip
def close_frequencies(folder: Path) -> Outcome:
    content = dict(np.load(DATA / "responses" / "can30_c180.npz"))
    refused = 0
    for step in (1e3, 1e-3, 1e13, 1e299):
        content["frequency_hz"] = 4e9 + np.arange(21) * step
        np.savez_compressed(folder / "close.npz", **content)
        done = _limited(folder, 4, "simulate", "--response", "close.npz", "--views", "24", "--out", "r.h5")
        refused += done.returncode == 1 and "bug in tagid" not in done.stderr
    return Outcome(f"{refused} of 4 refused", refused == 4)


@attack(
    "F10b", "sizes from options are not compared with the limits of the process", before="0 of 2 refused",
    test=f"{_ABSURD}::test_limits_of_the_process_and_of_its_group_count_as_memory",
)  # fmt: skip
def large_sizes(folder: Path) -> Outcome:
    for name, height in (("a", "0"), ("b", "0.3")):
        more = ("--antenna-height", height, "--out", f"{name}.tagid.h5")
        _run(folder, "simulate", "helmet-120", "--views", "36", *more)
    _run(folder, "join", "a.tagid.h5", "b.tagid.h5", "--out", "both.tagid.h5")
    words = ("reconstruct", "a.tagid.h5")
    cases = (
        (
            "reconstruct",
            "both.tagid.h5",
            "--volume",
            "--heights=-0.1,0.1",
            "--pixels",
            "1024",
            "--levels",
            "512",
            "--method",
            "bp",
        ),
        (*words, "--method", "ats", "--ats", "aspect_harmonics=1000000"),
    )
    ended = [_limited(folder, 5, *case) for case in cases]
    refused = sum(done.returncode == 2 and "bug in tagid" not in done.stderr for done in ended)
    return Outcome(f"{refused} of 2 refused", refused == 2)


def _limited(folder: Path, gigabytes: int, *words: str) -> subprocess.CompletedProcess[str]:
    """A command under a limit of address space."""
    limit = f'ulimit -v {gigabytes * 10**6}; exec {sys.executable} -m tagid "$@"'
    try:
        return subprocess.run(
            ["bash", "-c", limit, "tagid", *words], cwd=folder, capture_output=True, text=True, timeout=60,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return subprocess.CompletedProcess(words, 124, "", "")


@attack("F11", "a view in the registry never ends", before="no end, SIGTERM ignored", test=_LAYOUTS)
def endless_view(folder: Path) -> Outcome:
    _run(folder, "layouts")
    with closing(sqlite3.connect(Path(os.environ["TAGID_DATA"]) / "registry.sqlite")) as connection:
        connection.executescript(
            "DROP TABLE layout; CREATE VIEW layout AS WITH RECURSIVE x(n) AS "
            "(SELECT 1 UNION ALL SELECT n + 1 FROM x) SELECT n name, n definition, n version FROM x"
        )
    process = subprocess.Popen([*TAGID, "layouts"], stderr=subprocess.PIPE, text=True, cwd=folder)
    try:
        _, errors = process.communicate(timeout=20)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGTERM)
        time.sleep(5)
        ignored = process.poll() is None
        process.kill()
        return Outcome("no end" + ", SIGTERM ignored" * ignored, False)
    return Outcome("refused", process.returncode == 1 and "view or trigger" in errors)


@attack(
    "F11b", "a configuration that is a pipe, a device or huge", before="0 of 3 refused",
    test=f"{_ABSURD}::test_a_configuration_that_is_no_file",
)  # fmt: skip
def endless_configuration(folder: Path) -> Outcome:
    os.mkfifo(folder / "pipe")
    with (folder / "huge").open("wb") as file:
        file.truncate(1 << 40)
    refused = 0
    for name in ("pipe", "huge", "/dev/zero"):
        limit = 'ulimit -v 4000000; exec timeout 20 "$@"'
        done = subprocess.run(
            ["bash", "-c", limit, "x", *TAGID, "config"], cwd=folder, capture_output=True, text=True,
            env={**os.environ, "TAGID_CONFIG": name},
        )  # fmt: skip
        refused += done.returncode in (1, 2) and "bug in tagid" not in done.stderr
    return Outcome(f"{refused} of 3 refused", refused == 3)


@attack(
    "F11c", "a lock that is always refused: files are made and deleted for ever",
    before="2 of 3 errors: no end with EAGAIN",
    test=f"{_SECRETS}::test_a_file_is_written_and_read_where_every_lock_is_refused",
)  # fmt: skip
def refused_locks(folder: Path) -> Outcome:
    compiler = shutil.which("gcc")
    if compiler is None:
        return Outcome("not tried: no gcc", True)
    source = "#include <errno.h>\n#include <stdlib.h>\n"
    source += 'int flock(int d, int o) { errno = atoi(getenv("LOCK_ERROR")); return -1; }\n'
    (folder / "nolock.c").write_text(source)
    library = folder / "nolock.so"
    subprocess.run([compiler, "-shared", "-fPIC", folder / "nolock.c", "-o", library], check=True)
    written = 0
    for error in (errno.EAGAIN, errno.ENOLCK, errno.EIO):
        more = {"LD_PRELOAD": str(library), "LOCK_ERROR": str(error)}
        name = f"{error}.tagid.h5"
        done = _run(folder, "simulate", "points-3", "--views", "24", "--out", name, limit_s=20, **more)
        shown = _run(folder, "show", name, limit_s=20, **more)
        written += done.returncode == 0 and shown.returncode == 0
    rest = [path for path in folder.iterdir() if path.name.startswith(".")]
    return Outcome(f"{written} of 3 errors: written and read", written == 3 and not rest)


@attack(
    "F17", "absurd numbers are a bug in tagid", before="9 kinds of absurd number",
    test=f"{_ABSURD}::test_absurd_numbers_are_refused",
)  # fmt: skip
def absurd_numbers(folder: Path) -> Outcome:
    typed_numbers.prepare(folder)
    environment = {
        **os.environ, "TAGID_RADAR_TIMEOUT_S": "0.05", "TAGID_RADAR_RESUME_S": "0", "OMP_NUM_THREADS": "1",
    }  # fmt: skip
    # `tests/typed_numbers.py` has more values; those that are accepted take as long as the command.
    tried = [
        case
        for case in typed_numbers.cases()
        if case.value in ("1e300", "9" * 60)
        or (case.value == "nan" and case.words[0] != "radar")
        or (case.value == "1e-300" and case.words[0] in ("enroll", "simulate", "reconstruct"))
    ]
    with CommandServer(folder, environment) as server, ThreadPoolExecutor(2) as pool:
        server.run(["layouts"], folder, environment, 60)

        def fault(case: typed_numbers.Case) -> str:
            try:
                done = server.run(list(case.words), folder, environment, 30)
            except subprocess.TimeoutExpired:
                done = None
            return typed_numbers.fault(case, done)

        faults = [
            f"{case.words[0]} {case.option}"
            for case, text in zip(tried, pool.map(fault, tried), strict=True)
            if text
        ]
    return Outcome(f"{len(faults)} of {len(tried)} {', '.join(faults[:5])}".strip(), not faults)
