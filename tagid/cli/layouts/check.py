"""`tagid layouts check`: find enrolled layouts that could be confused with each other."""

from __future__ import annotations

from itertools import combinations

import typer

from tagid.cli.common.enrolling import rate_in_words
from tagid.cli.common.frame import Terminal, command
from tagid.counting import counted
from tagid.errors import LayoutConflictError
from tagid.result import Result


def register(app: typer.Typer) -> None:
    """Add the command."""

    @command(app, "layouts check")
    def check(terminal: Terminal) -> Result:
        """Check the registry: how far readings tell every pair apart.

        Example: tagid layouts check
        """
        from rich.table import Table
        from rich.text import Text

        from tagid.cli.common.enrolling import direction_known, height_weight
        from tagid.enrolling.enrolment import neighbour
        from tagid.operate.workplace import open_registry
        from tagid.reading.alike import Conditions

        registry = open_registry()
        version, enrolled = registry.snapshot()
        lost = [change for change in registry.history() if change.entry is None]
        remarks = [
            f"version {c.version} ({c.action} {c.name}) cannot be read, so it cannot be restored"
            for c in lost
        ]
        known, weight = direction_known(), height_weight()
        conditions = Conditions(height_weight=weight)
        pairs, nested = [], []
        for a, b in combinations(enrolled, 2):
            pair = neighbour(a, b, known, weight)
            if a.size == b.size:
                pairs.append((a.name, pair.compared(a, b, conditions)))
            elif pair.distance.nested:
                nested.append(sorted((a, b), key=lambda layout: layout.size))
        pairs.sort(key=lambda pair: pair[1].distance.rms_m)
        bad = [pair for pair in pairs if pair[1].confusable]
        table = Table(box=None)
        for head in ("pair", "RMS mm", "worst mm", "not told apart", "remark"):
            table.add_column(head, no_wrap=head != "remark")
        for name, other in pairs[: max(10, len(bad))]:
            distance = other.distance
            remark = "CONFUSABLE" if other.confusable else ""
            table.add_row(
                f"{name} - {other.name}",
                f"{distance.rms_m * 1e3:.1f}",
                f"{distance.worst_m * 1e3:.1f}",
                rate_in_words(other.unresolved),
                remark + (", as its mirror image" if other.mirrored else ""),
            )
        for part, whole in nested[:10]:
            table.add_row(
                f"{part.name} - {whole.name}", "-", "-", "-", f"{part.name} is a part of {whole.name}"
            )
        data = {
            "layouts": len(enrolled),
            "registry_version": version,
            "pairs": [
                {
                    "a": name,
                    "b": other.name,
                    "rms_m": other.distance.rms_m,
                    "worst_m": other.distance.worst_m,
                    "confusion_rate": other.unresolved,
                    "confusable": other.confusable,
                    "mirrored": other.mirrored,
                }
                for name, other in pairs
            ],
            "damaged_versions": [change.version for change in lost],
            "nested": [{"part": part.name, "of": whole.name} for part, whole in nested],
        }
        if nested:
            remarks.append(
                f"{counted(len(nested), 'layout')} inside a larger one. This is allowed: the reader counts "
                "reflectors. But if the larger one loses a reflector, the smaller one may be named; avoid "
                "such pairs on objects that could be mixed up."
            )
        if not pairs and not nested:
            return Result(
                "layouts check",
                data,
                messages=tuple(remarks),
                human=Text(f"{len(enrolled)} layouts, no two with the same number of reflectors"),
            )
        if not bad:
            return Result("layouts check", data, table, messages=tuple(remarks))
        error = LayoutConflictError(
            f"{counted(len(bad), 'pair')} of layouts could be confused: they leave more readings "
            "without a name than enrolling allows",
            "Remove one of each pair with `tagid layouts --remove NAME`, or move a reflector.",
        )
        return Result.from_error("layouts check", error, data, table, tuple(remarks))
