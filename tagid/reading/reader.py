"""From a recording to a decision."""

from __future__ import annotations

from collections.abc import Sequence

from tagid.imaging.types import BasebandScans
from tagid.reading.decision import Decision, decide
from tagid.reading.hypotheses import Contest
from tagid.reading.spectra import Spectra
from tagid.tags.layouts.layout import Layout


def read(scans: BasebandScans, layouts: Sequence[Layout], signatures: Sequence[object] = ()) -> Decision:
    """Read the tag of a recording.

    Args:
        scans: made without a matched filter.
        layouts: the candidates.
    """
    return decide(Contest(Spectra.of(scans), layouts).run())
