"""The report as one self-contained HTML file: totals, a table to sort and filter, pictures.

It is written in pieces with a size budget for pictures, so that a page of ten thousand captures still opens.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tagid.counting import counted
from tagid.errors import UsageError
from tagid.files import replacing_text
from tagid.report.records import CAVEATS, ItemRecord, StoredItem, qualified
from tagid.report.thumbnails import smaller

if TYPE_CHECKING:
    from markupsafe import Markup

SMALL_SIDE = 32
SMALL_BYTES = 900
"""Approximate size of a picture reduced to `SMALL_SIDE` px."""
_FULL_SHARE = 0.75
"""Part of the budget for pictures in full size; the rest is for small ones."""
_BASE64 = 4 / 3
_SHOWN_MISSES = 500
_NOT_SHOWN = (
    "schema", "schema_version", "hypothesis", "hypotheses", "nearest", "error",
    "reason", "reason_code", "advice", "causes", "note", "remarks", "bound", "coverage",
    "recorded_utc", "recording_note", "copy_of", "correct",
)  # fmt: skip
"""Fields of a record that no details of the page read: what they say is explained in words."""


@dataclass(frozen=True)
class PageSettings:
    """Title of the page, size limit of all pictures together, MB, and a remark on the selection of the
    items.
    """

    title: str = "Radar tag identification"
    megabytes: float = 32.0
    note: str = ""

    def __post_init__(self) -> None:
        if not 0 <= self.megabytes <= 1000:
            raise UsageError(f"the picture limit of the page is {self.megabytes} MB", "Give 0 to 1000 MB.")


Items = Callable[[], Iterator[StoredItem]]
Pictures = Callable[[int], tuple[bytes, bytes]]


def write_page(
    path: Path, items: Items, pictures: Pictures, summary: Mapping[str, Any], settings: PageSettings
) -> None:
    """Write report.html atomically.

    Args:
        items: gives all items in the order of the inputs, their records with expected answers; called often.
        pictures: gives image and sinogram, PNG, of the item at a position.
        summary: content of summary.json.

    Raises StorageError, DiskFullError.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    folder = resources.files("tagid.report") / "page_files"
    with resources.as_file(folder) as place:
        environment = Environment(
            loader=FileSystemLoader(place),
            autoescape=True,
            undefined=StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        environment.filters |= {"number": _number, "percent": _percent, "counted": counted}
        environment.filters |= {"name": _name, "words": _words}
        template = environment.get_template("report.html.j2")
        style, script = ((place / name).read_text("utf-8") for name in ("page.css", "page.js"))
    content = _Content(items, pictures, settings)
    pieces = template.generate(
        summary=summary,
        settings=settings,
        content=content,
        style=_verbatim(style),
        script=_verbatim(script),
        style_hash=_hash(style),
        script_hash=_hash(script),
        shown_misses=_SHOWN_MISSES,
        caveats=CAVEATS,
        qualified=qualified(summary),
    )
    with replacing_text(path) as file:
        for piece in pieces:
            file.write(piece)


class _Content:
    """The generators used by the template."""

    def __init__(self, items: Items, pictures: Pictures, settings: PageSettings) -> None:
        self._items, self._pictures = items, pictures
        self._size = _allot(items, settings.megabytes)
        self.left_out = sum(1 for size in self._size.values() if size == 0)
        self.small = sum(1 for size in self._size.values() if size == 1)

    def rows(self) -> Iterator[Markup]:
        """The table's cells of each item, in the order that page.js expects."""
        from jinja2.utils import htmlsafe_json_dumps

        for item in self._items():
            r = item.record
            who = item.position, r.file, r.status, r.layout or "", r.label
            bound = r.p_value if r.status == "identified" else None
            worth = round(r.score, 4), r.coverage, bound, r.caveats, r.copy_of or ""
            recording = (r.recorded_utc or "")[:16].replace("T", " "), r.recording_note
            words = r.why.removeprefix(f"{r.file}: "), next(iter(r.what_to_do), "")
            size = self._size.get(item.position, -1)
            yield htmlsafe_json_dumps([*who, *worth, *recording, *words, r.expected, r.correct, size])

    def details(self) -> Iterator[tuple[int, Markup]]:
        """The details of each item: its record, what qualifies it in words, and drawing data."""
        from jinja2.utils import htmlsafe_json_dumps

        for item in self._items():
            more = {"drawing": item.drawing, "explained": item.record.explained()}
            shown = {name: value for name, value in item.record.document.items() if name not in _NOT_SHOWN}
            yield item.position, htmlsafe_json_dumps({**shown, **more})

    def pictures(self) -> Iterator[tuple[int, str, str]]:
        """(position, image, sinogram) in base64; without those over budget."""
        for position, size in self._size.items():
            if size == 0:
                continue
            image, sinogram = self._pictures(position)
            if size == 1:
                image, sinogram = smaller(image, SMALL_SIDE), b""
            yield position, base64.b64encode(image).decode(), base64.b64encode(sinogram).decode()


def _allot(items: Items, megabytes: float) -> dict[int, int]:
    """Position -> 2 full pictures, 1 a small one, 0 none, by expected interest; only those that
    have pictures."""
    wanted = sorted(
        (_interest(item.record), item.position, item.picture_bytes) for item in items() if item.picture_bytes
    )
    budget = megabytes * 1e6
    total = sum(size * _BASE64 for _, _, size in wanted)
    full = budget if total <= budget else budget * _FULL_SHARE
    used = 0.0
    allotted: dict[int, int] = {}
    for _, position, size in wanted:
        need = size * _BASE64
        if used + need <= full:
            allotted[position] = 2
        elif used + (need := SMALL_BYTES * _BASE64) <= budget:
            allotted[position], full = 1, 0.0
        else:
            allotted[position], need = 0, 0.0
        used += need
    return allotted


def _interest(record: ItemRecord) -> tuple[int, float]:
    """Sort key, most interesting first: misses, then unidentified items, then narrow decisions."""
    if record.correct is False:
        return 0, record.margin
    return (2 if record.status == "identified" else 1), record.margin


def _verbatim(text: str) -> Markup:
    """A package file for a style or script element, unchanged."""
    from markupsafe import Markup

    return Markup(text)


def _hash(text: str) -> str:
    """Hash source of an inline style or script for a content security policy (W3C CSP 3, section 2.3.1)."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:,.{digits}f}".replace(",", "\u202f")


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f}\u202f%"


def _name(setting: str) -> str:
    """A setting's name in words, its unit after a comma."""
    words, _, unit = setting.rpartition("_")
    if words and unit in ("m", "hz", "deg", "db", "s"):
        return f"{words.replace('_', ' ')}, {unit}"
    return setting.replace("_", " ")


def _words(value: object) -> str:
    """A setting's value as a person reads it.

    >>> _words(None), _words(False), _words({"preset": "field", "extent_m": [0.5, None]})
    ('not set', 'no', 'preset: field; extent, m: 0.5, not set')
    """
    if value is None:
        return "not set"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Mapping):
        return "; ".join(f"{_name(name)}: {_words(part)}" for name, part in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_words, value)) or "none"
    return str(value)
