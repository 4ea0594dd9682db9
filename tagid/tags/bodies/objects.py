"""Enrolled objects in a capture: how much each leaves unexplained, and when one is named.

An object is compared as a whole: its signature has no freedom but pose and gain, so what it leaves must be
noise. How strict that is depends on what its tag adds to the body, which is known where the body is enrolled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from tagid.tags.bodies.hypothesis import ObjectMatch, ObjectModel
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.verdicts.verdict import Code, Verdict


@dataclass(frozen=True)
class ObjectDecision:
    """Tests that an enrolled object must pass. Energies are those beyond the noise.

    Attributes:
        gain: the object explains so many noise energies more than the best body without a tag.
        noise: it leaves at most this share of the noise energy (which is known to 25 %),
        tag: and this share of what it explains beyond the best body without a tag,
        model: plus this share of what it explains beyond a body of revolution. Full-wave objects leave up to
            0.03 % of that at the distance of their enrolment; the same object with one reflector of its tag
            missing, on a handle 17 dB over the tag, leaves 1.2 %.
        stray_nats: a single reflector explains no more of what is left than noise may, in variances: over 400
            places noise reaches 14, and 20 in one of 10^5 captures; or no more than `model` allows.
        second: another object that leaves at most so many noise energies more is as good.
    """

    gain: float = 0.5
    noise: float = 0.35
    tag: float = 0.10
    model: float = 0.003
    stray_nats: float = 20.0
    second: float = 0.5


@dataclass(frozen=True)
class ObjectReading:
    """One enrolled object in a capture.

    Attributes:
        model: the object.
        match: its pose and the energy left.
        excess: energy left beyond noise, in noise energies; may be slightly negative.
        beyond_round: energy explained beyond a body of revolution, in noise energies.
        beyond_body: the same beyond the best body without a tag, enrolled ones included.
        stray: energy of the strongest reflector in what it leaves, in noise energies; 0 for all but the
            object that leaves least.
        stray_nats: the same over the variance of what is left.
    """

    model: ObjectModel
    match: ObjectMatch
    excess: float
    beyond_round: float
    beyond_body: float
    stray: float = 0.0
    stray_nats: float = 0.0

    def model_error(self, settings: ObjectDecision) -> float:
        """Energy that the error of the signature itself may leave, in noise energies."""
        tag = settings.tag * max(self.beyond_body, 0.0)
        return min(settings.model * max(self.beyond_round, 0.0), tag)

    def allowed(self, settings: ObjectDecision) -> float:
        """The largest excess with which it is named, in noise energies."""
        tag = settings.tag * max(self.beyond_body, 0.0)
        return min(settings.noise, tag) + self.model_error(settings)

    def has_stray(self, settings: ObjectDecision) -> bool:
        """Whether a reflector that the object does not have stands in what it leaves."""
        return self.stray_nats > settings.stray_nats and self.stray > self.model_error(settings)


def read_objects(
    spectra: Spectra, objects: Sequence[ObjectModel], round_left: float, body_left: float
) -> list[ObjectReading]:
    """Every enrolled object in a capture, the one that leaves least first.

    Args:
        spectra: capture, at the frequencies of the signatures.
        objects: enrolled ones.
        round_left: energy that a body of revolution leaves.
        body_left: energy that the best body without a tag leaves.
    """
    noise = max(spectra.noise_energy, 1e-9 * spectra.energy)
    found = []
    for model in objects:
        one = model.match(spectra)
        excess = one.left / noise - 1 - min(one.noise_share, 1.0)
        found.append(
            ObjectReading(model, one, excess, (round_left - one.left) / noise, (body_left - one.left) / noise)
        )
    found.sort(key=lambda reading: reading.match.left)
    if found:
        stray = found[0].model.stray(found[0].match)
        found[0] = replace(found[0], stray=stray.energy / noise, stray_nats=stray.nats)
    return found


def decide_object(readings: Sequence[ObjectReading], settings: ObjectDecision) -> Verdict:
    """The verdict on the object that leaves least."""
    if not readings:
        return Verdict("unknown", Code.UNEXPLAINED, "no object is enrolled")
    best = readings[0]
    name = best.model.name
    if best.beyond_body <= settings.gain:
        return Verdict("unknown", Code.WEAK, f"the tag of {name} does not stand out of its body's echo")
    if best.excess > best.allowed(settings):
        left = max(best.excess, 0.0) / max(best.beyond_round, 1e-9)
        return Verdict(
            "unknown",
            Code.UNEXPLAINED,
            f"the enrolled object {name} leaves {min(left, 1):.1%} of the turning echo unexplained",
        )
    if best.has_stray(settings):
        return Verdict(
            "unknown", Code.UNEXPLAINED, f"a reflector shows that the enrolled object {name} does not have"
        )
    for other in readings[1:]:
        if other.excess - best.excess < settings.second and other.model.name != name:
            return Verdict(
                "ambiguous", Code.AMBIGUOUS, f"{name} and {other.model.name} explain the echo about equally"
            )
    return Verdict("identified")
