"""Planned against measured SNR: `tagid plan` and scans of the emulated radar, as `tagid show` compares them.

Cases are drawn at random from a grid of reflectors, layouts on bodies, distances and integrations. Each is
recorded from the emulator's scans over 1.3 turns, as `tagid scan` does, and inspected as `tagid show` does.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np

from tagid.motion.turntable import OVERLAP_TURNS
from tagid.planning.plan import Setup, planned_snr_db
from tagid.radar.settings import RadarConfig
from tagid.recording.plan import plan_window
from tagid.signal import analytic, noise_power_of, snr_db
from tagid.simulate import ReflectorSpec, parse_body
from tagid.simulate.budget import LinkBudget
from tagid.simulate.spec import SceneSpec, turning_scene
from tagid.tags.layouts.layout import builtin_layouts
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

LAYOUTS = builtin_layouts()
OBJECTS = (
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
        """By `tagid plan`."""
        reflector, budget = (
            ReflectorSpec("octahedron", self.size_mm * 1e-3),
            LinkBudget(integration=self.integration),
        )
        where = (parse_body(self.body), self.distance_m, 60 / PERIOD_S, budget)
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
    """The row of the table to which a case belongs."""
    return next((f"below {top} dB" for top in (5, 15, 25, 35) if planned_db < top), "35 dB and more")


def differences(run: Run) -> Iterator[Table]:
    """Measured less planned SNR, by object and by planned SNR."""
    count = run.number(80, 6)
    run.seeds = f"{SEED} for the {count} cases drawn, one scene of its own per case"
    grid = list(product(OBJECTS, SIZES_MM, DISTANCES_M, INDICES))
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
