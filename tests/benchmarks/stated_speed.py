"""Stated speeds that are wrong: which are contradicted by the scans, and with which number.

Tags that repeat within a turn (two, three times) and tags that do not, bare and on bodies, at 10 rpm and 5 to
20 dB; the stated speed is a quarter to three times the true one, the recording 1.3 turns at the stated speed,
or 1.35 or 2.2 true turns. The same recordings with the right speed are a check of false alarms.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tagid.errors import TagidError
from tagid.metadata import ResolvedMotion
from tagid.pipeline.turn import resolve_turn
from tagid.simulate import Acquisition, ReflectorSpec, parse_body, scene_on_body, simulate_capture
from tagid.tags.layouts.design import DesignRules, design
from tagid.tags.layouts.layout import builtin_layouts
from tagid.tags.layouts.objects import object_named
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

MUGS = {
    layout.name: layout
    for layout in design(object_named("mug").with_rows(1), DesignRules(3, 12, 0.04), 4, "mug").layouts
}
LAYOUTS = {**MUGS, **builtin_layouts()}
OBJECTS = (
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
        """A random case."""
        layout, body = OBJECTS[rng.integers(len(OBJECTS))]
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
    """What the user is told."""
    if resolved is None:
        return "refused"
    if not resolved.shown_rpms:
        return "not contradicted"
    right = any(abs(rpm / TRUE_RPM - 1) < 0.03 for rpm in resolved.shown_rpms)
    if len(resolved.shown_rpms) == 1:
        return f"contradicted by {'the true speed' if right else 'one false speed'}"
    return f"contradicted by several{', the true one among them' if right else ' false ones'}"


def contradicted(run: Run) -> Iterator[Table]:
    """What the user is told of wrong and of right speeds."""
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
