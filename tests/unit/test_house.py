"""The plan of the house, held by tests: what may be heavy, who starts threads and processes, reads files."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from tagid import config
from tagid.pipeline import reconstruct

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "tagid"
FILES = sorted(PACKAGE.rglob("*.py"))

BARE_THREADS = {
    "tagid/batch/local.py",
    "tagid/motion/ble.py",
    "tagid/motion/driven.py",
    "tagid/motion/emulation/gatt.py",
    "tagid/motion/emulation/pty.py",
    "tagid/motion/emulation/truth.py",
    "tagid/station/reports.py",
    "tagid/station/scans.py",
    "tagid/station/server.py",
    "tagid/station/station.py",
    "firmware_tools/virtual/__main__.py",
    "firmware_tools/virtual/board.py",
    "firmware_tools/virtual/process.py",
}
"""Files that still start threads without `tagid.workers.Worker`; a line goes with the last such thread."""


def test_every_thread_has_an_owner_who_learns_of_its_end() -> None:
    paths = [*FILES, *(ROOT / "firmware_tools").rglob("*.py")]
    texts = {str(path.relative_to(ROOT)): path.read_text() for path in paths}
    bare = {name for name, text in texts.items() if "hread" in text and starts_a_thread(ast.parse(text))}
    assert bare - {"tagid/workers.py"} - BARE_THREADS == set(), "use tagid.workers.Worker"
    assert starts_a_thread(ast.parse("import threading as t; t.Thread(target=print)"))


def starts_a_thread(tree: ast.AST) -> bool:
    """Whether code calls `Thread`, or the function below it."""
    calls = [node.func for node in ast.walk(tree) if isinstance(node, ast.Call)]
    names = {call.attr if isinstance(call, ast.Attribute) else getattr(call, "id", "") for call in calls}
    return bool(names & {"Thread", "start_new_thread"})


STARTS_CHILDREN = {
    "subprocess": {"Popen", "run", "call", "check_call", "check_output", "getoutput", "getstatusoutput"},
    "multiprocessing": {"get_context", "set_start_method", "Process", "Pool", "Manager"},
    "os": {"fork", "forkpty", "system", "popen", "posix_spawn", "posix_spawnp"}
    | {
        f"{kind}{how}"
        for kind in ("exec", "spawn")
        for how in ("l", "le", "lp", "lpe", "v", "ve", "vp", "vpe")
    },
    "asyncio": {"create_subprocess_exec", "create_subprocess_shell"},
    "pty": {"fork", "spawn"},
    "sys": {"executable"},
}
MAY_START_CHILDREN = re.compile(
    r"process|executable|from os|import pty|os\.(exec|spawn|fork|system|popen|posix_spawn)", re.IGNORECASE
)
"""What a file contains that does; to read most files is enough."""
CHILDREN_ARE_STARTED_BY = {"tagid/processes.py", "tagid/motion/guard.py"}
"""One module, and the guardian's program, which starts words made by that module."""


def starts_of_children(tree: ast.AST) -> list[str]:
    """Uses of what starts a process, or names the interpreter, in a file; types of processes are none."""
    called = {id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    uses = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            starts = node.attr in STARTS_CHILDREN.get(node.value.id, ())
            uses += [ast.unparse(node)] if starts and (node.attr != "Popen" or id(node) in called) else []
        elif isinstance(node, ast.ImportFrom) and node.module in STARTS_CHILDREN:
            names = {alias.name for alias in node.names}
            uses += [f"{node.module}.{name}" for name in names & STARTS_CHILDREN[node.module]]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("ProcessPoolExecutor"):
            words = ast.unparse(node)
            uses += [] if "processes.spawn_context()" in words else [words]
    return uses


def test_children_are_started_in_one_place() -> None:
    """Elsewhere a child would import from the current folder, and outlive a parent that is killed."""
    files = [path for part in ("tagid", "firmware_tools", "train") for path in (ROOT / part).rglob("*.py")]
    texts = {str(path.relative_to(ROOT)): path.read_text() for path in files}
    result = {
        f"{name}: {use}"
        for name, text in texts.items()
        if name not in CHILDREN_ARE_STARTED_BY and MAY_START_CHILDREN.search(text)
        for use in starts_of_children(ast.parse(text))
    }
    assert result - {"train/export.py: subprocess.run"} == set()  # git
    bent = "import os, subprocess\nsubprocess.Popen([])\nos.execv('', [])\nfrom multiprocessing import Pool"
    assert len(starts_of_children(ast.parse(bent))) == 3


def imported(nodes: Sequence[ast.AST]) -> set[str]:
    """Packages that these nodes import from."""
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
    return {name.split(".")[0] for name in names}


def test_what_runs_on_the_board_needs_nothing_of_the_host() -> None:
    board = {"time", "struct", "json", "os", "sys", "array", "binascii", "machine", "bluetooth"}
    board |= {"micropython", "tagid_bridge"}
    for path in (ROOT / "firmware_tools" / "bridge" / "tagid_bridge").glob("*.py"):
        assert imported([*ast.walk(ast.parse(path.read_text()))]) <= board, path


def test_torch_is_imported_only_where_it_belongs() -> None:
    allowed = {"imaging/ats/fit_torch.py", "imaging/ats/fit_paper.py"}
    for path in FILES:
        if str(path.relative_to(PACKAGE)) not in allowed and "torch" in (text := path.read_text()):
            assert "torch" not in imported([*ast.walk(ast.parse(text))]), path


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys; sys.argv = ['tagid', '--help']\n"
        "from tagid.cli.app import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "heavy = {'torch', 'scipy', 'matplotlib', 'onnxruntime', 'numpy', 'h5py'}\n"
        "heavy &= set(sys.modules)\n"
        "sys.exit(','.join(sorted(heavy)) or 0)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_identify_loads_only_what_it_uses(tmp_path: Path) -> None:
    """The command's time is mostly that of its imports; each of these takes 20 ms or more, or megabytes."""
    code = (
        "import sys\n"
        "from tagid.cli.app import main\n"
        "def run(*words):\n"
        "    sys.argv = ['tagid', *words, '-q']\n"
        "    try: main()\n"
        "    except SystemExit as end: assert not end.code, end.code\n"
        "unused = {'torch', 'scipy', 'numpy.ma', 'PIL', 'jinja2', 'asyncio',\n"
        "          'tagid.radar', 'tagid.recording', 'tagid.motion', 'tagid.simulate', 'tagid.storage.npz',\n"
        "          'tagid.storage.journal', 'tagid.imaging.sparse', 'tagid.imaging.ats.problem'}\n"
        "run('identify', sys.argv[1])\n"
        "print(','.join(sorted(unused & set(sys.modules))), file=sys.stderr, end='')\n"
    )
    path = tmp_path / "a.tagid.h5"
    environment = {**os.environ, "TAGID_DATA": str(tmp_path), "TAGID_CONFIG": str(tmp_path / "config.toml")}
    words = [sys.executable, "-m", "tagid", "simulate", "helmet-120", "--views", "12", "--out", str(path)]
    subprocess.run(words, check=True, capture_output=True, env=environment)
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""


def test_no_module_is_over_600_lines() -> None:
    files = [*FILES, *(ROOT / "firmware_tools").rglob("*.py")]
    assert [str(path) for path in files if path.read_text().count("\n") > 600] == [], "more than one thought"


def test_the_configuration_knows_every_imaging_method() -> None:
    """It lists them itself, because it must not load numerics."""
    assert set(config.METHODS) == {"auto", *reconstruct.METHODS}


READERS = {
    "files.py": "the bounded reader",
    "imaging/memory.py": "pseudo files of the kernel",
    "motion/guardian.py": "a pseudo file of the kernel",
    "ports.py": "pseudo files of the kernel",
    "radar/emulation/wires.py": "a pseudo file of the kernel",
    "station/web_history.py": "captures in parts, for an archive",
}
"""Modules that open files themselves, and which."""


def unbounded_reads(path: Path) -> list[str]:
    """Calls that read files without a limit; a module that reads files of the package names `resources`."""
    text = path.read_text()
    if not any(word in text for word in ("read_text", "read_bytes", "open(", "tomllib")):
        return []
    tree = ast.parse(text)
    packaged = any(isinstance(node, ast.Name) and node.id == "resources" for node in ast.walk(tree))
    results = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        owner = getattr(getattr(node.func, "value", None), "id", "")
        whole = name in ("read_text", "read_bytes") and isinstance(node.func, ast.Attribute)
        opened = name == "open" and isinstance(node.func, (ast.Name, ast.Attribute)) and owner != "os"
        modes = {str(arg.value).strip("b+") for arg in node.args if isinstance(arg, ast.Constant)}
        by_name = opened and not modes & {"w", "x", "a"} and owner in LOCAL
        if owner == "tomllib" or (whole and owner != "files" and not packaged) or by_name:
            results.append(f"{path.relative_to(PACKAGE)}:{node.lineno}: {name}")
    return results


LOCAL = ("", "path", "file", "place", "target")
"""Owners of `open` that are names of files, not archives or file systems."""


def test_files_are_read_with_a_limit() -> None:
    reads = [line for path in FILES for line in unbounded_reads(path)]
    assert [line for line in reads if line.split(":")[0] not in READERS] == []
    assert {line.split(":")[0] for line in reads} == set(READERS)


def test_every_endless_loop_is_said_to_end() -> None:
    """Each has a row in the table of waits of docs/architecture.md."""
    rows = (ROOT / "docs" / "architecture.md").read_text()
    endless = {
        path.relative_to(PACKAGE)
        for path in FILES
        if "while" in (text := path.read_text())
        and any(
            isinstance(node, ast.While) and isinstance(node.test, ast.Constant)
            for node in ast.walk(ast.parse(text))
        )
    }
    assert (
        endless
        and [name for name in endless if f"`{name}`" not in rows and f"`{name.parent}/*`" not in rows] == []
    )


def test_names_say_what_they_hold() -> None:
    """Words that say nothing of what a name holds; a pair of left and right is no such name."""
    words = {"found", "one", "own", "told", "each", "places"}
    names: list[str] = []
    others = (path for room in ("tests", "train", "firmware_tools") for path in (ROOT / room).rglob("*.py"))
    for path in (*FILES, *others):
        for node in ast.walk(ast.parse(path.read_text())):
            stored = isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store)
            name = getattr(node, "id", None) or getattr(node, "attr", "") if stored else ""
            name = node.arg if isinstance(node, ast.arg) else name
            names += [f"{path}:{node.lineno} {name}"] if name in words else []
    packaged = [name for name in names if name.startswith(str(PACKAGE))]
    assert len(packaged) <= 15, packaged
    assert len(names) < 40, names
