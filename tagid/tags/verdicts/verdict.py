"""What a reading comes to: the status, and for a refusal a code, the reason and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

NO_NAMES = ("no_tag", "unknown", "ambiguous", "failed")
"""Answers that name nothing."""


class Code(StrEnum):
    """Reason codes of answers that name nothing; stable, for programs."""

    NONE = ""
    NO_ECHO = "no_echo"
    NO_TAG = "no_tag"
    UNEXPLAINED = "unexplained"
    BODY = "body_unknown"
    MISSING = "reflector_missing"
    EXTRA = "reflector_extra"
    ELSEWHERE = "reflectors_elsewhere"
    DISPLACED = "reflectors_displaced"
    HIDDEN = "reflectors_hidden"
    OTHER = "another_arrangement"
    RADIUS = "another_radius"
    OFF_CENTRE = "off_centre"
    WEAK = "too_weak"
    AMBIGUOUS = "two_layouts"
    UNCALIBRATED = "not_calibrated"
    DISAGREE = "recordings_disagree"
    STOPPED = "turn_stopped"
    PARTIAL = "partial_turn"


_BODY = "if it has a handle, a rim or flat sides"
_LARGER = "use a larger reflector or more integration (radar.integration)"
ADVICE = {
    Code.NONE: "",
    Code.NO_ECHO: f"Check that the object lies in the range window and turns, or {_LARGER}.",
    Code.NO_TAG: f"If the object carries a tag, {_LARGER}.",
    Code.UNEXPLAINED: f"Enrol the tag if it is new, or the body {_BODY}.",
    Code.BODY: "Enrol the body: it is not round, and its own echo covers the tag's.",
    Code.MISSING: "Check that every reflector of the tag is in place and as large as the others.",
    Code.EXTRA: "Remove what does not belong to the tag, or enrol the tag as it is.",
    Code.ELSEWHERE: f"Enrol the tag if it is new, or the body {_BODY}; otherwise record more views.",
    Code.DISPLACED: "Put the reflectors back in their places, or enrol the tag as it is.",
    Code.HIDDEN: "Mount the reflectors on the outside of the object.",
    Code.OTHER: (
        f"Enrol the tag if it is new, or the body {_BODY}; otherwise record more views, or {_LARGER}."
    ),
    Code.RADIUS: "Check the reflectors' distance from the axis, or enrol the tag as it is.",
    Code.OFF_CENTRE: "Place the object within 10 mm of the rotation axis.",
    Code.WEAK: f"Record more views, or {_LARGER}.",
    Code.AMBIGUOUS: "Record more views, or enrol layouts that differ more.",
    Code.UNCALIBRATED: "Record 12 views or more, or accept a larger tags.false_accept.",
    Code.DISAGREE: "Check that all recordings are of one object, and record it again.",
    Code.STOPPED: "Check what holds the table, and its supply, then record a full turn again.",
    Code.PARTIAL: "Record the object from all sides: slightly more than one full turn.",
}
"""One sentence for each code: what to do next."""


@dataclass(frozen=True)
class Verdict:
    """The outcome of a decision.

    Attributes:
        status: "identified", "ambiguous", "unknown" or "no_tag".
        code: why nothing is named; `Code.NONE` where a layout is.
        reason: the same in words, with the numbers.
    """

    status: str
    code: Code = Code.NONE
    reason: str = ""

    @property
    def advice(self) -> str:
        """What to do next; empty if a layout is named."""
        return ADVICE[self.code]
