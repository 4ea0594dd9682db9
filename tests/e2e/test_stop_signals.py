"""Stop signals aimed at the moment of writing, in real processes; `attack_signals.py` is the long run."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tagid.simulate.acquisition import Acquisition
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import scene_from_name
from tagid.storage.hdf5 import read_capture, write_capture
from tagid.storage.journal_capture import read_journal_capture

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "property"))

from attack_signals import attack, environment, started, wait_for


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("undisturbed")
    with started("simulate", folder) as process:
        process.communicate()
    return folder / "out" / "a.tagid.h5"


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture that is soon read."""
    file = tmp_path_factory.mktemp("small") / "a.tagid.h5"
    write_capture(file, simulate_capture(scene_from_name("helmet-120", 1), Acquisition(views=12), seed=1)[0])
    return file


@pytest.mark.parametrize("command", ["scan", "record", "simulate", "report"])
def test_signals_while_writing_cost_nothing(
    tmp_path: Path, undisturbed: Path, small: Path, command: str
) -> None:
    truth = {"simulate": undisturbed, "report": small}.get(command)
    codes = set()
    for number in range(2):
        folder = tmp_path / str(number)
        folder.mkdir()
        outcome = attack(command, folder, random.Random(f"{command}-{number}"), truth)
        assert outcome.faults == []
        codes.add(outcome.returncode)
    assert command == "report" or 130 in codes


@pytest.mark.parametrize("kind", [signal.SIGTERM, signal.SIGHUP])
def test_every_stop_signal_ends_a_scan_alike(tmp_path: Path, kind: signal.Signals) -> None:
    out = tmp_path / "out"
    with started("scan", tmp_path) as process:
        assert wait_for(
            lambda: any(path.stat().st_size > 100_000 for path in out.glob("*.tagid.journal")), process
        )
        process.send_signal(kind)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert err.count("error:") == 1, err
    (path,) = out.iterdir()
    capture = read_capture(path)
    assert capture.views > 10 and not capture.complete
    assert capture.samples.any(axis=1).all()


EXITING = """
import os
from tagid.cli import frame
from {program} import main

def exiting(code):
    os.kill(os.getpid(), {kind})
    raise SystemExit(code)

frame.sys.exit = exiting
main()
"""
DAMAGED = """
from tagid import files
from tagid.cli.app import main

def damage(path):
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size // 2)

files.forget_cached = damage
main()
"""


@pytest.mark.parametrize(
    ("program", "kind"),
    [
        ("tagid.cli.app", signal.SIGINT),
        ("tagid.cli.app", signal.SIGHUP),
        ("firmware_tools.cli", signal.SIGTERM),
    ],
)
def test_a_signal_after_the_last_write_changes_nothing(kind: signal.Signals, program: str) -> None:
    """Between the result and the end of the interpreter, where exit code and message are decided."""
    words = [sys.executable, "-c", EXITING.format(program=program, kind=int(kind)), "--help"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert (done.returncode, done.stderr) == (0, "")


def test_the_journal_stays_where_the_file_does_not_read_back(tmp_path: Path) -> None:
    for words in (["scan"], ["radar", "record"]):
        folder = tmp_path / words[-1]
        done = subprocess.run(
            [sys.executable, "-c", DAMAGED, *words, "--radar", "emulator://helmet-120", "--axis-distance",
             "1", "--scans", "60", "--save-dir", str(folder)],
            capture_output=True, text=True, cwd=tmp_path, timeout=120,
            env=environment(tmp_path),
        )  # fmt: skip
        assert done.returncode == 1, done.stderr
        (journal,) = folder.iterdir()
        assert journal.name.endswith(".tagid.journal")
        words_of_error = " ".join(done.stderr.split())
        assert "read back" in words_of_error and "tagid recover" in words_of_error
        assert read_journal_capture(journal).views == 60
