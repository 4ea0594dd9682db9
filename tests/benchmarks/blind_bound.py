"""Tags on cans and cups whose wall nobody states: what is left to tell them from other arrangements by.

The scenes are those of `reading_bodies` at 36 views, recorded at 40 dB, where hardly any noise is left. R is
the energy by which the best other arrangement of alike reflectors, beside its own wall, about its own centre
and with its own amplitudes, leaves more than the tag's layout does, in variances of the noise; at S dB it is
10^((S - 40) / 10) of that at 40 dB. It is taken from the reader's own search, beside a wall of known waves or
with a free pattern, whichever tells more. A reader that has to choose between the tag and that arrangement
alone, at a false-accept setting of 0.1 %, names the tag with the probability

    Phi(sqrt(2 R) - 3.09),

because two echoes that differ by an energy R are sqrt(2 R) standard deviations apart. More arrangements, and
a search that misses the best of them, make the share that can be named smaller than that; walls that fit the
scene closer than the reader's family of them would make R larger.

    python tests/benchmarks/blind_bound.py --jobs 2 --write docs/results
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from statistics import NormalDist

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import reading_bodies_scenes as scenes
from own_bound import spectra
from provenance import page, publish
from reading_bodies_scenes import Cell

from tagid.tags.bodies.body_reading import BodySettings
from tagid.tags.bodies.on_body import read_on_body
from tagid.tags.matching.beside import read_beside_wall

QUIET_DB = 40
BODIES = ("can", "cup")
FIRST = 960
NORMAL = NormalDist()
FALSE_ACCEPT = 1e-3


@dataclass(frozen=True)
class Apart:
    """What tells a tag from the best other arrangement: R at QUIET_DB; 0 where another layout fits better."""

    body: str
    variances: float

    def named(self, snr_db: float) -> float:
        """Probability with which a reader names it, at most."""
        energy = self.variances * 10 ** ((snr_db - QUIET_DB) / 10)
        return NORMAL.cdf(float(np.sqrt(2 * energy)) - NORMAL.inv_cdf(1 - FALSE_ACCEPT))


def apart(cell: Cell, number: int) -> Apart:
    """R in one scene."""
    drawn = scenes.draw(replace(cell, snr_db=QUIET_DB), "development", number)
    seen, settings, layouts = spectra(drawn.capture), BodySettings(), list(drawn.layouts)
    first = read_on_body(seen, layouts, settings.body, settings)
    if first is None:
        return Apart(cell.body, 0.0)
    found = [first, read_beside_wall(first, None, layouts, settings)]
    told = [
        one.lead * one.error / one.variance
        for one in found
        if one is not None and one.layouts[0].layout == drawn.name
    ]
    return Apart(cell.body, max([0.0, *told]))


def document(found: list[Apart]) -> list[str]:
    """The table."""
    columns = " | ".join(f"{snr} dB" for snr in scenes.SNRS_DB)
    lines = [
        f"| body | tags | R at 10 dB: 10 %, 25 %, 50 % have less than | named at most, {columns} |",
        "|---" * (3 + len(scenes.SNRS_DB)) + "|",
    ]
    for bodies in ((BODIES[0],), (BODIES[1],), BODIES):
        own = [one for one in found if one.body in bodies]
        scale = 10 ** ((10 - QUIET_DB) / 10)
        low, quarter, middle = scale * np.quantile([one.variances for one in own], [0.1, 0.25, 0.5])
        shares = " | ".join(
            f"{100 * np.mean([one.named(snr) for one in own]):.0f} %" for snr in scenes.SNRS_DB
        )
        name = " and ".join(bodies)
        lines.append(f"| {name} | {len(own)} | {low:.0f}, {quarter:.0f}, {middle:.0f} | {shares} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--numbers", type=int, default=10, help="scenes of every cell")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--write", type=Path, help="folder for blind-bound.md")
    given = parser.parse_args()
    cells = [
        Cell("own", "tagged", "paper", body, offset, QUIET_DB, 36, pulse)
        for body, offset, pulse in product(BODIES, scenes.OFFSETS_MM, scenes.PULSES)
    ]
    tasks = [(cell, FIRST + number) for number in range(given.numbers) for cell in cells]
    with multiprocessing.get_context("fork").Pool(given.jobs) as pool:
        found = pool.starmap(apart, tasks, 2)
    last = FIRST + given.numbers - 1
    title = "Tags beside walls that nobody states: what is left to tell them by"
    seeds = f"development, numbers {FIRST} to {last}"
    lines = [*page(title, seeds, __doc__), *document(found)]
    publish(lines, given.write, "blind-bound.md")


if __name__ == "__main__":
    main()
