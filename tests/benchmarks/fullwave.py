"""Validates the full-wave solver: differences in dB from exact series and from finer meshes.

Spheres against the Mie series, plates against physical optics, a tube against the exact series of an infinite
cylinder, a dielectric plate against the slab, convergence of meshes, interpolation between rings, and every
shared response (skipped where there is no folder `shared` beside the checkout).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product

import numpy as np

from tagid.constants import SPEED_OF_LIGHT
from tagid.simulate.response import Ring
from tagid.simulate.response_file import read_response
from tests.benchmarks.electromagnetic import ConductingCylinder
from tests.benchmarks.provenance import SHARED
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table
from train.fullwave import Efie, Mesh, Sweep, ring_antennas, shapes, solve_response
from train.fullwave.mie import sphere_backscatter

RESPONSES = SHARED / "fullwave" / "responses"
EAST = np.array([[1.0, 0.0, 0.0]])
UP = np.array([[0.0, 0.0, 1.0]])
FAR_M = 300.0
Line = tuple[str, str]


def db(ratio: np.ndarray | complex) -> np.ndarray:
    return 20 * np.log10(np.abs(ratio))


def wavenumber(ghz: float) -> float:
    return 2e9 * np.pi * ghz / SPEED_OF_LIGHT


def far_field(equation: Efie, k: float) -> complex:
    """b towards a far antenna on the x axis, vertical polarisation."""
    s = equation.monostatic(k, FAR_M * EAST, UP)[0]
    return complex(s * FAR_M**2 * np.exp(2j * k * FAR_M))


def mie() -> Iterator[Line]:
    """The faceted sphere is compared with the sphere of its volume."""
    for radius, pieces in ((0.02, 5), (0.02, 8), (0.03, 8)):
        mesh = shapes.sphere(radius, pieces)
        p = mesh.corners
        volume = np.abs(np.einsum("ti,ti->t", p[:, 0], np.cross(p[:, 1], p[:, 2]))).sum() / 6
        equal = (0.75 * volume / np.pi) ** (1 / 3)
        equation = Efie(mesh)
        ratios = np.array(
            [
                far_field(equation, k) / sphere_backscatter(equal, np.array(k))
                for k in map(wavenumber, np.arange(3.0, 5.01, 0.25))
            ]
        )
        worst, angle = np.abs(db(ratios)).max(), np.abs(np.angle(ratios, deg=True)).max()
        what = f"sphere {1e3 * radius:.0f} mm, {equation.unknowns} unknowns, 3..5 GHz"
        yield what, f"worst {worst:.2f} dB, {angle:.1f} deg"


def plate() -> Iterator[Line]:
    """Physical optics at normal incidence: |b| = area / wavelength."""
    side = 0.15
    equation = Efie(shapes.plate(side, side, 0.009))
    for ghz in (3.0, 4.0, 5.0):
        k = wavenumber(ghz)
        exact = side**2 * k / (2 * np.pi)
        yield f"plate 150 mm, {ghz} GHz", f"{float(db(far_field(equation, k) / exact)):+.2f} dB"


def cylinder() -> Iterator[Line]:
    """A tube of three to five wavelengths against a slice of the infinite cylinder; its ends diffract."""
    height, radius = 0.3, 0.03
    exact = ConductingCylinder(radius, height)
    equation = Efie(shapes.tube(radius, height, 0.0095))
    for ghz in (3.0, 3.5, 4.0, 4.5, 5.0):
        ratio = far_field(equation, wavenumber(ghz)) / exact.scattering_length(np.array(ghz * 1e9))
        what = f"tube 60 x 300 mm, {equation.unknowns} unknowns, {ghz} GHz, against the exact cylinder"
        yield what, f"{float(db(ratio)):+.2f} dB, {np.angle(ratio, deg=True):+.1f} deg"


def sheet() -> Iterator[Line]:
    """A dielectric plate over the metal plate of its size, against the reflection of the slab."""
    side = 0.22
    metal = Efie(shapes.plate(side, side, 0.0115))
    for eps, thickness in ((2.8, 0.003), (5.0, 0.003)):
        equation = Efie(shapes.plate(side, side, 0.0115, shapes.sheet(eps, thickness)))
        for ghz in (3.1, 4.8):
            k = wavenumber(ghz)
            r = (1 - np.sqrt(eps)) / (1 + np.sqrt(eps))
            through = np.exp(-2j * k * np.sqrt(eps) * thickness)
            slab = r * (1 - through) / (1 - r**2 * through)
            x = 0.5j * k * (eps - 1) * thickness
            ratio = far_field(equation, k) / far_field(metal, k)
            solver, ideal = float(db(ratio / slab)), float(db(x / (1 + x) / slab))
            what = f"sheet eps {eps}, 3 mm, {ghz} GHz, against the slab"
            yield what, f"solver {solver:+.2f} dB, ideal sheet {ideal:+.2f} dB"


def around(equation: Efie, k: float, ring: Ring, aspects: int) -> np.ndarray:
    """b (aspects,) of one frequency and ring."""
    position, polarisation = ring_antennas(ring, aspects)
    return equation.monostatic(k, position, polarisation) * ring.range_m**2 * np.exp(2j * k * ring.range_m)


def mesh() -> Iterator[Line]:
    """Each mesh against the finest of its kind."""
    skin = shapes.sheet(2.8, 0.003)
    kinds: dict[str, dict[str, Callable[[], Mesh]]] = {
        "octahedron 20 mm": {
            **{f"{n} even": partial(shapes.octahedron, 0.02, n, 1.0) for n in (3, 4, 6)},
            **{f"{n} graded": partial(shapes.octahedron, 0.02, n) for n in (3, 4, 6, 8)},
        },
        "can 60 x 90 mm": {f"{e} mm": partial(shapes.can, 0.03, 0.09, e / 1e3) for e in (10, 9, 8, 6)},
        "helmet 78 x 101 mm": {
            f"{e} mm": partial(shapes.helmet, (0.078, 0.101, 0.09), 0.02, e / 1e3, skin)
            for e in (12, 11, 9.5, 8)
        },
    }
    for kind, meshes in kinds.items():
        results = {
            label: np.stack([around(Efie(build()), wavenumber(4.0), Ring(1.0, p), 24) for p in "VH"])
            for label, build in meshes.items()
        }
        best = list(results.values())[-1]
        for label, b in results.items():
            error = np.sqrt((np.abs(b - best) ** 2).mean(1) / (np.abs(best) ** 2).mean(1))
            power = 10 * np.log10((np.abs(b) ** 2).mean(1) / (np.abs(best) ** 2).mean(1))
            yield (
                f"mesh of {kind}, {label}",
                f"mean RCS V {power[0]:+.2f} H {power[1]:+.2f} dB, "
                f"rms error V {100 * error[0]:.1f} H {100 * error[1]:.1f} %",
            )


def distance() -> Iterator[Line]:
    """Responses interpolated from rings at 0.8, 1.0 and 1.2 m (V) or 0.8 and 1.2 m (H), against solved."""
    can = Mesh.join(shapes.can(0.03, 0.09, 0.01), shapes.tag(0.03, np.array([[0.045, 0.0]]), 3))
    rings = tuple(Ring(d, p) for d in (0.55, 0.7, 0.9, 1.5, 3.0) for p in "VH")
    solved = solve_response("can", can, Sweep(3.9e9, 4.1e9, 2, 48, rings))
    base = solve_response("can", can, Sweep(3.9e9, 4.1e9, 2, 48))
    for i, ring in enumerate(rings):
        seen = base.seen_from(ring_antennas(ring, 48)[0], ring.polarisation)
        there = solved.scattering_length_m[:, i].T
        error = np.sqrt((np.abs(seen - there) ** 2).mean() / (np.abs(there) ** 2).mean())
        yield f"distance {ring.distance_m} m {ring.polarisation}", f"rms error {100 * error:.2f} %"


def _shared_mesh(name: str, pieces: int, grading: float) -> Mesh:
    """An object of the shared folder, from the words of its README."""
    body, _, layout = name.partition("_")
    radius, tip = (0.11, 0.02) if "h120" in layout else (0.045, 0.02)
    if "40" in name or body == "can28":
        tip = 0.04
    angles = {"one": [0], "c90": [0, 90], "c180": [0, 180], "h120": [0, 120, 240]}
    layout = layout.removesuffix("_20").removesuffix("_40")
    positions = [
        [radius * np.cos(np.deg2rad(a)), radius * np.sin(np.deg2rad(a))] for a in angles.get(layout, [])
    ]
    if name.endswith("_one") and body.startswith("free"):
        positions = [[0.0, 0.0]]
    if layout == "lin":
        positions = [[-0.09, 0.0], [0.0, 0.0], [0.09, 0.0]]
    parts = []
    if body.startswith("can"):
        parts.append(shapes.can(float(body[3:]) / 1e3, 0.1, 0.008))
    if body == "shell":
        parts.append(shapes.helmet((0.078, 0.101, 0.09), 0.02, 0.011, shapes.sheet(2.8, 0.003)))
    if layout == "handle":
        parts.append(shapes.handle(0.037).moved(turn_rad=np.deg2rad(250)))
    if positions:
        parts.append(shapes.tag(tip, np.array(positions), pieces, grading))
    return Mesh.join(*parts)


def shared() -> Iterator[Line]:
    """Every shared response at 3.1, 4.0 and 4.9 GHz, with even reflector meshes of 3 (20 mm) or 4 pieces."""
    if not RESPONSES.is_dir():
        yield "shared responses", f"skipped, {RESPONSES} does not exist"
        return
    for path in sorted(RESPONSES.glob("*.npz")):
        theirs, name = read_response(path), path.stem
        pieces = 4 if "40" in name or "can28" in name else 3
        equation = Efie(_shared_mesh(name, pieces, 1.0))
        begun = time.monotonic()
        mean, worst, error = [], [], []
        for i, j in product((5, 20, 35), (1, 3)):
            b = around(equation, float(theirs.wavenumber[i]), theirs.rings[j], 24)
            x = theirs.scattering_length_m[i, j, ::3]
            mean.append(10 * np.log10((np.abs(b) ** 2).mean() / (np.abs(x) ** 2).mean()))
            strong = np.abs(x) > np.abs(x).max() / np.sqrt(10)
            worst.append(np.abs(db(b / x))[strong].max())
            error.append(np.sqrt((np.abs(b - x) ** 2).mean() / (np.abs(x) ** 2).mean()))
        yield (
            f"{name}, {equation.unknowns} unknowns",
            f"mean RCS {min(mean):+.2f}..{max(mean):+.2f} dB, within 10 dB of the maximum {max(worst):.2f} "
            f"dB, rms {100 * max(error):.1f} %, {time.monotonic() - begun:.0f} s",
        )


CHECKS = {check.__name__: check for check in (mie, plate, cylinder, sheet, mesh, distance, shared)}


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("checks", nargs="*", metavar="CHECK", help=f"of {', '.join(CHECKS)}; all of them")


def differences(run: Run) -> Iterator[Table]:
    rows = []
    for name in run.options.checks or (("plate",) if run.quick else CHECKS):
        for line in CHECKS[name]():
            run.say(": ".join(line))
            rows.append(line)
    yield Table("check | difference", rows)
