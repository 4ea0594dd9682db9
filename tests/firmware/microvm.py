"""The real MicroPython virtual machine under node, where both are installed."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).resolve().parent / "vm"
PACKAGE = FOLDER / "node_modules" / "@micropython" / "micropython-webassembly-pyscript"

needs_vm = pytest.mark.skipif(
    shutil.which("node") is None or not PACKAGE.is_dir(),
    reason="needs node and MicroPython's virtual machine: npm install --prefix tests/firmware/vm",
)


def run_in_vm(board: Path, *plans: dict[str, Any], heap_bytes: int = 128 * 1024) -> list[dict[str, Any]]:
    """Runs plans, one after the other, on a folder with the board's files.

    The heap is about as large as an ESP32-C3 leaves.
    """
    (board / "scenario.json").write_text(json.dumps(plans))
    words = ["node", str(FOLDER / "run.mjs"), str(board), str(FOLDER / "scenario.py"), str(heap_bytes)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    assert len(lines) == len(plans), done.stdout
    return [json.loads(line) for line in lines]
