"""An item of a report: the identification of a file, with its content, its time and the expected answer.

An item is stored and sent as one JSON document (`items.jsonl`, docs/reporting.md). This is the only place
that spells the document's keys to read them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal


@dataclass(frozen=True)
class Verdict:
    """Why an item is not a passed test case.

    Attributes:
        kind: "error" if the item could not be read, else "failure".
        reason: one sentence.
    """

    kind: Literal["error", "failure"]
    reason: str


@dataclass(frozen=True)
class ItemRecord:
    """The document of one item, with typed access to what totals, tables and pages use.

    Attributes:
        document: plain JSON values in the order in which they are written.
    """

    document: Mapping[str, Any]

    @classmethod
    def from_json(cls, text: str) -> ItemRecord:
        """A record from the text of `to_json`."""
        return cls(json.loads(text))

    def to_json(self) -> str:
        """The document on one line. Raises ValueError for a number that JSON lacks."""
        return json.dumps(dict(self.document), allow_nan=False)

    @property
    def file(self) -> str:
        """Name of the file, as in the inputs."""
        return str(self.document["file"])

    @property
    def content_sha256(self) -> str | None:
        """Hex sha256 of the file; None if it could not be read."""
        value: str | None = self.document["content_sha256"]
        return value

    @property
    def capture_uuid(self) -> str | None:
        """UUID of the capture; None if it could not be read."""
        value: str | None = self.document["capture_uuid"]
        return value

    @property
    def model_sha256(self) -> str | None:
        """sha256 of the network that was used; None without one."""
        value: str | None = self.document["model_sha256"]
        return value

    @property
    def status(self) -> str:
        """ "identified", "unknown", "ambiguous", "no_tag" or "failed"."""
        return str(self.document["status"])

    @property
    def layout(self) -> str | None:
        """Name of the layout; None unless identified."""
        value: str | None = self.document["layout"]
        return value

    @property
    def label(self) -> str:
        """Readable name of the object; empty if there is none."""
        return str(self.document["label"])

    @property
    def answer(self) -> str:
        """The answer as one word: the layout if identified, else the status."""
        return str(self.layout if self.status == "identified" else self.status)

    @property
    def reason(self) -> str:
        """Why the object was not named; empty if it was."""
        return str(self.document["reason"])

    @property
    def score(self) -> float:
        """Score of the answer, as in the contract's Identification."""
        return float(self.document["score"])

    @property
    def margin(self) -> float:
        """Margin of the answer, as in the contract's Identification."""
        return float(self.document["margin"])

    @property
    def centre_m(self) -> tuple[float | None, float | None]:
        """Centre of the tag, m; None where nothing was named."""
        x, y = self.document["centre_m"] or (None, None)
        return x, y

    @property
    def reflectors(self) -> int:
        """Number of reflectors found."""
        return len(self.document["reflectors"])

    @property
    def error_code(self) -> str | None:
        """Code of the error of a failed item; None for others."""
        return self._error().get("code")

    @property
    def error_remedy(self) -> str | None:
        """Remedy for the error of a failed item; None for others."""
        return self._error().get("remedy")

    @property
    def expected(self) -> str | None:
        """The manifest's answer; None if it does not name the file, or before `judged`."""
        value: str | None = self.document.get("expected")
        return value

    @property
    def correct(self) -> bool | None:
        """Whether the answer is the expected one; None if nothing is expected."""
        value: bool | None = self.document.get("correct")
        return value

    @property
    def total_s(self) -> float:
        """Seconds of all stages."""
        return round(float(sum(self.document["seconds"].values())), 4)

    def stage_s(self, stage: str) -> float | None:
        """Seconds of one stage; None if the item did not reach it."""
        value: float | None = self.document["seconds"].get(stage)
        return value

    def _error(self) -> Mapping[str, str]:
        return self.document.get("error") or {}

    def judged(self, expected: str | None) -> ItemRecord:
        """The record with the manifest's answer, and whether it was given."""
        correct = None if expected is None else self.answer == expected
        return ItemRecord({**self.document, "expected": expected, "correct": correct})

    def renamed(self, name: str) -> ItemRecord:
        """The record of the same content in a file of another name, which its error then names, too."""
        error = self._error()
        if not error:
            return ItemRecord({**self.document, "file": name})
        error = {**error, "message": error["message"].replace(self.file, name)}
        return ItemRecord({**self.document, "error": error, "reason": error["message"], "file": name})

    def verdict(self) -> Verdict | None:
        """The item as a test case: None if it passes.

        It passes if the answer is the expected one or, where none is expected, if it is a name.
        """
        if self.status == "failed":
            return Verdict("error", self.reason)
        if self.expected is None:
            named = self.status == "identified"
            return None if named else Verdict("failure", f"{self.status}: {self.reason}")
        if self.correct:
            return None
        reason = f" ({self.reason})" if self.reason else ""
        return Verdict("failure", f"expected {self.expected}, found {self.answer}{reason}")


@dataclass(frozen=True)
class Drawing:
    """What the page draws around the pictures of an item.

    Attributes:
        method: imaging method of the image.
        extent_m: width of the image.
        centre_m: its centre (x, y).
        image_db, sinogram_db: dynamic range of the colours.
        layout_m: (reflectors, 2) places of the named layout's reflectors; empty if nothing is named.
        range_m: first and last range of the sinogram.
        angle_deg: first and last angle of the sinogram; None without angles.
        views: number of views.
    """

    method: str
    extent_m: float
    centre_m: list[float]
    image_db: float
    layout_m: list[list[float]]
    range_m: list[float]
    angle_deg: list[float] | None
    views: int
    sinogram_db: float

    @classmethod
    def from_json(cls, text: str) -> Drawing | None:
        """A drawing from the text of `drawing_json`."""
        values = json.loads(text)
        return cls(**values) if values else None


def drawing_json(drawing: Drawing | None) -> str:
    """A drawing as JSON; an empty object if there are no pictures."""
    return json.dumps({} if drawing is None else asdict(drawing))


@dataclass(frozen=True)
class Thumbnails:
    """The pictures of one item.

    Attributes:
        image, sinogram: PNG; empty if there is none.
        drawing: what the page draws around them; None if there are none.
    """

    image: bytes = b""
    sinogram: bytes = b""
    drawing: Drawing | None = None


@dataclass(frozen=True)
class StoredItem:
    """One item as the report's working file holds it.

    Attributes:
        position: among the inputs, from 0.
        record: its record.
        drawing: what the page draws around its pictures; None if it has none.
        picture_bytes: size of its pictures; 0 if it has none.
    """

    position: int
    record: ItemRecord
    drawing: Drawing | None
    picture_bytes: int
