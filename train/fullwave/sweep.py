"""From a mesh to a response: solves the integral equation for every frequency and ring of antennas.

Time for one frequency on one core: 2 s for 1400 unknowns (a can of 70 x 100 mm with edges of 8 mm). It grows
with the square of the unknowns; the factorisation, which grows with the cube, is half of it at about 5000.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tagid._version import __version__
from tagid.constants import SPEED_OF_LIGHT
from tagid.errors import DataError
from tagid.simulate.response import Response, Ring
from tagid.types import Floats
from train.fullwave.efie import Efie
from train.fullwave.mesh import Mesh

COARSEST = 3.5
"""Minimum wavelength in units of the longest mesh edge: the longest is about 1.7 times the usual edge."""


@dataclass(frozen=True)
class Sweep:
    """Parameters of a solution.

    Attributes:
        start_hz, stop_hz: first and last frequency, Hz.
        frequencies: their number, evenly spaced. The spacing limits the depth in range to c / (2 spacing):
            1.5 m for 100 MHz.
        aspects: antennas on each ring. The response of an object of radius r has harmonics up to about
            2 k r + 6, so that 72 suffice up to 0.13 m at 5.2 GHz.
        rings: distances, polarisations and heights.
    """

    start_hz: float = 2.8e9
    stop_hz: float = 5.2e9
    frequencies: int = 25
    aspects: int = 72
    rings: tuple[Ring, ...] = (*(Ring(d, "V") for d in (0.8, 1.0, 1.2)), *(Ring(d, "H") for d in (0.8, 1.2)))

    @property
    def frequency_hz(self) -> Floats:
        """(frequencies,) Hz."""
        return np.linspace(self.start_hz, self.stop_hz, self.frequencies)


def ring_antennas(ring: Ring, aspects: int) -> tuple[Floats, Floats]:
    """Positions and polarisations (aspects, 3) of the antennas on a ring.

    V is the upright direction as seen along the line of sight (tilted if the ring is above the
    plane), H lies in the horizontal plane.
    """
    angle = 2 * np.pi * np.arange(aspects) / aspects
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros(aspects)], axis=1)
    across = np.stack([-np.sin(angle), np.cos(angle), np.zeros(aspects)], axis=1)
    positions = ring.distance_m * outward + np.array([0.0, 0.0, ring.height_m])
    if ring.polarisation == "H":
        return positions, across
    sight = positions / ring.range_m
    return positions, np.cross(sight, across)


def solve_response(
    name: str,
    mesh: Mesh,
    sweep: Sweep | None = None,
    reflectors_m: Floats | None = None,
) -> Response:
    """Solve an object.

    Args:
        sweep: frequencies and antennas; the default suits a tag at about 1 m from the P440.
        reflectors_m: (n, 2) true positions of the reflectors, stored with the response.

    Returns:
        its response, with the mesh and the solver named in its provenance.

    Raises DataError: the mesh is too coarse for the highest frequency, or an antenna touches it.
    """
    sweep = Sweep() if sweep is None else sweep
    shortest = SPEED_OF_LIGHT / sweep.stop_hz
    if mesh.longest_edge_m * COARSEST > shortest:
        raise DataError(
            f"mesh edges of {name} are up to {1e3 * mesh.longest_edge_m:.1f} mm long, at a wavelength of "
            f"{1e3 * shortest:.1f} mm",
            f"The wavelength must be at least {COARSEST:g} times the longest edge.",
        )
    equation = Efie(mesh)
    antennas = [ring_antennas(ring, sweep.aspects) for ring in sweep.rings]
    positions, polarisations = (np.concatenate([pair[i] for pair in antennas]) for i in (0, 1))
    distance = np.linalg.norm(positions, axis=1)
    b = np.empty((sweep.frequencies, len(positions)), dtype=np.complex64)
    for i, frequency in enumerate(sweep.frequency_hz):
        k = 2 * np.pi * frequency / SPEED_OF_LIGHT
        s = equation.monostatic(float(k), positions, polarisations)
        b[i] = s * distance**2 * np.exp(2j * k * distance)
    return Response(
        name,
        sweep.frequency_hz,
        sweep.rings,
        b.reshape(sweep.frequencies, len(sweep.rings), sweep.aspects),
        np.zeros((0, 2)) if reflectors_m is None else np.asarray(reflectors_m, np.float64),
        {
            "method": "method of moments, EFIE, RWG functions",
            "solver": f"tagid {__version__}",
            "mesh": f"{len(mesh.triangles)} triangles, {equation.unknowns} unknowns, edges up to "
            f"{1e3 * mesh.longest_edge_m:.1f} mm",
        },
    )
