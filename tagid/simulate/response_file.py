"""The response file: one NPZ per object, described in docs/responses.md.

Input is not trusted: sizes are checked before memory is allocated, nothing is unpickled, and any invalid
content raises one error that names the file.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.constants import SPEED_OF_LIGHT
from tagid.errors import DataError, FileFormatError, UsageError
from tagid.files import read_bytes, write_bytes
from tagid.simulate.acquisition import Acquisition
from tagid.simulate.presets import room_clutter
from tagid.simulate.response import MAX_VALUES, Response, Ring
from tagid.simulate.response_scene import ResponseBody, peak_echo, response_scene
from tagid.simulate.scene import Scene, StaticReturns
from tagid.storage.assembly import decode_settings, encode_settings, text
from tagid.storage.npz import read_arrays

FORMAT = "tagid.response"
FORMAT_VERSION = 1
MAX_BYTES = 10 * MAX_VALUES

_OWN = (
    *("format", "format_version", "name", "frequency_hz", "aspect_rad", "scattering_length_m"),
    *("ring_distance_m", "ring_height_m", "ring_polarisation"),
)
_OPTIONAL = ("reflectors_m", "provenance")
_PLAIN = ("S", "freqs", "azimuth", "ring_distance", "ring_pol")
_MAX_RINGS = 64


def read_response(path: Path) -> Response:
    """Read a response file, or the plain layout with keys S, freqs, azimuth, ring_distance and ring_pol.

    Raises StorageError: the file cannot be read. FileFormatError: damaged, too large, of another format or
    version, a key is missing, of the wrong shape or dtype, or not finite.
    """
    arrays = read_arrays(path, read_bytes(path, MAX_BYTES), frozenset((*_OWN, *_OPTIONAL, *_PLAIN)))
    if "format" not in arrays and all(key in arrays for key in _PLAIN):
        return _from_plain(path, arrays)
    if "format" not in arrays:
        raise FileFormatError(
            f"{path}: is not a response file: it has neither `format` nor {', '.join(_PLAIN)}",
            "docs/responses.md describes the file.",
        )
    named = _text(path, arrays, "format")
    if named != FORMAT:
        raise FileFormatError(f"{path}: format is {named[:40]!r}, expected {FORMAT!r}")
    missing = [key for key in _OWN if key not in arrays]
    if missing:
        raise FileFormatError(
            f"{path}: the response lacks {', '.join(missing)}", "docs/responses.md lists the keys."
        )
    version = arrays["format_version"]
    if version.shape != () or version.dtype.kind not in "iu" or int(version) < 1:
        raise FileFormatError(f"{path}: format_version is not one positive whole number")
    if int(version) > FORMAT_VERSION:
        raise FileFormatError(
            f"{path}: format version {int(version)} is newer than {FORMAT_VERSION}", "Update tagid."
        )
    about: dict[str, str] = {}
    if "provenance" in arrays:
        provenance = decode_settings(_text(path, arrays, "provenance"), f"{path} (provenance)")
        about = {str(key): str(value) for key, value in provenance.items()}
    rings = _rings(path, arrays["ring_distance_m"], arrays["ring_polarisation"], arrays["ring_height_m"])
    values = _complex(path, "scattering_length_m", arrays["scattering_length_m"])
    _check_aspects(path, _real(path, "aspect_rad", arrays["aspect_rad"]), values)
    reflectors = arrays.get("reflectors_m", np.zeros((0, 2)))
    return _build(
        path,
        name=_text(path, arrays, "name")[:200],
        frequency_hz=_real(path, "frequency_hz", arrays["frequency_hz"]),
        rings=rings,
        scattering_length_m=values.astype(np.complex64),
        reflectors_m=_real(path, "reflectors_m", reflectors),
        provenance=about,
    )


def write_response(path: Path, response: Response) -> None:
    """Write a response file atomically; `read_response` restores it without loss.

    Raises StorageError, DiskFullError.
    """
    aspects = response.aspects
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        format=np.array(FORMAT),
        format_version=np.int64(FORMAT_VERSION),
        name=np.array(response.name),
        frequency_hz=response.frequency_hz,
        aspect_rad=2 * np.pi * np.arange(aspects) / aspects,
        ring_distance_m=np.array([ring.distance_m for ring in response.rings]),
        ring_height_m=np.array([ring.height_m for ring in response.rings]),
        ring_polarisation=np.array([ring.polarisation for ring in response.rings]),
        scattering_length_m=response.scattering_length_m.astype(np.complex64),
        reflectors_m=response.reflectors_m,
        provenance=np.array(encode_settings(dict(response.provenance))),
    )
    write_bytes(path, buffer.getvalue())


def _from_plain(path: Path, arrays: dict[str, NDArray[Any]]) -> Response:
    """The plain layout: S (f, rings, aspects) = b exp(-2jkR) / R^2, rings at the height of the plane."""
    values, frequency = _complex(path, "S", arrays["S"]), _real(path, "freqs", arrays["freqs"])
    distance = _real(path, "ring_distance", arrays["ring_distance"])
    rings = _rings(path, distance, arrays["ring_pol"], np.zeros(distance.shape))
    _check_aspects(path, _real(path, "azimuth", arrays["azimuth"]), values)
    if values.shape[:2] != (*frequency.shape, len(rings)):
        raise FileFormatError(f"{path}: S has shape {values.shape}, expected (freqs, rings, azimuth)")
    k = 2 * np.pi * frequency / SPEED_OF_LIGHT
    b = values * (distance**2 * np.exp(2j * np.outer(k, distance)))[..., None]
    about = {"source": "plain layout (S, freqs, azimuth, ring_distance, ring_pol)"}
    return _build(
        path,
        name=path.stem[:200],
        frequency_hz=frequency,
        rings=rings,
        scattering_length_m=b.astype(np.complex64),
        provenance=about,
    )


def _build(path: Path, **fields: Any) -> Response:
    try:
        return Response(**fields)
    except DataError as error:
        raise FileFormatError(f"{path}: {error.message}", error.remedy) from error


def _rings(
    path: Path, distance: NDArray[Any], polarisation: NDArray[Any], height: NDArray[Any]
) -> tuple[Ring, ...]:
    distance, height = _real(path, "ring distance", distance), _real(path, "ring height", height)
    same = distance.ndim == 1 and distance.shape == polarisation.shape == height.shape
    if not same or not 1 <= len(distance) <= _MAX_RINGS:
        raise FileFormatError(
            f"{path}: ring distances, polarisations and heights have shapes {distance.shape}, "
            f"{polarisation.shape} and {height.shape}, expected the same (1 to {_MAX_RINGS},)"
        )
    if polarisation.dtype.kind not in "US":
        raise FileFormatError(f"{path}: ring polarisations have dtype {polarisation.dtype}, expected text")
    letters = [
        p.decode("utf-8", "replace") if isinstance(p, bytes) else str(p) for p in polarisation.tolist()
    ]
    try:
        return tuple(Ring(float(d), p, float(h)) for d, p, h in zip(distance, letters, height, strict=True))
    except DataError as error:
        raise FileFormatError(f"{path}: {error.message}", error.remedy) from error


def _check_aspects(path: Path, aspect: NDArray[np.float64], values: NDArray[Any]) -> None:
    count = len(aspect) if aspect.ndim == 1 else 0
    if values.ndim != 3 or values.shape[2] != count:
        raise FileFormatError(
            f"{path}: the response has shape {values.shape} and {aspect.shape} aspects, "
            "expected (frequencies, rings, aspects)"
        )
    even = 2 * np.pi * np.arange(count) / max(count, 1)
    if count < 4 or np.abs(aspect - even).max() > 1e-3:
        raise FileFormatError(
            f"{path}: the aspects are not 2 pi i / {count}",
            "Resample them evenly from 0 over the whole circle, without 2 pi itself.",
        )


def _text(path: Path, arrays: dict[str, NDArray[Any]], key: str) -> str:
    values = arrays[key]
    if values.shape != () or values.dtype.kind not in "US":
        raise FileFormatError(f"{path}: {key} has shape {values.shape}, expected one text")
    return text(values.item(), f"{path} ({key})")


def _real(path: Path, key: str, values: NDArray[Any]) -> NDArray[np.float64]:
    if values.dtype.kind not in "iuf" or values.size > MAX_VALUES:
        raise FileFormatError(f"{path}: {key} has dtype {values.dtype}, expected real numbers")
    return values.astype(np.float64)


def _complex(path: Path, key: str, values: NDArray[Any]) -> NDArray[np.complex128]:
    if values.dtype.kind not in "iufc":
        raise FileFormatError(f"{path}: {key} has dtype {values.dtype}, expected numbers")
    if values.size > MAX_VALUES:
        raise FileFormatError(f"{path}: {key} holds {values.size} values, more than {MAX_VALUES}")
    # Values too large for single precision become infinite and are rejected by the response.
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(np.complex64).astype(np.complex128)


@dataclass(frozen=True)
class ResponseFiles:
    """An object given by its response file, with the reference for the SNR of its recordings.

    Attributes:
        polarisation: "V" or "H".
        reference: response whose strongest echo is the SNR's signal; None means the object's own.
        reference_body: response that is subtracted from the reference: tagged object minus its body.
    """

    response: Path
    polarisation: str = "V"
    reference: Path | None = None
    reference_body: Path | None = None

    def __post_init__(self) -> None:
        if self.reference_body is not None and self.reference is None:
            raise UsageError("a reference body is given without a reference", "Add `snr_reference=FILE`.")

    def scene(self, acquisition: Acquisition, seed: int = 0) -> Scene:
        """The object in a room drawn from the seed, scaled by the object if that exceeds its reference.

        Raises the reader's errors, and UsageError if the response does not cover the acquisition.
        """
        response = read_response(self.response)
        reference = None if self.reference is None else read_response(self.reference)
        if reference is not None and self.reference_body is not None:
            reference = reference.without(read_response(self.reference_body))
        alone = response_scene(response, acquisition, self.polarisation, reference)
        bodies = [body for body in alone.object if isinstance(body, ResponseBody)]
        for body in bodies:
            # An emulator says before its first scan that the response does not cover where the object stands.
            peak_echo(body, acquisition, acquisition.placement)
        strengths = [peak_echo(body, acquisition) for body in bodies]
        room = room_clutter(np.random.default_rng(seed))
        room = StaticReturns(room.ranges_m, room.amplitudes * max(1.0, *strengths))
        return response_scene(response, acquisition, self.polarisation, reference, room)
