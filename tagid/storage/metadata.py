"""Metadata of a capture in files: three JSON objects with a version, and the migration between versions.

Every format (HDF5, journal, NPZ, MATLAB) reads and writes them here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tagid.capture import Capture
from tagid.errors import DataError, FileFormatError
from tagid.metadata import METADATA_VERSION, MotionInfo, ObjectInfo, RadarInfo, RadarSettings, ResolvedMotion

PARTS = ("radar", "motion", "object")
VERSION_KEY = "metadata_version"
"""If a format has no version of its own, this key is stored next to the parts; absent means 1."""


def metadata_of(capture: Capture) -> dict[str, dict[str, Any]]:
    """The JSON objects of a capture, at the current version."""
    return {name: getattr(capture, name).to_json() for name in PARTS}


def read_metadata(objects: Mapping[str, Any], where: str, version: int = METADATA_VERSION) -> dict[str, Any]:
    """The fields `radar`, `motion` and `object` of a Capture from JSON objects; a missing one is empty.

    Raises FileFormatError, naming `where`: a part is not an object, a known key has a value of the wrong
    type, or the version is newer than this tagid supports.
    """
    parts: dict[str, Mapping[str, Any]] = {}
    for name in PARTS:
        value = objects.get(name) or {}
        if not isinstance(value, Mapping):
            raise FileFormatError(f"{where}: {name} is not a JSON object")
        parts[name] = value
    if not 1 <= version <= METADATA_VERSION:
        raise FileFormatError(
            f"{where}: metadata of version {version}, this tagid reads up to version {METADATA_VERSION}",
            "It was made by a newer tagid; upgrade.",
        )
    if version == 1:
        parts = _typed(parts)
    try:
        return {
            "radar": RadarInfo.from_json(parts["radar"]),
            "motion": MotionInfo.from_json(parts["motion"]),
            "object": ObjectInfo.from_json(parts["object"]),
        }
    except DataError as error:
        raise FileFormatError(f"{where}: {error.message}", error.remedy) from error


def stored_version(values: Mapping[str, Any], where: str) -> int:
    """The version stored next to the parts; 1 if absent. Raises FileFormatError."""
    version = values.get(VERSION_KEY, 1)
    if not isinstance(version, int) or isinstance(version, bool):
        raise FileFormatError(f"{where}: {VERSION_KEY} is {str(version)[:60]}, expected a whole number")
    return version


def _typed(parts: Mapping[str, Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    """Version 1 to 2: move settings next to `config` and facts next to `resolved` to their own keys.

    Version 1 had no types. Values that do not fit a field of version 2 are dropped, not rejected, because no
    version of tagid has used them.
    """
    radar, motion = dict(parts["radar"]), dict(parts["motion"])
    loose = {name: radar.pop(name) for name in _SETTINGS & set(radar)}
    config = radar.get("config")
    if loose and not isinstance(config, Mapping):
        radar["config"] = loose
    facts = {name: motion.pop(name) for name in _FACTS & set(motion)}
    resolved = motion.get("resolved")
    if facts and not isinstance(resolved, Mapping):
        motion["resolved"] = facts
    if "rpm" in motion:
        motion.setdefault("nominal_rpm", motion.pop("rpm"))
    return {
        "radar": _fitting(RadarInfo, radar),
        "motion": _fitting(MotionInfo, motion),
        "object": _fitting(ObjectInfo, parts["object"]),
    }


_SETTINGS = set(RadarSettings.__dataclass_fields__) - {"extra", "node_id"}
_FACTS = {"period_s", "period_sigma_s", "source", "quality", "direction", "turns"}

Part = type[RadarInfo] | type[MotionInfo] | type[ObjectInfo] | type[RadarSettings] | type[ResolvedMotion]


def _fitting(kind: Part, values: Mapping[str, Any]) -> dict[str, Any]:
    """The entries of an object that the typed value accepts, key by key."""
    nested: Mapping[str, Part] = {
        "config": RadarSettings, "config_asked": RadarSettings, "resolved": ResolvedMotion
    }  # fmt: skip
    taken: dict[str, Any] = {}
    for key, value in values.items():
        inner = nested.get(key)
        entry = _fitting(inner, value) if inner and isinstance(value, Mapping) else value
        try:
            kind.from_json({key: entry})
        except DataError:
            continue
        taken[key] = entry
    return taken
