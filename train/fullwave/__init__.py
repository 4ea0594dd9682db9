"""A full-wave solver for thin metal and thin dielectric sheets, and meshes of the objects of interest."""

from train.fullwave.efie import Efie
from train.fullwave.mesh import Mesh
from train.fullwave.sweep import Sweep, ring_antennas, solve_response

__all__ = ["Efie", "Mesh", "Sweep", "ring_antennas", "solve_response"]
