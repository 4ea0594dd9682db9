"""The verdict on a tag beside a thin shell that nobody enrolled."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from tagid.tags.bodies.decide import FARTHEST_CENTRE_M, from_elsewhere
from tagid.tags.bodies.shell_reader import ShellReading
from tagid.tags.verdicts.verdict import Code, Verdict


@dataclass(frozen=True)
class ShellDecision:
    """Tests of a layout beside a shell.

    Attributes:
        where: where the layout is, as sentences have it.
        near_m: no reflector stands nearer outside than this: close together before a thin wall they are not
            told from single ones, unless the layout leads by `near_lead`: on boxes of our simulator one does
            by 1.6 to 7.4. Two pairs of neighbours on a crate passed for `container-180`.
        shift_m: largest difference of the reflectors' apparent distance from their centre from the layout's.
        unexplained: largest share of the tag's echo that it may leave beyond noise: of 24 tags on solved
            shells at 36 views up to 0.15, of tags that are not enrolled 0.66 and more,
        chance_sigmas: and so many standard deviations of the noise's energy.
        lead: least lead over other arrangements on the shell; those 24 have 0.46 and more, and tags that
            are not enrolled less than 0.1.
        angle_deg, radius_m: largest differences where angles and radius are fitted freely.
        centre_m: largest distance of the shell's centre, and of the tag's, from the rotation axis.
        tag_nats: a tag explains so many noise variances.
        wall_share: a shell has this share of the moving echo: without one the reading is that of a bare tag.
        middle: a reflector in the middle is told where it would show by so many errors of the reading,
        contrary: and stands there where it explains more than this share of that,
        told: and so much: less is noise, and what the shell's own model leaves.
        middle_off_axis: where the tag stands `off_axis_m` from the rotation axis one must show by so many: of
            helmets of our simulator it does by 0.8 and more, and where one stands there, by 0.05 to 0.8: the
            shell was bent to explain it.
        own_middle: one that the layout has must show by so much, and explain `contrary` of it: before a
            round wall, on the axis, two reflectors alone are that layout by up to 0.12.
        early_m: range of `BodyReading.early_m`: of tags in solved cartons -36 to 18 mm.
    """

    where: str = "on a thin shell"
    near_m: float = 0.0
    near_lead: float = 1.5
    shift_m: float = inf
    unexplained: float = 0.2
    chance_sigmas: float = 3.5
    lead: float = 0.3
    angle_deg: float = 12.0
    radius_m: float = 0.008
    centre_m: float = FARTHEST_CENTRE_M
    tag_nats: float = 80.0
    wall_share: float = 0.05
    middle: float = 0.1
    middle_off_axis: float = 0.25
    off_axis_m: float = 0.005
    contrary: float = 0.25
    told: float = 0.15
    own_middle: float = 0.15
    early_m: tuple[float, float] = (-inf, inf)

    @classmethod
    def beside_walls(cls) -> ShellDecision:
        """Those in or on a carton or a crate.

        Tags in solved cartons lead by 0.46 and more; an untagged helmet of our simulator did by 0.4.
        """
        return cls(
            where="beside thin walls",
            near_m=0.025,
            shift_m=0.003,
            unexplained=0.1,
            lead=0.45,
            early_m=(-0.045, 0.030),
        )


def decide_on_shell(found: ShellReading, settings: ShellDecision) -> Verdict:
    """The verdict on the best layout beside a shell."""
    r, s = found.reading, settings
    name = r.layouts[0].layout
    if r.body_energy < s.wall_share * r.energy:
        return Verdict("unknown", Code.BODY, "no shell shows")
    if r.tag_nats < s.tag_nats:
        return Verdict("unknown", Code.WEAK, f"{name} {s.where} is too weak to be told from another")
    by_chance = s.chance_sigmas * (max(r.noise, 0.0) * max(r.variance, 0.0)) ** 0.5 / r.tag
    if r.unexplained > s.unexplained + by_chance:
        left = f"{min(r.unexplained, 1):.0%} of its echo unexplained"
        return Verdict("unknown", Code.BODY, f"{name} {s.where} leaves {left}")
    near = ((found.outside_m > 0) & (found.outside_m < s.near_m)).any()
    if near and r.lead < s.near_lead:
        reason = f"{name} {s.where} would stand before them, where other arrangements look alike"
        return Verdict("unknown", Code.BODY, reason)
    off = max(abs(r.pose.centre), abs(r.layouts[0].centre))
    if off > s.centre_m:
        return Verdict("unknown", Code.OFF_CENTRE, f"the shell's centre lies {off * 1e3:.0f} mm off the axis")
    if not s.early_m[0] <= r.early_m <= s.early_m[1]:
        return from_elsewhere(r)
    if r.angle_off_deg > s.angle_deg:
        return Verdict("unknown", Code.OTHER, f"the reflectors' angles are not those of {name}")
    if r.radius_off_m > s.radius_m or abs(r.layouts[0].batch.at[0, 2]) > s.shift_m:
        return Verdict("unknown", Code.RADIUS, f"the reflectors' radius is not that of {name}")
    if found.has_middle and found.middle_lead < s.contrary * found.middle_nats:
        return Verdict("unknown", Code.MISSING, f"the reflector in the middle of {name} is missing")
    if found.has_middle and found.middle_nats < s.own_middle:
        reason = f"on the axis the reflector in the middle of {name} does not show: move it by 3 mm"
        return Verdict("unknown", Code.MISSING, reason)
    off_axis = abs(r.layouts[0].centre) > s.off_axis_m
    if not found.has_middle and off_axis and found.middle_nats < s.middle_off_axis:
        return Verdict("unknown", Code.EXTRA, f"a reflector may stand in the middle of {name}")
    told = not found.has_middle and found.middle_nats >= s.middle
    if told and found.middle_lead < -max(s.contrary * found.middle_nats, s.told):
        return Verdict("unknown", Code.EXTRA, f"a reflector stands in the middle of {name}")
    if r.lead < s.lead:
        reason = f"another arrangement {s.where} explains the echo about as well"
        return Verdict("unknown", Code.OTHER, reason)
    return Verdict("identified")
