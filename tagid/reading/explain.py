"""What hypotheses explain of a recording, for people: shares, reflectors with their levels, range offset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.fields.thin_shell import BoxShell
from tagid.reading.decision import is_same, words
from tagid.reading.descent import Estimate
from tagid.reading.evidence import fit
from tagid.reading.hypothesis import Hypothesis
from tagid.reading.reading import Explanation, Kind, Reflector, Residuals
from tagid.reading.sheet import BOX, METAL, SHELL, SheetModel
from tagid.reading.signature import SignatureModel
from tagid.reading.spectra import MODEL_ERROR, Spectra
from tagid.types import Complex

MOST = 8
"""Hypotheses that are reported."""
DRAWN = 4
"""Hypotheses whose residuals are kept for a picture."""
RANGES_M = np.linspace(-0.25, 0.25, 51)
"""Ranges beyond the axis distance of the residuals, m."""
_BOX = np.array([1 + 1j, -1 + 1j, -1 - 1j, 1 - 1j])
_ROUND = np.exp(2j * np.pi * np.arange(48) / 48)
"""Corners of outlines of half sizes 1."""
OFFSETS_M = np.arange(-0.25, 0.25, 5e-4)
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
    unexplained: float

    @classmethod
    def of(cls, spectra: Spectra, hypothesis: Hypothesis) -> Explained:
        """That of a hypothesis of a recording."""
        columns, data, lam, power = hypothesis.estimate.whitened(spectra)
        amplitudes = fit(columns, data, lam, power).amplitudes
        residual = data - (amplitudes[:, None] @ columns)[:, 0]
        noise = data.shape[1] * (1 - MODEL_ERROR**2 * spectra.moving).sum()
        unexplained = (np.abs(residual) ** 2).sum() - noise
        return cls(
            hypothesis, amplitudes, float(np.clip(unexplained / (spectra.views * spectra.moving.sum()), 0, 1))
        )

    def reflectors(self, spectra: Spectra) -> tuple[Reflector, ...]:
        """The reflectors of the hypothesis, and its odd scatterers, as measured."""
        estimate, model = self.hypothesis.estimate, self.hypothesis.estimate.model
        count, first = len(estimate.positions), model.body_columns
        spectrum = np.zeros((len(self.amplitudes), count), dtype=np.complex128)
        if count:
            spectrum += self.amplitudes[:, first : first + 1]
            if model.unlike:
                last = model.columns - model.odd
                spectrum += self.amplitudes[:, last - model.unlike : last]
        odd = self.amplitudes[:, model.columns - model.odd :]
        levels = np.concatenate([spectrum, odd], axis=1)
        turned = levels * np.exp(1j * spectra.kappa * self.offset_m(spectra))[:, None]
        energy = (np.abs(levels) ** 2).sum(axis=0)
        loudest = max(float(energy.max(initial=0.0)), 1e-30)
        heights = np.concatenate(model.heights_of(estimate.x)) if model.lifts or model.spot > 2 else None
        positions = np.concatenate([estimate.positions, estimate.odd])
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
            for i, place in enumerate(positions)
        )

    def residual(self, spectra: Spectra) -> Complex:
        """(F, V) what it leaves of the data, the room projected out."""
        estimate = self.hypothesis.estimate
        columns = estimate.model.at(spectra, estimate.x, slopes=False).values
        echo = (self.amplitudes[:, None] @ columns)[:, 0]
        return np.asarray(spectra.data - echo + (echo @ spectra.rooms.T) @ spectra.rooms)

    def offset_m(self, spectra: Spectra) -> float:
        """Range beyond the axis distance at which the reflectors' amplitudes are most alike, m."""
        model = self.hypothesis.estimate.model
        if model.tag is None:
            return 0.0
        body = self.amplitudes[:, model.body_columns]
        together = np.abs(np.exp(1j * OFFSETS_M[:, None] * spectra.kappa) @ body)
        return float(OFFSETS_M[together.argmax()])


def kind_of(hypothesis: Hypothesis) -> Kind:
    """What stands there by a hypothesis."""
    model = hypothesis.estimate.model
    if not hypothesis.tagged:
        return Kind.NO_TAG
    if isinstance(model, SignatureModel):
        return Kind.OBJECT if model.whole else Kind.BODY
    if isinstance(model, SheetModel):
        return {SHELL: Kind.SHELL, BOX: Kind.BOX, METAL: Kind.BOX}.get(model.kind, Kind.ROUND)
    return Kind.ROUND if model.transfer.body else Kind.BARE


def ranked(hypotheses: Sequence[Hypothesis], winner: Hypothesis) -> list[Hypothesis]:
    """The winner and the best of every other kind and layout that is not the same tag, best first.

    Args:
        winner: comes first, whatever its evidence.
    """
    kinds = {(kind_of(winner), winner.name): winner}
    for hypothesis in sorted(hypotheses, key=lambda hypothesis: -hypothesis.log_z):
        if winner.name is None or hypothesis.name is not None or not is_same(hypothesis, winner):
            kinds.setdefault((kind_of(hypothesis), hypothesis.name), hypothesis)
    return list(kinds.values())[:MOST]


def explanations(every: Sequence[Explained]) -> tuple[Explanation, ...]:
    """Hypotheses as the answer reports them."""
    best = max(explained.hypothesis.log_z for explained in every)
    return tuple(_explanation(explained, explained.hypothesis.log_z - best) for explained in every)


def _explanation(explained: Explained, log_evidence: float) -> Explanation:
    hypothesis = explained.hypothesis
    estimate, model = hypothesis.estimate, hypothesis.estimate.model
    return Explanation(
        kind_of(hypothesis),
        model.body.signature.name if isinstance(model, SignatureModel) else "",
        hypothesis.name,
        words(hypothesis),
        float(log_evidence),
        explained.unexplained,
        (estimate.centre.real, estimate.centre.imag),
        float(np.abs(estimate.positions - estimate.centre).mean()) if len(estimate.positions) else None,
        _outline(estimate),
    )


def _outline(estimate: Estimate) -> tuple[tuple[float, float], ...]:
    """Corners of a sheet, m; none of a body whose own echo does not tell its size."""
    model, x = estimate.model, estimate.x
    if not isinstance(model, SheetModel):
        return ()
    sheet = model.sheet(x)
    unit = _BOX if model.kind.shell is BoxShell else _ROUND
    corners = sheet.across_m * unit.real + 1j * sheet.along_m * unit.imag
    placed = complex(x[0], x[1]) + corners * np.exp(1j * x[2])
    return tuple((float(point.real), float(point.imag)) for point in placed)


def residuals(spectra: Spectra, every: Sequence[Explained]) -> Residuals:
    """What hypotheses leave of a recording, as range profiles over the angle."""
    order = np.argsort(spectra.direction)
    waves = np.exp(1j * RANGES_M[:, None] * spectra.kappa) / np.sqrt(len(spectra.kappa))

    def profiles(data: Complex) -> NDArray[np.float16]:
        return np.asarray(np.abs(waves @ data[:, order]), dtype=np.float16)

    by_hypothesis = np.stack([profiles(explained.residual(spectra)) for explained in every[:DRAWN]])
    return Residuals(spectra.direction[order], RANGES_M, profiles(spectra.data), by_hypothesis)
