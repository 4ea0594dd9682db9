"""What a hypothesis is, and the geometry by which hypotheses are compared and begun."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations, permutations

import numpy as np

from tagid.reading.arrangement import Arrangement
from tagid.reading.columns import Model
from tagid.reading.descent import Estimate, Powers
from tagid.reading.search import Group
from tagid.reading.signature import HEAD, EnrolledBody, SignatureModel
from tagid.reading.spectra import Spectra
from tagid.tags.layouts.layout import Layout
from tagid.types import Complex, Floats

MOST_ODD = 2
"""Odd scatterers that one search adds beside a tag."""
MOST_REFLECTORS = 5
"""Reflectors of an arrangement that is not enrolled."""
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
        estimate: the model at its most probable parameters.
        log_z: log evidence, nats.
        middle: the layout has a reflector in the middle, which looks like the body.
        prior: log probability of it, in `log_z`.
    """

    layout: Layout | None
    estimate: Estimate
    log_z: float
    middle: bool = False
    prior: float = 0.0

    def moved(self, by: complex, prior: float) -> Hypothesis:
        """The same of a recording whose origin lies elsewhere: places are so much farther, x + jy, m.

        Args:
            prior: log probability more, nats.
        """
        estimate = replace(self.estimate, x=moved(self.estimate.model, self.estimate.x, by))
        return replace(self, estimate=estimate, log_z=self.log_z + prior, prior=self.prior + prior)

    @property
    def tagged(self) -> bool:
        """It has a tag. One reflector alone has no arrangement, and echoes as a small round body does."""
        model = self.estimate.model
        single = model.tag is not None and model.tag.count == 1 and not model.whole
        return model.tagged and (self.layout is not None or not single)

    @property
    def name(self) -> str | None:
        """Of the layout, or of the enrolled object that stands there as it was."""
        return self.estimate.model.identity if self.layout is None else self.layout.name


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
        reflectors = zip(tag.radius_m.tolist(), tag.angle.tolist(), tag.height_m.tolist(), strict=True)
        return tuple((radius, angle, height + rise_m) for radius, angle, height in reflectors)


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
    def of(cls, spectra: Spectra, estimate: Estimate) -> Stand:
        """That of a hypothesis."""
        assert isinstance(estimate.model, SignatureModel)
        echo = estimate.model.at(spectra, estimate.x, slopes=False).values[:, 0]
        centres = estimate.centre, complex(estimate.x[0], estimate.x[1])
        powers = Powers(1e-2, estimate.powers.body)
        return cls(estimate.model.body, estimate.x[:HEAD], echo, centres, powers)

    def head(self, centre: complex) -> Floats:
        """Parameters before those of reflectors about a centre."""
        off = centre - self.centres[1]
        return np.append(self.x, [off.real, off.imag])


def best_bare(hypotheses: Sequence[Hypothesis], name: str) -> Hypothesis | None:
    """The best hypothesis of a name without a body; None where there is none."""
    bare = [
        hypothesis
        for hypothesis in hypotheses
        if hypothesis.name == name and not hypothesis.estimate.model.body_columns
    ]
    return max(bare, key=lambda hypothesis: hypothesis.log_z, default=None)


def moved(model: Model, x: Floats, by: complex) -> Floats:
    """Parameters x (P,) of a model with all places so much farther, x + jy, m."""
    x = x.copy()
    for row in model.place_rows:
        x[row : row + 2] += by.real, by.imag
    return x


def distinct(positions: Sequence[complex]) -> list[complex]:
    """Places x + jy, m, without those that stand within 1 mm of one before them."""
    out: list[complex] = []
    for place in positions:
        if all(abs(place - other) > 1e-3 for other in out):
            out.append(place)
    return out


def disc_of(radius_m: float) -> int:
    """Number of the clutter's disc for reflectors at a distance from the axis, m."""
    return 0 if radius_m < 0.08 else 1


def bodies_apart(some: Sequence[Hypothesis]) -> list[Estimate]:
    """One enrolled body in all poses that differ."""
    out: list[Estimate] = []
    for estimate in (hypothesis.estimate for hypothesis in some):
        if all(
            abs(np.angle(np.exp(1j * (estimate.x[2] - other.x[2])))) > 0.05
            or np.abs(estimate.x[:2] - other.x[:2]).max() > 2e-3
            for other in out
        ):
            out.append(estimate)
    return out


def pose_of(tag: Arrangement, positions: Complex) -> tuple[complex, float] | None:
    """Centre and turn that lay a tag's reflectors on places (K,), x + jy, m; None where they are far off."""
    if tag.count != len(positions) or tag.count < 2:
        return None
    flat = tag.radius_m * np.exp(1j * tag.angle)
    best, pose = FITS_M, None
    for order in permutations(range(tag.count)):
        p = positions[list(order)]
        turn = np.vdot(flat - flat.mean(), p - p.mean())
        turn = turn / max(abs(turn), 1e-30)
        off = np.abs((flat - flat.mean()) * turn - (p - p.mean())).max()
        if off < best:
            best, pose = float(off), (complex(p.mean() - flat.mean() * turn), float(np.angle(turn)))
    return pose


def as_layouts(estimate: Estimate, layouts: Sequence[Layout]) -> Iterator[tuple[Layout, Model, Floats, bool]]:
    """Layouts where points of a hypothesis, alike or odd, stand about as theirs do; the other points are odd.

    Gives layout, model, parameters, and whether the body covers the layout's middle.
    """
    model = estimate.model
    head = estimate.x[: model.head].copy()
    # The centre is counted from that of a sheet or an enrolled body.
    origin = estimate.centre - complex(*head[model.about])
    points, alike = np.concatenate([estimate.positions, estimate.odd]), tuple(range(len(estimate.positions)))
    heights = np.concatenate(model.heights_of(estimate.x))
    for layout in layouts:
        arranged = Arranged.of(layout, model.covers_middle)
        for some in combinations(range(len(points)), arranged.tag.count):
            rest = [] if some == alike else [i for i in range(len(points)) if i not in some]
            pose = pose_of(arranged.tag, points[list(some)]) if len(rest) <= MOST_ODD else None
            if pose is None:
                continue
            head[model.about] = (pose[0] - origin).real, (pose[0] - origin).imag
            placed = replace(model, tag=arranged.tag, disc=disc_of(arranged.radius_m), odd=0)
            rise = [float(np.mean(heights[list(some)] - arranged.tag.height_m))] * placed.lifts
            x = np.r_[head, pose[1], 0.0, rise]
            for i in rest:
                placed, spot = placed.and_odd(), [points[i].real, points[i].imag, heights[i]]
                x = np.append(x, spot[: placed.spot])
            yield layout, placed, x, arranged.middle


def unlike(starts: list[Candidate], count: int) -> list[Candidate]:
    """The best starts of one layout whose reflectors stand in other places."""
    out: list[Candidate] = []
    for start in sorted(starts, key=lambda start: -start.log):
        positions = start.model.positions(start.x)
        if all(
            np.abs(positions[:, None] - other.model.positions(other.x)).min(axis=1).max() > 0.015
            for other in out
        ):
            out.append(start)
        if len(out) == count:
            break
    return out


def rivals(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """What competes with the best name: the best of every other name, and those without one of every transfer
    and number of reflectors; the best first."""
    kinds: dict[tuple[str | None, str, int], Hypothesis] = {}
    for hypothesis in sorted(hypotheses, key=lambda hypothesis: -hypothesis.log_z):
        estimate, name = hypothesis.estimate, hypothesis.name
        kind = ("", 0) if name is not None else (estimate.model.transfer.name, len(estimate.positions))
        kinds.setdefault((name, *kind), hypothesis)
    best = next((hypothesis for hypothesis in kinds.values() if hypothesis.name is not None), None)
    return [hypothesis for hypothesis in kinds.values() if hypothesis is not best]


def same_place(estimate: Estimate, other: Estimate) -> bool:
    """Both are of one model and stand at one place."""
    if estimate.model.transfer is not other.model.transfer or len(estimate.positions) != len(other.positions):
        return False
    if not len(estimate.positions):
        return estimate.model.disc == other.model.disc
    if differ_in_height(estimate, other):
        return False
    return bool((np.abs(estimate.positions[:, None] - other.positions).min(axis=1) < 5e-3).all())


def differ_in_height(estimate: Estimate, other: Estimate) -> bool:
    """Whether reflectors of `estimate` stand at other heights than the nearest of `other`, or at any.

    A height that is common to all is that of the object's plane.
    """
    tag = estimate.model.tag
    if not (estimate.model.lifts or other.model.lifts) or tag is None or not len(other.positions):
        return False
    if tag.tall and tag.lifts > 1 and not tag.glued:
        return True
    nearest = np.abs(estimate.positions[:, None] - other.positions).argmin(axis=1)
    off = estimate.model.heights_of(estimate.x)[0] - other.model.heights_of(other.x)[0][nearest]
    return bool(np.abs(off - off.mean()).max() > LEVEL_M)
