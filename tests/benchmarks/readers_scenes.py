"""Scenes of every yardstick of `readers.py`, of development seeds alone.

y1 is `bodies_scenes.py`, y2 `reading_bodies_scenes.py`, y3 `unseen_scenes.py` (opened objects), all without
enrollment; y2e is y2 with body or object enrolled, y4 `enrolled_scenes.py`, y5 `identification_scenes.py`
from number 1000 on, aside objects off the axis, null `train/population.py`, volume
`train/volume_objects.py`, on which nothing is chosen. y3 requires solved objects in SOLVED:
`solve --set unseen` makes them, in about half a minute each.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import product
from pathlib import Path

import numpy as np

from tagid.capture import Capture
from tagid.errors import TagidError
from tagid.pipeline.prepared import load_capture
from tagid.simulate import Placement, parse_body, parse_reflector
from tagid.simulate.acquisition import Acquisition
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import scene_on_body
from tagid.tags.bodies.signature import Signature, SignatureKind
from tagid.tags.layouts.layout import Layout, builtin_layouts
from tests.benchmarks import (
    bodies_scenes,
    enrolled_scenes,
    identification_scenes,
    reading_bodies_scenes,
    solved_objects,
    unseen_scenes,
)
from tests.benchmarks.fullwave_scenes import NAMES
from tests.benchmarks.provenance import ROOT
from tests.benchmarks.reading_bodies_scenes import Cell
from train import population, volume_objects

SOLVED = Path(os.environ.get("TAGID_SOLVED", ROOT / "build" / "unseen"))
BUILTIN = tuple(builtin_layouts().values())
FIRST_NULL, FIRST_READING_BODIES, FIRST_IDENTIFICATION, FIRST_ASIDE = 6_000_000, 500, 1000, 40
NULLS, DRAWN, VOLUMES = 300, 100, 60
"""Scenes per round."""
ASIDE: dict[str, tuple[str, ...]] = {
    "none": ("container-90", "container-180", "helmet-120", "helmet-linear"),
    "can:35mm": ("container-90", "container-180"),
    "can:30mm": ("container-90", "container-180"),
    "cup:40mm,handle": ("container-90", "container-180"),
    "box:120mm": ("container-90", "container-180"),
    "helmet": ("helmet-120", "helmet-linear"),
}
"""Bodies off the axis, and the tags on them."""
HARD = ((36, 10), (36, 0), (12, 10), (18, 0))
SEEDS = "of development alone (`tests/benchmarks/readers_scenes.py`)"
"""What the page says of them."""
READ = f"{enrolled_scenes.POPULATION}/read"


@dataclass(frozen=True, eq=False)
class Scene:
    """One recording: row of the table, the layout that it shows, what is enrolled.

    `truth` is None where nothing may be named; `alias` is the name of an enrolled object that is as right.
    """

    group: str
    truth: str | None
    layouts: Sequence[Layout]
    capture: Capture
    signatures: Sequence[Signature] = ()
    alias: str = ""


def _key(*parts: object) -> str:
    return "/".join(map(str, parts))


Draws = Iterator[tuple[str, Callable[[], Scene | None]]]
"""Keys with what makes their scenes: None if not solved, or an enrolled pair though drawn as foreign."""


def y1(turn: int) -> Draws:
    """Full-wave objects in every recording, others in some, and drawn foreign tags."""
    hows = bodies_scenes.RECORDINGS
    some = [(scene, how) for scene in bodies_scenes.TAGGED for how in hows]
    for i, scene in enumerate(bodies_scenes.UNNAMED):
        some += [(scene, how) for j, how in enumerate(hows) if (i + 3 * j + turn) % 6 == 0]
    for scene, how in some:
        angles = "" if scene.angles_deg is None else "@" + ",".join(f"{a:g}" for a in scene.angles_deg)
        yield f"y1/{scene.name}{angles}/{how.label}/{2 * turn}", partial(_fullwave, scene, how, 2 * turn)
    for number in range(DRAWN * turn, DRAWN * (turn + 1)):
        yield f"y1/drawn/{number}", partial(_fullwave, *bodies_scenes.drawn(number), number)


def _fullwave(scene: bodies_scenes.Scene, how: bodies_scenes.Recording, seed: int) -> Scene | None:
    if scene.is_enrolled_pair:
        return None
    return Scene(scene.group, scene.truth, BUILTIN, bodies_scenes.captured(scene, how, seed))


def _strata(worlds: tuple[str, ...], bodies: tuple[str, ...]) -> dict[tuple[str, ...], list[Cell]]:
    """Cells of moderate SNR and views by enrolled set, body and group, and by world of several."""
    strata: dict[tuple[str, ...], list[Cell]] = {}
    for cell in reading_bodies_scenes.cells(worlds):
        if cell.body in bodies and cell.snr_db in (20, 10, 5) and cell.views in (72, 36, 18):
            world = (cell.world,) if len(worlds) > 1 else ()
            strata.setdefault((*world, cell.enrolled, cell.body, cell.group), []).append(cell)
    return strata


def y2(turn: int) -> Draws:
    """A sample of the cells of every world, body and group."""
    at = FIRST_READING_BODIES + turn
    for stratum, cells in _strata(("own", "full-wave"), reading_bodies_scenes.BODIES).items():
        number = 5 if stratum[3] != "tagged" else 13 if stratum[1] == "paper" else 6
        for cell in random.Random(f"{turn}/{stratum}").sample(cells, number):
            yield _key("y2", *cell, at), partial(_reading_bodies, cell, at)


def y2e(turn: int) -> Draws:
    """A sample of the same with the body, or the whole object, enrolled from captures of its own."""
    at = FIRST_READING_BODIES + turn
    for stratum, cells in _strata(("own",), reading_bodies_scenes.BODIES[1:]).items():
        number = 8 if stratum[2] == "tagged" else 3
        for i, cell in enumerate(random.Random(f"{turn}/{stratum}").sample(cells, min(number, len(cells)))):
            kind = ("body", "object")[i % 2]
            yield _key("y2e", kind, *cell, at), partial(_known_body, cell, at, kind)


def _known_body(cell: Cell, number: int, kind: SignatureKind) -> Scene | None:
    scene = _reading_bodies(cell, number)
    name = "body" if kind == "body" else scene.truth or "another"
    try:
        signature = reading_bodies_scenes.signature_of(cell, number, name, kind)
    except TagidError:
        return None
    return replace(scene, group=f"{kind} enrolled, {cell.body}", signatures=(signature,))


def _reading_bodies(cell: Cell, number: int) -> Scene:
    drawn = reading_bodies_scenes.draw(cell, number)
    group = f"{cell.world}, {cell.body if cell.enrolled == 'paper' else cell.enrolled}"
    return Scene(group, drawn.name or None, drawn.layouts, drawn.capture)


def y3(turn: int) -> Draws:
    """Every opened object once, in another recording each round."""
    hows = unseen_scenes.RECORDINGS
    for i, name in enumerate(solved_objects.OPENED):
        how = hows[(3 * i + i // len(hows) + turn) % len(hows)]
        yield f"y3/{name}/{how.label}/{turn}", partial(_unseen, name, how, f"unseen/1/blind/{name}///{turn}")


def _unseen(name: str, how: unseen_scenes.Recording, circumstances: str) -> Scene | None:
    base, truth = unseen_scenes.base_of(name), unseen_scenes.truth_of(name) or None
    try:
        capture = unseen_scenes.recorded(SOLVED, name, how, circumstances)
    except TagidError:
        return None
    kind = "round body" if base in solved_objects.ROUND else base.rstrip("0123456789")
    return Scene(kind or "bare tag", truth, BUILTIN, capture)


def y4(turn: int) -> Draws:
    """Full-wave objects in two of eight places, each with bodies or objects enrolled; designed layouts."""
    positions = [*product(enrolled_scenes.OFFSETS_MM, enrolled_scenes.SNRS_DB)]
    every = enrolled_scenes.scenes(turn // 4)
    kinds = list(dict.fromkeys((s.part, s.solved) for s in every))
    for s in every:
        at = positions.index((s.offset_mm, s.snr_db)) - kinds.index((s.part, s.solved)) - turn
        # A tag of a layout on an object that is not enrolled is right and wrong at once.
        if at % 4 == 0 and (s.part == "body" or s.name or s.solved not in enrolled_scenes.ON_BODIES):
            yield _key("y4", *s), partial(_enrolled, s)
    for d in enrolled_scenes.designed_scenes()[turn % 9 :: 9]:
        yield _key("y4", "designed", *d), partial(_designed, d)


_enrolled_one = cache(enrolled_scenes.enrolled)
_enrolled_carrier = cache(enrolled_scenes.enrolled_carrier)


def _enrolled(s: enrolled_scenes.Scene) -> Scene:
    where = enrolled_scenes.Where(f"{READ}/{s.number}", s.snr_db, s.offset_mm, enrolled_scenes.VIEWS)
    whole = s.part == "object"
    known = enrolled_scenes.OBJECTS if whole else enrolled_scenes.BODIES
    signatures = [_enrolled_one(name, "object" if whole else "body") for name in known]
    tag = s.solved.split("+")[-1].split("-")[0].split("_")[1:]
    truth = NAMES[tag[0]] if s.name else None
    capture = enrolled_scenes.capture_of(s.solved, where)
    return Scene(f"{s.part} enrolled", truth, BUILTIN, capture, signatures, s.name * whole)


def _designed(d: enrolled_scenes.DesignedScene) -> Scene:
    carrier = enrolled_scenes.CARRIERS[d.carrier]
    where = enrolled_scenes.Where(f"{READ}/{d.number}", d.snr_db, d.offset_mm, enrolled_scenes.VIEWS)
    capture = enrolled_scenes.designed_capture(carrier, d.layout, d.size_mm, where)
    signatures = [_enrolled_carrier(i) for i in enrolled_scenes.ENROLLED[d.carrier]]
    return Scene(f"body enrolled, {carrier.name}", d.name or None, carrier.family, capture, signatures)


def y5(turn: int) -> Draws:
    """Bare tags, imperfect ones, tags that nobody enrolled, and objects without a tag."""
    made = identification_scenes.Condition
    cells = [(made("tagged", "paper", v, s), 3) for v in (360, 36, 18, 12) for s in (20, 10, 5, 0)]
    cells += [(made("tagged", "paper", 36, 10, twist), 3) for twist in identification_scenes.TWISTS]
    cells += [(made("tagged", few, v, 10), 3) for few in ("helmet-16", "mug-8") for v in (36, 12)]
    cells += [(made("unenrolled", "paper", v, s), 7) for v, s in HARD]
    cells += [(made("untagged", "paper", v, s), 4) for v, s in HARD]
    for i, (condition, count) in enumerate(cells):
        for j in range(count):
            number = FIRST_IDENTIFICATION + (5 * i + j + count * turn) % 100
            yield _key("y5", *condition, number), partial(_identification, condition, number)


def _identification(condition: identification_scenes.Condition, number: int) -> Scene:
    made, twist = identification_scenes.record(condition, number), condition.twist
    foreign = condition.group != "tagged" or twist.startswith("one reflector")
    group = twist or (condition.group if condition.enrolled == "paper" else condition.enrolled)
    layouts = identification_scenes.SETS[condition.enrolled]
    return Scene(group, None if foreign else made.name, layouts, made.capture)


def null(turn: int) -> Draws:
    """The population of objects without an enrolled tag."""
    for number in range(FIRST_NULL + NULLS * turn, FIRST_NULL + NULLS * (turn + 1)):
        yield f"null/{number}", partial(_null, number)


def _null(number: int) -> Scene | None:
    drawn = population.draw(number)
    return None if drawn.is_enrolled_pair else Scene(drawn.body, None, BUILTIN, drawn.capture)


def volume(turn: int) -> Draws:
    """Drawn objects of every body, solved by cells; no constant of the reader is chosen on them."""
    for seed in volume_objects.DEVELOPMENT[VOLUMES * turn : VOLUMES * (turn + 1)]:
        yield f"volume/{seed}", partial(_volume, seed)


def _volume(seed: int) -> Scene:
    drawn = volume_objects.draw(seed)
    return Scene(drawn.body, drawn.truth, BUILTIN, drawn.capture)


def aside(turn: int) -> Draws:
    """Simulated tags and strangers that stand 15 to 90 mm off the axis, with 72 views at 20 dB, 36 at 10."""
    seed = FIRST_ASIDE + turn
    for body, tags in ASIDE.items():
        for name, views in product((*tags, "points-3", "untagged"), (72, 36)):
            if body != "none" or name != "untagged":
                yield _key("aside", body, name, views, seed), partial(_aside, body, name, views, seed)


def _aside(body: str, name: str, views: int, seed: int) -> Scene | None:
    rng = np.random.default_rng([seed, views, *f"{body} {name}".encode()])
    first, second = (int(seed) for seed in rng.integers(2**31, size=2))
    try:
        scene = scene_on_body(name, parse_body(body), parse_reflector("octahedron:20mm"), first)
    except TagidError:  # a point inside the body
        return None
    place = rng.uniform(0.015, 0.09) * np.exp(2j * np.pi * rng.uniform())
    where = Placement((place.real, place.imag), 2 * np.pi * rng.uniform())
    snr_db = 20.0 if views > 36 else 10.0
    how = Acquisition(views=views, snr_db=snr_db, placement=where, range_law=True)
    capture, _ = simulate_capture(scene, how, seed=second)
    truth = name if name in builtin_layouts() else None
    return Scene("tagged" if truth else name, truth, BUILTIN, load_capture(capture))


YARDSTICKS: dict[str, Callable[[int], Draws]] = {
    work.__name__: work for work in (y1, y2, y2e, y3, y4, y5, aside, null, volume)
}


@cache
def drawn(yardstick: str, turn: int) -> dict[str, Callable[[], Scene | None]]:
    """Every scene of a round by its key, in an order drawn once."""
    some = list(YARDSTICKS[yardstick](turn))
    random.Random(f"{yardstick}/{turn}").shuffle(some)
    return dict(some)
