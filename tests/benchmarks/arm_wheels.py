"""Check that every dependency has a wheel for 64-bit ARM Linux: a Raspberry Pi compiles nothing but tagid.

It resolves and downloads wheels for the platform with `pip download --only-binary`, about 100 MB, into a
folder that is removed afterwards. It needs no more than pip and numpy beside it.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tomllib
from collections.abc import Iterator

from tests.benchmarks.provenance import ROOT
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

PLATFORMS = (
    "manylinux_2_28_aarch64",
    "manylinux_2_27_aarch64",
    "manylinux_2_17_aarch64",
    "manylinux2014_aarch64",
)
"""Newest first: Raspberry Pi OS 12 has glibc 2.36, onnxruntime asks for 2.27."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """For what they are."""
    parser.add_argument("--python", default="3.11")
    parser.add_argument("--extra", action="append", default=[])


def wheels(run: Run) -> Iterator[Table]:
    """A row for each wheel; it fails where a dependency has none."""
    given = run.options
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needed = list(project["dependencies"])
    for extra in given.extra:
        needed += project["optional-dependencies"][extra]
    words = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--quiet",
        "--dest",
        str(run.folder),
        "--only-binary",
        ":all:",
    ]
    words += ["--implementation", "cp", "--python-version", given.python]
    words += [word for platform in PLATFORMS for word in ("--platform", platform)]
    words += ["--constraint", str(ROOT / "constraints.txt"), *needed]
    if subprocess.run(words, check=False).returncode:
        run.failed = True
        yield Table((), (), "A dependency has no wheel for aarch64: see above.")
        return
    files = sorted(run.folder.glob("*.whl"), key=lambda path: -path.stat().st_size)
    total = sum(file.stat().st_size for file in files) / 1e6
    rows = [(file.name, f"{file.stat().st_size / 1e6:.1f}") for file in files]
    yield Table(("wheel", "MB"), rows, f"{len(files)} wheels, {total:.1f} MB, Python {given.python}.")
