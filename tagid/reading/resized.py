"""The angles of a layout at another distance from the centre: then it is another tag."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from tagid.reading import search
from tagid.reading.columns import Model
from tagid.reading.descent import Powers
from tagid.reading.hypothesis import Arranged, Candidate, Hypothesis, disc_of
from tagid.reading.spectra import Spectra
from tagid.reading.transfers.transfer import Transfer


def resized(
    spectra: Spectra, transfers: Sequence[Transfer], radii_m: Sequence[float], hypothesis: Hypothesis
) -> Iterator[Candidate]:
    """A layout's angles on rings of other radii, at their best turns about the centre where it stands.

    Args:
        hypothesis: of a layout.
    """
    assert hypothesis.layout is not None
    estimate, of_layout = hypothesis.estimate, hypothesis.estimate.model
    powers = Powers(max(estimate.powers.clutter, 1e-3), estimate.powers.body)
    rise = float(of_layout.heights_of(estimate.x)[0].min())
    for transfer in transfers:
        for disc in (0, 1):
            radii = [radius for radius in radii_m if disc_of(radius) == disc]
            model = Model(
                transfer, None, transfer.body, disc, levels=of_layout.levels, priors=of_layout.priors
            )
            shape = estimate.x[2:4] if of_layout.shapes else np.zeros(2)
            head = np.r_[estimate.centre.real, estimate.centre.imag, shape[: model.shapes]]
            arranged = Arranged.of(hypothesis.layout, model.covers_middle)
            rings = [replace(arranged, tag=arranged.tag.resized(radius)) for radius in radii]
            echo = model.at(spectra, head, slopes=False).values[:, 0] if transfer.body else spectra.data
            groups = [ring.group(rise) for ring in rings]
            (table,) = search.tables(spectra, model, [estimate.centre], groups, powers, echo[None])
            for ring, starts in zip(rings, search.turned(table, 1), strict=True):
                tagged = replace(model, tag=ring.tag)
                for start in starts:
                    x = np.r_[head, start.angles[0], 0.0, [rise] * tagged.lifts]
                    yield Candidate(start.log, None, tagged, x, False)
