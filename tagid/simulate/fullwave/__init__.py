"""A full-wave solver for thin metal and thin dielectric sheets, and meshes of the objects of interest."""

from tagid.simulate.fullwave.efie import Efie
from tagid.simulate.fullwave.mesh import Mesh
from tagid.simulate.fullwave.sweep import Sweep, ring_antennas, solve_response

__all__ = ["Efie", "Mesh", "Sweep", "ring_antennas", "solve_response"]
