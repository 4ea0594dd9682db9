"""From recordings of one object to a decision."""

from __future__ import annotations

from collections.abc import Sequence

from tagid.imaging.types import BasebandScans
from tagid.reading.decision import Decision
from tagid.reading.hypotheses import Contest
from tagid.reading.several import decide_together
from tagid.reading.signature import enrolled_in
from tagid.reading.spectra import RADIUS_M, Spectra
from tagid.tags.bodies.signature import Signature
from tagid.tags.layouts.layout import Layout


def read(
    scans: BasebandScans | Sequence[BasebandScans],
    layouts: Sequence[Layout],
    signatures: Sequence[Signature] = (),
) -> Decision:
    """Read the tag of an object.

    Args:
        scans: of one recording, or of each of several, made without a matched filter.
        layouts: the candidates.
        signatures: enrolled bodies and objects; those of another band than a recording's take no part in it.
    """
    every = [scans] if isinstance(scans, BasebandScans) else list(scans)
    contests = [contest(one, layouts, signatures) for one in every]
    for one in contests:
        one.run()
    return decide_together(contests)


def contest(scans: BasebandScans, layouts: Sequence[Layout], signatures: Sequence[Signature] = ()) -> Contest:
    """What competes in a recording; arguments as of `read`."""
    enrolled = enrolled_in(scans, signatures)
    radius_m = max([RADIUS_M, *(one.signature.radius_m for one in enrolled)])
    kappa = enrolled[0].signature.wavenumbers if enrolled else None
    return Contest(Spectra.of(scans, radius_m, kappa=kappa), layouts, enrolled=enrolled)
