"""What an installation takes on disk, with and without byte code: the table of docs/results/process.md.

    python -m pip wheel . --no-deps --wheel-dir dist
    python tests/benchmarks/installed_size.py dist/tagid-*.whl

It installs the wheel and what it needs into a new environment in a temporary folder, and measures that: first
as `pip install --no-compile` leaves it, then with byte code, as `pip install` does.
"""

from __future__ import annotations

import argparse
import compileall
import subprocess
import sys
import tempfile
import venv
from collections import Counter
from pathlib import Path

WITH = {"numpy.libs": "numpy", "pillow.libs": "pillow", "PIL": "pillow", "h5py.libs": "h5py"}
"""Folders that belong to a package of another name."""
SHOWN = 8


def megabytes(folder: Path) -> float:
    """Sum of the sizes of all files below a folder, MB of a million bytes."""
    return sum(path.lstat().st_size for path in folder.rglob("*") if not path.is_dir()) / 1e6


def packages(site: Path) -> Counter[str]:
    """MB of each package in a site-packages folder; those of the environment itself as one."""
    found: Counter[str] = Counter()
    for entry in site.iterdir():
        name = WITH.get(entry.name, entry.name.split("-")[0])
        if name in ("pip", "setuptools", "pkg_resources", "_distutils_hack"):
            name = "pip and setuptools"
        found[name] += megabytes(entry) if entry.is_dir() else entry.stat().st_size / 1e6
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("wheel", type=Path)
    wheel = parser.parse_args().wheel.resolve()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "environment"
        venv.create(folder, with_pip=True)
        words = ("-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-compile", str(wheel))
        subprocess.run([folder / "bin" / "python", *words], check=True)
        site = next(folder.glob("lib/python*/site-packages"))
        bare, plain = megabytes(folder), packages(site)
        compileall.compile_dir(site, quiet=2, workers=1)
        compiled = packages(site)
        print(f"environment: {bare:.0f} MB, with byte code {megabytes(folder):.0f} MB")
        print("\n| package | MB | with byte code |\n|---|---|---|")
        largest = [package for package, _ in plain.most_common(SHOWN)]
        for package in largest:
            print(f"| {package} | {plain[package]:.0f} | {compiled[package]:.0f} |")
        rest = sum(size for package, size in plain.items() if package not in largest)
        more = sum(size for package, size in compiled.items() if package not in largest)
        print(f"| the rest | {rest:.0f} | {more:.0f} |")


if __name__ == "__main__":
    sys.exit(main())
