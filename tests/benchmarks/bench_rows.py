"""How often tags whose reflectors differ in height alone are told apart, from one and from several heights.

Run `python tests/benchmarks/bench_rows.py --write`. Every reading is appended to `--keep FILE` and not
repeated, so that a run can be stopped and continued.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from imaging_report import heading, table

from tagid.pipeline.identify import identify
from tagid.pipeline.join import join
from tagid.pipeline.prepared import prepare
from tagid.tags.layouts.layout import Layout
from tests.unit.imaging_scenes import record, turn

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results" / "rows.md"
RADIUS_M, ROW_M, VIEWS = 0.11, 0.06, 36
RECORDINGS = ((0.0,), (0.2,), (0.0, 0.05, 0.1), (0.0, 0.1, 0.2))
LEVELS_DB = (20, 10)
ASSIGNMENTS = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
"""Rows of the three reflectors of the enrolled layouts; the two with two reflectors up are left to
strangers."""
STRANGERS = ((1, 1, 0), (1, 0, 1), (0, 1, 1), (2, 0, 0))
TEXT = """{head}
Three reflectors at a radius of {radius:.0f} mm, {row:.0f} mm between two rows. Each seed draws the angles of
the reflectors (at least 60 degrees apart), the rotation, a shift within 6 mm, an elevation of the object
within 10 mm and amplitudes within 10 %. Four enrolled layouts have the same plan view: all reflectors below,
or one of the three above. {seeds} seeds per row of the table; {views} views per height at 1 m; SNR of one
sample at a reflector's peak. The unenrolled tags have two reflectors above, or one {twice:.0f} mm above:
naming one of them is an error.

"Foreign" tags are the unenrolled ones.

| antenna heights (m) | dB | named | ambiguous | refused | wrong name | foreign named | foreign ambiguous |
|---|---|---|---|---|---|---|---|
{rows}
"""


@dataclass(frozen=True)
class Job:
    """One reading.

    Attributes:
        seed: of the scene.
        heights: antenna heights, m.
        level_db: SNR.
        stranger: whether the tag is not enrolled.
    """

    seed: int
    heights: tuple[float, ...]
    level_db: int
    stranger: bool

    @property
    def key(self) -> str:
        return json.dumps(asdict(self))


def read(job: Job) -> str:
    """ "right", "wrong", or the status."""
    rng = np.random.default_rng([83, job.seed])
    while True:
        angle = np.sort(rng.uniform(0, 2 * np.pi, 3))
        if np.diff(np.append(angle, angle[0] + 2 * np.pi)).min() > np.pi / 3:
            break
    plan = RADIUS_M * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    layouts = [
        Layout(f"rows-{number}", plan, heights=ROW_M * np.array(rows, float))
        for number, rows in enumerate(ASSIGNMENTS)
    ]
    number = int(rng.integers(len(ASSIGNMENTS)))
    rows = STRANGERS[number] if job.stranger else ASSIGNMENTS[number]
    rotation, shift = rng.uniform(0, 2 * np.pi), rng.uniform(-1, 1, 2) * 0.006 / np.sqrt(2)
    raised, amplitudes = rng.uniform(-0.01, 0.01), rng.uniform(0.9, 1.1, 3)
    c, s = np.cos(rotation), np.sin(rotation)
    points = np.column_stack([plan @ np.array([[c, s], [-s, c]]) + shift, ROW_M * np.array(rows) + raised])
    noise = 10 ** (-job.level_db / 20)
    parts = [
        record(points, amplitudes, turn(VIEWS, 1.0, h), start_m=0.5, noise=noise, seed=1000 * job.seed + k)
        for k, h in enumerate(job.heights)
    ]
    reading = identify(prepare(join(parts) if len(parts) > 1 else parts[0]), layouts).reading
    assert reading is not None
    if reading.status != "identified":
        return reading.status
    return "right" if not job.stranger and reading.layout == f"rows-{number}" else "wrong"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    known: dict[str, str] = {}
    if given.keep and given.keep.exists():
        known = dict(json.loads(line) for line in given.keep.read_text().splitlines())
    jobs = [
        Job(seed, heights, level, stranger)
        for seed in range(given.seeds)
        for heights in RECORDINGS
        for level in LEVELS_DB
        for stranger in (False, True)
    ]
    for job in jobs:
        if job.key not in known:
            known[job.key] = read(job)
            if given.keep:
                with given.keep.open("a") as file:
                    file.write(json.dumps([job.key, known[job.key]]) + "\n")
    rows = []
    for heights in RECORDINGS:
        for level in LEVELS_DB:
            of = {
                stranger: [
                    known[job.key]
                    for job in jobs
                    if (job.heights, job.level_db, job.stranger) == (heights, level, stranger)
                ]
                for stranger in (False, True)
            }

            def share(stranger: bool, *words: str, of: dict[bool, list[str]] = of) -> str:
                return f"{sum(of[stranger].count(word) for word in words)} of {len(of[stranger])}"

            rows.append(
                [
                    ", ".join(f"{h:g}" for h in heights),
                    str(level),
                    share(False, "right"),
                    share(False, "ambiguous"),
                    share(False, "unknown", "no_tag"),
                    share(False, "wrong"),
                    share(True, "wrong"),
                    share(True, "ambiguous"),
                ]
            )
    text = TEXT.format(
        head=heading(
            "Tags in rows",
            f"python tests/benchmarks/bench_rows.py --seeds {given.seeds} --write",
            f"0 to {given.seeds - 1}",
        ),
        radius=1e3 * RADIUS_M,
        row=1e3 * ROW_M,
        twice=2e3 * ROW_M,
        seeds=given.seeds,
        views=VIEWS,
        rows=table(["x"] * 8, rows).split("\n", 2)[2].rstrip(),
    )
    print(text)
    if given.write:
        RESULTS.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
