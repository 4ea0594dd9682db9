"""The response of an object to the radar over frequency, aspect, polarisation and distance.

One type holds solver results and anechoic chamber measurements alike, so that scenes, emulator and benchmarks
need not distinguish them. docs/responses.md describes the file format.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tagid.constants import SPEED_OF_LIGHT
from tagid.errors import DataError, UsageError
from tagid.types import Floats

MAX_VALUES = 16_000_000
"""Maximum number of complex values of one response: 128 MB."""

MAX_FREQUENCY_HZ = 1e12
DEPTHS_M = (0.01, 20.0)
"""Depths of objects whose responses are read: c / 2 over the step between two frequencies."""

POLARISATIONS = ("V", "H")
"""Co-polar: both antennas upright, or both horizontal across the line of sight."""

_MOST_NODES = 5
_NEAREST = 0.6


@dataclass(frozen=True)
class Ring:
    """A circle of antenna positions around the object's origin.

    Attributes:
        distance_m: horizontal distance from the object's vertical axis to the antenna, m.
        polarisation: "V" or "H".
        height_m: height of the antenna above the object's plane z = 0, m.
    """

    distance_m: float
    polarisation: str
    height_m: float = 0.0

    def __post_init__(self) -> None:
        if self.polarisation not in POLARISATIONS:
            raise DataError(f"ring polarisation is {self.polarisation[:20]!r}, expected V or H")
        if not (np.isfinite(self.distance_m) and 0.01 <= self.distance_m <= 1e4):
            raise DataError(f"ring distance is {self.distance_m} m, expected 0.01 to 10000 m")
        if not (np.isfinite(self.height_m) and abs(self.height_m) <= self.distance_m):
            raise DataError(
                f"ring height is {self.height_m} m at a distance of {self.distance_m} m",
                "Heights up to the distance are supported.",
            )

    @property
    def range_m(self) -> float:
        """Distance from the object's origin to the antenna, m."""
        return float(np.hypot(self.distance_m, self.height_m))


@dataclass(frozen=True, eq=False)
class Response:
    """The monostatic response of one object.

    The scattered field at the antenna, along the polarisation of the incident field, is
    E_s / E_0 = b exp(-2jkR) / R^2 with R from the object's origin to the antenna, for an antenna whose
    field at distance R in free space is exp(-jkR) / R; time convention exp(+j omega t). The scattering
    length b (m) is stored. It is smooth in frequency and distance; the radar cross-section is 4 pi
    |b|^2, and far away b does not depend on the distance. A conducting sphere has b near -radius / 2 *
    exp(2jk radius).

    Attributes:
        frequency_hz: (f,) evenly spaced, ascending, Hz.
        rings: antenna positions of the samples. For each polarisation the rings are all combinations of some
            distances and some heights, at most 5 of each.
        scattering_length_m: (f, rings, aspects) complex64, m. Aspect i is an antenna in the direction
            2 pi i / aspects in the object's frame, counter-clockwise from above.
        reflectors_m: (n, 2) true positions of its reflectors in the object's frame, m, if known.
        provenance: texts: method, tool and error.

    Raises DataError if the parts do not fit or are not finite.
    """

    name: str
    frequency_hz: Floats
    rings: tuple[Ring, ...]
    scattering_length_m: NDArray[np.complex64]
    reflectors_m: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    provenance: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        f, b = self.frequency_hz, self.scattering_length_m
        if f.ndim != 1 or len(f) < 2 or not np.isfinite(f).all() or f[0] <= 0:
            raise DataError(f"frequencies have shape {f.shape}, expected (f,) with f > 1, positive, finite")
        step = np.diff(f)
        if not (step > 0).all() or np.ptp(step) > 1e-3 * step.mean():
            raise DataError(
                "frequencies are not evenly spaced and ascending", "Resample the response to an even spacing."
            )
        if f.max() > MAX_FREQUENCY_HZ:
            raise DataError(f"frequencies reach {f.max():g} Hz", "Give hertz.")
        shallow, deep = DEPTHS_M
        if not shallow <= self.unambiguous_m <= deep:
            raise DataError(
                f"frequencies {step.mean():g} Hz apart describe an object of {self.unambiguous_m:g} m depth, "
                f"expected {shallow:g} to {deep:g} m",
                "Sample the response of an object of 1 m every 120 MHz, in hertz.",
            )
        if b.ndim != 3 or b.shape[:2] != (len(f), len(self.rings)) or b.shape[2] < 4:
            raise DataError(
                f"scattering lengths have shape {b.shape}, expected ({len(f)}, {len(self.rings)}, aspects)"
            )
        if b.size > MAX_VALUES:
            raise DataError(f"the response holds {b.size} values, more than {MAX_VALUES}")
        if not np.isfinite(b).all():
            raise DataError("scattering lengths are not finite")
        if self.reflectors_m.ndim != 2 or self.reflectors_m.shape[1] != 2:
            raise DataError(f"reflectors have shape {self.reflectors_m.shape}, expected (n, 2)")
        if not np.isfinite(self.reflectors_m).all():
            raise DataError("reflectors are not finite")
        for polarisation in self.polarisations:
            self._nodes(polarisation)

    @property
    def polarisations(self) -> tuple[str, ...]:
        """The polarisations of the rings, V before H."""
        return tuple(p for p in POLARISATIONS if any(ring.polarisation == p for ring in self.rings))

    @property
    def aspects(self) -> int:
        """Number of aspects, evenly spaced over the full circle."""
        return int(self.scattering_length_m.shape[2])

    @property
    def wavenumber(self) -> Floats:
        """(f,) k, 1/m."""
        return 2 * np.pi * self.frequency_hz / SPEED_OF_LIGHT

    @property
    def unambiguous_m(self) -> float:
        """Depth in range after which the response repeats, because its frequencies are discrete, m."""
        return float(SPEED_OF_LIGHT / 2 / (self.frequency_hz[1] - self.frequency_hz[0]))

    def _nodes(self, polarisation: str) -> tuple[Floats, Floats, NDArray[np.int64]]:
        """Distances (d,), heights (h,), and the ring (h, d) of every combination."""
        ring_of = {
            (r.height_m, r.distance_m): i for i, r in enumerate(self.rings) if r.polarisation == polarisation
        }
        count = sum(ring.polarisation == polarisation for ring in self.rings)
        heights, distances = (sorted({key[axis] for key in ring_of}) for axis in (0, 1))
        if len(ring_of) != count or len(ring_of) != len(heights) * len(distances):
            raise DataError(
                f"the {polarisation} rings are not every combination of {len(distances)} distances and "
                f"{len(heights)} heights once",
                "Omit the rings that have no counterpart.",
            )
        if max(len(heights), len(distances)) > _MOST_NODES:
            raise DataError(f"more than {_MOST_NODES} distances or heights of polarisation {polarisation}")
        table = np.array([[ring_of[h, d] for d in distances] for h in heights], dtype=np.int64)
        return np.array(distances), np.array(heights), table

    @cached_property
    def _harmonics(self) -> NDArray[np.complex128]:
        """(f, rings, aspects) coefficients of exp(j m aspect), m as in `numpy.fft.fftfreq`."""
        return np.asarray(np.fft.fft(self.scattering_length_m.astype(np.complex128), axis=2) / self.aspects)

    def seen_from(self, antennas: Floats, polarisation: str = "V") -> NDArray[np.complex128]:
        """Scattering length b (views, f), m, towards antennas (views, 3) in the object's frame, m, at "V" or
        "H".

        Over the aspect the samples are interpolated by their Fourier series. Between and beyond rings b is a
        polynomial in 1 / distance (the near field is an expansion in it) and in the antenna's height, through
        all rings of the polarisation; with one distance the near field of that distance is used.

        Raises UsageError: the response lacks the polarisation, an antenna is much closer than the nearest
        ring, or its height is outside the heights of the rings.
        """
        if polarisation not in self.polarisations:
            raise UsageError(
                f"response {self.name} holds no polarisation {polarisation!r}",
                f"Use {' or '.join(self.polarisations)}.",
            )
        distances, heights, table = self._nodes(polarisation)
        distance = np.hypot(antennas[:, 0], antennas[:, 1])
        if (near := float(distance.min())) < _NEAREST * distances[0]:
            raise UsageError(
                f"an antenna {near:.3f} m from {self.name} is nearer than the response allows",
                f"Stay at least {_NEAREST * distances[0]:.2f} m away, or solve a nearer ring.",
            )
        z = antennas[:, 2]
        if z.min() < heights[0] - 5e-3 or z.max() > heights[-1] + 5e-3:
            height = float(z[np.abs(z).argmax()])
            side = "above" if height > 0 else "below"
            many = f"heights of {heights[0]:g} to {heights[-1]:g} m"
            held = many if len(heights) > 1 else f"the height {heights[0]:g} m"
            raise UsageError(
                f"the antenna is {abs(height):.3f} m {side} the plane of {self.name}",
                f"Its response holds {held} only: `motion.antenna_height_m` less `elevation` must be that.",
            )
        by_distance = _lagrange(1 / distances, 1 / distance)
        by_height = _lagrange(heights, np.clip(z, heights[0], heights[-1]))
        turn = _fourier(self.aspects, np.arctan2(antennas[:, 1], antennas[:, 0]))
        total = np.zeros((len(antennas), len(self.frequency_hz)), dtype=np.complex128)
        for h in range(len(heights)):
            for d in range(len(distances)):
                weight = by_height[:, h] * by_distance[:, d]
                total += weight[:, None] * (turn @ self._harmonics[:, table[h, d]].T)
        return total

    @property
    def difference(self) -> bool:
        """Whether another response was subtracted, as by `without`."""
        return "difference" in self.provenance

    def without(self, other: Response) -> Response:
        """Difference to the response `other`, for example a tagged can without the can.

        Raises UsageError if frequencies, rings or aspects differ.
        """
        alike = (
            self.rings == other.rings
            and self.scattering_length_m.shape == other.scattering_length_m.shape
            and np.allclose(self.frequency_hz, other.frequency_hz, rtol=1e-6, atol=0)
        )
        if not alike:
            raise UsageError(
                f"responses {self.name} and {other.name} differ in frequencies, rings or aspects",
                "Subtract a response that was sampled in the same way.",
            )
        difference = self.scattering_length_m - other.scattering_length_m
        about = {"difference": f"{self.name} without {other.name}"}
        name = f"{self.name} without {other.name}"
        return Response(name, self.frequency_hz, self.rings, difference, self.reflectors_m, about)


def _lagrange(nodes: Floats, at: Floats) -> Floats:
    """(points, nodes) weights of the polynomial through the nodes."""
    weights = np.ones((len(at), len(nodes)))
    for i, node in enumerate(nodes):
        for j, other in enumerate(nodes):
            if i != j:
                weights[:, i] *= (at - other) / (node - other)
    return weights


def _fourier(count: int, angle: Floats) -> NDArray[np.complex128]:
    """(angles, count) exp(j m angle) in the order of `numpy.fft.fftfreq`.

    The highest harmonic of an even count represents +m and -m, so it is a cosine.
    """
    order = np.fft.fftfreq(count, 1 / count)
    basis = np.exp(1j * np.outer(angle, order))
    if count % 2 == 0:
        basis[:, count // 2] = np.cos(angle * count / 2)
    return np.asarray(basis)
