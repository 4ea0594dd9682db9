"""Readings of views from several antenna heights, which only the hypothesis of a tag without a body can
explain.

Models of bodies hold for one antenna height, so what they would say is missing, and the answer says so.
"""

from __future__ import annotations

from dataclasses import replace

from tagid.tags.matching.contest_settings import ContestSettings
from tagid.tags.matching.reading import Reading
from tagid.tags.verdicts.verdict import Code

NOTE = (
    "several antenna heights were read together, which compares tags without a body only; read one height by "
    "itself for tags on bodies and enrolled objects"
)


def without_bodies(bare: Reading, settings: ContestSettings) -> Reading:
    """The bare reading, refused where a body would have taken part if there were one antenna height.

    Args:
        bare: reading of the scans without a body.
        settings: of the comparison with bodies: what a bare name has to explain.
    """
    if bare.status not in ("identified", "ambiguous"):
        return replace(bare, note=NOTE)
    if bare.evidence.share >= settings.explained and bare.evidence.outward <= settings.outward:
        return replace(bare, note=NOTE)
    reason = f"the nearest layout explains {bare.evidence.share:.0%} of the echo"
    if bare.evidence.share >= settings.explained:
        reason = "the reflectors are visible from outside only"
    refused = bare.refused(
        Code.BODY, f"{reason}, and bodies cannot be read from several antenna heights together"
    )
    return replace(refused, note=NOTE)
