"""Values of the reader of tags on bodies: its settings, an arrangement after its fit, and what came out."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from tagid.fields.shells import Shell
from tagid.tags.bodies.hypothesis import BodyModel, Pose, Seen
from tagid.tags.bodies.points import PointReading
from tagid.tags.bodies.reflectors_fit import Batch, Priors, alone
from tagid.tags.bodies.revolution import RoundBody
from tagid.tags.bodies.spectra import Spectra, centred


@dataclass(frozen=True)
class BodySettings:
    """Extent of the search and the priors of tags on bodies.

    Attributes:
        priors: see `Priors`.
        body: the body that nobody enrolled.
        most: largest number of reflectors in another arrangement.
        other_deg: arrangements whose angles differ by more are another arrangement.
        split_deg: reflectors nearer than this, in an arrangement that is the layout's where each such group
            is one, leave nearly what the layout leaves with patterns of more than three terms,
        split_lead: so with these they contradict it only where they lead by so much more than other
            arrangements need.
        nested_lead: on an enrolled body, added to the lead before split arrangements with up to three terms
            where they explain no more than the layout, which they nearly contain, and it leads them before a
            wall (`neighbours`). Of 156 full-wave readings of a mug without a tag or with neighbours in the
            places of a layout's reflectors none was named then; by the first condition alone 4 were,
        neighbours: compared with so many of them, from `through_views` on.
        upright_share: not where the layout leaves so much more of the tag's echo by the patterns of
            horizontal polarisation than by those of upright: of 7 readings with horizontal polarisation the
            most is 0.011, of 5 of foreign neighbours with upright one the least 0.05.
        face_lead: neighbours on flat faces, in place of a layout's reflectors, contradict it where it leads
            them by so much less than other arrangements. Of 7 full-wave readings of neighbours on boxes the
            layout leads by 0.13 at most, of 43 with a layout on boxes and mugs by 0.21 and more in 42,
        split_error: share of the tag's echo that a split arrangement with three terms may leave, where the
            layout needs five: full-wave tags of two reflectors are ahead of it by 3 % or more at 20 dB.
        simple_error: the same of other explanations with few amplitudes per frequency: a body without
            reflectors, or points without a body. Tags on full-wave cans leave up to 2 % with three terms.
        other_radius_m: and so are those whose apparent radius differs by more from the layout's limits.
        strong: a body that explains more than this share of the moving echo gives the centre alone.
        centre_reach_m: a weak body's centre is searched so far from the axis, m.
        centres: centres tried in full for a weak body.
        arrangements: kinds of arrangements that are fitted, beside those with free angles.
        finished: layouts fitted to the end.
        loose: other arrangements fitted with free angles before a layout is named, with patterns of up to
            three terms and with more.
        through_views: fewest views at which patterns of 5 terms are fitted, on round bodies. At 18 and 24
            views, five of 1,600 untagged or foreign boxes, shells and ovals passed for tags in this way.
        through_left: on an enrolled body only where three terms leave more of the tag's echo than this share.
        through_m: apparent radius at which their fit begins, m.
        hopeless: where no arrangement explains this share of what the body leaves, none is fitted to the end.
        turn_step_rad: of the search for the turn of a body below a tag that is louder.
        rings_m: radii tried about each nominal one under `wide_m`, relative to it, m.
        wide_m: from here on a body is a shell, and only the nominal radius is tried.
        ring_step_m: spacing of the angles on a ring, m of arc.
        clear_lead, clear_left: a round body is not asked how oval it is where a layout on it leads by so much
            and leaves no more than this share of its echo.
        look_again: an enrolled body is read once more where what is known of the turn beside its tag would
            change the lead by so much.
        bent: what it then tells is not used where the body alone leaves so many times more of it: up to 1.7
            times as much on cups with a tag, 17 to 136 times where centres ran away by 7 mm.
        noise_nats: lead in noise variances that counts as much as the model's own error.
    """

    priors: Priors = field(default_factory=Priors)
    body: RoundBody = field(default_factory=RoundBody)
    most: int = 4
    other_deg: float = 12.0
    split_deg: float = 62.0
    split_lead: float = 0.6
    nested_lead: float = 0.3
    neighbours: int = 3
    upright_share: float = 0.03
    face_lead: float = 0.1
    split_error: float = 0.04
    simple_error: float = 0.02
    other_radius_m: float = 0.012
    strong: float = 0.94
    centre_reach_m: float = 0.010
    centres: int = 2
    arrangements: int = 12
    finished: int = 4
    loose: int = 3
    through_views: int = 30
    through_left: float = 0.15
    through_m: float = 0.038
    hopeless: float = 0.5
    turn_step_rad: float = float(np.pi / 36)
    rings_m: tuple[float, ...] = (-0.009, 0.005)
    wide_m: float = 0.076
    ring_step_m: float = 5.5e-3
    clear_lead: float = 0.3
    clear_left: float = 0.05
    look_again: float = 0.1
    bent: float = 2.0
    noise_nats: float = 25.0

    def error(self, spectra: Spectra, above: float, tag: float) -> float:
        """Energy that a lead of 1 is, see `BodyReading.error`.

        Args:
            spectra: the scans.
            above: energy above the noise that a layout leaves. What chance may add is no error of the model.
            tag: energy that the layout explains.
        """
        beyond = max(above - spectra.noise_spread, 0.0)
        return beyond + (self.priors.model_error * tag + self.noise_nats * spectra.noise)

    def radius_offsets_m(self, radius_m: float) -> tuple[float, ...]:
        """Radii tried about a nominal one, relative to it, m."""
        return self.rings_m if radius_m < self.wide_m else (0.0,)


@dataclass(frozen=True, eq=False)
class Placed:
    """One arrangement after its fit.

    Attributes:
        batch: one row.
        left: energy left.
        charged: the same with the charge for the pattern's terms.
        layout: its name; None for an arrangement that no layout has.
        angles: (K,) of the reflectors present, rad.
        radius_m: mean apparent radius, m.
    """

    batch: Batch
    left: float
    charged: float
    layout: str | None

    @property
    def angles(self) -> NDArray[np.float64]:
        """(K,) directions of the reflectors from their centre, rad."""
        return np.asarray(self.batch.angles[0][self.batch.present[0] > 0])

    def apart_rad(self, other: Placed) -> float:
        """Largest angle between reflectors of the two, in order of their angles; pi for unlike counts."""
        one, two = np.sort(self.angles % (2 * np.pi)), np.sort(other.angles % (2 * np.pi))
        if len(one) != len(two):
            return float(np.pi)
        return float(np.abs(np.angle(np.exp(1j * (one - two)))).max())

    @property
    def radii(self) -> NDArray[np.float64]:
        """(K,) apparent distances from their centre, m."""
        return np.asarray(self.batch.radii[0][self.batch.present[0] > 0] + self.batch.at[0, 2])

    @property
    def centre(self) -> complex:
        """Of the ring, x + jy, m."""
        return complex(self.batch.centres[0])

    @property
    def positions(self) -> NDArray[np.float64]:
        """(K, 2) apparent places, m."""
        place = self.centre + self.radii * np.exp(1j * self.angles)
        return np.stack([place.real, place.imag], axis=1)


@dataclass(frozen=True, eq=False)
class BodyReading:
    """What the scans say of a tag on one body.

    Attributes:
        body: the model used.
        pose: of the body in the best layout's fit.
        spectra: the scans, seen from where the body says that they were taken.
        views: of the recording.
        energy: of the moving echo.
        noise: expected energy of the noise after the fit.
        variance: of one value from noise alone.
        body_left: energy that the body alone leaves.
        layouts: every layout that can lie on this body, best first.
        others: arrangements that are not the best layout's, best first.
        free: the best layout's arrangement with all angles free; None where none of the free ones is near.
        tag: energy that the best layout's reflectors explain.
        unexplained: share of the tag's echo that they leave, noise subtracted.
        lead: what the best other arrangement leaves more, over what the layout leaves, the model's error and
            the noise: the strength of the evidence.
        untagged_lead: the same of a body without reflectors that has the layout's symmetry; infinite where it
            was not fitted because `lead` is not positive, or the layout has no symmetry.
        error: energy that a lead of 1 is: what the layout leaves, the model's error and the noise.
        rough: energy by which an explanation with few amplitudes must be worse for a lead of 1.
        angle_off_deg, radius_off_m: between the free arrangement and the layout.
        tag_nats: the tag's energy over the variance of the noise.
        early_m: how much earlier than a point in its place a reflector answers, one way, m. A reflector
            answers from its place to within the bounce at the wall and the error of the axis distance; the
            wall of an oval body imitates a pair, but answers from far outside its apparent radius.
        through: the wave passes through the body: the pattern has more terms than that of a reflector before
            an opaque wall, or the wall is not metal.
        front_m: the same of the body about its centre, the radius of a body with a wall; the smaller one of
            those beside the layout and beside another arrangement that leaves less.
        body_energy: that the body explains beside the reflectors; the smaller one as well.
        back: amplitude of the reflectors' pattern from behind over that from in front.
        points_lead: lead over the best arrangement of points without a body; infinite where none was fitted.
        wall: the round wall whose waves fix the reflectors' pattern; None where the pattern was free.
        freely: energy that the layout leaves on this body with a free pattern, where `wall` fixes it here;
            infinite where another layout is the best one then.
    """

    body: BodyModel
    pose: Pose
    spectra: Spectra
    views: int
    energy: float
    noise: float
    variance: float
    body_left: float
    layouts: tuple[Placed, ...]
    others: tuple[Placed, ...]
    free: Placed | None
    tag: float
    unexplained: float
    lead: float
    untagged_lead: float
    error: float
    rough: float
    angle_off_deg: float
    radius_off_m: float
    tag_nats: float
    early_m: float
    through: bool
    front_m: float
    body_energy: float
    back: float = 0.0
    points_lead: float = np.inf
    wall: Shell | None = None
    freely: float = np.inf

    @property
    def least(self) -> float:
        """The least energy that any arrangement leaves on this body."""
        return min(placed.left for placed in (*self.layouts, *self.others))

    @property
    def nominal_m(self) -> float:
        """Mean distance of the best layout's reflectors from their centre, as built, m."""
        batch = self.layouts[0].batch
        return float(batch.radii[0][batch.present[0] > 0].mean())

    @property
    def outside_m(self) -> float:
        """How far outside the best layout's places its reflectors seem to be, m."""
        return float(self.layouts[0].radii.mean()) - self.nominal_m

    @property
    def signal(self) -> float:
        """Energy of the moving echo above noise."""
        return max(self.energy - self.noise, 1e-30)

    def share(self, left: float) -> float:
        """Energy left above noise as a share of the moving echo above noise, 0..1."""
        return float(np.clip((left - self.noise) / self.signal, 0, 1))

    @property
    def body_over_tag(self) -> float:
        """Energy of the whole echo of the body over that of the tag.

        Estimated from what moves of it: of a body on the rotation axis nothing does, and anything may stand
        there; off the axis, a body that returns as much as reflectors moves as they do.
        """
        at, turn = np.array([self.layouts[0].centre]), np.array([self.pose.turn_rad])
        echo = self.body.echo(self.spectra, at, turn)[0]
        whole = float((np.abs(echo) ** 2).sum())
        moving = float((np.abs(centred(echo)) ** 2).sum())
        return self.body_energy * whole / max(moving * self.tag, 1e-30)

    def against(self, points: PointReading) -> BodyReading:
        """The reading with the lead that is left against points without a body.

        Free points near one layout are another arrangement than the layout that is read here.
        """
        rivals = [placed.left for placed in points.others[:1]]
        if points.layouts[0].layout != self.layouts[0].layout:
            rivals.append(points.free.left)
        if not rivals or self.body.name:
            return self
        lead = (min(rivals) - self.layouts[0].charged) / self.rough
        return replace(self, lead=min(self.lead, lead), points_lead=lead)


def seen_again(
    reading: BodyReading,
    spectra: Spectra,
    beside: NDArray[np.complex128],
    left: float,
    settings: BodySettings,
) -> Seen | None:
    """What the body of a reading tells of the scans beside reflectors; None where that is not worth having.

    It would change little, or reflectors stand for the body.

    Args:
        reading: the reading.
        spectra: the scans.
        beside: (F, C, V) echoes of the reflectors, each with a free amplitude per frequency.
        left: energy that the reading leaves.
        settings: how much is little.
    """
    seen = reading.body.seen(spectra, reading.pose, beside, reading.layouts[0].left / spectra.data.size)
    if seen is None or left - seen.left < settings.look_again * reading.error:
        return None
    # Free patterns may take the body's part, which then is bent to suit nothing that stands there.
    lost = alone(seen.spectra, reading.body, seen.pose).left > settings.bent * reading.body_left
    return None if lost else seen
