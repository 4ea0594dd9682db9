"""`tagid layouts design`, `capacity` and `reflector`: new layouts for an object, and reflectors to make."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid.cli import enrolling
from tagid.cli.frame import Terminal, command
from tagid.cli.options import METRES, MILLIMETRES
from tagid.cli.outputs import check_new
from tagid.config import load_config
from tagid.counting import counted
from tagid.errors import UsageError
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.report.reflector_sheet import CrossSection
    from tagid.result import Drawn
    from tagid.tags.layouts.design import DesignRules, Family
    from tagid.tags.layouts.layout import Layout
    from tagid.tags.layouts.objects import TaggedObject


@dataclass(frozen=True)
class TargetOptions:
    """The object that layouts are for and the rules of their design, as options."""

    target: Annotated[str, typer.Option("--object", help="helmet, mug or container.")] = "helmet"
    slots: Annotated[int, typer.Option(help="Equal angular steps around the object.")] = 12
    rows: Annotated[int | None, typer.Option(help="Number of the object's rows to use; default 1.")] = None
    radius: Annotated[
        list[float] | None,
        typer.Option(parser=METRES, help="Custom object: radius of a row in metres; repeat for each row."),
    ] = None
    height: Annotated[
        list[float] | None, typer.Option(parser=METRES, help="Height of each --radius row, metres.")
    ] = None
    spacing: Annotated[
        float | None,
        typer.Option(
            parser=METRES,
            help="Minimum reflector spacing, metres; default of design: 0.07, or less if the count needs it; "
            "of capacity: 0.04.",
        ),
    ] = None
    mirror: Annotated[
        bool | None,
        typer.Option(
            "--mirror/--no-mirror",
            help="Count mirror images as two layouts; default: follows tags.direction.",
        ),
    ] = None
    seed: Annotated[
        int, typer.Option(min=0, max=9223372036854775807, help="Random seed of the search for the best set.")
    ] = 0
    heights: Annotated[
        str | None,
        typer.Option(
            metavar="H,H,...", help="Antenna heights of every scan, metres; default: motion.antenna_heights."
        ),
    ] = None

    def object(self, every_row: bool = False) -> TaggedObject:
        """The built-in object with its rows, or a custom one from radii and heights. Raises UsageError."""
        from tagid.tags.layouts.objects import Row, TaggedObject, object_named

        radii, heights = self.radius, self.height
        if not radii:
            if heights:
                raise UsageError("--height without --radius", "Give a --radius for every --height.")
            named = object_named(self.target)
            return named if every_row else named.with_rows(1 if self.rows is None else self.rows)
        if heights and len(heights) != len(radii):
            raise UsageError(
                f"{len(radii)} radii and {len(heights)} heights", "Give as many --height as --radius."
            )
        if self.rows is not None:
            raise UsageError("--rows with --radius", "Every --radius is a row; omit --rows.")
        given = tuple(Row(r, h) for r, h in zip(radii, heights or [0.0] * len(radii), strict=True))
        return TaggedObject("own", "other", given, "Own object")

    def rules(self, reflectors: int) -> DesignRules:
        """The design rules for so many reflectors. Raises UsageError."""
        from tagid.tags.layouts.design import REFLECTOR_M, DesignRules

        return DesignRules(
            reflectors,
            self.slots,
            REFLECTOR_M if self.spacing is None else self.spacing,
            mirror_counts=enrolling.direction_known() if self.mirror is None else self.mirror,
            seed=self.seed,
            antenna_heights_m=(
                enrolling.antenna_heights()
                if self.heights is None
                else enrolling.parse_antenna_heights(self.heights)
            ),
            axis_distance_m=load_config({})["motion.axis_distance_m"] or 1.0,
        )


@command("layouts design")
def design(
    terminal: Terminal,
    target: TargetOptions,
    reflectors: Annotated[int, typer.Option(help="Reflectors per layout.")] = 3,
    count: Annotated[int, typer.Option(min=1, max=10000, help="Number of layouts.")] = 10,
    alone: Annotated[bool, typer.Option("--alone", help="Ignore the enrolled layouts.")] = False,
    prefix: Annotated[str | None, typer.Option(help="Prefix of the names, e.g. mug-r3s12.")] = None,
    out: Annotated[Path | None, typer.Option(help="Write the layouts as TOML.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite an existing file.")] = False,
    enroll: Annotated[bool, typer.Option("--enroll", help="Enroll all layouts, or none.")] = False,
    yes: enrolling.Yes = False,
) -> Result:
    """Design the layouts that a radar distinguishes best at any orientation of the object.

    Example: tagid layouts design --object helmet --reflectors 3 --slots 12 --count 10 --out helmets.toml
    """
    from tagid.enrolling.advice import roomiest
    from tagid.operate.workplace import open_registry
    from tagid.tags.layouts.design import design as exactly
    from tagid.tags.layouts.layout import is_name

    if prefix is not None and not is_name(f"{prefix}-01"):
        # Checked before the search, whose remedies are other options.
        raise UsageError(
            f"--prefix {prefix[:80]!r} is not valid",
            "Use up to 60 of a-z, 0-9, dot, dash and underscore; begin with a letter or digit.",
        )
    if out is not None:
        check_new(out, force)
    rules = target.rules(reflectors)
    beside = [] if alone else open_registry().layouts()
    chosen = target.object()
    whole = chosen if target.radius else target.object(every_row=True)
    asked = _Asked(whole, len(chosen.rows), rules, count, tuple(beside))
    make = roomiest if target.spacing is None else exactly
    try:
        family = make(chosen, rules, count, prefix, beside)
    except UsageError as error:
        raise UsageError(error.message, asked.remedy()) from None
    return _designed(terminal, family, asked, out, enrolling.Wish(False, yes, not enroll))


@command("layouts capacity")
def capacity(
    terminal: Terminal,
    target: TargetOptions,
    error_rate: Annotated[float, typer.Option(help="Share of readings that may have no name.")] = 0.001,
) -> Result:
    """Compute how many identities an object can carry at a given error rate.

    Example: tagid layouts capacity --object mug --error-rate 0.001
    """
    from tagid.enrolling.capacity import capacity as of_object
    from tagid.reading.alike import Conditions
    from tagid.report.table import Table

    chosen, rules = target.object(), [target.rules(reflectors) for reflectors in (2, 3, 4)]
    table = Table("recording", *(f"{r.reflectors} reflectors" for r in rules), wraps=())
    rows: list[dict[str, Any]] = []
    recordings = ((36, 20.0), (36, 10.0), (36, 0.0), (12, 10.0))
    with terminal.progress("capacity", total=len(recordings)) as advance:
        for done, (views, snr_db) in enumerate(recordings):
            advance(done, f"{views} views {snr_db:g} dB")
            conditions = Conditions(views, snr_db, rules[0].height_weight)
            capacities = [of_object(chosen, rule, error_rate, conditions) for rule in rules]
            cells = [
                f"{c.identities}" + (f" ({c.distance_m * 1e3:.0f} mm)" if c.identities > 1 else "")
                for c in capacities
            ]
            table.add_row(f"{views} views {snr_db:g} dB", *cells)
            rows += [
                {
                    "views": views,
                    "snr_db": snr_db,
                    "reflectors": c.reflectors,
                    "identities": c.identities,
                    "distance_m": c.distance_m if c.identities > 1 else None,
                    "error_rate": c.error_rate,
                }
                for c in capacities
            ]
    radii = ", ".join(f"{row.radius_m * 1e3:.0f} mm" for row in chosen.rows)
    line = (
        f"{chosen.label or chosen.name} (radius {radii}), {rules[0].slots} slots: identities, where "
        f"at most {error_rate:g} of readings leave no name (and their minimum distance)"
    )
    return Result(
        "layouts capacity", {"object": chosen.name, "error_rate": error_rate, "rows": rows}, [line, table]
    )


@dataclass(frozen=True)
class _Asked:
    """A design request: the whole object, its rows, rules, number, and the layouts to be avoided."""

    target: TaggedObject
    rows: int
    rules: DesignRules
    count: int
    beside: tuple[Layout, ...]

    def remedy(self) -> str:
        """Alternative options that work, or what else to do if there are none."""
        from tagid.enrolling.advice import alternatives

        suggestions = alternatives(self.target, self.rows, self.rules, self.count, self.beside)
        if suggestions:
            return f"These work: {', or '.join(suggestions)}."
        if self.beside and alternatives(self.target, self.rows, self.rules, self.count):
            return (
                "The enrolled layouts leave no room: use a larger object, or remove layouts that are not in "
                "use with `tagid layouts remove NAME`."
            )
        return "Use a larger object: neither fewer reflectors nor a smaller spacing works on this one."

    def without_ghosts(self) -> int:
        """The largest number of enrollable layouts, up to that asked for, without ghosts; 0 for none."""
        from tagid.enrolling.advice import most
        from tagid.tags.layouts.design import GHOST_M

        rules = replace(self.rules, spacing_m=GHOST_M)
        return most(self.target.with_rows(self.rows), rules, self.count + 1, self.beside)


def _designed(
    terminal: Terminal, family: Family, asked: _Asked, out: Path | None, wish: enrolling.Wish
) -> Result:
    import numpy as np

    from tagid.enrolling.enrollment import family_outlooks, refusal
    from tagid.enrolling.layout_file import write_layouts
    from tagid.operate.workplace import open_registry
    from tagid.report.table import Table
    from tagid.tags.layouts.design import GHOST_M

    messages = []
    outlooks = family_outlooks(family.layouts, asked.beside, enrolling.basis())
    refused = refusal(outlooks, asked.beside)
    remedy = "" if refused is None else asked.remedy()
    if refused is not None:
        messages.append(f"this set cannot be enrolled: {refused.message}. {remedy}".replace("..", "."))
    if family.ghost_m < GHOST_M:
        number = asked.without_ghosts()
        settings = f"--spacing {GHOST_M:g}" + f" --count {number}" * (number < asked.count)
        messages.append(
            f"reflectors {family.ghost_m * 1e3:.0f} mm apart, closer than {GHOST_M * 1e3:.0f} mm (a "
            "wavelength), can cause a ghost; "
            + (f"{settings} avoids it" if number else "on this object they cannot be farther apart")
        )
    if out is not None:
        write_layouts(family.layouts, out)
    stored = None
    if not wish.dry_run:
        stored = enrolling.store_family(terminal, open_registry(), family.layouts, "design", wish)
    table = Table("layout", "angles deg", "radii mm", "heights mm")
    for layout in family.layouts:
        x, y = layout.positions.T
        angles = np.rad2deg(np.arctan2(y, x)) % 360
        table.add_row(
            layout.name,
            " ".join(f"{a:.0f}" for a in angles),
            " ".join(f"{r * 1e3:.0f}" for r in np.hypot(x, y)),
            " ".join(f"{float(h) * 1e3:.0f}" for h in np.asarray(layout.heights)),
        )
    worst = max(outlooks, key=lambda outlook: outlook.unresolved)
    least = f"{family.distance_m * 1e3:.1f} mm"
    lines: list[Drawn] = [
        (
            f"{counted(len(family.layouts), 'layout')} of {family.candidates} that fit, reflectors at least "
            f"{family.ghost_m * 1e3:.0f} mm apart; "
            + (f"the two most alike differ by {least}, turned to match" if len(family.layouts) > 1 else "")
            + ("" if family.proven else " (a better set may exist)")
        )
    ]
    lines.append(f"{worst.layout.name}: {enrolling.about(worst)}")
    if out is not None:
        how = "they cannot be enrolled" if refused else f"enroll them: tagid layouts import {out}"
        lines.append(f"written to {out}; {how}")
    data = {
        "layouts": [layout.to_dict() for layout in family.layouts],
        "distance_m": None if family.distance_m == float("inf") else family.distance_m,
        "proven_best": family.proven,
        "confusion_rate": worst.unresolved,
        "nearest_reflectors_m": family.ghost_m,
        "candidates": family.candidates,
        "necklaces": family.necklaces,
        "can_be_enrolled": refused is None,
        "advice": remedy,
        "path": None if out is None else str(out),
        "registry_version": None if stored is None else stored.version,
        **({} if stored is None else stored.data),
    }
    lines.append(table)
    if stored is None:
        return Result("layouts design", data, lines, messages=tuple(messages))
    if stored.version is not None:
        lines.append(f"enrolled, registry version {stored.version}")
    return stored.result("layouts design", data, lines, messages)


KINDS = ("octahedron",)
_MADE = (".stl", ".svg", ".pdf")
_TOLD = (".csv", ".png")


@command("layouts reflector")
def reflector(
    terminal: Terminal,
    kind: Annotated[str, typer.Option(help="octahedron.")] = "octahedron",
    size: Annotated[float, typer.Option(parser=MILLIMETRES, help="From tip to tip, millimetres.")] = 40.0,
    out: Annotated[
        list[Path] | None,
        typer.Option("--out", "-o", help="A .stl solid, or a .svg or .pdf net; repeatable."),
    ] = None,
    rcs: Annotated[
        list[Path] | None,
        typer.Option(help="Compute its radar cross-section: .csv table, .png plot; repeatable."),
    ] = None,
    paper: Annotated[str, typer.Option(help="Paper of a PDF: a4, a3, letter.")] = "a4",
    force: Annotated[bool, typer.Option("--force", help="Overwrite existing files.")] = False,
) -> Result:
    """Create files for a reflector: a solid for a 3-D printer and foil, or a net to cut and fold at 1:1.

    Example: tagid layouts reflector --size 40 --out r.stl --out r.pdf --rcs r.csv --rcs r.png
    """
    from tagid.files import write_bytes
    from tagid.report import reflector_sheet as sheets
    from tagid.report.drafting import to_svg
    from tagid.report.pdf import to_pdf

    if kind not in KINDS:
        raise UsageError(f"there is no reflector {kind[:40]!r}", f"Use {', '.join(KINDS)}.")
    made, responses = list(out or ()), list(rcs or ())
    if not made and not responses:
        raise UsageError("nothing to write", "Give --out r.stl, r.svg or r.pdf, or --rcs r.csv or r.png.")
    for paths, known, option in ((made, _MADE, "--out"), (responses, _TOLD, "--rcs")):
        for path in paths:
            if path.suffix.lower() not in known:
                raise UsageError(f"{option} {path}: unknown suffix", f"Use {', '.join(known)}.")
            check_new(path, force)
    size_m = size * 1e-3
    sheets.check_size(size_m)
    for path in made:
        suffix = path.suffix.lower()
        if suffix == ".stl":
            content = sheets.to_stl(size_m)
        else:
            net = sheets.sheet(size_m)
            content = to_svg(net) if suffix == ".svg" else to_pdf([net], paper)
        write_bytes(path, content)
    edge = size / 2**0.5
    lines: list[Drawn] = [f"octahedron, size {size:g} mm from tip to tip, edge {edge:.1f} mm"]
    solved = sheets.cross_section(size_m) if responses else None
    if solved is not None:
        for path in responses:
            content = sheets.to_csv(solved).encode() if path.suffix == ".csv" else sheets.to_png(solved)
            write_bytes(path, content)
        lines += [_table(solved), f"source: {solved.source}"]
    written = [str(path) for path in (*made, *responses)]
    lines += [f"written  {path}" for path in written]
    data: dict[str, Any] = {
        "kind": kind,
        "size_mm": size,
        "edge_mm": edge,
        "written": written,
        "rcs_dbsm": None,
    }
    if solved is not None:
        levels = ("frequency_hz", "aspect_deg", "vertical", "horizontal")
        data["rcs_dbsm"] = {
            "source": solved.source,
            **{name: getattr(solved, name).tolist() for name in levels},
        }
    return Result("layouts reflector", data, lines)


def _table(solved: CrossSection) -> Drawn:
    from tagid.report.table import Table

    table = Table("GHz", "vertical dBsm", "horizontal dBsm, towards a tip", "at 45 degrees")
    half = len(solved.aspect_deg) // 2
    for i, frequency in enumerate(solved.frequency_hz):
        across = solved.horizontal[i]
        table.add_row(
            f"{frequency / 1e9:.1f}",
            f"{solved.vertical[i].mean():.1f}",
            f"{across[0]:.1f}",
            f"{across[half]:.1f}",
        )
    return table
