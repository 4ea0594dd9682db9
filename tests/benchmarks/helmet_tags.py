"""What our simulator's helmets do to the echo of their tags, against tags on solved helmet shells.

The echo of a tag is that of the tagged shell less that of the shell, both by the method of moments. Each
model has the same reflectors, alike, and one free amplitude per frequency; the half axes of its shell are
those that suit the echo best, in steps of 2 mm. The share of the energy is what the model leaves, without
what is constant over the aspects.

In a carton, 105 by 140 mm wide and 120 mm high, of 5 mm cardboard with a permittivity of 1.5, the same with
its four walls in place of an ellipse, at their true places; the last line is the carton alone.

    python tests/benchmarks/helmet_tags.py --write docs/results
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
from numpy.typing import NDArray
from provenance import ROOT, page, publish

from tagid.errors import DataError
from tagid.fields.thin_shell import BoxShell, EllipticShell, ShellField
from tagid.simulate.beside import Beside, BesideRound, BesideShell
from tagid.simulate.multipole import Layer
from tagid.simulate.response import Response
from tagid.simulate.response_file import read_response
from tagid.simulate.taps import wavenumber

SHARED = Path(os.environ.get("TAGID_SHARED", ROOT.parent / "shared")) / "fullwave" / "responses"
OWN = ROOT / "tests" / "data" / "shells"
WALL_M, PERMITTIVITY = 3e-3, 2.8
"""Of the simulator's helmets."""
ACROSS_M, ALONG_M = np.arange(0.068, 0.085, 0.002), np.arange(0.088, 0.107, 0.002)
CARTONS = ROOT / "tests" / "data" / "cartons"
WALLS = BoxShell(0.070, 0.0525, (1.5 - 1) * 5e-3)
FREQUENCIES, ASPECTS = 7, 72


@dataclass(frozen=True)
class Tagged:
    """A solved tag on a solved shell: files, radius of its ring, m, and directions of its reflectors, deg."""

    folder: Path
    shell: str
    name: str
    radius_m: float
    degrees: tuple[float, ...]
    middle: bool = False

    @property
    def places(self) -> NDArray[np.complex128]:
        """(K,) x + jy, m."""
        ring = self.radius_m * np.exp(1j * np.deg2rad(self.degrees))
        return np.append(ring, 1e-4) if self.middle else np.asarray(ring)


TAGS = (
    Tagged(SHARED, "shell", "shell_h120_20", 0.110, (0, 120, 240)),
    Tagged(SHARED, "shell", "shell_h120_40", 0.110, (0, 120, 240)),
    Tagged(OWN, "shell74", "shell74_h120", 0.112, (25, 145, 265)),
    Tagged(OWN, "shell74", "shell74_lin", 0.090, (0, 180), middle=True),
)


IN_CARTONS = (
    Tagged(CARTONS, "carton140", "carton140_c90", 0.045, (100, 190)),
    Tagged(CARTONS, "carton140", "carton140_three", 0.045, (0, 100, 220)),
)


def beside_sheet(across_m: float, along_m: float, place: complex) -> Beside:
    """The thin elliptic sheet of the simulator's helmets."""
    return BesideShell(EllipticShell(across_m, along_m, (PERMITTIVITY - 1) * WALL_M / 2), place)


def beside_round_wall(across_m: float, along_m: float, place: complex) -> Beside:
    """A round wall about the axis, as far from it as the shell's in the reflector's direction."""
    direction = place / abs(place)
    wall = 1 / float(np.hypot(direction.real / across_m, direction.imag / along_m))
    if abs(abs(place) - wall) < WALL_M / 2:
        raise DataError("in the wall")
    return BesideRound((Layer(wall - WALL_M / 2), Layer(wall + WALL_M / 2, PERMITTIVITY)), abs(place))


def left(
    echo: NDArray[np.complex128],
    frequency_hz: NDArray[np.float64],
    antenna: NDArray[np.complex128],
    tag: Tagged,
    beside: Callable[[complex], Beside | None],
) -> float:
    """Share of an echo (F, V) that alike reflectors beside a body leave."""
    k = wavenumber(frequency_hz)
    wave = np.zeros_like(echo)
    for place in tag.places:
        apart = np.abs(antenna - place)
        one = np.exp(-2j * k[:, None] * (apart - np.abs(antenna))) * (np.abs(antenna) / apart) ** 2
        body = beside(complex(place))
        if body is not None:
            one = one * body.effect(frequency_hz, np.angle(antenna) - np.angle(place))
        wave += one
    return left_by(echo, wave)


def left_by(echo: NDArray[np.complex128], wave: NDArray[np.complex128]) -> float:
    """Share of an echo (F, V) that a wave (F, V) leaves with one amplitude per frequency."""
    wave = wave - wave.mean(axis=1, keepdims=True)
    seen = echo - echo.mean(axis=1, keepdims=True)
    along = np.abs((wave.conj() * seen).sum(axis=1)) ** 2 / (np.abs(wave) ** 2).sum(axis=1)
    return float(1 - along.sum() / (np.abs(seen) ** 2).sum())


def best(
    tag: Tagged,
    echo: NDArray[np.complex128],
    frequency_hz: NDArray[np.float64],
    antenna: NDArray[np.complex128],
) -> tuple[float, float, float]:
    """What no shell, round walls and elliptic sheets leave."""
    found = {beside_round_wall: np.inf, beside_sheet: np.inf}
    for across, along in product(ACROSS_M, ALONG_M):
        for make in found:
            try:
                value = left(echo, frequency_hz, antenna, tag, partial(make, float(across), float(along)))
            except DataError:
                continue
            found[make] = min(found[make], value)
    return left(echo, frequency_hz, antenna, tag, lambda _: None), *found.values()


def echo_of(tag: Tagged) -> tuple[NDArray[np.complex128], NDArray[np.float64], NDArray[np.complex128]]:
    """Echo (F, V) of a tag, frequencies (F,) and antennas x + jy (V,), 1 m away or as solved."""
    (tagged, frequency, antenna), (shell, _, _) = (solved(tag.folder, name) for name in (tag.name, tag.shell))
    return tagged - shell, frequency, antenna


def solved(
    folder: Path, name: str
) -> tuple[NDArray[np.complex128], NDArray[np.float64], NDArray[np.complex128]]:
    """The same of a whole object."""
    shell = read_response(folder / f"{name}.npz")
    antenna = distance_of(shell) * np.exp(2j * np.pi * np.arange(ASPECTS) / ASPECTS)
    where = np.stack([antenna.real, antenna.imag, 0 * antenna.real], axis=1)
    inside = np.flatnonzero((shell.frequency_hz >= 3.1e9) & (shell.frequency_hz <= 4.8e9))
    kept = inside[np.linspace(0, len(inside) - 1, FREQUENCIES).astype(int)]
    return shell.seen_from(where).T[kept], shell.frequency_hz[kept], antenna


def distance_of(response: Response) -> float:
    """The nearest distance at which it was solved, m."""
    return min(ring.distance_m for ring in response.rings)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--write", type=Path, help="folder for helmet-tags.md")
    given = parser.parse_args()
    title = "Tags on helmets and in cartons: thin sheets against solved ones"
    lines = [
        *page(title, "none, nothing is drawn", __doc__),
        "| solved tag | no shell | round wall | elliptic sheet |",
        "|---|---|---|---|",
    ]
    for tag in TAGS:
        values = best(tag, *echo_of(tag))
        lines.append(f"| {tag.name} | {' | '.join(f'{100 * value:.1f} %' for value in values)} |")
        print(lines[-1], flush=True)
    lines += ["", "| solved | no walls | four walls |", "|---|---|---|"]
    for tag in IN_CARTONS:
        echo, frequency, antenna = echo_of(tag)
        alone = left(echo, frequency, antenna, tag, lambda _: None)
        walled = left(echo, frequency, antenna, tag, lambda place: BesideShell(WALLS, place))
        lines.append(f"| {tag.name} | {100 * alone:.1f} % | {100 * walled:.1f} % |")
    echo, frequency, antenna = solved(CARTONS, "carton140")
    own = ShellField.of(wavenumber(frequency), WALLS).echo(antenna)
    lines.append(f"| carton140, untagged | | {100 * left_by(echo, own):.1f} % |")
    publish(lines, given.write, "helmet-tags.md")


if __name__ == "__main__":
    main()
