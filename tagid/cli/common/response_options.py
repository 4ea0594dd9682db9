"""Options of `tagid simulate` and `tagid emulate p440` for an object from a response file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.errors import UsageError

if TYPE_CHECKING:
    from tagid.simulate.response_files import ResponseFiles

ResponseFile = Annotated[
    Path | None,
    typer.Option("--response", help="Response file of the object, instead of a scene (docs/responses.md)."),
]
Polarisation = Annotated[
    str | None, typer.Option("--polarisation", help="With --response: V (default) or H.")
]
SnrReference = Annotated[
    Path | None,
    typer.Option("--snr-reference", help="With --response: response whose peak --snr refers to."),
]
SnrReferenceBody = Annotated[
    Path | None,
    typer.Option("--snr-reference-body", help="Response subtracted from --snr-reference."),
]


def check_scene_options(instead: str, why: str, given: Mapping[str, bool]) -> None:
    """Refuse options of a scene beside the option that replaces it.

    Args:
        instead: that option.
        why: what it brings with it.
        given: for each option of a scene, whether the command line has it.

    Raises UsageError, which names those that were given.
    """
    names = [name for name, there in given.items() if there]
    if names:
        listed = ", ".join(names[:-1]) + " and " * (len(names) > 1) + names[-1]
        raise UsageError(
            f"{listed} cannot be combined with {instead}",
            f"Omit {'them' if len(names) > 1 else 'it'}: {why}.",
        )


def check_with_response(given: Mapping[str, bool]) -> None:
    """Refuse options of a scene beside --response. Raises UsageError, which names those that were given."""
    check_scene_options("--response", "a response file contains the complete object", given)


def response_files(
    response: Path | None, polarisation: str | None, reference: Path | None, body: Path | None
) -> ResponseFiles | None:
    """The files of these options, None without --response.

    Raises UsageError if one of the others is given without it.
    """
    if response is not None:
        from tagid.simulate.response_files import ResponseFiles

        return ResponseFiles(response, (polarisation or "V").upper(), reference, body)
    if polarisation is not None or reference is not None or body is not None:
        raise UsageError(
            "--polarisation, --snr-reference and --snr-reference-body need --response",
            "Add --response FILE.",
        )
    return None
