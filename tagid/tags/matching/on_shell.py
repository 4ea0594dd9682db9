"""What a thin shell or a box that nobody enrolled says, where no other hypothesis names a tag."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tagid.imaging.types import BasebandScans
from tagid.tags.bodies.body_reading import BodyReading
from tagid.tags.bodies.hypothesis import Explanation, Kind
from tagid.tags.bodies.points import Place
from tagid.tags.bodies.shell_decide import decide_on_shell
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.layouts.layout import Layout
from tagid.tags.matching.contest_settings import ContestSettings
from tagid.tags.matching.reading import Reading
from tagid.tags.matching.won import on_body
from tagid.tags.verdicts.verdict import Code, Verdict

_MIDDLE = (Code.EXTRA, Code.MISSING)
_WHERE = {Kind.SHELL: "on a thin shell", Kind.BOX: "in a box"}
CLEARER = 0.5
"""A refusal is that on a shell, and a name on a glass is doubted, where a layout on the shell leaves this
share of what every other hypothesis leaves."""

NOTHING = 0.02
"""What a hypothesis leaves no other need explain, if it is less: a name beside a glass gave way to a box that
left nothing either."""
NEEDED = 0.2
"""Walls explain so much of the echo more than what needs none: of 36 tags in solved cartons 0.4 and more. A
reflector in the middle of `container-90`, near the noise, passed for a carton's walls."""


def _hint(settled: Reading, layouts: Sequence[Layout]) -> Place | None:
    """Where the best layout lies without a body."""
    if not settled.scores:
        return None
    best = settled.scores[0]
    layout = next(one for one in layouts if one.name == best.name)
    return Place(layout, float(np.deg2rad(best.rotation_deg)), best.centre_m)


def _plain_left(settled: Reading) -> float:
    """Least share of the echo that a tag without a body, or no tag, leaves."""
    plain = (one.left for one in settled.hypotheses if one.kind in (Kind.NO_TAG, Kind.BARE))
    return min(plain, default=1.0)


def on_shell(
    settled: Reading, scans: BasebandScans, layouts: Sequence[Layout], settings: ContestSettings
) -> Reading | None:
    """The reading on a thin shell, or in a box; None where neither explains the scans better than the others.

    Args:
        settled: what the other hypotheses come to: no name, or one beside a wall that the wave passes.
        scans: at most a turn of folded views.
        layouts: the enrolled ones.
        settings: of the contest.
    """
    from tagid.tags.bodies.shell_reader import read_in_box, read_on_shell

    spectra, hint = Spectra.of(scans), _hint(settled, layouts)
    said = None
    for kind, read, decision in (
        (Kind.SHELL, read_on_shell, settings.shell),
        (Kind.BOX, read_in_box, settings.box),
    ):
        if kind is Kind.BOX and _plain_left(settled) < NEEDED:
            break
        found = read(spectra, layouts, settings.body, hint)
        if found is None:
            continue
        own = _said(kind, found.reading, decide_on_shell(found, decision), settled, layouts)
        if own is not None and own.status == "identified":
            return own
        said = said or own
    return said


def _said(
    kind: Kind, reading: BodyReading, verdict: Verdict, settled: Reading, layouts: Sequence[Layout]
) -> Reading | None:
    """What a reading beside a shell says against the other hypotheses; None for nothing."""
    best = reading.layouts[0]
    own = Explanation(
        kind,
        "",
        best.layout,
        reading.share(best.left),
        float(np.clip(reading.unexplained, 0, 1)),
        reading.pose,
        None,
        float(best.radii.mean()),
    )
    hypotheses = tuple(sorted((own, *settled.hypotheses), key=lambda one: one.left))
    others = min((one.left for one in settled.hypotheses), default=1.0)
    if kind is Kind.BOX and settled.body is not None and settled.layout == best.layout:
        # A cup's wall leaves 4 % of a loud tag, to which the sides of a box bend: a free pattern leaves less.
        others = min(others, (settled.body.freely - reading.noise) / reading.signal)
    clearer = own.left <= CLEARER * others and others > NOTHING
    named = verdict.status == "identified"
    if settled.status == "identified" and not clearer:
        # Near the noise points leave nothing: of two names on a body that counts which leaves less.
        told = (one.left for one in settled.hypotheses if one.layout == settled.layout)
        if not named or best.layout == settled.layout or own.left >= min(told, default=0.0):
            return None
        reason = f"the echo is that of {settled.layout} on a round body, or of {best.layout} {_WHERE[kind]}"
        return replace(settled, status="ambiguous", code=Code.AMBIGUOUS, reason=reason, hypotheses=hypotheses)
    # Walls with the right layout leave less than a round body with any, or than points: 65 of 65 tags in
    # solved cartons. Two bare reflectors of three, which left half as much, passed for the three on a shell.
    if own.left > others and (named or kind is Kind.BOX):
        return None
    if kind is Kind.BOX and _plain_left(settled) - own.left < NEEDED:
        return None
    # An enrolled body knows better what stands in the middle of the same tag.
    known = settled.body if settled.kind is Kind.BODY else None
    if known is not None and settled.code in _MIDDLE and known.layouts[0].layout == best.layout:
        return None
    # What stands there may be an enrolled body with another tag.
    other = (one for one in settled.hypotheses if one.kind is Kind.BODY and one.layout != best.layout)
    if any(one.left <= own.left for one in other):
        return None
    if named:
        return replace(on_body(settled, reading, layouts, None), kind=kind, hypotheses=hypotheses, note="")
    if not clearer or verdict.code is Code.WEAK:
        return None
    return replace(
        settled,
        status=verdict.status,
        layout=None,
        code=verdict.code,
        reason=verdict.reason,
        nearest=best.layout or settled.nearest,
        kind=kind,
        body=reading,
        hypotheses=hypotheses,
    )
