"""Accuracy of reflector positions measured in one recording.

Run `python tests/benchmarks/localisation.py` for what docs/results/localisation.md shows,
`--short` for a check.
Scenes are those of identification_scenes.py; "own echoes" adds what an object itself sends back as it turns.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import platform
import sys
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from multiprocessing.pool import Pool
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # train/ is not installed

import numpy as np
from identification_scenes import FIRST_SEED, Condition, Recorded, draw_scene, record_scene

from tagid.enrolling.averaging import position_covariances
from tagid.geometry import ImageGrid
from tagid.imaging.autofocus import focus_axis_distance
from tagid.simulate.scattering import Cylinder, Points
from tagid.simulate.scene import Scene
from tagid.tags.layouts.codebook import best_pairing
from tagid.tags.reading.field import MatchedField
from tagid.tags.reading.reflectors import refine_positions
from tagid.tags.reading.views import fold_views

CONDITIONS = ((36, 20), (36, 10), (36, 0), (12, 10))
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


@dataclass(frozen=True)
class Recording:
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


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors (K, 2), m, of K reflectors: after fitting turn and place, and as the scans tell them."""

    made: np.ndarray
    told: np.ndarray


def errors(one: Recording) -> Errors:
    """The errors of the reflectors' places in one recording."""
    condition = Condition("tagged", one.enrolled, one.views, one.snr_db)
    scene, name = draw_scene(condition, one.number)
    if one.own_echoes:
        scene = with_own_echoes(scene, np.random.default_rng([FIRST_SEED + one.number, 2]))
    recorded: Recorded = record_scene(scene, name, condition, one.number + 1000 * one.again)
    scans, _ = focus_axis_distance(recorded.scans, ImageGrid(0.5, 128), 0.03)
    field = MatchedField(fold_views(scans, RADIUS_M), RADIUS_M)
    truth = recorded.positions[:, :2]
    found, _ = refine_positions(field, truth)
    assert scene.points is not None
    object_frame = scene.points.positions[:, :2]
    pair = best_pairing(found, object_frame)
    c, s = np.cos(pair.rotation_rad), np.sin(pair.rotation_rad)
    left = np.empty_like(found)
    left[pair.partner] = found @ np.array([[c, s], [-s, c]]) + pair.shift_m - object_frame[pair.partner]
    told = position_covariances(field, found)
    return Errors(left, np.sqrt(np.diagonal(told, axis1=1, axis2=2)))


def repeated(pool: Pool, scenes: int, repeats: int = 4) -> None:
    """Part of the error with body echoes that is unchanged when the object is repositioned."""
    print(f"\nOwn echoes, 36 views, 20 dB, every object recorded {repeats} times\n")
    print("| object | error mm | same in all mm | scatter mm |")
    print("|---|---|---|---|")
    for enrolled in ("helmet-16", "mug-8"):
        tasks = [
            Recording(enrolled, True, 36, 20, i, again) for i in range(scenes) for again in range(repeats)
        ]
        made = np.array([one.made for one in pool.imap(errors, tasks, 4)])
        made = made.reshape(scenes, repeats, *made.shape[1:])
        mean = made.mean(axis=1, keepdims=True)
        scatter = np.mean((made - mean) ** 2) * repeats / (repeats - 1)
        same = np.mean(mean**2) - scatter / repeats
        cells = [f"{1e3 * np.sqrt(max(value, 0)):.2f}" for value in (np.mean(made**2), same, scatter)]
        print(f"| {enrolled} | {' | '.join(cells)} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=160, help="scenes a row")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--short", action="store_true", help="16 scenes a row")
    arguments = parser.parse_args()
    scenes = 16 if arguments.short else arguments.scenes
    print(
        f"Machine: {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, "
        f"numpy {np.__version__}. Date: {datetime.now(UTC):%Y-%m-%d}."
    )
    print(f"Command: `python {' '.join(sys.argv)}`; {scenes} scenes a row, one seed each.\n")
    print("| object | own echoes | views | SNR dB | error mm | within 95 % | told by the scans mm |")
    print("|---|---|---|---|---|---|---|")
    with multiprocessing.get_context("fork").Pool(arguments.jobs) as pool:
        for enrolled in ("helmet-16", "mug-8"):
            for echoes in (False, True):
                for views, snr in CONDITIONS:
                    tasks = [Recording(enrolled, echoes, views, snr, i) for i in range(scenes)]
                    found = list(pool.imap(errors, tasks, 4))
                    made = np.array([one.made for one in found])
                    told = np.array([one.told for one in found])
                    # 2 K coordinates less turn and shift leave 2 K - 3.
                    lost = made.size / (made.size - 3 * len(made))
                    rms = 1e3 * np.sqrt(np.mean(made**2) * lost)
                    most = 1e3 * np.quantile(np.abs(made), 0.95) * np.sqrt(lost)
                    row = (enrolled, "shell off the axis, handle, rim" if echoes else "none", views, snr)
                    print(f"| {' | '.join(map(str, row))} | {rms:.2f} | {most:.2f} | ", end="")
                    print(f"{1e3 * np.sqrt(np.mean(told**2)):.2f} |", flush=True)
        repeated(pool, scenes // 4)


if __name__ == "__main__":
    main()
