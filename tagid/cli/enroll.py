"""`tagid enroll`: add an identity."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.cli import options
from tagid.cli.frame import Terminal, command
from tagid.config import Config, load_config
from tagid.errors import UsageError
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.tags.layout import Layout


def register(app: typer.Typer) -> None:
    """Add the command."""

    @command(app, "enroll")
    def enroll(
        terminal: Terminal,
        name: Annotated[str | None, typer.Argument(help="Name of the layout.")] = None,
        points: Annotated[
            list[str] | None, typer.Option("--point", help="A reflector as X,Y in metres; once for each.")
        ] = None,
        file: Annotated[Path | None, typer.Option("--file", help="A layout in TOML or JSON.")] = None,
        captures: Annotated[
            list[Path] | None, typer.Option("--capture", help="A capture of the object; several are better.")
        ] = None,
        kind: Annotated[str, typer.Option("--kind", help="helmet, container or other.")] = "other",
        label: Annotated[str, typer.Option("--label", help="Shown to people with the name.")] = "",
        notes: Annotated[str, typer.Option("--notes", help="Kept with the layout.")] = "",
        motion: options.MotionUrl = None,
        axis_distance: options.AxisDistance = None,
        force: Annotated[bool, typer.Option("--force", help="Enrol one that could be confused.")] = False,
    ) -> Result:
        """Enrol a layout from numbers, from a file, or from captures of the real object.

        Example: tagid enroll helmet-7 --kind helmet --point 0.11,0 --point -0.05,0.09 --point 0,-0.08
        """
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        from tagid.cli.imaging import open_registry
        from tagid.tags.enrolment import enrol
        from tagid.tags.layout import Layout, read_layout

        ways = [bool(points), file is not None, bool(captures)]
        if sum(ways) != 1:
            raise UsageError(
                "say in one way where the reflectors are", "Use --point X,Y (repeated), --file or --capture."
            )
        if file is None and not name:
            raise UsageError("the new layout needs a name", "Give it first: tagid enroll NAME ...")
        spread: list[float] | None = None
        if file is not None:
            layout, source = read_layout(file), f"file {file.name}"
        elif captures:
            config = load_config({"motion.url": motion, "motion.axis_distance_m": axis_distance})
            layout, spread = _from_captures(str(name), captures, config, (kind, label))
            source = f"{len(captures)} captures"
        else:
            positions = [parse_point("--point", text) for text in points or []]
            layout = Layout(str(name), positions, kind, notes=notes, label=label)  # type: ignore[arg-type]
            source = "command line"
        result = enrol(open_registry(), layout, source, force=force)
        table = Table("distance to", "worst reflector mm", "remark", box=None)
        for other, distance in sorted(result.distances.items(), key=lambda item: item[1].worst_m):
            far = "-" if distance.worst_m == float("inf") else f"{distance.worst_m * 1e3:.1f}"
            remark = "a part of the other" if distance.nested else ""
            table.add_row(other, far, "COULD BE CONFUSED" if other in result.confusable else remark)
        lines: list[Text | Table] = [
            Text(f"{layout.name} enrolled: {layout.size} reflectors, registry version {result.version}")
        ]
        if spread is not None:
            lines.append(Text(f"scatter of the reflectors over the captures: {max(spread) * 1e3:.1f} mm"))
        data = {
            "layout": layout.to_dict(),
            "registry_version": result.version,
            "distances": {
                other: {"worst_m": d.worst_m, "rms_m": d.rms_m, "nested": d.nested}
                for other, d in result.distances.items()
            },
            "confusable": list(result.confusable),
            "spread_m": spread,
        }
        return Result("enroll", data, Group(*lines, table))


def parse_point(option: str, text: str) -> tuple[float, float]:
    """X,Y in metres from the text of an option. Raises UsageError."""
    parts = text.split(",")
    try:
        x, y = (float(part) for part in parts)
    except ValueError:
        raise UsageError(f"{option} {text!r} is not X,Y", f"Give metres, e.g. {option} 0.11,-0.02") from None
    return x, y


def _from_captures(
    name: str, captures: list[Path], config: Config, about: tuple[str, str]
) -> tuple[Layout, list[float]]:
    from tagid.defaults import complete, motion_of
    from tagid.pipeline import locate_reflectors, prepare
    from tagid.storage.importers import read_any
    from tagid.tags.enrolment import layout_from_readings

    found = []
    for path in captures:
        capture = complete(read_any(path, config["radar.cable_delay_ps"]), config)
        capture = prepare(capture, motion_of(config, capture))
        found.append(locate_reflectors(capture))
    estimate = layout_from_readings(found, name, about[0], about[1])
    return estimate.layout, [float(value) for value in estimate.spread_m]
