"""Steps shared by `scan`, `identify` and `reconstruct`: load, prepare, draw, and report an answer.

Separate from the commands, so that all of them report a capture alike.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tagid.cli.common.frame import Terminal
from tagid.config import Config, data_folder
from tagid.counting import counted
from tagid.errors import EXIT_BATCH, EXIT_FAILED, EXIT_OK, EXIT_UNCERTAIN, TagidError, UsageError

if TYPE_CHECKING:
    from rich.console import RenderableType

    from tagid.imaging.autofocus import AxisFocus
    from tagid.imaging.pulsefit import PulseEstimate
    from tagid.imaging.region import Region
    from tagid.pipeline.answer import Identification
    from tagid.pipeline.prepared import PreparedCapture
    from tagid.pipeline.reconstruct import Reconstruction
    from tagid.pipeline.settings import ImagingSettings
    from tagid.tags.bodies.calibration import Bound
    from tagid.tags.enrolling.registry import Registry
    from tagid.tags.matching.reading import Reading


def open_registry() -> Registry:
    """The user's registry of layouts."""
    from tagid.tags.enrolling.registry import Registry

    return Registry(data_folder() / "registry.sqlite")


def remember(command: str, items: list[dict[str, Any]], settings: dict[str, Any]) -> tuple[str, ...]:
    """Store answers in the history; a remark if it cannot be written, which must not suppress them."""
    from tagid.storage.history import FILE_NAME, History

    try:
        history = History(data_folder() / FILE_NAME)
        history.add(history.begin(command, settings), items)
    except TagidError as error:
        return (f"not stored in the history: {error.message}. {error.remedy}",)
    return ()


def settings_from(config: Config, background: str = "mean", focus: bool = True) -> ImagingSettings:
    """Imaging settings of the configuration and the command line."""
    from tagid.imaging.ats.options import parse_settings
    from tagid.imaging.ats.settings import AtsSettings
    from tagid.pipeline.settings import ImagingSettings, TagPriors

    if background not in ("mean", "median", "reference", "none"):
        raise UsageError(f"--background is {background!r}", "Use mean, median, reference or none.")
    if background == "reference":
        background = "none"  # subtracted while loading, by `load_capture`
    return ImagingSettings(
        method=config["imaging.method"],
        extent_m=config["imaging.extent_m"],
        pixels=config["imaging.pixels"],
        background=background,  # type: ignore[arg-type]
        focus_m=None if focus else 0.0,
        false_accept=config["tags.false_accept"],
        direction_known=config["tags.direction"] == "known",
        priors=TagPriors(
            centre_sigma_m=config["tags.centre_sigma_m"],
            radius_sigma_m=config["tags.radius_sigma_m"],
            radius_inside_m=config["tags.radius_inside_m"],
            radius_outside_m=config["tags.radius_outside_m"],
            offset_range_m=config["tags.offset_range_m"],
        ),
        pulse=config["imaging.pulse"],
        ats=AtsSettings(**parse_settings([config["imaging.ats"]])),
    )


def parse_place(text: str | None, option: str = "--centre") -> tuple[float, float] | None:
    """X,Y in metres of --centre or --side."""
    if text is None:
        return None
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"{option} is {text!r}", f"Give X,Y in metres, such as {option} 0.5,2.") from None
    return x, y


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
        lines.append(
            f"the data do not determine the path delay: {focus.reason}; the ranges are used as given"
        )
        if focus.best_m is not None:
            lines.append(
                f"best estimate of the path delay {focus.best_m * 1e3:+.1f} mm, "
                f"evidence {focus.evidence:.1f} of {focus.needed:.1f} needed"
            )
    if region.mirrored:
        lines.append(
            "the path is straight: echoes from each side also appear on the other (--side X,Y selects one)"
        )
    return lines


def focus_words(focus: AxisFocus | None) -> list[str]:
    """The result of the axis-distance search, with its evidence if it was not used."""
    if focus is None or focus.axis_distance_m is None:
        return []
    from tagid.imaging.autofocus import BEYOND_SEARCH

    if focus.reliable:
        return [
            f"axis distance {focus.axis_distance_m:.4f} m, {focus.offset_m * 1e3:+.1f} mm from the given "
            f"(standard error {focus.sigma_m * 1e3:.2g} mm, "
            f"evidence {focus.evidence:.1f} of {focus.needed:.1f} needed)"
        ]
    lines = [f"the data do not determine the axis distance: {focus.reason}; the given value is used"]
    if focus.best_m is not None:
        lines.append(
            f"best estimate of the axis distance {focus.best_m:.4f} m, evidence {focus.evidence:.1f} of "
            f"{focus.needed:.1f} needed"
        )
    if focus.reason == BEYOND_SEARCH:
        lines.append("--axis-search METRES searches farther")
    return lines


def held_out_words(settings: dict[str, Any]) -> list[str]:
    """How well the image predicts held-out views: the main quality figure of every image."""
    found = settings.get("held_out")
    if not found:
        return []
    noise = "" if found["noise"] is None else f", including noise {100 * found['noise']:.1f} %"
    same = found["residual"] == found["backprojection"]
    other = "" if same else f"; backprojection {100 * found['backprojection']:.1f} %"
    lines = [
        f"held-out residual {100 * found['residual']:.1f} % of {found['views']} held-out views{noise}{other}"
    ]
    if found["worse_than_backprojection"]:
        lines.append(
            "backprojection predicts held-out views better: --method bp is more reliable than this image"
        )
    return lines


def prior_words(settings: dict[str, Any]) -> list[str]:
    """The prior that ats took instead of its defaults, if it tried any, and what it left out."""
    words = _prior_words(settings)
    skipped = settings.get("priors_not_tried")
    if words and skipped:
        words[0] += f"; not tried because the image is large: {'; '.join(skipped)}"
    return words


def _prior_words(settings: dict[str, Any]) -> list[str]:
    from tagid.imaging.ats.adapt import PIXELS, linear_iterations

    prior, tried = settings.get("prior"), settings.get("prior_trials")
    if not prior or not tried:
        return []
    residual = f"leaves {100 * tried[prior]:.1f} % of views that its fit did not see"
    than = f"the default prior {100 * tried['default']:.1f} %"
    both = settings.get("prior_against_default")
    if both and both["residual"] != tried[prior]:
        than = f"of the first {both['views']} of them {100 * both['residual']:.1f} %, {than}"
    iterations = linear_iterations(prior)
    if iterations is not None and iterations <= 1:
        return [
            f"no scene model predicts better than backprojection: the image is backprojection ({residual})"
        ]
    if iterations is not None:
        return [f"linear solution after {iterations} iterations: {residual}, {than}"]
    if prior == PIXELS:
        return [f"sparse solution without a field: {residual}, {than}"]
    if prior == "default":
        others = [tried[name] for name in tried if name != prior]
        more = sum(left > tried[prior] for left in others)
        return [f"default prior kept: {residual}, less than {more} of {len(others)} others"]
    return [f"prior {prior}: {residual}, {than}"]


def outside_words(settings: dict[str, Any]) -> list[str]:
    """Whether echoes from outside the image were found."""
    found = settings.get("outside")
    if not found:
        return []
    subtracted = " and was subtracted" if found["subtracted"] else ""
    return [
        f"{100 * found['share']:.0f} % of the scans' energy comes from outside the image{subtracted}; "
        "use a larger --extent to show it"
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


def calibration_words(settings: dict[str, Any]) -> list[str]:
    """Parameters that ats estimated besides the scene, one line each, with standard errors."""
    found: dict[str, Any] = settings.get("calibration") or {}
    lines: list[str] = []
    if "axis" in found:
        axis = found["axis"]
        lines.append(
            f"axis distance {axis['distance_m']:.4f} ± {axis['sigma_m']:.4f} m, "
            f"{axis['offset_m'] * 1e3:+.1f} mm from the given or focused value"
        )
    for w in found.get("wobble", ()):
        lines.append(
            f"wobble, harmonic {w['harmonic']}: {w['amplitude_deg']:.2f} ± {w['sigma_deg']:.2f} deg "
            f"at {w['phase_deg']:+.0f} deg, {w['speed_percent']:.1f} % of the speed"
        )
    if "gain" in found:
        gain = found["gain"]
        error = sum(gain["sigma"]) / len(gain["sigma"])
        low, high = min(gain["scans"]), max(gain["scans"])
        lines.append(f"gain of the scans {low:.3f} to {high:.3f}, each ± {error:.3f}")
    if "static" in found:
        lines.append(f"static component of {found['static']['rms']:.3g} rms subtracted")
    return lines


def learned(result: Reconstruction) -> dict[str, Any]:
    """Findings about the recording, for the JSON document."""
    settings = result.image.settings
    names = (
        "axis_distance_m", "focus", "held_out", "prior", "prior_trials", "priors_not_tried", "pulse",
        "calibration", "warnings",
    )  # fmt: skip
    return {name: settings[name] for name in names if name in settings}


def learned_words(result: Reconstruction) -> list[str]:
    """The same as text, one line each."""
    return [
        *held_out_words(result.image.settings),
        *prior_words(result.image.settings),
        *outside_words(result.image.settings),
        *result.image.settings.get("warnings", ()),
        *focus_words(result.focus),
        *region_words(result.region),
        *pulse_words(result.pulse),
        *calibration_words(result.image.settings),
    ]


def image_with_progress(terminal: Terminal, prepared: PreparedCapture) -> Reconstruction:
    """Reconstruct a prepared capture under a progress line."""
    from tagid.pipeline.reconstruct import reconstruct

    with terminal.progress("image", total=1.0) as advance:
        return reconstruct(
            prepared, progress=lambda done, total, remark: advance(done / max(total, 1), remark)
        )


def draw(result: Reconstruction, answer: Identification | None, png: Path) -> None:
    """Write the picture of an image, with the detected reflectors."""
    from tagid.report.picture import Marker, draw_image

    markers = []
    reading = answer.reading if answer else None
    if reading:
        offset = 1
        for reflector in reading.reflectors:
            markers.append(Marker(reflector.x_m, reflector.y_m, str(offset), reflector.matched))
            offset += 1
    name = method_shown(result)
    title = name if answer is None else f"{headline(answer)}  ({name})"
    image = result.image
    draw_image(image.values, image.grid.extent, png, title=title, reflectors=markers, centre_m=image.centre_m)


def method_shown(result: Reconstruction) -> str:
    """The method as a picture's title names it: ATS may show the paper's, or no field."""
    from tagid.imaging.ats.adapt import PIXELS, linear_iterations

    if result.image.settings.get("preset") == "paper":
        return "ATS, paper"
    prior = result.image.settings.get("prior", "")
    if prior == PIXELS:
        return "ATS, sparse solution"
    iterations = linear_iterations(prior)
    if iterations is None:
        return result.method.upper()
    return "ATS, backprojection" if iterations <= 1 else "ATS, linear solution"


def in_terminal(result: Reconstruction) -> RenderableType:
    """The image as text, in colour if the terminal supports it and NO_COLOR is not set."""
    from rich.console import Console

    from tagid.report.preview import colour_wanted, preview

    image = result.image
    colour = colour_wanted(Console())
    return preview(image.values, image.grid.extent, colour=colour, centre_m=image.centre_m)


SUBTRACTED = {
    True: "the echo of the body is subtracted from the image",
    False: "no body was found: nothing is subtracted from the image",
}
HYPOTHESES = {
    "no_tag": "a round body without a tag",
    "bare": "a tag without a body",
    "round": "a tag on a round body",
    "shell": "a tag on a helmet shell",
    "box": "a tag in or on a thin box",
    "body": "a tag on an enrolled body",
    "object": "an enrolled object",
}
"""Kinds of hypotheses in words."""


def headline(answer: Identification) -> str:
    """The answer in a few words, for a title or a first line."""
    reading = answer.reading
    if answer.status == "identified" and reading:
        return f"{reading.layout}, score {reading.score:.2f}"
    words = {"unknown": "unknown tag", "ambiguous": "ambiguous", "no_tag": "no tag", "failed": "failed"}
    return words[answer.status]


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
    """The hypothesis that won, its body's centre and the share of the moving echo that it leaves unexplained.

    Empty where the scans hold no echo that any hypothesis could explain.
    """
    from tagid.tags.bodies.hypothesis import Kind

    kind, won = reading.kind, reading.explained_by
    if kind is Kind.BARE and reading.status == "no_tag":
        return ""
    words = HYPOTHESES[kind]
    if won is None:
        return words
    if kind is Kind.NO_TAG and won.name:
        words = "an enrolled body without a tag"
    if won.name and kind is not Kind.OBJECT:
        words = words.replace("an enrolled body", f"the body {won.name}")
    x, y = (round(value * 1e3) for value in won.pose.centre_m)
    # A layout without a body has a centre of its own, which a name states with its rotation.
    where = "" if kind is Kind.BARE else f", centre ({x}, {y}) mm"
    percent = 100 * won.left
    return f"{words}{where}, {percent:.{0 if percent >= 9.95 else 1}f} % unexplained"


def nearest_words(answer: Identification) -> str:
    """The nearest layout, and the share of the echo that it explains, if compared."""
    nearest = answer.to_dict()["nearest"]
    share = "" if nearest["share"] is None else f", which explains {nearest['share']:.0%} of the echo"
    return f"{nearest['layout']}{share}"


def describe(answer: Identification, name: str) -> RenderableType:
    """The answer as text: one bold line, then the details."""
    from rich.console import Group
    from rich.text import Text

    colours = {"identified": "bold green", "failed": "bold red"}
    style = colours.get(answer.status, "bold yellow")
    first = Text.assemble((headline(answer).upper(), style), f"   {answer.label}   {name}")
    lines = [first]
    reading = answer.reading
    if answer.error:
        lines.append(Text(f"  {answer.error['message']} {answer.error['remedy']}"))
    if reading:
        if reading.reason:
            lines.append(Text(f"  why: {reading.reason}"))
            if answer.status == "unknown":
                lines.append(Text(f"  nearest layout: {nearest_words(answer)}"))
            for cause in answer.causes:
                lines.append(Text(f"  likely cause: {cause.text}", "bold"))
                lines.append(Text(f"  what to do: {cause.remedy}"))
            if all(cause.code != reading.code.value for cause in answer.causes):
                lines.append(Text(f"  {'otherwise' if answer.causes else 'what to do'}: {reading.advice}"))
        if words := hypothesis_words(reading):
            lines.append(Text(f"  read as: {words}"))
        if reading.note:
            lines.append(Text(f"  note: {reading.note}"))
        if reading.bound is not None:
            lines.append(Text(f"  {bound_words(reading.bound)}"))
        elif reading.status == "identified":
            lines.append(Text("  no bound on false accept: answers of this kind are not calibrated"))
        if reading.layout:
            x, y = (value * 1e3 for value in reading.centre_m)
            lines.append(
                Text(
                    f"  rotated {degrees(reading.rotation_deg)} deg, centre ({x:.1f}, {y:.1f}) mm, "
                    f"margin {reading.margin:.2f}, {counted(len(reading.reflectors), 'reflector')}"
                )
            )
    return Group(*lines)


def degrees(value: float) -> str:
    """An angle from 0 up to, but not including, 360 degrees, to a tenth.

    >>> degrees(359.98), degrees(-0.01), degrees(120.04)
    ('0.0', '0.0', '120.0')
    """
    return f"{round(value, 1) % 360:.1f}"


def failed(capture_uuid: str | None, error: TagidError) -> Identification:
    """The Identification of an item that could not be read."""
    from tagid.pipeline.answer import Identification

    entry = {"code": error.code, "message": error.message, "remedy": error.remedy}
    return Identification("failed", None, capture_uuid, None, error=entry)


def exit_code_of(answers: list[Identification]) -> int:
    """0 all identified, 3 some unknown/ambiguous/no tag, 1 the only item failed, 5 some items failed."""
    if any(answer.status == "failed" for answer in answers):
        return EXIT_FAILED if len(answers) == 1 else EXIT_BATCH
    return EXIT_OK if all(answer.status == "identified" for answer in answers) else EXIT_UNCERTAIN
