"""Every sentence about a result: image, axis, pulse, turn, ending and bound. No other module words them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from tagid.counting import counted
from tagid.imaging.facts import ImageFacts, facts_of, is_coupled
from tagid.metadata import Ending, RadarInfo, ResolvedMotion
from tagid.operate.truth import Comparison
from tagid.pipeline.identify import WHOLE_TURN
from tagid.pipeline.resolve import one_of

if TYPE_CHECKING:
    from tagid.imaging.autofocus import AxisFocus
    from tagid.imaging.pulsefit import PulseEstimate
    from tagid.imaging.region import Region
    from tagid.pipeline.answer import Identification
    from tagid.pipeline.reconstruct import Reconstruction
    from tagid.reading.calibration import Bound
    from tagid.reading.reading import Reading

_NOT_PREDICTED = 0.9
"""Residual from which on held-out views count as not predicted."""

_CLEARLY = 2.0
"""Standard errors from which on an axis distance is farther than the given one."""
_HIGHER = (
    "an antenna that stands higher above the object's plane than given looks the same, but for the size of "
    "the picture: check `motion.antenna_height_m`"
)

SUBTRACTED = {
    True: "the echo of the body is subtracted from the image",
    False: "no body was found: nothing is subtracted from the image",
}


def headline(answer: Identification) -> str:
    """The answer in a few words, for a title or a first line."""
    reading = answer.reading
    name = name_of(answer)
    return f"{name}, score {reading.score:.2f}" if answer.status == "identified" and reading else name


def name_of(answer: Identification) -> str:
    """The name, or that there is none, in one or two words."""
    reading = answer.reading
    if answer.status == "identified" and reading:
        return str(reading.layout)
    words = {"unknown": "unknown tag", "ambiguous": "ambiguous", "no_tag": "no tag", "failed": "failed"}
    return words[answer.status]


def trust_words(answer: Identification) -> str:
    """How far a name can be trusted, in one line."""
    bound = answer.reading.bound if answer.reading else None
    if bound is None or bound.objects == 0:
        seen = coverage_words(answer.coverage)
        return f"no bound on wrong names: {seen or 'answers of this kind are not calibrated'}"
    one_in = 1 / max(bound.p_value, 1e-12)
    scale = 10.0 ** max(math.floor(math.log10(one_in)) - 1, 0)
    words = (
        f"at most 1 in {math.floor(one_in / scale) * scale:,.0f} such objects is named wrongly (simulated)"
    )
    return words if bound.kept else f"{words}; set is 1 in {1 / bound.false_accept:,.0f}"


def coverage_words(coverage: float | None) -> str:
    """The part of a turn that the views cover; "" for a whole turn."""
    if coverage is None or coverage >= WHOLE_TURN:
        return ""
    return f"the views cover {360 * coverage:.0f} of 360 degrees"


def truth_words(truth: Comparison | None) -> str:
    """The comparison of an answer with the truth, in one line; "" if there is none.

    >>> truth_words(Comparison("helmet-120", True, 0.42, 1.23e-3))
    'helmet-120: named rightly, rotation +0.4 deg, centre 1.2 mm off'
    """
    if truth is None:
        return ""
    verdict = "named wrongly" if truth.instead is not None else "not named"
    if truth.right:
        verdict = "nothing named" if truth.layout is None else "named rightly"
    words = f"{truth.layout or 'no tag'}: {verdict}"
    if truth.rotation_error_deg is not None:
        words += f", rotation {round(truth.rotation_error_deg, 1) + 0.0:+.1f} deg"
    if truth.centre_error_m is not None:
        words += f", centre {truth.centre_error_m * 1e3:.1f} mm off"
    return words


def bound_words(bound: Bound) -> str:
    """The basis of the false-accept bound, in one line; why there is none where nothing was calibrated."""
    if bound.objects == 0:
        return f"no bound on false accept: no calibration objects of {bound.stratum}"
    words = f"false accept at most {bound.p_value:.2g}"
    if not bound.reachable:
        words += f" (too few objects for {bound.false_accept:g})"
    elif not bound.kept:
        words += f" ({bound.false_accept:g} is set)"
    return f"{words}, from {bound.objects} calibration objects ({bound.stratum}): {bound.population}"


def hypothesis_words(reading: Reading) -> str:
    """The hypothesis that won, its centre and the share of the moving echo that it does not explain.

    Empty if the scans hold no echo that any hypothesis could explain.
    """
    won = reading.explained_by
    if won is None or reading.code == "no_echo":
        return ""
    x, y = (round(value * 1e3) for value in won.centre_m)
    return f"{won.words}, centre ({x}, {y}) mm, {won.residual_words}"


def nearest_words(answer: Identification) -> str:
    """The nearest layout, and the share of the echo that it explains, if they were compared."""
    nearest = answer.to_dict()["nearest"]
    share = "" if nearest["share"] is None else f", which explains {nearest['share']:.0%} of the echo"
    return f"{nearest['layout']}{share}"


def degrees(value: float) -> str:
    """An angle from 0 up to, but not including, 360 degrees, to a tenth.

    >>> degrees(359.98), degrees(-0.01), degrees(120.04)
    ('0.0', '0.0', '120.0')
    """
    return f"{round(value, 1) % 360:.1f}"


def turn_line(resolved: ResolvedMotion | None) -> str:
    """How the angles were determined, in one line; "" if unknown.

    >>> turn_line(ResolvedMotion(turns=1.312, period_s=8.63, quality=0.97, kind="free"))
    '1.31 turns of 8.63 s (free), period quality 0.97'
    """
    if resolved is None or not resolved.turns or not resolved.period_s:
        return ""
    line = f"{resolved.turns:.2f} turns of {resolved.period_s:.2f} s ({resolved.kind or 'free'})"
    if resolved.shown_rpms and resolved.nominal_rpm:
        # Its quality would praise a wrong speed: a symmetric tag repeats at several.
        shown = one_of([f"{60 / rpm:.2f}" for rpm in resolved.shown_rpms])
        return f"{line} as stated; the scans show {shown} s"
    if resolved.quality is not None:
        line += f", period quality {resolved.quality:.2f}"
    if resolved.source == "measured":
        line += f", clocks aligned to {resolved.clock_sigma_ms or 0.0:.1f} ms"
        if not resolved.checked_by_radar:
            line += ", not checked by the radar"
    if resolved.kind == "roomba" and not resolved.calibrated:
        line += "; `tagid motion calibrate` stores the wheel base"
    return line


def notes(radar: RadarInfo) -> list[str]:
    """Notes on a recording for the user, one sentence each."""
    lines = []
    if lost := radar.scans_lost:
        lines.append(f"{counted(lost, 'scan')} lost between radar and computer")
    malformed = int((radar.statistics or {}).get("malformed", 0))
    if malformed:
        lines.append(f"{counted(malformed, 'packet')} were damaged or not P440 messages")
    if radar.scans_dropped:
        from tagid.storage.journal_queue import drop_note

        lines.append(drop_note(radar.scans_dropped))
    if radar.gap_count:
        seconds = sum(gap.seconds for gap in radar.gaps)
        times = "once" if radar.gap_count == 1 else f"{radar.gap_count} times"
        why = radar.gaps[0].reason if radar.gaps else ""
        lines.append(
            f"the radar was lost {times}, for {seconds:.1f} s in total; recording then continued ({why})"
            # A loose cable is lost once or for good.
            + (": is another program using it?" if radar.gap_count > 1 else "")
        )
    return lines


def ending_words(ended: Ending | None) -> str:
    """Why a recording ended, in one line; "" if it is not known.

    >>> ending_words(Ending("sure", 0.45, "helmet-120", 5e-4, 1999))
    'after 45 % of the turn, because helmet-120 was certain (false accept at most 0.0005, from 1999 turns)'
    """
    if ended is None:
        return ""
    if ended.reason == "sure":
        bound = "" if ended.p_value is None else f" (false accept at most {ended.p_value:.2g}"
        turns = f", from {ended.turns} turns)" if bound and ended.turns else ")" if bound else ""
        share = "" if ended.share is None else f"after {100 * ended.share:.0f} % of the turn, "
        return f"{share}because {ended.layout} was certain{bound}{turns}"
    words = {
        "turn": "the turn was complete",
        "limit": "the limit of scans or time was reached",
    }
    return words.get(ended.reason, ended.reason)


def region_words(region: Region | None) -> list[str]:
    """Findings for free antenna positions, one line each."""
    if region is None:
        return []
    x, y = region.centre_m
    lines = [f"{region.grid.extent:g} m about ({x:g}, {y:g}) m, {region.grid.pixels} pixels per side"]
    focus = region.focus
    if focus is not None and focus.reliable:
        lines.append(
            f"path delay {focus.delay_m * 1e3:+.1f} mm one way, subtracted from the ranges "
            f"(standard error {focus.sigma_m * 1e3:.2g} mm)"
        )
    elif focus is not None:
        lines.append(f"the ranges are used as given: {focus.reason}")
    if region.mirrored:
        why = "the path is straight"
        if focus is not None and focus.alike:
            why = "the path is nearly straight, and its two sides explain the scans alike"
        lines.append(f"{why}: echoes from each side also appear on the other (`towards_m=X,Y` selects one)")
    return lines


def focus_words(focus: AxisFocus | None) -> list[str]:
    """The result of the axis-distance search."""
    if focus is None or focus.axis_distance_m is None:
        return []
    if focus.reliable:
        evidence = f"evidence {focus.evidence:.1f} of {focus.needed:.1f} needed"
        lines = [
            f"axis distance {focus.axis_distance_m:.4f} m, {focus.offset_m * 1e3:+.1f} mm from the given "
            f"(standard error {focus.sigma_m * 1e3:.2g} mm, {evidence})"
        ]
        if focus.offset_m > _CLEARLY * focus.sigma_m:
            lines.append(_HIGHER)
        return lines
    # One statement: an estimate that is rejected, and its evidence, stand in the document alone.
    return [f"the given axis distance is used: {focus.reason}"]


def held_out_words(settings: ImageFacts) -> list[str]:
    """How well the image predicts held-out views: the main quality figure of every image."""
    held_out = settings.get("held_out")
    if not held_out:
        return []
    noise = "" if held_out["noise"] is None else f", including noise {100 * held_out['noise']:.1f} %"
    same = held_out["residual"] == held_out["backprojection"]
    other = "" if same else f"; backprojection {100 * held_out['backprojection']:.1f} %"
    # Documents of earlier versions lack it.
    neighbours = held_out.get("neighbours")
    beside = "" if neighbours is None else f"; the two neighbouring scans {100 * neighbours:.1f} %"
    lines = [
        f"held-out residual {100 * held_out['residual']:.1f} % of {held_out['views']} held-out views"
        f"{noise}{other}{beside}"
    ]
    least = min(held_out["residual"], 1.0 if neighbours is None else neighbours)
    if least > _NOT_PREDICTED and (held_out["noise"] or 0.0) < least / 2:
        lines.append(
            "neither the image nor the neighbouring scans predict a held-out view: the views are far apart, "
            "and the residual does not tell whether the image is right"
        )
    elif held_out.get("worse_than_neighbours"):
        lines.append(
            "the image predicts held-out views no better than smoothness over angle does: the residual does "
            "not tell whether its geometry is right"
        )
    if held_out["worse_than_backprojection"]:
        lines.append(
            "backprojection predicts held-out views better: `imaging.method=bp` or `imaging.method=bp-raw`, "
            "whichever has that residual, is more reliable than this image"
        )
    return lines


COUPLED_PIXELS = "coupled pixels instead of the neural field, which leaves more than noise of held-out views"
"""Of an image under that prior (`tagid.imaging.coupled`)."""


def outside_words(settings: ImageFacts) -> list[str]:
    """The share of energy from outside the image, if it is large."""
    outside = settings.get("outside")
    if not outside:
        return []
    subtracted = " and was subtracted" if outside["subtracted"] else ""
    return [
        f"{100 * outside['share']:.0f} % of the scans' energy comes from outside the image{subtracted}; "
        "use a larger `imaging.extent_m` to show it"
    ]


def pulse_words(pulse: PulseEstimate | None) -> list[str]:
    """The result of the pulse estimate, if one was requested."""
    if pulse is None:
        return []
    if math.isnan(pulse.residual):
        return ["too few views to estimate the pulse; the assumed pulse is used"]
    unseen = f"leaves {100 * pulse.residual:.1f} % of held-out views unexplained"
    if pulse.taken:
        return [f"pulse estimated: {unseen}, the assumed one {100 * pulse.assumed_residual:.1f} %"]
    return [f"assumed pulse kept: an estimate {unseen}, it {100 * pulse.assumed_residual:.1f} %"]


def calibration_words(settings: ImageFacts) -> list[str]:
    """The parameters that ATS estimated besides the scene, one line each, with standard errors."""
    calibration = settings.get("calibration") or {}
    lines: list[str] = []
    if "axis" in calibration:
        axis = calibration["axis"]
        lines.append(
            f"axis distance {axis['distance_m']:.4f} ± {axis['sigma_m']:.4f} m, "
            f"{axis['offset_m'] * 1e3:+.1f} mm from the given or focused value"
        )
    for w in calibration.get("wobble", ()):
        lines.append(
            f"wobble, harmonic {w['harmonic']}: {w['amplitude_deg']:.2f} ± {w['sigma_deg']:.2f} deg "
            f"at {w['phase_deg']:+.0f} deg, {w['speed_percent']:.1f} % of the speed"
        )
    if "gain" in calibration:
        gain = calibration["gain"]
        error = sum(gain["sigma"]) / len(gain["sigma"])
        low, high = min(gain["scans"]), max(gain["scans"])
        lines.append(f"gain of the scans {low:.3f} to {high:.3f}, each ± {error:.3f}")
    if "static" in calibration:
        lines.append(f"static component of {calibration['static']['rms']:.3g} rms subtracted")
    return lines


def learned_words(result: Reconstruction) -> list[str]:
    """Everything that a reconstruction reports of its image, one line each."""
    facts, focus = facts_of(result.image.settings), result.focus
    warnings = facts.get("warnings", ())
    return [
        *held_out_words(facts),
        *([COUPLED_PIXELS] if is_coupled(facts) else []),
        *outside_words(facts),
        *warnings,
        *([] if focus is not None and focus.reason in warnings else focus_words(focus)),
        *region_words(result.region),
        *pulse_words(result.pulse),
        *calibration_words(facts),
    ]


def method_shown(result: Reconstruction) -> str:
    """The method for a picture's title; of ATS also the variant, or that the scene is extended."""
    settings = result.image.settings
    if settings.get("preset") == "paper":
        return "ATS, paper"
    return "ATS, coupled pixels" if is_coupled(facts_of(settings)) else result.method.upper()
