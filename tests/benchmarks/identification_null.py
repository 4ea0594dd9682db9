"""Chance level: how well the enrolled layouts explain noise, boxes and unenrolled tags.

Run `python tests/benchmarks/identification_null.py --jobs 2` for the numbers that
`tagid/tags/reading/decision.py` rests on, `--short` for a check of a minute. Its seeds and its objects occur
in no other benchmark.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
from identification_scenes import SETS

from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.simulate.acquisition import Acquisition, Placement, Wobble
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import room_clutter, scene_from_layout, scene_from_name
from tagid.simulate.scattering import Box, Points
from tagid.simulate.scene import Scene
from tagid.tags.layouts.codebook import rotational_distance
from tagid.tags.layouts.layout import Layout, builtin_layouts
from tagid.tags.matching.matcher import read_tag
from tagid.tags.reading.decision import (
    DecisionSettings,
    Evidence,
    chance,
    decide,
    least_preference,
    preference,
)

FIRST_SEED = 90_000_000
GROUPS = ("unenrolled", "tagged", "box", "noise")
APART_M = 0.012
"""Unenrolled tags nearer than this, in RMS, are equivalent to the layout: enrolment calls them confusable."""


@dataclass(frozen=True)
class Sample:
    """One reading of an object without an enrolled tag, or with one."""

    group: str
    kind: str
    views: int
    status: str
    right: bool
    evidence: Evidence


def unenrolled(rng: np.random.Generator) -> np.ndarray:
    """(K, 2) two to five reflectors 40 mm or more apart, anywhere or on a ring, m; none of the enrolled."""
    while True:
        count, radius = int(rng.integers(2, 6)), rng.uniform(0.045, 0.12)
        points = rng.uniform(-radius, radius, (count, 2))
        if rng.uniform() < 0.5:
            angle = rng.uniform(0, 2 * np.pi, count)
            points = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        gap = np.linalg.norm(points[:, None] - points[None], axis=2) + np.eye(count)
        if gap.min() < 0.04:
            continue
        layout = Layout("unenrolled", points)
        same = [other for other in SETS["paper"] if other.size == count]
        if all(rotational_distance(layout, other).rms_m > APART_M for other in same):
            return points


def scene_of(group: str, rng: np.random.Generator, seed: int) -> tuple[Scene, str]:
    """What stands on the table, and its name or number of reflectors."""
    if group == "noise":
        return scene_from_name("empty", seed), "empty"
    if group == "box":
        width, depth = rng.uniform(0.06, 0.25, 2)
        box = Box(width, depth, rng.uniform(0.5, 3.0), rng.uniform(0.1, 0.8), rng.uniform(0.03, 0.2))
        return Scene("box", (replace(box, rotation_rad=rng.uniform(0, 6.28)),), room=room_clutter(rng)), "box"
    if group == "tagged":
        layout = list(builtin_layouts().values())[seed % 4]
        points, name = layout.positions, layout.name
    else:
        points = unenrolled(rng)
        name = str(len(points))
    scene = scene_from_layout(points, name, seed)
    if seed % 8 < 4 and scene.points is not None:
        # Half of them are darker or brighter behind than the simulator's usual reflectors.
        other = replace(
            scene.points, aspect_floor=rng.uniform(0, 1), aspect_width_rad=np.deg2rad(rng.uniform(100, 240))
        )
        scene = replace(scene, object=tuple(other if isinstance(b, Points) else b for b in scene.object))
    return scene, name


@dataclass(frozen=True)
class Task:
    """One scene of a group."""

    group: str
    number: int


def sample(task: Task) -> Sample:
    """One recording of a random number of views and noise, read."""
    group = task.group
    seed = FIRST_SEED + task.number
    rng = np.random.default_rng([seed, GROUPS.index(group)])
    scene, kind = scene_of(group, rng, seed)
    radius, turn = 0.01 * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
    views = int(rng.choice([12, 18, 24, 36]))
    # About 0.8 nats a view and reflector at 0 dB: from barely seen (8 nats) to clear (60).
    nats = np.exp(rng.uniform(np.log(8), np.log(60)))
    acquisition = Acquisition(
        views=views,
        noise_std=float(np.sqrt(0.8 * views / nats)),
        placement=Placement((radius * np.cos(turn), radius * np.sin(turn)), rng.uniform(0, 2 * np.pi)),
        wobble=Wobble(speed=0.01),
        axis_distance_error_m=rng.uniform(-0.015, 0.015),
    )
    capture, _ = simulate_capture(scene, acquisition, seed)
    scans = preprocess(capture, None, PreprocessSettings(matched_filter=False, extent_m=0.3))
    reading = read_tag(scans, SETS["paper"])
    return Sample(group, kind, views, reading.status, reading.nearest == kind, reading.evidence)


def passes(samples: list[Sample]) -> list[Evidence]:
    """Evidence of those that every test but the preference lets through."""
    certain = [replace(one.evidence, odds_nats=1e3) for one in samples]
    kept = [decide(e, DecisionSettings()).status == "identified" for e in certain]
    return [one.evidence for one, k in zip(samples, kept, strict=True) if k]


def _noise(e: Evidence) -> tuple[float, int, float, int]:
    return e.nats, e.size, e.places, e.scans


def report_noise(samples: list[Sample]) -> None:
    """How often noise beats the bound that the decision states for it."""
    print("Noise alone: share that is explained better than with the probability stated\n")
    print("| stated | scenes | share |\n|---|---|---|")
    for stated in (0.3, 0.1, 0.01):
        hits = sum(chance(*_noise(one.evidence)) <= stated for one in samples)
        print(f"| {stated:g} | {len(samples)} | {hits / len(samples):.4f} |")
    print()


def report_gain(kept: list[Evidence]) -> None:
    """What one point more explains of tags that are all there, by their energy."""
    print("Tags: nats that one point more explains (GAIN_NATS is the mode)\n")
    print("| nats of the tag | scenes | 5 % | median | 95 % |\n|---|---|---|---|---|")
    for low, high in ((10, 40), (40, 80), (80, 200)):
        gains = [e.gain_nats for e in kept if low <= e.noise_nats < high]
        if gains:
            cells = " | ".join(f"{q:.1f}" for q in np.quantile(gains, [0.05, 0.5, 0.95]))
            print(f"| {low} to {high} | {len(gains)} | {cells} |")
    print()


def report_preference(groups: dict[str, list[Sample]]) -> None:
    """How far the preference lies over what the default setting asks, as a share of all scenes."""
    margins = (-3, -2, -1, 0, 1, 2)
    print("Share of all scenes whose preference exceeds what false_accept = 0.001 asks by so many nats\n")
    head = " | ".join(f"{m:+d}" for m in margins)
    print(f"| group | nats a reflector | scenes | {head} |\n|" + "---|" * (3 + len(margins)))
    for name, samples in groups.items():
        for low, high in ((0, 16), (16, 25), (25, 100)):
            some = [s for s in samples if low <= s.evidence.noise_nats / s.evidence.size < high]
            over = [preference(e) - least_preference(e, 1e-3) for e in passes(some)]
            if some:
                cells = " | ".join(f"{sum(x > m for x in over) / len(some):.4f}" for m in margins)
                print(f"| {name} | {low} to {high} | {len(some)} | {cells} |")
    print(flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=2000, help="unenrolled tags; a quarter per other group")
    parser.add_argument("--short", action="store_true", help="80 unenrolled tags")
    parser.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args()
    scenes = 80 if arguments.short else arguments.scenes
    tasks = [Task(g, i) for g in GROUPS for i in range(scenes if g == "unenrolled" else scenes // 4)]
    with multiprocessing.get_context("fork").Pool(arguments.jobs) as pool:
        samples = list(pool.imap(sample, tasks, chunksize=4))
    groups = {g: [s for s in samples if s.group == g] for g in GROUPS}
    print(f"Command: `python {' '.join(sys.argv)}`\n")
    report_noise(groups["noise"])
    report_gain(passes([s for s in groups["tagged"] if s.right]))
    report_preference({name: groups[name] for name in ("unenrolled", "box", "tagged")})


if __name__ == "__main__":
    main()
