"""How far the evidence tells two layouts apart, on the bodies that they are for.

A noiseless recording of one layout is explained by both, each at its most probable pose, on any body, as it
was enrolled or glued a little off. The difference L of their log evidences is about what a noisy recording
shows in the mean; as a log likelihood ratio of normal errors it scatters with the variance 2 L (Kay 1998,
Fundamentals of Statistical Signal Processing II, section 4.3). A name needs a lead of `decision.SURE`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from math import erfc, sqrt

import numpy as np

from tagid.constants import SPEED_OF_LIGHT
from tagid.reading.columns import Model
from tagid.reading.decision import SURE
from tagid.reading.descent import Estimate, best_powers, refined
from tagid.reading.hypotheses import TRANSFERS
from tagid.reading.hypothesis import Arranged, Candidate, disc_of
from tagid.reading.spectra import MODEL_ERROR, Spectra
from tagid.reading.transfers.plain import BARE
from tagid.reading.transfers.rod import RODS
from tagid.reading.transfers.transfer import Transfer
from tagid.reading.transfers.wall import WALLS
from tagid.tags.layouts.codebook import best_pairing
from tagid.tags.layouts.layout import Layout
from tagid.types import Floats

ENERGY_0DB = 0.13
"""Energy of a reflector's echo per view and frequency over the noise's at an SNR of 0 dB (`tagid simulate`),
where its loudest sample is as loud as the noise."""
_KAPPA = 4 * np.pi / SPEED_OF_LIGHT * np.linspace(3.3e9, 4.7e9, 9)
BODIES: dict[str, tuple[Transfer, ...]] = {"helmet": (BARE,)}
"""What objects of a kind may be, for upright antennas: a helmet's shell hardly changes its reflectors."""
_ANY: tuple[Transfer, ...] = (BARE, *(wall for wall in (*WALLS, *RODS) if wall.name.endswith("V")))
_TURNS, _TRIED = 24, 3
"""Turns tried on the true body, and those of them tried on every body."""


@dataclass(frozen=True)
class Conditions:
    """Of a recording.

    Attributes:
        views: of a whole turn, per antenna height.
        snr_db: of a reflector's loudest sample.
        height_weight: see `codebook.height_weight`; 0 for one antenna height.
    """

    views: int = 36
    snr_db: float = 10.0
    height_weight: float = 0.0


@dataclass(frozen=True)
class Apart:
    """How far two layouts are told apart.

    Attributes:
        lead: expected log evidence of the true one over the other, on the body where it is least, nats; of
            the two recordings that have less.
        body: that body in words; empty for reflectors beside nothing.
    """

    lead: float
    body: str

    @property
    def where(self) -> str:
        """The body as the end of a phrase; empty for none."""
        return f" on {self.body}" if self.body else ""

    def unresolved(self, unsure: float = 0.0) -> float:
        """Share of the readings whose lead is too small for a name.

        Args:
            unsure: standard deviation of the enrolled difference of the two, over that difference.
        """
        if self.lead <= 0:
            return 1.0
        spread = sqrt(2 * self.lead + (2 * self.lead * unsure) ** 2)
        return 0.5 * erfc((self.lead - SURE) / spread / sqrt(2))


def told_apart(layout: Layout, other: Layout, conditions: Conditions = Conditions()) -> Apart:
    """How far recordings tell two layouts of as many reflectors apart, of the one that they tell less."""
    candidates = []
    for recorded, rival in ((layout, other), (other, layout)):
        for body in BODIES.get(recorded.kind, _ANY):
            spectra = _recorded(recorded, body, conditions)
            true = _or_glued(spectra, refined(spectra, *_placed(spectra, recorded, body)))
            lead = true - _best(spectra, rival, recorded, body)
            candidates.append(Apart(float(lead), body.words if body.body else ""))
    return min(candidates, key=lambda candidate: candidate.lead)


def _recorded(layout: Layout, body: Transfer, conditions: Conditions) -> Spectra:
    """A recording of a layout's reflectors without noise, in the units of one with it."""
    whole = _antennas(conditions)
    model, x = _placed(whole, layout, body)
    echo = model.at(whole, x, slopes=False).values[:, model.body_columns]
    echo = echo * sqrt(ENERGY_0DB * 10 ** (conditions.snr_db / 10))
    echo = echo - (echo @ whole.rooms.T) @ whole.rooms
    moving = (np.abs(echo) ** 2).mean(axis=1)
    unit = 1 + MODEL_ERROR**2 * moving
    # The whiteners, which depend on the antennas alone, are those of the empty recording.
    return replace(whole, data=echo / np.sqrt(unit)[:, None], moving=moving / unit, stated=whole)


@lru_cache(maxsize=8)
def _antennas(conditions: Conditions) -> Spectra:
    """An empty recording at 1 m; of two heights that tell as much as those of the conditions."""
    views, up = conditions.views, conditions.height_weight / sqrt(2)
    turn = np.exp(-2j * np.pi * np.arange(views) / views)
    height = np.repeat([-up, up], views) if up else np.zeros(views)
    antenna = np.tile(turn, len(height) // views)
    none = np.zeros((len(_KAPPA), len(height)), dtype=np.complex128)
    return Spectra(none, _KAPPA, antenna, height, 1.0, np.zeros(len(_KAPPA)), not up)


def _placed(spectra: Spectra, layout: Layout, transfer: Transfer) -> tuple[Model, Floats]:
    """The model of a layout behind a transfer, about the axis."""
    arranged = Arranged.of(layout, transfer.body and not transfer.clear)
    model = Model(transfer, arranged.tag, transfer.body, disc_of(arranged.radius_m), levels=spectra.levels)
    return model, np.zeros(model.parameters)


def _best(spectra: Spectra, layout: Layout, recorded: Layout, body: Transfer) -> float:
    """Log evidence of a layout, at any place and turn, on any body, nats.

    Args:
        recorded: the layout of the recording, and its body.
    """

    def tried(transfer: Transfer, poses: Iterable[tuple[complex, float]]) -> list[Candidate]:
        model, x = _placed(spectra, layout, transfer)
        starts = []
        for centre, turn in poses:
            x = x.copy()
            x[0], x[1], x[model.head] = centre.real, centre.imag, turn
            starts.append(Candidate(best_powers(spectra, model, x, 1e-2)[1], layout, model, x, False))
        return sorted(starts, key=lambda start: -start.log)

    about = [(0j, float(turn)) for turn in 2 * np.pi * np.arange(_TURNS) / _TURNS]
    pair = best_pairing(layout.positions, recorded.positions)
    poses = [(complex(*pair.shift_m), pair.rotation_rad), (0j, pair.rotation_rad)]
    poses += [
        (complex(*start.x[:2]), float(start.x[start.model.head])) for start in tried(body, about)[:_TRIED]
    ]
    likely = [tried(transfer, poses)[0] for transfer in TRANSFERS]
    estimates = [refined(spectra, start.model, start.x) for start in likely]
    return _or_glued(spectra, max(estimates, key=lambda estimate: estimate.log_z))


def _or_glued(spectra: Spectra, estimate: Estimate) -> float:
    """Log evidence of reflectors as they were enrolled, or glued a little off, nats."""
    return max(estimate.log_z, refined(spectra, *estimate.by_hand(), (None,)).log_z)
