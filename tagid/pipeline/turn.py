"""Selects by imaging the multiple of the shortest repetition that is a full turn, and checks a stated speed.

An object with n-fold symmetry repeats n times per turn, which autocorrelation cannot distinguish from a
faster table. Only at the true speed do a few fixed points explain the motion of the echoes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tagid.angles.align import NotAlignedError
from tagid.angles.period import GOOD_QUALITY, NOMINAL_TOLERANCE
from tagid.angles.views import mean_scans
from tagid.capture import Capture
from tagid.errors import DataError
from tagid.geometry import ImageGrid
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import PreprocessSettings, outside_error, preprocess
from tagid.imaging.sparse import omp
from tagid.motion.urls import open_motion
from tagid.pipeline.axis_search import bright_offsets
from tagid.pipeline.resolve import clock_of, has_angles, held, one_turn, stopped_error, with_angles

MULTIPLES = (1, 2, 3, 4)
"""Symmetries that are tested: a tag of four reflectors can repeat four times per turn."""
_SHORTEST_TURN = 0.3
"""Fraction of a turn that must be recorded before a multiple can be tested."""
_POINTS = 6
_GRID = ImageGrid(0.3, 60)
"""Covers the layouts (radius up to 130 mm) with the Nyquist step of the point response, 5 mm < lambda / 8."""
_VIEWS = 90
_BETTER = 0.7
"""A multiple is accepted if its residual is below this fraction of the shortest repetition's: on
the four layouts at 10 and 20 dB the true multiple has 0.05 to 0.4."""
_BETTER_THAN_A_REPETITION = 0.35
"""The same where the scans repeat with the stated period, too: only the image speaks against it."""
_AS_LIKELY = 2.5
"""The shortest repetition is told apart from its multiples if each leaves this many times as much. A faster
turn explains a symmetric tag on a smaller ring with fewer points: the true multiple left up to 2.04 times as
much. Of tags that do not repeat, all others left 2.67 times and more."""
_STRETCH_VIEWS = 180
_EXPLAINED = 0.05
"""A stated speed that leaves less than this unexplained needs no check: on the four layouts and three points
at 15 dB, wrong speeds leave 0.14 to 0.8, the true one 0.02 to 0.1."""


def _outside(capture: Capture) -> DataError | None:
    """Why the scans cannot show how the object turned: they do not reach it."""
    axis = capture.axis_distance_m
    if axis is None or capture.range_start_m <= axis <= float(capture.ranges_m[-1]):
        return None
    return outside_error(capture, "rotation axis", axis)


def resolve_turn(capture: Capture, motion: str | None = None) -> Capture:
    """The capture with angles; a period estimated from the data is checked for being a fraction of a turn.

    Existing angles and positions are kept unless the URL of a motion is given. Where the scans show that the
    object stopped, its angle is held. Where measured angles cannot be assigned to the scans, the period in
    the scans takes their place.

    Raises DataError: no times, or no period; TurnStoppedError where the object stopped before one was seen.
    UsageError: a bad URL.
    """
    if motion is None and has_angles(capture):
        return capture
    try:
        first = with_angles(capture, motion)
    except NotAlignedError as error:
        return _by_the_scans(capture, motion, error)
    except DataError as error:
        raise _outside(capture) or stopped_error(capture) or error from error
    resolved = first.motion.resolved
    url = first.motion.url or "free"
    table = open_motion(url)
    if stopped := held(capture, first, table):
        return stopped
    if table.measures or capture.axis_distance_m is None:
        return first
    if table.nominal_s is not None:
        return _with_checked_speed(capture, first, table.nominal_s)
    if resolved is None or resolved.period_s is None or resolved.turns is None:
        return first
    # Scans of a standstill resemble each other at any period.
    if stopped_at := stopped_error(capture):
        raise stopped_at
    shortest, turns = resolved.period_s, resolved.turns
    direction = "cw" if table.direction < 0 else "ccw"
    candidates: dict[int, Capture] = {}
    residuals: dict[int, float] = {}
    for multiple in MULTIPLES:
        if turns / multiple < _SHORTEST_TURN:
            break
        speed = f"free?rpm={60 / (multiple * shortest)}&direction={direction}"
        candidates[multiple] = first if multiple == 1 else with_angles(capture, speed)
        try:
            residuals[multiple] = unexplained_share(candidates[multiple])
        except DataError:
            # The object is outside the window or nothing rotates: imaging reports that more clearly.
            return first
    best = min(residuals, key=lambda multiple: residuals[multiple])
    if residuals[best] >= _BETTER * residuals[1]:
        best = 1
    chosen = candidates[best]
    info = replace(
        chosen.motion.resolved or resolved,
        nominal_rpm=None,
        shortest_repetition_s=shortest,
        repetitions_a_turn=best,
        unexplained={str(multiple): share for multiple, share in residuals.items()},
    )
    return replace(chosen, motion=replace(chosen.motion, url=url, resolved=info))


def _by_the_scans(capture: Capture, motion: str | None, unaligned: NotAlignedError) -> Capture:
    """The capture with angles from the period in its scans; raises the error where they show no turn."""
    track = capture.motion.track
    reverse = track is not None and track.angles_rad[-1] < track.angles_rad[0]
    bare = replace(capture, motion=capture.motion.without_track())
    try:
        resolved = resolve_turn(bare, "free?direction=cw" if reverse else "free")
    except DataError:
        raise unaligned from None
    if resolved.motion.resolved is None or (resolved.motion.resolved.quality or 0.0) < GOOD_QUALITY:
        raise unaligned
    url = motion or capture.motion.url
    return replace(resolved, motion=replace(resolved.motion, url=url, not_resolved=unaligned.message))


def _with_checked_speed(capture: Capture, given: Capture, nominal_s: float) -> Capture:
    """The capture with its stated speed, and the speed measured in its scans if the two differ.

    A stated speed is contradicted if the scans repeat well with a different period, and six fixed points
    explain the same scans clearly better at a multiple of that period than at the stated one, which no other
    axis distance makes good. All speeds are compared on the same scans: a shorter arc is easier to explain.
    Where several multiples explain them, all are named.
    """
    resolved = given.motion.resolved
    if resolved is None or resolved.kind != "free" or resolved.period_s is None:
        return given
    try:
        if unexplained_share(given) < _EXPLAINED:
            return given
        direction = "cw" if resolved.direction == -1 else "ccw"
        alone = with_angles(capture, f"free?direction={direction}").motion.resolved
        if alone is None or alone.period_s is None or alone.turns is None:
            return given
        if (alone.quality or 0.0) < GOOD_QUALITY:
            return given
        if resolved.repeats is False:
            repeating = replace(resolved, shortest_repetition_s=alone.period_s)
            given = replace(given, motion=replace(given.motion, resolved=repeating))
        others = [
            multiple * alone.period_s
            for multiple in MULTIPLES
            if alone.turns / multiple >= _SHORTEST_TURN
            and abs(multiple * alone.period_s - nominal_s) > NOMINAL_TOLERANCE * nominal_s
        ]
        if not others:
            return given
        stretch = _Stretch.of(capture, max(nominal_s, *others), resolved.direction or 1)
        better = _BETTER if resolved.source == "nominal" else _BETTER_THAN_A_REPETITION
        most = better * stretch.unexplained(resolved.period_s)
        residuals = {period: stretch.unexplained(period) for period in others}
        best = min(residuals, key=residuals.__getitem__)
        if residuals[best] >= most or stretch.explained_elsewhere(
            resolved.period_s, residuals[best] / better
        ):
            return given
    except DataError:
        # No repetition, or nothing to image: the stated speed cannot be checked.
        return given
    margin = _AS_LIKELY if best == min(others) else 1 / _BETTER
    shown = sorted(
        (period for period in others if residuals[period] <= margin * residuals[best]),
        key=residuals.__getitem__,
    )
    speeds = tuple(float(60 / period) for period in shown)
    said = (
        replace(resolved, measured_rpm=speeds[0])
        if len(speeds) == 1
        else replace(resolved, likely_rpms=speeds)
    )
    return replace(given, motion=replace(given.motion, resolved=said))


@dataclass(frozen=True, eq=False)
class _Stretch:
    """Scans that are compared at several speeds.

    Attributes:
        capture: up to `_STRETCH_VIEWS` means of consecutive scans, without angles.
        times_s: (views,) their times, s.
        direction: +1 counter-clockwise from above, -1 clockwise.
    """

    capture: Capture
    times_s: NDArray[np.float64]
    direction: int

    @classmethod
    def of(cls, capture: Capture, seconds: float, direction: int) -> _Stretch:
        """The first seconds of a recording."""
        times = clock_of(capture).times_s
        since = np.asarray(times - times[0], dtype=np.float64)
        scans = max(2, int(np.searchsorted(since, seconds, "right")))
        views = min(_STRETCH_VIEWS, scans)
        slot = np.arange(scans) * views // scans
        count = np.bincount(slot, minlength=views)
        bare = replace(
            capture,
            samples=mean_scans(capture.samples[:scans], slot, count),
            angles_rad=None,
            angle_sigma_rad=None,
            antenna_positions_m=None,
            receive_positions_m=None,
            host_time_ns=None,
            radar_time_ms=None,
            scan_id=None,
            flags=None,
            motion=replace(capture.motion, averaged_into_views=views),
        )
        return cls(bare, np.bincount(slot, since[:scans]) / count, direction)

    def at(self, period_s: float) -> Capture:
        """The scans with their angles at a speed."""
        return replace(self.capture, angles_rad=self.direction * 2 * np.pi * self.times_s / period_s)

    def unexplained(self, period_s: float) -> float:
        """Share that six fixed points leave at a speed."""
        return _left_by_points(self.at(period_s))

    def explained_elsewhere(self, period_s: float, share: float) -> bool:
        """Whether a speed leaves less than a share at another axis distance.

        At a wrong distance fixed points explain no speed.
        """
        stated = self.at(period_s)
        distance = stated.axis_distance_m or 0.0
        return any(
            _left_by_points(replace(stated, axis_distance_m=distance + offset)) < share
            for offset in bright_offsets(stated)
        )


def unexplained_share(capture: Capture) -> float:
    """Fraction of the energy above noise that six fixed points do not explain (matching pursuit).

    Raises DataError if the capture cannot be imaged.
    """
    return _left_by_points(one_turn(capture, _VIEWS))


def _left_by_points(views: Capture) -> float:
    """The same of all views of a capture."""
    settings = PreprocessSettings(extent_m=_GRID.extent, matched_filter=False)
    scans = preprocess(views, settings=settings)
    operator = ForwardOperator(scans, _GRID)
    image = omp(scans, _GRID, _POINTS, operator=operator)
    residual = scans.samples - operator.forward(image.values.ravel()).reshape(scans.samples.shape)
    energy = float((np.abs(scans.samples) ** 2).sum())
    noise = scans.noise_std**2 * scans.samples.size / energy
    return max(float((np.abs(residual) ** 2).sum()) / energy - noise, 1e-3)
