"""What a hypothesis is, and the geometry by which hypotheses are compared and begun."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations, permutations

import numpy as np

from tagid.reading.arrangement import Arrangement
from tagid.reading.columns import Model
from tagid.reading.descent import Found, Powers
from tagid.reading.search import Group
from tagid.reading.signature import HEAD, EnrolledBody, SignatureModel
from tagid.reading.spectra import Spectra
from tagid.tags.layouts.layout import Layout
from tagid.types import Complex, Floats

FITS_M = 0.012
"""A layout is tried where a free arrangement differs from it by less, m."""
MIDDLE_M = 5e-3
"""A reflector nearer to the axis is the middle one: beside a body it looks like that."""
LEVEL_M = 0.02
"""Heights that differ by less are the same, m."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One explanation of a recording.

    Attributes:
        layout: the enrolled one; None for none or an arrangement that is not enrolled.
        found: the model at its most probable parameters.
        log_z: log evidence, nats.
        middle: the layout has a reflector in the middle, which looks like the body.
        prior: log probability of it, in `log_z`.
    """

    layout: Layout | None
    found: Found
    log_z: float
    middle: bool = False
    prior: float = 0.0

    @property
    def tagged(self) -> bool:
        """It has reflectors."""
        return self.found.model.tagged

    @property
    def name(self) -> str | None:
        """Of the layout, or of the enrolled object that stands there as it was."""
        return self.found.model.identity if self.layout is None else self.layout.name


@dataclass(frozen=True, eq=False)
class Joint:
    """An explanation of one recording or of several.

    Attributes:
        log_z: log evidence over all of them, nats.
        shown: what it looks like in one of them.
        mixed: the recordings are not all of one object.
        bare: log evidence of the best of its name without a body, nats; -inf where there is none.
    """

    log_z: float
    shown: Hypothesis
    mixed: bool = False
    bare: float = float("-inf")


@dataclass(frozen=True, eq=False)
class Candidate:
    """A start of the descent and the log evidence that the tables give it."""

    log: float
    layout: Layout | None
    model: Model
    x: Floats
    middle: bool


@dataclass(frozen=True, eq=False)
class Arranged:
    """A layout as an arrangement; without its middle reflector if the body covers that."""

    layout: Layout
    tag: Arrangement
    radius_m: float
    middle: bool

    @classmethod
    @lru_cache(maxsize=256)
    def of(cls, layout: Layout, covered: bool) -> Arranged:
        whole = Arrangement.of_layout(layout.positions, layout.heights)
        out = whole.radius_m > MIDDLE_M
        tag = whole.of(np.flatnonzero(out)) if covered else whole
        return cls(layout, tag, float(whole.radius_m.max()), covered and bool((~out).any()))

    def group(self, rise_m: float) -> Group:
        """Radius, m, angle, rad, and height, m, of every reflector, risen by so much."""
        tag = self.tag
        places = zip(tag.radius_m.tolist(), tag.angle.tolist(), tag.height_m.tolist(), strict=True)
        return tuple((radius, angle, height + rise_m) for radius, angle, height in places)


@dataclass(frozen=True, eq=False)
class Stand:
    """An enrolled body in its pose.

    Attributes:
        x: (HEAD,) parameters of the body.
        echo: (F, V).
        centres: of a tag as it is supposed, and of the body.
        powers: under which reflectors are looked for.
    """

    body: EnrolledBody
    x: Floats
    echo: Complex
    centres: tuple[complex, complex]
    powers: Powers

    @classmethod
    def of(cls, spectra: Spectra, found: Found) -> Stand:
        """That of a hypothesis."""
        assert isinstance(found.model, SignatureModel)
        echo = found.model.at(spectra, found.x, slopes=False).values[:, 0]
        centres = found.centre, complex(found.x[0], found.x[1])
        powers = Powers(1e-2, found.powers.body)
        return cls(found.model.body, found.x[:HEAD], echo, centres, powers)

    def head(self, centre: complex) -> Floats:
        """Parameters before those of reflectors about a centre."""
        off = centre - self.centres[1]
        return np.append(self.x, [off.real, off.imag])


def best_bare(hypotheses: Sequence[Hypothesis], name: str) -> Hypothesis | None:
    """The best hypothesis of a name without a body; None where there is none."""
    bare = [
        hypothesis
        for hypothesis in hypotheses
        if hypothesis.name == name and not hypothesis.found.model.body_columns
    ]
    return max(bare, key=lambda one: one.log_z, default=None)


def distinct(places: Sequence[complex], apart_m: float) -> list[complex]:
    """Places x + jy, m, without those that stand nearer to one before them."""
    out: list[complex] = []
    for place in places:
        if all(abs(place - other) > apart_m for other in out):
            out.append(place)
    return out


def disc_of(radius_m: float) -> int:
    """Number of the clutter's disc for reflectors at a distance from the axis, m."""
    return 0 if radius_m < 0.08 else 1


def bodies_apart(some: Sequence[Hypothesis]) -> list[Found]:
    """One enrolled body in all poses that differ."""
    out: list[Found] = []
    for found in (one.found for one in some):
        if all(
            abs(np.angle(np.exp(1j * (found.x[2] - other.x[2])))) > 0.05
            or np.abs(found.x[:2] - other.x[:2]).max() > 2e-3
            for other in out
        ):
            out.append(found)
    return out


def pose_of(tag: Arrangement, places: Complex) -> tuple[complex, float] | None:
    """Centre and turn that lay a tag's reflectors on places (K,), x + jy, m; None where they are far off."""
    if tag.count != len(places) or tag.count < 2:
        return None
    flat = tag.radius_m * np.exp(1j * tag.angle)
    best, found = FITS_M, None
    for order in permutations(range(tag.count)):
        p = places[list(order)]
        turn = np.vdot(flat - flat.mean(), p - p.mean())
        turn = turn / max(abs(turn), 1e-30)
        off = np.abs((flat - flat.mean()) * turn - (p - p.mean())).max()
        if off < best:
            best, found = float(off), (complex(p.mean() - flat.mean() * turn), float(np.angle(turn)))
    return found


def as_layouts(
    found: Found, layouts: Sequence[Layout], most_odd: int
) -> Iterator[tuple[Layout, Model, Floats, bool]]:
    """Layouts where points of a hypothesis, alike or odd, stand about as theirs do; the other points are odd.

    Gives layout, model, parameters, and whether the body covers the layout's middle.
    """
    model = found.model
    head = found.x[: model.head].copy()
    # The centre is counted from that of a sheet or an enrolled body.
    origin = found.centre - complex(*head[model.about])
    points, alike = np.concatenate([found.places, found.odd]), tuple(range(len(found.places)))
    heights = np.concatenate(model.heights_of(found.x))
    for layout in layouts:
        arranged = Arranged.of(layout, model.covers_middle)
        for some in combinations(range(len(points)), arranged.tag.count):
            rest = [] if some == alike else [i for i in range(len(points)) if i not in some]
            pose = pose_of(arranged.tag, points[list(some)]) if len(rest) <= most_odd else None
            if pose is None:
                continue
            head[model.about] = (pose[0] - origin).real, (pose[0] - origin).imag
            own = replace(model, tag=arranged.tag, disc=disc_of(arranged.radius_m), odd=0)
            rise = [float(np.mean(heights[list(some)] - arranged.tag.height_m))] * own.lifts
            x = np.r_[head, pose[1], 0.0, rise]
            for i in rest:
                own, spot = own.and_odd(), [points[i].real, points[i].imag, heights[i]]
                x = np.append(x, spot[: own.spot])
            yield layout, own, x, arranged.middle


def middle_of(places: Complex) -> complex:
    """Centre of the circle nearest to three places or more (K,), x + jy, m."""
    rows = np.stack([places.real, places.imag, np.ones(len(places))], axis=1)
    across, along, _ = np.linalg.lstsq(rows, np.abs(places) ** 2, rcond=None)[0]
    return complex(across, along) / 2


def unlike(starts: list[Candidate], count: int) -> list[Candidate]:
    """The best starts of one layout whose reflectors stand in other places."""
    out: list[Candidate] = []
    for one in sorted(starts, key=lambda one: -one.log):
        places = one.model.places(one.x)
        if all(
            np.abs(places[:, None] - other.model.places(other.x)).min(axis=1).max() > 0.015 for other in out
        ):
            out.append(one)
        if len(out) == count:
            break
    return out


def same_place(one: Found, other: Found) -> bool:
    """Both are of one model and stand at one place."""
    if one.model.transfer is not other.model.transfer or len(one.places) != len(other.places):
        return False
    if differ_in_height(one, other):
        return False
    return bool((np.abs(one.places[:, None] - other.places).min(axis=1) < 5e-3).all())


def differ_in_height(one: Found, other: Found) -> bool:
    """Whether reflectors of `one` stand at other heights than the nearest of `other`, or at any.

    A height that is common to all is that of the object's plane.
    """
    tag = one.model.tag
    if not (one.model.lifts or other.model.lifts) or tag is None or not len(other.places):
        return False
    if tag.tall and tag.lifts > 1:
        return True
    nearest = np.abs(one.places[:, None] - other.places).argmin(axis=1)
    off = one.model.heights_of(one.x)[0] - other.model.heights_of(other.x)[0][nearest]
    return bool(np.abs(off - off.mean()).max() > LEVEL_M)
