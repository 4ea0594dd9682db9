"""Child processes: no code of the current folder runs in them, and they end with their parent."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SHADOWED = ("selectors", "pickle", "socket", "tempfile", "numpy", "h5py", "syslog", "json", "runpy")


@pytest.fixture
def hostile(tmp_path: Path) -> Path:
    """A folder with modules of all kinds; each leaves a file if it runs, and fails."""
    folder = tmp_path / "hostile"
    (folder / "tagid").mkdir(parents=True)
    for name in (*SHADOWED, "tagid/__init__"):
        owned = tmp_path / f"owned-{name.replace('/', '-')}"
        (folder / f"{name}.py").write_text(f"open({str(owned)!r}, 'w'); raise SystemExit(9)\n")
    return folder


def owned(folder: Path) -> list[str]:
    return [path.name for path in folder.parent.glob("owned-*")]


def run(folder: Path, code: str, *words: str) -> subprocess.CompletedProcess[str]:
    """A program that runs in a folder but does not import from it."""
    done = subprocess.run(
        [sys.executable, "-P", "-W", "error", "-c", code, *words], cwd=folder, capture_output=True, text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"}, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done


def test_no_child_runs_code_of_the_current_folder(hostile: Path) -> None:
    """A module, a pool of multiprocessing with its resource tracker, and a module in place of a process."""
    code = """
import os, subprocess, sys
from tagid import processes
os.environ["PYTHONPATH"] = os.pathsep.join(("", ".", "here"))
with processes.start("tagid", "--version", stdout=subprocess.PIPE) as child:
    print(child.stdout.read().decode().split()[0])
with processes.spawn_context().Pool(1) as pool:
    print(pool.apply(divmod, (7, 4)))
assert "PYTHONSAFEPATH" not in os.environ, "the caller's own environment is kept"
sys.stdout.flush()
processes.replace("tagid", "--version")
"""
    name, result, again = run(hostile, code).stdout.splitlines()
    assert (name, result) == ("tagid", "(1, 3)") and again.startswith("tagid ")
    assert owned(hostile) == []


def test_a_child_finds_the_clone_from_which_its_parent_runs(tmp_path: Path) -> None:
    """`python -m tagid` in a clone: the child is of the clone, not of an installed version."""
    clone = tmp_path / "clone"
    shutil.copytree(
        ROOT / "tagid", clone / "tagid", ignore=shutil.ignore_patterns("*.so", "__pycache__", "data")
    )
    code = """
import os, subprocess, sys
sys.path.insert(0, os.getcwd())
from tagid import processes
with processes.start("tagid.where", stdout=subprocess.PIPE) as child:
    print(child.stdout.read().decode())
"""
    (clone / "tagid" / "where.py").write_text("import tagid\nprint(tagid.__file__)\n")
    assert run(clone, code).stdout.strip() == str(clone / "tagid" / "__init__.py")


def test_the_guardian_and_its_command_run_no_code_of_the_current_folder(hostile: Path) -> None:
    """The command runs, also where the folder was removed, and what it says is seen."""
    code = """
import os, shutil, sys
from pathlib import Path
from tagid import processes
from tagid.motion.guardian import Guardian, Watch
if sys.argv[1:] == ["removed"]:
    shutil.rmtree(os.getcwd())
url = "comxim+serial:///dev/ttyNOWHERE?speed=0"
command = processes.python("tagid.motion.emergency")
guard = Guardian(Watch("x", 30.0, command=command, command_input=url + chr(10)))
words = Path(f"/proc/{guard._process.pid}/cmdline").read_bytes()
assert b"NOWHERE" not in words and "NOWHERE" not in " ".join(command), "others can read command lines"
assert guard._process.poll() is None
guard.release(farewell=False)
"""
    for words in ([], ["removed"]):
        done = run(hostile, code, *words)
        assert "NOWHERE" in done.stderr and "speed is 0" in done.stderr, done.stderr
        assert "x could not be stopped. It may still be turning" in done.stderr
        assert owned(hostile) == []


def state(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return "Z"


def test_a_worker_of_a_pool_ends_with_a_killed_parent() -> None:
    code = """
import time, os
from tagid import processes
if __name__ == "__main__":
    with processes.spawn_context().Pool(1) as pool:
        print(pool.apply(os.getpid), flush=True)
        time.sleep(60)
"""
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    worker = int(parent.stdout.readline())
    parent.send_signal(signal.SIGKILL)
    parent.communicate()
    deadline = time.monotonic() + 10
    while state(worker) != "Z":
        assert time.monotonic() < deadline
        time.sleep(0.02)
