"""Check that every dependency has a wheel for 64-bit ARM Linux: a Raspberry Pi compiles nothing but tagid.

It resolves and downloads wheels for the platform with `pip download --only-binary`, about 100 MB, into a
folder that is removed afterwards. It needs no more than pip and numpy beside it.
"""

from __future__ import annotations

import subprocess
import sys
import tomllib
from collections.abc import Iterator

from tests.benchmarks.provenance import ROOT
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

PYTHON = "3.11"
PLATFORMS = tuple(f"manylinux{version}_aarch64" for version in ("_2_28", "_2_27", "_2_17", "2014"))
"""Newest first: Raspberry Pi OS 12 has glibc 2.36, onnxruntime asks for 2.27."""


def wheels(run: Run) -> Iterator[Table]:
    """A row for each wheel; it fails where a dependency has none."""
    needed = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    words = [sys.executable, "-m", "pip", "download", "--quiet", "--dest", str(run.folder)]
    words += ["--only-binary", ":all:", "--implementation", "cp", "--python-version", PYTHON]
    words += [word for platform in PLATFORMS for word in ("--platform", platform)]
    words += ["--constraint", str(ROOT / "constraints.txt"), *needed]
    if subprocess.run(words, check=False).returncode:
        run.failed = True
        yield Table((), (), "A dependency has no wheel for aarch64: see above.")
        return
    sizes = {path.name: path.stat().st_size / 1e6 for path in run.folder.glob("*.whl")}
    rows = [(name, f"{size:.1f}") for name, size in sorted(sizes.items(), key=lambda item: -item[1])]
    yield Table("wheel | MB", rows, f"{len(rows)} wheels, {sum(sizes.values()):.1f} MB, Python {PYTHON}.")
