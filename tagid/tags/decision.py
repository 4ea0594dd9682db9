"""When to say a name, and when to say that none is known: every threshold of the reader with its reason.

A wrong name costs more than a question, so each test can only take a name away.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DecisionSettings:
    """Thresholds of the decision.

    Attributes:
        null_nats: explained energy over the noise level, less 3 K, under which there is no tag. The search
            tries about e^9 independent places; the tail of a Gamma(K) beyond 24 + 3 K is under e^-16.
            Recordings of noise alone reach 20.
        explained_share: least share of the energy above noise that the layout explains.
        free_share: as many points placed freely may explain this much more than the layout, of its energy;
            more means that the echo is of something else.
        missing_share: a reflector weaker than this share of the layout's median is missing; less two standard
            deviations of a measured amplitude, but never under `missing_least`.
        extra_share: an unexplained point stronger than this share of the layout's median is extra.
        displacement_m: RMS distance of freely fitted reflectors from the layout's, above which it is
            another layout; four standard deviations of a measured position are added. A quarter of the
            smallest distance that enrolment accepts.
        ambiguous_share: a runner-up within this share of the best's explained energy is as good, since
            wobble, aspect and focus leave errors of that size.
        ambiguous_nats: and so is one within this many noise levels.
    """

    null_nats: float = 24.0
    explained_share: float = 0.45
    free_share: float = 0.2
    free_nats: float = 10.0
    missing_share: float = 0.55
    missing_least: float = 0.35
    extra_share: float = 0.5
    displacement_m: float = 3e-3
    ambiguous_share: float = 0.08
    ambiguous_nats: float = 12.0


@dataclass(frozen=True)
class Evidence:
    """What the decision is taken from.

    Attributes:
        size: reflectors of the best layout.
        nats: its explained energy over the level of noise and clutter left.
        share: its part of the energy above noise.
        weakest: weakest reflector's amplitude over the median.
        missing, extra: reflectors missing from and beyond the layout.
        free_share, free_nats: what as many free points explain more, of the layout's energy and in noise
            levels.
        displacement_m: RMS distance of freely fitted reflectors from the layout's places.
        displacement_sigma_m: standard deviation of one measured position.
        margin_share, margin_nats: the best's lead over the runner-up, of its energy and in noise levels.
    """

    size: int
    nats: float
    share: float
    weakest: float
    missing: int
    extra: int
    displacement_m: float
    displacement_sigma_m: float
    margin_share: float
    margin_nats: float
    free_share: float
    free_nats: float


def decide(evidence: Evidence, settings: DecisionSettings) -> tuple[str, str]:
    """Status (identified, unknown, ambiguous or no_tag) and the reason in words."""
    e = evidence
    if e.nats < settings.null_nats + 3 * e.size:
        return "no_tag", "nothing stands out of noise and clutter"
    if e.share < settings.explained_share:
        return "unknown", f"the nearest layout explains {e.share:.0%} of the echo"
    if e.extra:
        return "unknown", f"{e.extra} strong reflector(s) beyond the nearest layout"
    if e.missing:
        return "unknown", f"{e.missing} reflector(s) of the nearest layout are missing"
    if e.free_share > settings.free_share and e.free_nats > settings.free_nats:
        return "unknown", f"as many points elsewhere explain {e.free_share:.0%} more than the nearest layout"
    if e.displacement_m > settings.displacement_m + 4 * e.displacement_sigma_m:
        return "unknown", f"reflectors lie {e.displacement_m * 1e3:.1f} mm from the nearest layout's"
    if e.margin_share < settings.ambiguous_share or e.margin_nats < settings.ambiguous_nats:
        return "ambiguous", "two layouts explain the echo almost equally well"
    return "identified", ""
