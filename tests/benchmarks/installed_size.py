"""What an installation takes on disk, with and without byte code.

    python -m pip wheel . --no-deps --wheel-dir dist
    python -m tests.benchmarks installed-size dist/tagid-*.whl

It installs the wheel and what it needs into a new environment in a temporary folder, and measures that: first
as `pip install --no-compile` leaves it, then with byte code, as `pip install` does.
"""

from __future__ import annotations

import argparse
import compileall
import subprocess
import venv
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

WITH = {"numpy.libs": "numpy", "pillow.libs": "pillow", "PIL": "pillow", "h5py.libs": "h5py"}
"""Folders that belong to a package of another name."""
SHOWN = 8


def megabytes(folder: Path) -> float:
    """Sum of the sizes of all files below a folder, MB of a million bytes."""
    return sum(path.lstat().st_size for path in folder.rglob("*") if not path.is_dir()) / 1e6


def packages(site: Path) -> Counter[str]:
    """MB of each package in a site-packages folder; those of the environment itself as one."""
    counter: Counter[str] = Counter()
    for entry in site.iterdir():
        name = WITH.get(entry.name, entry.name.split("-")[0])
        if name in ("pip", "setuptools", "pkg_resources", "_distutils_hack"):
            name = "pip and setuptools"
        counter[name] += megabytes(entry) if entry.is_dir() else entry.stat().st_size / 1e6
    return counter


def add_options(parser: argparse.ArgumentParser) -> None:
    """What is installed."""
    parser.add_argument("wheel", type=Path)


def sizes(run: Run) -> Iterator[Table]:
    """A row for each large package."""
    wheel, folder = run.options.wheel.resolve(), run.folder / "environment"
    venv.create(folder, with_pip=True)
    words = ("-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-compile", str(wheel))
    subprocess.run([folder / "bin" / "python", *words], check=True)
    site = next(folder.glob("lib/python*/site-packages"))
    bare, plain = megabytes(folder), packages(site)
    compileall.compile_dir(site, quiet=2, workers=1)
    compiled = packages(site)
    largest = [package for package, _ in plain.most_common(SHOWN)]
    rows = [(package, f"{plain[package]:.0f}", f"{compiled[package]:.0f}") for package in largest]
    rest, more = (
        sum(size for name, size in item.items() if name not in largest) for item in (plain, compiled)
    )
    rows.append(("the rest", f"{rest:.0f}", f"{more:.0f}"))
    note = f"Environment: {bare:.0f} MB, with byte code {megabytes(folder):.0f} MB."
    yield Table("package | MB with `--no-compile` | MB with byte code", rows, note)
