"""Outcome and confirmation shown by `enroll` and `layouts import` before anything is stored.

Scripts receive the same data as JSON and are not asked.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid.cli.consent import can_ask, confirm
from tagid.cli.frame import Output, Terminal
from tagid.config import load_config
from tagid.errors import CaptureInterrupted, TagidError, UsageError, visible
from tagid.proportion import percent
from tagid.query import quantity
from tagid.result import Redrawn, Result

if TYPE_CHECKING:
    from tagid.enrolling.enrollment import Basis, Outlook
    from tagid.enrolling.registry import Registry
    from tagid.result import Drawn
    from tagid.tags.bodies.signature import Signature
    from tagid.tags.layouts.layout import Layout

Yes = Annotated[bool, typer.Option("--yes", "-y", help="Store without confirmation.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Show the outcome but store nothing.")]
SHOWN = 6
"""Neighbours listed in text output; JSON has them all."""


def direction_known() -> bool:
    return bool(load_config({})["tags.direction"] == "known")


def antenna_heights() -> tuple[float, ...]:
    """Configured heights of the antenna, m; (0,) for one. Raises UsageError."""
    return parse_antenna_heights(load_config({})["motion.antenna_heights"])


def parse_antenna_heights(text: str) -> tuple[float, ...]:
    """Antenna heights, m, of comma-separated numbers; (0,) for an empty text. Raises UsageError."""
    try:
        return tuple(quantity(part, "m") for part in text.split(",")) if text.strip() else (0.0,)
    except ValueError:
        raise UsageError(
            f"the antenna heights are {text[:80]!r}", "Give metres separated by commas, e.g. 0,0.15,0.3."
        ) from None


def basis() -> Basis:
    """What readings with the configured antenna heights and direction tell layouts apart by."""
    from tagid.enrolling.enrollment import Basis
    from tagid.tags.layouts.codebook import height_weight

    weight = height_weight(antenna_heights(), load_config({})["motion.axis_distance_m"] or 1.0)
    return Basis(direction_known(), weight)


def about(outlook: Outlook) -> str:
    """How well readings tell a layout from its neighbours."""
    least, conditions = outlook.least, outlook.conditions
    if least is None or least.apart is None:
        return "no other layout is like it"
    sigma = outlook.layout.sigma_m
    known = f", its positions known to within {sigma * 1e3:.1f} mm" if sigma > 0 else ""
    return (
        f"not told from {least.name}{least.apart.where} in {rate_in_words(least.unresolved)} of readings at "
        f"{conditions.views} views and {conditions.snr_db:g} dB{known}"
    )


def neighbours(outlook: Outlook) -> Drawn:
    """The nearest enrolled layouts to one, as a table."""
    from tagid.report.table import Table

    if not outlook.neighbours:
        return "no other layout is enrolled"
    table = Table("nearest enrolled", "worst mm", "RMS mm", "not told apart", "remark", wraps=("remark",))
    for neighbour in outlook.neighbours[: max(SHOWN, len(outlook.confusable))]:
        distance = neighbour.distance
        same = distance.worst_m < float("inf")
        remark = "different number of reflectors" if not same else ""
        if distance.nested:
            remark = "one is a subset of the other"
        if neighbour.confusable:
            remark = "COULD BE CONFUSED"
        table.add_row(
            neighbour.name,
            f"{distance.worst_m * 1e3:.1f}" if same else "-",
            f"{distance.rms_m * 1e3:.1f}" if same else "-",
            rate_in_words(neighbour.unresolved) if same else "-",
            remark + (", as its mirror image" if neighbour.mirrored else ""),
        )
    return [table, about(outlook)]


def family_neighbours(outlooks: Sequence[Outlook]) -> Drawn:
    """The nearest other layout to each of several, as a table."""
    from tagid.report.table import Table

    table = Table("layout", "nearest", "worst mm", "not told apart", "remark", wraps=("remark",))
    for outlook in outlooks:
        near = outlook.neighbours[0] if outlook.neighbours else None
        far = near is None or near.distance.worst_m == float("inf")
        table.add_row(
            outlook.layout.name,
            "-" if near is None or far else near.name,
            "-" if near is None or far else f"{near.distance.worst_m * 1e3:.1f}",
            rate_in_words(outlook.unresolved),
            "COULD BE CONFUSED" if outlook.confusable else "",
        )
    worst = max(outlooks, key=lambda outlook: outlook.unresolved)
    return [table, f"{worst.layout.name}: {about(worst)}"]


def as_data(outlook: Outlook) -> dict[str, Any]:
    """The same as JSON values."""
    conditions = outlook.conditions
    return {
        "nearest": [
            {
                "name": n.name,
                "worst_m": n.distance.worst_m,
                "rms_m": n.distance.rms_m,
                "rotation_deg": n.distance.rotation_deg,
                "confusion_rate": n.unresolved,
                "lead": None if n.apart is None else n.apart.lead,
                "body": None if n.apart is None else n.apart.body,
                "nested": n.distance.nested,
                "mirrored": n.mirrored,
                "confusable": n.confusable,
            }
            for n in outlook.neighbours
        ],
        "confusion_rate": outlook.unresolved,
        "reference": {"views": conditions.views, "snr_db": conditions.snr_db},
        "confusable": list(outlook.confusable),
    }


def agree(terminal: Terminal, shown: Drawn, question: str, yes: bool) -> bool:
    """Show the outcome of enrolling, and ask for confirmation on a terminal.

    Returns whether it was shown. Raises CaptureInterrupted if the user declines: nothing is stored then.
    """
    if yes or terminal.output != Output.human or not (can_ask() and sys.stderr.isatty()):
        return False
    from rich.console import Console

    Console(stderr=True, highlight=False).print(Redrawn(shown, visible))
    if not confirm(question, default=False):
        raise CaptureInterrupted("declined: nothing was stored")
    return True


@dataclass(frozen=True)
class Wish:
    """Options for storing layouts: override conflicts, skip the prompt, or store nothing."""

    force: bool = False
    yes: bool = False
    dry_run: bool = False


@dataclass(frozen=True)
class Stored:
    """The outcome of enrolling several layouts.

    Attributes:
        version: the new registry version; None if nothing was stored.
        data: their neighbours, as JSON values.
        seen: their neighbours, as text; None if already shown before the prompt.
        error: why nothing was stored.
    """

    version: int | None
    data: dict[str, Any]
    seen: Drawn | None
    error: TagidError | None = None

    def result(
        self, name: str, data: dict[str, Any], lines: Sequence[Drawn], messages: Sequence[str] = ()
    ) -> Result:
        human = [*([] if self.seen is None else [self.seen]), *([] if self.error else lines)]
        if self.error is None:
            return Result(name, data, human, messages=tuple(messages))
        return Result.from_error(name, self.error, data, human, tuple(messages))


def store_family(
    terminal: Terminal,
    registry: Registry,
    layouts: Sequence[Layout],
    source: str,
    wish: Wish,
    signatures: Sequence[Signature] = (),
) -> Stored:
    """Show the outcome of enrolling layouts and signatures, ask for confirmation, and store all or none.

    Raises CaptureInterrupted if the user declines, RegistryError.
    """
    from tagid.enrolling.enrollment import family_outlooks, merge, refusal

    by = basis()
    seen, enrolled = registry.snapshot()
    outlooks = family_outlooks(layouts, enrolled, by)
    shown = family_neighbours(outlooks) if outlooks else "no layouts, signatures only"
    data = {"confusion": [{"layout": outlook.layout.name, **as_data(outlook)} for outlook in outlooks]}
    error = None if wish.force else refusal(outlooks, enrolled)
    if error:
        return Stored(None, data, shown, error)
    if wish.dry_run:
        return Stored(None, data, shown)
    more = f" and {len(signatures)} signatures" if signatures else ""
    asked = agree(terminal, shown, f"Enroll {len(layouts)} layouts{more}?", wish.yes)
    version = merge(
        registry, layouts, source, force=wish.force, basis=by, checked=seen, signatures=signatures
    )
    return Stored(version, data, None if asked else shown)


def rate_in_words(rate: float) -> str:
    """A share of the readings as text; one below 0.001 % is given as a bound."""
    return "under 0.001 %" if rate < 1e-5 else percent(rate)
