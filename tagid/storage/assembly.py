"""From the values in a file to a Capture: the checks shared by all formats.

Files are not trusted: every invalid value raises an error that names the file and the field.
"""

from __future__ import annotations

import hashlib
import json
import math
import uuid
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture, Pulse
from tagid.errors import DataError, FileFormatError, displayable

AS_NPZ = (
    "numpy.savez('scans.npz', samples=SCANS, range_start_m=METRES, range_step_m=METRES, angles_rad=ANGLES, "
    "axis_distance_m=METRES), where SCANS is (views, bins), one scan a row (docs/formats.md)"
)
"""The way on for scans in a file that is not read."""
MAX_JSON_BYTES = 64 << 20
"""Longest settings text accepted, characters."""


def encode_settings(settings: dict[str, Any]) -> str:
    """JSON text of a settings dict; numpy values become plain ones, non-finite ones become null.

    Bytes of a text that are not UTF-8 (a note or a device name typed on a Latin-1 terminal) become \\xNN: as
    halves of surrogate pairs they would make the whole file unreadable.
    """
    return json.dumps(_plain(settings), allow_nan=False, sort_keys=True)


def decode_settings(text: str | bytes, where: str, repair: bool = False) -> dict[str, Any]:
    """A dict from JSON text in a file, with halves of surrogate pairs as \\uNNNN if `repair`.

    Raises FileFormatError, naming `where`: too long, not JSON, not an object, or such a half.
    """
    if len(text) > MAX_JSON_BYTES:
        raise FileFormatError(
            f"{where}: the settings have {len(text)} characters, more than {MAX_JSON_BYTES}"
        )
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{where}: the settings are not JSON") from error
    half = "\\ud" if isinstance(text, str) else b"\\ud"
    if repair:
        value = _plain(value)
    elif half in text.lower():  # type: ignore[operator]
        _check_unicode(json.dumps(value, ensure_ascii=False), where)
    if not isinstance(value, dict):
        raise FileFormatError(f"{where}: the settings are a JSON {type(value).__name__}, expected an object")
    return value


def number(value: Any, where: str) -> float:
    """A finite real number from a file. Raises FileFormatError."""
    array = np.asarray(value)
    if array.shape != () or array.dtype.kind not in "iuf" or not math.isfinite(float(array)):
        raise FileFormatError(f"{where}: expected one finite number, found {_short(value)}")
    return float(array)


def text(value: Any, where: str) -> str:
    """A short text from a file. Raises FileFormatError."""
    if isinstance(value, bytes):
        value = value.decode("utf-8", errors="replace")
    if not isinstance(value, str) or len(value) > 4096:
        raise FileFormatError(f"{where}: expected a short text, found {_short(value)}")
    _check_unicode(value, where)
    return str(value)


def _check_unicode(content: str, where: str) -> None:
    """Raises FileFormatError for a text that cannot be written: half of a surrogate pair, from JSON."""
    try:
        content.encode("utf-8")
    except UnicodeEncodeError as error:
        raise FileFormatError(f"{where}: holds half of a surrogate pair, which is no character") from error


def build_pulse(samples: NDArray[Any], step: float, path: Path) -> Pulse:
    """The pulse (n,) of a file, with its step, s. Raises FileFormatError."""
    if samples.dtype.kind not in "iuf":
        raise FileFormatError(f"{path}: pulse has dtype {samples.dtype}, expected real numbers")
    try:
        return Pulse(samples.astype(np.float64), step)
    except DataError as error:
        raise FileFormatError(f"{path}: {error.message}") from error


def unwrap(counter: NDArray[Any], modulus: int) -> NDArray[np.int64]:
    """A counter that wraps at `modulus`, continued: every step is the smallest one in either direction.

    >>> unwrap(np.array([65534, 65535, 1]), 65536).tolist()
    [65534, 65535, 65537]
    """
    values = np.asarray(counter, dtype=np.int64)
    steps = (np.diff(values) + modulus // 2) % modulus - modulus // 2
    unwrapped: NDArray[np.int64] = values[0] + np.concatenate([np.zeros(1, np.int64), np.cumsum(steps)])
    return unwrapped


SMALL_BYTES = 16 << 20
MAX_EXPANSION = 20
"""Scans contain noise and compress 2:1 to 5:1; a much higher ratio in a large file indicates an attack."""

TEXTS = ("uuid", "created_utc", "tool_version")
"""Texts of a capture beside its metadata."""
OPTIONAL_NUMBERS = (
    "axis_distance_m",
    "antenna_height_m",
    "antenna_separation_m",
    "center_frequency_hz",
    "bandwidth_hz",
    "wave_speed_m_s",
)
"""Numbers of a capture that a file may omit."""
VIEW_ARRAYS = {
    "host_time_ns": "int64",
    "radar_time_ms": "float64",
    "angles_rad": "float64",
    "angle_sigma_rad": "float64",
    "scan_id": "int64",
    "flags": "uint8",
    "antenna_positions_m": "float64",
    "receive_positions_m": "float64",
}
"""Arrays with one row per view besides the samples, and their dtypes."""
OLD_ANGLES = "angle_rad"
"""Name of the angles in HDF5 and MATLAB files of tagid 0.1 and 0.2, and in NPZ files made of those."""
_LIMITS = {
    "range_start_m": (-1e7, 1e7),
    "range_step_m": (1e-6, 1e4),
    "axis_distance_m": (1e-6, 1e7),
    "antenna_height_m": (-1e7, 1e7),
    "antenna_separation_m": (0.0, 1e4),
    "center_frequency_hz": (1.0, 1e13),
    "bandwidth_hz": (1.0, 1e13),
}
"""Limits for plausible values, (least, most): far beyond any known radar."""
_LONGEST_MS = 1e15


def _check_plausible(path: Path, fields: dict[str, Any]) -> None:
    """Raises FileFormatError for implausible numbers, which would overflow in later calculations."""
    for name, (least, most) in _LIMITS.items():
        value = fields.get(name)
        if value is not None and not least <= value <= most:
            raise FileFormatError(
                f"{path}: {name} is {value:g}, which is not plausible",
                f"Expected {least:g} to {most:g} (SI units): check the file's units.",
            )
    arrays = {"antenna_positions_m": 1e7, "receive_positions_m": 1e7}
    arrays |= {"angles_rad": 1e9, "radar_time_ms": _LONGEST_MS}
    for name, most in arrays.items():
        values = fields.get(name)
        if values is not None and len(values) and not float(np.abs(values).max()) <= most:
            raise FileFormatError(
                f"{path}: {name} reaches {np.abs(values).max():g}, which is not plausible",
                f"Expected up to {most:g}: check the file's units.",
            )
    pulse = fields.get("pulse")
    if pulse is not None and not 1e-15 <= pulse.step <= 1.0:
        raise FileFormatError(f"{path}: pulse_step_s is {pulse.step:g}, which is not plausible")


def build_capture(path: Path, **fields: Any) -> Capture:
    """A validated Capture from the fields of a file. Raises FileFormatError naming the file.

    A file without a UUID gets one derived from its scans (RFC 9562, version 5), so that reading it again,
    also on another computer, gives the same capture.
    """
    _check_plausible(path, fields)
    try:
        capture = Capture(**fields)
    except DataError as error:
        raise FileFormatError(f"{path}: {error.message}", error.remedy) from error
    if "uuid" in fields:
        return capture
    return replace(capture, uuid=str(uuid.uuid5(_SCANS, _digest(capture))))


_SCANS = uuid.UUID("0a4f3a9b-6f0e-5d0c-9f43-5c0b7a1d2e68")


def _digest(capture: Capture) -> str:
    digest = hashlib.sha256(np.ascontiguousarray(capture.samples).data)
    for values in (
        capture.angles_rad,
        capture.antenna_positions_m,
        capture.receive_positions_m,
        capture.host_time_ns,
    ):
        if values is not None:
            digest.update(np.ascontiguousarray(values).data)
    digest.update(repr((capture.samples.shape, capture.range_start_m, capture.range_step_m)).encode())
    return digest.hexdigest()


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {displayable(str(key)): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int):
        return value
    return displayable(str(value))


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape} and dtype {value.dtype}"
    return repr(value)[:60]
