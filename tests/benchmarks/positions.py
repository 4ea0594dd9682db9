"""Accuracy of reflector positions measured in one recording.

Scenes are those of identification_scenes.py; "own echoes" adds what an object itself sends back as it turns.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from tagid.enrolling.averaging import position_covariances
from tagid.enrolling.field import MatchedField
from tagid.enrolling.reflectors import refine_positions
from tagid.geometry import ImageGrid
from tagid.imaging.autofocus import focus_axis_distance
from tagid.reading.views import fold_views
from tagid.simulate.scattering import Cylinder, Points
from tagid.simulate.scene import Scene
from tagid.tags.layouts.codebook import best_pairing
from tests.benchmarks.identification_scenes import FIRST_SEED, Condition, draw_scene, record_scene
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table, column, rms

CONDITIONS = ((36, 20), (36, 10), (36, 0), (12, 10))
OBJECTS = ("helmet-16", "mug-8")
RADIUS_M = 0.18


def with_own_echoes(scene: Scene, rng: np.random.Generator) -> Scene:
    """The scene with a shell up to 6 mm off the tag's middle, a handle and a rim in place of its own shell.

    The handle is a point of 0.1 to 0.5 of a reflector 20 to 40 mm outside the shell, the rim an arc of 20 to
    60 degrees of points of 0.03 to 0.15 each on it.
    """
    assert scene.points is not None
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
    """A recording of one object.

    Attributes:
        enrolled: the set of layouts that the object is drawn from.
        own_echoes: whether its body echoes, too.
        views, snr_db: of the recording.
        number: of the object.
        again: of the recording of that object, from 0.
    """

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
    assert scene.points is not None
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
    for enrolled, echoes, (views, snr) in product(OBJECTS, (False, True), conditions):
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
    for enrolled in OBJECTS:
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
