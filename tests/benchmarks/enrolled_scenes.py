"""Scenes of enrolled bodies and objects: solved ones, and designed layouts on enrolled bodies.

Designed are 16 layouts on a helmet shell and 8 on a mug with a handle, from two sources of waves, reported
apart. "own" is `tagid.simulate`: a plastic shell, a porcelain cup with a
handle, octahedra of 20 or 40 mm with strengths 0.5 dB apart, the tag's middle off the body's by 0.5 mm.
"full-wave" is a superposition of solved responses, since these layouts were not solved: the untagged body
plus, for every reflector, what a single one adds. On the shell that is an octahedron alone, moved to its
place; on the mug it is what one adds to a can without a handle, turned. Heights enter through the distance.
Coupling between reflectors, and between reflectors and handle or shell, is left out.

Three bodies are enrolled in every designed scene: the one that stands there and two that do not. Foreign tags
are two to four reflectors at random angles, 40 mm or more apart, of no enrolled arrangement.
"""

from __future__ import annotations

import zlib
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture
from tagid.constants import SPEED_OF_LIGHT
from tagid.pipeline.identify import aspect_spectra
from tagid.simulate import Acquisition, Placement, ReflectorSpec, parse_body, simulate_capture
from tagid.simulate.objects import Variation, object_scene
from tagid.simulate.presets import room_clutter
from tagid.tags.bodies.joint import Named, enroll_signature
from tagid.tags.bodies.signature import Signature, SignatureKind
from tagid.tags.layouts.layout import Layout
from tests.benchmarks.fullwave_scenes import full_wave, recorded
from tests.benchmarks.identification_scenes import SETS, in_space, is_foreign, least_gap_m

DISTANCE_M = 1.0
POPULATION = "development/1"
"""What the captures are drawn from."""
OFFSETS_MM = (0, 2, 6, 10)
SNRS_DB = (20, 10)
VIEWS = 36

HANDLE = "can35_handle"
BODIES = (HANDLE, "shell", "can35")
ON_BODIES = {
    f"{HANDLE}+can35_c90-can35": "container-90",
    f"{HANDLE}+can28_c180-can28": "container-180",
    "shell_h120_20": "helmet-120",
    "shell_h120_40": "helmet-120",
    "can35_c90": "container-90",
}
"""Tagged scenes and the layout that they carry."""
FOREIGN_ON_BODIES = (HANDLE, f"{HANDLE}+can35_one-can35", "shell", "can35", "can35_one", "can28_one")
"""Untagged bodies and tags that nobody enrolled."""
OBJECTS = (f"{HANDLE}+can35_c90-can35", "shell_h120_20", "shell_h120_40", "can35_c90", "can28_c180")
FOREIGN_OBJECTS = (
    HANDLE,
    f"{HANDLE}+can35_one-can35",
    f"{HANDLE}+can28_c180-can28",
    "shell",
    "can35",
    "can35_one",
    "can28_one",
)


class Where(NamedTuple):
    """Population and number of a capture, SNR against one reflector, distance from the axis, and views."""

    key: str
    snr_db: float
    offset_mm: float
    views: int


ENROLMENT = [Where(f"{POPULATION}/enrol/{i}", 20, 2 + 2 * i, 72) for i in range(3)]


def capture_of(solved: str, where: Where) -> Capture:
    """A capture of a solved object, the same for the same arguments; SNR against one reflector of its tag."""
    rng = np.random.default_rng(zlib.crc32("/".join(map(str, (solved, *where))).encode()))
    offset = where.offset_mm * 1e-3 * np.exp(2j * np.pi * rng.uniform())
    return recorded(solved, rng, offset, views=where.views, distance=DISTANCE_M, snr_db=where.snr_db)


class Scene(NamedTuple):
    """A capture of a solved object: what is enrolled ("body" or "object"); the right name, "" for none."""

    part: str
    solved: str
    name: str
    offset_mm: int
    snr_db: int
    number: int


def slug(solved: str) -> str:
    """Name under which a solved object is enrolled."""
    return solved.replace("_", "-").replace("+", ".")


def enrolled(solved: str, kind: SignatureKind) -> Signature:
    """Signature of a solved object from three captures."""
    shown = [capture_of(solved, where) for where in ENROLMENT]
    return _signature(solved, slug(solved), shown, kind)


def _signature(prefix: str, name: str, shown: list[Capture], kind: SignatureKind) -> Signature:
    captures = [Named(f"{prefix} {i}", aspect_spectra(capture)) for i, capture in enumerate(shown)]
    return enroll_signature(captures, name, kind).signature


def scenes(number: int) -> list[Scene]:
    results = []
    for place in product(OFFSETS_MM, SNRS_DB, (number,)):
        results += [Scene("body", solved, name, *place) for solved, name in ON_BODIES.items()]
        results += [Scene("body", solved, "", *place) for solved in FOREIGN_ON_BODIES]
        results += [Scene("object", solved, slug(solved), *place) for solved in OBJECTS]
        results += [Scene("object", solved, "", *place) for solved in FOREIGN_OBJECTS]
    return results


AZIMUTHS = 72
RINGS = ((0.8, "V"), (1.0, "V"), (1.2, "V"), (1.0, "H"))
"""Distances and polarisations of the solved responses."""


class Carrier(NamedTuple):
    """A body, as `--body` takes it or solved, with its designed layouts, of `identification_scenes.SETS`.

    The world is "own", or "full-wave" with a solved response of a single reflector per size.
    """

    world: str
    layouts: str
    body: str
    single: tuple[str, ...]
    sizes_mm: tuple[int, ...]

    @property
    def name(self) -> str:
        """Under which the body is enrolled."""
        return f"{self.layouts}-{self.world}"

    @property
    def family(self) -> tuple[Layout, ...]:
        return SETS[self.layouts]


CARRIERS = (
    Carrier("own", "helmet-16", "helmet:84mm", (), (20, 40)),
    Carrier("own", "mug-8", "cup:33mm,wall=4mm,handle", (), (20,)),
    Carrier("full-wave", "helmet-16", "shell", ("free20_one", "free40_one"), (20, 40)),
    Carrier("full-wave", "mug-8", "can35_handle", ("can35_one-can35", "can28_one-can28"), (20, 40)),
)
"""40 mm octahedra 45 mm from the axis do not fit on a cup of 33 mm radius. The designed upper row, 70 mm from
the axis and 50 mm up, lies outside the dome of a helmet of 84 mm half axis, and inside the solved shell."""


ENROLLED = ((0, 1, 3), (1, 0, 2), (2, 3, 1), (3, 2, 0))
"""Which bodies are enrolled in the scenes of each carrier, by index: its own first."""
FOREIGN = 3
"""Foreign tags for every size and SNR, beside one body without a tag."""
SPACING_M = 0.04
"""Least spacing of the reflectors of foreign tags."""


class DesignedScene(NamedTuple):
    """A capture of a carrier (index) with a layout of its family (index; -1: none, less: a foreign tag)."""

    carrier: int
    what: int
    size_mm: int
    offset_mm: int
    snr_db: int
    number: int = 0

    @property
    def layout(self) -> Layout | None:
        if self.what >= 0:
            return CARRIERS[self.carrier].family[self.what]
        return None if self.what == -1 else _foreign(self)

    @property
    def name(self) -> str:
        return CARRIERS[self.carrier].family[self.what].name if self.what >= 0 else ""


def designed_scenes() -> list[DesignedScene]:
    """Every layout of every carrier in every size and SNR, at one offset each; and what has no name."""
    return [
        DesignedScene(c, what, size, OFFSETS_MM[(what + size // 20 + i) % len(OFFSETS_MM)], snr)
        for c, carrier in enumerate(CARRIERS)
        for size in carrier.sizes_mm
        for i, snr in enumerate(SNRS_DB)
        for what in range(-1 - FOREIGN, len(carrier.family))
    ]


def _foreign(scene: DesignedScene) -> Layout:
    carrier = CARRIERS[scene.carrier]
    rng = np.random.default_rng([7, scene.carrier, -scene.what, scene.size_mm, scene.snr_db, scene.number])
    radius = max(float(np.hypot(*place)) for place in carrier.family[0].positions)
    while True:
        angles = rng.uniform(0, 2 * np.pi, int(rng.integers(2, 5)))
        positions = radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        if least_gap_m(positions) >= SPACING_M and is_foreign(positions, carrier.family):
            return Layout("foreign", positions)


def designed_capture(carrier: Carrier, layout: Layout | None, size_mm: int, where: Where) -> Capture:
    """A capture of a layout, or of none, on its body; the same for the same arguments.

    The SNR refers to octahedra of the size.
    """
    key, snr_db, offset_mm, views = where
    words = f"{carrier}/{layout.name if layout else ''}/{size_mm}/{key}/{snr_db}/{offset_mm}/{views}"
    rng = np.random.default_rng(zlib.crc32(words.encode()))
    place = offset_mm * 1e-3 * np.exp(2j * np.pi * rng.uniform())
    if carrier.world == "own":
        return _own(carrier, layout, size_mm, where, rng, place)
    single = carrier.single[carrier.sizes_mm.index(size_mm)]
    made, name = full_wave(), carrier.body
    if layout is not None:
        name = f"{carrier.body}@{layout.name}@{size_mm}".replace("-", "~")
        if name not in made._cache:
            made._cache[name] = _superposed(carrier.body, single, layout)
    return recorded(name, rng, place, reference=single, views=views, distance=DISTANCE_M, snr_db=snr_db)


def _superposed(body: str, single: str, layout: Layout) -> tuple[NDArray[np.float64], NDArray[np.complex128]]:
    """Frequencies and response (F, ring, order) of a body and reflectors, as `scenes.response` returns."""
    made = full_wave()
    frequency, reply = made.response(body)
    around = np.exp(2j * np.pi * np.arange(AZIMUTHS) / AZIMUTHS)
    rings = []
    for distance, polarisation in RINGS:
        carrier = np.exp(4j * np.pi * frequency[:, None] / SPEED_OF_LIGHT * distance) * distance**2
        total = np.zeros((len(frequency), AZIMUTHS), dtype=np.complex128)
        for (x, y), height in zip(layout.positions[:, :2], layout.heights, strict=True):
            turn = np.exp(-1j * np.angle(complex(x, y)))
            # A single reflector alone was solved about its own middle; one on a can about the can's axis.
            origin = complex(x, y) if single.startswith("free") else 0j
            toward = (distance * around - origin) * turn
            _, part = made.view(single, np.hypot(np.abs(toward), height), np.angle(toward), polarisation)
            total += part.T
        rings.append(total * carrier)
    return frequency, reply + np.fft.fft(np.stack(rings, axis=1), axis=2) / AZIMUTHS


def _own(
    carrier: Carrier,
    layout: Layout | None,
    size_mm: int,
    where: Where,
    rng: np.random.Generator,
    place: complex,
) -> Capture:
    positions = np.zeros((0, 3))
    ring = np.zeros(2)
    if layout is not None:
        positions = in_space(layout)
        ring = rng.normal(0, 0.5e-3, 2)
    # The handle stands alike in every capture, counted from the tag: the tag is glued on anywhere.
    parts_rad = float(np.random.default_rng(zlib.crc32(carrier.body.encode())).uniform(0, 2 * np.pi))
    scene = object_scene(
        carrier.name,
        positions,
        parse_body(carrier.body),
        ReflectorSpec("octahedron", size_mm * 1e-3),
        rng=rng,
        room=room_clutter(rng),
        variation=Variation(parts_rad, (float(ring[0]), float(ring[1])), 0.5),
    )
    acquisition = Acquisition(
        views=where.views,
        snr_db=where.snr_db,
        axis_distance_m=DISTANCE_M,
        placement=Placement((place.real, place.imag), rng.uniform(0, 2 * np.pi)),
    )
    return simulate_capture(scene, acquisition, int(rng.integers(2**32)))[0]


def enrolled_carrier(number: int) -> Signature:
    """Signature of a body of the designed layouts from three captures without a tag."""
    carrier = CARRIERS[number]
    shown = [designed_capture(carrier, None, carrier.sizes_mm[0], where) for where in ENROLMENT]
    return _signature(carrier.name, carrier.name, shown, "body")
