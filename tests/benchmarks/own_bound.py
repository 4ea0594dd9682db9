"""What the waves of our simulator's moving bodies hold of a tag: an upper bound on what any reader can name.

The scenes are those of `reading_bodies` at 36 views. D is the energy of the tag's echo on its body, without
noise, over the variance of the noise of one value; what is constant over the views is subtracted. A reader
that knows the body's echo, the pulse, and what every reflector returns, but not which of four layouts in
which of 72 turns stands there, needs

    sqrt(2 D / K) >= Q^-1(0.001 / (4 * 72)) + Q^-1(0.1)

to tell the K reflectors from K - 1 of them with a probability of 90 % at a false-accept setting of 0.1 %: two
echoes that differ by an energy d are told apart at sqrt(2 d) standard deviations, and a reflector has D / K.

Without a body and on round ones R is what the best other arrangement leaves: of 1 to 4 alike reflectors at 48
angles about the tag's middle, each with the echo that it has there, and one free amplitude per frequency. A
reader that knows the body, and what a reflector returns on it, but not their strength, needs
sqrt(2 R) >= Q^-1(0.001) + Q^-1(0.1) to tell the tag from it.

    python tests/benchmarks/own_bound.py --jobs 2 --write docs/results
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import reading_bodies_scenes as scenes
from numpy.typing import NDArray
from provenance import page, publish
from reading_bodies_scenes import Cell

from tagid.capture import Capture
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.simulate import NoiseShape, simulate_capture
from tagid.simulate.scattering import Body
from tagid.tags.bodies.arrangement import apart_deg, can_stand, layout_gaps_deg, off_axis, resolution_deg
from tagid.tags.bodies.body_reading import BodySettings
from tagid.tags.bodies.reflectors_fit import POINTS
from tagid.tags.bodies.ring import Ring
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.layouts.layout import builtin_layouts

NEEDED = 4.5 + 1.28
"""Standard deviations: Q^-1(0.001 / 288) and Q^-1(0.1)."""
NEEDED_OF_OTHERS = 3.09 + 1.28
"""Q^-1(0.001) and Q^-1(0.1)."""
ROUND = ("none", "cup", "cup-handle", "can")
"""Bodies on which other arrangements stand alike."""
ANGLES = 48
KEPT = 400
"""Sets of every number among which the best other arrangement is sought."""


@dataclass(frozen=True)
class Held:
    """Energy D of a tag of K reflectors, and R; NaN for R where it was not asked for."""

    body: str
    snr_db: int
    energy: float
    reflectors: int
    other: float

    @property
    def is_enough(self) -> bool:
        """Whether each of its reflectors can be told."""
        return bool(np.sqrt(2 * self.energy / self.reflectors) >= NEEDED)

    @property
    def is_told(self) -> bool:
        """Whether it can be told from the best other arrangement."""
        return bool(np.sqrt(2 * self.other) >= NEEDED_OF_OTHERS)


def spectra(capture: Capture) -> Spectra:
    """Of a capture at 36 views."""
    return Spectra.of(preprocess(capture, settings=PreprocessSettings(matched_filter=False, extent_m=0.5)))


def held(cell: Cell, number: int) -> Held:
    """The energies in one scene."""
    made = scenes.own_recording(cell, "development", number)
    noisy = simulate_capture(made.scene, made.acquisition, made.seed)[0]
    quiet = replace(made.acquisition, snr_db=None, noise=NoiseShape())

    def echo(*objects: Body) -> Spectra:
        return spectra(simulate_capture(replace(made.scene, object=objects, room=None), quiet, made.seed)[0])

    # The reflectors come first; what their body does to their echo is part of them.
    tag, *body = made.scene.object
    alone, noise = echo(tag), spectra(noisy).noise
    other = float("nan")
    if cell.body in ROUND:
        standing = scenes.alike(made, ANGLES)
        columns = np.stack([echo(one).data for one in standing], axis=1)
        other = left_by_others(alone, columns, echo(*body).data if body else None, made.name) / noise
    return Held(cell.body, cell.snr_db, alone.energy / noise, made.reflectors, other)


def left_by_others(
    tag: Spectra, columns: NDArray[np.complex128], body: NDArray[np.complex128] | None, name: str
) -> float:
    """Energy that the best arrangement that is not the layout's leaves of its echo.

    Args:
        tag: echo of the layout's reflectors.
        columns: (F, ANGLES, V) of a reflector at every angle.
        body: (F, V) echo of the body, whose amplitude is free; None for none.
        name: of the layout.
    """
    layout = builtin_layouts()[name]
    radius, wanted = off_axis(layout)[0].mean(), layout_gaps_deg(layout)
    scale = np.sqrt(tag.energy / tag.data.size)
    angles = 2 * np.pi * np.arange(ANGLES) / ANGLES
    ring = Ring.from_columns(tag.data / scale, columns / scale, body, radius, POINTS, angles)
    left = [
        ring.energy - value
        for sets, values in ring.best(4, KEPT).values()
        for some, value in zip(sets, values, strict=True)
        if apart_deg(angles[some], wanted, resolution_deg(radius)) > BodySettings.other_deg
        and can_stand(angles[some], radius)
    ]
    return float(min(left, default=ring.energy)) * scale**2


def document(found: list[Held]) -> list[str]:
    """The table."""
    lines = [
        "| body | SNR dB | tags | D, median (10 to 90 %) | D is enough | R / D, median | R is enough |",
        "|---|---|---|---|---|---|---|",
    ]
    for body, snr in product(scenes.BODIES, scenes.SNRS_DB):
        own = [one for one in found if (one.body, one.snr_db) == (body, snr)]
        if own:
            low, middle, high = np.quantile([one.energy for one in own], [0.1, 0.5, 0.9])
            enough = 100 * np.mean([one.is_enough for one in own])
            shown = "| - | - |"
            if body in ROUND:
                share = 100 * np.median([one.other / one.energy for one in own])
                shown = f"| {share:.0f} % | {100 * np.mean([one.is_told for one in own]):.0f} % |"
            known = f"{middle:.0f} ({low:.0f} to {high:.0f}) | {enough:.0f} %"
            lines.append(f"| {body} | {snr} | {len(own)} | {known} {shown}")
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
    title = "Tags on our simulator's bodies: what the waves hold"
    seeds = f"development, numbers 300 to {299 + given.numbers}"
    lines = [*page(title, seeds, __doc__), *document(found)]
    publish(lines, given.write, "own-bound.md")


if __name__ == "__main__":
    main()
