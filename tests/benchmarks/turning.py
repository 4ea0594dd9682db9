"""Stated speeds that are wrong, and turns that stop half-way: what the scans tell of them.

Stated speeds: tags that repeat within a turn (two, three times) and tags that do not, bare and on bodies,
at 10 rpm and 5 to 20 dB; the stated speed is a quarter to three times the true one, the recording 1.3 turns
at the stated speed, or 1.35 or 2.2 true turns. The same recordings with the right speed are a check of
false alarms.

Stops: every preset, tags and bare bodies of `tagid.simulate`, and the full-wave responses of cans, helmet
shells and reflectors, each up to about 1 cm off the axis. SNR 20, 10 and 5 dB per reflector. Turning
objects are recorded over 1.25 to 1.4 turns, a third of them over a part of a turn only (as seen while it is
being recorded), with a told speed that is up to 13 % wrong. Stopped ones stop at 0.25, 0.5, 0.75 and 0.9 of
a turn for good, or go on after 0.3 of a turn. A stop counts as found within 0.04 turns.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from tagid.angles.period import NOMINAL_TOLERANCE
from tagid.angles.standstill import find_standstill
from tagid.errors import TagidError
from tagid.metadata import ResolvedMotion
from tagid.pipeline.turn import resolve_turn
from tagid.simulate import (
    Acquisition,
    Placement,
    ReflectorSpec,
    parse_body,
    parse_reflector,
    scene_on_body,
    simulate_capture,
)
from tagid.simulate.presets import scene_from_name
from tagid.tags.layouts.design import DesignRules, design
from tagid.tags.layouts.layout import builtin_layouts
from tagid.tags.layouts.objects import object_named
from tests.benchmarks.fullwave_scenes import full_wave, single_of
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

MUGS = {
    layout.name: layout
    for layout in design(object_named("mug").with_rows(1), DesignRules(3, 12, 0.04), 4, "mug").layouts
}
LAYOUTS = {**MUGS, **builtin_layouts()}
TURNED = (
    *((name, "none") for name in ("mug-01", "mug-02", "mug-03", "mug-04")),
    *(("container-180", "can:35mm"), ("helmet-120", "helmet"), ("helmet-linear", "helmet")),
    *(("container-180", "cup:40mm"), ("helmet-120", "none"), ("container-180", "none")),
    ("helmet-linear", "none"),
)
RATIOS = (0.25, 0.33, 0.4, 0.5, 0.6, 0.75, 1.25, 1.5, 2.0, 3.0)
TRUE_RPM = 10.0
SEED = 50
"""Of the drawn cases."""
SCANS_PER_TURN = 150


class Case(NamedTuple):
    """A recording and the ratio of the stated speed to the true one."""

    layout: str
    body: str
    seed: int
    ratio: float
    snr_db: float
    turns: float

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Case:
        layout, body = TURNED[rng.integers(len(TURNED))]
        seed, ratio = int(rng.integers(1e6)), float(rng.choice(RATIOS))
        snr_db = float(rng.choice([5, 10, 15, 20]))
        return cls(layout, body, seed, ratio, snr_db, float(rng.choice([1.3 / ratio, 1.35, 2.2])))

    def resolved(self, ratio: float) -> ResolvedMotion | None:
        """The motion of the recording with a stated speed; None where it cannot be resolved."""
        views = max(int(SCANS_PER_TURN * self.turns), 40)
        acquisition = Acquisition(views=views, turns=self.turns, snr_db=self.snr_db, period_s=60 / TRUE_RPM)
        reflector = ReflectorSpec("octahedron", 0.04)
        scene = scene_on_body(self.layout, parse_body(self.body), reflector, self.seed, layouts=LAYOUTS)
        capture, _ = simulate_capture(scene, acquisition, self.seed)
        bare = replace(capture, angles_rad=None, angle_sigma_rad=None)
        try:
            return resolve_turn(bare, f"free?rpm={TRUE_RPM * ratio}").motion.resolved
        except TagidError:
            return None


def outcome(resolved: ResolvedMotion | None) -> str:
    if resolved is None:
        return "refused"
    if not resolved.shown_rpms:
        return "not contradicted"
    right = any(abs(rpm / TRUE_RPM - 1) < 0.03 for rpm in resolved.shown_rpms)
    if len(resolved.shown_rpms) == 1:
        return f"contradicted by {'the true speed' if right else 'one false speed'}"
    return f"contradicted by several{', the true one among them' if right else ' false ones'}"


def contradicted(run: Run) -> Iterator[Table]:
    count = run.number(160, 6)
    run.seeds = f"{SEED}, {count} cases"
    rng = np.random.default_rng(SEED)
    wrong: Counter[str] = Counter()
    right: Counter[str] = Counter()
    for _ in range(count):
        case = Case.drawn(rng)
        wrong[outcome(case.resolved(case.ratio))] += 1
        if case.turns >= 1.3:
            right[outcome(case.resolved(1.0))] += 1
    rows = [
        (reported, f"{wrong[reported]} of {wrong.total()}", f"{right[reported]} of {right.total()}")
        for reported in sorted(wrong | right)
    ]
    yield Table("told to the user | wrong speed stated | right speed stated", rows)


FINE = 720
"""Views per turn from which a recording is interpolated."""
FIRST_SEED = 7000
SNRS_DB = (20, 10, 5)
STOPS = (0.25, 0.5, 0.75, 0.9)
PAUSES = {"stops": math.inf, "goes on": 0.3}
TURNS, SCANS = 1.3, 468
RESULTS = ("right", "elsewhere", "none")
NEAR = 0.04
PRESETS = (
    *("container-90", "container-180", "helmet-120", "helmet-linear", "points-1", "points-3", "points-6"),
    *("can", "box", "corner", "empty", "untagged"),
)
BODIES = (
    ("container-90", "can:28mm"),
    ("container-180", "cup:33mm,wall=4mm"),
    ("helmet-120", "helmet:100mm"),
    ("untagged", "cup:33mm,wall=4mm,handle"),
    ("untagged", "can:33mm,seam"),
)
SOLVED = (
    *("can35", "can35_one", "can35_c90", "can35_handle", "can28", "can28_one", "can28_c180"),
    *("shell", "shell_h120_20", "shell_h120_40", "free40_one", "free20_c90", "free40_h120"),
)


class Clean(NamedTuple):
    """One turn without noise, (FINE, bins), and the standard deviation of the noise of one sample at 0 dB."""

    samples: np.ndarray
    noise_std: float

    def recorded(self, turns: np.ndarray, snr_db: float, rng: np.random.Generator) -> np.ndarray:
        """(scans, bins) float32 at these turns."""
        place = turns % 1 * FINE
        low = np.floor(place).astype(int)
        share = (place - low)[:, None]
        echo = (1 - share) * self.samples[low % FINE] + share * self.samples[(low + 1) % FINE]
        noise = self.noise_std * 10 ** (-snr_db / 20) * rng.standard_normal(echo.shape)
        return np.asarray(echo + noise, dtype=np.float32)


def objects() -> list[str]:
    bodies = [f"{name} on {body}" for name, body in BODIES]
    return [*PRESETS, *bodies, *(f"full-wave {name}" for name in SOLVED)]


def clean(name: str, seed: int) -> Clean:
    rng = np.random.default_rng([seed, 77])
    x, y = 0.006 * rng.standard_normal(2)
    if name.startswith("full-wave "):
        solved = name.removeprefix("full-wave ")
        scan, _ = full_wave().make(
            solved, rng, reference=single_of(solved), views=FINE, centre=(x / 2, y / 2), snr_db=300.0
        )
        return Clean(scan["samples"].astype(float), 1000 / math.sqrt(2))
    tag, on, body = name.partition(" on ")
    scene = (
        scene_on_body(tag, parse_body(body), parse_reflector("octahedron"), seed)
        if on
        else scene_from_name(tag, seed)
    )
    placement = Placement((float(x), float(y)), float(rng.uniform(0, 6.28)))
    _, truth = simulate_capture(scene, Acquisition(views=FINE, snr_db=0.0, placement=placement), seed)
    return Clean(truth.clean, truth.noise_std)


def imagined(turn: Clean, snr_db: float, rng: np.random.Generator) -> bool:
    """Whether a stop is found in an object that turns."""
    turns = rng.uniform(1.25, 1.4) if rng.uniform() < 2 / 3 else rng.uniform(0.4, 1.2)
    reported = np.linspace(0, turns, round(SCANS * turns / TURNS), endpoint=False)
    true = rng.uniform() + reported * rng.uniform(0.87, 1.13)
    return find_standstill(turn.recorded(true, snr_db, rng), reported, NOMINAL_TOLERANCE) is not None


def found(turn: Clean, stop: float, pause: float, snr_db: float, rng: np.random.Generator) -> str:
    """ "right", "elsewhere" or "none"."""
    reported = np.linspace(0, TURNS, SCANS, endpoint=False)
    true = np.where(reported < stop, reported, np.maximum(stop, reported - pause))
    still = find_standstill(turn.recorded(rng.uniform() + true, snr_db, rng), reported, NOMINAL_TOLERANCE)
    if still is None:
        return "none"
    ends = [still.first / SCANS * TURNS - stop, still.stop / SCANS * TURNS - min(TURNS, stop + pause)]
    return "right" if np.abs(ends).max() < NEAR else "elsewhere"


def stops(run: Run) -> Iterator[Table]:
    seeds = run.drawn(4, first=FIRST_SEED)
    run.seeds += " (constants were chosen on 10 to 17)"
    turning: Counter[tuple[int, bool]] = Counter()
    stopped: Counter[tuple[str, int, float, str]] = Counter()
    for name, seed in product(PRESETS[:3] if run.quick else objects(), seeds):
        turn = clean(name, seed)
        rngs = np.random.default_rng([seed, 5]), np.random.default_rng([seed, 5])
        for snr_db in SNRS_DB:
            wrong = imagined(turn, snr_db, rngs[0])
            turning[snr_db, wrong] += 1
            if wrong:
                run.say(f"imagined: {name}, seed {seed}, {snr_db} dB")
            for (what, pause), stop in product(PAUSES.items(), STOPS) if name != "empty" else ():
                stopped[what, snr_db, stop, found(turn, stop, pause, snr_db, rngs[1])] += 1
    rows = [(snr, turning[snr, True] + turning[snr, False], turning[snr, True]) for snr in SNRS_DB]
    yield Table("SNR, dB | turning objects | a stop was reported", rows)
    lines = []
    for what, snr in product(PAUSES, SNRS_DB):
        counts = [[stopped[what, snr, stop, result] for result in RESULTS] for stop in STOPS]
        lines.append((what, snr, *(f"{c[0]} / {c[1]} / {sum(c)}" for c in counts)))
    note = "Turning objects that stop at a part of the turn. Cells: right / elsewhere / all."
    yield Table(("the table", "SNR, dB", *map(str, STOPS)), lines, note)
