"""Identifies tagged objects from ultra-wideband radar scans taken while they rotate.

The names listed here are the public interface (`docs/api.md`). Each is loaded when it is first used, so
`import tagid` is cheap. Everything else may change between versions.
"""

from __future__ import annotations

TYPE_CHECKING = False  # type checkers take it as true; importing `typing` would cost more than all else here
if TYPE_CHECKING:
    from typing import Any

    from tagid.angles.views import Angles as Angles
    from tagid.capture import Capture as Capture
    from tagid.capture import Pulse as Pulse
    from tagid.config import Config as Config
    from tagid.config import ConfigValue as ConfigValue
    from tagid.geometry import Aperture as Aperture
    from tagid.geometry import ImageGrid as ImageGrid
    from tagid.imaging.ats.problem import FieldShape as FieldShape
    from tagid.imaging.ats.settings import AtsSettings as AtsSettings
    from tagid.imaging.autofocus import AxisFocus as AxisFocus
    from tagid.imaging.operator import ForwardOperator as ForwardOperator
    from tagid.imaging.preprocess import PreprocessSettings as PreprocessSettings
    from tagid.imaging.pulsefit import PulseEstimate as PulseEstimate
    from tagid.imaging.rangefocus import DelayFocus as DelayFocus
    from tagid.imaging.rangefocus import EchoPoint as EchoPoint
    from tagid.imaging.region import Region as Region
    from tagid.imaging.types import BasebandScans as BasebandScans
    from tagid.imaging.types import Image as Image
    from tagid.imaging.types import PointResponse as PointResponse
    from tagid.metadata import Ending as Ending
    from tagid.metadata import MotionInfo as MotionInfo
    from tagid.metadata import ObjectInfo as ObjectInfo
    from tagid.metadata import RadarInfo as RadarInfo
    from tagid.metadata import RadarSettings as RadarSettings
    from tagid.metadata import RecordingPart as RecordingPart
    from tagid.metadata import ReferenceFacts as ReferenceFacts
    from tagid.metadata import ReferenceName as ReferenceName
    from tagid.metadata import ResolvedMotion as ResolvedMotion
    from tagid.metadata import ScanGap as ScanGap
    from tagid.metadata import SimulatedTruth as SimulatedTruth
    from tagid.metadata import Standstill as Standstill
    from tagid.metadata import Track as Track
    from tagid.motion.device import Motion as Motion
    from tagid.operate.turn import Answer as Answer
    from tagid.operate.turn import ReadingSetup as ReadingSetup
    from tagid.operate.turn import identify as identify
    from tagid.operate.workplace import Workplace as Workplace
    from tagid.pipeline.answer import Cause as Cause
    from tagid.pipeline.answer import Identification as Identification
    from tagid.pipeline.load import LoadDefault as LoadDefault
    from tagid.pipeline.load import LoadSettings as LoadSettings
    from tagid.pipeline.load import load_capture as load_capture
    from tagid.pipeline.prepared import PreparedCapture as PreparedCapture
    from tagid.pipeline.prepared import prepare as prepare
    from tagid.pipeline.reconstruct import Reconstruction as Reconstruction
    from tagid.pipeline.reconstruct import reconstruct as reconstruct
    from tagid.pipeline.settings import ImagingSettings as ImagingSettings
    from tagid.pipeline.settings import TagPriors as TagPriors
    from tagid.radar.assembler import Scan as Scan
    from tagid.radar.assembler import Statistics as Statistics
    from tagid.radar.links import Link as Link
    from tagid.radar.p440 import P440 as P440
    from tagid.radar.settings import RadarConfig as RadarConfig
    from tagid.radar.status import RadarStatus as RadarStatus
    from tagid.recording.plan import RecordingPlan as RecordingPlan
    from tagid.recording.radars import open_radar as open_radar
    from tagid.recording.recorder import Watch as Watch
    from tagid.recording.recorder import record as record
    from tagid.recording.session import Session as Session
    from tagid.recording.stream import ScanStream as ScanStream
    from tagid.result import Problem as Problem
    from tagid.simulate.acquisition import Acquisition as Acquisition
    from tagid.simulate.acquisition import Placement as Placement
    from tagid.simulate.acquisition import RangeWindow as RangeWindow
    from tagid.simulate.acquisition import Recording as Recording
    from tagid.simulate.acquisition import Wobble as Wobble
    from tagid.simulate.capture import Truth as Truth
    from tagid.simulate.capture import simulate_capture as simulate_capture
    from tagid.simulate.noise import Interference as Interference
    from tagid.simulate.noise import NoiseShape as NoiseShape
    from tagid.simulate.presets import scene_from_name as scene_from_name
    from tagid.simulate.scattering import Body as Body
    from tagid.simulate.scattering import Points as Points
    from tagid.simulate.scattering import Returns as Returns
    from tagid.simulate.scene import Scene as Scene
    from tagid.simulate.scene import StaticReturns as StaticReturns
    from tagid.simulate.scene import Tag as Tag
    from tagid.simulate.snr import EchoLevels as EchoLevels
    from tagid.simulate.snr import Snr as Snr
    from tagid.simulate.spec import SceneSpec as SceneSpec
    from tagid.storage.exporters import export as export
    from tagid.storage.importers import read_any as read_any
    from tagid.tags.bodies.body_reading import BodyReading as BodyReading
    from tagid.tags.bodies.calibration import Bound as Bound
    from tagid.tags.bodies.hypothesis import Explanation as Explanation
    from tagid.tags.bodies.hypothesis import Kind as Kind
    from tagid.tags.bodies.signature import Signature as Signature
    from tagid.tags.enrolling.registry import Registry as Registry
    from tagid.tags.enrolling.registry import RegistryChange as RegistryChange
    from tagid.tags.enrolling.registry import RegistryContents as RegistryContents
    from tagid.tags.enrolling.registry import Restored as Restored
    from tagid.tags.layouts.layout import Layout as Layout
    from tagid.tags.layouts.layout import builtin_layouts as builtin_layouts
    from tagid.tags.matching.reading import LayoutScore as LayoutScore
    from tagid.tags.matching.reading import Reading as Reading
    from tagid.tags.network.detector import Detection as Detection
    from tagid.tags.network.second_look import Opinion as Opinion
    from tagid.tags.network.second_look import SecondLook as SecondLook
    from tagid.tags.reading.decision import Evidence as Evidence
    from tagid.tags.reading.reflectors import Reflector as Reflector
    from tagid.tags.verdicts.verdict import Code as Code

__version__ = "0.2.0"

_HOMES = {
    "Capture": "tagid.capture",
    "ImageGrid": "tagid.geometry",
    "ForwardOperator": "tagid.imaging.operator",
    "Identification": "tagid.pipeline.answer",
    "Answer": "tagid.operate.turn",
    "ReadingSetup": "tagid.operate.turn",
    "identify": "tagid.operate.turn",
    "Workplace": "tagid.operate.workplace",
    "load_capture": "tagid.pipeline.load",
    "PreparedCapture": "tagid.pipeline.prepared",
    "prepare": "tagid.pipeline.prepared",
    "Reconstruction": "tagid.pipeline.reconstruct",
    "reconstruct": "tagid.pipeline.reconstruct",
    "ImagingSettings": "tagid.pipeline.settings",
    "TagPriors": "tagid.pipeline.settings",
    "RecordingPlan": "tagid.recording.plan",
    "open_radar": "tagid.recording.radars",
    "record": "tagid.recording.recorder",
    "Acquisition": "tagid.simulate.acquisition",
    "simulate_capture": "tagid.simulate.capture",
    "scene_from_name": "tagid.simulate.presets",
    "SceneSpec": "tagid.simulate.spec",
    "export": "tagid.storage.exporters",
    "read_any": "tagid.storage.importers",
    "Layout": "tagid.tags.layouts.layout",
    "builtin_layouts": "tagid.tags.layouts.layout",
    "Registry": "tagid.tags.enrolling.registry",
    # Types of their arguments, results and fields.
    "Angles": "tagid.angles.views",
    "Pulse": "tagid.capture",
    "Config": "tagid.config",
    "ConfigValue": "tagid.config",
    "Aperture": "tagid.geometry",
    "FieldShape": "tagid.imaging.ats.problem",
    "AtsSettings": "tagid.imaging.ats.settings",
    "AxisFocus": "tagid.imaging.autofocus",
    "PreprocessSettings": "tagid.imaging.preprocess",
    "PulseEstimate": "tagid.imaging.pulsefit",
    "DelayFocus": "tagid.imaging.rangefocus",
    "EchoPoint": "tagid.imaging.rangefocus",
    "Ending": "tagid.metadata",
    "Region": "tagid.imaging.region",
    "BasebandScans": "tagid.imaging.types",
    "Image": "tagid.imaging.types",
    "PointResponse": "tagid.imaging.types",
    "MotionInfo": "tagid.metadata",
    "ObjectInfo": "tagid.metadata",
    "RadarInfo": "tagid.metadata",
    "RadarSettings": "tagid.metadata",
    "RecordingPart": "tagid.metadata",
    "ReferenceFacts": "tagid.metadata",
    "ReferenceName": "tagid.metadata",
    "ResolvedMotion": "tagid.metadata",
    "ScanGap": "tagid.metadata",
    "SimulatedTruth": "tagid.metadata",
    "Standstill": "tagid.metadata",
    "Track": "tagid.metadata",
    "Motion": "tagid.motion.device",
    "Cause": "tagid.pipeline.answer",
    "LoadDefault": "tagid.pipeline.load",
    "LoadSettings": "tagid.pipeline.load",
    "Scan": "tagid.radar.assembler",
    "Statistics": "tagid.radar.assembler",
    "Link": "tagid.radar.links",
    "P440": "tagid.radar.p440",
    "RadarConfig": "tagid.radar.settings",
    "RadarStatus": "tagid.radar.status",
    "Watch": "tagid.recording.recorder",
    "Session": "tagid.recording.session",
    "ScanStream": "tagid.recording.stream",
    "Problem": "tagid.result",
    "Placement": "tagid.simulate.acquisition",
    "RangeWindow": "tagid.simulate.acquisition",
    "Recording": "tagid.simulate.acquisition",
    "Wobble": "tagid.simulate.acquisition",
    "Truth": "tagid.simulate.capture",
    "Interference": "tagid.simulate.noise",
    "NoiseShape": "tagid.simulate.noise",
    "Body": "tagid.simulate.scattering",
    "Points": "tagid.simulate.scattering",
    "Returns": "tagid.simulate.scattering",
    "Scene": "tagid.simulate.scene",
    "StaticReturns": "tagid.simulate.scene",
    "Tag": "tagid.simulate.scene",
    "EchoLevels": "tagid.simulate.snr",
    "Snr": "tagid.simulate.snr",
    "Bound": "tagid.tags.bodies.calibration",
    "Explanation": "tagid.tags.bodies.hypothesis",
    "Kind": "tagid.tags.bodies.hypothesis",
    "BodyReading": "tagid.tags.bodies.body_reading",
    "Signature": "tagid.tags.bodies.signature",
    "RegistryChange": "tagid.tags.enrolling.registry",
    "RegistryContents": "tagid.tags.enrolling.registry",
    "Restored": "tagid.tags.enrolling.registry",
    "LayoutScore": "tagid.tags.matching.reading",
    "Reading": "tagid.tags.matching.reading",
    "Detection": "tagid.tags.network.detector",
    "Opinion": "tagid.tags.network.second_look",
    "SecondLook": "tagid.tags.network.second_look",
    "Evidence": "tagid.tags.reading.decision",
    "Reflector": "tagid.tags.reading.reflectors",
    "Code": "tagid.tags.verdicts.verdict",
}
"""Public name -> module that defines it."""

__all__ = [*_HOMES, "__version__"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'tagid' has no attribute {name!r}")
    from importlib import import_module

    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
