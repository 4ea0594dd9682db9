"""How far reflectors may be off their marks before the name is lost.

Every reflector of a tag is moved by the same distance, each in a random direction of its own; the layout is
enrolled with its marks. Layouts are the built-in ones, bare and on the body that they are for, and a designed
set.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import numpy as np

from tagid.errors import TagidError
from tagid.pipeline.identify import identify
from tagid.simulate import Acquisition, Placement, Wobble, parse_body, parse_reflector, simulate_capture
from tagid.simulate.presets import scene_on_body
from tagid.tags.layouts.design import DesignRules, design
from tagid.tags.layouts.layout import Layout, builtin_layouts
from tagid.tags.layouts.objects import builtin_objects
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table, grouped

FIRST_SEED = 62_000
DISTANCES_MM = (1, 2)
VIEWS, SNR_DB = 36, 20.0
DESIGNED = 4
"""Layouts of the designed set."""
NOTE = """Every reflector of a tag is off its mark by the distance above the column, each in a random
direction: tags that were named of {count}. {views} views, {snr:g} dB, octahedra of 40 mm, up to 4 mm off the
axis, 0.5 % of wobble; no body is enrolled. The designed layouts are {designed} of 3 reflectors on a
helmet, enrolled without others of their kind. {wrong}"""


@cache
def designed() -> dict[str, Layout]:
    """The designed set."""
    family = design(builtin_objects()["helmet"], DesignRules(), DESIGNED, "designed")
    return {layout.name: layout for layout in family.layouts}


def tags() -> list[tuple[str, str]]:
    """Layout and body of every row."""
    bodies = {name: "helmet" if name.startswith("helmet") else "can:35mm" for name in builtin_layouts()}
    bare = [(name, "none") for name in (*bodies, *designed())]
    return bare + list(bodies.items())


def displaced(layout: Layout, distance_m: float, rng: np.random.Generator) -> Layout:
    """The layout with every reflector moved by a distance in a random direction."""
    turn = rng.uniform(0, 2 * math.pi, layout.size)
    moved = layout.positions + distance_m * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return replace(layout, positions=moved, symmetry=0)


def reading(job: tuple[int, str, str, int]) -> dict[str, str]:
    """The outcome of a tag, of its number, layout, body, and the distance in mm: named, wrong or refused."""
    number, name, body, distance_mm = job
    enrolled = builtin_layouts() if name in builtin_layouts() else designed()
    rng = np.random.default_rng([FIRST_SEED, number])
    glued = displaced(enrolled[name], distance_mm * 1e-3, rng)
    seed = FIRST_SEED + number
    reflector = parse_reflector("octahedron:40mm")
    scene = scene_on_body(name, parse_body(body), reflector, seed, layouts={name: glued})
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
    numbers = run.drawn(20, first=FIRST_SEED)
    shown = tags()[: 1 if run.quick else None]
    jobs = [(n, *tag, d) for n in range(len(numbers)) for tag in shown for d in DISTANCES_MM]
    results = run.each(reading, jobs)
    outcomes = grouped(results, lambda job: job[1:])
    rows = [
        (*tag, *(sum(item["outcome"] == "named" for item in outcomes[*tag, d]) for d in DISTANCES_MM))
        for tag in shown
    ]
    wrong = sum(item["outcome"] == "wrong" for item in results.values())
    said = "None was given a wrong name." if not wrong else f"{wrong} were given a wrong name."
    columns = ("layout", "body", *(f"{distance} mm" for distance in DISTANCES_MM))
    note = NOTE.format(count=len(numbers), views=VIEWS, snr=SNR_DB, designed=DESIGNED, wrong=said)
    yield Table(columns, rows, note)
