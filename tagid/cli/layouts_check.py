"""`tagid layouts check`: which of the enrolled layouts can be taken for another."""

from __future__ import annotations

from itertools import combinations
from typing import Annotated

import typer

from tagid.cli.frame import Terminal, command
from tagid.errors import LayoutConflictError
from tagid.result import Result


def register(app: typer.Typer) -> None:
    """Add the command."""

    @command(app, "layouts check")
    def check(
        terminal: Terminal,
        sigma: Annotated[
            float | None, typer.Option("--sigma", help="Error of one coordinate, metres (measured default).")
        ] = None,
    ) -> Result:
        """Check the registry: every pair's distance and how often noise confuses it.

        Example: tagid layouts check
        """
        from rich.table import Table
        from rich.text import Text

        from tagid.cli.imaging import open_registry
        from tagid.tags.capacity import REFERENCE, confusion_rate
        from tagid.tags.codebook import CONFUSABLE_M, rotational_distance

        registry = open_registry()
        enrolled = registry.layouts()
        registry.history()
        error_m = REFERENCE.sigma_m if sigma is None else sigma
        pairs = []
        for a, b in combinations(enrolled, 2):
            distance = rotational_distance(a, b)
            if a.size == b.size:
                rate = confusion_rate(distance.rms_m, a.size, error_m)
                pairs.append((distance.rms_m, distance.worst_m, a.name, b.name, rate))
        pairs.sort()
        bad = [pair for pair in pairs if pair[1] < CONFUSABLE_M]
        table = Table("pair", "distance mm", "worst reflector mm", "confused", "remark", box=None)
        for rms, worst, a_name, b_name, rate in pairs[: max(10, len(bad))]:
            remark = "COULD BE CONFUSED" if worst < CONFUSABLE_M else ""
            table.add_row(
                f"{a_name} - {b_name}", f"{rms * 1e3:.1f}", f"{worst * 1e3:.1f}", f"{rate:.1e}", remark
            )
        data = {
            "layouts": len(enrolled),
            "registry_version": registry.version,
            "sigma_m": error_m,
            "pairs": [
                {"a": a_name, "b": b_name, "rms_m": rms, "worst_m": worst, "confusion_rate": rate}
                for rms, worst, a_name, b_name, rate in pairs
            ],
        }
        if not pairs:
            return Result("layouts check", data, Text(f"{len(enrolled)} layouts, no two of one size"))
        if not bad:
            return Result("layouts check", data, table)
        error = LayoutConflictError(
            f"{len(bad)} pair(s) of layouts lie within {CONFUSABLE_M * 1e3:.0f} mm of each other",
            "Remove one of each pair with `tagid layouts --remove NAME`, or move a reflector.",
        )
        entry = {"code": error.code, "message": error.message, "remedy": error.remedy}
        return Result("layouts check", data, table, "error", error.exit_code, errors=(entry,))
