"""Every benchmark: what it measures, how long it takes, what it needs, and the page that shows it."""

from __future__ import annotations

import shutil
import sys
import tomllib
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from tests.benchmarks.provenance import SHARED


@dataclass(frozen=True)
class Benchmark:
    """One benchmark.

    Attributes:
        name: as it is typed.
        summary: what it measures, one line.
        minutes: about so many of one core.
        page: of docs/results/, with the heading `title`.
        work: module and function, which yields tables.
        needs: names of `NEEDS`.
        one_thread: whether numpy is kept to one thread.
    """

    name: str
    summary: str
    minutes: int
    page: str
    work: str
    title: str = ""
    needs: tuple[str, ...] = ()
    one_thread: bool = True


BENCHMARKS = {
    name: Benchmark(name, **{**entry, "needs": tuple(entry.get("needs", ()))})
    for name, entry in tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")).items()
}
"""By name, in the order of `list`."""


def _module(name: str) -> bool:
    return find_spec(name) is not None


NEEDS: dict[str, tuple[bool, str]] = {
    "torch": (_module("torch"), "pip install '.[ats]'"),
    "scipy": (_module("scipy"), "pip install '.[science]'"),
    "dask": (_module("distributed"), "pip install '.[cluster]'"),
    "station": (_module("starlette"), "pip install '.[station]'"),
    "bridge": (_module("bumble"), "pip install ./firmware_tools"),
    "pytest": (_module("pytest"), "pip install '.[dev]'"),
    "lpips": ((SHARED / "data/lpips/lpips_sq.onnx").is_file(), f"the model in {SHARED}/data/lpips"),
    "pulses": ((SHARED / "data/p440/pulse.npz").is_file(), f"the pulses in {SHARED}/data/p440"),
    "full-wave": ((SHARED / "fullwave/scenes.py").is_file(), f"the responses in {SHARED}/fullwave"),
    "pip": (_module("pip"), "an environment with pip, and a package index that it reaches"),
    "cc": (shutil.which("cc") is not None, "a C compiler"),
    "c++": (shutil.which("c++") is not None, "a C++ compiler with OpenMP"),
    "pylops": (_module("pylops"), "pip install pylops"),
    "chromium": (
        _module("selenium") and all(map(shutil.which, ("chromium", "chromedriver"))),
        "pip install '.[dev]', Chromium and chromedriver",
    ),
    "git": (shutil.which("git") is not None, "a checkout with git"),
    "linux": (sys.platform == "linux", "Linux: /proc, pseudo terminals, processor affinity"),
}
"""Name -> whether it is there, and how to get it."""


def missing(names: tuple[str, ...]) -> list[str]:
    return [f"{name} is missing: {NEEDS[name][1]}" for name in names if not NEEDS[name][0]]
