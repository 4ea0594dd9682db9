"""What the waves of our simulator's moving bodies hold of a tag: an upper bound on what any reader can name.

The scenes are those of `reading_bodies` at 36 views. D is the energy of the tag's echo on its body, without
noise, over the variance of the noise of one value; what is constant over the views is subtracted. A reader
that knows the body's echo, the pulse, and what every reflector returns, but not which of four layouts in
which of 72 turns stands there, needs

    sqrt(2 D / K) >= Q^-1(0.001 / (4 * 72)) + Q^-1(0.1)

to tell the K reflectors from K - 1 of them with a probability of 90 % at a false-accept setting of 0.1 %: two
echoes that differ by an energy d are told apart at sqrt(2 d) standard deviations, and a reflector has D / K.

    python tests/benchmarks/own_bound.py --jobs 2 --write docs/results
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import platform
import sys
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import product
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import reading_bodies_scenes as scenes
from provenance import commit
from reading_bodies_scenes import Cell

from tagid.capture import Capture
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.simulate import NoiseShape, simulate_capture
from tagid.tags.bodies.spectra import Spectra

NEEDED = 4.5 + 1.28
"""Standard deviations: Q^-1(0.001 / 288) and Q^-1(0.1)."""


@dataclass(frozen=True)
class Held:
    """Energy D of a tag of K reflectors."""

    body: str
    snr_db: int
    energy: float
    reflectors: int

    @property
    def is_enough(self) -> bool:
        """Whether each of its reflectors can be told."""
        return bool(np.sqrt(2 * self.energy / self.reflectors) >= NEEDED)


def spectra(capture: Capture) -> Spectra:
    """Of a capture at 36 views."""
    return Spectra.of(preprocess(capture, settings=PreprocessSettings(matched_filter=False, extent_m=0.5)))


def held(cell: Cell, number: int) -> Held:
    """The energy in one scene."""
    scene, acquisition, seed = scenes.own_scene(cell, "development", number)
    noisy, _ = simulate_capture(scene, acquisition, seed)
    # The reflectors come first; what their body does to their echo is part of them.
    tag = replace(scene, object=scene.object[:1], room=None)
    quiet = replace(acquisition, snr_db=None, noise=NoiseShape())
    alone, _ = simulate_capture(tag, quiet, seed)
    energy = spectra(alone).energy / spectra(noisy).noise
    return Held(cell.body, cell.snr_db, energy, tag.object[0].positions.shape[0])  # type: ignore[attr-defined]


def document(found: list[Held]) -> list[str]:
    """The table."""
    lines = [
        "| body | SNR dB | tags | D, median (10 to 90 %) | enough in every reflector |",
        "|---|---|---|---|---|",
    ]
    for body, snr in product(scenes.BODIES, scenes.SNRS_DB):
        own = [one for one in found if (one.body, one.snr_db) == (body, snr)]
        if own:
            low, middle, high = np.quantile([one.energy for one in own], [0.1, 0.5, 0.9])
            enough = 100 * np.mean([one.is_enough for one in own])
            lines.append(
                f"| {body} | {snr} | {len(own)} | {middle:.0f} ({low:.0f} to {high:.0f}) | {enough:.0f} % |"
            )
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--numbers", type=int, default=5, help="scenes of every cell")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--write", type=Path, help="folder for own-bound.md")
    given = parser.parse_args()
    cells = [c for c in scenes.cells(("own",)) if (c.group, c.enrolled, c.views) == ("tagged", "paper", 36)]
    tasks = [(cell, 300 + number) for number in range(given.numbers) for cell in cells]
    with multiprocessing.get_context("fork").Pool(given.jobs) as pool:
        found = pool.starmap(held, tasks, 4)
    lines = [
        "# Tags on our simulator's bodies: what the waves hold",
        "",
        f"Command: `python {' '.join(sys.argv)}`. Commit: {commit()}.",
        f"Machine: {platform.machine()}, Python {platform.python_version()}, numpy {np.__version__}.",
        f"Date: {datetime.now(UTC):%Y-%m-%d}. Seeds: development, numbers 300 to {299 + given.numbers}.",
        "",
        *(str(__doc__).split("\n\n", 1)[1].split("    python tests")[0].strip().splitlines()),
        "",
        *document(found),
    ]
    text = "\n".join(lines) + "\n"
    print(text)
    if given.write:
        (given.write / "own-bound.md").write_text(text)


if __name__ == "__main__":
    main()
