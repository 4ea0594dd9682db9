"""What a benchmark needs beyond the base installation, checked before it begins."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from importlib.util import find_spec

from tests.benchmarks.provenance import ROOT, SHARED


def _module(name: str) -> Callable[[], bool]:
    return lambda: find_spec(name) is not None


def _program(*names: str) -> Callable[[], bool]:
    return lambda: all(shutil.which(name) for name in names)


def _linux() -> bool:
    return sys.platform == "linux"


NEEDS: dict[str, tuple[Callable[[], bool], str]] = {
    "torch": (_module("torch"), "pip install '.[ats]'"),
    "scipy": (_module("scipy"), "pip install '.[science]'"),
    "dask": (_module("distributed"), "pip install '.[cluster]'"),
    "station": (_module("starlette"), "pip install '.[station]'"),
    "bridge": (_module("bumble"), "pip install ./firmware_tools"),
    "pytest": (_module("pytest"), "pip install '.[dev]'"),
    "lpips": ((SHARED / "data" / "lpips" / "lpips_sq.onnx").is_file, f"the model in {SHARED}/data/lpips"),
    "pulses": ((SHARED / "data" / "p440" / "pulse.npz").is_file, f"the pulses in {SHARED}/data/p440"),
    "full-wave": ((SHARED / "fullwave" / "scenes.py").is_file, f"the responses in {SHARED}/fullwave"),
    "solved": (
        lambda: any((ROOT / "build" / "unseen").glob("*.npz")),
        "python -m tests.benchmarks solve --set unseen",
    ),
    "pip": (_module("pip"), "an environment with pip, and a package index that it reaches"),
    "cc": (_program("cc"), "a C compiler"),
    "c++": (_program("c++"), "a C++ compiler with OpenMP"),
    "pylops": (_module("pylops"), "pip install pylops"),
    "chromium": (
        lambda: _module("selenium")() and _program("chromium", "chromedriver")(),
        "pip install '.[dev]', Chromium and chromedriver",
    ),
    "git": (_program("git"), "a checkout with git"),
    "linux": (_linux, "Linux: /proc, pseudo terminals, processor affinity"),
}
"""Name -> whether it is there, and how to get it."""


def missing(names: tuple[str, ...]) -> list[str]:
    """A line for each need that is not met."""
    return [f"{name} is missing: {NEEDS[name][1]}" for name in names if not NEEDS[name][0]()]
