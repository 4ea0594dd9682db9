"""Reads the identity of a tagged object from ultra-wideband radar scans of it turning.

The names listed here are the public interface (`docs/api.md`). They are loaded when first used, so
`import tagid` costs nothing. Everything else may change between versions.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tagid.capture import Capture as Capture
    from tagid.geometry import ImageGrid as ImageGrid
    from tagid.imaging.operator import ForwardOperator as ForwardOperator
    from tagid.pipeline.answer import Identification as Identification
    from tagid.pipeline.identify import identify as identify
    from tagid.pipeline.load import load_capture as load_capture
    from tagid.pipeline.prepared import PreparedCapture as PreparedCapture
    from tagid.pipeline.prepared import prepare as prepare
    from tagid.pipeline.reconstruct import Reconstruction as Reconstruction
    from tagid.pipeline.reconstruct import reconstruct as reconstruct
    from tagid.pipeline.settings import ImagingSettings as ImagingSettings
    from tagid.recording.plan import RecordingPlan as RecordingPlan
    from tagid.recording.radars import open_radar as open_radar
    from tagid.recording.recorder import record as record
    from tagid.simulate.acquisition import Acquisition as Acquisition
    from tagid.simulate.capture import simulate_capture as simulate_capture
    from tagid.simulate.presets import scene_from_name as scene_from_name
    from tagid.storage.exporters import export as export
    from tagid.storage.importers import read_any as read_any
    from tagid.tags.enrolling.registry import Registry as Registry
    from tagid.tags.layouts.layout import Layout as Layout
    from tagid.tags.layouts.layout import builtin_layouts as builtin_layouts

__version__ = "0.2.0"

_HOMES = {
    "Capture": "tagid.capture",
    "ImageGrid": "tagid.geometry",
    "ForwardOperator": "tagid.imaging.operator",
    "Identification": "tagid.pipeline.answer",
    "identify": "tagid.pipeline.identify",
    "load_capture": "tagid.pipeline.load",
    "PreparedCapture": "tagid.pipeline.prepared",
    "prepare": "tagid.pipeline.prepared",
    "Reconstruction": "tagid.pipeline.reconstruct",
    "reconstruct": "tagid.pipeline.reconstruct",
    "ImagingSettings": "tagid.pipeline.settings",
    "RecordingPlan": "tagid.recording.plan",
    "open_radar": "tagid.recording.radars",
    "record": "tagid.recording.recorder",
    "Acquisition": "tagid.simulate.acquisition",
    "simulate_capture": "tagid.simulate.capture",
    "scene_from_name": "tagid.simulate.presets",
    "export": "tagid.storage.exporters",
    "read_any": "tagid.storage.importers",
    "Layout": "tagid.tags.layouts.layout",
    "builtin_layouts": "tagid.tags.layouts.layout",
    "Registry": "tagid.tags.enrolling.registry",
}
"""Public name -> module that defines it."""

__all__ = [*_HOMES, "__version__"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'tagid' has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
