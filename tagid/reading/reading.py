"""What is read in recordings, as a value: the answer, why, and the hypotheses that compete."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from tagid.reading.calibration import Bound
from tagid.reading.hypothesis import Hypothesis
from tagid.reading.verdict import ADVICE, Code


class Kind(StrEnum):
    """What stands there by a hypothesis."""

    NO_TAG = "no_tag"
    """A body or nothing, and no reflectors."""
    BARE = "bare"
    """Reflectors beside nothing that returns an echo."""
    ROUND = "round"
    """Reflectors on a round body that is not enrolled."""
    SHELL = "shell"
    """Reflectors on a thin elliptic shell that is not enrolled, as a helmet has one."""
    BOX = "box"
    """Reflectors in or on a box that is not enrolled."""
    BODY = "body"
    """Reflectors on an enrolled body."""
    OBJECT = "object"
    """An enrolled tagged object as a whole."""


@dataclass(frozen=True)
class Reflector:
    """A point found in the scans.

    Attributes:
        x_m, y_m: position in the object's plane, m.
        amplitude: complex, in units of the scans.
        amplitude_db: relative to the strongest reflector found, dB.
        snr_db: energy over the level of noise and clutter, dB.
        matched: whether it belongs to the layout that was read.
        z_m: height above the object's plane, m; None where one antenna height does not show it.
    """

    x_m: float
    y_m: float
    amplitude: complex
    amplitude_db: float
    snr_db: float
    matched: bool = False
    z_m: float | None = None


@dataclass(frozen=True)
class LayoutScore:
    """One row of the comparison of layouts.

    Attributes:
        name: layout.
        criterion: log evidence of no tag over that of the layout, nats; lower is better.
        share: part of the moving echo above noise that its best hypothesis explains.
    """

    name: str
    criterion: float
    share: float


@dataclass(frozen=True)
class Explanation:
    """One hypothesis as the answer reports it.

    Attributes:
        kind: see `Kind`.
        name: of the enrolled body or object; "" otherwise.
        layout: the layout or enrolled object that it would name; None where it names none.
        words: the hypothesis in words.
        log_evidence: over that of the best hypothesis, nats: 0 or less.
        unexplained: residual share of the moving echo above noise, 0..1.
        centre_m: (x, y) of the body or, beside none, of the tag, m.
        radius_m: mean distance of the reflectors from the centre, m; None without reflectors.
        outline_m: corners (x, y) of the body, m, counter-clockwise; empty where its size is not known.
    """

    kind: Kind
    name: str
    layout: str | None
    words: str
    log_evidence: float
    unexplained: float
    centre_m: tuple[float, float]
    radius_m: float | None = None
    outline_m: tuple[tuple[float, float], ...] = ()

    @property
    def residual_words(self) -> str:
        """The residual share in words."""
        percent = 100 * self.unexplained
        return f"{percent:.{0 if percent >= 9.95 else 1}f} % unexplained"


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residual range profiles of the echo that changes over the views, for the first hypotheses.

    Attributes:
        angle_rad: (V,) direction of the antenna, as the object sees it.
        range_m: (R,) beyond the axis distance, m.
        recorded: (R, V) magnitude of the recording, over the root mean square of the noise.
        by_hypothesis: (H, R, V) the same of the residuals of the first hypotheses.
    """

    angle_rad: NDArray[np.float64]
    range_m: NDArray[np.float64]
    recorded: NDArray[np.float16]
    by_hypothesis: NDArray[np.float16]


@dataclass(frozen=True, eq=False)
class Reading:
    """What the scans say.

    Attributes:
        status: "identified", "unknown", "ambiguous" or "no_tag".
        reason: why it is not identified, in words; empty otherwise.
        code: the same for programs.
        layout: name of the layout; the likelier one where ambiguous, None where unknown or no tag.
        nearest: name of the likeliest layout whatever the status.
        lead: Lambda, log evidence of the likeliest that has a name over the best other hypothesis, nats.
        needed: lead from which a name is given, nats.
        score: 0..1, share of the moving echo above noise that the nearest layout's hypothesis explains.
        margin: 0..1, 1 - exp(-lead).
        rotation_deg: counter-clockwise rotation of the layout, within its symmetry.
        centre_m: where the layout's origin lies, m.
        offset_m: range offset, i.e. the error of the axis distance, m.
        reflectors: where they were measured: those of the layout (matched), and odd scatterers.
        missing, extra: reflectors less and more than those of the nearest layout.
        scores: every layout, best first.
        kind: of the hypothesis that won.
        hypotheses: the best of every kind, best first; the first is the one that won.
        bound: what `tags.false_accept` rests on; None where no calibration applies.
        winner: the hypothesis that won.
        residuals: what the first of the hypotheses leave.
        note: what limits the answer; empty for nothing.
    """

    status: str
    reason: str
    layout: str | None
    nearest: str
    lead: float
    needed: float
    score: float
    margin: float
    rotation_deg: float
    centre_m: tuple[float, float]
    offset_m: float
    reflectors: tuple[Reflector, ...]
    missing: int
    extra: int
    scores: tuple[LayoutScore, ...]
    code: Code = Code.NONE
    kind: Kind = Kind.BARE
    hypotheses: tuple[Explanation, ...] = ()
    bound: Bound | None = None
    winner: Hypothesis | None = None
    residuals: Residuals | None = None
    note: str = ""

    @property
    def explained_by(self) -> Explanation | None:
        """The hypothesis that won; None where nothing was compared."""
        return next(iter(self.hypotheses), None)

    @property
    def advice(self) -> str:
        """What to do next; empty where a layout is named."""
        return ADVICE[self.code]

    def moved(self, by: complex) -> Reading:
        """The same with all places so much farther, x + jy, m."""
        if not by:
            return self

        def there(place: tuple[float, float]) -> tuple[float, float]:
            return place[0] + by.real, place[1] + by.imag

        return replace(
            self,
            centre_m=there(self.centre_m),
            reflectors=tuple(
                replace(reflector, x_m=reflector.x_m + by.real, y_m=reflector.y_m + by.imag)
                for reflector in self.reflectors
            ),
            hypotheses=tuple(
                replace(
                    explanation,
                    centre_m=there(explanation.centre_m),
                    outline_m=tuple(map(there, explanation.outline_m)),
                )
                for explanation in self.hypotheses
            ),
            winner=None if self.winner is None else self.winner.moved(by, 0.0),
        )

    def refused(self, code: Code, reason: str) -> Reading:
        """The same without its name."""
        return replace(self, status="unknown", layout=None, code=code, reason=reason)
