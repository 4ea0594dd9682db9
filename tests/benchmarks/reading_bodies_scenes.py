"""Scenes of the benchmark on real bodies: tagged, foreign and untagged objects, from two sources of waves.

"own" scenes come from `tagid.simulate`; "full-wave" scenes from solved responses. SNR is per reflector
(`tagid.simulate.snr`) in both. The seeds are those of development: constants were chosen on them.
"""

from __future__ import annotations

import hashlib
import zlib
from functools import cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from tagid.capture import Capture, Pulse
from tagid.errors import DataError
from tagid.pipeline.identify import aspect_spectra
from tagid.simulate import (
    Acquisition,
    Interference,
    NoiseShape,
    Placement,
    ReflectorSpec,
    Wobble,
    parse_body,
    simulate_capture,
)
from tagid.simulate.objects import Variation, object_scene
from tagid.simulate.presets import room_clutter
from tagid.simulate.scene import Scene, StaticReturns
from tagid.tags.bodies.joint import Named, enroll_signature
from tagid.tags.bodies.signature import Signature, SignatureKind
from tagid.tags.layouts.layout import Layout
from tests.benchmarks.fullwave_scenes import NAMES, recorded
from tests.benchmarks.identification_scenes import SETS, in_space, is_foreign, least_gap_m
from tests.benchmarks.provenance import SHARED

POPULATION = "reading-bodies/development/1"

BODIES = ("none", "cup", "cup-handle", "can", "helmet", "box")
FULL_WAVE_BODIES = ("none", "can", "helmet")
OFFSETS_MM = (0, 2, 6, 10)
SNRS_DB = (20, 10, 5, 0)
VIEWS = (72, 36, 18, 12)
PULSES = ("nominal", "measured")

FULL_WAVE = {
    ("tagged", "none"): {f"free{size}_{kind}": name for kind, name in NAMES.items() for size in (20, 40)},
    ("tagged", "can"): {"can35_c90": "container-90", "can28_c180": "container-180"},
    ("tagged", "helmet"): {"shell_h120_20": "helmet-120", "shell_h120_40": "helmet-120"},
    ("foreign", "none"): {"free20_one": "", "free40_one": ""},
    ("foreign", "can"): {"can35_one": "", "can28_one": "", "can35_c90": "-", "can28_c180": "-"},
    ("foreign", "helmet"): {"shell_h120_20": "-", "shell_h120_40": "-"},
    ("untagged", "can"): {"can35": "", "can28": "", "can35_handle": ""},
    ("untagged", "helmet"): {"shell": ""},
}
"""(group, body) -> solved object and the layout that it carries. A foreign object marked "-" carries one of
the set's layouts, which is left out of the registry for that scene."""


class Cell(NamedTuple):
    """One cell of the grid: `enrolled` of `identification_scenes.SETS`, the object off the axis in a random
    direction, one of PULSES, which no capture states."""

    world: str
    group: str
    enrolled: str
    body: str
    offset_mm: int
    snr_db: int
    views: int
    pulse: str


class Drawn(NamedTuple):
    """A recording, what is enrolled, and the right name; empty if no name is right."""

    capture: Capture
    layouts: tuple[Layout, ...]
    name: str


def draw(cell: Cell, number: int) -> Drawn:
    """The recording of a cell and a number, independent of all others."""
    rng = _generator(cell, number)
    if cell.world == "full-wave":
        return _full_wave(cell, rng)
    made, scene = _standing(cell, rng)
    capture, _ = simulate_capture(scene, _acquisition(cell, rng), int(rng.integers(2**32)))
    return Drawn(capture, SETS[cell.enrolled], made.name)


def _generator(cell: Cell, number: int) -> np.random.Generator:
    digest = hashlib.sha256(f"{POPULATION}/{number}".encode()).digest()
    return np.random.default_rng(
        [int.from_bytes(digest[:8], "big"), zlib.crc32("/".join(map(str, cell)).encode())]
    )


@cache
def _measured_pulses() -> dict[str, Pulse]:
    """Pulses recorded with P440 radars, by name."""
    with np.load(SHARED / "data" / "p440" / "pulse.npz", allow_pickle=False) as file:
        step = float(file["dt_ns"]) * 1e-9
        return {name: Pulse(file[name] - file[name].mean(), step) for name in sorted(file) if name != "dt_ns"}


def _layouts_for(cell: Cell) -> tuple[Layout, ...]:
    """The layouts of the set that fit on the body."""
    layouts = SETS[cell.enrolled]
    if cell.enrolled != "paper" or cell.body in ("none", "box"):
        return layouts
    kind = "helmet" if cell.body == "helmet" else "container"
    return tuple(layout for layout in layouts if layout.kind == kind)


def _body_text(body: str, size_mm: float, rng: np.random.Generator) -> str:
    """A body of random size for reflectors of a size, as `--body` takes it."""
    if body == "can":
        # The octahedra stand 45 mm from the axis and reach inwards by half their size.
        most = 35.0 if size_mm < 30 else 28.0
        return f"can:{rng.uniform(24, most):.2f}mm,height={rng.uniform(80, 120):.0f}mm,seam"
    if body in ("cup", "cup-handle"):
        handle = ",handle" if body == "cup-handle" else ""
        filled = ",filled" if rng.uniform() < 0.3 else ""
        oval = f",oval={rng.uniform(0, 0.3):.2f}mm"
        return f"cup:{rng.uniform(30, 38):.2f}mm,wall={rng.uniform(3, 5):.2f}mm{oval}{handle}{filled}"
    if body == "helmet":
        # Not where a reflector of helmet-linear, 90 mm from the axis, would stand in the wall.
        return f"helmet:{rng.uniform(96, 104):.2f}mm"
    if body == "box":
        return f"box:{rng.uniform(100, 150):.1f}mm,height={rng.uniform(80, 150):.0f}mm"
    return "none"


def _foreign(cell: Cell, rng: np.random.Generator) -> np.ndarray:
    """(K, 2) one to five reflectors 40 mm or more apart on a ring around the body, none of the enrolled."""
    radius = 0.110 if cell.body == "helmet" else 0.045
    most = 3 if radius < 0.05 else 5
    while True:
        count = int(rng.integers(1, most + 1))
        angle = rng.uniform(0, 2 * np.pi, count)
        points = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        if count == 1:
            return points
        if least_gap_m(points) >= 0.04 and is_foreign(points, SETS[cell.enrolled]):
            return points


class _Object(NamedTuple):
    """An object of our simulator in its room: the enrolled layout that it carries ("" for none), reflectors
    (K, 3), m, and their size, its body as `--body` takes it, and how it deviates from the nominal one."""

    name: str
    positions: np.ndarray
    body: str
    size_mm: float
    variation: Variation
    room: StaticReturns


def _own_object(cell: Cell, rng: np.random.Generator) -> _Object:
    fitting = _layouts_for(cell)
    layout = fitting[int(rng.integers(len(fitting)))]
    size_mm = float(rng.choice([20.0, 40.0]))
    body = _body_text(cell.body, size_mm, rng)
    name, positions = "", np.zeros((0, 3))
    if cell.group == "tagged":
        name, positions = layout.name, in_space(layout)
    elif cell.group == "foreign":
        positions = _foreign(cell, rng)
    ring = rng.normal(0, 0.5e-3, 2)
    room = room_clutter(rng)
    variation = Variation(rng.uniform(0, 2 * np.pi), (float(ring[0]), float(ring[1])), 0.5)
    return _Object(name, positions, body, size_mm, variation, room)


def _scene(made: _Object, group: str, positions: np.ndarray, rng: np.random.Generator) -> Scene:
    reflector = ReflectorSpec("octahedron", made.size_mm * 1e-3)
    how: dict[str, Any] = {"rng": rng, "room": made.room, "variation": made.variation}
    return object_scene(group, positions, parse_body(made.body), reflector, **how)


def _standing(cell: Cell, rng: np.random.Generator) -> tuple[_Object, Scene]:
    """An object whose reflectors stand clear of its wall, and its scene."""
    while True:
        made = _own_object(cell, rng)
        try:
            return made, _scene(made, cell.group, made.positions, rng)
        except DataError:
            continue


def _acquisition(cell: Cell, rng: np.random.Generator) -> Acquisition:
    place = rng.uniform(0, 2 * np.pi)
    off = cell.offset_mm * 1e-3
    pulse_number, tone, colour = int(rng.integers(7)), rng.uniform() < 0.2, rng.uniform(0, 1)
    pulses = (*_measured_pulses().values(),) if cell.pulse == "measured" else (None,)
    return Acquisition(
        views=cell.views,
        snr_db=float(cell.snr_db),
        noise=NoiseShape(colour, Interference(-6.0, rng.uniform(3.1e9, 4.8e9), 0.3) if tone else None),
        pulse=pulses[pulse_number % len(pulses)],
        placement=Placement(
            (off * np.cos(place), off * np.sin(place)), rng.uniform(0, 2 * np.pi), rng.uniform(-0.1, 0.1)
        ),
        wobble=Wobble(speed=0.01),
        axis_distance_error_m=rng.uniform(-0.015, 0.015),
    )


def signature_of(cell: Cell, number: int, name: str, kind: SignatureKind) -> Signature:
    """A body, or an object with its tag, enrolled from three captures of it, as `tagid enroll` takes them.

    72 views at 20 dB, turned and moved by 2 to 6 mm, at the height of the recording that is to be read, in a
    room of its own, on a turntable as uneven as that of the recording where the tag is enrolled with the
    body. An object that carries no enrolled layout is enrolled with one.

    Raises:
        DataError: that layout's reflectors do not stand clear of its wall.
    """
    tagged = kind == "object"
    rng = _generator(cell, number)
    # As in the recording: the tag's reflectors are drawn first.
    made, _ = _standing(cell, rng)
    read = _acquisition(cell, rng)
    positions = np.zeros((0, 3))
    if tagged:
        fitting = _layouts_for(cell)
        positions = made.positions if made.name else in_space(fitting[number % len(fitting)])
    shown = _scene(made, "tagged" if tagged else "untagged", positions, rng)
    captures: list[Named] = []
    for off in (2e-3, 4e-3, 6e-3):
        place, turn = rng.uniform(0, 2 * np.pi, 2)
        acquisition = Acquisition(
            views=72,
            snr_db=20.0,
            placement=Placement((off * np.cos(place), off * np.sin(place)), turn, read.placement.height_m),
            wobble=read.wobble if tagged else Wobble(),
        )
        capture, _ = simulate_capture(shown, acquisition, int(rng.integers(2**32)))
        captures.append(Named(f"capture {len(captures) + 1}", aspect_spectra(capture)))
    return enroll_signature(captures, name, kind).signature


def _full_wave(cell: Cell, rng: np.random.Generator) -> Drawn:
    objects = FULL_WAVE[cell.group, cell.body]
    solved = sorted(objects)[int(rng.integers(len(objects)))]
    layouts, name = SETS[cell.enrolled], objects[solved]
    if name == "-":
        carried = FULL_WAVE["tagged", cell.body][solved]
        layouts, name = tuple(layout for layout in layouts if layout.name != carried), ""
    place, off = rng.uniform(0, 2 * np.pi), cell.offset_mm * 1e-3
    names = (*_measured_pulses(),)
    pulse = names[int(rng.integers(len(names)))]
    capture = recorded(
        solved,
        rng,
        complex(off * np.cos(place), off * np.sin(place)),
        views=cell.views,
        pulse=pulse if cell.pulse == "measured" else "gauss",
        snr_db=float(cell.snr_db),
        wobble=0.01,
        distance_error=rng.uniform(-0.015, 0.015),
    )
    return Drawn(capture, layouts, name)


def cells(worlds: tuple[str, ...]) -> list[Cell]:
    """The grid: tagged objects in full, the others at 36 views."""
    grid = []
    for world in worlds:
        for body in BODIES if world == "own" else FULL_WAVE_BODIES:
            every = product(OFFSETS_MM, SNRS_DB, VIEWS, PULSES)
            grid += [Cell(world, "tagged", "paper", body, *how) for how in every]
            grid += [
                Cell(world, group, "paper", body, *how)
                for group, *how in product(("foreign", "untagged"), (0, 6), (20, 10), (36,), PULSES)
                if world == "own" or (group, body) in FULL_WAVE
            ]
    if "own" in worlds:
        designed = (("helmet-16", "helmet"), ("mug-8", "cup"))
        every = product(designed, (0, 6), SNRS_DB)
        grid += [Cell("own", "tagged", *on, offset, snr, 36, "nominal") for on, offset, snr in every]
    return grid
