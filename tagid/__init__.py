"""Identifies tagged objects from ultra-wideband radar scans taken while they rotate.

The names listed here are the public interface, with the types of their arguments, results and fields, which
the API page of the site (`make docs`) lists by module. Each name is loaded when it is first used, so
`import tagid` is cheap. Everything else may change between versions.
"""

from __future__ import annotations

from tagid._version import __version__ as __version__

TYPE_CHECKING = False  # type checkers take it as true; importing `typing` would cost more than all else here
if TYPE_CHECKING:
    from typing import Any

    from tagid.capture import Capture as Capture
    from tagid.config import Config as Config
    from tagid.enrolling.registry import Registry as Registry
    from tagid.errors import TagidError as TagidError
    from tagid.geometry import ImageGrid as ImageGrid
    from tagid.imaging.ats.settings import AtsSettings as AtsSettings
    from tagid.imaging.operator import ForwardOperator as ForwardOperator
    from tagid.metadata import ObjectInfo as ObjectInfo
    from tagid.motion.device import Motion as Motion
    from tagid.motion.urls import open_motion as open_motion
    from tagid.operate.turn import Answer as Answer
    from tagid.operate.turn import identify as identify
    from tagid.operate.workplace import Workplace as Workplace
    from tagid.pipeline.answer import Cause as Cause
    from tagid.pipeline.answer import Identification as Identification
    from tagid.pipeline.prepared import LoadDefault as LoadDefault
    from tagid.pipeline.prepared import LoadSettings as LoadSettings
    from tagid.pipeline.prepared import PreparedCapture as PreparedCapture
    from tagid.pipeline.prepared import load_capture as load_capture
    from tagid.pipeline.prepared import prepare as prepare
    from tagid.pipeline.reconstruct import Reconstruction as Reconstruction
    from tagid.pipeline.reconstruct import reconstruct as reconstruct
    from tagid.pipeline.settings import ImagingSettings as ImagingSettings
    from tagid.pipeline.settings import TagPriors as TagPriors
    from tagid.radar.p440 import P440 as P440
    from tagid.radar.settings import RadarConfig as RadarConfig
    from tagid.recording.plan import RecordingPlan as RecordingPlan
    from tagid.recording.radars import open_radar as open_radar
    from tagid.recording.recorder import Watch as Watch
    from tagid.recording.recorder import record as record
    from tagid.recording.stream import ScanStream as ScanStream
    from tagid.report.picture import draw_image as draw_image
    from tagid.simulate.acquisition import Acquisition as Acquisition
    from tagid.simulate.capture import simulate_capture as simulate_capture
    from tagid.simulate.presets import scene_from_name as scene_from_name
    from tagid.simulate.scene import Scene as Scene
    from tagid.simulate.spec import SceneSpec as SceneSpec
    from tagid.storage.exporters import export as export
    from tagid.storage.importers import read_any as read_any
    from tagid.tags.layouts.layout import Layout as Layout
    from tagid.tags.layouts.layout import builtin_layouts as builtin_layouts


# lazy_loader.attach_stub would list each name once, but needs 8 ms instead of 2 at every start.
_HOMES = {
    "Workplace": "tagid.operate.workplace",
    "Answer": "tagid.operate.turn",
    "Config": "tagid.config",
    "TagidError": "tagid.errors",
    "Capture": "tagid.capture",
    "read_any": "tagid.storage.importers",
    "export": "tagid.storage.exporters",
    "load_capture": "tagid.pipeline.prepared",
    "LoadSettings": "tagid.pipeline.prepared",
    "LoadDefault": "tagid.pipeline.prepared",
    "prepare": "tagid.pipeline.prepared",
    "PreparedCapture": "tagid.pipeline.prepared",
    "ObjectInfo": "tagid.metadata",
    "identify": "tagid.operate.turn",
    "Identification": "tagid.pipeline.answer",
    "Cause": "tagid.pipeline.answer",
    "Layout": "tagid.tags.layouts.layout",
    "builtin_layouts": "tagid.tags.layouts.layout",
    "Registry": "tagid.enrolling.registry",
    "reconstruct": "tagid.pipeline.reconstruct",
    "Reconstruction": "tagid.pipeline.reconstruct",
    "ImagingSettings": "tagid.pipeline.settings",
    "TagPriors": "tagid.pipeline.settings",
    "AtsSettings": "tagid.imaging.ats.settings",
    "ImageGrid": "tagid.geometry",
    "ForwardOperator": "tagid.imaging.operator",
    "draw_image": "tagid.report.picture",
    "open_radar": "tagid.recording.radars",
    "P440": "tagid.radar.p440",
    "RadarConfig": "tagid.radar.settings",
    "open_motion": "tagid.motion.urls",
    "Motion": "tagid.motion.device",
    "RecordingPlan": "tagid.recording.plan",
    "record": "tagid.recording.recorder",
    "Watch": "tagid.recording.recorder",
    "ScanStream": "tagid.recording.stream",
    "SceneSpec": "tagid.simulate.spec",
    "scene_from_name": "tagid.simulate.presets",
    "Scene": "tagid.simulate.scene",
    "Acquisition": "tagid.simulate.acquisition",
    "simulate_capture": "tagid.simulate.capture",
}
"""Public name -> module that defines it."""

_MOVED = {
    "tagid.angles.views": "Angles",
    "tagid.capture": "Pulse",
    "tagid.config": "ConfigValue",
    "tagid.geometry": "Aperture",
    "tagid.imaging.ats.problem": "FieldShape",
    "tagid.imaging.autofocus": "AxisFocus",
    "tagid.imaging.preprocess": "PreprocessSettings",
    "tagid.imaging.pulsefit": "PulseEstimate",
    "tagid.imaging.rangefocus": "DelayFocus EchoPoint",
    "tagid.imaging.region": "Region",
    "tagid.imaging.types": "BasebandScans Image PointResponse",
    "tagid.metadata": "Ending MotionInfo RadarInfo RadarSettings RecordingPart ReferenceFacts ReferenceName"
    " ResolvedMotion ScanGap SimulatedTruth Standstill Track",
    "tagid.operate.turn": "ReadingSetup",
    "tagid.radar.assembler": "Scan Statistics",
    "tagid.radar.links": "Link",
    "tagid.radar.status": "RadarStatus",
    "tagid.recording.session": "Session",
    "tagid.reading.calibration": "Bound",
    "tagid.reading.reading": "Explanation Kind LayoutScore Reading Reflector",
    "tagid.reading.verdict": "Code",
    "tagid.result": "Problem",
    "tagid.simulate.acquisition": "Placement RangeWindow Recording Wobble",
    "tagid.simulate.capture": "Truth",
    "tagid.simulate.noise": "Interference NoiseShape",
    "tagid.simulate.scattering": "Body Points Returns",
    "tagid.simulate.scene": "StaticReturns Tag",
    "tagid.simulate.snr": "EchoLevels Snr",
    "tagid.tags.bodies.signature": "Signature",
    "tagid.enrolling.registry": "RegistryChange RegistryContents Restored",
}
"""Module -> its names that this version still gives here, with a warning."""

__all__ = [*_HOMES, "__version__"]


def __getattr__(name: str) -> Any:
    from importlib import import_module

    if home := _HOMES.get(name):
        value = globals()[name] = getattr(import_module(home), name)
        return value
    for module, names in _MOVED.items():
        if name in names.split():
            import warnings

            text = f"`tagid.{name}` is deprecated: use `from {module} import {name}`"
            warnings.warn(text, DeprecationWarning, stacklevel=2)
            return getattr(import_module(module), name)
    raise AttributeError(f"module 'tagid' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
