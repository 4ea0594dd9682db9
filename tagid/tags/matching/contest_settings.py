"""How hypotheses are compared: every threshold of the contest, with its justification."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from tagid.tags.bodies.body_reading import BodySettings
from tagid.tags.bodies.calibration import Calibration
from tagid.tags.bodies.decide import BodyDecision
from tagid.tags.bodies.objects import ObjectDecision
from tagid.tags.bodies.points import PointSettings
from tagid.tags.bodies.shell_decide import ShellDecision
from tagid.tags.bodies.transparent import TransparentDecision
from tagid.tags.matching.bare_checks import BareDecision


@dataclass(frozen=True)
class ContestSettings:
    """How hypotheses are compared.

    Attributes:
        body: search and priors on bodies.
        decision: tests on bodies.
        points: fit and tests of tags without a body.
        bare: checks of a name without a body.
        explained: a bare reading that explains this share of the echo is not contested: no body could leave
            a third of so little.
        wall_m: a body takes part against a bare name only where its echo comes from so far before its centre
        wall_share: and has this share of the moving echo's energy: the interaction of bare reflectors comes
            from behind it.
        alone: or alone explains this share of it: an empty cup's echo comes from behind, too,
        outward: or where the reflectors shine outward by more than this (`Evidence.outward`): bare
            full-wave tags reach 0.3, tags on full-wave cans have 0.64 or more.
        false_accept: probability of naming an object of the calibration's population.
        calibrated: by which; None for the package's own.
        beyond: or where points without a body are behind the layout on it by such a lead: a strong body is
            nearly one point, and what it hides counts.
        better: a hypothesis that leaves so many times less contradicts one that names another layout.
        much: a name without a body that leaves so much of the echo needs no wall to be contested: something
            else stands there. Neighbours on a can on the axis, horizontally polarised, left half of it.
        enrolled_lead: a name on a round body is refused where an enrolled body leads it by so much. Of 42
            full-wave readings that are right it leads by 0.55 at most, of neighbours on a box by 5;
        enrolled_other: or by so much with another arrangement: a handle and one reflector were a pair.
        standing: or where the enrolled body alone leaves so much less of the echo than a round one, and
            another arrangement on it leaves least: at 18 views a shell and `helmet-linear` passed for a cup
            with `container-180`.
        borne_out: a layout on an enrolled body that leaves more than `BodyDecision.round_left` is named only
            where it leaves so many times more on a round body. Of tags on their own bodies most leave 1.7
            times as much and more, of tags with one more reflector in the middle, on a mug that is not there,
            1.1 to 1.7.
        turning: an enrolled body of which a smaller share turns may have a round wall: 0 to 0.34 of mugs with
            handles, full-wave and our own, and of cans, 0.7 to 0.9 of oval shells.
        disputed_nats: a name without a body is refused where another arrangement on a round body leaves so
            many noise variances less, its amplitudes charged: in a weak echo one reflector on a can passes
            for two without a body,
        disputed_share: beyond this share of a pair's echo, and what `points` may leave of other tags. Two
            reflectors 150 degrees apart on a plastic bottle, whose wall delays the farther one by 3 mm, have
            the spacing of opposite ones. Of 1,008 recordings of simulated bare tags, of 5 dB and more, none
            is lost to 0.015, three are to 0.008.
        undone_nats, undone_share: a pair's name without a body is asked of a thin wall where arrangements
            beside one leave so many noise variances, and this share of the echo, less than its points, which
            may be darker from behind. Of 400 recordings of solved pairs without a body it is 0.53 % at most,
            of those on a bottle 0.9 % and more; of 60 of foreign pairs on a bottle and a jar 10 are named, 19
            without.
        delayed_nats, delayed_share: and such a wall may bear out a pair that is not where it was found where
            they leave so much less than points anywhere do: 1.9 % and more of the echo of pairs on a bottle
            of 2 mm, 0.9 % at most of 120 recordings of solved pairs without a body.
        delayed_rest: and no more than this share of what those leave beyond the noise: a pair of 40 mm
            reflectors without a body, 96 mm apart, left 0.57 of it, right ones 0.28 at most.
        transparent: of names that points have beside an enrolled body.
        shell: tests on a thin shell that nobody enrolled,
        box: and in or on a box of thin walls. Tags that are read rightly there seem 0.7 mm nearer to their
            middle than the layout has them to 2.3 mm further out, and leave up to 3 % of their echo in solved
            cartons.
        objects: tests on enrolled objects.
    """

    body: BodySettings = field(default_factory=BodySettings)
    decision: BodyDecision = field(default_factory=BodyDecision)
    points: PointSettings = field(default_factory=PointSettings)
    bare: BareDecision = field(default_factory=BareDecision)
    explained: float = 0.9
    wall_m: float = 0.010
    wall_share: float = 0.05
    alone: float = 0.5
    outward: float = 0.45
    beyond: float = 2.0
    better: float = 3.0
    much: float = 0.4
    enrolled_lead: float = 1.0
    enrolled_other: float = 0.5
    standing: float = 0.5
    borne_out: float = 1.4
    turning: float = 0.5
    disputed_nats: float = 12.0
    disputed_share: float = 0.015
    undone_nats: float = 15.0
    undone_share: float = 0.0065
    delayed_nats: float = 24.0
    delayed_share: float = 0.012
    delayed_rest: float = 0.4
    transparent: TransparentDecision = field(default_factory=TransparentDecision)
    shell: ShellDecision = field(default_factory=ShellDecision)
    box: ShellDecision = field(default_factory=ShellDecision.beside_walls)
    objects: ObjectDecision = field(default_factory=ObjectDecision)
    false_accept: float = 1e-3
    calibrated: Calibration | None = None

    @property
    def delayed_tests(self) -> BodyDecision:
        """Tests beside a thin wall: it returns hardly anything, and shows by what it does to reflectors."""
        return replace(self.decision, least_body=0.0, thin_body=0.0)

    def calibration(self) -> Calibration:
        """The calibration in force. Raises ModelError where the package's file is damaged."""
        return self.calibrated or Calibration.shipped()
