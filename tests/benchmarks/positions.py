"""Reflector positions: how accurately a recording tells them, how exactly to glue them; and SNR.

Accuracy: scenes are those of identification_scenes.py; "own echoes" adds what an object itself sends back
as it turns. Gluing: every reflector of a tag is moved by the same distance, each in a random direction of
its own; the layout is enrolled with its marks; layouts are the built-in ones, bare and on the body that
they are for, and a designed set. SNR: `tagid plan` against scans of the emulated radar, as `tagid show`
compares them; cases are drawn at random from a grid, and each is recorded over 1.3 turns, as `tagid scan`
does.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np

from tagid.enrolling.averaging import position_covariances
from tagid.enrolling.field import MatchedField
from tagid.enrolling.reflectors import refine_positions
from tagid.geometry import ImageGrid
from tagid.imaging.autofocus import focus_axis_distance
from tagid.motion.turntable import OVERLAP_TURNS
from tagid.planning.plan import Setup, planned_snr_db
from tagid.radar.settings import RadarConfig
from tagid.reading.views import fold_views
from tagid.recording.plan import plan_window
from tagid.signal import analytic, noise_power_of, snr_db
from tagid.simulate import (
    Acquisition,
    Placement,
    ReflectorSpec,
    Wobble,
    parse_body,
    simulate_capture,
)
from tagid.simulate.budget import LinkBudget
from tagid.simulate.presets import scene_on_body
from tagid.simulate.scattering import Cylinder, Points
from tagid.simulate.scene import Scene
from tagid.simulate.spec import SceneSpec, turning_scene
from tagid.tags.layouts.codebook import best_pairing
from tagid.tags.layouts.design import DesignRules, design
from tagid.tags.layouts.layout import Layout, builtin_layouts
from tagid.tags.layouts.objects import builtin_objects
from tests.benchmarks.identification_scenes import FIRST_SEED, Condition, draw_scene, outcome_of, record_scene
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table, column, grouped, rms

LAYOUTS = builtin_layouts()
CONDITIONS = ((36, 20), (36, 10), (36, 0), (12, 10))
ENROLLED = ("helmet-16", "mug-8")
RADIUS_M = 0.18


def with_own_echoes(scene: Scene, rng: np.random.Generator) -> Scene:
    """The scene with a shell up to 6 mm off the tag's middle, a handle and a rim in place of its own shell.

    The handle is a point of 0.1 to 0.5 of a reflector 20 to 40 mm outside the shell, the rim an arc of 20 to
    60 degrees of points of 0.03 to 0.15 each on it.
    """
    radius = max(0.02, float(np.linalg.norm(scene.points.positions[:, :2], axis=1).max()) - 0.02)
    off, turn = rng.uniform(0, 0.006), rng.uniform(0, 2 * np.pi)
    shell = Cylinder(radius, 0.5, (off * np.cos(turn), off * np.sin(turn)))
    at, out = rng.uniform(0, 2 * np.pi), radius + rng.uniform(0.02, 0.04)
    handle = Points(np.array([[out * np.cos(at), out * np.sin(at)]]), np.array([rng.uniform(0.1, 0.5)]))
    arc = rng.uniform(0, 2 * np.pi) + np.linspace(0, np.deg2rad(rng.uniform(20, 60)), 7)
    rim = Points(radius * np.stack([np.cos(arc), np.sin(arc)], axis=-1), np.full(7, rng.uniform(0.03, 0.15)))
    kept = tuple(body for body in scene.object if not isinstance(body, Cylinder))
    return replace(scene, object=(*kept, shell, handle, rim))


class Recording(NamedTuple):
    """The so many-th recording of a numbered object of a set of layouts, whose body may echo, too."""

    enrolled: str
    own_echoes: bool
    views: int
    snr_db: int
    number: int
    again: int = 0


def errors(recording: Recording) -> dict[str, list[list[float]]]:
    """Errors (K, 2), m, of reflectors: after fitting turn and place ("made"), and as the scans tell them."""
    condition = Condition("tagged", recording.enrolled, recording.views, recording.snr_db)
    scene, name = draw_scene(condition, recording.number)
    if recording.own_echoes:
        scene = with_own_echoes(scene, np.random.default_rng([FIRST_SEED + recording.number, 2]))
    recorded = record_scene(scene, name, condition, recording.number + 1000 * recording.again)
    scans, _ = focus_axis_distance(recorded.scans, ImageGrid(0.5, 128), 0.03)
    field = MatchedField(fold_views(scans, RADIUS_M), RADIUS_M)
    refined_spots, _ = refine_positions(field, recorded.positions[:, :2])
    object_frame = scene.points.positions[:, :2]
    pair = best_pairing(refined_spots, object_frame)
    c, s = np.cos(pair.rotation_rad), np.sin(pair.rotation_rad)
    turned = refined_spots @ np.array([[c, s], [-s, c]]) + pair.shift_m
    remaining = np.empty_like(refined_spots)
    remaining[pair.partner] = turned - object_frame[pair.partner]
    covariances = position_covariances(field, refined_spots)
    told = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    return {"made": remaining.tolist(), "told": told.tolist()}


def accuracy(run: Run) -> Iterator[Table]:
    """A row for every kind of object, views and SNR; then objects that are recorded again."""
    scenes = run.number(200, 8)
    run.seeds = f"{FIRST_SEED} on, one per scene"
    rows = []
    conditions = CONDITIONS[1:2] if run.quick else CONDITIONS
    for enrolled, echoes, (views, snr) in product(ENROLLED, (False, True), conditions):
        tasks = [Recording(enrolled, echoes, views, snr, i) for i in range(scenes)]
        results = [*run.each(errors, tasks).values()]
        made = column(results, "made")
        # 2 K coordinates less turn and shift leave 2 K - 3.
        lost = made.size / (made.size - 3 * len(made))
        most = 1e3 * np.quantile(np.abs(made), 0.95) * np.sqrt(lost)
        what = "shell off the axis, handle, rim" if echoes else "none"
        shown = (1e3 * rms(made) * np.sqrt(lost), most, 1e3 * rms(column(results, "told")))
        rows.append((enrolled, what, views, snr, *(f"{value:.2f}" for value in shown)))
    columns = "object | own echoes | views | SNR dB | error mm | within 95 % mm | told by the scans mm"
    yield Table(columns, rows, f"{scenes} scenes per row.")
    # Part of the error with body echoes that is unchanged when the object is repositioned.
    again, scenes, repeated = 4, scenes // 4, []
    for enrolled in ENROLLED:
        tasks = [Recording(enrolled, True, 36, 20, i, n) for i in range(scenes) for n in range(again)]
        made = column(run.each(errors, tasks).values(), "made")
        made = made.reshape(scenes, again, *made.shape[1:])
        mean = made.mean(axis=1, keepdims=True)
        scatter = np.mean((made - mean) ** 2) * again / (again - 1)
        same = np.mean(mean**2) - scatter / again
        cells = [f"{1e3 * np.sqrt(max(value, 0)):.2f}" for value in (np.mean(made**2), same, scatter)]
        repeated.append((enrolled, *cells))
    note = f"{scenes} objects of each kind with own echoes, recorded {again} times at 36 views and 20 dB."
    yield Table("object | error mm | same in all mm | scatter mm", repeated, note)


FIRST_GLUED = 62_000
DISTANCES_MM = (1, 2)
VIEWS, SNR_DB = 36, 20.0
DESIGNED = 4
"""Layouts of the designed set."""
NOTE = """Every reflector of a tag is off its mark by the distance above the column, each in a random
direction: tags that were named of {count}. {views} views, {snr:g} dB, octahedra of 40 mm, up to 4 mm off the
axis, 0.5 % of wobble; no body is enrolled. The designed layouts are {designed} of 3 reflectors on a
helmet, enrolled without others of their kind. {wrong}"""


@cache
def designed() -> dict[str, Layout]:
    family = design(builtin_objects()["helmet"], DesignRules(), DESIGNED, "designed")
    return {layout.name: layout for layout in family.layouts}


def reading(job: tuple[int, str, str, int]) -> dict[str, str]:
    """The outcome of a tag, of its number, layout, body, and the distance in mm: named, wrong or refused."""
    number, name, body, distance_mm = job
    enrolled = LAYOUTS if name in LAYOUTS else designed()
    rng = np.random.default_rng([FIRST_GLUED, number])
    layout = enrolled[name]
    turn = rng.uniform(0, 2 * math.pi, layout.size)
    moved = layout.positions + distance_mm * 1e-3 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    glued = replace(layout, positions=moved, symmetry=0)
    seed = FIRST_GLUED + number
    reflector = ReflectorSpec("octahedron", 0.04)
    scene = scene_on_body(name, parse_body(body), reflector, seed, layouts={name: glued})
    off, turn = 0.004 * math.sqrt(rng.uniform()), rng.uniform(0, 2 * math.pi)
    placement = Placement((off * math.cos(turn), off * math.sin(turn)), rng.uniform(0, 2 * math.pi))
    acquisition = Acquisition(views=VIEWS, snr_db=SNR_DB, placement=placement, wobble=Wobble(speed=0.005))
    capture, _ = simulate_capture(scene, acquisition, seed)
    return {"outcome": outcome_of(capture, list(enrolled.values()), name)}


def names(run: Run) -> Iterator[Table]:
    numbers = run.drawn(20, first=FIRST_GLUED)
    bodies = {name: "helmet" if name.startswith("helmet") else "can:35mm" for name in LAYOUTS}
    tags = [*((name, "none") for name in (*bodies, *designed())), *bodies.items()]
    shown = tags[: 1 if run.quick else None]
    jobs = [(n, *tag, d) for n in range(len(numbers)) for tag in shown for d in DISTANCES_MM]
    results = run.each(reading, jobs)
    outcomes = grouped(results, lambda job: job[1:])
    rows = [
        (*tag, *(sum(item["outcome"] == "named" for item in outcomes[*tag, d]) for d in DISTANCES_MM))
        for tag in shown
    ]
    wrong = sum(item["outcome"] == "wrong" for item in results.values())
    said = "None was given a wrong name." if not wrong else f"{wrong} were given a wrong name."
    columns = ("layout", "body", *(f"{distance} mm" for distance in DISTANCES_MM))
    note = NOTE.format(count=len(numbers), views=VIEWS, snr=SNR_DB, designed=DESIGNED, wrong=said)
    yield Table(columns, rows, note)


PLANNED = (
    ("container-180", "none"),
    ("container-90", "can:35mm"),
    ("container-90", "cup:40mm"),
    ("container-180", "cup:40mm,handle"),
    ("helmet-120", "none"),
    ("helmet-120", "helmet"),
    ("helmet-linear", "helmet"),
)
SIZES_MM = (20, 25, 30, 40, 50)
DISTANCES_M = (0.7, 1.0, 1.5, 2.0, 2.5)
INDICES = (9, 10, 11, 12, 13)
SEED = 8
"""Of the drawn cases and of their scenes."""
SCANS_PER_TURN = 100
PERIOD_S = 10.0


class Case(NamedTuple):
    """A setup of the grid and the seed of its emulated scene."""

    layout: str
    body: str
    size_mm: int
    distance_m: float
    integration: int
    seed: int

    def planned_db(self) -> float:
        reflector = ReflectorSpec("octahedron", self.size_mm * 1e-3)
        where = (
            parse_body(self.body),
            self.distance_m,
            60 / PERIOD_S,
            LinkBudget(integration=self.integration),
        )
        return planned_snr_db(Setup(LAYOUTS[self.layout], reflector, *where))

    def measured_db(self) -> float | None:
        """Of the emulated scans; None where nothing changes beyond the noise."""
        spec = SceneSpec(
            self.layout,
            reflector=f"octahedron:{self.size_mm}mm",
            axis_distance=self.distance_m,
            budget=True,
            rpm=60 / PERIOD_S,
            seed=self.seed,
            body=self.body,
        )
        source = turning_scene(spec)
        radar = RadarConfig(base_integration_index=self.integration)
        config = plan_window(self.distance_m, 0.5, 0.0, radar)
        times = np.arange(round(OVERLAP_TURNS * SCANS_PER_TURN)) / SCANS_PER_TURN * PERIOD_S
        signal = analytic(np.stack([source.scan(i, float(t), config) for i, t in enumerate(times)]))
        return snr_db(signal, noise_power_of(signal))[0]


def level(planned_db: float) -> str:
    return next((f"below {top} dB" for top in (5, 15, 25, 35) if planned_db < top), "35 dB and more")


def differences(run: Run) -> Iterator[Table]:
    count = run.number(80, 6)
    run.seeds = f"{SEED} for the {count} cases drawn, one scene of its own per case"
    grid = list(product(PLANNED, SIZES_MM, DISTANCES_M, INDICES))
    differences: dict[str, list[float]] = defaultdict(list)
    unseen = []
    for number in np.random.default_rng(SEED).choice(len(grid), count, replace=False):
        (layout, body), *how = grid[int(number)]
        case = Case(layout, body, *how, 1000 * SEED + int(number))
        planned, measured = case.planned_db(), case.measured_db()
        if measured is None:
            unseen.append(planned)
            continue
        for row in (layout + (f" on {body}" if body != "none" else ""), level(planned), "all"):
            differences[row].append(measured - planned)
        run.say(f"{case}: planned {planned:.1f}, measured {measured:.1f} dB")
    rows = []
    for row, result in sorted(differences.items()):
        within = f"{sum(abs(value) <= 1 for value in result)} of {len(result)}"
        rows.append((row, len(result), f"{np.mean(result):+.2f}", f"{max(result, key=abs):+.2f}", within))
    planned_db = sorted(round(x, 1) for x in unseen)
    below = f"Nothing beyond the noise in {len(unseen)} cases, planned {planned_db} dB."
    yield Table("cases | number | mean (dB) | largest (dB) | within 1 dB", rows, below=below)
