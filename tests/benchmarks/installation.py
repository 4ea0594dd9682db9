"""Size of an installation, its wheels for 64-bit ARM, and what it costs to start a command.

    python -m pip wheel . --no-deps --wheel-dir dist
    python -m tests.benchmarks installed-size dist/tagid-*.whl

installs the wheel and what it needs into a new environment in a temporary folder, and measures that: first
as `pip install --no-compile` leaves it, then with byte code, as `pip install` does. A Raspberry Pi compiles
nothing but tagid: `arm-wheels` resolves and downloads wheels for the platform, about 100 MB, with no more
than pip and numpy beside it. Of commands the least of several rounds of each is compared, taken in turn so
that a busy machine hits all alike; each child is measured by its own user and system time (`os.wait4`), not
by the clock, and its peak memory.
"""

from __future__ import annotations

import argparse
import compileall
import os
import subprocess
import sys
import tomllib
import venv
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from tests.benchmarks.provenance import ROOT
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


def sizes_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("wheel", type=Path)


def sizes(run: Run) -> Iterator[Table]:
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


COMMANDS: dict[str, tuple[str, ...]] = {
    "python -c pass": ("-c", "pass"),
    "tagid --help": ("-m", "tagid", "--help"),
    "tagid layouts": ("-m", "tagid", "layouts"),
    "tagid config": ("-m", "tagid", "config"),
    "tagid identify FILE (36 views)": ("-m", "tagid", "identify", "36.tagid.h5"),
    "tagid identify FILE (360 views)": ("-m", "tagid", "identify", "360.tagid.h5"),
}
LIMITS = {"tagid --help": 8.0, "tagid layouts": 10.0}
"""Times the cost of `python -c pass`."""


def cost(words: Sequence[str], folder: Path, environment: dict[str, str]) -> tuple[float, float]:
    """CPU seconds and peak memory, MB, of one child."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    child = subprocess.Popen([sys.executable, *words], cwd=folder, env=environment, **quiet)
    _, _, usage = os.wait4(child.pid, 0)
    child.returncode = 0
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024


def starts(run: Run) -> Iterator[Table]:
    run.seeds = "0"
    # Byte code is compiled once, as in any installation, whatever the surroundings say of it.
    kept = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    environment = {**kept, "PYTHONPYCACHEPREFIX": f"{run.folder}/pyc"}
    for views in (36, 360):
        words = ("simulate", "helmet-120", "--views", str(views), "--out", f"{views}.tagid.h5")
        cost(("-m", "tagid", *words), run.folder, environment)
    for words in COMMANDS.values():
        cost(words, run.folder, environment)
    results: dict[str, list[tuple[float, float]]] = {what: [] for what in COMMANDS}
    for _ in range(run.number(7, 2)):
        for what, words in COMMANDS.items():
            results[what].append(cost(words, run.folder, environment))
    base = min(seconds for seconds, _ in results["python -c pass"])
    rows = []
    for what, costs in results.items():
        seconds, memory = min(costs)[0], max(megabytes for _, megabytes in costs)
        limit = f"{LIMITS[what]:g}" if what in LIMITS else ""
        rows.append((f"`{what}`", f"{1e3 * seconds:.0f}", f"{seconds / base:.1f}", limit, f"{memory:.0f}"))
    yield Table("command | CPU (ms) | times `python -c pass` | limit | peak (MB)", rows)
