"""`tagid enroll`: add an identity, or a body on which tags are mounted."""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from math import log10
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid.cli import enrolling, options
from tagid.cli.frame import Terminal, command
from tagid.cli.options import METRES
from tagid.config import load_config
from tagid.counting import counted
from tagid.errors import RegistryError, UsageError
from tagid.query import parse_point
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.config import Config
    from tagid.pipeline.enrollment import LayoutProposal, Measured
    from tagid.result import Drawn
    from tagid.tags.bodies.joint import Joint
    from tagid.tags.layouts.layout import Layout


@command("enroll")
def enroll(
    terminal: Terminal,
    name: Annotated[
        str | None, typer.Argument(help="Name of the new entry; a file contains its own.")
    ] = None,
    more: Annotated[
        list[Path] | None, typer.Argument(help="Captures of the real object, same as --capture.")
    ] = None,
    points: Annotated[
        list[str] | None,
        typer.Option(
            "--point", help="A reflector as X,Y in metres from the axis; repeat for each reflector."
        ),
    ] = None,
    file: Annotated[Path | None, typer.Option(help="One layout in TOML or JSON.")] = None,
    captures: Annotated[
        list[Path] | None,
        typer.Option(
            "--capture",
            help="A capture of the real object; give three or more, and turn and move the object between "
            "them.",
        ),
    ] = None,
    body: Annotated[
        bool, typer.Option("--body", help="The captures show an untagged body: tags on it can then be read.")
    ] = False,
    sigma: Annotated[
        float | None,
        typer.Option(parser=METRES, help="Standard deviation of the --point coordinates, metres."),
    ] = None,
    kind: Annotated[str | None, typer.Option(help="helmet, container or other.")] = None,
    label: Annotated[str | None, typer.Option(help="Description shown with the name.")] = None,
    notes: Annotated[str | None, typer.Option(help="Text stored with the layout.")] = None,
    motion: options.MotionUrl = None,
    axis_distance: options.AxisDistance = None,
    force: Annotated[
        bool,
        typer.Option("--force", help="Replace an entry of that name; accept one that could be confused."),
    ] = False,
    yes: enrolling.Yes = False,
    dry_run: enrolling.DryRun = False,
) -> Result:
    """Enroll a layout from coordinates, a file or captures of the real object, or an untagged body.

    With three captures the object's signature is also stored; if the body hides the reflectors, only the
    signature. The nearest enrolled layouts and the expected confusion rate are shown first; at a
    terminal you are asked before anything is stored.

    Example: tagid enroll helmet-7 --kind helmet --point 0.11,0 --point -0.05,0.09 --point 0,-0.08

    Example: tagid enroll helmet-7 first.tagid.h5 second.tagid.h5 third.tagid.h5

    Example: tagid enroll --body mug first.tagid.h5 second.tagid.h5 third.tagid.h5
    """
    from tagid.tags.layouts.layout import KINDS

    captures = [*(captures or []), *(more or [])]
    if body and not (name and captures):
        missing = [what for what, there in (("a name", name), ("captures", captures)) if not there]
        raise UsageError(
            f"--body without {' and '.join(missing)}",
            "Give three captures of the untagged body: tagid enroll --body NAME FILE FILE FILE.",
        )
    ways = [bool(points), file is not None, bool(captures)]
    if sum(ways) != 1:
        raise UsageError(
            "give the reflectors in exactly one way", "Use --point X,Y (repeated), --file, or captures."
        )
    if file is None and not name:
        raise UsageError("the new entry needs a name", "Give it first: tagid enroll NAME ...")
    if captures and Path(str(name)).is_file():
        raise UsageError(
            f"{name} is a file, but a name is expected", "Give the name first: tagid enroll NAME ..."
        )
    if sigma is not None and not points:
        raise UsageError("--sigma without --point", "Files and captures contain their accuracy.")
    if kind is not None and kind not in KINDS:
        raise UsageError(f"--kind is {kind[:80]!r}", f"Use {', '.join(KINDS)}.")
    config = load_config({"motion.url": motion, "motion.axis_distance_m": axis_distance})
    origin = "" if points else f", file {file.name}" if file else f", {len(captures)} captures"
    source = f"tagid enroll{origin}"
    wish = enrolling.Wish(force, yes, dry_run)
    if body:
        if kind is not None or notes is not None:
            raise UsageError("--kind and --notes apply to layouts only", "Omit them with --body.")
        joint = _body_signature(terminal, str(name), captures, config)
        return _enrol_signature(terminal, joint, label, source, wish, ())
    measured = None
    if file is not None:
        layout = _from_file(file)
    elif captures:
        measured = _measure(terminal, str(name), captures, config)
        if measured.estimate is None:
            assert measured.joint is not None
            return _enrol_signature(terminal, measured.joint, label, source, wish, measured.remarks)
        layout = measured.estimate.layout
    else:
        layout = _from_points(str(name), points or [], sigma)
    fields = {"name": name, "kind": kind, "label": label, "notes": notes}
    layout = replace(layout, **{key: value for key, value in fields.items() if value is not None})  # type: ignore[arg-type]
    return _enrol_layout(terminal, layout, measured, source, wish)


def _body_signature(terminal: Terminal, name: str, paths: list[Path], config: Config) -> Joint:
    from tagid.operate.workplace import Workplace
    from tagid.pipeline.enrollment import prepare_files, signature

    place = Workplace(config)
    captures = prepare_files(paths, place.loading())
    with terminal.progress("signature", total=len(captures) + 1) as advance:
        done = count(1)
        return signature(
            name, "body", captures, place.imaging(), lambda what: advance(next(done), Path(what).name)
        )


def _measure(terminal: Terminal, name: str, paths: list[Path], config: Config) -> Measured:
    from tagid.operate.workplace import Workplace
    from tagid.pipeline.enrollment import measure, prepare_files, sight

    place = Workplace(config)
    imaging = place.imaging()
    captures = prepare_files(paths, place.loading())
    with terminal.progress("measuring", total=2 * len(captures) + 1) as advance:
        done = count(1)

        def progress(what: str) -> None:
            advance(next(done), Path(what).name)

        sighted = []
        for capture in captures:
            sighted.append(sight(capture, imaging))
            progress(capture.name)
        return measure(name, sighted, imaging, progress)


def _enrol_layout(
    terminal: Terminal, layout: Layout, measured: Measured | None, source: str, wish: enrolling.Wish
) -> Result:
    """Show the outcome of enrolling a layout, ask for confirmation, and store it with its signature."""
    from tagid.operate.workplace import open_registry
    from tagid.pipeline.enrollment import propose_layout

    registry = open_registry()
    proposal = propose_layout(registry.contents(), layout, measured, enrolling.basis())
    if proposal.taken is not None and not wish.force:
        raise proposal.taken
    conflict = None if wish.force else proposal.conflict
    if conflict is not None or wish.dry_run:
        return _result(proposal, measured, None, False, conflict)
    question = f"Enroll {layout.name} ({counted(layout.size, 'reflector')})?"
    shown = enrolling.agree(terminal, _shown(proposal, measured), question, wish.yes)
    stored, version = proposal.store(registry, source, wish.force)
    return _result(stored, measured, version, shown)


def _enrol_signature(
    terminal: Terminal,
    joint: Joint,
    label: str | None,
    source: str,
    wish: enrolling.Wish,
    remarks: tuple[str, ...],
) -> Result:
    """Show the quality of a signature (body, or object without positions), ask, and store it."""
    from tagid.operate.workplace import open_registry
    from tagid.pipeline.enrollment import joint_data, joint_words, propose_signature
    from tagid.tags.bodies.likeness import least_tag

    registry = open_registry()
    signature = replace(joint.signature, label=label or "")
    proposal = propose_signature(registry.contents(), signature)
    if proposal.taken is not None and not wish.force:
        raise proposal.taken
    lines = joint_words(joint)
    lines += [
        f"  difference from {p.second}: {p.difference:.1%} of the angle-dependent echo"
        for p in proposal.likenesses[: enrolling.SHOWN]
    ]
    notes = list(remarks)
    if signature.kind == "body":
        least_db = 10 * log10(max(least_tag(signature), 1e-12))
        lines.append(f"  a tag on it must return more than {least_db:.0f} dB of its echo")
        if proposal.alike:
            alike = ", ".join(proposal.alike)
            notes.append(f"it is similar to {alike}: a tag on one may be read as on the other")
    data: dict[str, Any] = {
        "layout": None,
        "signature": joint_data(joint),
        "alike": list(proposal.alike),
        "stored": False,
        "registry_version": proposal.version,
    }
    error = proposal.conflict
    if error is not None and not wish.force:
        return Result.from_error("enroll", error, data, lines, tuple(notes))
    if wish.dry_run:
        human = [lines, f"{signature.name} not stored"]
        return Result("enroll", data, human, messages=tuple(notes))
    asked = enrolling.agree(terminal, lines, f"Enroll the {signature.kind} {signature.name}?", wish.yes)
    data["registry_version"] = proposal.store(registry, source, wish.force)
    data["stored"] = True
    line = f"{signature.kind} {signature.name} enrolled, registry version {data['registry_version']}"
    return Result("enroll", data, line if asked else [lines, line], messages=tuple(notes))


def _shown(proposal: LayoutProposal, measured: Measured | None) -> Drawn:
    """Text shown before the confirmation."""
    from tagid.pipeline.enrollment import joint_words
    from tagid.report.layout_sheet import in_terminal

    layout = proposal.layout
    lines: list[Drawn] = [in_terminal(layout, 33)]
    for number, (x, y) in enumerate(layout.positions, 1):
        spread = ""
        if layout.covariance is not None:
            across, along = layout.covariance[number - 1].diagonal() ** 0.5 * 1e3
            spread = f"  +- {across:.1f}, {along:.1f} mm"
        lines.append(f"  {number}  x {x * 1e3:7.1f}  y {y * 1e3:7.1f} mm{spread}")
    if measured is not None and measured.estimate is not None:
        estimate = measured.estimate
        count = len(estimate.rotations_deg)
        known = f"which scatter by up to {max(estimate.spread_m) * 1e3:.1f} mm"
        lines.append("measured on " + counted(count, "capture") + (f", {known}" if count > 1 else ""))
        if estimate.mirrored:
            lines.append(f"taken as mirror images: {', '.join(estimate.mirrored)}")
    if measured is not None and measured.joint is not None:
        lines += joint_words(measured.joint)
    return [*lines, enrolling.neighbours(proposal.outlook)]


def _result(
    proposal: LayoutProposal,
    measured: Measured | None,
    version: int | None,
    shown: bool,
    error: RegistryError | None = None,
) -> Result:
    from tagid.pipeline.enrollment import joint_data

    layout, outlook = proposal.layout, proposal.outlook
    estimate = measured.estimate if measured else None
    messages = list(measured.remarks) if measured else []
    if estimate is not None and len(estimate.rotations_deg) < 3:
        messages.append(
            "use three or more captures, with the object moved between them, to determine the accuracy"
        )
    data = {
        "layout": layout.to_dict(),
        "signature": joint_data(measured.joint) if measured else None,
        "stored": version is not None,
        "registry_version": version if version is not None else outlook.version,
        **enrolling.as_data(outlook),
        "distances": {
            n.name: {"worst_m": n.distance.worst_m, "rms_m": n.distance.rms_m, "nested": n.distance.nested}
            for n in outlook.neighbours
        },
        "sigma_m": layout.sigma_m if layout.covariance is not None else None,
        "spread_m": None if estimate is None else [float(value) for value in estimate.spread_m],
        "scatter_m": None if estimate is None else estimate.scatter_m,
        "rotations_deg": None if estimate is None else list(estimate.rotations_deg),
        "mirrored": None if estimate is None else list(estimate.mirrored),
    }
    line = f"{layout.name} not stored"
    if version is not None:
        line = f"{layout.name} enrolled: {layout.size} reflectors, registry version {version}"
    human = line if shown else [_shown(proposal, measured), line]
    if error is not None:
        return Result.from_error("enroll", error, data, human, tuple(messages))
    return Result("enroll", data, human, messages=tuple(messages))


def _from_points(name: str, points: list[str], sigma: float | None) -> Layout:
    import numpy as np

    from tagid.tags.layouts.layout import Layout

    positions = np.array([parse_point("--point", text) for text in points])
    covariance = None
    if sigma is not None:
        if not 0 < sigma <= 0.1:
            raise UsageError(f"--sigma is {sigma:g} m", "Give metres, up to 0.1, e.g. --sigma 0.001")
        covariance = np.tile(sigma**2 * np.eye(2), (len(positions), 1, 1))
    return Layout(name, positions, covariance=covariance)


def _from_file(file: Path) -> Layout:
    from tagid.enrolling.layout_file import read_layouts

    layouts = read_layouts(file)
    if len(layouts) > 1:
        raise UsageError(
            f"{file} holds {len(layouts)} layouts", f"Enroll them all: tagid layouts import {file}"
        )
    return layouts[0]
