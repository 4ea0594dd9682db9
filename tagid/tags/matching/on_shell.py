"""Names of tags on a thin shell that nobody enrolled, where no other hypothesis names one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tagid.imaging.types import BasebandScans
from tagid.tags.bodies.hypothesis import Explanation, Kind
from tagid.tags.bodies.shell_decide import decide_on_shell
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.layouts.layout import Layout
from tagid.tags.matching.contest_settings import ContestSettings
from tagid.tags.matching.reading import Reading
from tagid.tags.matching.won import on_body


def on_shell(
    settled: Reading, scans: BasebandScans, layouts: Sequence[Layout], settings: ContestSettings
) -> Reading | None:
    """The reading that a layout on a thin shell wins; None where none does.

    Args:
        settled: what the other hypotheses come to; it names nothing.
        scans: at most a turn of folded views.
        layouts: the enrolled ones.
        settings: of the contest.
    """
    from tagid.tags.bodies.shell_reader import read_on_shell

    found = read_on_shell(Spectra.of(scans), layouts, settings.body)
    if found is None or decide_on_shell(found, settings.shell).status != "identified":
        return None
    reading = found.reading
    best = reading.layouts[0]
    share = (best.left - reading.noise) / max(reading.energy - reading.noise, 1e-30)
    own = Explanation(
        Kind.SHELL,
        "",
        best.layout,
        float(np.clip(share, 0, 1)),
        float(np.clip(reading.unexplained, 0, 1)),
        reading.pose,
        None,
        float(best.radii.mean()),
    )
    hypotheses = tuple(sorted((own, *settled.hypotheses), key=lambda one: one.left))
    return replace(on_body(settled, reading, layouts, None), hypotheses=hypotheses, note="")
