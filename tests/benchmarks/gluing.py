"""How far reflectors may be off their marks before the name is lost.

Every reflector of a tag is moved by the same distance, each in a random direction of its own; the layout is
enrolled with its marks.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from tagid.errors import TagidError
from tagid.pipeline.identify import identify
from tagid.simulate import Acquisition, Placement, Wobble, parse_body, parse_reflector, simulate_capture
from tagid.simulate.presets import scene_on_body
from tagid.tags.layouts.layout import Layout, builtin_layouts
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

FIRST_SEED = 62_000
DISTANCES_MM = (1, 2)
VIEWS, SNR_DB = 36, 20.0
NOTE = """Every reflector of a tag is off its mark by the distance above the column, each in a random
direction: tags that were named of {count}. {views} views, {snr:g} dB, octahedra of 40 mm, no body, up to
4 mm off the axis, 0.5 % of wobble. {wrong}"""


def displaced(layout: Layout, distance_m: float, rng: np.random.Generator) -> Layout:
    """The layout with every reflector moved by a distance in a random direction."""
    turn = rng.uniform(0, 2 * math.pi, layout.size)
    moved = layout.positions + distance_m * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return replace(layout, positions=moved, symmetry=0)


def reading(job: tuple[int, str, int]) -> dict[str, str]:
    """The outcome of a tag, of its number, layout and distance in mm: named, wrong or refused."""
    number, name, distance_mm = job
    enrolled = builtin_layouts()
    rng = np.random.default_rng([FIRST_SEED, number])
    glued = displaced(enrolled[name], distance_mm * 1e-3, rng)
    seed = FIRST_SEED + number
    reflector = parse_reflector("octahedron:40mm")
    scene = scene_on_body(name, parse_body("none"), reflector, seed, layouts={name: glued})
    off, turn = 0.004 * math.sqrt(rng.uniform()), rng.uniform(0, 2 * math.pi)
    placement = Placement((off * math.cos(turn), off * math.sin(turn)), rng.uniform(0, 2 * math.pi))
    acquisition = Acquisition(views=VIEWS, snr_db=SNR_DB, placement=placement, wobble=Wobble(speed=0.005))
    capture, _ = simulate_capture(scene, acquisition, seed)
    try:
        answer = identify(capture, list(enrolled.values()))
    except TagidError:
        return {"outcome": "refused"}
    if answer.status != "identified" or answer.reading is None:
        return {"outcome": "refused"}
    return {"outcome": "named" if answer.reading.layout == name else "wrong"}


def names(run: Run) -> Iterator[Table]:
    """A row for every layout."""
    count = run.number(20, 1)
    run.seeds = f"{FIRST_SEED} to {FIRST_SEED + count - 1}"
    layouts = list(builtin_layouts())[: 1 if run.quick else None]
    jobs = [(n, name, d) for n in range(count) for name in layouts for d in DISTANCES_MM]
    outcomes = {job: result["outcome"] for job, result in run.each(reading, jobs).items()}
    rows = []
    for name in layouts:
        cells = (
            sum(outcomes[n, name, distance] == "named" for n in range(count)) for distance in DISTANCES_MM
        )
        rows.append((name, *cells))
    wrong = sum(outcome == "wrong" for outcome in outcomes.values())
    said = "None was given a wrong name." if not wrong else f"{wrong} were given a wrong name."
    columns = ("layout", *(f"{distance} mm" for distance in DISTANCES_MM))
    yield Table(columns, rows, NOTE.format(count=count, views=VIEWS, snr=SNR_DB, wrong=said))
