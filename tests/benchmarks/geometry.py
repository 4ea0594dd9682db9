"""Recordings with a wrong geometry: how often `reconstruct` warns of it, and of right ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

from tagid.capture import Capture
from tagid.pipeline.reconstruct import reconstruct
from tagid.pipeline.settings import ImagingSettings
from tests.benchmarks.focus_scenes import FAMILIES, P440, RADARS, SONAR, Radar, draw_scene
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

FIRST_SEED = 7200
HEIGHT_M = 0.5
KINDS = {
    "isolated reflectors": ("reflectors", "one reflector"),
    "reflectors on a shell": ("shell with reflectors",),
    "bodies": ("rough outline", "smooth body", "body with fittings", "box", "round can"),
}
NOTE = """Scenes of `focus_scenes.py`, as those of the axis distance (72 to 360 views, noise 10 to 30 dB under
the strongest sample, P440 and a radar of 17 mm; the height of P440 alone), through `reconstruct` with
backprojection. The limits were chosen on other seeds, 1500 to 1525. A recording counts as found where the
warning names this error. An antenna that stands higher than given shows as an axis that is farther. Angles
of the opposite direction are those of the mirror image, which no scan tells; a carrier 5 % off changes what
points leave by less than a hundredth of the energy, and is not told, either."""


class Error(NamedTuple):
    """What is wrong: turns that the object made, what is done to the capture, and the words that tell it."""

    words: str
    turns: float = 1.0
    changed: Callable[[Capture, Radar], Capture] = lambda capture, radar: capture
    higher_m: float = 0.0


def _angles_times(factor: float) -> Callable[[Capture, Radar], Capture]:
    def changed(capture: Capture, _: Radar) -> Capture:
        assert capture.angles_rad is not None
        return replace(capture, angles_rad=capture.angles_rad * factor)

    return changed


def _axis_off(wavelengths: float) -> Callable[[Capture, Radar], Capture]:
    def changed(capture: Capture, radar: Radar) -> Capture:
        return replace(capture, axis_distance_m=radar.axis_distance_m + wavelengths * radar.wavelength_m)

    return changed


ERRORS = {
    "none": Error(""),
    "half a turn, right": Error("", 0.5, _angles_times(0.5)),
    "half a turn given as a whole one": Error("does not close", 0.5),
    "two turns given as one": Error("repeat those", 2.0),
    "a whole turn given as a half": Error("as alike as neighbours", 1.0, _angles_times(0.5)),
    "axis a wavelength too far": Error("the axis seems to be", 1.0, _axis_off(1.0)),
    "axis a wavelength too near": Error("the axis seems to be", 1.0, _axis_off(-1.0)),
    "antenna 0.5 m higher than given": Error("the axis seems to be", higher_m=HEIGHT_M),
}
_WARNINGS = {error.words for error in ERRORS.values() if error.words}


def try_scene(job: tuple[str, str, int, int]) -> dict[str, Any]:
    """Warnings of geometry (their words here) that one scene with one error has."""
    name, family, number, seed = job
    error, radar = ERRORS[name], RADARS[number]
    scene = draw_scene(family, radar, seed, turns=error.turns, higher_m=error.higher_m)
    given = replace(scene.capture, axis_distance_m=scene.true_m)
    capture = error.changed(given, radar)
    settings = ImagingSettings("bp", extent_m=scene.extent_m, pixels=64, held_out=False, outside=False)
    said = reconstruct(capture, settings).image.settings.get("warnings", [])
    return {"said": sorted(words for words in _WARNINGS if any(words in text for text in said))}


def wrong_geometry(run: Run) -> Iterator[Table]:
    seeds = run.drawn(8, 1, FIRST_SEED)
    radars = {name: [P440] if error.higher_m else [P440, SONAR] for name, error in ERRORS.items()}
    jobs = [
        (name, family, RADARS.index(radar), seed)
        for name in ERRORS
        for family in FAMILIES
        for radar in radars[name]
        for seed in seeds
    ]
    outcomes = run.each(try_scene, jobs)
    rows: list[list[object]] = []
    for name, error in ERRORS.items():
        cells, other = [], 0
        for families in KINDS.values():
            some = [found["said"] for job, found in outcomes.items() if job[0] == name and job[1] in families]
            right = sum(error.words in said for said in some) if error.words else 0
            other += sum(bool(set(said) - {error.words}) for said in some)
            cells.append(f"{right} of {len(some)}" if error.words else "-")
        total = sum(job[0] == name for job in jobs)
        rows.append([name, *cells, f"{other} of {total}"])
    yield Table("error | " + " | ".join(KINDS) + " | another warning", rows, NOTE)
