"""Captures of solved full-wave responses for the benchmarks of enrolled bodies.

Responses are in `shared/fullwave` beside the checkout (or where TAGID_SHARED points), captures are made by
that folder's own `scenes.py`.
"""

from __future__ import annotations

import importlib.util
import os
import sys
import zlib
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from tagid.capture import Capture

SHARED = Path(os.environ.get("TAGID_SHARED", Path(__file__).resolve().parents[3] / "shared"))
DISTANCE_M = 1.0


@lru_cache(maxsize=1)
def scene_maker() -> ModuleType:
    """The scene maker beside the responses, which then knows sums too."""
    file = SHARED / "fullwave" / "scenes.py"
    spec = importlib.util.spec_from_file_location("fullwave_scenes", file)
    if spec is None or spec.loader is None or not file.is_file():
        sys.exit(f"{file} is missing: set TAGID_SHARED to the folder that holds fullwave/")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    plain = module.response

    def response(name: str) -> Any:
        if "+" not in name:
            return plain(name)
        first, second = name.split("+")
        frequencies, own = response(first)
        return frequencies, own + response(second)[1]

    module.response = response
    return module


def capture_of(solved: str, key: str, snr_db: float, offset_mm: float, views: int) -> Capture:
    """A capture of a solved object, the same for the same key; SNR against one reflector of its tag."""
    rng = np.random.default_rng(zlib.crc32(f"{solved}/{key}/{snr_db}/{offset_mm}/{views}".encode()))
    base = solved.split("_")[0]
    one = f"free{'40' if solved.endswith('40') else '20'}_one" if base == "shell" else f"{base}_one-{base}"
    offset = offset_mm * 1e-3 * np.exp(2j * np.pi * rng.uniform())
    scan, _ = scene_maker().make(
        solved,
        rng,
        reference=one,
        views=views,
        distance=DISTANCE_M,
        centre=(offset.real, offset.imag),
        snr_db=snr_db,
    )
    return captured(scan)


def captured(scan: dict[str, Any]) -> Capture:
    """A scan of the scene maker as a capture."""
    return Capture(
        scan["samples"],
        float(scan["range_start_m"]),
        float(scan["range_step_m"]),
        angles_rad=scan["angles_rad"],
        axis_distance_m=float(scan["axis_distance_m"]),
    )
