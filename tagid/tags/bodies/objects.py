"""Enrolled objects in a capture: how much each leaves unexplained, and when one is named.

An object is compared as a whole: its signature has no freedom but pose and gain, so what it leaves must be
noise. How strict that is depends on what its tag adds to the body, which is known where the body is enrolled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from tagid.tags.bodies.arrangement import off_axis
from tagid.tags.bodies.hypothesis import BodyModel, Enrolled, ObjectMatch, ObjectModel
from tagid.tags.bodies.pulse_tail import AMPLITUDES
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.layouts.layout import Layout
from tagid.tags.verdicts.verdict import Code, Verdict


@dataclass(frozen=True)
class ObjectDecision:
    """Tests that an enrolled object must pass. Energies are those beyond the noise.

    Attributes:
        gain_nats: the object explains so many noise variances more than the best body without a tag.
        reflector_nats: a reflector of its tag returns so many noise variances at least: of an object whose
            tag is hidden in the noise, nobody can say whether it is there.
        least_share: a reflector is supposed to return so much of the object's turning echo, 20 dB below it,
            where its layout is not known or does not stand out of the signature: of a mug with a handle that
            is 17 dB over the tag it returns 1.2 %.
        noise: it leaves at most this share of the noise energy (which is known to 25 %),
        tag: and this share of what it explains beyond the best body without a tag, or of the noise energy
            what `level` says,
        level: which does not tell a weak tag's remains from the error of the noise's level,
        model: plus this share of what it explains beyond a body of revolution. Full-wave objects leave up to
            0.03 % of that at the distance of their enrolment; the same object with one reflector of its tag
            missing, on a handle 17 dB over the tag, leaves 1.2 %.
        stray_nats, most_stray_nats: a single reflector explains no more of what is left than noise may, in
            variances: over 400 places noise reaches 12; a quarter of what a reflector of its tag returns
            where that is between the two; or no more than `model` allows,
        part: and this part of what a reflector of its tag returns.
        second: another object that leaves at most so many noise energies more is as good.
    """

    gain_nats: float = 120.0
    reflector_nats: float = 24.0
    least_share: float = 0.01
    noise: float = 0.35
    tag: float = 0.10
    level: float = 0.2
    model: float = 0.003
    stray_nats: float = 14.0
    most_stray_nats: float = 24.0
    part: float = 0.15
    second: float = 0.5


@dataclass(frozen=True)
class ObjectReading:
    """One enrolled object in a capture.

    Attributes:
        model: the object.
        match: its pose and the energy left.
        nats: noise variances in one noise energy.
        excess: energy left beyond noise, in noise energies; may be slightly negative.
        beyond_round: energy explained beyond a body of revolution, in noise energies.
        beyond_body: the same beyond the best body without a tag, enrolled ones included.
        reflector: energy that a reflector of its tag returns at least, in noise energies; 0 for all but the
            object that leaves least, and where it leaves too much.
        stray: energy of the strongest reflector in what it leaves, in noise energies; 0 for all but the
            object that leaves least.
        stray_nats: the same over the variance of what is left.
    """

    model: ObjectModel
    match: ObjectMatch
    nats: float
    excess: float
    beyond_round: float
    beyond_body: float
    reflector: float = 0.0
    stray: float = 0.0
    stray_nats: float = 0.0

    def model_error(self, settings: ObjectDecision) -> float:
        """Energy that the error of the signature itself may leave, in noise energies."""
        tag = settings.tag * max(self.beyond_body, 0.0)
        return min(settings.model * max(self.beyond_round, 0.0), tag)

    def allowed(self, settings: ObjectDecision) -> float:
        """The largest excess with which it is named, in noise energies."""
        tag = settings.tag * max(self.beyond_body, 0.0)
        return min(settings.noise, max(tag, settings.level)) + self.model_error(settings)

    def has_stray(self, settings: ObjectDecision) -> bool:
        """Whether a reflector that the object does not have stands in what it leaves."""
        quarter = max(0.25 * self.reflector * self.nats, settings.stray_nats)
        least = min(self.model_error(settings), settings.part * self.reflector)
        return self.stray_nats > min(quarter, settings.most_stray_nats) and self.stray > least


def read_objects(
    spectra: Spectra,
    enrolled: Enrolled,
    layouts: Sequence[Layout],
    round_left: float,
    body_left: float,
    settings: ObjectDecision,
    seen: Layout | None = None,
) -> list[ObjectReading]:
    """Every enrolled object in a capture, the one that leaves least first.

    Args:
        spectra: capture, at the frequencies of the signatures.
        enrolled: bodies and objects.
        layouts: enrolled ones; an object's may be among them.
        round_left: energy that a body of revolution leaves.
        body_left: energy that the best body without a tag leaves.
        settings: of the tests.
        seen: the layout that was found on a body; then all its reflectors were.
    """
    noise = max(spectra.noise_energy, 1e-9 * spectra.energy)
    nats = float(len(spectra.data) * (spectra.views - 1))
    free = (AMPLITUDES - 1) / (spectra.views - 1)
    found = []
    for model in enrolled.objects:
        one = model.match(spectra)
        excess = one.left / noise - (1 - free) - min(one.noise_share, 1.0)
        beyond_round, beyond_body = (round_left - one.left) / noise, (body_left - one.left) / noise
        found.append(ObjectReading(model, one, nats, excess, beyond_round, beyond_body))
    found.sort(key=lambda reading: reading.match.left)
    if found:
        best = found[0]
        stray = best.model.stray(best.match)
        # It takes as long as all the rest, and says nothing of an object that is not there.
        explains = best.excess <= best.allowed(settings)
        reflector = _reflector(best, enrolled.bodies, layouts, settings, seen) if explains else 0.0
        found[0] = replace(best, reflector=reflector, stray=stray.energy / noise, stray_nats=stray.nats)
    return found


def _reflector(
    reading: ObjectReading,
    bodies: Sequence[BodyModel],
    layouts: Sequence[Layout],
    settings: ObjectDecision,
    seen: Layout | None,
) -> float:
    """What a reflector of the object's tag returns at least, in noise energies."""
    beyond_round, beyond_body = max(reading.beyond_round, 0.0), max(reading.beyond_body, 0.0)
    layout = next((one for one in layouts if one.name == reading.model.layout), None)
    if seen is not None and (layout is None or seen.name == layout.name):
        return beyond_body / max(len(off_axis(seen)[0]), 1)
    share = settings.least_share
    if layout is not None:
        share = max(reading.model.reflector_share(layout, bodies), share)
    # All that is beyond the body is the tag's.
    most = beyond_body / max(len(off_axis(layout)[0]), 1) if layout is not None else beyond_body
    return min(share * beyond_round, most)


def decide_object(readings: Sequence[ObjectReading], settings: ObjectDecision) -> Verdict:
    """The verdict on the object that leaves least."""
    if not readings:
        return Verdict("unknown", Code.UNEXPLAINED, "no object is enrolled")
    best = readings[0]
    name = best.model.name
    if best.beyond_body * best.nats <= settings.gain_nats:
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
    if best.reflector * best.nats <= settings.reflector_nats:
        return Verdict("unknown", Code.WEAK, f"a reflector that {name} lacks would not show in this noise")
    for other in readings[1:]:
        if other.excess - best.excess < settings.second and other.model.name != name:
            return Verdict(
                "ambiguous", Code.AMBIGUOUS, f"{name} and {other.model.name} explain the echo about equally"
            )
    return Verdict("identified")
