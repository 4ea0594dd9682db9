"""Solves the objects of tests/data/responses: about 15 minutes of one core for all of them.

    PYTHONPATH=. OMP_NUM_THREADS=1 python tests/benchmarks/solve_responses.py [NAME ...] [--out FOLDER]

Without names it solves every object whose file is missing. The dimensions differ from every object that the
reader's constants were chosen on. Reflectors are octahedra, positions in mm in the object's frame.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tagid.simulate.response_file import write_response
from train.fullwave import Mesh, Sweep, shapes, solve_response

OUT = Path(__file__).resolve().parents[1] / "data" / "responses"
SWEEP = Sweep(frequencies=21)
"""2.8 to 5.2 GHz in steps of 120 MHz: 1.25 m of depth, which holds all but -37 dB of a can's echo."""


@dataclass(frozen=True)
class Object:
    """One object: its body, and the size and places of its reflectors.

    Attributes:
        body: its mesh, or None for a tag alone.
        tip_mm: reflectors from tip to tip.
        places: (radius in mm, azimuth in degrees) of every reflector.
    """

    body: Callable[[], Mesh] | None
    tip_mm: float = 20.0
    places: tuple[tuple[float, float], ...] = ()

    @property
    def reflectors_m(self) -> np.ndarray:
        """(n, 2) m."""
        polar = np.array(self.places, dtype=np.float64).reshape(-1, 2)
        angle = np.deg2rad(polar[:, 1])
        return 1e-3 * polar[:, :1] * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def mesh(self) -> Mesh:
        """All of it."""
        parts = [] if self.body is None else [self.body()]
        if self.places:
            parts.append(shapes.tag(self.tip_mm * 1e-3, self.reflectors_m))
        return Mesh.join(*parts)


def _can30() -> Mesh:
    return shapes.can(0.030, 0.090, 0.009)


def _can40() -> Mesh:
    return shapes.can(0.040, 0.100, 0.0095)


def _handled() -> Mesh:
    return Mesh.join(
        shapes.can(0.034, 0.085, 0.009),
        shapes.handle(0.036, 0.030, 0.050, 0.012, 0.009).moved(turn_rad=np.deg2rad(200)),
    )


def _cup() -> Mesh:
    return shapes.can(0.036, 0.085, 0.009, shapes.sheet(5.0, 0.003))


def _shell() -> Mesh:
    return shapes.helmet((0.072, 0.092, 0.080), 0.025, 0.0105, shapes.sheet(2.8, 0.003))


def _box() -> Mesh:
    return shapes.box((0.070, 0.070, 0.090), 0.010)


OBJECTS = {
    "free30_one": Object(None, 30, ((0, 0),)),
    "free30_c90": Object(None, 30, ((45, 0), (45, 90))),
    "free20_foreign": Object(None, 20, ((45, 0), (45, 55), (45, 170))),
    "can30": Object(_can30),
    "can30_c180": Object(_can30, 30, ((45, 0), (45, 180))),
    "can30_foreign": Object(_can30, 30, ((45, 0), (45, 130))),
    "can40": Object(_can40),
    "can40_one": Object(_can40, 20, ((49, 0),)),
    "can40_c90": Object(_can40, 20, ((49, 0), (49, 90))),
    "handle34": Object(_handled),
    "handle34_c90": Object(_handled, 20, ((45, 0), (45, 90))),
    "cup36": Object(_cup),
    "cup36_one": Object(_cup, 20, ((45, 0),)),
    "cup36_c180": Object(_cup, 20, ((45, 0), (45, 180))),
    "shell": Object(_shell),
    "shell_h120": Object(_shell, 40, ((110, 0), (110, 120), (110, 240))),
    "box": Object(_box),
    "box_c90": Object(_box, 30, ((60, 0), (60, 90))),
}


def main(objects: dict[str, Object], sweep: Sweep) -> None:
    """Solve the objects that the command line names, or all that are missing."""
    parser = argparse.ArgumentParser(description="Solves objects into response files.")
    parser.add_argument("names", nargs="*", choices=[*objects, []], help="objects; all that are missing")
    parser.add_argument("--out", type=Path, default=OUT, help="folder of the files")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for name in given.names or [n for n in objects if not (given.out / f"{n}.npz").exists()]:
        begun, cpu = time.monotonic(), time.process_time()
        thing = objects[name]
        response = solve_response(name, thing.mesh(), sweep, thing.reflectors_m)
        write_response(given.out / f"{name}.npz", response)
        spent = f"{time.monotonic() - begun:.0f} s, {time.process_time() - cpu:.0f} s of one core"
        print(f"{name}: {response.provenance['mesh']}; {spent}", flush=True)


if __name__ == "__main__":
    main(OBJECTS, SWEEP)
