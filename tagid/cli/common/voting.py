"""Output of a joint answer from several recordings, with the answer of each recording."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from tagid.counting import counted

if TYPE_CHECKING:
    from rich.console import RenderableType

    from tagid.pipeline.answer import Identification


def joint_item(
    joint: Identification, files: Sequence[str], alone: Sequence[Identification]
) -> dict[str, Any]:
    """The joint Identification as an item, with `votes`: file, status, layout, score and margin of each."""
    votes = [
        {
            "file": file,
            "capture_uuid": one.capture_uuid,
            "status": one.status,
            "layout": one.reading.layout if one.reading else None,
            "score": one.reading.score if one.reading else 0.0,
            "margin": one.reading.margin if one.reading else 0.0,
        }
        for file, one in zip(files, alone, strict=True)
    ]
    return {"file": files[0], **joint.to_dict(), "votes": votes}


def joint_text(
    joint: Identification, files: Sequence[str], alone: Sequence[Identification]
) -> RenderableType:
    """The joint answer as text, with one line per recording."""
    from rich.console import Group
    from rich.text import Text

    from tagid.cli.common import imaging

    lines = [Text(f"  {file}: {imaging.headline(one)}") for file, one in zip(files, alone, strict=True)]
    return Group(imaging.describe(joint, f"from {counted(len(alone), 'recording')}"), *lines)
