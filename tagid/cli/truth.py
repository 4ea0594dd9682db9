"""The truth of an emulated scene, for its capture: from the emulator's file or its URL."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from tagid.errors import DataError, FileFormatError, StorageError

if TYPE_CHECKING:
    from tagid.metadata import ObjectInfo

_MAX_BYTES = 64 * 1024


def read_truth(path: Path) -> ObjectInfo:
    """The object in a file of `tagid emulate p440 --truth FILE`. Raises StorageError, FileFormatError."""
    from tagid.files import read_bytes
    from tagid.metadata import ObjectInfo

    try:
        values = json.loads(read_bytes(path, _MAX_BYTES))
        if not isinstance(values, dict):
            raise ValueError("not an object")
        return ObjectInfo.from_json(values)
    except (ValueError, RecursionError, DataError) as error:
        raise FileFormatError(
            f"{path}: is not a truth file ({str(error)[:120]})",
            "Give a file written by `tagid emulate p440 --truth FILE`.",
        ) from None


def is_truth(path: Path) -> bool:
    """Whether a file is one that `tagid emulate p440 --truth FILE` wrote."""
    try:
        return read_truth(path).truth is not None
    except (FileFormatError, StorageError):
        return False


def truth_of(url: str, file: Path | None) -> ObjectInfo | None:
    """The object of an emulated radar, from its file or its emulator:// URL; None for a real radar."""
    from tagid.recording.radars import emulated_object

    if file is not None:
        return read_truth(file)
    return emulated_object(url) if url else None


def with_truth(about: ObjectInfo, truth: ObjectInfo | None) -> ObjectInfo:
    """The operator's remarks, and the truth of the emulated object."""
    if truth is None:
        return about
    stated = {field.name: getattr(about, field.name) for field in fields(about) if field.name != "extra"}
    return replace(truth, **{name: value for name, value in stated.items() if value not in (None, ())})
