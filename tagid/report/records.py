"""An item of a report: the identification of a file, with its content, its time and the expected answer.

An item is stored and sent as one JSON document (`items.jsonl`, docs/reporting.md). This is the only place
that spells the document's keys to read them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, Literal, NamedTuple, TypeVar

from tagid.pipeline.identify import WHOLE_TURN

_T = TypeVar("_T")
CAVEATS = {"part_of_a_turn": "part of a turn", "no_bound": "no bound"}
"""Marks of an answer that is worth less than its status says, in words."""


class Verdict(NamedTuple):
    """Why an item is not a passed test case, an error if it could not be read; the reason in one sentence."""

    kind: Literal["error", "failure"]
    reason: str


class _Member(Generic[_T]):
    """A member of a record's document; None where the document lacks it."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, record: ItemRecord, owner: type) -> _T:
        return record.document.get(self._name)  # type: ignore[return-value]


@dataclass(frozen=True)
class ItemRecord:
    """The document of one item, with typed access to what totals, tables and pages use.

    Attributes:
        document: plain JSON values in the order in which they are written.
        file: name of the file, as in the inputs.
        content_sha256: hex sha256 of the file; None if it could not be read.
        capture_uuid: UUID of the capture; None if it could not be read.
        status: "identified", "unknown", "ambiguous", "no_tag" or "failed".
        layout: name of the layout; None unless identified.
        label: readable name of the object; empty if there is none.
        score, margin: of the answer, as in the contract's Identification.
        reason: why the object was not named; empty if it was.
        coverage: share of a turn from which the object was seen, 0 to 1; None if unknown.
        recorded_utc: time of the recording, ISO 8601; None if the file does not tell it.
        expected: the manifest's answer; None if it does not name the file, or before `judged`.
        correct: whether the answer is the expected one; None if nothing is expected.
        copy_of: name of an earlier item with the same content; None if there is none, or before `judged`.
    """

    document: Mapping[str, Any]
    file = _Member[str]()
    content_sha256 = _Member[str | None]()
    capture_uuid = _Member[str | None]()
    status = _Member[str]()
    layout = _Member[str | None]()
    label = _Member[str]()
    score = _Member[float]()
    margin = _Member[float]()
    reason = _Member[str]()
    coverage = _Member[float | None]()
    recorded_utc = _Member[str | None]()
    expected = _Member[str | None]()
    correct = _Member[bool | None]()
    copy_of = _Member[str | None]()

    @classmethod
    def from_json(cls, text: str) -> ItemRecord:
        """A record from the text of `to_json`."""
        return cls(json.loads(text))

    def to_json(self) -> str:
        """The document on one line. Raises ValueError for a number that JSON lacks."""
        return json.dumps(dict(self.document), allow_nan=False)

    @property
    def answer(self) -> str:
        """The answer as one word: the layout if identified, else the status."""
        return str(self.layout if self.status == "identified" else self.status)

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
    def recording_note(self) -> str:
        """The operator's note of the recording; empty if there is none."""
        return str(self.document.get("recording_note") or "")

    @property
    def why(self) -> str:
        """Likely causes, reason and notes in one line; empty if there is nothing to say."""
        causes = [f"likely cause: {text}" for text in self._causes_beside_the_reason]
        return "; ".join(filter(None, (*causes, self.reason, self.note)))

    @property
    def _causes_beside_the_reason(self) -> list[str]:
        return [cause["text"] for cause in self.causes if cause["code"] != self.document.get("reason_code")]

    def explained(self) -> list[tuple[str, str]]:
        """What qualifies the answer, as (name, text) in the order of a person's questions."""
        causes = [("likely cause", text) for text in self._causes_beside_the_reason]
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
    def total_s(self) -> float:
        return round(float(sum(self.document["seconds"].values())), 4)

    @property
    def error(self) -> Mapping[str, str]:
        """The error of a failed item, {code, message, remedy}; empty for others."""
        return self.document.get("error") or {}

    def judged(self, expected: str | None, copy_of: str | None = None) -> ItemRecord:
        """The record with the manifest's answer, whether it was given, and the item of the same content."""
        correct = None if expected is None else self.answer == expected
        more = {"expected": expected, "correct": correct, "copy_of": copy_of}
        return ItemRecord({**self.document, **more})

    def renamed(self, name: str) -> ItemRecord:
        """The record of the same content in a file of another name, which its error then names, too."""
        error = self.error
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
class Thumbnails:
    """The pictures of one item, PNG, and what the page draws around them; empty if there are none.

    The drawing holds plain JSON values as `draw_pictures` makes them.
    """

    image: bytes = b""
    sinogram: bytes = b""
    drawing: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class StoredItem:
    """One item as the report's working file holds it: its position among the inputs, from 0, its record, the
    drawing of its `Thumbnails`, and their size, bytes; 0 if it has none.
    """

    position: int
    record: ItemRecord
    drawing: Mapping[str, Any]
    picture_bytes: int
