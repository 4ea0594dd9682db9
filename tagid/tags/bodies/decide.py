"""When a tag on a body is named, and what is said when it is not."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, log10, sqrt

from tagid.tags.bodies.body_reading import BodyReading
from tagid.tags.verdicts.verdict import Code, Verdict

FARTHEST_CENTRE_M = 0.013
"""Of an object that stands within 10 mm of the axis, as measured."""


@dataclass(frozen=True)
class BodyDecision:
    """Tests that a layout on a body must pass; each can only take a name away.

    Attributes:
        unexplained: largest share of the tag's echo that its layout may leave. A handle, an oval wall or
            another tag leave 20 % or more,
        chance_sigmas: beside so many standard deviations of the noise's energy, on a round body: two of it
            and of its level, which the median of as many values gives to 1 / ln 2 of that.
        wall_unexplained: the same beside a wall: one that tapers, or ends near the reflectors, leaves a
            fifth, other arrangements a quarter and more,
        wall_clear: so much only where it leads by `clear_lead`, else this: straight walls leave up to 9 %,
            and handles, boxes and single reflectors, of which a pair is made, 10 to 18 %.
        shell_unexplained: on an enrolled shell, before which patterns differ with the gap, where the layout
            leads by `shell_lead`: tags on oval shells leave up to 20 % and lead by 0.7 and more, 44 others
            leave 33 % or more and lead by -0.3 at most, those with one reflector too many 28 % and 0.44,
        shell_m: of nominal radius and more.
        round_left: and on a round body no more than this beyond what noise may add: tags on full-wave cans
            and cups leave up to 3 %, and a wobble of 1 % as much; tags on helmet shells, read as ones on a
            round body, 12 % or more.
        noise_level: relative error of the expected noise,
        noise_sigmas: and standard deviations of its energy, that noise may add.
        lead: smallest `BodyReading.lead`, whatever the calibration says: an eighth of the model's own error.
        angle_deg, radius_m: largest difference between the layout and the same reflectors with free angles.
        early_m: range of `BodyReading.early_m`: full-wave tags on cans answer from 26 mm behind to 14 mm
            before their apparent place, the wall of an oval helmet from 60 mm before it; 15 mm more before
            for the error of the axis distance, and 39 mm more behind, for an unstated pulse that is late and
            for what wall and reflectors exchange in noise as well. Of 1,400 objects without an enrolled tag
            the longer range behind let none through.
        early_clear_m: the larger of them where the layout leads by `clear_lead`: pulses that nobody stated
            are early by up to 50 mm. Of 11,000 objects without an enrolled tag oval shells led by up to 1.2,
            from 46 mm before and more.
        wall_share: a body with this share of the moving echo, and `wall_noise` of the noise beyond it, has
            a wall, which cannot lie further outside the reflectors than the larger of `early_m`: those of
            full-wave cans lie 8 to 17 mm inside, 21 mm outside where the axis distance is wrong by 10 mm and
            the pulse is delayed.
        wall_noise: share of the noise that the fit of a body which hardly moves may explain.
        enrolled_m: the echo of an enrolled body comes from where it came at enrolment, to within this, one
            way: axis distances and pulses that nobody stated move it by up to 54 mm, a body that is not
            there answers from up to 88,
        enrolled_share: where it has this share of the moving echo. Below loud tags a thin shell's echo, up
            to a quarter, seems to come from as far as 150 mm.
        early_wall_m: how early beside a wall of known waves, and where the layout leads by `walled_lead`,
        late_wall_m: and how late: tags on cups, cans and glasses, ours and solved, answer from 36 mm behind
            to 46 before, from 50 behind and 64 before where the pulse is one that nobody stated and they lead
            by more; neighbours on a crate from 36 to 46 behind, an untagged shell from 54 before, both with
            leads below 0.8.
        pair_wall_m: a pair beside a wall that the wave passes answers from its place to within this,
        pair_lead: unless it leads by so much: three in a line on a helmet's shell, at 18 views, passed for
            one beside a small glass from 34 to 50 mm behind and 32 to 54 before, with leads up to 2.1, a lone
            reflector from 48 before. Of 87 right pairs that lead by less than this five are lost.
        seen_m: reflectors beside a wall of known waves, or seen from all sides, answer from where they are,
            to within this. Only before an opaque wall does the bounce move a free pattern: of 90 tags that
            are right those seen from all sides are within 7 mm, those beside walls within 9; pairs 140 mm
            apart, before a thin shell, imitate ones of 90 mm from 15 to 25 mm outside,
        seen_back: and reflectors are seen from all sides whose pattern has so much from behind,
        flat: on an enrolled body where more of its echo than this turns: shells and boxes. Neighbours on a
            crate passed for an opposite pair from 14 and 15 mm inside; on mugs, whose walls bend the wave,
            right ones seem up to 18 mm inside.
        undone: body and reflectors beside a wall whose echoes cancel each other fit two echoes to what has
            neither: energy of the body's echo, and what the body alone leaves, over the moving echo.
            Uncorrelated ones make 1; 300 right readings up to 1.5, a tag on a helmet shell that was taken
            for one beside a small glass 1.8 to 1.9,
        undone_clear: where the layout leads by `clear_lead`: a cup at 20 dB made 1.64 and led by 11.
        least_body: a round body returns at least this share of what its reflectors do, as far as its movement
            tells. Of 520 right readings full-wave ones return 1.5 times as much and more, our own 0.7, with
            12 views 0.2 in one and 0.4 in another; of the ten best of 28,000 objects without an enrolled tag
            six return 0.03 to 0.3: other reflectors about a point 3 to 12 mm off the axis. None led by more
            than 3.4,
        moving_nats: or, where what moves of it is so many noise variances,
        thin_body: this share, as a thin shell does: of nine of those objects one moves so loudly and returns
            0.17, another, at 12 views, 0.4.
        sure_lead: a layout that leads by so much needs no loud body: reflectors of 40 mm on a can that
            returned a tenth of what they did led by 11.
        far_wall_m: and it may answer from so far before or behind beside a wall of known waves: pulses that
            nobody stated delay tags on cans by up to 72 mm.
        free_more: lead by which a free pattern must be ahead of one of known waves, to be as convincing.
        centre_m: largest distance of the centres of body and tag from the rotation axis.
        no_tag_nats: a body is untagged where no arrangement explains so many noise variances more: fitting
            noise alone, 27 amplitudes and the places explain 40 to 50,
        no_tag_share: and this share of the moving echo: wobble leaves as much of a strong body.
        enrolled_nats: a tag on an enrolled body explains so many noise variances: the body's pose is fitted,
            too, and its signature has errors. Of 1,440 objects without an enrolled tag arrangements explained
            85 to 113 of four that would have been named,
        walled_nats: fewer beside a wall of known waves, whose 18 amplitudes fit less of the noise: of some
            900 foreign and untagged readings on enrolled cups, mugs and cans one led by 0.25 or more, by
            0.54, and explained 78.
    """

    unexplained: float = 0.15
    chance_sigmas: float = 3.5
    wall_unexplained: float = 0.20
    wall_clear: float = 0.10
    shell_unexplained: float = 0.22
    shell_lead: float = 0.6
    shell_m: float = 0.076
    round_left: float = 0.08
    noise_level: float = 0.25
    noise_sigmas: float = 3.0
    lead: float = 0.3
    angle_deg: float = 12.0
    radius_m: float = 0.025
    early_m: tuple[float, float] = (-0.065, 0.030)
    early_clear_m: float = 0.060
    clear_lead: float = 2.0
    wall_share: float = 0.05
    wall_noise: float = 0.1
    enrolled_m: float = 0.065
    enrolled_share: float = 0.3
    early_wall_m: tuple[float, float] = (0.050, 0.065)
    late_wall_m: tuple[float, float] = (-0.040, -0.065)
    walled_lead: float = 1.0
    pair_wall_m: float = 0.030
    pair_lead: float = 2.5
    seen_m: float = 0.012
    seen_back: float = 0.45
    flat: float = 0.5
    undone: float = 1.6
    undone_clear: float = 1.75
    least_body: float = 0.5
    moving_nats: float = 60.0
    thin_body: float = 0.18
    sure_lead: float = 4.0
    far_wall_m: float = 0.080
    free_more: float = 0.15
    centre_m: float = FARTHEST_CENTRE_M
    no_tag_nats: float = 60.0
    no_tag_share: float = 0.001
    enrolled_nats: float = 120.0
    walled_nats: float = 80.0


def score(reading: BodyReading, settings: BodyDecision) -> float:
    """The evidence for the best layout, -inf where a test refuses it: what the calibration orders."""
    passed = decide_on_body(reading, replace(settings, lead=-inf)).status == "identified"
    known = reading.wall is not None or bool(reading.body.name)
    return reading.lead - (0.0 if known else settings.free_more) if passed else -inf


def tag_snr_db(reading: BodyReading) -> float:
    """Energy of what is not of the body over that of the noise, dB."""
    return 10 * log10(max(reading.tag / max(reading.noise, 1e-30), 1e-9))


def most_unexplained(reading: BodyReading, settings: BodyDecision) -> float:
    """Largest share of the tag's echo that the best layout may leave.

    The energy of noise over n complex values has a standard deviation of sqrt(n) variances. A loud tag whose
    layout leaves more than the model's own error is not that layout on a round body, whatever is worse.
    """
    r, s = reading, settings
    deviation = sqrt(max(r.noise, 0.0) * max(r.variance, 0.0)) / max(r.tag, 1e-30)
    by_chance = s.chance_sigmas * deviation
    if r.wall is not None:
        return (s.wall_unexplained if r.lead >= s.clear_lead else s.wall_clear) + by_chance
    if r.body.name:
        clear = r.nominal_m >= s.shell_m and r.lead >= s.shell_lead
        return (s.shell_unexplained if clear else s.unexplained) + by_chance
    noise = s.noise_level * r.noise / max(r.tag, 1e-30) + s.noise_sigmas * deviation
    return min(s.unexplained + by_chance, s.round_left + noise)


def is_in_place(reading: BodyReading, settings: BodyDecision) -> bool:
    """Whether the reflectors answer from where the layout has them."""
    r, s = reading, settings
    # An enrolled body knows of the delay that its echo may have in common with the reflectors'.
    told = bool(r.body.name) and r.body_energy > s.wall_share * r.energy
    delay = r.front_m if told else 0.0
    if r.wall is not None:
        clear = int(r.lead >= s.walled_lead)
        latest, earliest = s.late_wall_m[clear], s.early_wall_m[clear]
        if r.lead >= s.sure_lead:
            latest, earliest = -s.far_wall_m, s.far_wall_m
        elif r.through and not r.body.name and len(r.layouts[0].angles) == 2 and r.lead < s.pair_lead:
            latest, earliest = -s.pair_wall_m, s.pair_wall_m
        return latest <= r.early_m - min(delay, 0.0) and r.early_m - max(delay, 0.0) <= earliest
    if r.through:
        # One that the wave passes through returns most from behind, by paths of its own.
        return True
    if r.body.name:
        return r.early_m - max(delay, 0.0) <= _earliest_m(r, s)
    return s.early_m[0] <= r.early_m <= _earliest_m(r, s)


def _earliest_m(reading: BodyReading, settings: BodyDecision) -> float:
    """How early reflectors, or the wall behind them, may answer, m: more in a clear case on a round body."""
    clear = not reading.body.name and reading.lead >= settings.clear_lead
    return settings.early_clear_m if clear else settings.early_m[1]


def from_elsewhere(reading: BodyReading) -> Verdict:
    """The verdict on reflectors that do not answer from where the layout has them."""
    early = reading.early_m
    return Verdict(
        "unknown",
        Code.BODY,
        f"the echo comes from {abs(early) * 1e3:.0f} mm {'before' if early > 0 else 'behind'} "
        f"the places of {reading.layouts[0].layout}, as from the wall of a body that is not round",
    )


def _has_wall(reading: BodyReading, settings: BodyDecision) -> bool:
    """Whether the body's echo stands out of the tag's and of the noise that its fit may explain."""
    share = settings.wall_share * reading.energy + settings.wall_noise * max(reading.noise, 0.0)
    return reading.body_energy > share


def _least_body(reading: BodyReading, settings: BodyDecision) -> float:
    """What a round body returns at least, over what its reflectors do."""
    r, s = reading, settings
    if r.lead >= s.sure_lead:
        return 0.0
    return s.thin_body if r.body_energy >= s.moving_nats * r.variance else s.least_body


def decide_on_body(reading: BodyReading, settings: BodyDecision) -> Verdict:
    """The verdict on the best layout of a body, before any calibration."""
    r, s = reading, settings
    name = f"the enrolled body {r.body.name}" if r.body.name else "a round body"
    best = r.layouts[0]
    gain = r.body_left - r.least
    if gain < s.no_tag_nats * r.variance + s.no_tag_share * r.energy:
        return Verdict("no_tag", Code.NO_TAG, f"{name} without reflectors explains the echo")
    left = Verdict(
        "unknown",
        Code.UNEXPLAINED if r.body.name else Code.BODY,
        f"{best.layout} on {name} leaves {min(r.unexplained, 1):.0%} of its echo unexplained",
    )
    if r.unexplained > max(most_unexplained(r, s), s.unexplained):
        return left
    # On an enrolled body the tag has its own centre: a foreign pair is a layout's about another place.
    what, off = max(("body", abs(r.pose.centre)), ("tag", abs(best.centre)), key=lambda pair: pair[1])
    if off > s.centre_m:
        return Verdict(
            "unknown", Code.OFF_CENTRE, f"the {what}'s centre lies {off * 1e3:.0f} mm off the axis"
        )
    if not is_in_place(r, s):
        return from_elsewhere(r)
    if r.body.turns and r.body_energy > s.enrolled_share * r.energy and abs(r.front_m) > s.enrolled_m:
        side = "before" if r.front_m > 0 else "behind"
        return Verdict(
            "unknown",
            Code.BODY,
            f"what looks like {name} is {abs(r.front_m) * 1e3:.0f} mm {side} where it was at enrolment",
        )
    inside = r.front_m - r.nominal_m
    if _has_wall(r, s) and inside > _earliest_m(r, s):
        return Verdict(
            "unknown",
            Code.BODY,
            f"the body's wall lies {inside * 1e3:.0f} mm outside the reflectors of {best.layout}",
        )
    if r.angle_off_deg > s.angle_deg:
        return Verdict("unknown", Code.OTHER, f"the reflectors' angles are not those of {best.layout}")
    seen = r.wall is not None or (r.back > s.seen_back and (not r.body.name or r.body.turning_share > s.flat))
    # On flat faces what bounces comes from further out, not from further in.
    farthest_m = inf if r.body.name and r.wall is None else s.seen_m
    if seen and not -s.seen_m <= r.outside_m <= farthest_m:
        side = "outside" if r.outside_m > 0 else "inside"
        return Verdict(
            "unknown",
            Code.RADIUS,
            f"the reflectors are {abs(r.outside_m) * 1e3:.0f} mm {side} the places of {best.layout}",
        )
    undone = s.undone_clear if r.lead >= s.clear_lead else s.undone
    if r.wall is not None and r.body_energy + r.body_left > undone * r.energy:
        return Verdict(
            "unknown", Code.BODY, f"a wall that explains the echo would undo that of {best.layout} beside it"
        )
    if r.radius_off_m > s.radius_m:
        return Verdict("unknown", Code.RADIUS, f"the reflectors' radius is not that of {best.layout}")
    if not r.body.name and r.body_over_tag < _least_body(r, s):
        return Verdict(
            "unknown",
            Code.BODY,
            f"no body moves with {best.layout}: where it would stand one would show",
        )
    if r.untagged_lead < s.lead:
        return Verdict(
            "unknown",
            Code.BODY,
            f"an oval or angular body without reflectors explains the echo as well as {best.layout}",
        )
    if r.points_lead < s.lead:
        return Verdict(
            "unknown", Code.OTHER, "reflectors elsewhere, without a body, explain the echo about as well"
        )
    if r.body.name and gain < (s.enrolled_nats if r.wall is None else s.walled_nats) * r.variance:
        return Verdict("unknown", Code.WEAK, f"the tag on {name} is too weak to be told from another")
    if r.lead < s.lead:
        return Verdict(
            "unknown", Code.OTHER, f"another arrangement on {name} explains the echo about as well"
        )
    # Last: where another test speaks against the layout, its reason says more.
    return left if r.unexplained > most_unexplained(r, s) else Verdict("identified")
