"""The station's page in a headless Chromium: what an operator does there, what is shown, and pictures."""

from __future__ import annotations

import base64
import contextlib
import importlib.util
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from PIL import Image, ImageDraw, ImageFont

from tests.benchmarks.provenance import ROOT
from tests.benchmarks.walk_steps import Walk

SIZES = ("phone", "tablet", "desk")
THEMES = ("light", "dark")
ABSENT = "udp://127.0.0.1:9"
EMULATED = "emulator://helmet-120?rpm=6&seed=2&centre=0.005,-0.003&rate=1"
WATCH = """
window.seen = [];
setInterval(() => {
  const now = ["answer", "scan", "link"].map((id) => document.getElementById(id).textContent).join(" / ");
  if (window.seen.at(-1) !== now) window.seen.push(now);
}, 50);
"""
DROP = """
const bytes = Uint8Array.from(atob(arguments[0]), (one) => one.charCodeAt(0));
const files = new DataTransfer();
files.items.add(new File([bytes], "dragged.tagid.h5"));
for (const kind of ["dragenter", "dragover", "drop"])
  document.body.dispatchEvent(new DragEvent(kind, { dataTransfer: files, bubbles: true, cancelable: true }));
"""
ROW, GAP, LABEL, COLOURS = 200, 6, 92, 128
"""Height of a small picture, space around it, width of the labels (pixels), and colours of a sheet."""


def station_pictures() -> ModuleType:
    """The script of the pictures of docs/station.md, whose browser and sizes are used here."""
    path = ROOT / "docs" / "make_station_pictures.py"
    spec = importlib.util.spec_from_file_location("make_station_pictures", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@dataclass(frozen=True)
class Screen:
    """The page of a station, and where its pictures go."""

    walk: Walk
    page: Any
    shots: Path
    script: ModuleType

    def text(self, *ids: str) -> str:
        """What the elements of these names show; nothing where they are hidden or absent."""
        words = (
            "return arguments[0].map((id) => document.getElementById(id)?.innerText?.trim() || '')"
            ".filter(Boolean).join('\\n')"
        )
        return str(self.page.execute_script(words, list(ids)))

    def until(self, script: str, seconds: float = 120.0) -> bool:
        """Wait until a script is true; whether it became so in time."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if self.page.execute_script(f"return Boolean({script})"):
                return True
            time.sleep(0.1)
        return False

    def click(self, name: str) -> None:
        """Press a button."""
        self.page.execute_script("document.getElementById(arguments[0]).click()", name)

    def press_first(self, words: str) -> bool:
        """Press the first button of the history with these words; whether there is one."""
        script = (
            "const all = [...document.querySelectorAll('#history button')];"
            "const one = all.find((one) => one.textContent === arguments[0]);"
            "one?.click(); return Boolean(one)"
        )
        return bool(self.page.execute_script(script, words))

    def open(self, name: str) -> bool:
        """Show a view; whether there is one of this name."""
        self.page.execute_script(f"location.hash = '#view-{name}'")
        return self.until(f"document.body.dataset.view === '{name}'", 3)

    def pictures(self, name: str) -> None:
        """Take the screen at every size in both themes, and note where the page is wider than it."""
        wide = []
        for theme in THEMES:
            for size in SIZES:
                self.script.size(self.page, size, theme)
                time.sleep(0.15)
                self.script.take(self.page, self.shots / f"{name}+{theme}+{size}.png")
                if self.page.execute_script("return document.documentElement.scrollWidth > innerWidth"):
                    wide.append(f"{size} {theme}")
        self.script.size(self.page, "tablet", "light")
        self.walk.note(f"wide-{name}", f"{name}: width of the page", ", ".join(wide) or "fits")

    def did(self, key: str, shown: str, began: float, text: str) -> None:
        """Keep what is seen after an act on the page."""
        self.walk.note(key, shown, text, time.monotonic() - began)


@contextlib.contextmanager
def station(walk: Walk, words: str, shots: Path) -> Iterator[Screen]:
    """A station and a browser that shows its page."""
    script = station_pictures()
    with walk.background(f"station --bind 127.0.0.1:0 --output json {words}") as process:
        assert process.stdout is not None
        url = json.loads(process.stdout.readline())["data"]["url"]
        page = script.browser(str(walk.folder / f"profile-{len(walk.steps)}"))
        try:
            script.size(page, "tablet", "light")
            page.get(url)
            yield Screen(walk, page, shots, script)
        finally:
            page.quit()


def configure(walk: Walk, url: str) -> None:
    """Set the radar, as `tagid config set` does; the station reads it before every check."""
    Path(walk.environment["TAGID_CONFIG"]).write_text(
        f'[radar]\nurl = "{url}"\n[motion]\nurl = "free?rpm=6"\naxis_distance_m = 1.0\n'
    )


def at_the_station(walk: Walk, shots: Path) -> None:
    """A station without a radar that gets one, and the demonstration."""
    shots.mkdir(parents=True, exist_ok=True)
    configure(walk, ABSENT)
    with station(walk, "--save-dir first", shots) as screen:
        without_radar(walk, screen)
    Path(walk.environment["TAGID_CONFIG"]).unlink()
    elsewhere = "scan -q --radar 'emulator://helmet-120?rpm=6' --axis-distance 1.0 --motion 'free?rpm=6'"
    (walk.folder / "elsewhere").mkdir()
    walk.tagid("elsewhere", f"{elsewhere} --save-dir elsewhere")
    with station(walk, "--demo --save-dir demo", shots) as screen:
        screen.until("document.getElementById('answer').textContent === 'Ready'", 30)
        screen.page.execute_script(WATCH)
        screen.pictures("ready")
        for part in (scanned, refused, enrolled, listed, replayed, dragged, settings, rig):
            part(screen)


def without_radar(walk: Walk, screen: Screen) -> None:
    """What the page claims without a radar, and how soon it follows one."""
    began = time.monotonic()
    screen.until("document.getElementById('answer').textContent === 'No radar'", 10)
    screen.did(
        "no-radar",
        "open the page without a radar",
        began,
        screen.text("answer", "reason", "advice", "radar", "link"),
    )
    screen.pictures("no radar")
    screen.open("health")
    screen.until("!document.getElementById('wiring').hidden", 30)
    screen.pictures("health")
    screen.did(
        "wiring", "open Health without a radar", began, screen.text("wiring", "health", "health-count")
    )
    configure(walk, EMULATED)
    screen.open("scan")
    began = time.monotonic()
    screen.until(
        "document.getElementById('answer').textContent === 'Ready'"
        " && (document.getElementById('radar')?.textContent ?? 'radar ok') === 'radar ok'",
        40,
    )
    screen.did("radar-back", "connect the radar", began, screen.text("answer", "reason", "radar", "link"))
    screen.open("health")
    screen.until("document.getElementById('wiring').hidden", 30)
    fine = "document.getElementById('health-fine').closest('details').open ? 'open' : 'folded'"
    folded = str(screen.page.execute_script(f"return {fine}"))
    screen.did(
        "health", "open Health", began, f"{folded}\n{screen.text('health', 'health-count', 'health-fine')}"
    )


def scanned(screen: Screen) -> None:
    """One scan with a note."""
    began = time.monotonic()
    screen.page.execute_script("document.getElementById('note').value = 'newcomer 1'")
    screen.click("scan")
    screen.until("document.getElementById('turn').value > 0.4", 40)
    screen.pictures("turning")
    screen.until("!running")
    seen = screen.page.execute_script("return window.seen")
    words = screen.text("answer", "reason", "advice", "figures", "image-caption", "evidence-part")
    screen.did("scan-page", "Scan, in the demonstration", began, words + "\n" + "\n".join(seen))
    screen.pictures("answer")


def refused(screen: Screen) -> None:
    """A scan of the demonstration's second object, which nobody enrolled."""
    options = screen.page.execute_script(
        "return [...(document.getElementById('object')?.options ?? [])].map((one) => one.value)"
    )
    if len(options) < 2:
        screen.did("refused", "scan an object that is not enrolled", time.monotonic(), "no such object")
        return
    began = time.monotonic()
    screen.page.execute_script("document.getElementById('object').value = arguments[0]", options[1])
    screen.click("scan")
    screen.until("running", 10)
    screen.until("!running")
    screen.did(
        "refused", "scan an object that is not enrolled", began, screen.text("answer", "reason", "advice")
    )
    screen.pictures("refused")


def enrolled(screen: Screen) -> None:
    """Three captures of an object, and its enrollment."""
    began = time.monotonic()
    screen.open("enrol")
    screen.page.execute_script("document.getElementById('e-name').value = 'hat-9'")
    screen.click("e-begin")
    for number in (1, 2, 3):
        screen.until("enrolment.subject && !document.getElementById('capture').disabled && !running", 30)
        screen.click("capture")
        there = f"document.querySelectorAll('#captures li').length === {number}"
        screen.until(f"{there} && !enrolment.measuring && !running")
    screen.until("enrolment.proposal && !enrolment.measuring", 30)
    words = screen.text("instruction", "trouble", "measured-text", "nearest", "confusion", "captures")
    screen.did("enroll-page", "Enroll: three captures", began, words)
    screen.pictures("enroll")
    ready = screen.page.execute_script("return Boolean(enrolment.proposal && enrolment.proposal.ready)")
    if ready:
        screen.click("store")
    stored = screen.until("enrolment.stored", 20)
    screen.did(
        "enroll-done",
        "Enroll: to the end",
        began,
        screen.text("done-text") if stored else "cannot be finished",
    )
    if not stored:
        screen.click("cancel")
    screen.open("scan")


def listed(screen: Screen) -> None:
    """The history: its rows, filters, a picture, and a report over all entries."""
    began = time.monotonic()
    screen.open("history")
    screen.until("document.querySelectorAll('#history li').length > 2", 20)
    screen.did("history-page", "History", began, screen.text("history"))
    rows = "return document.querySelectorAll('#history li').length"
    count = screen.page.execute_script(rows)
    filter_by(screen, "f-status", "unknown")
    unknown = screen.page.execute_script(rows)
    filter_by(screen, "f-status", "")
    filter_by(screen, "f-layout", "helmet-120")
    helmets = screen.page.execute_script(rows)
    filter_by(screen, "f-layout", "")
    screen.did(
        "filter", "History: filters", began, f"{count} rows, {unknown} unknown, {helmets} of helmet-120"
    )
    screen.click("select-all")
    began = time.monotonic()
    screen.click("report")
    screen.until("report && report.complete", 180)
    screen.did(
        "report-page", "History: report over all entries", began, screen.text("report-text", "selected")
    )
    screen.pictures("history")
    below, began = [], time.monotonic()
    for size in SIZES:
        screen.script.size(screen.page, size, "light")
        screen.press_first("Picture")
        screen.until("document.getElementById('viewer').open", 5)
        time.sleep(0.5)
        bottom = "document.getElementById('viewer-close').getBoundingClientRect().bottom"
        if screen.page.execute_script(f"return {bottom} > innerHeight"):
            below.append(size)
        if size == "phone":
            screen.pictures("picture")
        screen.click("viewer-close")
    screen.did(
        "viewer", "History: a picture", began, f"Close is below the edge: {', '.join(below) or 'at no size'}"
    )
    screen.script.size(screen.page, "tablet", "light")


def filter_by(screen: Screen, name: str, value: str) -> None:
    """Set a filter of the history."""
    screen.page.execute_script(
        "const one = document.getElementById(arguments[0]); one.value = arguments[1];"
        "one.dispatchEvent(new Event('change', { bubbles: true }))",
        name,
        value,
    )
    time.sleep(1.0)


def replayed(screen: Screen) -> None:
    """A stored capture, shown as if it was recorded now."""
    began = time.monotonic()
    screen.open("history")
    there = screen.press_first("Replay")
    if there:
        screen.until("running", 10)
        screen.until("!running")
        time.sleep(0.5)
    words = screen.text("answer", "reason", "figures", "problem") if there else "no such button"
    screen.did("replay", "History: replay a capture", began, words)


def dragged(screen: Screen) -> None:
    """A capture of another folder that is dropped on the page."""
    began = time.monotonic()
    if not screen.page.execute_script("return Boolean(document.getElementById('drop'))"):
        screen.did("drag", "drag a capture into the page", began, "nothing takes it")
        return
    (capture, *_) = sorted((screen.walk.folder / "elsewhere").glob("*.tagid.h5"))
    screen.page.execute_script(DROP, base64.b64encode(capture.read_bytes()).decode())
    screen.until("running", 10)
    screen.until("!running")
    screen.did(
        "drag", "drag a capture into the page", began, screen.text("answer", "reason", "figures", "problem")
    )


def settings(screen: Screen) -> None:
    """The settings, their sounds, and the echo over range."""
    began = time.monotonic()
    if not screen.open("settings"):
        screen.did("settings", "Settings", began, "no such view")
        return
    screen.until("settings", 10)
    screen.click("s-sound-named")
    screen.click("s-sound-unknown")
    screen.click("profile-button")
    screen.until("profile && profile.scans > 60", 20)
    screen.pictures("settings")
    words = screen.text("settings-part", "profile-part", "problem")
    screen.did("settings", "Settings, sounds, echo over range", began, words)
    screen.click("profile-button")
    screen.open("health")
    screen.pictures("health, radar ok")


def rig(screen: Screen) -> None:
    """The steps of commissioning."""
    began = time.monotonic()
    if screen.open("commission"):
        time.sleep(1.0)
        screen.pictures("rig")
        screen.did("rig", "Rig", began, screen.text("commission-part"))
    else:
        screen.did("rig", "Rig", began, "no such view")


VIEWS = (
    "no radar", "health", "ready", "turning", "answer", "refused", "enroll", "history", "picture", "settings",
    "health, radar ok", "rig",
)  # fmt: skip
"""In the order of a sheet."""


def sheet(shots: Path, target: Path, title: str) -> None:
    """All pictures in one: a row for every view, both themes beside each other."""
    views = [view for view in VIEWS if (shots / f"{view}+light+phone.png").exists()]
    rows: list[list[Image.Image]] = []
    for view in views:
        row = []
        for theme in THEMES:
            for size in SIZES:
                with Image.open(shots / f"{view}+{theme}+{size}.png") as full:
                    row.append(
                        full.convert("RGB").resize(
                            (round(full.width * ROW / full.height), ROW), Image.Resampling.LANCZOS
                        )
                    )
        rows.append(row)
    width = LABEL + max(sum(one.width + GAP for one in row) for row in rows)
    whole = Image.new("RGB", (width, 26 + len(rows) * (ROW + GAP)), "#9aa0ad")
    draw = ImageDraw.Draw(whole)
    font = ImageFont.load_default(13)
    draw.text((GAP, 5), title, "black", font)
    for number, (view, row) in enumerate(zip(views, rows, strict=True)):
        top, left = 26 + number * (ROW + GAP), LABEL
        draw.multiline_text((GAP, top), view.replace(", ", ",\n"), "black", font)
        for one in row:
            whole.paste(one, (left, top))
            left += one.width + GAP
    whole.quantize(COLOURS, Image.Quantize.MAXCOVERAGE, kmeans=2, dither=Image.Dither.NONE).save(
        target, optimize=True
    )
