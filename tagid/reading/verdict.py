"""What an answer that names nothing is called by programs, and what to do about it."""

from __future__ import annotations

from enum import StrEnum


class Code(StrEnum):
    """Reason codes of answers that name nothing; stable, for programs."""

    NONE = ""
    NO_ECHO = "no_echo"
    NO_TAG = "no_tag"
    MISSING = "reflector_missing"
    EXTRA = "reflector_extra"
    DISPLACED = "reflectors_displaced"
    OTHER = "another_arrangement"
    RADIUS = "another_radius"
    WEAK = "too_weak"
    AMBIGUOUS = "two_layouts"
    UNCALIBRATED = "not_calibrated"
    DISAGREE = "recordings_disagree"
    STOPPED = "turn_stopped"
    PARTIAL = "partial_turn"


_LARGER = "use a larger reflector or more integration (radar.integration)"
ADVICE = {
    Code.NONE: "",
    Code.NO_ECHO: f"Check that the object lies in the range window and turns, or {_LARGER}.",
    Code.NO_TAG: (
        f"If the object carries a tag, {_LARGER}, or enroll the body if it has a handle, a rim or flat sides."
    ),
    Code.MISSING: "Check that every reflector of the tag is in place and as large as the others.",
    Code.EXTRA: "Remove what is not of the tag, or enroll the body if it has a handle, or the tag as it is.",
    Code.DISPLACED: "Put the reflectors back in their places, or enroll the tag as it is.",
    Code.OTHER: (
        "Enroll the tag if it is new, or the body if it has a handle, a rim or flat sides; otherwise record "
        f"more views, or {_LARGER}."
    ),
    Code.RADIUS: "Check the reflectors' distance from the axis, or enroll the tag as it is.",
    Code.WEAK: f"Record more views, or {_LARGER}.",
    Code.AMBIGUOUS: "Record more views, or enroll layouts that differ more.",
    Code.UNCALIBRATED: "Record 24 views or more, or accept a larger tags.false_accept.",
    Code.DISAGREE: "Check that all recordings are of one object, and record it again.",
    Code.STOPPED: "Check what holds the table, and its supply, then record a full turn again.",
    Code.PARTIAL: "Record the object from all sides: slightly more than one full turn.",
}
"""One sentence for each code: what to do next."""
