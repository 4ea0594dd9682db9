"""What hypotheses explain of a recording, for people: shares, reflectors with their levels, range offset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tagid.reading.decision import is_same, words
from tagid.reading.descent import variance
from tagid.reading.evidence import fit
from tagid.reading.hypothesis import Hypothesis
from tagid.reading.reading import Explanation, Kind
from tagid.reading.sheet import BOX, METAL, SHELL, SheetModel
from tagid.reading.signature import SignatureModel
from tagid.reading.spectra import MODEL_ERROR, Complex, Spectra
from tagid.tags.reading.reflectors import Reflector

MOST = 8
"""Hypotheses that are reported."""
OFFSETS_M = np.arange(-0.1, 0.1, 5e-4)
"""Range offsets that are tried, m."""


@dataclass(frozen=True, eq=False)
class Explained:
    """A hypothesis with its most probable amplitudes.

    Attributes:
        amplitudes: (F, n) of its columns, in units of the spectra.
        left: share of the moving echo above noise that it leaves, 0..1.
    """

    hypothesis: Hypothesis
    amplitudes: Complex
    left: float

    @classmethod
    def of(cls, spectra: Spectra, one: Hypothesis) -> Explained:
        """That of a hypothesis of a recording."""
        found, model = one.found, one.found.model
        columns = spectra.whiteners[model.disc].apply(model.at(spectra, found.x, slopes=False).values)
        data = spectra.white[model.disc]
        powers = found.powers
        power = model.power(spectra.moving, powers.body, powers.tag, powers.oval)
        amplitudes = fit(columns, data, variance(spectra, model, powers.clutter), power).amplitudes
        residual = data - (amplitudes[:, None] @ columns)[:, 0]
        noise = data.shape[1] * (1 - MODEL_ERROR**2 * spectra.moving).sum()
        left = (np.abs(residual) ** 2).sum() - noise
        return cls(one, amplitudes, float(np.clip(left / (spectra.views * spectra.moving.sum()), 0, 1)))

    def reflectors(self, spectra: Spectra) -> tuple[Reflector, ...]:
        """The reflectors of the hypothesis, and its odd scatterers, as measured."""
        found, model = self.hypothesis.found, self.hypothesis.found.model
        count, first = len(found.places), model.body_columns
        own = np.zeros((len(self.amplitudes), count), dtype=np.complex128)
        if count:
            own += self.amplitudes[:, first : first + 1]
            if model.unlike:
                last = model.columns - model.odd
                own += self.amplitudes[:, last - model.unlike : last]
        odd = self.amplitudes[:, model.columns - model.odd :]
        levels = np.concatenate([own, odd], axis=1)
        turned = levels * np.exp(1j * spectra.kappa * self.offset_m(spectra))[:, None]
        energy = (np.abs(levels) ** 2).sum(axis=0)
        loudest = max(float(energy.max(initial=0.0)), 1e-30)
        heights = np.concatenate(model.heights_of(found.x)) if model.lifts or model.spot > 2 else None
        places = np.concatenate([found.places, found.odd])
        return tuple(
            Reflector(
                float(place.real),
                float(place.imag),
                complex(turned[:, i].mean()),
                float(10 * np.log10(max(energy[i], 1e-12 * loudest) / loudest)),
                float(10 * np.log10(max(energy[i] * spectra.views / len(spectra.kappa), 1e-12))),
                i < count and self.hypothesis.layout is not None,
                None if heights is None else float(heights[i]),
            )
            for i, place in enumerate(places)
        )

    def offset_m(self, spectra: Spectra) -> float:
        """Range beyond the axis distance at which the reflectors' amplitudes are most alike, m."""
        model = self.hypothesis.found.model
        if model.tag is None:
            return 0.0
        own = self.amplitudes[:, model.body_columns]
        together = np.abs(np.exp(1j * OFFSETS_M[:, None] * spectra.kappa) @ own)
        return float(OFFSETS_M[together.argmax()])


def kind_of(one: Hypothesis) -> Kind:
    """What stands there by a hypothesis."""
    model = one.found.model
    if not model.tagged:
        return Kind.NO_TAG
    if isinstance(model, SignatureModel):
        return Kind.OBJECT if model.whole else Kind.BODY
    if isinstance(model, SheetModel):
        return {SHELL: Kind.SHELL, BOX: Kind.BOX, METAL: Kind.BOX}.get(model.kind, Kind.ROUND)
    return Kind.ROUND if model.transfer.body else Kind.BARE


def explanations(
    spectra: Spectra, hypotheses: Sequence[Hypothesis], winner: Hypothesis
) -> tuple[Explanation, ...]:
    """The winner and the best of every other kind and layout that is not the same tag, best first.

    Args:
        winner: comes first, whatever its evidence.
    """
    kinds = {(kind_of(winner), winner.name): winner}
    for one in sorted(hypotheses, key=lambda one: -one.log_z):
        if winner.name is None or one.name is not None or not is_same(one, winner):
            kinds.setdefault((kind_of(one), one.name), one)
    best = max(one.log_z for one in kinds.values())
    return tuple(_explanation(spectra, one, one.log_z - best) for one in list(kinds.values())[:MOST])


def _explanation(spectra: Spectra, one: Hypothesis, log_evidence: float) -> Explanation:
    found, model = one.found, one.found.model
    name = model.body.signature.name if isinstance(model, SignatureModel) else ""
    radius = float(np.abs(found.places - found.centre).mean()) if len(found.places) else None
    centre = found.centre.real, found.centre.imag
    left = Explained.of(spectra, one).left
    return Explanation(kind_of(one), name, one.name, words(one), float(log_evidence), left, centre, radius)
