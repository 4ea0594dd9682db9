"""Simulated scenes and recordings with known ground truth, for tests of every processing stage.

The same scenes feed the capture simulator and the radar emulator.
"""

from tagid.simulate.acquisition import Acquisition, Placement, RangeWindow, Recording, Wobble
from tagid.simulate.capture import Truth, simulate_capture
from tagid.simulate.noise import Interference, NoiseShape
from tagid.simulate.presets import preset_names, scene_from_layout, scene_from_name, scene_on_body
from tagid.simulate.pulses import random_pulse
from tagid.simulate.scattering import Box, Cylinder, Points
from tagid.simulate.scene import Scene, StaticReturns
from tagid.simulate.snr import EchoLevels, Snr
from tagid.simulate.source import TurningScene
from tagid.simulate.spec import SceneSpec
from tagid.simulate.specification import BodySpec, ReflectorSpec, parse_body, parse_elevation, parse_reflector

__all__ = [
    "Acquisition",
    "BodySpec",
    "Box",
    "Cylinder",
    "EchoLevels",
    "Interference",
    "NoiseShape",
    "Placement",
    "Points",
    "RangeWindow",
    "Recording",
    "ReflectorSpec",
    "Scene",
    "SceneSpec",
    "Snr",
    "StaticReturns",
    "Truth",
    "TurningScene",
    "Wobble",
    "parse_body",
    "parse_elevation",
    "parse_reflector",
    "preset_names",
    "random_pulse",
    "scene_from_layout",
    "scene_from_name",
    "scene_on_body",
    "simulate_capture",
]
