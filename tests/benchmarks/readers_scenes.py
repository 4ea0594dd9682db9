"""Scenes of every yardstick of `readers.py`, of development seeds alone.

y1 is `bodies_scenes.py`, y2 `reading_bodies_scenes.py`, y3 `unseen_scenes.py` (opened objects), all without
enrollment; y2e is y2 with body or object enrolled, y4 `enrolled_scenes.py`, y5 `identification_scenes.py`
from number 1000 on, null `train/population.py`, volume `train/volume_objects.py`, on which nothing is
chosen. y3 requires solved objects in SOLVED: `solve --set unseen` makes them, in about half a minute each.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

from tagid.capture import Capture
from tagid.errors import TagidError
from tagid.pipeline.identify import aspect_spectra
from tagid.tags.bodies.joint import Named, enroll_signature
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
from train import population, volume_objects

ROOT = Path(__file__).resolve().parents[2]
SOLVED = Path(os.environ.get("TAGID_SOLVED", ROOT / "build" / "unseen"))
BUILTIN = tuple(builtin_layouts().values())
FIRST_NULL, FIRST_READING_BODIES, FIRST_IDENTIFICATION = 6_000_000, 500, 1000
NULLS, DRAWN, VOLUMES = 300, 100, 60
"""Scenes per round."""
HARD = ((36, 10), (36, 0), (12, 10), (18, 0))
SEEDS = "of development alone (`tests/benchmarks/readers_scenes.py`)"
"""What the page says of them."""
READ = f"{enrolled_scenes.POPULATION}/read"


@dataclass(frozen=True, eq=False)
class Scene:
    """One recording: what it shows, what is enrolled, and the layout that it carries.

    `truth` is None where nothing may be named; `alias` is the name of an enrolled object that is as right.
    """

    key: str
    group: str
    body: str
    truth: str | None
    layouts: Sequence[Layout]
    capture: Capture
    signatures: Sequence[Signature] = ()
    alias: str = ""


Draws = Iterator[tuple[str, Callable[[], Scene | None]]]
"""Keys with what makes their scenes: None if not solved, or an enrolled pair though drawn as foreign."""


def y1(turn: int) -> Draws:
    """Full-wave objects in every recording, others in some, and drawn foreign tags."""
    hows = bodies_scenes.RECORDINGS
    some = [(scene, how) for scene in bodies_scenes.tagged() for how in hows]
    for i, scene in enumerate(bodies_scenes.unnamed()):
        some += [(scene, how) for j, how in enumerate(hows) if (i + 3 * j + turn) % 6 == 0]
    for scene, how in some:
        angles = "" if scene.angles_deg is None else "@" + ",".join(f"{a:g}" for a in scene.angles_deg)
        key = f"y1/{scene.name}{angles}/{how.label}/{2 * turn}"
        yield key, partial(_fullwave, key, scene, how, 2 * turn)
    for number in range(DRAWN * turn, DRAWN * (turn + 1)):
        yield (
            f"y1/drawn/{number}",
            partial(_fullwave, f"y1/drawn/{number}", *bodies_scenes.drawn(number), number),
        )


def _fullwave(key: str, scene: bodies_scenes.Scene, how: bodies_scenes.Recording, seed: int) -> Scene | None:
    base = scene.name.split("_")[0]
    body = "none" if base.startswith("free") else base
    if scene.is_enrolled_pair:
        return None
    return Scene(key, scene.group, body, scene.truth, BUILTIN, bodies_scenes.captured(scene, how, seed))


def y2(turn: int) -> Draws:
    """A sample of the cells of every world, body and group."""
    strata: dict[tuple[str, ...], list[reading_bodies_scenes.Cell]] = {}
    for cell in reading_bodies_scenes.cells(("own", "full-wave")):
        if cell.snr_db in (20, 10, 5) and cell.views in (72, 36, 18):
            strata.setdefault((cell.world, cell.enrolled, cell.body, cell.group), []).append(cell)
    for stratum, cells in strata.items():
        number = 5 if stratum[3] != "tagged" else 13 if stratum[1] == "paper" else 6
        for cell in random.Random(f"{turn}/{stratum}").sample(cells, number):
            key = "/".join(map(str, ("y2", *cell, FIRST_READING_BODIES + turn)))
            yield key, partial(_reading_bodies, key, cell, FIRST_READING_BODIES + turn)


def y2e(turn: int) -> Draws:
    """A sample of the same with the body, or the whole object, enrolled from captures of its own."""
    strata: dict[tuple[str, ...], list[reading_bodies_scenes.Cell]] = {}
    for cell in reading_bodies_scenes.cells(("own",)):
        if cell.body != "none" and cell.snr_db in (20, 10, 5) and cell.views in (72, 36, 18):
            strata.setdefault((cell.enrolled, cell.body, cell.group), []).append(cell)
    for stratum, cells in strata.items():
        number = 8 if stratum[2] == "tagged" else 3
        for i, cell in enumerate(random.Random(f"{turn}/{stratum}").sample(cells, min(number, len(cells)))):
            kind = ("body", "object")[i % 2]
            key = "/".join(map(str, ("y2e", kind, *cell, FIRST_READING_BODIES + turn)))
            yield key, partial(_known_body, key, cell, FIRST_READING_BODIES + turn, kind)


def _known_body(key: str, cell: reading_bodies_scenes.Cell, number: int, kind: SignatureKind) -> Scene | None:
    scene = _reading_bodies(key, cell, number)
    name = "body" if kind == "body" else scene.truth or "another"
    try:
        shown = reading_bodies_scenes.enrolment_captures(cell, number, tagged=kind == "object")
        captures = [Named(f"capture {i + 1}", aspect_spectra(capture)) for i, capture in enumerate(shown)]
        signature = enroll_signature(captures, name, kind).signature
    except TagidError:
        return None
    return replace(scene, group=f"{kind} enrolled, {cell.body}", signatures=(signature,))


def _reading_bodies(key: str, cell: reading_bodies_scenes.Cell, number: int) -> Scene:
    drawn = reading_bodies_scenes.draw(cell, number)
    group = f"{cell.world}, {cell.body if cell.enrolled == 'paper' else cell.enrolled}"
    return Scene(key, group, cell.body, drawn.name or None, drawn.layouts, drawn.capture)


def y3(turn: int) -> Draws:
    """Every opened object once, in another recording each round."""
    hows = unseen_scenes.RECORDINGS
    for i, name in enumerate(solved_objects.OPENED):
        how = hows[(3 * i + i // len(hows) + turn) % len(hows)]
        key = f"y3/{name}/{how.label}/{turn}"
        yield key, partial(_unseen, key, name, how, f"unseen/1/blind/{name}///{turn}")


def _unseen(key: str, name: str, how: unseen_scenes.Recording, circumstances: str) -> Scene | None:
    base, truth = unseen_scenes.base_of(name), unseen_scenes.truth_of(name) or None
    try:
        capture = unseen_scenes.recorded(SOLVED, name, how, circumstances)
    except TagidError:
        return None
    kind = "round body" if base in solved_objects.ROUND else base.rstrip("0123456789")
    return Scene(key, kind or "bare tag", base or "none", truth, BUILTIN, capture)


def y4(turn: int) -> Draws:
    """Full-wave objects in two of eight places, each with bodies or objects enrolled; designed layouts."""
    positions = [(o, s) for o in enrolled_scenes.OFFSETS_MM for s in enrolled_scenes.SNRS_DB]
    every = enrolled_scenes.scenes(turn // 4)
    kinds = list(dict.fromkeys((s.part, s.solved) for s in every))
    for s in every:
        at = positions.index((s.offset_mm, s.snr_db)) - kinds.index((s.part, s.solved)) - turn
        # A tag of a layout on an object that is not enrolled is right and wrong at once.
        if at % 4 == 0 and (s.part == "body" or s.name or s.solved not in enrolled_scenes.ON_BODIES):
            key = "/".join(map(str, ("y4", *s)))
            yield key, partial(_enrolled, key, s)
    for d in enrolled_scenes.designed_scenes()[turn % 9 :: 9]:
        key = "/".join(map(str, ("y4", "designed", *d)))
        yield key, partial(_designed, key, d)


@cache
def _signature(part: str, which: Any) -> Signature:
    if part == "designed":
        return enrolled_scenes.enrolled_carrier(which)
    return enrolled_scenes.enrolled(which, "object" if part == "object" else "body")


def _enrolled(key: str, s: enrolled_scenes.Scene) -> Scene:
    where = enrolled_scenes.Where(f"{READ}/{s.number}", s.snr_db, s.offset_mm, enrolled_scenes.VIEWS)
    whole = s.part == "object"
    known = enrolled_scenes.OBJECTS if whole else enrolled_scenes.BODIES
    tag = s.solved.split("+")[-1].split("-")[0].split("_")[1:]
    truth = bodies_scenes.NAMES[tag[0]] if s.name else None
    capture = enrolled_scenes.capture_of(s.solved, where)
    signatures = [_signature(s.part, name) for name in known]
    group = f"{s.part} enrolled"
    body = enrolled_scenes.HANDLE if s.solved.startswith(enrolled_scenes.HANDLE) else s.solved.split("_")[0]
    return Scene(key, group, body, truth, BUILTIN, capture, signatures, s.name * whole)


def _designed(key: str, d: enrolled_scenes.DesignedScene) -> Scene:
    carrier = enrolled_scenes.CARRIERS[d.carrier]
    where = enrolled_scenes.Where(f"{READ}/{d.number}", d.snr_db, d.offset_mm, enrolled_scenes.VIEWS)
    capture = enrolled_scenes.designed_capture(carrier, d.layout, d.size_mm, where)
    signatures = [_signature("designed", i) for i in enrolled_scenes.ENROLLED[d.carrier]]
    group = f"body enrolled, {carrier.name}"
    return Scene(key, group, carrier.body, d.name or None, carrier.family, capture, signatures)


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
            key = "/".join(map(str, ("y5", *condition, number)))
            yield key, partial(_identification, key, condition, number)


def _identification(key: str, condition: identification_scenes.Condition, number: int) -> Scene:
    made, twist = identification_scenes.record(condition, number), condition.twist
    foreign = condition.group != "tagged" or twist.startswith("one reflector")
    body = made.name if condition.group == "untagged" else "none"
    group = twist or (condition.group if condition.enrolled == "paper" else condition.enrolled)
    layouts = identification_scenes.SETS[condition.enrolled]
    return Scene(key, group, body, None if foreign else made.name, layouts, made.capture)


def null(turn: int) -> Draws:
    """The population of objects without an enrolled tag."""
    for number in range(FIRST_NULL + NULLS * turn, FIRST_NULL + NULLS * (turn + 1)):
        yield f"null/{number}", partial(_null, f"null/{number}", number)


def _null(key: str, number: int) -> Scene | None:
    drawn = population.draw(number)
    return (
        None if drawn.is_enrolled_pair else Scene(key, drawn.body, drawn.body, None, BUILTIN, drawn.capture)
    )


def volume(turn: int) -> Draws:
    """Drawn objects of every body, solved by cells; no constant of the reader is chosen on them."""
    for seed in volume_objects.DEVELOPMENT[VOLUMES * turn : VOLUMES * (turn + 1)]:
        yield f"volume/{seed}", partial(_volume, f"volume/{seed}", seed)


def _volume(key: str, seed: int) -> Scene:
    drawn = volume_objects.draw(seed)
    return Scene(key, drawn.body, drawn.body, drawn.truth, BUILTIN, drawn.capture)


YARDSTICKS: dict[str, Callable[[int], Draws]] = {
    work.__name__: work for work in (y1, y2, y2e, y3, y4, y5, null, volume)
}


@cache
def drawn(yardstick: str, turn: int) -> dict[str, Callable[[], Scene | None]]:
    """Every scene of a round by its key, in an order drawn once."""
    some = list(YARDSTICKS[yardstick](turn))
    random.Random(f"{yardstick}/{turn}").shuffle(some)
    return dict(some)
