"""Settings common to all items of a batch, and the fingerprint of those settings.

Workers on other computers receive exactly this value, and `--resume` compares its fingerprint.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from tagid._version import __version__
from tagid.models_store import manifest
from tagid.operate.turn import ReadingSetup
from tagid.report.records import ItemRecord, Thumbnails
from tagid.tags.bodies.signature_file import to_bytes

MAX_CAPTURE_BYTES = 512 << 20
"""Largest file that a worker accepts: hours of scans. A single file must not end a batch."""


@dataclass(frozen=True, eq=False)
class Job:
    """Settings of a batch.

    Attributes:
        setup: all that an answer depends on; its imaging method also renders the page's pictures.
        pictures: whether to render them.
        known: sha256 of contents whose answer is kept from an earlier run with the same fingerprint.
    """

    setup: ReadingSetup
    pictures: bool = True
    known: frozenset[str] = field(default_factory=frozenset)

    @classmethod
    def of(cls, setup: ReadingSetup, pictures: bool = True) -> Job:
        """The job of a setup; the method "auto" becomes backprojection.

        One picture by a slower method takes as long as ten identifications: use them only on request.
        """
        method = "bp" if setup.imaging.method == "auto" else setup.imaging.method
        return cls(replace(setup, imaging=replace(setup.imaging, method=method)), pictures)

    def described(self) -> dict[str, Any]:
        """Everything that an answer depends on except the capture, as plain JSON values."""
        enrolled = self.setup.enrolled
        return {
            "imaging": asdict(self.setup.imaging),
            **self.setup.loading.described(),
            "registry_version": enrolled.version,
            "layouts_sha256": _sha256([layout.to_dict() for layout in enrolled.layouts]),
            "signatures_sha256": [
                hashlib.sha256(to_bytes(signature)).hexdigest() for signature in enrolled.signatures
            ],
            "tool_version": __version__,
            "models_sha256": {name: entry.sha256 for name, entry in sorted(manifest().items())},
            "pictures": self.pictures,
        }

    def fingerprint(self) -> str:
        """sha256 of `described`."""
        return _sha256(self.described())


@dataclass(frozen=True)
class Answered:
    """An item that was processed: its record, its small pictures, and the processor time used, s."""

    record: ItemRecord
    pictures: Thumbnails = field(default_factory=Thumbnails)
    cpu_s: float = 0.0


@dataclass(frozen=True)
class Known:
    """An item whose answer an earlier run has left: sha256 of its file in hex, and the processor time used,
    s.
    """

    content_sha256: str
    cpu_s: float = 0.0


Outcome = Answered | Known
"""Result of one item."""


def _sha256(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
