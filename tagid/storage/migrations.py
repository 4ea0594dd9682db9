"""Small pure functions that migrate older capture files to the current layout.

Each depends only on two consecutive versions, so old files stay readable and the reader supports only
one layout.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from tagid.errors import FileFormatError
from tagid.storage.assembly import decode_settings, encode_settings
from tagid.storage.metadata import PARTS, migrate_metadata

FORMAT_VERSION = 3
"""Version of the capture file that this tagid writes. 2: typed metadata (`tagid.storage.metadata`). 3: the
angles are called `angles_rad`, as in NPZ and MATLAB files; a second antenna (antenna_separation_m,
/scans/receive_positions_m), which version 2 would ignore."""
OLD_ANGLES = "scans/angle_rad"
ANGLES = "scans/angles_rad"


@dataclass(frozen=True)
class RawCapture:
    """Content of a capture file before it is interpreted.

    Attributes:
        attributes: root attributes by name, as plain values.
        arrays: datasets by path, e.g. `scans/samples`, as numpy arrays.
    """

    attributes: Mapping[str, Any]
    arrays: Mapping[str, Any]


Step = Callable[[RawCapture], RawCapture]


def _typed_metadata(raw: RawCapture) -> RawCapture:
    """Version 1 to 2: typed metadata. Invalid values are left for the reader to reject."""
    parts: dict[str, Mapping[str, Any]] = {}
    for name in PARTS:
        try:
            parts[name] = decode_settings(raw.attributes[name], name)
        except (KeyError, TypeError, FileFormatError):
            return raw
    texts = {name: encode_settings(dict(part)) for name, part in migrate_metadata(parts, 1, "").items()}
    return RawCapture({**raw.attributes, **texts}, raw.arrays)


def named_angles(raw: RawCapture) -> RawCapture:
    """Version 2 to 3: angles under the name used by all formats; no second antenna means one antenna."""
    if OLD_ANGLES not in raw.arrays or ANGLES in raw.arrays:
        return raw
    return RawCapture(
        raw.attributes,
        {ANGLES if name == OLD_ANGLES else name: values for name, values in raw.arrays.items()},
    )


STEPS: Mapping[int, Step] = MappingProxyType({1: _typed_metadata, 2: named_angles})
"""The migration from version n to n + 1, by n."""


def migrate(
    raw: RawCapture,
    version: int,
    path: Path,
    steps: Mapping[int, Step] = STEPS,
    current: int = FORMAT_VERSION,
) -> RawCapture:
    """The content at version `current`.

    Raises:
        FileFormatError: the version is newer than `current`, below 1, or a step is missing.
    """
    check_version(version, path, current)
    for number in range(version, current):
        if number not in steps:
            raise FileFormatError(f"{path}: format version {number} is not supported", "Use an older tagid.")
        raw = steps[number](raw)
    return raw


def check_version(version: int, path: Path, current: int = FORMAT_VERSION) -> None:
    """Raise FileFormatError if a file of this version cannot be read."""
    if version > current:
        raise FileFormatError(
            f"{path}: format version {version}, this tagid reads up to version {current}",
            "It was made by a newer tagid; upgrade.",
        )
    if version < 1:
        raise FileFormatError(f"{path}: format version {version} does not exist", "The file is damaged.")
