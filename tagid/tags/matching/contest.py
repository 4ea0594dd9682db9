"""The hypotheses compete: no tag, bare, on a round body, on each enrolled body, each enrolled object.

The bare reading stands where it explains the echo. Otherwise a body takes part, and a name needs a hypothesis
that passes its own decision and is not contradicted by one that explains the echo much better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from tagid.imaging.types import BasebandScans
from tagid.tags.bodies.arrangement import difference_deg, gaps_deg, layout_gaps_deg
from tagid.tags.bodies.body_reading import BodyReading
from tagid.tags.bodies.calibration import Bound, Calibration
from tagid.tags.bodies.decide import decide_on_body, score, tag_snr_db
from tagid.tags.bodies.hypothesis import Enrolled, Explanation, Kind, Pose, plausible
from tagid.tags.bodies.middle import contradicts
from tagid.tags.bodies.objects import ObjectReading, decide_object, read_objects
from tagid.tags.bodies.points import PointReading
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.layouts.layout import Layout
from tagid.tags.matching.alone import (
    in_place,
    is_silent,
    pointed,
    points_of,
    promised,
    undisputed,
    without_body,
)
from tagid.tags.matching.bare_checks import checked
from tagid.tags.matching.beside import borne_out, disputed, is_doubted, outdone, read_beside_wall
from tagid.tags.matching.contest_settings import ContestSettings
from tagid.tags.matching.delayed import pair_on_thin_wall, undelayed
from tagid.tags.matching.promise import bound_on_body, kept
from tagid.tags.matching.reading import Reading
from tagid.tags.matching.won import hypothesis_on, kind_on, on_body, on_object
from tagid.tags.verdicts.verdict import Code, Verdict

ENOUGH_BODIES = 2
"""Enrolled bodies that are read in any case; more only while a layout on none of them explains the echo."""
EXPLAINED_OBJECTS = 3
"""Enrolled objects reported among the hypotheses, the best ones."""


def settle(
    bare: Reading,
    scans: BasebandScans,
    layouts: Sequence[Layout],
    enrolled: Enrolled,
    settings: ContestSettings,
    *,
    direction_known: bool = True,
) -> Reading:
    """The bare reading, or what the hypothesis that won instead of it says.

    Args:
        bare: reading of the scans without a body.
        scans: the same scans, at most a turn of folded views.
        layouts: the enrolled ones.
        enrolled: bodies and objects.
        settings: see there.
        direction_known: whether layouts are known from their mirror images; points are fitted only then.
    """
    settled, points = _weighed(bare, scans, layouts, enrolled, settings, direction_known)
    return promised(settled, points, scans.aperture.views, settings)


def _weighed(
    bare: Reading,
    scans: BasebandScans,
    layouts: Sequence[Layout],
    enrolled: Enrolled,
    settings: ContestSettings,
    direction_known: bool = True,
) -> tuple[Reading, PointReading | None]:
    """What `settle` says before the bound of names without a body, and the points that the scans show."""
    own = _own(bare)
    opaque = bare.evidence.outward > settings.outward
    spectra = Spectra.of(scans, wavenumbers=enrolled.wavenumbers)
    points = None
    if not is_silent(bare, spectra) and direction_known:
        points = points_of(bare, spectra, layouts, settings.points)
        bare = in_place(bare, points, settings.points)
    done = without_body(bare, points, layouts, settings)
    if done is not None:
        borne = checked(done, points, spectra, layouts, settings.bare, opaque=opaque)
        if borne.status != done.status:
            # A name that no points bear out may be that of reflectors on a body.
            done, bare = None, borne
        elif points is not None and _leaves_much(done, points, enrolled, settings):
            # It may be the echo of a body, and of something on it.
            done, bare = None, borne
            own = replace(own, left=max(own.left, min(points.unexplained, 1.0)))
        else:
            if points is not None and pointed(bare, points, settings):
                own = replace(own, layout=done.layout, left=float(np.clip(points.unexplained, 0, 1)))
            settled = replace(borne, hypotheses=(own,))
    if done is None:
        settled = _against_bodies(_Bare(bare, own, points, opaque), spectra, layouts, enrolled, settings)
        settled = checked(settled, points, spectra, layouts, settings.bare, opaque=opaque)
    settled = undisputed(settled, points, spectra, layouts, settings)
    return undelayed(settled, points, spectra, layouts, settings), points


def _leaves_much(done: Reading, points: PointReading, enrolled: Enrolled, settings: ContestSettings) -> bool:
    """Whether points leave so much that a body takes part: an enrolled one, or any where none is named."""
    asked = bool(enrolled.bodies) or done.status == "ambiguous"
    return asked and points.unexplained > settings.bare.unexplained


@dataclass(frozen=True)
class NullEvidence:
    """What the calibration orders: the evidence for a name, -inf where a test refuses it in any case.

    Attributes:
        round: on a body of revolution (`score`).
        wall: beside a wall of known waves, where the reading above is refused, or beside a thin one.
        bare: without a body (`PointReading.lead`).
        snr_db: energy of what is not of the body over that of the noise.
    """

    round: float
    wall: float
    bare: float
    snr_db: float


def bare_evidence(
    bare: Reading,
    points: PointReading,
    scans: BasebandScans,
    layouts: Sequence[Layout],
    settings: ContestSettings,
) -> float:
    """The evidence for a wrong name without a body, -inf where `settle` gives none."""
    placed = in_place(bare, points, settings.points)
    if (without_body(placed, points, layouts, settings) or placed).status != "identified":
        return -inf
    freely = replace(settings, calibrated=Calibration("none", (), {}))
    last, _ = _weighed(bare, scans, layouts, Enrolled(), freely)
    return points.lead if (last.status, last.kind) == ("identified", Kind.BARE) else -inf


def null_evidence(
    bare: Reading,
    scans: BasebandScans,
    layouts: Sequence[Layout],
    settings: ContestSettings,
    *,
    bodies: bool = True,
) -> NullEvidence:
    """The evidence for a wrong name that an object without an enrolled tag gives, as `settle` weighs it.

    Args:
        bare: reading of the scans without a body.
        scans, layouts, settings: as of `settle`.
        bodies: False leaves out the round body, which takes three quarters of the time.
    """
    from tagid.tags.bodies.on_body import read_on_body

    spectra = Spectra.of(scans)
    points, alone = None, -inf
    if not is_silent(bare, spectra):
        points = points_of(bare, spectra, layouts, settings.points)
        alone = bare_evidence(bare, points, scans, layouts, settings)
        bare = in_place(bare, points, settings.points)
    if not bodies:
        return NullEvidence(-inf, -inf, alone, points.snr_db if points is not None else 0.0)
    reading = read_on_body(spectra, layouts, settings.body.body, settings.body, [complex(*bare.centre_m)])
    if reading is None:
        return NullEvidence(-inf, -inf, alone, 0.0)
    known = _Bare(bare, _own(bare), points, bare.evidence.outward > settings.outward)
    reading = reading.against(points) if points is not None else reading
    done = without_body(bare, points, layouts, settings)
    if done is not None:
        done = checked(done, points, spectra, layouts, settings.bare, opaque=known.opaque)
        if points is not None and _leaves_much(done, points, Enrolled(), settings):
            done = None
    if done is not None and done.status != "unknown":
        # `settle` asks no body.
        return NullEvidence(-inf, -inf, alone, tag_snr_db(reading))
    evidence = score(reading, settings.decision) if _shows(known, reading, settings) else -inf
    walled = -inf
    if decide_on_body(reading, settings.decision).status != "no_tag":
        beside = read_beside_wall(reading, points, layouts, settings.body)
        if beside is not None and _shows(known, beside, settings):
            walled = score(beside, settings.decision)
    if points is not None:
        delayed = pair_on_thin_wall(done or bare, points, spectra, layouts, settings)
        walled = max(walled, delayed.lead if delayed is not None else -inf)
    return NullEvidence(evidence, walled, alone, tag_snr_db(reading))


def _own(bare: Reading) -> Explanation:
    """The bare reading as a hypothesis."""
    left = float(np.clip(1 - bare.evidence.share, 0, 1))
    return Explanation(Kind.BARE, "", bare.layout, left, None, Pose(bare.centre_m), bare.rotation_deg)


@dataclass(frozen=True, eq=False)
class _Bare:
    """What is known before bodies take part.

    Attributes:
        reading: without a body.
        own: the same as a hypothesis.
        points: fit of points with double bounce; None where nothing stands out of the noise.
        opaque: the reflectors shine outward only.
    """

    reading: Reading
    own: Explanation
    points: PointReading | None
    opaque: bool


def _against_bodies(
    known: _Bare,
    spectra: Spectra,
    layouts: Sequence[Layout],
    enrolled: Enrolled,
    settings: ContestSettings,
) -> Reading:
    """The bare reading against layouts on bodies, and enrolled objects."""
    from tagid.tags.bodies.on_body import read_on_body

    bare, own = known.reading, known.own
    named = bare.status in ("identified", "ambiguous")
    hints = [complex(*bare.centre_m)]
    readings: list[tuple[BodyReading, Verdict]] = []
    # What each enrolled body says, with a free pattern and beside its wall.
    on_known: list[BodyReading] = []
    for body in (settings.body.body, *plausible(spectra, enrolled.bodies)):
        explained = any(v.status == "identified" for r, v in readings if r.body.name)
        if explained and len(readings) > ENOUGH_BODIES:
            break
        # Where an enrolled body alone explains the echo nothing else is named.
        empty = any(v.status == "no_tag" for r, v in readings if r.body.name)
        reading = read_on_body(spectra, layouts, body, settings.body, hints)
        if reading is not None and body.name and readings and not explained:
            reading = _clearer(reading, readings[0][0], spectra, layouts, settings)
        if reading is not None:
            reading = reading.against(known.points) if known.points is not None else reading
            verdict = _judged(known, reading, layouts, settings)
            # Where no body shows, no name beside a wall would stand.
            hopeful = _shows(known, reading, settings) and not outdone(reading, on_known, settings)
            doubted = is_doubted(reading, verdict, hopeful)
            on_known += [reading] if body.name else []
            if doubted and not empty and body.turning_share < settings.turning:
                beside = read_beside_wall(reading, known.points, layouts, settings.body)
                on_known += [beside] if body.name and beside is not None else []
                reading, verdict = _after_wall(known, reading, verdict, beside, layouts, settings)
            if body.name and readings:
                verdict = _borne_out(reading, verdict, readings[0][0], settings)
            readings.append((reading, verdict))
    if not readings:
        return replace(bare, hypotheses=(own,))
    readings = [(r, _outdone(r, v, on_known, settings)) for r, v in readings]
    explanations = [own, *_explanations(readings)]
    # An enrolled body alone explains the echo: a layout on another body only imitates it.
    alone = [(r, v) for r, v in readings if r.body.name and v.status == "no_tag"]
    passed = [] if alone else [(r, v) for r, v in readings if v.status == "identified"]
    seen = min((r for r, _ in passed), key=lambda r: r.layouts[0].left, default=None)
    objects = read_objects(
        spectra,
        enrolled,
        layouts,
        readings[0][0].body_left,
        min(r.body_left for r, _ in readings),
        settings.objects,
        next((one for one in layouts if seen is not None and one.name == seen.layouts[0].layout), None),
    )
    explanations += [_object_explanation(spectra, one) for one in objects[:EXPLAINED_OBJECTS]]
    bare = replace(bare, hypotheses=tuple(sorted(explanations, key=lambda e: e.left)))
    if objects:
        whole = decide_object(objects, settings.objects)
        fitted = min((r for r, _ in readings), key=lambda r: r.least)
        shown = fitted if _shows(known, fitted, settings) else None
        if whole.status == "identified":
            return on_object(bare, objects[0], passed, settings.objects.second, shown)
        if whole.status == "ambiguous" and not passed:
            return replace(
                bare,
                status="ambiguous",
                layout=objects[0].model.layout,
                code=whole.code,
                reason=whole.reason,
                kind=Kind.OBJECT,
                body=shown,
            )
    if seen is not None:
        if (
            not named
            or _contradicted(known)
            or bare.layout == seen.layouts[0].layout
            or own.left > settings.better * _left(seen)
        ):
            return on_body(bare, seen, layouts, _bound(seen, settings))
        if _left(seen) > settings.better * own.left:
            return bare
        return replace(
            bare,
            status="ambiguous",
            code=Code.AMBIGUOUS,
            reason=f"the echo is that of {bare.layout} without a body, or of {seen.layouts[0].layout} on one",
        )
    first, verdict = min(alone or readings, key=lambda pair: pair[0].least)
    if named:
        return _disputed(known, first, settings) or _contested(bare, own, first, layouts, settings)
    points = known.points
    if points is not None and points.displaced(settings.points) and verdict.status != "no_tag":
        # What points at other places explain needs no shell or walls either.
        least = replace(own, left=min(own.left, max(points.least, 0.0)))
        told = (least if one is own else one for one in bare.hypotheses)
        return replace(bare, body=first, hypotheses=tuple(sorted(told, key=lambda one: one.left)))
    clearer = own.left > max(settings.better * first.share(first.least), settings.decision.unexplained)
    if clearer or verdict.status == "no_tag":
        if bare.status == "no_tag":
            return replace(bare, body=first)
        return replace(
            bare,
            status=verdict.status,
            code=verdict.code,
            reason=verdict.reason,
            score=0.0 if verdict.status == "no_tag" else bare.score,
            kind=Kind.NO_TAG if verdict.status == "no_tag" else kind_on(first),
            body=first,
        )
    return replace(bare, body=first)


def _judged(
    known: _Bare, reading: BodyReading, layouts: Sequence[Layout], settings: ContestSettings
) -> Verdict:
    """The verdict on a layout on a body, with the calibration's."""
    verdict = decide_on_body(reading, settings.decision)
    if verdict.status == "identified" and not _shows(known, reading, settings):
        # Where no body shows, the pattern of a bare pair cannot be told from its angle.
        verdict = Verdict("unknown", Code.OTHER, "no body shows, and no layout fits without one")
    if verdict.status == "identified" and _centre_absent(known, reading):
        named = reading.layouts[0].layout
        verdict = Verdict("unknown", Code.MISSING, f"the reflector in the middle of {named} is missing")
    if verdict.status == "identified" and reading.body.name and reading.nominal_m >= settings.body.wide_m:
        layout = next(one for one in layouts if one.name == reading.layouts[0].layout)
        # A shell passes the wave to what stands inside it; a mug's wall does not.
        verdict = contradicts(reading, layout) or verdict
    if verdict.status != "identified":
        return verdict
    return kept(_bound(reading, settings), verdict)


def _centre_absent(known: _Bare, reading: BodyReading) -> bool:
    """Whether a layout on a round body lacks its reflector in the middle.

    About its centre such a body sends the same wave, so that a reading on it leaves that reflector out.
    Without a body too little of the wave is left for one.
    """
    best = reading.layouts[0]
    same = known.reading.nearest == best.layout and known.reading.evidence.absent > 0
    return same and not reading.body.name and len(best.radii) < known.reading.evidence.size


def _after_wall(
    known: _Bare,
    reading: BodyReading,
    verdict: Verdict,
    beside: BodyReading | None,
    layouts: Sequence[Layout],
    settings: ContestSettings,
) -> tuple[BodyReading, Verdict]:
    """A reading with a free pattern that is refused, or may imitate others, after what a wall says of it.

    Many terms imitate, and a few beside a handle: it and one reflector passed for `container-90` on an
    enrolled cup by 0.4. Of 58 right names on enrolled cups and cans all lead before walls by 0.6 and more.
    """
    named = reading.layouts[0].layout
    if verdict.status == "identified" and not reading.body.name and not reading.through:
        if disputed(reading, beside):
            reason = f"beside a round wall another arrangement explains the echo better than {named}"
            verdict = Verdict("unknown", Code.OTHER, reason)
        return reading, verdict
    if beside is not None:
        told = _judged(known, beside, layouts, settings)
        if told.status == "identified" and not _of_a_shell(reading, beside, settings):
            own, free = beside.layouts[0], reading.layouts[0]
            return replace(beside, freely=free.left if free.layout == own.layout else inf), told
    known_body = bool(reading.body.name)
    stands = not disputed(reading, beside) if known_body else borne_out(reading, beside, settings.decision)
    if verdict.status == "identified" and not stands:
        where = f"the enrolled body {reading.body.name}" if known_body else "a round body"
        verdict = Verdict("unknown", Code.BODY, f"no round wall bears out {named} on {where}")
    return reading, verdict


def _of_a_shell(reading: BodyReading, beside: BodyReading, settings: ContestSettings) -> bool:
    """Whether what a wall that the wave passes names may be a helmet's layout: a free pattern finds one.

    Three reflectors in a line on a shell passed for a pair beside a small glass.
    """
    wider = reading.nominal_m >= settings.body.wide_m > beside.nominal_m
    clear = beside.lead >= settings.decision.clear_lead
    return wider and beside.through and not reading.body.name and not clear


def _outdone(
    reading: BodyReading,
    verdict: Verdict,
    on_known: Sequence[BodyReading],
    settings: ContestSettings,
) -> Verdict:
    """The verdict on a name on a round body, taken back where an enrolled body explains the echo better."""
    if verdict.status != "identified" or reading.body.name:
        return verdict
    named = reading.layouts[0]
    for other in on_known:
        best = min((*other.layouts, *other.others), key=lambda placed: placed.charged)
        if other.wall is not None and best.layout == named.layout:
            # The wall of its own body suits a layout better than one of which nothing is known.
            continue
        least = settings.enrolled_lead if best.layout == named.layout else settings.enrolled_other
        leads = named.left - best.charged > least * other.error
        # Alone it explains far more than a round body does: then it is what stands there.
        stands = other.body_left < settings.standing * reading.body_left
        if leads or (stands and best.layout != named.layout):
            reason = f"reflectors on the enrolled body {other.body.name} explain the echo better than"
            return Verdict("unknown", Code.OTHER, f"{reason} {named.layout} on a round body")
    return verdict


def _borne_out(
    reading: BodyReading, verdict: Verdict, first: BodyReading, settings: ContestSettings
) -> Verdict:
    """The verdict on a name on an enrolled body, taken back where a round one explains about as much.

    Where the layout leaves much on both, it is not that body that stands there.
    """
    much = reading.unexplained > settings.decision.round_left
    if verdict.status != "identified" or not much or first.body.name:
        return verdict
    if _beyond(first) > settings.borne_out * _beyond(reading):
        return verdict
    reason = f"a round body explains the echo about as well as the enrolled body {reading.body.name}"
    return Verdict("unknown", Code.BODY, reason)


def _shows(known: _Bare, reading: BodyReading, settings: ContestSettings) -> bool:
    """Whether there is a body below the reflectors: enrolled, opaque, walled, or not explained by points."""
    unlike = known.points is not None and (
        known.points.least > settings.points.unexplained or reading.points_lead > settings.beyond
    )
    # Reflectors that are merely seen from one side are not explained by points, either.
    beyond = unlike and known.reading.code is not Code.HIDDEN
    seen = known.opaque or beyond or _walled(reading, settings) or stands_alone(reading, settings)
    return bool(reading.body.name) or seen


def _clearer(
    reading: BodyReading,
    first: BodyReading,
    spectra: Spectra,
    layouts: Sequence[Layout],
    settings: ContestSettings,
) -> BodyReading:
    """The reading on an enrolled body, or one with the pose found below a loud tag where that leaves less.

    Args:
        reading: on the body where it stands without a tag.
        first: on a round body.
        spectra, layouts, settings: of the contest.
    """
    from tagid.tags.bodies.below import read_below

    # A body that returns far less than its tag stands alone where it imitates the tag best.
    left, by_chance = reading.layouts[0].left, settings.decision.no_tag_nats * reading.variance
    worse = left > first.layouts[0].left + by_chance
    if reading.unexplained <= settings.decision.unexplained and not worse:
        return reading
    centres = [first.pose.centre]
    below = read_below(spectra, layouts, reading.body, settings.body, centres, max(left, reading.least))
    if below is None or below.least >= reading.least:
        return reading
    # Without a tag the body stands where it leaves least on its own.
    return replace(below, body_left=min(reading.body_left, below.body_left))


def _bound(reading: BodyReading, settings: ContestSettings) -> Bound:
    return bound_on_body(reading, settings.decision, settings.calibration(), settings.false_accept)


def _walled(reading: BodyReading, settings: ContestSettings) -> bool:
    """Whether the echo of a wall, before the body's centre, has its share of the energy."""
    strong = reading.body_energy >= settings.wall_share * reading.energy
    return strong and reading.front_m >= settings.wall_m


def stands_alone(reading: BodyReading, settings: ContestSettings) -> bool:
    """Whether the body without reflectors explains most of the echo.

    An empty cup's echo comes from behind its centre, where bare reflectors' interaction comes from as well.
    """
    explained = reading.energy - reading.body_left
    by_chance = settings.decision.no_tag_nats * reading.variance
    return explained >= max(settings.alone * reading.signal, by_chance)


def _beyond(reading: BodyReading) -> float:
    """Energy above noise that the best layout leaves."""
    return max(reading.layouts[0].left - reading.noise, 0.0)


def _left(reading: BodyReading) -> float:
    return reading.share(reading.layouts[0].left)


def _contradicted(known: _Bare) -> bool:
    """Whether points are nearest to another layout than the image names.

    Near the noise the image explains all of an echo, whichever layout it names.
    """
    return known.points is not None and known.points.layouts[0].layout != known.reading.layout


def _disputed(known: _Bare, reading: BodyReading, settings: ContestSettings) -> Reading | None:
    """A bare name taken back where points, or an enrolled body, speak for others; None where neither does."""
    bare, points = known.reading, known.points
    if points is None:
        return None
    nearest = points.layouts[0]
    if _contradicted(known):
        reason = f"the echo is nearer to points at the places of {nearest.layout}"
        return replace(bare.refused(Code.OTHER, reason), body=reading)
    best = min((*reading.layouts, *reading.others), key=lambda placed: placed.charged)
    leads = nearest.left - best.charged > settings.enrolled_other * reading.error
    if not reading.body.name or best.layout == bare.layout or not leads:
        return None
    reason = f"other reflectors on the enrolled body {reading.body.name} explain the echo better than"
    refused = bare.refused(Code.OTHER, f"{reason} {bare.layout} without one")
    return replace(refused, kind=kind_on(reading), body=reading)


def _contested(
    bare: Reading,
    own: Explanation,
    reading: BodyReading,
    layouts: Sequence[Layout],
    settings: ContestSettings,
) -> Reading:
    """A bare name, taken back where another arrangement on a body leaves far less of the echo."""
    best = min((*reading.layouts, *reading.others), key=lambda placed: placed.left)
    wanted = layout_gaps_deg(next(one for one in layouts if one.name == bare.layout))
    apart = difference_deg(gaps_deg(best.angles), wanted) > settings.body.other_deg
    doubtful = (
        _walled(reading, settings)
        # On the axis a wall does not move: there its shadow on the reflectors tells of it.
        or bare.evidence.outward > settings.outward
        or bool(reading.body.name)
        # Alike reflectors of constant brightness that leave so much are not all that stands there.
        or own.left > settings.much
    )
    if best.layout == bare.layout or not apart or not doubtful:
        return replace(bare, body=reading)
    if own.left <= settings.better * max(reading.share(best.left), settings.body.priors.model_error):
        return replace(bare, body=reading)
    refused = bare.refused(
        Code.OTHER,
        f"another arrangement on a body leaves {reading.share(best.left):.0%} of the echo, "
        f"{bare.layout} without one {own.left:.0%}",
    )
    return replace(refused, kind=kind_on(reading), body=reading)


def _explanations(readings: Sequence[tuple[BodyReading, Verdict]]) -> list[Explanation]:
    """No tag, and the best layout on every body."""
    first = readings[0][0]
    no_tag = Explanation(Kind.NO_TAG, "", None, first.share(first.body_left), None, first.pose)
    return [no_tag, *(hypothesis_on(reading) for reading, _ in readings)]


def _object_explanation(spectra: Spectra, reading: ObjectReading) -> Explanation:
    left = reading.match.left - spectra.noise_energy
    share = left / max(spectra.energy - spectra.noise_energy, 1e-30)
    beyond = reading.excess / max(reading.beyond_body, 1e-9)
    return Explanation(
        Kind.OBJECT,
        reading.model.name,
        reading.model.layout,
        float(np.clip(share, 0, 1)),
        float(np.clip(beyond, 0, 1)),
        reading.match.pose,
    )
