"""Diagnosis of objects that were not named: the likely cause in the recording, and its remedy.

The answer says which hypothesis won. This module searches for the cause: a wrong
speed, a turn that stopped, lost scans, a partial revolution, a wrong axis distance, an object off the axis. A
cause is stated only if the scans confirm it; it never changes the answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tagid.capture import Capture, ViewFlag
from tagid.errors import DataError
from tagid.imaging.preprocess import remove_background
from tagid.metadata import RadarInfo, ResolvedMotion
from tagid.pipeline.answer import Cause, Identification
from tagid.pipeline.axis_search import bright_offsets
from tagid.pipeline.identify import WHOLE_TURN, ended_early, identify, widest_gap
from tagid.pipeline.prepared import PreparedCapture
from tagid.pipeline.resolve import REMEDY, one_of, speed_contradiction, stopped_words
from tagid.reading.reading import Kind, Reading
from tagid.reading.verdict import ADVICE, Code
from tagid.signal import analytic, median, peak_place
from tagid.tags.layouts.layout import Layout

_FEWEST = 8
"""Views that a circle, three numbers, needs."""
_KEPT_DEVIATIONS = 3.0
_ROUNDS = 5


@dataclass(frozen=True)
class Circling:
    """The circle of the strongest echo.

    Attributes:
        centre_m: (x, y) in the turntable's frame, m.
        spread_m: RMS of the ranges about those of the circle, m, in the views that follow it.
        share: of the views that follow it.
        faintest: amplitude of the strongest echo in its faintest views (10 %) over its median.
    """

    centre_m: tuple[float, float]
    spread_m: float
    share: float
    faintest: float

    @property
    def radius_m(self) -> float:
        """Distance of the centre from the axis, m."""
        return float(np.hypot(*self.centre_m))


def circling(capture: Capture) -> Circling | None:
    """The circle that the range of each view's strongest moving echo describes; None for too few views, or
    without angles.

    The front of a round body of radius a about the point c is at |antenna - c| - a, to first order in c at
    D - a - c . u with the direction u of the antenna. Reflectors, handles and noise are the strongest in some
    views; these are left out in turns.
    """
    if capture.angles_rad is None or capture.views < _FEWEST:
        return None
    envelope = np.abs(analytic(remove_background(capture.samples, "mean")))
    ranges = capture.range_start_m + capture.range_step_m * np.array([peak_place(view) for view in envelope])
    angles = capture.angles_rad
    columns = np.stack([np.ones(len(angles)), -np.cos(angles), np.sin(angles)], axis=1)
    kept = np.ones(len(angles), dtype=bool)
    for _ in range(_ROUNDS):
        circle = np.linalg.lstsq(columns[kept], ranges[kept], rcond=None)[0]
        off = np.abs(ranges - columns @ circle)
        # A median absolute deviation is 0.67 standard deviations; a quarter of a bin is the least.
        usual = max(float(median(off)) / 0.67, capture.range_step_m / 4)
        again = off <= _KEPT_DEVIATIONS * usual
        if again.sum() < _FEWEST or np.array_equal(again, kept):
            break
        kept = again
    spread = float(np.sqrt(np.mean((ranges - columns @ circle)[kept] ** 2)))
    amplitudes = envelope.max(axis=1)
    faintest = float(np.quantile(amplitudes, 0.1) / max(float(median(amplitudes)), 1e-30))
    return Circling((float(circle[1]), float(circle[2])), spread, float(kept.mean()), faintest)


def named_in(prepared: PreparedCapture, capture: Capture, layouts: Sequence[Layout]) -> Reading | None:
    """The reading, with the settings of an answer, of the same scans elsewhere, if it names the object."""
    try:
        answer = identify(prepared.elsewhere(capture), layouts)
    except DataError:
        return None
    return answer.reading if answer.status == "identified" else None


_LOSS = int(ViewFlag.AFTER_LOSS | ViewFlag.AFTER_GAP)
_FARTHEST_M = 0.12
_AXIS_TRIES = 1
"""Axis distances that are read in full, the best first."""
_CIRCLE_M, _CIRCLE_SHARE = 0.025, 0.8
"""Largest spread of the strongest echo about its circle, m, and the least share of views that follow it."""
_ROUND_M, _ROUND_SHARE, _ROUND_FAINTEST = 0.010, 0.85, 0.65
"""The same, and the amplitude of its faintest views, of a round body alone: solved cans spread by 3 to 9 mm
and have 0.68 and more; handles, boxes and loud reflectors on a can spread more or have less."""
_CIRCLES_M = 0.006
"""Smallest circle: that of a can 15 mm off the axis seems 7 mm wide, because the mean is subtracted."""
_TOLD_M = 0.020
"""From here on the width of the circle is that of the body's place to within 5 mm."""
_CENTRE_IT = "Place the object's axis within 10 mm of the rotation axis."
_CENTRE_FIRST = {
    Code.NO_TAG: f"{_CENTRE_IT} {ADVICE[Code.NO_TAG]}",
    Code.OTHER: f"{_CENTRE_IT} If it is there: {ADVICE[Code.OTHER][0].lower()}{ADVICE[Code.OTHER][1:]}",
}
"""Advice in the place of the reader's, which lets the body be enrolled, where it may stand off the axis."""
_IN_RANGE = f"Check that the object lies in the recorded range and turns. {ADVICE[Code.NO_TAG]}"
_NO_DELAY = "Measure the path delay of radar and cables, which is 0 ps here, with `tagid commission`."
_NEW_TAG = "Enroll the tag if it is new. If it is enrolled, check that every reflector is on its mark."
_OFF_AXIS = "Move the object 5 mm and scan again: a reflector on the rotation axis looks like the room."
_ON_AXIS_M = 2e-3
"""A reflector nearer to the axis hardly shows."""
_EXPLAINED = 0.05
"""Share of the echo that reflectors alone may leave where there is no body to be enrolled."""
_AXIS_M = 0.01
"""An axis distance wrong by less is no cause: the reader looks for that itself."""
_BEYOND_M = 0.05
"""Half the range resolution: reflectors so far from where the axis distance puts them do not fit the picture.
Bare tags of the yardsticks are within 16 mm."""


def _uncovered(capture: Capture) -> Cause | None:
    """The cause of views that do not cover a turn: lost scans, or a recording of less than a turn.

    Scans were lost if the object was recorded over more of the turn than the views cover, or, where the
    recorded turns are unknown, if a view beside the gap is flagged and the recording does not begin there.
    """
    gap = None if ended_early(capture) else widest_gap(capture)
    if gap is None or gap.share >= WHOLE_TURN:
        return None
    covered = f"the views cover {gap.share * 360:.0f} of 360 degrees"
    turns = capture.motion.resolved.turns if capture.motion.resolved else None
    radar, flags = capture.radar, capture.flags
    if turns is None:
        beside = 0 if flags is None else int(np.bitwise_or.reduce(flags[list(gap.sides)]))
        inside = bool(beside & _LOSS) and not beside & ViewFlag.FIRST
    else:
        inside = gap.share < min(turns, 1.0) - (1 - WHOLE_TURN)
    lost = (radar.scans_lost or 0) + (radar.scans_dropped or 0)
    flagged = flags is not None and bool(np.any(flags & _LOSS))
    if not inside or not (lost or radar.gap_count or flagged):
        remedy = (
            "Record slightly more than one full turn; `tagid scan` does so if the speed is right and no "
            "limit of scans or seconds ends it before."
        )
        if capture.angles_rad is None:
            remedy = "Record from positions on all sides of the object."
        return Cause("partial_turn", covered, remedy)
    scans = "scans were" if not lost else "1 scan was" if lost == 1 else f"{lost} scans were"
    recorded = "" if turns is None else f", although {turns:.2f} turns were recorded"
    return Cause(
        "scans_lost",
        f"{scans} lost: {covered}{recorded}",
        "Check cable, switch and load of this computer with `tagid radar monitor`, which counts lost scans "
        "(docs/radar.md, Faults), then record again.",
    )


def recording_remarks(capture: Capture) -> tuple[str, ...]:
    """Problems of a recording, one sentence each: a wrong speed, lost scans, a partial revolution."""
    remarks = []
    if capture.motion.not_resolved and capture.motion.resolved is not None:
        remarks.append(f"{capture.motion.not_resolved}; their period is used instead")
    if contradiction := speed_contradiction(capture.motion.resolved):
        remarks.append(contradiction)
    if cause := _stopped(capture):
        remarks.append(f"{cause.text}; the scans meanwhile are not used")
    elif cause := _uncovered(capture):
        remarks.append(f"{cause.text}; reflectors that face away in all of them are not seen")
    return tuple(remarks)


def with_causes(
    answer: Identification, prepared: PreparedCapture, layouts: Sequence[Layout]
) -> Identification:
    """The answer, with likely causes if nothing is named, most certain first; else a remark on the axis."""
    if answer.status == "failed" or answer.reading is None:
        return answer
    if answer.status == "identified":
        return replace(answer, remarks=(*answer.remarks, *_of_the_range(answer, prepared.given)))
    if answer.reading.code is Code.UNCALIBRATED:
        # A layout explains the scans: nothing is wrong with them but that they are few.
        return replace(answer, causes=tuple(_of_the_turn(prepared.given)))
    round_echo = circling(prepared.given)
    beyond = _beyond_range(answer.reading, round_echo, prepared.given.radar)
    causes = _of_the_turn(prepared.given, beyond_range=beyond)
    circle = _off_the_axis(round_echo)
    if not any(cause.code == "speed" for cause in causes):
        beside = None if circle is None else _of_a_round_body(circle)
        causes += _of_the_axis(prepared, layouts) if beside is None else [beside]
    return replace(
        answer, causes=tuple(causes), advice=_advice(answer.reading, round_echo, prepared.given.radar)
    )


def _advice(reading: Reading, round_echo: Circling | None, radar: RadarInfo) -> str:
    """What to do in the place of the reader's advice; empty where that is right."""
    if _another_tag(reading):
        return _NEW_TAG
    if reading.code is Code.WEAK and any(
        np.hypot(reflector.x_m, reflector.y_m) < _ON_AXIS_M for reflector in reading.reflectors
    ):
        return _OFF_AXIS
    if _unseen(reading, round_echo):
        in_range = _IN_RANGE if reading.code is Code.NO_TAG else reading.advice
        return f"{_NO_DELAY} {in_range}" if _beyond_range(reading, round_echo, radar) else in_range
    return "" if _centred(round_echo) else _CENTRE_FIRST.get(reading.code, "")


def _unseen(reading: Reading, round_echo: Circling | None) -> bool:
    """Whether no echo turns that could be the object's."""
    return reading.code in (Code.NO_TAG, Code.NO_ECHO) and not _followed(round_echo)


def _beyond_range(reading: Reading, round_echo: Circling | None, radar: RadarInfo) -> bool:
    """Whether the ranges are wrong by an unknown path delay, so that nothing is seen.

    Every cable delays: no radar but a simulated one records at the stated ranges without a correction.
    """
    unknown = radar.kind != "simulated" and radar.cable_delay_ps == 0
    return unknown and _unseen(reading, round_echo)


def _another_tag(reading: Reading) -> bool:
    """Whether reflectors alone, in another arrangement than the enrolled ones, explain the echo."""
    if reading.code is not Code.OTHER or reading.kind is not Kind.BARE or not reading.hypotheses:
        return False
    return reading.hypotheses[0].unexplained < _EXPLAINED


def _of_the_turn(capture: Capture, *, beyond_range: bool = False) -> list[Cause]:
    resolved = capture.motion.resolved
    causes = []
    contradiction = speed_contradiction(resolved)
    # Scans that do not reach the object do not tell that its speed is wrong, unless they show another one.
    if contradiction and resolved is not None and (resolved.shown_rpms or not beyond_range):
        causes.append(_of_the_speed(resolved, contradiction))
    if cause := _stopped(capture) or _uncovered(capture):
        causes.append(cause)
    return causes


def _of_the_speed(resolved: ResolvedMotion, contradiction: str) -> Cause:
    """A stated speed that the scans contradict, with the ones that they show."""
    turned = "direction=cw" if resolved.direction == -1 else ""
    urls = ["free?" + "&".join(filter(None, (f"rpm={rpm:.3g}", turned))) for rpm in resolved.shown_rpms]
    estimated = "?".join(filter(None, ("free", turned)))
    speeds = one_of([f"`motion.url={url}`" for url in urls]) if urls else ""
    if len(urls) > 1:
        return Cause("speed", contradiction, f"Measure the time of a turn, and read it again with {speeds}.")
    estimate = f"`motion.url={estimated}`, which estimates the speed from the scans."
    if urls:
        return Cause(
            "speed",
            contradiction,
            f"Read it again with {speeds}, or with {estimate}",
            {"motion.url": urls[0]},
        )
    if resolved.shortest_repetition_s is not None:
        settings = {"motion.url": estimated}
        return Cause("speed", contradiction, f"Check the speed, or read it again with {estimate}", settings)
    # What was recorded may be less than a turn.
    return Cause("speed", contradiction, f"Check the speed and record again, or record with {estimate}")


def _stopped(capture: Capture) -> Cause | None:
    """The cause of a turn that stopped, as the scans have shown when its angles were found."""
    resolved = capture.motion.resolved
    if resolved is None or resolved.standstill is None:
        return None
    return Cause("turn_stopped", stopped_words(resolved.standstill), REMEDY)


def axis_read_m(answer: Identification, capture: Capture) -> float | None:
    """The axis distance that the reflectors of a name fit, m; None without a name, and on a body."""
    given, reading = capture.axis_distance_m, answer.reading
    if given is None or reading is None or answer.status != "identified" or reading.kind is not Kind.BARE:
        return None
    return given + reading.offset_m


def other_axis_m(answer: Identification, capture: Capture) -> float | None:
    """The same where it is not the given distance: from `_BEYOND_M` on."""
    fits = axis_read_m(answer, capture)
    return None if fits is None or abs(fits - (capture.axis_distance_m or 0.0)) < _BEYOND_M else fits


def _of_the_range(answer: Identification, capture: Capture) -> tuple[str, ...]:
    """That a tag was read elsewhere than where the axis distance puts it."""
    fits = other_axis_m(answer, capture)
    if fits is None:
        return ()
    instead = f"an axis distance of {fits:.2f} m, not {capture.axis_distance_m:.2f} m"
    return (f"the reflectors fit {instead}: measure it again, and the path delay",)


def _of_the_axis(prepared: PreparedCapture, layouts: Sequence[Layout]) -> list[Cause]:
    """A different axis distance, if the reader names the object with it."""
    capture = prepared.capture
    given = capture.axis_distance_m
    if given is None or capture.angles_rad is None:
        return []
    offsets = bright_offsets(capture, prepared.settings.background)
    for offset in offsets[:_AXIS_TRIES]:
        moved = replace(capture, axis_distance_m=given + offset)
        if (name := named_in(prepared, moved, layouts)) is not None:
            best = given + offset + name.offset_m
            if abs(best - given) < _AXIS_M:
                continue
            return [
                Cause(
                    "axis_distance",
                    f"with an axis distance of {best:.2f} m instead of {given:.2f} m the scans show "
                    f"{name.layout}",
                    "Measure the distance from the antennas to the rotation axis again; "
                    f"`motion.axis_distance_m={best:.2f}` applies it to this recording.",
                    {"motion.axis_distance_m": round(float(best), 2)},
                )
            ]
    return []


def _off_the_axis(circle: Circling | None) -> Circling | None:
    """The circle of the strongest echo, where something off the axis, not too far, makes one."""
    return circle if circle is not None and _CIRCLES_M < circle.radius_m < _FARTHEST_M else None


def _followed(circle: Circling | None) -> bool:
    """Whether the strongest echo of most views lies on the circle."""
    return circle is not None and circle.spread_m < _CIRCLE_M and circle.share > _CIRCLE_SHARE


def _centred(circle: Circling | None) -> bool:
    """Whether the scans exclude that the object stands off the axis."""
    return circle is not None and _followed(circle) and circle.radius_m <= _CIRCLES_M


def _of_a_round_body(circle: Circling) -> Cause | None:
    """The cause of an echo that nothing but a round body off the axis makes."""
    if circle.spread_m > _ROUND_M or circle.share < _ROUND_SHARE or circle.faintest < _ROUND_FAINTEST:
        return None
    off = f"about {circle.radius_m * 1e3:.0f} mm" if circle.radius_m >= _TOLD_M else "10 to 20 mm"
    words = f"the strongest echo circles the rotation axis, as that of a round body {off} off it"
    return Cause("off_centre", words, _CENTRE_IT)
