"""Simulated scenes and recordings, so that every stage is tested against a known truth.

The same scenes feed the capture simulator and the radar emulator's turning object.
"""

from tagid.simulate.acquisition import Acquisition, Placement, RangeWindow, Recording, Wobble
from tagid.simulate.capture import Truth, simulate_capture
from tagid.simulate.electromagnetic import ConductingCylinder, Plate, cardboard_box, metal_box
from tagid.simulate.presets import preset_names, scene_from_layout, scene_from_name
from tagid.simulate.scattering import Box, Cylinder, Points
from tagid.simulate.scene import Scene, StaticReturns
from tagid.simulate.source import TurningScene

__all__ = [
    "Acquisition",
    "Box",
    "ConductingCylinder",
    "Cylinder",
    "Placement",
    "Plate",
    "Points",
    "RangeWindow",
    "Recording",
    "Scene",
    "StaticReturns",
    "Truth",
    "TurningScene",
    "Wobble",
    "cardboard_box",
    "metal_box",
    "preset_names",
    "scene_from_layout",
    "scene_from_name",
    "simulate_capture",
]
