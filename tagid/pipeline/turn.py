"""Selects by imaging the multiple of the shortest repetition that is a full turn, and checks a stated speed.

An object with n-fold symmetry repeats n times per turn, which autocorrelation cannot distinguish from a
faster table. Only at the true speed do a few fixed points explain the motion of the echoes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tagid.angles.period import NOMINAL_TOLERANCE
from tagid.capture import Capture
from tagid.errors import DataError
from tagid.geometry import ImageGrid
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.sparse import omp
from tagid.motion.urls import open_motion
from tagid.pipeline.axis_search import bright_offsets
from tagid.pipeline.resolve import has_angles, one_turn, with_angles
from tagid.pipeline.standstill import held, stopped_error

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
_EXPLAINED = 0.05
"""A stated speed that leaves less than this unexplained needs no check: on the four layouts and three points
at 15 dB, wrong speeds leave 0.14 to 0.8, the true one 0.02 to 0.1."""


def resolve_turn(capture: Capture, motion: str | None = None) -> Capture:
    """The capture with angles; a period estimated from the data is checked for being a fraction of a turn.

    Where the scans show that the object stopped, its angle is held.

    Args:
        capture: any capture; existing angles and positions are kept unless a motion is given.
        motion: device URL; None estimates the period from the data.

    Raises:
        DataError: no times, or no period; TurnStoppedError where the object stopped before one was seen.
        UsageError: a bad URL.
    """
    if motion is None and has_angles(capture):
        return capture
    try:
        first = with_angles(capture, motion)
    except DataError as error:
        raise stopped_error(capture) or error from error
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
    left: dict[int, float] = {}
    for multiple in MULTIPLES:
        if turns / multiple < _SHORTEST_TURN:
            break
        speed = f"free?rpm={60 / (multiple * shortest)}&direction={direction}"
        candidates[multiple] = first if multiple == 1 else with_angles(capture, speed)
        try:
            left[multiple] = unexplained_share(candidates[multiple])
        except DataError:
            # The object is outside the window or nothing rotates: imaging reports that more clearly.
            return first
    best = min(left, key=lambda multiple: left[multiple])
    if left[best] >= _BETTER * left[1]:
        best = 1
    found = candidates[best]
    info = replace(
        found.motion.resolved or resolved,
        nominal_rpm=None,
        shortest_repetition_s=shortest,
        repetitions_a_turn=best,
        unexplained={str(multiple): share for multiple, share in left.items()},
    )
    return replace(found, motion=replace(found.motion, url=url, resolved=info))


def _with_checked_speed(capture: Capture, told: Capture, nominal_s: float) -> Capture:
    """The capture with its stated speed, and the speed measured in its scans if the two differ.

    A stated speed is contradicted if the scans repeat with a different period, and six fixed points explain
    them clearly better (`_BETTER`) at a multiple of that period than at the stated one, which no other axis
    distance makes good.
    """
    resolved = told.motion.resolved
    if resolved is None or resolved.kind != "free" or resolved.period_s is None:
        return told
    try:
        stated = unexplained_share(told)
        if stated < _EXPLAINED:
            return told
        direction = "cw" if resolved.direction == -1 else "ccw"
        alone = with_angles(capture, f"free?direction={direction}").motion.resolved
        if alone is None or alone.period_s is None or alone.turns is None:
            return told
        best, left = 0.0, _BETTER * stated
        for multiple in MULTIPLES:
            period = multiple * alone.period_s
            if alone.turns / multiple < _SHORTEST_TURN:
                break
            if abs(period - nominal_s) <= NOMINAL_TOLERANCE * nominal_s:
                continue
            other = with_angles(capture, f"free?rpm={60 / period}&direction={direction}")
            share = unexplained_share(other)
            if share < left:
                best, left = period, share
    except DataError:
        # No repetition, or nothing to image: the stated speed cannot be checked.
        return told
    if not best or _explained_elsewhere(told, left / _BETTER):
        return told
    return replace(told, motion=replace(told.motion, resolved=replace(resolved, measured_rpm=60 / best)))


def _explained_elsewhere(told: Capture, share: float) -> bool:
    """Whether the stated speed leaves less than a share unexplained at another axis distance.

    At a wrong distance, fixed points explain no speed, and a slower one least badly, because its shorter arc
    of views is easier to explain.
    """
    turn = one_turn(told, _VIEWS)
    distance = turn.axis_distance_m or 0.0
    return any(
        unexplained_share(replace(turn, axis_distance_m=distance + offset)) < share
        for offset in bright_offsets(turn)
    )


def unexplained_share(capture: Capture) -> float:
    """Fraction of the energy above noise that six fixed points do not explain (matching pursuit).

    Raises DataError if the capture cannot be imaged.
    """
    settings = PreprocessSettings(extent_m=_GRID.extent, matched_filter=False)
    scans = preprocess(one_turn(capture, _VIEWS), settings=settings)
    operator = ForwardOperator(scans, _GRID)
    image = omp(scans, _GRID, _POINTS, operator=operator)
    residual = scans.samples - operator.forward(image.values.ravel()).reshape(scans.samples.shape)
    energy = float((np.abs(scans.samples) ** 2).sum())
    noise = scans.noise_std**2 * scans.samples.size / energy
    return max(float((np.abs(residual) ** 2).sum()) / energy - noise, 1e-3)
