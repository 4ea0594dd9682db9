"""`tagid enroll`: add an identity."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.cli.common import enrolling, options
from tagid.cli.common.frame import Terminal, command
from tagid.cli.common.points import parse_point
from tagid.config import Config, load_config
from tagid.errors import RegistryError, UsageError
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.tags.enrolling.averaging import LayoutEstimate
    from tagid.tags.enrolling.enrolment import Outlook
    from tagid.tags.layouts.layout import Layout
    from tagid.tags.layouts.registry import Registry


def register(app: typer.Typer) -> None:
    """Add the command."""

    @command(app, "enroll")
    def enroll(
        terminal: Terminal,
        name: Annotated[
            str | None,
            typer.Argument(help="Name of the layout; a file has one of its own.", show_default=False),
        ] = None,
        more: Annotated[
            list[Path] | None,
            typer.Argument(help="Captures of the real object, as with --capture.", show_default=False),
        ] = None,
        points: Annotated[
            list[str] | None,
            typer.Option(
                "--point",
                help="A reflector as X,Y in metres from the axis; once for each.",
                show_default=False,
            ),
        ] = None,
        file: Annotated[
            Path | None, typer.Option("--file", help="One layout in TOML or JSON.", show_default=False)
        ] = None,
        captures: Annotated[
            list[Path] | None,
            typer.Option(
                "--capture",
                help="A capture of the real object; once for each, three or more, the object put down anew.",
                show_default=False,
            ),
        ] = None,
        sigma: Annotated[
            float | None,
            typer.Option("--sigma", help="How exactly the --point are known, metres.", show_default=False),
        ] = None,
        kind: Annotated[
            str | None, typer.Option("--kind", help="helmet, container or other.", show_default=False)
        ] = None,
        label: Annotated[
            str | None, typer.Option("--label", help="Shown to people with the name.", show_default=False)
        ] = None,
        notes: Annotated[
            str | None, typer.Option("--notes", help="Kept with the layout.", show_default=False)
        ] = None,
        motion: options.MotionUrl = None,
        axis_distance: options.AxisDistance = None,
        force: Annotated[
            bool, typer.Option("--force", help="Enrol one that could be confused, or over its namesake.")
        ] = False,
        yes: enrolling.Yes = False,
        dry_run: enrolling.DryRun = False,
    ) -> Result:
        """Enrol a layout from numbers, from a file, or from captures of the real object.

        The nearest enrolled layouts and the expected rate of confusion are shown first; at a terminal you are
        asked before anything is stored.

        Example: tagid enroll helmet-7 --kind helmet --point 0.11,0 --point -0.05,0.09 --point 0,-0.08

        Example: tagid enroll helmet-7 first.tagid.h5 second.tagid.h5 third.tagid.h5
        """
        from tagid.cli.common.imaging import open_registry
        from tagid.tags.enrolling.enrolment import outlook as look

        captures = [*(captures or []), *(more or [])]
        ways = [bool(points), file is not None, bool(captures)]
        if sum(ways) != 1:
            raise UsageError(
                "say in one way where the reflectors are", "Use --point X,Y (repeated), --file, or captures."
            )
        if file is None and not name:
            raise UsageError("the new layout needs a name", "Give it first: tagid enroll NAME ...")
        if captures and Path(str(name)).is_file():
            raise UsageError(f"{name} is a file where a name should be", "Name first: tagid enroll NAME ...")
        if sigma is not None and not points:
            raise UsageError(
                "--sigma without --point", "A file and captures say themselves how exact they are."
            )
        estimate = None
        if file is not None:
            layout, source = _from_file(file), f"file {file.name}"
        elif captures:
            config = load_config({"motion.url": motion, "motion.axis_distance_m": axis_distance})
            estimate = _from_captures(str(name), captures, config, terminal)
            layout, source = estimate.layout, f"{len(captures)} captures"
        else:
            layout, source = _from_points(str(name), points or [], sigma), "command line"
        given = {"name": name, "kind": kind, "label": label, "notes": notes}
        layout = replace(layout, **{key: value for key, value in given.items() if value is not None})  # type: ignore[arg-type]
        registry = open_registry()
        version, known = registry.snapshot()
        found = look(layout, known, direction_known=enrolling.direction_known(), version=version)
        if any(other.name == layout.name for other in known) and not force:
            raise RegistryError(
                f"a layout named {layout.name} is enrolled already",
                "Choose another name, remove it with `tagid layouts --remove`, or replace it with --force.",
            )
        conflict = None if force else found.conflict()
        if conflict is not None or dry_run:
            error = () if conflict is None else (conflict,)
            return _result(found, estimate, None, False, errors=error)
        question = f"Enrol {layout.name} ({layout.size} reflectors)?"
        shown = enrolling.agree(terminal, _shown(found, estimate), question, yes)
        return _store(registry, found, estimate, source, force, shown)


def _store(
    registry: Registry,
    found: Outlook,
    estimate: LayoutEstimate | None,
    source: str,
    force: bool,
    shown: bool,
) -> Result:
    from tagid.tags.enrolling.enrolment import enrol

    done = enrol(registry, found.layout, source, force=force, direction_known=enrolling.direction_known())
    return _result(done.outlook, estimate, done.version, shown)


def _shown(found: Outlook, estimate: LayoutEstimate | None):  # type: ignore[no-untyped-def]
    """What a person sees before the question."""
    from rich.console import Group
    from rich.text import Text

    from tagid.report.layout_sheet import in_terminal

    layout = found.layout
    lines: list[object] = [Text(in_terminal(layout, 33))]
    for number, (x, y) in enumerate(layout.positions, 1):
        spread = "" if layout.covariance is None else "  +- " + _sigmas(layout, number - 1)
        lines.append(Text(f"  {number}  x {x * 1e3:7.1f}  y {y * 1e3:7.1f} mm{spread}"))
    if estimate is not None:
        count = len(estimate.rotations_deg)
        known = f"which scatter by up to {max(estimate.spread_m) * 1e3:.1f} mm"
        lines.append(Text(f"measured on {count} capture(s)" + (f", {known}" if count > 1 else "")))
        if estimate.mirrored:
            lines.append(Text(f"taken as mirror images: {', '.join(estimate.mirrored)}"))
    return Group(*lines, enrolling.neighbours(found))  # type: ignore[arg-type]


def _sigmas(layout: Layout, index: int) -> str:
    assert layout.covariance is not None
    own = layout.covariance[index]
    return f"{own[0, 0] ** 0.5 * 1e3:.1f}, {own[1, 1] ** 0.5 * 1e3:.1f} mm"


def _result(
    found: Outlook,
    estimate: LayoutEstimate | None,
    version: int | None,
    shown: bool,
    errors: tuple[RegistryError, ...] = (),
) -> Result:
    from rich.console import Group
    from rich.text import Text

    layout = found.layout
    entries = tuple({"code": e.code, "message": e.message, "remedy": e.remedy} for e in errors)
    messages = []
    if estimate is not None and len(estimate.rotations_deg) < 3:
        messages.append("three or more captures, the object put down anew for each, show how exact they are")
    data = {
        "layout": layout.to_dict(),
        "stored": version is not None,
        "registry_version": version if version is not None else found.version,
        **enrolling.as_data(found),
        "distances": {
            n.name: {"worst_m": n.distance.worst_m, "rms_m": n.distance.rms_m, "nested": n.distance.nested}
            for n in found.neighbours
        },
        "sigma_m": layout.sigma_m if layout.covariance is not None else None,
        "spread_m": None if estimate is None else [float(value) for value in estimate.spread_m],
        "scatter_m": None if estimate is None else estimate.scatter_m,
        "rotations_deg": None if estimate is None else list(estimate.rotations_deg),
        "mirrored": None if estimate is None else list(estimate.mirrored),
    }
    line = Text(f"{layout.name} not stored")
    if version is not None:
        line = Text(f"{layout.name} enrolled: {layout.size} reflectors, registry version {version}")
    human = line if shown else Group(_shown(found, estimate), line)
    status, code = ("error", errors[0].exit_code) if errors else ("success", 0)
    return Result("enroll", data, human, status, code, tuple(messages), entries)  # type: ignore[arg-type]


def _from_points(name: str, points: list[str], sigma: float | None) -> Layout:
    import numpy as np

    from tagid.tags.layouts.layout import Layout

    places = np.array([parse_point("--point", text) for text in points])
    covariance = None
    if sigma is not None:
        if not sigma > 0:
            raise UsageError(
                f"--sigma is {sigma:g} m", "Give a positive number of metres, e.g. --sigma 0.001"
            )
        covariance = np.tile(sigma**2 * np.eye(2), (len(places), 1, 1))
    return Layout(name, places, covariance=covariance)


def _from_file(file: Path) -> Layout:
    from tagid.tags.layouts.layout_file import read_layouts

    found = read_layouts(file)
    if len(found) > 1:
        raise UsageError(f"{file} holds {len(found)} layouts", f"Enrol them all: tagid layouts import {file}")
    return found[0]


def _from_captures(name: str, captures: list[Path], config: Config, terminal: Terminal) -> LayoutEstimate:
    from tagid.cli.common.imaging import settings_from
    from tagid.pipeline.identify import sight_reflectors
    from tagid.pipeline.load import LoadSettings, load_capture
    from tagid.tags.enrolling.averaging import average

    same = {path.resolve() for path in captures}
    if len(same) < len(captures):
        raise UsageError("one capture is given twice", "Give captures of the object put down anew each time.")
    settings, loading = settings_from(config), LoadSettings.of(config)
    found, known = [], dict[str, Path]()
    with terminal.progress("captures", total=len(captures)) as advance:
        for number, path in enumerate(captures, 1):
            capture = load_capture(path, loading)
            twin = known.setdefault(capture.uuid, path)
            if twin != path:
                raise UsageError(
                    f"{path} and {twin} are one capture",
                    "Give captures of the object put down anew each time.",
                )
            found.append(sight_reflectors(capture, str(path), settings))
            advance(number, path.name)
    return average(found, name, direction_known=config["tags.direction"] == "known")
