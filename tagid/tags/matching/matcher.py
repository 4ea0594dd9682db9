"""From scans to a name: the best place of every layout, what it leaves unexplained, and the decision.

Layouts are compared in the data domain with a charge for every reflector, because any two reflectors of three
look like some layout of two when only peaks are matched.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tagid.errors import RegistryError
from tagid.imaging.preprocess import select_views
from tagid.imaging.types import BasebandScans
from tagid.imaging.whitening import whitened
from tagid.signal import median
from tagid.tags.bodies.body_reading import BodyReading
from tagid.tags.bodies.hypothesis import Enrolled, Explanation, Kind, Pose
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.bodies.transparent import without_transparent
from tagid.tags.layouts.layout import Layout
from tagid.tags.matching.alone import Alone, named_alone, points_of
from tagid.tags.matching.contest import NullEvidence, null_evidence, settle
from tagid.tags.matching.contest_settings import ContestSettings
from tagid.tags.matching.delayed import ASKED, borne_out_by_thin_wall
from tagid.tags.matching.heights import without_bodies
from tagid.tags.matching.on_shell import on_shell
from tagid.tags.matching.reading import LayoutScore, Reading
from tagid.tags.matching.refused import attributed
from tagid.tags.reading.decision import PLACES_PER_METRE, DecisionSettings, Evidence, decide
from tagid.tags.reading.field import MatchedField
from tagid.tags.reading.hidden import HiddenSectors, hidden_sectors
from tagid.tags.reading.hypotheses import ELEVATION_RANGE_M, Fit, SearchSettings, search
from tagid.tags.reading.reflectors import (
    FinderSettings,
    SearchDisc,
    as_reflectors,
    clean,
    no_points,
    separate,
)
from tagid.tags.reading.rivals import rivals
from tagid.tags.reading.thin_wall import ThinWall, thin_wall
from tagid.tags.reading.views import fold_views
from tagid.tags.verdicts.verdict import Code

EXTRA_NATS = 11.0
"""Extra reflectors are looked for more eagerly than the finder does, at 1000 exp(-11) = 2 % of false alarms:
they only count where they are as strong as the layout's own."""


@dataclass(frozen=True)
class ReaderSettings:
    """Search, finder and decision in one value.

    Attributes:
        search, finder, decision: see there.
        contest: reading and decision on bodies.
        direction_known: whether angles rise as the object turns counter-clockwise. Where that is not known,
            every layout is tried as its mirror image too; of two that mirror each other none wins.
    """

    search: SearchSettings = field(default_factory=SearchSettings)
    finder: FinderSettings = field(default_factory=lambda: FinderSettings(detection_nats=EXTRA_NATS))
    decision: DecisionSettings = field(default_factory=DecisionSettings)
    contest: ContestSettings = field(default_factory=ContestSettings)
    direction_known: bool = True


def read_tag(
    scans: BasebandScans,
    layouts: Sequence[Layout],
    settings: ReaderSettings | None = None,
    enrolled: Enrolled | None = None,
) -> Reading:
    """Which of the layouts, if any, turned before the radar.

    Args:
        scans: preprocessed without the matched filter (the reader correlates with the response itself).
        layouts: the enrolled ones.
        settings: search, finder and decision.
        enrolled: enrolled bodies and objects.

    Raises:
        RegistryError: no layouts. DataError: the scans do not hold the object's range.
    """
    scan = MatchedScan(scans, layouts, settings or ReaderSettings(), enrolled)
    return scan.settled(scan.own)


def null_evidence_of(scans: BasebandScans, layouts: Sequence[Layout], *, bodies: bool = True) -> NullEvidence:
    """The evidence for a name that scans of an object without an enrolled tag give, by default settings.

    Args:
        scans, layouts: as of `read_tag`.
        bodies: see `null_evidence`.
    """
    settings = ReaderSettings()
    scan = MatchedScan(scans, layouts, settings)
    bare = scan.own
    evidence = null_evidence(bare, scan.scans, layouts, settings.contest, bodies=bodies)
    if evidence.bare > -np.inf or bare.code is Code.NO_ECHO:
        return evidence
    # As in `MatchedScan.settled`, whatever is found on a body.
    found = scan.cleared()
    return evidence if found is None else replace(evidence, bare=found.points.lead)


CARRIED = 0.2
"""A body that alone explains this share of the moving echo hides reflectors that it carries."""


def _carried(body: BodyReading | None) -> bool:
    """Whether a round body shows, on which another arrangement explains the echo better than any layout."""
    return body is not None and body.lead < 0 and body.body_left < (1 - CARRIED) * body.energy


LEVEL_STEP_M = 8e-3
"""Half a null radius of the point response, as the pixels of the disc are a third of it."""


class MatchedScan:
    """One recording with the best place of every layout in it.

    Args:
        scans, layouts, settings, enrolled: see `read_tag`.

    Attributes:
        scans: the recording, at most a turn of folded views.
        criteria: (layouts,) J of `LayoutScore`, lower is better; of several recordings they add up.

    Raises:
        RegistryError: no layouts. DataError: the scans do not hold the object's range.
    """

    def __init__(
        self,
        scans: BasebandScans,
        layouts: Sequence[Layout],
        settings: ReaderSettings,
        enrolled: Enrolled | None = None,
    ) -> None:
        if not layouts:
            raise RegistryError("no layout is enrolled", "Enrol one with tagid enroll.")
        reach = max(layout.radius_m for layout in layouts) + settings.search.centre_range_m * np.sqrt(2)
        self._radius = max(reach, settings.finder.radius_m)
        self._settings = settings
        self._layouts = layouts
        self._enrolled = enrolled or Enrolled()
        self.scans = fold_views(whitened(scans), self._radius + 0.02)
        heights = np.concatenate([np.asarray(layout.heights) for layout in layouts])
        bounds = float(heights.min()) - ELEVATION_RANGE_M, float(heights.max()) + ELEVATION_RANGE_M
        several = len(self.scans.aperture.height_groups()) > 1
        self._field = MatchedField(self.scans, self._radius + 0.02, bounds if several else (0.0, 0.0))
        self._discs = _levels(self._field, bounds) if several else None
        self._fits = search(self._field, layouts, settings.search)
        if not settings.direction_known:
            turned = search(self._field, [layout.mirrored() for layout in layouts], settings.search)
            pairs = zip(self._fits, turned, strict=True)
            self._fits = [min(pair, key=lambda fit: fit.criterion) for pair in pairs]
        self._places = sum(2 * np.pi * one.radius_m / one.symmetry for one in layouts) * PLACES_PER_METRE
        self._places *= len(settings.search.patterns) * (1 if settings.direction_known else 2)
        self.criteria = np.array([fit.criterion for fit in self._fits])

    def may_be_named(self) -> bool:
        """Whether the fits leave a name without a body possible: enough is explained, and one layout leads.

        Much faster than `read`, and never False where that names a layout.
        """
        ranked = sorted(self._fits, key=lambda fit: fit.criterion)
        best, matched, decision = ranked[0], self._field, self._settings.decision
        # `_signal_energy` with the most noise that it may subtract.
        noise = 2 * matched.noise_variance * matched.independent_samples
        signal = max(matched.energy - noise, best.explained, 1e-30)
        if best.charged < decision.explained_share * signal:
            return False
        lead = best.charged - (ranked[1].charged if len(ranked) > 1 else 0.0)
        return lead >= decision.ambiguous_share * best.charged

    def settled(self, bare: Reading) -> Reading:
        """The reading without a body, or the one on a body where that explains the scans better.

        Views of several antenna heights are compared with bare tags only, see `matching.heights`.
        """
        if self._field.several_heights:
            return without_bodies(bare, self._settings.contest)
        known = self._settings.direction_known
        contest = self._settings.contest
        settled = settle(bare, self.scans, self._layouts, self._enrolled, contest, direction_known=known)
        if not known:
            return attributed(settled, contest)
        passed = settled.kind is Kind.ROUND and settled.body is not None and settled.body.through
        if settled.status == "identified" and passed:
            # A helmet's shell passes for a glass beside some arrangements.
            return on_shell(settled, self.scans, self._layouts, contest) or settled
        if settled.status != "unknown":
            return settled
        if settled.body is not None and settled.body.body.name:
            named = self._beside_transparent(settled, settled.body)
        else:
            named = self._cleared_of(settled) or self._before_thin_plastic(settled)
        last = named or on_shell(settled, self.scans, self._layouts, contest) or settled
        return attributed(last, contest)

    def _cleared_of(self, settled: Reading) -> Reading | None:
        """The name that `cleared` finds, with the other hypotheses; None for none."""
        found = self.cleared()
        if found is None or (found.reading.hidden_deg > 0 and _carried(settled.body)):
            return None
        others = (one for one in settled.hypotheses if one.kind is not Kind.BARE)
        return replace(found.reading, hypotheses=(*found.reading.hypotheses, *others))

    def _before_thin_plastic(self, settled: Reading) -> Reading | None:
        """The name of a pair that a thin wall moves from its places; None for none."""
        contest = self._settings.contest
        if settled.code not in ASKED or self.scans.aperture.views < contest.body.through_views:
            return None
        spectra = Spectra.of(self.scans)
        points = points_of(self.own, spectra, self._layouts, contest.points)
        return borne_out_by_thin_wall(settled, points, spectra, self._layouts, contest)

    def _beside_transparent(self, settled: Reading, on_body: BodyReading) -> Reading | None:
        """The name of points beside an enrolled body that hardly changes the wave; None for none.

        Args:
            settled: the reading, which names nothing.
            on_body: that of the enrolled body in it.
        """
        spectra = Spectra.of(self.scans, wavenumbers=self._enrolled.wavenumbers)
        contest = self._settings.contest
        scans = without_transparent(self.scans, spectra, on_body, contest.body.priors)
        found = MatchedScan(scans, self._layouts, self._settings)._alone()
        if found is None or not contest.transparent.bears_out(found.points, on_body):
            return None
        points = found.points
        left = points.unexplained * points.tag / on_body.signal
        own = Explanation(
            Kind.BODY,
            on_body.body.name,
            found.reading.layout,
            float(np.clip(left, 0, 1)),
            float(np.clip(points.unexplained, 0, 1)),
            on_body.pose,
        )
        hypotheses = tuple(sorted((own, *settled.hypotheses), key=lambda one: one.left))
        return replace(found.reading, kind=Kind.BODY, body=on_body, hypotheses=hypotheses)

    @property
    def _best(self) -> Fit:
        """The fit that leads in this recording."""
        return self._fits[int(np.argmin(self.criteria))]

    @property
    def charged(self) -> float:
        """The most energy that a layout explains without a body, after the charge for unlike amplitudes."""
        return self._best.charged

    @cached_property
    def own(self) -> Reading:
        """What this recording says without a body where its own best layout leads."""
        return self.read(np.argsort(self.criteria))

    @cached_property
    def wall(self) -> ThinWall | None:
        """The thin round wall about the best layout's centre; None where none shows."""
        return thin_wall(self.scans, self._field, self._best)

    @cached_property
    def without_wall(self) -> MatchedScan:
        """The recording without the echo of its thin wall; itself where there is none."""
        if self.wall is None:
            return self
        return MatchedScan(self.wall.scans, self._layouts, self._settings)

    @cached_property
    def hidden(self) -> HiddenSectors | None:
        """Sectors in which something hides the best layout's reflectors; None where none shows."""
        evidence = self.own.evidence
        # Reflectors that shine outward only are hidden by the body that carries them.
        if evidence.uneven_nats <= 0 or evidence.outward > self._settings.contest.outward:
            return None
        return hidden_sectors(self._field, self._best)

    @cached_property
    def where_seen(self) -> MatchedScan:
        """The views in which nothing hides a reflector; the recording itself where nothing does in any."""
        if self.hidden is None:
            return self
        seen = select_views(self.scans, np.flatnonzero(self.hidden.seen))
        return MatchedScan(seen, self._layouts, self._settings)

    def cleared(self) -> Alone | None:
        """The name without a body once what disturbs it is left out; None for none.

        That is the echo of a thin round wall, or else the views in which something hides a reflector. Both
        together would fit too much.
        """
        found = self._before_thin_wall()
        if found is not None or self.hidden is None:
            return found
        found = self.where_seen._alone()
        # Fewer views may not name what all of them do not find, nor what points elsewhere explain as well.
        if found is None or found.reading.layout != self.own.nearest or found.points.lead <= 0:
            return None
        lost = 360.0 * float(np.mean(~self.hidden.seen))
        note = f"something hides a reflector in {lost:.0f} degrees of the turn, which were left out"
        own = (_as_hypothesis(found),)
        return replace(found, reading=replace(found.reading, hypotheses=own, note=note, hidden_deg=lost))

    def _alone(self) -> Alone | None:
        """The name without a body."""
        return named_alone(self.own, Spectra.of(self.scans), self._layouts, self._settings.contest)

    def _before_thin_wall(self) -> Alone | None:
        """The name without a body once the echo of a thin round wall is taken out; None for none."""
        if self.wall is None:
            return None
        found = self.without_wall._alone()
        # Of tags on thin shells points leave up to 12 %; a pair on a can, at 12 views, passed for three in a
        # line that left 16 and 24 %.
        if found is None or found.points.unexplained > self._settings.contest.bare.unexplained:
            return None
        reading, radius = found.reading, self.wall.radius_m
        own = _as_hypothesis(found)
        note = f"the echo of a thin round wall, about {radius * 1e3:.0f} mm in radius, was taken out first"
        return replace(found, reading=replace(reading, hypotheses=(own,), note=note, wall_m=radius))

    def read(self, order: NDArray[np.intp]) -> Reading:
        """What this recording says without a body if the layouts rank in this order."""
        settings, matched = self._settings, self._field
        ranked = [self._fits[i] for i in order]
        best, runner_up = ranked[0], ranked[1] if len(ranked) > 1 else None
        disc = SearchDisc(matched, self._radius, settings.finder.step_m, best.look, self._discs)
        positions, amplitudes, level = clean(disc, best.points, best.amplitudes, settings.finder)
        apart = separate(positions, amplitudes, best.layout.size, matched.height_scale)
        positions, amplitudes = positions[apart], amplitudes[apart]
        case = _Case(disc, best, runner_up, np.abs(amplitudes), level, self._places)
        evidence, measured = _evidence(case, settings)
        verdict = decide(evidence, settings.decision)
        status = verdict.status
        named = best.layout.size if status in ("identified", "ambiguous") else 0
        if named:
            positions = np.concatenate([measured, positions[named:]])
        else:
            # What was found without the layout: its own places would look like a measurement.
            positions, amplitudes, level = clean(disc, *no_points(disc), settings.finder)
            apart = separate(positions, amplitudes, 0, matched.height_scale)
            positions, amplitudes = positions[apart], amplitudes[apart]
        signal = _signal_energy(matched, best, level)
        return Reading(
            status=status,
            reason=verdict.reason,
            code=verdict.code,
            layout=best.layout.name if status in ("identified", "ambiguous") else None,
            nearest=best.layout.name,
            score=0.0 if status == "no_tag" else _certain_share(matched, best, level),
            margin=float(np.clip(evidence.margin_share, 0, 1)),
            rotation_deg=float(np.rad2deg(best.rotation_rad)),
            centre_m=(float(best.centre_m[0]), float(best.centre_m[1])),
            offset_m=best.offset_m,
            reflectors=as_reflectors(positions, amplitudes, level, matched.template_energy, named),
            missing=evidence.missing,
            extra=evidence.extra,
            scores=tuple(_score(matched, fit, signal) for fit in ranked),
            evidence=evidence,
        )


def _as_hypothesis(found: Alone) -> Explanation:
    """A name without a body as a hypothesis."""
    reading, left = found.reading, float(np.clip(found.points.unexplained, 0, 1))
    return Explanation(
        Kind.BARE, "", reading.layout, left, None, Pose(reading.centre_m), reading.rotation_deg
    )


def _levels(matched: MatchedField, bounds_m: tuple[float, float]) -> NDArray[np.float64]:
    """Heights of the discs in which free points are searched, m.

    Their distance changes the echoes as much as LEVEL_STEP_M in the plane does, from which a free point still
    finds its place.
    """
    count = int(np.clip(np.ceil((bounds_m[1] - bounds_m[0]) / (LEVEL_STEP_M * matched.height_scale)), 2, 12))
    return np.linspace(*bounds_m, count)


def _signal_energy(matched: MatchedField, fit: Fit, level: float) -> float:
    """Energy above noise, at least what the fit explains.

    The noise is what the scans say or what the residual shows, but no more than twice the former: in strong
    echoes the residual is the model's error, which is not to be forgiven.
    """
    stated = matched.noise_variance * matched.independent_samples
    noise = float(np.clip(level * matched.independent_samples, stated, 2 * stated)) if stated > 0 else 0.0
    return float(max(matched.energy - noise, fit.explained, 1e-30))


def _certain_share(matched: MatchedField, fit: Fit, level: float) -> float:
    """Explained share with the signal's energy taken two standard deviations of the noise's larger."""
    n, variance = matched.independent_samples, matched.noise_variance
    return float(min(fit.charged / (_signal_energy(matched, fit, level) + 2 * np.sqrt(n) * variance), 1.0))


def _score(matched: MatchedField, fit: Fit, signal: float) -> LayoutScore:
    return LayoutScore(
        fit.layout.name,
        fit.criterion,
        float(min(fit.charged / signal, 1.0)),
        float(np.rad2deg(fit.rotation_rad)),
        (float(fit.centre_m[0]), float(fit.centre_m[1])),
    )


@dataclass(frozen=True, eq=False)
class _Case:
    """What the decision about the best layout of one recording is computed from.

    Attributes:
        disc: search area, with the aspect of the layout's reflectors.
        best, runner_up: fits of the two leading layouts; None if only one is enrolled.
        magnitudes: (n,) of the points found: the layout's reflectors first, then those beyond it.
        level: noise and clutter of the residual.
        places: number of independent places searched, over all layouts.
    """

    disc: SearchDisc
    best: Fit
    runner_up: Fit | None
    magnitudes: NDArray[np.float64]
    level: float
    places: float


def _absent(best: Fit, each: float, decision: DecisionSettings) -> NDArray[np.bool_]:
    """(K,) whether a reflector's constant amplitude is too small, of those that are measured well enough.

    Args:
        best: the layout's fit with constant amplitudes.
        each: energy of one reflector over the noise, nats.
        decision: see `absent_share`.
    """
    constant = np.abs(best.amplitudes)
    measured = (best.visibility >= decision.absent_visibility) & (
        2 * each * best.visibility >= decision.absent_nats
    )
    return np.asarray(measured & (constant < decision.absent_share * median(constant)))


def _evidence(case: _Case, settings: ReaderSettings) -> tuple[Evidence, NDArray[np.float64]]:
    """The evidence, and the positions (K, 2) of the layout's reflectors when fitted freely, m."""
    best, runner_up, level = case.best, case.runner_up, case.level
    matched, decision = case.disc.field, settings.decision
    size = best.layout.size
    beyond = case.magnitudes[size:]
    noise = matched.noise_variance if matched.noise_variance > 0 else level
    other = rivals(case.disc, best, noise, settings.search)
    own = other.sizes
    each = max(best.explained / level / size, 1.0)
    missing = own < decision.missing_below(each) * own.max()
    # Near the axis amplitudes that vary with the view describe other echoes, too.
    absent = _absent(best, each, decision)
    lead = best.charged - (runner_up.charged if runner_up else 0.0)
    fewer = (best.layout.size - runner_up.layout.size) if runner_up else size
    evidence = Evidence(
        size=size,
        nats=best.explained / level,
        places=case.places,
        share=float(min(best.charged / _signal_energy(matched, best, level), 1.0)),
        weakest=float(own.min() / max(float(own.max()), 1e-30)),
        missing=int(np.count_nonzero(missing | absent)),
        extra=int(np.count_nonzero(beyond > decision.extra_share * median(own))),
        gain_nats=other.gain_nats,
        further_nats=other.further_nats,
        odds_nats=other.odds_nats,
        outward=other.outward,
        noise_nats=best.explained / noise,
        displacement_m=other.displacement_m,
        displacement_sigma_m=float(1 / (2 * matched.wavenumber * np.sqrt(2 * each))),
        margin_share=lead / max(best.charged, 1e-30),
        margin_nats=lead / level - fewer * np.log(matched.independent_samples),
        views=matched.views,
        uneven_nats=other.uneven_nats,
        absent=int(np.count_nonzero(absent)),
    )
    return evidence, other.positions
