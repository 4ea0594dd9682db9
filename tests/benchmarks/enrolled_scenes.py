"""Captures of solved full-wave responses, and the scenes of enrolled bodies and objects.

Responses are in `shared/fullwave` beside the checkout (or where TAGID_SHARED points), captures are made by
that folder's own `scenes.py`.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import Any

import numpy as np

from tagid.capture import Capture
from tagid.pipeline.identify import aspect_spectra
from tagid.tags.bodies.joint import Named, enroll_signature
from tagid.tags.bodies.signature import Signature, SignatureKind
from tests.benchmarks.reading_bodies_scenes import captured, full_wave

DISTANCE_M = 1.0
POPULATION = "development/1"
"""What the captures are drawn from."""
OFFSETS_MM = (0, 2, 6, 10)
SNRS_DB = (20, 10)
VIEWS = 36
ENROLMENT_VIEWS = 72

HANDLE = "can35_handle"
BODIES = (HANDLE, "shell", "can35")
ON_BODIES = {
    f"{HANDLE}+can35_c90-can35": "container-90",
    f"{HANDLE}+can28_c180-can28": "container-180",
    "shell_h120_20": "helmet-120",
    "shell_h120_40": "helmet-120",
    "can35_c90": "container-90",
}
"""Tagged scenes and the layout that they carry."""
FOREIGN_ON_BODIES = (HANDLE, f"{HANDLE}+can35_one-can35", "shell", "can35", "can35_one", "can28_one")
"""Untagged bodies and tags that nobody enrolled."""
OBJECTS = (f"{HANDLE}+can35_c90-can35", "shell_h120_20", "shell_h120_40", "can35_c90", "can28_c180")
FOREIGN_OBJECTS = (
    HANDLE,
    f"{HANDLE}+can35_one-can35",
    f"{HANDLE}+can28_c180-can28",
    "shell",
    "can35",
    "can35_one",
    "can28_one",
)


@lru_cache(maxsize=1)
def scene_maker() -> ModuleType:
    """The scene maker beside the responses, which then knows sums too."""
    module = full_wave()
    plain = module.response

    def response(name: str) -> Any:
        if "+" not in name:
            return plain(name)
        first, second = name.split("+")
        frequencies, reply = response(first)
        return frequencies, reply + response(second)[1]

    module.response = response
    return module


def capture_of(solved: str, key: str, snr_db: float, offset_mm: float, views: int) -> Capture:
    """A capture of a solved object, the same for the same key; SNR against one reflector of its tag."""
    rng = np.random.default_rng(zlib.crc32(f"{solved}/{key}/{snr_db}/{offset_mm}/{views}".encode()))
    base = solved.split("_")[0]
    single = f"free{'40' if solved.endswith('40') else '20'}_one" if base == "shell" else f"{base}_one-{base}"
    offset = offset_mm * 1e-3 * np.exp(2j * np.pi * rng.uniform())
    return recorded(solved, rng, single, views, offset, snr_db)


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


@dataclass(frozen=True)
class Scene:
    """One capture to be read.

    Attributes:
        part: "body" or "object", what is enrolled.
        solved: object.
        name: right name, "" where none is.
        offset_mm, snr_db, number: of the capture.
    """

    part: str
    solved: str
    name: str
    offset_mm: int
    snr_db: int
    number: int


def slug(solved: str) -> str:
    """Name under which a solved object is enrolled."""
    return solved.replace("_", "-").replace("+", ".")


def enrolled(solved: str, kind: SignatureKind) -> Signature:
    """Signature of a solved object from three captures."""
    captures = [
        Named(
            f"{solved} {i}",
            aspect_spectra(capture_of(solved, f"{POPULATION}/enrol/{i}", 20, 2 + 2 * i, ENROLMENT_VIEWS)),
        )
        for i in range(3)
    ]
    return enroll_signature(captures, slug(solved), kind).signature


def scenes(numbers: int) -> list[Scene]:
    """Every scene of solved objects."""
    results = []
    for offset in OFFSETS_MM:
        for snr in SNRS_DB:
            for number in range(numbers):
                place = (offset, snr, number)
                results += [Scene("body", solved, name, *place) for solved, name in ON_BODIES.items()]
                results += [Scene("body", solved, "", *place) for solved in FOREIGN_ON_BODIES]
                results += [Scene("object", solved, slug(solved), *place) for solved in OBJECTS]
                results += [Scene("object", solved, "", *place) for solved in FOREIGN_OBJECTS]
    return results
