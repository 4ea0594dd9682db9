"""How much of a turn `tagid scan --until-sure` needs, and how often it gives a false name.

It reads the scans at 45, 60 and 75 % of the turn, and ends the scan when two successive looks name the same
layout without a body, with a lead that at most a share of 0.3 of `tags.false_accept` of turns without an
enrolled tag reaches anywhere in the turn (`tagid/reading/ending.json`). Otherwise the whole turn is recorded,
and its name has the rest of the error. Nothing is chosen on these turns.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from tagid.capture import Capture
from tagid.pipeline.identify import reader_settings
from tagid.pipeline.prepared import PreparedCapture
from tagid.pipeline.settings import ImagingSettings
from tagid.reading.ending import EndingCalibration
from tagid.reading.looks import LOOKS, SPENT, Look, agreed, largest, look, part_of_turn
from tagid.reading.reader import read
from tagid.reading.reading import Reading
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import room_clutter, scene_from_layout, scene_from_name
from tagid.simulate.scattering import Box, Points
from tagid.simulate.scene import Scene
from tagid.tags.layouts.layout import Layout
from tests.benchmarks import reading_bodies_scenes as bodies
from tests.benchmarks.identification_scenes import (
    SETS,
    Condition,
    drawn_acquisition,
    is_foreign,
    least_gap_m,
    record,
)
from tests.benchmarks.provenance import ROOT
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table, grouped, share
from train.population import draw

CALIBRATE, REPORT = 2_000_000, 3_000_000
"""First numbers of the turns of the shipped calibration, and of those of the table."""
KINDS = (
    *("population",) * 6,
    *("unenrolled", "unenrolled", "box", "noise"),
    *("other tags", "untagged"),
    *("own foreign", "own foreign", "own untagged", "own untagged"),
    *("full-wave foreign", "full-wave foreign", "full-wave untagged", "full-wave untagged"),
)
"""Kinds of null turns, each as often as it is listed."""
STATEMENT = (
    "simulated objects without an enrolled tag, of every kind that the reader is evaluated on: unenrolled "
    "tags, bodies and boxes with and without reflectors, hands, cables, noise, and full-wave responses of "
    "cans, helmet shells and reflectors; 36 or 72 views per turn, 0 to 30 dB; 4 or 16 layouts enrolled; half "
    "of them with a wrong scale of the angle (standard deviation 3 %)"
)
VIEWS = (36, 36, 36, 36, 36, 36, 36, 36, 36, 72)
DESIGNED = 0.05
"""Share of null turns with 16 designed layouts enrolled; more names are compared there."""
SCALE_SIGMA = 0.03
"""Of the angle: the slip of a robot whose wheel base is calibrated, or a stated speed that is not exact."""
NULL_SNRS_DB = (0.0, 5.0, 10.0, 20.0, 30.0)
_POPULATION_OFFSET = 40_000_000
_SCENE_OFFSET = 10_000_000


class Turn(NamedTuple):
    """A whole turn: as recorded, with angles; the enrolled layouts; the right name, if any; its kind."""

    capture: Capture
    layouts: Sequence[Layout]
    name: str
    kind: str


def null_turn(at: int) -> Turn:
    """The null turn of a number; kind, views, SNR and registry are drawn from it."""
    rng = np.random.default_rng([at, 15])
    kind = KINDS[at % len(KINDS)]
    views, snr_db = int(rng.choice(VIEWS)), float(rng.choice(NULL_SNRS_DB))
    enrolled = "helmet-16" if rng.uniform() < DESIGNED else "paper"
    layouts: Sequence[Layout] = SETS[enrolled]
    if kind == "population":
        capture = draw(_POPULATION_OFFSET + at, views=views, snr_db=snr_db).capture
    elif kind in ("unenrolled", "box", "noise"):
        scene = scene_of(kind, rng, _SCENE_OFFSET + at)
        capture, _ = simulate_capture(scene, drawn_acquisition(rng, views, snr_db), _SCENE_OFFSET + at)
    elif kind in ("other tags", "untagged"):
        condition = Condition("untagged" if kind == "untagged" else "unenrolled", "paper", views, snr_db)
        capture = record(condition, at).capture
    else:
        world, group = kind.split(" ")
        if world == "full-wave":
            # An object may carry a layout of the paper's, which its registry then lacks.
            enrolled = "paper"
        known = bodies.BODIES if world == "own" else bodies.FULL_WAVE_BODIES
        body = str(rng.choice([b for b in known if world == "own" or (group, b) in bodies.FULL_WAVE]))
        offset_mm, pulse = int(rng.choice(bodies.OFFSETS_MM)), str(rng.choice(bodies.PULSES))
        cell = bodies.Cell(world, group, enrolled, body, offset_mm, int(snr_db), views, pulse)
        capture, layouts, _ = bodies.draw(cell, at)
    scale = 1 + SCALE_SIGMA * float(np.random.default_rng([at, 16]).standard_normal())
    return Turn(scaled(capture, scale if at // len(KINDS) % 2 else 1.0), layouts, "", kind)


def scaled(capture: Capture, scale: float) -> Capture:
    """The capture as a device would record it whose angles are too large by a factor."""
    return replace(capture, angles_rad=capture.angles_rad * scale)


def unenrolled(rng: np.random.Generator) -> np.ndarray:
    """(K, 2) two to five reflectors 40 mm or more apart, anywhere or on a ring, m; none of the enrolled."""
    while True:
        count, radius = int(rng.integers(2, 6)), rng.uniform(0.045, 0.12)
        points = rng.uniform(-radius, radius, (count, 2))
        if rng.uniform() < 0.5:
            angle = rng.uniform(0, 2 * np.pi, count)
            points = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        if least_gap_m(points) >= 0.04 and is_foreign(points, SETS["paper"]):
            return points


def scene_of(group: str, rng: np.random.Generator, seed: int) -> Scene:
    """What stands on the table: "noise" alone, a "box", or an "unenrolled" tag."""
    if group == "noise":
        return scene_from_name("empty", seed)
    if group == "box":
        width, depth = rng.uniform(0.06, 0.25, 2)
        box = Box(width, depth, rng.uniform(0.5, 3.0), rng.uniform(0.1, 0.8), rng.uniform(0.03, 0.2))
        return Scene("box", (replace(box, rotation_rad=rng.uniform(0, 6.28)),), room=room_clutter(rng))
    points = unenrolled(rng)
    scene = scene_from_layout(points, str(len(points)), seed)
    if seed % 8 < 4 and scene.points is not None:
        # Half of them are darker or brighter behind than the simulator's usual reflectors.
        other = replace(
            scene.points, aspect_floor=rng.uniform(0, 1), aspect_width_rad=np.deg2rad(rng.uniform(100, 240))
        )
        scene = replace(scene, object=tuple(other if isinstance(b, Points) else b for b in scene.object))
    return scene


def tagged_turn(at: int, enrolled: str, snr_db: float, scale: float) -> Turn:
    """A tag without a body, layouts in turn, as `identification_scenes` records it at 36 views per turn."""
    recorded = record(Condition("tagged", enrolled, 36, snr_db), at)
    return Turn(scaled(recorded.capture, scale), SETS[enrolled], recorded.name, "tagged")


def tagged_body_turn(number: int, world: str, body: str, snr_db: float) -> Turn:
    """A tag on a body, from our simulator ("own") or full-wave responses ("full-wave")."""
    offset = bodies.OFFSETS_MM[number % len(bodies.OFFSETS_MM)]
    cell = bodies.Cell(world, "tagged", "paper", body, offset, int(snr_db), 36, bodies.PULSES[number % 2])
    return Turn(*bodies.draw(cell, REPORT + number), f"{world} {body}")


CALIBRATION = ROOT / "tagid" / "reading" / "ending.json"
FALSE_ACCEPT = 1e-3
FEWEST_VIEWS = 32
"""Views per turn that a scan needs: those of the calibration, less the error of their angle."""
FIRST_REPORTED = REPORT + 2000
"""Null turns of the report below this were seen when the looks were changed."""
SNRS_DB = (20.0, 10.0, 5.0)
SCALES = (0.95, 0.97, 1.03, 1.05)
ON_BODIES = (
    *(("own", body) for body in ("none", "can", "cup", "helmet")),
    *(("full-wave", body) for body in ("none", "can", "helmet")),
)
Row = dict[str, Any]


class Tagged(NamedTuple):
    """A turn with a tag: alone, from a set of layouts, with angles wrong by a factor, or on a body."""

    number: int
    group: str
    snr_db: float
    enrolled: str = "paper"
    scale: float = 1.0
    world: str = ""
    body: str = ""


def look_at(turn: Turn, part: float) -> Look:
    """The look at a turn after a part of it."""
    return look(part_of_turn(turn.capture, part), turn.layouts, part)


def _looks(row: Row) -> list[Look]:
    return [Look(**item) for item in row["looks"]]


def read_null(task: tuple[int]) -> Row:
    """The looks at a null turn. Both pairs of looks contain the middle one, which often decides alone."""
    turn = null_turn(*task)
    looks, score = [look_at(turn, LOOKS[1])], -math.inf
    if looks[0].layout is not None:
        looks = [look_at(turn, LOOKS[0]), *looks, look_at(turn, LOOKS[2])]
        score = largest(looks)
    return {"kind": turn.kind, "looks": [*map(asdict, looks)], "largest": score}


def whole_turn(turn: Turn, spent: float) -> Reading:
    """What the reader says after the whole turn, where early looks have spent a share of the error."""
    settings = ImagingSettings(false_accept=FALSE_ACCEPT)
    scans = PreparedCapture(turn.capture, settings).scans(settings.preprocessing(False))
    return read(scans, turn.layouts, reader_settings(settings, spent))


def read_tagged(task: Tagged) -> Row:
    """All looks at a turn with a tag, and the whole turn."""
    if task.body:
        turn = tagged_body_turn(task.number, task.world, task.body, task.snr_db)
    else:
        turn = tagged_turn(REPORT + task.number, task.enrolled, task.snr_db, task.scale)
    looks = [look_at(turn, part) for part in LOOKS]
    every = whole_turn(turn, 0.0)
    rest = whole_turn(turn, SPENT) if every.status == "identified" else every
    answers = {key: [item.status, item.layout] for key, item in (("rest", rest), ("whole", every))}
    return {"name": turn.name, "looks": [*map(asdict, looks)], **answers}


def ending(row: Row, calibration: EndingCalibration) -> tuple[float, str | None]:
    """Share of the turn after which two looks agree and the calibration allows an ending, by the rule of
    `tagid.live.sure`, and the layout that they name; 1 and None for the whole turn."""
    looks = _looks(row)
    for count in range(2, len(looks) + 1):
        layout, bound = agreed(looks[:count])[0], calibration.bound(looks[:count], FALSE_ACCEPT)
        if layout is not None and bound.reachable and bound.kept:
            return LOOKS[count - 1], layout
    return 1.0, None


def null_table(rows: Sequence[Row], calibration: EndingCalibration) -> Table:
    lines = []
    for kind in (*sorted({row["kind"] for row in rows}), "all"):
        some = [row for row in rows if kind in (row["kind"], "all")]
        named = sum(row["looks"][len(row["looks"]) // 2]["layout"] is not None for row in some)
        ends = sum(ending(row, calibration)[0] < 1 for row in some)
        lines.append((kind, len(some), share(named, len(some)), share(ends, len(some))))
    scores = ", ".join(f"{score:.1f}" for score in calibration.scores[:8]) or "none"
    note = (
        f"{str(__doc__).split(chr(10) * 2, 1)[1].strip()}\n\nThe calibration holds {calibration.turns} turns "
        f"(numbers {calibration.seeds[0]} to {calibration.seeds[1] - 1}): {calibration.population}. "
        f"{len(calibration.scores)} of them were named at two successive looks, with leads of {scores} "
        f"nats. Per cent with 95 % Wilson intervals.\n\nTurns without an enrolled tag; ended early: the "
        f"scan would have ended with a name."
    )
    return Table("object | turns | named at one look | ended early", lines, note)


def tag_table(rows: dict[Tagged, Row], calibration: EndingCalibration) -> Table:
    lines = []
    for group, some in grouped(rows, lambda task: task.group).items():
        ends = [ending(row, calibration) for row in some]
        shares = np.array([part for part, _ in ends])
        cells = [share(int((shares < 1).sum()), len(some))]
        cells += [f"{np.quantile(shares, q, method='higher'):.2f}" for q in (0.5, 0.9)]
        early = [
            ("identified", layout) if part < 1 else row["rest"]
            for (part, layout), row in zip(ends, some, strict=True)
        ]
        for answers in (early, [row["whole"] for row in some]):
            named = [
                layout == row["name"]
                for (status, layout), row in zip(answers, some, strict=True)
                if status == "identified"
            ]
            right = sum(named)
            cells += [share(right, len(some)), str(len(named) - right), str(len(some) - len(named))]
        lines.append((group, len(some), *cells))
    columns = (
        "turns with a tag | turns | ended early | share of the turn, median | 90 % | correct | wrong | "
        "refused | whole turn: correct | wrong | refused"
    )
    note = (
        "Bare tags of two sets of layouts by SNR (36 views per turn; `identification_scenes.py`), with "
        "angles that are wrong by a factor (10 dB; `tagid scan` corrects them by the repetition of the "
        "scans after a whole turn), and on bodies (20 and 10 dB, 0 to 10 mm off the axis). Names on a body "
        "have no calibration for a part of a turn, so such scans run the whole turn."
    )
    return Table(columns, lines, note)


def tagged(count: int) -> list[Tagged]:
    numbers = range(count)
    sets = ("paper", "helmet-16")
    tasks = [Tagged(n, f"{e}, {snr:g} dB", snr, e) for e, snr, n in product(sets, SNRS_DB, numbers)]
    tasks += [
        Tagged(n, f"angles {100 * (scale - 1):+.0f} %", 10.0, scale=scale)
        for scale, n in product(SCALES, numbers)
    ]
    return tasks + [
        Tagged(n, f"{world} {body}", snr, world=world, body=body)
        for (world, body), snr, n in product(ON_BODIES, SNRS_DB[:2], numbers)
    ]


def _nulls(run: Run, first: int) -> tuple[range, list[Row]]:
    """Numbers of null turns, and the looks at them."""
    numbers = range(first, first + (20 if run.quick else 2000))
    return numbers, [*run.each(read_null, [(number,) for number in numbers]).values()]


def endings(run: Run) -> Iterator[Table]:
    calibration, count = EndingCalibration.shipped(), run.number(14)
    numbers, rows = _nulls(run, FIRST_REPORTED)
    run.seeds = f"{numbers[0]} to {numbers[-1]} without a tag, {REPORT} to {REPORT + count - 1} with one"
    yield null_table(rows, calibration)
    yield tag_table(run.each(read_tagged, tagged(count)[:: 6 if run.quick else 1]), calibration)


def calibrate(run: Run) -> Iterator[Table]:
    numbers, rows = _nulls(run, CALIBRATE)
    run.seeds = f"{numbers[0]} to {numbers[-1]}"
    scores = sorted((row["largest"] for row in rows if math.isfinite(row["largest"])), reverse=True)
    span = (numbers.start, numbers.stop)
    made = EndingCalibration(STATEMENT, span, LOOKS, FEWEST_VIEWS, len(rows), tuple(scores))
    if run.pictures:
        CALIBRATION.write_text(made.to_json())
        run.say(f"{CALIBRATION.relative_to(ROOT)} written")
    cells = (len(rows), len(scores), scores[:10])
    yield Table("turns | named at two successive looks | leads, nats", [cells])
