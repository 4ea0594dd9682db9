"""An item of a report: the identification of a file, with its content, its time and the expected answer.

An item is stored and sent as one JSON document (`items.jsonl`, docs/reporting.md). This is the only place
that spells the document's keys to read them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

from tagid.pipeline.identify import WHOLE_TURN

CAVEATS = {"part_of_a_turn": "part of a turn", "no_bound": "no bound"}
"""Marks of an answer that is worth less than its status says, in words."""


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
    def coverage(self) -> float | None:
        """Share of a turn from which the object was seen, 0 to 1; None if unknown."""
        value: float | None = self.document.get("coverage")
        return value

    @property
    def p_value(self) -> float | None:
        """The false-accept bound; None if no calibration applies."""
        bound = self.document.get("bound") or {}
        value: float | None = bound.get("p_value")
        return value

    @property
    def caveats(self) -> list[str]:
        """Keys of `CAVEATS` that apply."""
        partial = self.coverage is not None and self.coverage < WHOLE_TURN
        unbounded = self.status == "identified" and self.p_value is None
        return [name for name, applies in zip(CAVEATS, (partial, unbounded), strict=True) if applies]

    @property
    def causes(self) -> list[Mapping[str, str]]:
        """Likely causes, {code, text, remedy} each, most certain first; empty if something was named."""
        return list(self.document.get("causes") or ())

    @property
    def note(self) -> str:
        """What the reader and the recording add to the answer, in sentences; empty if nothing."""
        return "; ".join(filter(None, (self.document.get("note"), *self.document.get("remarks", ()))))

    @property
    def what_to_do(self) -> list[str]:
        """Remedies, the most likely one first; empty if something was named."""
        remedies = [cause["remedy"] for cause in self.causes]
        if all(cause["code"] != self.document.get("reason_code") for cause in self.causes):
            remedies.append(str(self.document.get("advice", "")))
        return [remedy for remedy in remedies if remedy]

    @property
    def recorded_utc(self) -> str | None:
        """Time of the recording, ISO 8601; None if the file does not tell it."""
        value: str | None = self.document.get("recorded_utc")
        return value

    @property
    def recording_note(self) -> str:
        """The operator's note of the recording; empty if there is none."""
        return str(self.document.get("recording_note") or "")

    @property
    def copy_of(self) -> str | None:
        """Name of an earlier item with the same content; None if there is none, or before `judged`."""
        value: str | None = self.document.get("copy_of")
        return value

    @property
    def why(self) -> str:
        """Likely causes, reason and notes in one line; empty if there is nothing to say."""
        causes = [f"likely cause: {cause['text']}" for cause in self.causes]
        return "; ".join(filter(None, (*causes, self.reason, self.note)))

    def explained(self) -> list[tuple[str, str]]:
        """What qualifies the answer, as (name, text) in the order of a person's questions."""
        causes = [("likely cause", cause["text"]) for cause in self.causes]
        remedies = [("what to do", remedy) for remedy in self.what_to_do]
        why = ("why", self.reason)
        lines = [*causes, *remedies, why] if causes else [why, *remedies]
        lines.append(("note", self.note))
        lines += [("turn", self._turn_words()), ("false accept", self._bound_words())]
        lines += [("recorded", _utc(self.recorded_utc)), ("note of the recording", self.recording_note)]
        lines.append(("copy of", self.copy_of or ""))
        return [(name, text) for name, text in lines if text]

    def _turn_words(self) -> str:
        if self.coverage is None:
            return ""
        share = f"{100 * self.coverage:.0f} % seen"
        return f"part of a turn: {share}" if "part_of_a_turn" in self.caveats else share

    def _bound_words(self) -> str:
        bound = self.document.get("bound")
        if bound is not None:
            return (
                f"at most {bound['p_value']:.2g}, from {bound['calibration_objects']} calibration objects "
                f"({bound['stratum']}): {bound['population']}"
            )
        if "no_bound" not in self.caveats:
            return ""
        if "part_of_a_turn" in self.caveats:
            return "no bound: it holds for whole turns"
        return "no bound: answers of this kind are not calibrated"

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

    def judged(self, expected: str | None, copy_of: str | None = None) -> ItemRecord:
        """The record with the manifest's answer, whether it was given, and the item of the same content."""
        correct = None if expected is None else self.answer == expected
        more = {"expected": expected, "correct": correct, "copy_of": copy_of}
        return ItemRecord({**self.document, **more})

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


def qualified(summary: Mapping[str, Any]) -> str:
    """What qualifies the totals of summary.json, in words; empty if nothing does.

    >>> qualified({"caveats": {"part_of_a_turn": 2, "no_bound": 1}, "copies": 1})
    '2 of a part of a turn, 1 named without a bound on false accept, 1 copy not counted'
    """
    copies = summary["copies"]
    parts = (
        (summary["caveats"]["part_of_a_turn"], "of a part of a turn"),
        (summary["caveats"]["no_bound"], "named without a bound on false accept"),
        (copies, "copy not counted" if copies == 1 else "copies not counted"),
    )
    return ", ".join(f"{count} {words}" for count, words in parts if count)


def _utc(time: str | None) -> str:
    return f"{time[:19].replace('T', ' ')} UTC" if time else ""


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
