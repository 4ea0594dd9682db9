"""What the calibration promises for a name on a body, and whether that is what the setting asks for."""

from __future__ import annotations

from tagid.tags.bodies.body_reading import BodyReading
from tagid.tags.bodies.calibration import Bound, Calibration
from tagid.tags.bodies.decide import BodyDecision, score, tag_snr_db
from tagid.tags.verdicts.verdict import Code, Verdict


def bound_on_body(
    reading: BodyReading, decision: BodyDecision, calibration: Calibration, false_accept: float
) -> Bound:
    """What is promised for a name on a body; without objects where such readings were not calibrated.

    Args:
        reading: whose best layout is named.
        decision: its tests.
        calibration: in force.
        false_accept: probability of naming an object of its population that may be reached.
    """
    terms, snr_db = int(reading.layouts[0].batch.terms[0]), tag_snr_db(reading)
    if reading.wall is None and terms > calibration.terms:
        return Bound(1.0, false_accept, 0, f"patterns of {terms} terms", calibration.population)
    return calibration.bound(score(reading, decision), reading.views, snr_db, false_accept)


def kept(bound: Bound, verdict: Verdict) -> Verdict:
    """A verdict that names a layout, taken back where objects without the tag were as convincing."""
    if not bound.reachable:
        return Verdict(
            "unknown",
            Code.UNCALIBRATED,
            f"{bound.objects} calibration objects of {bound.stratum} do not bear out a false-accept "
            f"probability of {bound.false_accept:g}",
        )
    if not bound.kept:
        return Verdict(
            "unknown",
            Code.WEAK,
            f"a share of {bound.p_value:.2g} of the objects without an enrolled tag is as convincing, "
            f"{bound.false_accept:g} is allowed",
        )
    return verdict
