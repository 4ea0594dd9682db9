"""The plan of the house, held by tests: which way imports run, and what may be heavy."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "tagid"
FILES = sorted(PACKAGE.rglob("*.py"))

LEVELS = (
    {"errors", "constants", "__init__"},
    {"geometry", "capture", "config", "waveform", "signal", "ports"},
    {"imaging", "tags", "storage", "radar", "motion", "simulate", "models_store"},
    {"pipeline", "report", "doctor", "result", "sources", "inspection", "turn", "identification"}
    | {"recorder", "long_recording", "intake", "calibration", "monitoring"},
    {"batch", "defaults"},
    {"cli", "__main__"},
)
LEVEL_OF = {name: level for level, names in enumerate(LEVELS) for name in names}


def part(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported_parts(tree: ast.AST) -> set[str]:
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("tagid."):
            found.add(node.module.split(".")[1])
        elif isinstance(node, ast.ImportFrom) and node.module == "tagid":
            found |= {alias.name for alias in node.names if alias.name in LEVEL_OF}
        elif isinstance(node, ast.Import):
            found |= {a.name.split(".")[1] for a in node.names if a.name.startswith("tagid.")}
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_run_one_way(path: Path) -> None:
    own = part(path)
    for other in imported_parts(ast.parse(path.read_text())):
        assert other in LEVEL_OF, f"{other} has no place in the plan"
        assert LEVEL_OF[other] <= LEVEL_OF[own], f"{own} imports {other}, which stands above it"


@pytest.mark.parametrize("name", ["radar", "motion"])
def test_devices_never_import_imaging(name: str) -> None:
    for path in (PACKAGE / name).rglob("*.py"):
        assert "imaging" not in imported_parts(ast.parse(path.read_text())), path


def test_the_firmware_and_its_tools_are_imported_late() -> None:
    """They need packages of the extras; what runs on the board needs nothing of the host at all."""
    for path in FILES:
        for node in ast.parse(path.read_text()).body:
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(name.split(".")[0] == "firmware_tools" for name in names), path
    board = {"time", "struct", "json", "sys", "array", "binascii", "machine", "bluetooth", "micropython"}
    for path in (ROOT / "firmware_tools" / "bridge" / "tagid_bridge").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert {name.split(".")[0] for name in names} <= board | {"tagid_bridge"}, path


@pytest.mark.parametrize("path", sorted((ROOT / "firmware_tools").rglob("*.py")), ids=lambda p: p.name)
def test_every_file_of_the_firmware_says_why_it_exists(path: Path) -> None:
    text = path.read_text()
    assert ast.get_docstring(ast.parse(text)) and text.count("\n") <= 400


def test_torch_is_imported_only_where_it_belongs() -> None:
    allowed = {
        f"imaging/ats/{name}.py" for name in ("encoding", "network", "forward_step", "fit_torch", "export")
    }
    allowed |= {f"imaging/ats/{name}_paper.py" for name in ("forward", "fit")}
    for path in FILES:
        if str(path.relative_to(PACKAGE)) in allowed:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(name.split(".")[0] == "torch" for name in names), path


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys; sys.argv = ['tagid', '--help']\n"
        "from tagid.cli.app import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "heavy = {'torch', 'scipy.signal', 'matplotlib', 'onnxruntime', 'numpy', 'h5py'} & set(sys.modules)\n"
        "sys.exit(','.join(sorted(heavy)) or 0)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_every_module_says_why_it_exists_and_stays_readable(path: Path) -> None:
    text = path.read_text()
    if path.name != "__init__.py":
        assert ast.get_docstring(ast.parse(text)), "no docstring"
    assert text.count("\n") <= 400, "split by meaning"
