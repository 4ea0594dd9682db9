"""Objects without an enrolled tag, for calibrating the reader and for measuring it.

The scenes are not drawn from the reader's model: walls are rough and oval, creeping waves, handles, rims and
contents move with the body, reflectors bounce at the wall, and differ from one another.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture
from tagid.constants import SPEED_OF_LIGHT
from tagid.reading.arrangement import gaps_deg
from tagid.tags.layouts.layout import Layout, builtin_layouts
from train import volume

STATEMENT = (
    "simulated objects without an enrolled tag: round, oval, handled and box-shaped bodies, bare tags, "
    "hands, cables and pairs of objects; no tag, or 1 to 5 reflectors in no enrolled arrangement (bare "
    "pairs: 5 mm from an enrolled spacing); up to 10 mm off the axis, 12 to 72 views, 0 to 20 dB"
)
BODIES = ("none", "can", "oval", "handle", "box", "shell")
CLUTTER = ("", "", "", "", "hand", "cable", "second")
VIEWS = (12, 18, 24, 36, 36, 72)
SNRS_DB = (0.0, 5.0, 10.0, 20.0)
APART_DEG = 15.0
"""Foreign arrangements differ from every enrolled one of their size by more than this, or in radius."""
PAIR_APART_M = 5e-3
"""Two reflectors without a body have nothing but their spacing. Nearer than this to an enrolled one they are
that layout: of two that are each mounted to 1.5 mm it differs by 2.1 mm (standard deviation)."""
_STEP_M = SPEED_OF_LIGHT * 61.035e-12 / 2
_BAND = np.linspace(2.85e9, 5.05e9, 56)
_HALF_M = 0.45


@dataclass(frozen=True, eq=False)
class Specimen:
    """One drawn object and its recording.

    Attributes:
        truth: the layout's name; None where the object carries none of the enrolled ones.
        body, clutter: kinds.
        positions: (K,) of the reflectors on the object, x + jy, m.
        views, snr_db: of the recording, SNR per reflector at the peak of one sample.
    """

    capture: Capture
    truth: str | None
    body: str
    clutter: str
    positions: NDArray[np.complex128]
    views: int
    snr_db: float

    @property
    def is_enrolled_pair(self) -> bool:
        """Whether it is an enrolled pair without a body, though it was drawn as a foreign one."""
        return self.truth is None and self.body == "none" and has_enrolled_spacing(self.positions)


def has_enrolled_spacing(positions: NDArray[np.complex128]) -> bool:
    """Whether reflectors at x + jy (K,), m, are two, as far apart as those of an enrolled pair."""
    if len(positions) != 2:
        return False
    spacing = abs(positions[0] - positions[1])
    pairs = [layout.positions for layout in builtin_layouts().values() if len(layout.positions) == 2]
    return any(abs(spacing - np.linalg.norm(pair[0] - pair[1])) < PAIR_APART_M for pair in pairs)


@dataclass(frozen=True, eq=False)
class _Antenna:
    """Views (V,) in the body's own frame, and wavenumbers kappa (F,)."""

    place: NDArray[np.complex128]
    kappa: NDArray[np.float64]

    def wave(
        self, distance: NDArray[np.float64], weight: NDArray[np.float64] | float
    ) -> NDArray[np.complex128]:
        """(F, V) echo of something at distances (V,)."""
        return np.asarray(weight * np.exp(-1j * self.kappa[:, None] * distance) / distance**2)

    def point(self, at: complex, weight: NDArray[np.float64] | float = 1.0) -> NDArray[np.complex128]:
        """(F, V) echo of a point."""
        return self.wave(np.abs(self.place - at), weight)


def draw(seed: int, views: int | None = None, snr_db: float | None = None) -> Specimen:
    """The foreign or untagged specimen of a seed; views and SNR are drawn, too, unless given."""
    rng = np.random.default_rng([seed, 3])
    drawn, level = int(rng.choice(VIEWS)), float(rng.choice(SNRS_DB))
    views, snr = views or drawn, level if snr_db is None else snr_db
    body, clutter = str(rng.choice(BODIES)), str(rng.choice(CLUTTER))
    positions = foreign(rng, body)
    radius = _wall(rng, body, positions)
    distance = rng.uniform(0.8, 1.2)
    angles = np.arange(views) * 2 * np.pi / views
    wobble = rng.uniform(0, 0.01) * np.sin(rng.integers(1, 3) * angles + rng.uniform(0, 2 * np.pi))
    centre = 0.01 * np.sqrt(rng.uniform()) * np.exp(2j * np.pi * rng.uniform())
    spin = np.exp(-1j * rng.uniform(0, 2 * np.pi))
    antenna = _Antenna(
        np.asarray((distance * np.exp(-1j * (angles + wobble)) - centre) * spin),
        4 * np.pi * _BAND / SPEED_OF_LIGHT,
    )
    # Drawn before a box, too, whose field is solved: seeds of untagged ones keep their objects.
    tag = _tag(rng, antenna, positions, body)
    if body == "box":
        echo = _metal_box(rng, antenna, positions, radius)
    else:
        echo = tag + _body(rng, antenna, body, radius)
    echo = echo + _clutter(rng, antenna, clutter)
    samples = _recorded(rng, echo, distance, snr)
    error = rng.uniform(-0.01, 0.01)
    capture = Capture(
        samples=samples.astype(np.float32),
        range_start_m=distance - _HALF_M + error,
        range_step_m=_STEP_M,
        angles_rad=angles,
        axis_distance_m=distance + error,
    )
    return Specimen(capture, None, body, clutter, positions, views, snr)


def difference_deg(gaps: NDArray[np.floating], other: NDArray[np.floating]) -> float:
    """Largest difference of two gap lists over all rotations, degrees; 180 for unlike counts.

    >>> difference_deg(np.array([90.0, 270.0]), np.array([265.0, 95.0]))
    5.0
    """
    if len(gaps) != len(other):
        return 180.0
    start = np.arange(len(other))
    return float(np.abs(gaps - other[start - start[:, None]]).max(axis=1).min())


def foreign(rng: np.random.Generator, body: str) -> NDArray[np.complex128]:
    """Places of 0 to 5 alike reflectors in no enrolled arrangement, m."""
    count = int(rng.choice([0, 1, 2, 2, 2, 3, 3, 4, 5]))
    radius = rng.uniform(0.035, 0.07) if body in ("can", "handle", "oval") else rng.uniform(0.035, 0.125)
    if body == "shell":
        radius = rng.uniform(0.085, 0.125)
    least = 0.035 / radius
    while True:
        if count >= 3 and rng.uniform() < 0.25:
            # An enrolled arrangement with more: the hardest of all.
            base = list(builtin_layouts().values())[int(rng.integers(3))]
            angles = np.angle(base.positions[:, 0] + 1j * base.positions[:, 1])[:count]
            angles = np.concatenate([angles, rng.uniform(0, 2 * np.pi, max(count - len(angles), 0))])
        else:
            angles = rng.uniform(0, 2 * np.pi, count)
        gaps = np.deg2rad(gaps_deg(angles)) if count > 1 else np.full(1, 9.0)
        if count > 1 and (gaps.min() < min(least, 1.0)):
            continue
        if all(_differs(angles, radius, layout) for layout in builtin_layouts().values()):
            return np.asarray(radius * np.exp(1j * angles))


def _differs(angles: NDArray[np.float64], radius: float, layout: Layout) -> bool:
    place = layout.positions[:, 0] + 1j * layout.positions[:, 1]
    off = np.abs(place) > 0.01
    gaps = gaps_deg(np.angle(place[off]))
    near = difference_deg(gaps_deg(angles), gaps) <= APART_DEG if len(angles) == int(off.sum()) else False
    return not (near and abs(radius - float(np.abs(place[off]).mean())) < 0.04)


def _wall(rng: np.random.Generator, body: str, positions: NDArray[np.complex128]) -> float:
    """Radius of the body, m: a little inside its reflectors."""
    if len(positions):
        return float(max(np.abs(positions).max() - rng.uniform(0.008, 0.022), 0.018))
    return float(rng.uniform(0.08, 0.11) if body == "shell" else rng.uniform(0.02, 0.06))


def _tag(
    rng: np.random.Generator, antenna: _Antenna, positions: NDArray[np.complex128], body: str
) -> NDArray[np.complex128]:
    """(F, V) echo of the reflectors, with their shadow and the bounce at the wall."""
    total = np.zeros((len(antenna.kappa), len(antenna.place)), dtype=np.complex128)
    dark, bounce, phase = rng.uniform(0.0, 0.4), rng.uniform(0.2, 1.0), rng.uniform(0, 2 * np.pi)
    depth, slope, sharp = rng.uniform(0.004, 0.02), rng.uniform(-0.6, 1.2), rng.uniform(1.0, 3.0)
    if body in ("none", "shell"):
        dark, bounce = rng.uniform(0.5, 1.0), rng.uniform(0.0, 0.2)
    level = (antenna.kappa / antenna.kappa.mean()) ** slope
    for place in positions:
        toward = antenna.place - place
        cosine = np.cos(np.angle(toward) - np.angle(place)) if abs(place) > 1e-3 else np.ones(len(toward))
        shade = dark + (1 - dark) * ((1 + cosine) / 2) ** sharp
        # The path by the wall is longer by twice its depth behind the reflector, less where seen aslant.
        image = place - 2 * depth * place / max(abs(place), 1e-3)
        lit = bounce * np.clip(cosine, 0, 1)
        echo = antenna.point(place, shade) + np.exp(1j * phase) * antenna.point(image, shade * lit)
        total += rng.uniform(0.9, 1.1) * echo
    return np.asarray(total * level[:, None])


def _metal_box(
    rng: np.random.Generator, antenna: _Antenna, positions: NDArray[np.complex128], radius: float
) -> NDArray[np.complex128]:
    """(F, V) echo of a box of metal and of reflectors before its walls, in its field."""
    level = float(np.exp(rng.uniform(np.log(0.5), np.log(12.0))))
    half = radius * np.array([1.0, rng.uniform(0.5, 1.0)])
    if len(positions):
        gap = np.abs(positions).max() - radius
        # The largest box of these proportions that no reflector is nearer to.
        inside = np.abs([positions.real, positions.imag]) - gap
        half = np.maximum(half * (inside / half[:, None]).max(axis=0).min(), 0.018)
    cells, frequency = volume.metal(volume.box(*half)), antenna.kappa * SPEED_OF_LIGHT / (4 * np.pi)
    solved = volume.echo(cells, frequency, antenna.place)
    total = antenna.wave(np.abs(antenna.place), level) * (solved / np.abs(solved).max())
    # Once on the way to a reflector, once on the way back.
    seen = volume.lit(cells, frequency, antenna.place, positions) ** 2
    for i, place in enumerate(positions):
        total = total + rng.uniform(0.9, 1.1) * antenna.point(place) * seen[:, i]
    return np.asarray(total)


def _body(rng: np.random.Generator, antenna: _Antenna, body: str, radius: float) -> NDArray[np.complex128]:
    """(F, V) echo of the body: specular wall, creeping wave, and what is not round."""
    if body == "none":
        return np.zeros((len(antenna.kappa), len(antenna.place)), dtype=np.complex128)
    rho, side = np.abs(antenna.place), np.angle(antenna.place)
    level = float(np.exp(rng.uniform(np.log(0.5), np.log(12.0))))
    if body == "shell":
        level = float(np.exp(rng.uniform(np.log(0.3), np.log(3.0))))
    oval = rng.uniform(0.02, 0.25) if body in ("oval", "shell") else rng.uniform(0.0, 0.002)
    turn = rng.uniform(0, 2 * np.pi)
    support = radius * np.sqrt(1 + oval * np.cos(2 * (side - turn)))
    total = level * antenna.wave(rho - support, 1.0)
    creeping = rng.uniform(0.02, 0.2) * level * np.exp(1j * rng.uniform(0, 6.28))
    total = total + creeping * antenna.wave(rho + (np.pi / 2) * radius, 1.0)
    rough = rng.uniform(0, 0.004) * level
    for harmonic in range(1, 6):
        total = total + rough * np.exp(1j * rng.uniform(0, 6.28)) * antenna.wave(
            rho - radius, np.cos(harmonic * side + rng.uniform(0, 6.28))
        )
    if body == "handle":
        grip = (radius + rng.uniform(0.015, 0.03)) * np.exp(1j * rng.uniform(0, 6.28))
        facing = (1 + np.cos(np.angle(antenna.place - grip) - np.angle(grip))) / 2
        total = total + level * rng.uniform(0.2, 1.0) * antenna.point(grip, facing**2)
    return np.asarray(total)


def _clutter(rng: np.random.Generator, antenna: _Antenna, kind: str) -> NDArray[np.complex128]:
    """(F, V) echo of clutter on the table next to the object, which turns with it."""
    total = np.zeros((len(antenna.kappa), len(antenna.place)), dtype=np.complex128)
    if kind == "hand":
        middle = rng.uniform(0.06, 0.13) * np.exp(1j * rng.uniform(0, 6.28))
        for _ in range(8):
            at = middle + 0.03 * complex(*rng.standard_normal(2))
            total += rng.uniform(0.2, 1.0) * np.exp(1j * rng.uniform(0, 6.28)) * antenna.point(at)
    elif kind == "cable":
        start, way = 0.03 * complex(*rng.standard_normal(2)), np.exp(1j * rng.uniform(0, 6.28))
        for step in np.arange(0.0, 0.14, 0.01):
            total += rng.uniform(0.1, 0.4) * antenna.point(start + step * way)
    elif kind == "second":
        middle = rng.uniform(0.08, 0.13) * np.exp(1j * rng.uniform(0, 6.28))
        distance = np.abs(antenna.place - middle) - rng.uniform(0.015, 0.03)
        total += rng.uniform(0.5, 4.0) * antenna.wave(distance, 1.0)
    return total


def _recorded(
    rng: np.random.Generator, echo: NDArray[np.complex128], distance: float, snr_db: float
) -> NDArray[np.float64]:
    """(V, bins) real samples of an echo with room and noise; 1 is the peak of one reflector."""
    pulse = np.exp(-((_BAND - 4.0e9) ** 2) / (2 * rng.uniform(0.42e9, 0.55e9) ** 2))
    pulse = pulse * np.exp(1j * rng.uniform(-1.0, 1.0) * ((_BAND - 4.0e9) / 1e9) ** 2)
    ranges = distance - _HALF_M + _STEP_M * np.arange(int(2 * _HALF_M / _STEP_M))
    inverse = np.exp(4j * np.pi / SPEED_OF_LIGHT * _BAND[:, None] * ranges[None])
    unit = float(np.abs(pulse).sum()) / distance**2
    samples = np.real((echo * pulse[:, None]).T @ inverse) / unit
    room = np.zeros(len(ranges))
    for _ in range(8):
        at = rng.uniform(ranges[0] - 0.1, ranges[-1] + 0.1)
        wave = np.exp(-4j * np.pi / SPEED_OF_LIGHT * _BAND * at) * pulse
        room += rng.uniform(-2, 2) * np.real(wave @ inverse) / float(np.abs(pulse).sum())
    noise = 10 ** (-snr_db / 20) / np.sqrt(2)
    return np.asarray(samples + room + noise * rng.standard_normal(samples.shape))
