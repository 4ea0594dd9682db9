"""Captures of solved full-wave responses for the benchmarks of enrolled bodies.

Responses are in `shared/fullwave` beside the checkout (or where TAGID_SHARED points), captures are made by
that folder's own `scenes.py`.
"""

from __future__ import annotations

import zlib
from functools import lru_cache
from types import ModuleType
from typing import Any

import numpy as np
from reading_bodies_scenes import captured, full_wave

from tagid.capture import Capture

DISTANCE_M = 1.0


@lru_cache(maxsize=1)
def scene_maker() -> ModuleType:
    """The scene maker beside the responses, which then knows sums too."""
    module = full_wave()
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
    return recorded(solved, rng, one, views, offset, snr_db)


def recorded(
    name: str, rng: np.random.Generator, reference: str, views: int, place: complex, snr_db: float
) -> Capture:
    """A capture of what the scene maker knows by a name, standing at x + jy, m; SNR against the reference."""
    scan, _ = scene_maker().make(
        name,
        rng,
        reference=reference,
        views=views,
        distance=DISTANCE_M,
        centre=(place.real, place.imag),
        snr_db=snr_db,
    )
    return captured(scan)
