"""The readings of hypotheses that won: points, a layout on a body, an enrolled object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tagid.tags.bodies.body_reading import BodyReading, Placed
from tagid.tags.bodies.calibration import Bound
from tagid.tags.bodies.hypothesis import Explanation, Kind
from tagid.tags.bodies.objects import ObjectReading
from tagid.tags.bodies.points import PlacedPoints, PointReading
from tagid.tags.layouts.layout import Layout
from tagid.tags.matching.reading import Reading
from tagid.tags.reading.reflectors import Reflector
from tagid.tags.verdicts.verdict import Code, Verdict

UNEXPLAINED = 0.04
"""Reflectors of an arrangement that leaves more of what the body leaves are not reported: they stand for
something else. Tags on cans leave up to 2 %, a handle for which one reflector stands 4.6 to 13 %."""


@dataclass(frozen=True)
class Placement:
    """Where a layout lies: its origin, x + jy, m, and its turn, rad."""

    centre: complex
    turn_rad: float


def placement_of(layout: Layout, placed: PlacedPoints) -> Placement:
    """Where a layout lies whose reflectors were fitted as points."""
    own = layout.positions[:, 0] + 1j * layout.positions[:, 1]
    turn = complex(np.vdot(own - own.mean(), placed.places - placed.places.mean()))
    centre = complex(placed.places.mean() - own.mean() * turn / max(abs(turn), 1e-30))
    return Placement(centre, float(np.angle(turn)))


def as_points(bare: Reading, points: PointReading, layouts: Sequence[Layout]) -> Reading:
    """The reading of a layout that points with double bounce explain and nothing else does."""
    best = points.layouts[0]
    if bare.status == "identified":
        if bare.layout == best.layout:
            return bare
        return replace(
            bare,
            status="ambiguous",
            code=Code.AMBIGUOUS,
            reason=f"{bare.layout} and {best.layout} explain the echo about equally",
        )
    layout = next(one for one in layouts if one.name == best.layout)
    placement = placement_of(layout, best)
    each = max(points.tag / max(len(best.places), 1), 1e-30)
    snr = float(10 * np.log10(each / max(points.noise, 1e-9 * each)))
    return replace(
        bare,
        status="identified",
        code=Code.NONE,
        reason="",
        layout=layout.name,
        nearest=layout.name,
        score=float(np.clip(1 - points.unexplained, 0, 1)),
        margin=float(np.clip(points.lead / (1 + max(points.lead, 0.0)), 0, 1)),
        rotation_deg=float(np.rad2deg(placement.turn_rad) % (360 / layout.symmetry)),
        centre_m=(placement.centre.real, placement.centre.imag),
        reflectors=tuple(
            Reflector(float(z.real), float(z.imag), 1.0 + 0j, 0.0, snr, True) for z in points.free.places
        ),
        missing=0,
        extra=0,
    )


def on_body(bare: Reading, reading: BodyReading, layouts: Sequence[Layout], bound: Bound | None) -> Reading:
    """The reading that a layout on a body won."""
    best = reading.layouts[0]
    layout = next(one for one in layouts if one.name == best.layout)
    return replace(
        bare,
        status="identified",
        reason="",
        code=Code.NONE,
        layout=best.layout,
        nearest=layout.name,
        score=float(np.clip(1 - reading.unexplained, 0, 1)),
        margin=float(np.clip(reading.lead / (1 + max(reading.lead, 0.0)), 0, 1)),
        rotation_deg=_rotation_deg(best, layout),
        centre_m=(best.centre.real, best.centre.imag),
        reflectors=_measured(reading),
        missing=0,
        extra=0,
        kind=kind_on(reading),
        bound=bound,
        body=reading,
    )


def on_object(
    bare: Reading,
    won: ObjectReading,
    passed: Sequence[tuple[BodyReading, Verdict]],
    second: float,
    fitted: BodyReading | None = None,
) -> Reading:
    """The reading that an enrolled object won, unless a layout on a body with another name fits as well.

    Args:
        bare: reading of the scans without a body.
        won: the object.
        passed: readings on bodies that name a layout.
        second: noise energies within which a name on a body is as good.
        fitted: what the same scans say of a tag on a body; None where no body shows. The object is one echo
            as a whole: its body and its reflectors are told apart by this reading only.
    """
    name = won.model.layout or won.model.name
    # The signature is the narrower statement: a layout on a body, free in pattern and place, must leave
    # clearly less to contradict it.
    rivals = [
        r
        for r, _ in passed
        if r.layouts[0].layout != name and won.match.left - r.layouts[0].left > second * r.noise
    ]
    status, reason = "identified", ""
    if rivals:
        other = rivals[0]
        status = "ambiguous"
        reason = f"the echo is that of the enrolled object {name}, or of {other.layouts[0].layout} on a body"
    left = max(won.excess, 0.0) / max(won.beyond_body, 1e-9)
    return replace(
        bare,
        status=status,
        reason=reason,
        code=Code.AMBIGUOUS if rivals else Code.NONE,
        layout=name,
        nearest=name,
        score=float(np.clip(1 - left, 0, 1)),
        margin=float(np.clip(1 - left, 0, 1)),
        rotation_deg=float(np.rad2deg(won.match.pose.turn_rad) % 360),
        centre_m=won.match.pose.centre_m,
        reflectors=measured(fitted, matched=True) if fitted is not None else (),
        missing=0,
        extra=0,
        kind=Kind.OBJECT,
        body=fitted,
    )


def hypothesis_on(reading: BodyReading) -> Explanation:
    """The best layout on a body as a hypothesis."""
    best = reading.layouts[0]
    return Explanation(
        kind_on(reading),
        reading.body.name,
        best.layout,
        reading.share(best.left),
        float(min(reading.unexplained, 1.0)),
        reading.pose,
        None,
        float(best.radii.mean()),
    )


def kind_on(reading: BodyReading) -> Kind:
    return Kind.BODY if reading.body.name else Kind.ROUND


def _rotation_deg(placed: Placed, layout: Layout) -> float:
    """Rotation of the layout, within its symmetry, degrees."""
    place = layout.positions[:, 0] + 1j * layout.positions[:, 1]
    turned = np.exp(1j * (placed.angles - np.angle(place[np.abs(place) > 0.01])))
    return float(np.rad2deg(np.angle(turned.sum())) % (360 / layout.symmetry))


def _measured(reading: BodyReading) -> tuple[Reflector, ...]:
    """The reflectors where they were found with free angles, at their apparent radius."""
    return _as_reflectors(reading.free or reading.layouts[0], reading.tag_nats, matched=True)


def measured(reading: BodyReading, *, matched: bool) -> tuple[Reflector, ...]:
    """The reflectors of the arrangement that explains the echo best, whether a layout has it or not.

    None where it leaves over `UNEXPLAINED` of what the body leaves: then they stand for something else.

    Args:
        reading: on a body.
        matched: whether they are those of what is named.
    """
    best = min((*reading.layouts, *reading.others), key=lambda placed: placed.charged)
    beyond = max(reading.body_left - reading.noise, 1e-30)
    if best.left - reading.noise > UNEXPLAINED * beyond:
        return ()
    nats = (reading.body_left - best.left) / max(reading.variance, 1e-30)
    free = reading.free if best is reading.layouts[0] else None
    return _as_reflectors(free or best, nats, matched)


def _as_reflectors(placed: Placed, nats: float, matched: bool) -> tuple[Reflector, ...]:
    """Reflectors at their apparent places, that share an energy of `nats` variances of the noise."""
    snr = float(10 * np.log10(max(nats / len(placed.angles), 1e-9)))
    return tuple(Reflector(float(x), float(y), 1.0 + 0j, 0.0, snr, matched) for x, y in placed.positions)
