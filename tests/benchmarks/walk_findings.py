"""The 38 findings of the first walk, each with what must be printed or shown for it to be gone."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from tests.benchmarks.walk_steps import Step

Checks = Callable[["Seen"], Iterator[bool]]
LONG_SUCCESS = 5
"""Lines of an answer that names an object, with the places of its files."""


class Seen:
    """The steps of a whole walk by their keys; the text of one that was not done is empty."""

    def __init__(self, steps: list[Step]) -> None:
        self.steps = {step.key: step for step in steps}

    def __getitem__(self, key: str) -> str:
        return self.steps[key].text if key in self.steps else ""

    def flat(self, key: str) -> str:
        """The text in one line."""
        return " ".join(self[key].split())

    def code(self, key: str) -> int | None:
        """The exit code."""
        return self.steps[key].code if key in self.steps else None

    def data(self, key: str) -> dict[str, Any]:
        """The JSON document that was printed; empty where there is none."""
        start = self[key].find("{")
        if start < 0:
            return {}
        document, _ = json.JSONDecoder().raw_decode(self[key], start)
        return dict(document.get("data") or {})


@dataclass(frozen=True)
class Finding:
    """One finding of the first walk.

    Attributes:
        number: of the finding.
        what, before: what was tried, and what came of it at e61f330.
        how: what the check looks at; "by hand" where no script can.
        checks: what holds where the finding is gone.
        left: what is left of one that is gone in part.
    """

    number: str
    what: str
    before: str
    how: str
    checks: Checks
    left: str = ""

    def state(self, seen: Seen) -> str:
        """Whether it is gone, there, or gone in part."""
        held = list(self.checks(seen))
        if not held:
            return "by hand"
        if all(held):
            return "gone"
        return f"in part: {self.left}".removesuffix(": ") if any(held) else "there"


FINDINGS: list[Finding] = []


def finding(number: str, what: str, before: str, how: str, left: str = "") -> Callable[[Checks], Checks]:
    """Add a finding with its checks."""

    def add(checks: Checks) -> Checks:
        FINDINGS.append(Finding(number, what, before, how, checks, left))
        return checks

    return add


ROUND = "it is not round"


@finding(
    "H1",
    "a tag that is not enrolled",
    '"Enroll the body: it is not round"',
    "`identify` of four bare reflectors; the page",
)
def _(seen: Seen) -> Iterator[bool]:
    for text in (seen.flat("unenrolled"), seen.flat("refused")):
        yield ROUND not in text and "nroll the tag" in text
    yield "4 reflectors" in seen.flat("unenrolled") and "not enrolled" in seen.flat("unenrolled")


@finding(
    "H2",
    "a part of a turn in a scan and a report",
    "named, caveat hidden by -q and in the report",
    "`scan -q --max-seconds 5`, `report`",
)
def _(seen: Seen) -> Iterator[bool]:
    yield seen.code("half") == 3 and "of 360 degrees" in seen.flat("half")
    yield "coverage" in seen["items"] and "bound" in seen["items"] and "part of a turn" in seen["page"]


@finding(
    "H3",
    "a station without a radar",
    '"Ready", "connected"; a failure stays 40 s',
    "the page before and after the radar is there",
)
def _(seen: Seen) -> Iterator[bool]:
    yield "No radar" in seen["no-radar"] and "no radar" in seen["no-radar"]
    yield (
        "Ready" in seen["radar-back"]
        and "radar ok" in seen["radar-back"]
        and seen.steps["radar-back"].seconds < 20
    )


@finding(
    "H4",
    "a report over entries of other folders",
    "drops them without a word",
    "the page: report over all entries",
)
def _(seen: Seen) -> Iterator[bool]:
    yield "left out" in seen["report-page"]


@finding(
    "H5",
    "a wrong speed",
    '"Enroll the body", "every reflector in place"',
    "`scan --motion 'free?rpm=12'` at 6 rpm",
)
def _(seen: Seen) -> Iterator[bool]:
    text = seen.flat("rpm-12")
    yield ROUND not in text and ("6 rpm" in text or "speed" in text or "free" in text)


@finding(
    "H6",
    "an object with a body off the axis",
    '"Enroll the body: it is not round"',
    "`identify`: 20 and 30 mm off the axis",
)
def _(seen: Seen) -> Iterator[bool]:
    for key in ("off-helmet", "off-can"):
        text = seen.flat(key)
        yield ROUND not in text and (seen.code(key) == 0 or "axis" in text)


@finding(
    "H7",
    "an axis distance 10 cm wrong",
    "the cause between contradictions, an option that does not exist",
    "`scan --axis-distance 1.1`, then `identify`",
    "the tag is named, but nothing says that the distance is wrong",
)
def _(seen: Seen) -> Iterator[bool]:
    text = seen.flat("axis-10cm")
    yield "likely cause" in text or "MINE-01" in text
    yield "--axis-search" not in text and "do not determine" not in text
    yield "axis distance" in text
    yield "MINE-01" in seen["axis-again"]


@finding(
    "H8",
    "standard error of the axis distance",
    "1.4 mm where 10 mm wrong; offered for part of a turn",
    "`scan -v --until-sure`",
)
def _(seen: Seen) -> Iterator[bool]:
    text = seen.flat("axis-sure")
    found = re.search(r"(-?[\d.]+) mm from the given \(standard error ([\d.]+) mm", text)
    yield bool(text) and (found is None or abs(float(found[1])) < 2 * float(found[2]))


@finding(
    "H9", "`train export`", "overwrites the shipped network", "a training of eight scenes; models/ afterwards"
)
def _(seen: Seen) -> Iterator[bool]:
    yield seen["models"] == "changed: nothing"
    yield seen.code("dataset") == 0 and seen.code("fit") == 0


@finding("H10", "the answer of a scan", "14 lines, the name last", "`scan --demo`")
def _(seen: Seen) -> Iterator[bool]:
    lines = [line for line in seen["demo"].splitlines() if line and "━" not in line]
    yield bool(lines) and lines[0].startswith("HELMET-120") and len(lines) <= LONG_SUCCESS
    yield "at most 1 in" in seen["demo"] and "calibration objects" not in seen["demo"]


@finding(
    "M11",
    "a busy computer",
    '"this computer\'s clock was set", no answer',
    "`scan` with a robot, halted for 0.3 s",
)
def _(seen: Seen) -> Iterator[bool]:
    yield "clock was set" not in seen.flat("held") or "busy" in seen.flat("held")
    yield seen.code("held") == 0


@finding("M12", "`layouts design`", "proposes layouts that it warns of; jargon", "three designs")
def _(seen: Seen) -> Iterator[bool]:
    yield "note:" not in seen["design-8"] and "8 layouts" in seen["design-8"]
    yield "necklaces" not in seen["design-8"] and "mm apart" in seen["design-8"]
    yield "--count 18" in seen["design-500"]


@finding(
    "M13",
    "how exactly to glue",
    '"errors above 3 mm are refused"; a pair is from 0.5 mm on',
    "docs/first-tag.md",
)
def _(seen: Seen) -> Iterator[bool]:
    text = seen.flat("first-tag")
    yield "above 3 mm (RMS)" not in text and "within 1 mm of its mark" in text


@finding(
    "M14",
    "a benchmark without torch",
    "a traceback after minutes; no progress",
    "`imaging-points --quick` without torch, and for 60 s",
)
def _(seen: Seen) -> Iterator[bool]:
    yield (
        "Traceback" not in seen["no-torch"]
        and "torch" in seen["no-torch"]
        and seen.steps["no-torch"].seconds < 5
    )
    yield " of " in seen["progress"]


@finding("M15", "the paper's tables and figures", "no page names them", "docs/paper.md")
def _(seen: Seen) -> Iterator[bool]:
    yield "LPIPS" in seen["paper"] and "minutes" in seen["paper"] and "imaging-paper" in seen["paper"]


@finding(
    "M16",
    "the end of a scan on the page",
    '"No signal" after the last scan',
    "every state of the page, 20 a second",
)
def _(seen: Seen) -> Iterator[bool]:
    yield "helmet-120" in seen["scan-page"] and "No signal" not in seen["scan-page"]


@finding(
    "M17",
    "History",
    "no note, file, reason; the picture is higher than the screen",
    "the page: rows and the picture at three sizes",
)
def _(seen: Seen) -> Iterator[bool]:
    yield "newcomer 1" in seen["history-page"]
    yield ".tagid.h5" in seen["history-page"]
    yield "at no size" in seen["viewer"]


@finding("M18", "setting up from the tablet", "no settings, no echo over range", "the page: Settings, Health")
def _(seen: Seen) -> Iterator[bool]:
    yield all(
        word in seen["settings"] for word in ("Radar", "Axis distance", "Theme", "Sound", "Echo over range")
    )
    yield seen["health"].startswith("open")


@finding(
    "M19",
    "`tagid station` after `make demo`",
    "needs an extra",
    "what pyproject.toml lists for every installation",
)
def _(seen: Seen) -> Iterator[bool]:
    yield "uvicorn" in seen["needs"]


@finding(
    "M20",
    "Enroll in the demonstration",
    "the object is enrolled already; cannot be finished",
    "the page: three captures to the end",
)
def _(seen: Seen) -> Iterator[bool]:
    yield "is enrolled" in seen["enroll-done"]
    yield "Remove the capture" not in seen["enroll-page"] and "e-1" not in seen["enroll-page"]


@finding(
    "M21",
    "a report over mixed captures",
    "no reasons, copies counted, links dropped, overwritten",
    "`report`, `--resume`, `--watch`",
)
def _(seen: Seen) -> Iterator[bool]:
    yield "what_to_do" in seen["items"] and "reason" in seen["items"] and "cause" in seen["items"]
    yield "copy not counted" in seen["report"] and "does not exist" in seen["report"]
    yield seen.code("other") == 1 and seen.code("other-resume") == 1
    yield "first.tagid.h5: helmet-120" in seen["watch"] and "1 capture: 1" in seen["watch"]


@finding("M22", "an empty scene", 'physics jargon before "no tag"', "`identify` of noise")
def _(seen: Seen) -> Iterator[bool]:
    yield seen["empty"].startswith("NO TAG") and "energy lies outside" not in seen["empty"]


@finding("M23", "`tagid` alone", "an error, exit code 2", "`tagid`")
def _(seen: Seen) -> Iterator[bool]:
    yield seen.code("alone") == 0 and seen["alone"].startswith("Usage") and "error" not in seen["alone"]


@finding("M24", "80 columns", "commands and file names are cut", "`doctor`, `history`")
def _(seen: Seen) -> Iterator[bool]:
    yield "tagid-station.service " in seen["doctor"] and "…" not in seen["doctor"]
    yield ".tagid.h5" in seen["history"] and "…" not in seen["history"]


@finding(
    "L25", "`scan --live`", "403 of 360 degrees, no axes, erased at the end", "`scan --live` at a terminal"
)
def _(seen: Seen) -> Iterator[bool]:
    turned = [int(one) for one in re.findall(r"(\d+) of 360", seen["live"])]
    yield bool(turned) and max(turned) <= 360
    yield "nats" not in seen["live"]
    yield "▀" in seen["live"].rpartition("\x1b[?1049l")[2]


@finding("L26", "`scan --truth`", "the answer is not compared", "`scan --truth`")
def _(seen: Seen) -> Iterator[bool]:
    yield "named rightly" in seen["truth"]


@finding("L27", "the command line", "nine inconsistencies", "six lines that failed")
def _(seen: Seen) -> Iterator[bool]:
    for key in ("simulate-scene", "remove", "undo-y", "show", "unit"):
        yield seen.code(key) == 0
    yield "No such option" not in seen["negative"] and "in this range" in seen["negative"]


@finding("L28", "slips of the pen", 'no "did you mean"', "three slips, and `identify` of an image")
def _(seen: Seen) -> Iterator[bool]:
    for key in ("mistyped", "layout-name", "setting-name"):
        yield "Did you mean" in seen[key]
    yield "is an image" in seen.flat("image") and ".tagid.h5" in seen.flat("image")


@finding("L29", "`train fit`", "does not know its data set", "`train fit --work W`")
def _(seen: Seen) -> Iterator[bool]:
    yield seen.code("fit") == 0


@finding(
    "L30",
    "the held-out residual",
    "99.7 % for a perfect picture, without a word",
    "`reconstruct --method bp`",
)
def _(seen: Seen) -> Iterator[bool]:
    yield "neighbouring scans" in seen["bp"] and "no better than smoothness" in seen["bp"]


@finding("L31", "a volume from three heights", "copies of the tag, no warning", "`reconstruct --volume`")
def _(seen: Seen) -> Iterator[bool]:
    yield "shows again" in seen["volume"]


@finding("L32", "JSON of a name", '"probability": 0.17 of a matched reflector', "`identify --output json`")
def _(seen: Seen) -> Iterator[bool]:
    yield bool(seen.data("json")) and '"ghost"' not in seen["json"] and '"probability"' not in seen["json"]


@finding("L33", "the SNR of an object", "five different figures", "`simulate` and `show` of one capture")
def _(seen: Seen) -> Iterator[bool]:
    made, shown = (
        seen.data("snr-made").get("truth", {}).get("snr_db"),
        seen.data("snr-show").get("snr_db"),
    )
    yield made is not None and shown is not None and abs(made - shown) < 1.0


@finding(
    "L34",
    "the answer on the page",
    "the picture while turning, without circles",
    "the page: caption, and no Stop beside a name",
)
def _(seen: Seen) -> Iterator[bool]:
    yield "picture of the whole recording" in seen["scan-page"] or "circle" in seen["scan-page"]
    yield not re.search(r"^helmet-120 / Stop", seen["scan-page"], re.M)


@finding("L35", "the template", "a JPEG of 1 MB without text", "`layouts show --template`; its look by hand")
def _(seen: Seen) -> Iterator[bool]:
    size = int((seen["template-file"].split() or ["0"])[0])
    yield 0 < size < 200_000 and "fonts" in seen["template-file"]


@finding(
    "L36",
    "long pages",
    "a paragraph of 30 numbers, an API page of 3521 lines",
    "docs/results.md, docs/api.md",
)
def _(seen: Seen) -> Iterator[bool]:
    yield seen["api-page"] == "none"
    yield "| # | figure |" in seen["docs/results.md"]


@finding(
    "L37",
    "`radar calibrate` with a wrong distance; `undo`",
    'stores a delay 1 m off; "hat-9, hat-9"',
    "`radar calibrate --distance 2.00` at 1 m, `undo`",
)
def _(seen: Seen) -> Iterator[bool]:
    yield seen.code("calibrate-2") != 0 and "8470" in seen["calibrate-2"]
    yield "hat-9" in seen["undo"] and "hat-9, hat-9" not in seen["undo"] and "enroll" in seen["undo"]


@finding(
    "L38",
    "a wrong port",
    "9 s, names a port that was not asked; `doctor` names itself",
    "`scan`, `doctor`",
    "`doctor` without a configured radar warns and ends with 0",
)
def _(seen: Seen) -> Iterator[bool]:
    yield "21999" in seen["wrong-port"] and seen.steps["wrong-port"].seconds < 6
    yield "`tagid doctor`" not in seen["doctor-port"] and "21999" in seen["doctor-port"]
    yield seen.code("doctor") == 1
