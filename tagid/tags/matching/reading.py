"""What is read in one recording, as a value."""

from __future__ import annotations

from dataclasses import dataclass, replace

from tagid.tags.bodies.body_reading import BodyReading
from tagid.tags.bodies.calibration import Bound
from tagid.tags.bodies.hypothesis import Explanation, Kind
from tagid.tags.reading.decision import Evidence
from tagid.tags.reading.reflectors import Reflector
from tagid.tags.verdicts.verdict import ADVICE, Code


@dataclass(frozen=True)
class LayoutScore:
    """One row of the comparison.

    Attributes:
        name: layout.
        criterion: J = n log(E - e) + K log n relative to no reflectors; lower is better.
        share: part of the energy above noise that it explains.
        rotation_deg, centre_m: where it fits best.
    """

    name: str
    criterion: float
    share: float
    rotation_deg: float
    centre_m: tuple[float, float]


@dataclass(frozen=True)
class Reading:
    """What the scans say.

    Attributes:
        status: "identified", "unknown", "ambiguous" or "no_tag".
        reason: why it is not identified, in words; empty otherwise.
        code: the same for programs.
        layout: name of the layout; the nearest one where ambiguous, None where unknown or no tag.
        nearest: name of the best-fitting layout whatever the status.
        score: 0..1, share of the energy above noise that the nearest layout explains.
        margin: 0..1, the lead over the runner-up as a share of the explained energy.
        rotation_deg: counter-clockwise rotation of the layout, within its symmetry.
        centre_m: where the layout's origin lies, m.
        offset_m: range offset found, i.e. the error of the axis distance, m.
        reflectors: where they were measured, those of the layout (matched) and those beyond it.
        missing, extra: counts.
        scores: every layout, best first.
        evidence: the numbers behind the decision on reflectors without a body.
        kind: the hypothesis that won.
        hypotheses: every hypothesis that was fitted, best first.
        bound: what `tags.false_accept` rests on; None where no calibration was asked.
        body: the fit on a body, where one was made; for pictures without the body.
        note: what the reading took out or did not consider; empty for nothing.
        wall_m: radius of the thin round wall whose echo was taken out, m; None where none was.
        hidden_deg: part of the turn that was left out because something hides a reflector there, deg.
    """

    status: str
    reason: str
    layout: str | None
    nearest: str
    score: float
    margin: float
    rotation_deg: float
    centre_m: tuple[float, float]
    offset_m: float
    reflectors: tuple[Reflector, ...]
    missing: int
    extra: int
    scores: tuple[LayoutScore, ...]
    evidence: Evidence
    code: Code = Code.NONE
    kind: Kind = Kind.BARE
    hypotheses: tuple[Explanation, ...] = ()
    bound: Bound | None = None
    body: BodyReading | None = None
    note: str = ""
    wall_m: float | None = None
    hidden_deg: float = 0.0

    @property
    def explained_by(self) -> Explanation | None:
        """The hypothesis that won, as it was fitted; None where none was, as in a vote.

        Of several enrolled bodies or objects, the one that was read; of the layouts on it, the nearest one.
        """
        body = self.body
        if self.kind is Kind.NO_TAG and body is not None and body.body.name:
            # Among the hypotheses, no tag is a round body.
            left = body.share(body.body_left)
            return Explanation(Kind.NO_TAG, body.body.name, None, left, None, body.pose)
        alike = [one for one in self.hypotheses if one.kind is self.kind]
        if self.kind is Kind.BODY and body is not None:
            alike = [one for one in alike if one.name == body.body.name]
        if self.kind is Kind.OBJECT:
            alike = [one for one in alike if self.layout in (one.layout, one.name)] or alike
        named = [one for one in alike if one.layout == self.layout]
        return min(named or alike, key=lambda one: one.left, default=None)

    @property
    def advice(self) -> str:
        """What to do next; empty where a layout is named."""
        return ADVICE[self.code]

    def refused(self, code: Code, reason: str) -> Reading:
        """The same without its name."""
        return replace(self, status="unknown", layout=None, code=code, reason=reason)
