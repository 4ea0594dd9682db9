"""`tagid bodies`: enrolled bodies and the signatures of enrolled objects: list, draw, check, remove."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid.cli import enrolling
from tagid.cli.frame import Terminal, command
from tagid.cli.outputs import check_drawing
from tagid.counting import counted
from tagid.errors import LayoutConflictError
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.result import Drawn
    from tagid.tags.bodies.signature import Signature


@command("bodies", is_group=True)
def bodies(terminal: Terminal, remove: Annotated[str | None, typer.Option(hidden=True)] = None) -> Result:
    """List, draw and check enrolled bodies and objects; without a command, list them.

    Example: tagid bodies
    """
    from tagid.operate.workplace import open_registry
    from tagid.report.table import Table

    if remove:  # until 0.3: `bodies remove`
        return _removed("bodies", remove)
    registry = open_registry()
    contents = registry.contents()
    table = Table("kind", "name", "radius mm", "turning dB", "error %", "captures", "label")
    for signature in contents.signatures:
        facts = _facts(signature)
        table.add_row(
            signature.kind,
            signature.name,
            f"{signature.radius_m * 1e3:.0f}",
            _db(facts["turning_share"]),
            f"{signature.model_error * 100:.2f}",
            str(signature.captures),
            signature.label,
        )
    data = {
        "registry": str(registry.path),
        "registry_version": contents.version,
        "signatures": [_facts(signature) for signature in contents.signatures],
    }
    empty = "nothing is enrolled; see `tagid enroll --body NAME FILES`"
    return Result("bodies", data, table if contents.signatures else empty)


@command("bodies remove")
def remove(
    terminal: Terminal,
    name: Annotated[str, typer.Argument(help="Name of the body.")],
    yes: enrolling.Yes = False,
) -> Result:
    """Remove a body; its history is kept, and `tagid layouts undo` restores it.

    Example: tagid bodies remove mug
    """
    enrolling.agree(terminal, f"Tags on {name} will be read without its echo.", f"Remove {name}?", yes)
    return _removed("bodies remove", name)


def _removed(command: str, name: str) -> Result:
    from tagid.operate.workplace import open_registry

    version = open_registry().remove_signature("body", name, "tagid bodies remove")
    line = f"{name} removed; its history is kept (registry version {version})"
    return Result(command, {"removed": name, "registry_version": version}, line)


@command("bodies show")
def show(
    terminal: Terminal,
    name: Annotated[str, typer.Argument(help="Name of the body or object.")],
    of_object: Annotated[
        bool, typer.Option("--object", help="The signature of the tagged object of that name.")
    ] = False,
    png: Annotated[Path | None, typer.Option(help="Write a polar plot of the echo.")] = None,
) -> Result:
    """Show a body's or object's signature.

    Example: tagid bodies show mug --png mug.png
    """
    from tagid.files import write_bytes
    from tagid.operate.workplace import open_registry

    check_drawing("--png", png, (".png",))
    signature = open_registry().signature("object" if of_object else "body", name)
    if png is not None:
        from tagid.report.signature_plot import to_png

        write_bytes(png, to_png(signature))
    facts = _facts(signature)
    lines = [
        f"{signature.kind} {signature.name}  {signature.label}",
        f"  measured on {signature.captures} captures, {signature.distance_m:.2f} m from the axis, "
        f"{signature.frequencies_hz[0] / 1e9:.1f} to {signature.frequencies_hz[-1] / 1e9:.1f} GHz",
        f"  radius {signature.radius_m * 1e3:.0f} mm, {signature.order} harmonics; angle-dependent echo "
        f"{_db(facts['turning_share'])} dB relative to the total",
        f"  a tag on it must return more than {_db(facts['least_tag'])} dB of the body's echo",
    ]
    lines += [f"written  {png}"] if png else []
    data = {"signature": facts, "png": str(png) if png else None}
    return Result("bodies show", data, "\n".join(lines))


@command("bodies check")
def check(terminal: Terminal) -> Result:
    """Compare all enrolled bodies, and all enrolled objects, with each other.

    Example: tagid bodies check
    """
    from tagid.operate.workplace import open_registry
    from tagid.report.table import Table
    from tagid.tags.bodies.likeness import compare

    contents = open_registry().contents()
    pairs = [compare(a, b) for a, b in combinations(contents.signatures, 2) if a.kind == b.kind]
    pairs.sort(key=lambda pair: pair.difference)
    table = Table("kind", "pair", "apart %", "remark")
    for pair in pairs:
        remark = "ALIKE" if pair.alike else ""
        table.add_row(pair.kind, f"{pair.first} - {pair.second}", f"{pair.difference * 100:.1f}", remark)
    of_kind = [signature for signature in contents.signatures if signature.kind == "body"]
    lines = [
        f"{body.name}: a tag must return more than {_db(_facts(body)['least_tag'])} dB of its echo"
        for body in of_kind
    ]
    data = {
        "registry_version": contents.version,
        "pairs": [
            {"kind": p.kind, "first": p.first, "second": p.second, "apart": p.difference, "alike": p.alike}
            for p in pairs
        ],
        "signatures": [_facts(signature) for signature in contents.signatures],
    }
    bad = [pair for pair in pairs if pair.alike and pair.kind == "object"]
    same = [pair for pair in pairs if pair.alike and pair.kind == "body"]
    notes = tuple(
        f"the bodies {p.first} and {p.second} are similar: a tag on one may be read as on the other"
        for p in same
    )
    human: list[Drawn] = [table, *lines]
    if not bad:
        return Result("bodies check", data, human, messages=notes)
    error = LayoutConflictError(
        f"{counted(len(bad), 'pair')} of enrolled objects cannot be distinguished: "
        + ", ".join(f"{p.first} and {p.second}" for p in bad),
        "Remove one of each pair with `tagid layouts remove NAME`, or change its tag.",
    )
    return Result.from_error("bodies check", error, data, human, notes)


def _facts(signature: Signature) -> dict[str, Any]:
    from tagid.tags.bodies.likeness import least_tag

    return {
        "kind": signature.kind,
        "name": signature.name,
        "label": signature.label,
        "radius_m": signature.radius_m,
        "harmonics": signature.order,
        "frequencies_hz": [round(float(f)) for f in signature.frequencies_hz],
        "axis_distance_m": signature.distance_m,
        "antenna_height_m": signature.height_m,
        "captures": signature.captures,
        "model_error": signature.model_error,
        "noise_share": signature.noise_share,
        "turning_share": signature.turning_share,
        "least_tag": least_tag(signature),
    }


def _db(ratio: float) -> str:
    """A ratio of energies in dB; below -60 dB it is not shown."""
    from math import log10

    return f"{10 * log10(ratio):.0f}" if ratio > 1e-6 else "under -60"
