"""Scenes of solved bodies and tags, read blind.

A tag at other angles is a sum of turned copies of what one reflector adds to the body, which leaves out the
coupling between them.
"""

from __future__ import annotations

import zlib
from typing import NamedTuple

import numpy as np

from tagid.capture import Capture
from tagid.constants import SPEED_OF_LIGHT
from tagid.reading.arrangement import gaps_deg
from tests.benchmarks.fullwave_scenes import NAMES, full_wave, known, recorded
from train.population import difference_deg, has_enrolled_spacing

ANGLES = {"container-90": (0.0, 90.0), "container-180": (0.0, 180.0)}
NAMELESS = "foreign or untagged"
FOREIGN_DEG = (
    (), (0,), (0, 40), (0, 60), (0, 70), (0, 110), (0, 125), (0, 135), (0, 150), (0, 160), (0, 120, 240),
    (0, 90, 180), (0, 90, 200), (0, 60, 180), (0, 90, 180, 270), (0, 45, 180, 225), (0, 72, 144, 216, 288),
)  # fmt: skip
DRAWN_BODIES = ("can35", "can28", "can40", "cup36", "free20", "free40")
"""Bodies of drawn foreign tags, with a single reflector that was solved on each."""
APART_DEG = 15.0
"""A foreign tag differs by more than this from every enrolled one of its size."""
RING_M = 0.045
LEAST_M = 0.03
"""Octahedra on a ring of 45 mm stand at least so far apart."""


class Scene(NamedTuple):
    """A body with reflectors at some angles, or the response of a name where there are none (None).

    The group is the row of the table, the truth the layout that it carries; None for none of the enrolled.
    """

    group: str
    name: str
    angles_deg: tuple[float, ...] | None
    truth: str | None

    @property
    def is_enrolled_pair(self) -> bool:
        """Whether it is an enrolled pair without a body, as in the simulated population."""
        if self.truth is not None or self.angles_deg is None or not self.name.startswith("free"):
            return False
        return has_enrolled_spacing(RING_M * np.exp(1j * np.deg2rad(self.angles_deg)))


class Recording(NamedTuple):
    """How a scene is recorded: SNR against one reflector of the tag at its peak, offset from the axis in a
    random direction; hard: measured pulse, wobble of 0.01 rad, axis distance wrong by up to 10 mm."""

    views: int = 36
    snr_db: float = 20.0
    offset_m: float = 0.006
    polarisation: str = "V"
    hard: bool = False

    @property
    def label(self) -> str:
        words = [f"{self.views} views", f"{self.snr_db:.0f} dB", f"{self.offset_m * 1e3:.0f} mm off"]
        words += ["horizontal"] if self.polarisation == "H" else []
        words += ["measured pulse, wobble 1 %, axis wrong by up to 10 mm"] if self.hard else []
        return ", ".join(words)


RECORDINGS = (
    Recording(),
    Recording(snr_db=10.0),
    Recording(offset_m=0.0),
    Recording(offset_m=0.010),
    Recording(snr_db=10.0, offset_m=0.010, hard=True),
    Recording(polarisation="H"),
    Recording(views=18),
    Recording(views=72),
)


TAGGED = (
    *(
        Scene("bare tag", f"free{size}_{kind}", None, name)
        for size in (20, 40)
        for kind, name in NAMES.items()
    ),
    Scene("bare tag", "free30_c90", None, "container-90"),
    *(Scene("metal can", f"can{mm}", angles, name) for mm in (35, 28, 40) for name, angles in ANGLES.items()),
    Scene("metal can", "can30_c180", None, "container-180"),
    *(Scene("ceramic cup", "cup36", angles, name) for name, angles in ANGLES.items()),
    *(Scene("helmet shell", f"shell_h120_{size}", None, "helmet-120") for size in (20, 40)),
    Scene("mug with a handle", "handle34_c90", None, "container-90"),
)
"""Bare tags, round bodies, and bodies that are not round, each with an enrolled layout."""
_BARE = (
    *("shell", "can35_handle", "free20_one", "free40_one", "can30_foreign", "free20_foreign"),
    *("cup36", "handle34", "box", "can30", "can40"),
)
UNNAMED = (
    *(Scene(NAMELESS, can, tuple(map(float, at)), None) for can in ("can35", "can28") for at in FOREIGN_DEG),
    *(Scene(NAMELESS, name, None, None) for name in _BARE),
)
"""Untagged bodies and fixed foreign tags."""


def drawn(number: int) -> tuple[Scene, Recording]:
    """A foreign tag of 1 to 5 reflectors, or none, at random angles, recorded at random."""
    rng = np.random.default_rng([number, 29])
    body = DRAWN_BODIES[int(rng.integers(len(DRAWN_BODIES)))]
    free = body.startswith("free")
    layouts = [np.deg2rad(angle) for angle in ANGLES.values()] + [np.deg2rad([0.0, 120.0, 240.0])]
    while True:
        count = int(rng.choice([1, 2, 2, 3, 3, 4, 5] if free else [0, 1, 2, 2, 2, 3, 3, 4, 5]))
        angles = np.sort(rng.uniform(0, 2 * np.pi, count))
        if rng.uniform() < 0.25 and count >= 3:
            # An enrolled arrangement with one reflector more is the hardest foreign tag.
            angles[: len(layouts[0])] = layouts[int(rng.integers(2))]
        gaps = gaps_deg(angles) if count > 1 else np.full(1, 360.0)
        if count > 1 and 2 * RING_M * np.sin(np.deg2rad(min(gaps.min(), 180.0)) / 2) < LEAST_M:
            continue
        # Unlike counts differ by 180 degrees.
        if all(difference_deg(gaps, gaps_deg(layout)) > APART_DEG for layout in layouts):
            break
    recording = Recording(
        views=int(rng.choice([18, 36, 36, 72])),
        snr_db=float(rng.choice([5.0, 10.0, 20.0, 30.0])),
        offset_m=float(0.01 * np.sqrt(rng.uniform())),
        polarisation=str(rng.choice(["V", "V", "H"])),
        hard=bool(rng.uniform() < 0.5),
    )
    return Scene(
        f"foreign tag, {'bare' if free else 'on a body'}", body, tuple(np.rad2deg(angles)), None
    ), recording


def _reference(base: str, name: str) -> str:
    """Response whose echo is that of one reflector of the tag, at the frequencies of the object's."""
    made = full_wave()
    reply = made.response(name)[0]
    if known(f"{base}_one") and len(made.response(f"{base}_one")[0]) == len(reply):
        return f"{base}_one" if base.startswith("free") else f"{base}_one-{base}"
    size = "40" if name.endswith("40") or (base, name) == ("shell", "shell_h120") else "20"
    single = f"free{size}_one"
    frequency, values = made.response(single)
    if len(reply) == len(frequency):
        return single
    step = (len(frequency) - 1) // (len(reply) - 1)
    made._cache[f"{single} at {len(reply)}"] = (frequency[::step], values[::step])
    return f"{single} at {len(reply)}"


def _ring_of(name: str, angles_deg: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """A bare tag on a ring of RING_M, from the response of one reflector about its own middle."""
    made = full_wave()
    around = np.exp(2j * np.pi * np.arange(72) / 72)
    rings = []
    for distance, polarisation in ((0.8, "V"), (1.0, "V"), (1.2, "V"), (1.0, "H")):
        total = 0.0
        for angle in np.deg2rad(angles_deg):
            toward = (distance * around - RING_M * np.exp(1j * angle)) * np.exp(-1j * angle)
            frequency, part = made.view(name, np.abs(toward), np.angle(toward), polarisation)
            total = total + part.T
        carrier = np.exp(4j * np.pi * frequency[:, None] / SPEED_OF_LIGHT * distance)
        rings.append(total * distance**2 * carrier)
    return frequency, np.fft.fft(np.stack(rings, axis=1), axis=2) / len(around)


def captured(scene: Scene, recording: Recording, seed: int) -> Capture:
    made = full_wave()
    name, base = scene.name, scene.name.split("_")[0]
    if scene.angles_deg is not None:
        name = f"{base}@" + ",".join(f"{a:g}" for a in scene.angles_deg)
        if base.startswith("free"):
            made._cache[name] = _ring_of(f"{base}_one", scene.angles_deg)
        else:
            frequency, reply = made.response(f"{base}_one")
            body = made.response(base)[1]
            order = np.fft.fftfreq(reply.shape[2], 1 / reply.shape[2])
            turned = sum((reply - body) * np.exp(-1j * order * np.deg2rad(a)) for a in scene.angles_deg)
            made._cache[name] = (frequency, body + turned)
    rng = np.random.default_rng([seed, 17, zlib.crc32(name.encode())])
    turn = rng.uniform(0, 2 * np.pi)
    hard = {"pulse": "cr08", "wobble": 0.01, "distance_error": rng.uniform(-0.01, 0.01)}
    return recorded(
        name,
        rng,
        complex(recording.offset_m * np.cos(turn), recording.offset_m * np.sin(turn)),
        reference=_reference(base, name),
        views=recording.views,
        distance=rng.uniform(0.8, 1.2),
        snr_db=recording.snr_db,
        pol=recording.polarisation,
        **(hard if recording.hard else {}),
    )
