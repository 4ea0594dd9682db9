"""Objects for the full-wave solver: bodies, tags on them, foreign tags, from solved_objects.toml.

"responses" are those of tests/data/responses; the others had no part in making the reader. Objects of
development may serve to find faults and to choose constants, so may those that were sealed and reported once
("opened"); sealed ones are only reported. Dimensions, reflector sizes, mounting radii, places, materials and
shapes differ from those of ../shared/fullwave.
"""

from __future__ import annotations

import argparse
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tagid.simulate.response import Ring
from tagid.simulate.response_file import write_response
from tests.benchmarks.measure import timed
from tests.benchmarks.provenance import ROOT
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table
from train.fullwave import Mesh, Sweep, shapes, solve_response

RESPONSES = Sweep(frequencies=21)
"""2.8 to 5.2 GHz in steps of 120 MHz: 1.25 m of depth, which holds all but -37 dB of a can's echo."""
UNSEEN = Sweep(
    frequencies=21,
    rings=(
        *(Ring(d, "V", h) for h in (0.0, 0.1) for d in (0.8, 1.2)),
        *(Ring(d, "H") for d in (0.8, 1.2)),
    ),
)
"""Upright polarisation from two heights: the tag may stand lower than the antenna."""
ROUND = (
    *("free24", "closed25", "wide45", "plastic40", "closed32", "cup33"),
    *("free18", "free36", "tin28", "bottle", "glass35", "pail"),
    *("tumbler", "jar42", "beaker31", "tin37"),
    *("soda34", "crock38", "flask29", "goblet33", "tub41"),
    *("free22", "free32", "free26", "can31", "cup39", "can36", "glass38"),
    *("can33", "tin41", "cup34", "glass31"),
    *("can40", "tin30", "bottle32", "cup37"),
    *("can38", "jar35", "bottle30"),
    *("flask33", "pot28"),
)
"""Bodies of revolution, and tags alone: to be read without enrollment."""


@dataclass(frozen=True)
class Object:
    """One object: its body, and the size and places of its reflectors.

    Attributes:
        body: its shape as in the file, or None for a tag alone.
        tip_mm: reflectors from tip to tip.
        places: (radius in mm, azimuth in degrees) of every reflector.
    """

    body: dict[str, Any] | None
    tip_mm: float = 20.0
    places: tuple[tuple[float, float], ...] = ()

    @classmethod
    def of(cls, body: dict[str, Any] | None, numbers: list[Any]) -> Object:
        if not numbers:
            return cls(body)
        tip_mm, first, *rest = numbers
        if isinstance(first, list):
            return cls(body, tip_mm, tuple((radius, angle) for radius, angle in (first, *rest)))
        return cls(body, tip_mm, tuple((first, angle) for angle in rest))

    @property
    def reflectors_m(self) -> np.ndarray:
        """(n, 2) m."""
        polar = np.array(self.places, dtype=np.float64).reshape(-1, 2)
        angle = np.deg2rad(polar[:, 1])
        return 1e-3 * polar[:, :1] * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def mesh(self) -> Mesh:
        parts = [] if self.body is None else [body_mesh(self.body)]
        if self.places:
            parts.append(shapes.tag(self.tip_mm * 1e-3, self.reflectors_m))
        return Mesh.join(*parts)


def body_mesh(shape: dict[str, Any]) -> Mesh:
    """The surface of a body, with its handle or seam."""
    edge = shape["edge"]
    wall = shapes.sheet(*shape["wall"]) if "wall" in shape else 0.0
    if "can" in shape:
        body = shapes.can(*shape["can"], edge, wall)
    elif "box" in shape:
        body = shapes.box(tuple(shape["box"]), edge, wall)
    elif "helmet" in shape:
        *radii, brim = shape["helmet"]
        body = shapes.helmet(tuple(radii), brim, edge, wall)
    else:
        across = tuple(shape.get("across", (1.0, 1.0)))
        body = shapes.revolved(1e-3 * np.array(shape["profile"], dtype=float), edge, across, wall)
    if "handle" in shape:
        more = shapes.handle(*shape["handle"], shape["handle_edge"], wall)
    elif "plate" in shape:
        more = shapes.plate(*shape["plate"], shape["plate_edge"])
    else:
        return body
    turn_rad = float(np.deg2rad(shape.get("turn_deg", 0.0)))
    return Mesh.join(body, more.moved(tuple(shape.get("shift", (0.0, 0.0, 0.0))), turn_rad))


def _load(kind: str, bodies: str) -> dict[str, Object]:
    file = tomllib.loads(Path(__file__).with_suffix(".toml").read_text())
    known = file["bodies"][bodies]
    return {name: Object.of(known.get(name.split("_")[0]), at) for name, at in file["objects"][kind].items()}


OPENED = _load("opened", "unseen")
OBJECTS = {**_load("development", "unseen"), **OPENED, **_load("sealed", "unseen")}
SETS = {
    "responses": (_load("responses", "responses"), RESPONSES, ROOT / "tests" / "data" / "responses"),
    "unseen": (OBJECTS, UNSEEN, ROOT / "build" / "unseen"),
}
"""Objects, the sweep by which they are solved, and the folder of the files."""


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("names", nargs="*", help="objects; all whose files are missing")
    parser.add_argument("--set", choices=tuple(SETS), default="responses")


def solve(run: Run) -> Iterator[Table]:
    objects, sweep, out = SETS[run.options.set]
    rows = []
    out.mkdir(parents=True, exist_ok=True)
    for name in run.options.names or [n for n in objects if not (out / f"{n}.npz").exists()]:
        if name not in objects:
            raise SystemExit(f"there is no object {name} in the set {run.options.set}")
        thing = objects[name]
        solved, wall, cpu = timed(partial(solve_response, name, thing.mesh(), sweep, thing.reflectors_m))
        write_response(out / f"{name}.npz", solved)
        rows.append((name, solved.provenance["mesh"], f"{wall:.0f}", f"{cpu:.0f}"))
        run.say(str(rows[-1]))
    yield Table("object | mesh | s | s of one core", rows)
