"""The page in a real browser: it sorts, filters, opens images, and takes nothing it shows for markup."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import size, start, theme, wait
from PIL import Image
from report_batches import a_job, copy_captures, in_this_process, part_of_a_turn

from tagid.batch.expected import read_manifest
from tagid.batch.inputs import collect
from tagid.batch.run import BatchPlan, run_batch
from tagid.report.page import PageSettings, write_page
from tagid.report.records import ItemRecord, StoredItem

pytest.importorskip("selenium.webdriver")
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select

HOSTILE = "<script>document.title='taken'<\u2215script><img src=x onerror=alert(1)> & \"quotes\".tagid.h5"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    started = start(tmp_path_factory.mktemp("profile"))
    yield started
    started.quit()


@pytest.fixture
def show(browser: Any) -> Iterator[Callable[..., Any]]:
    """Opens a report's page at a size, and afterwards asks whether the console stayed empty."""

    def open_page(folder: Path, width: int = 1280, height: int = 900, mobile: bool = False) -> Any:
        size(browser, width, height, mobile)
        theme(browser, "light")
        browser.get((folder / "report.html").as_uri())
        return browser

    yield open_page
    assert [entry["message"] for entry in browser.get_log("browser")] == []


def files(browser: Any) -> list[str]:
    cells = "return [...document.querySelectorAll('#rows td.file .name')].map((cell) => cell.innerText)"
    return [text.rpartition("/")[2] for text in browser.execute_script(cells)]


@pytest.fixture(scope="module")
def report(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("page")
    captures = copy_captures(recorded, place / "captures")
    shutil.copy(captures / "empty.tagid.h5", captures / HOSTILE)
    part_of_a_turn(captures / "helmet-120.tagid.h5", captures / "part.tagid.h5", 0.75)
    manifest = place / "m.csv"
    manifest.write_text("file,expected_layout\nhelmet-120.tagid.h5,helmet-120\nempty.tagid.h5,container-90\n")
    sources = collect([str(captures)])
    expectations = read_manifest(manifest, sources.sources, ["helmet-120", "container-90"])
    page = PageSettings("Gate 4 <b>acceptance</b>")
    plan = BatchPlan(sources, place / "report", page=page, expectations=expectations)
    run_batch(plan, a_job(pictures=True), in_this_process)
    return place / "report"


def test_sort_filter_and_open(show, report: Path) -> None:
    page = show(report)
    assert page.title == "Gate 4 <b>acceptance</b>" == page.find_element(By.TAG_NAME, "h1").text
    assert HOSTILE in files(page), "a hostile name is text"
    assert not page.find_elements(By.CSS_SELECTOR, "img[src=x]")
    assert len(files(page)) == 7

    def scores() -> list[float]:
        cells = "return [...document.querySelectorAll('#rows td[data-head=score]')].map((c) => c.innerText)"
        return [float(text) for text in page.execute_script(cells) if text != "-"]

    # Sort by score, up and down.
    head = page.find_element(By.CSS_SELECTOR, "#heads th[data-key='5']")
    head.find_element(By.TAG_NAME, "button").click()
    assert head.get_attribute("aria-sort") == "ascending"
    rising = scores()
    assert rising == sorted(rising) and len(rising) == 6
    head.find_element(By.TAG_NAME, "button").click()
    assert scores() == sorted(rising, reverse=True)
    assert head.get_attribute("aria-sort") == "descending"

    # Filter by status, text, layout and expectation; it says how many are left.
    def clear() -> None:
        page.find_element(By.ID, "f-reset").click()
        wait(page, lambda: len(files(page)) == 7)

    Select(page.find_element(By.ID, "f-status")).select_by_value("no_tag")
    wait(page, lambda: sorted(files(page)) == sorted(["empty.tagid.h5", HOSTILE]))
    assert page.find_element(By.ID, "count").text == "2 of 7 files"
    clear()
    page.find_element(By.ID, "f-text").send_keys("CONTAINER")
    wait(page, lambda: sorted(files(page)) == ["container-180.tagid.h5", "container-90.tagid.h5"])
    Select(page.find_element(By.ID, "f-layout")).select_by_value("container-180")
    wait(page, lambda: files(page) == ["container-180.tagid.h5"])
    clear()
    Select(page.find_element(By.ID, "f-correct")).select_by_value("false")
    wait(page, lambda: files(page) == ["empty.tagid.h5"])
    clear()

    # What qualifies an answer is marked, filtered and explained; the copy is marked, too.
    Select(page.find_element(By.ID, "f-caveat")).select_by_value("part_of_a_turn")
    wait(page, lambda: files(page) == ["part.tagid.h5"])
    row = page.find_element(By.CSS_SELECTOR, "#rows tr")
    assert [mark.text for mark in row.find_elements(By.CLASS_NAME, "mark")] == ["part of a turn", "no bound"]
    assert "2026-11-03 07:15 UTC, table stopped" in row.text
    row.find_element(By.CSS_SELECTOR, "button.thumb").click()
    viewer = page.find_element(By.ID, "viewer")
    wait(page, viewer.is_displayed)
    assert page.find_element(By.ID, "v-answer").text.endswith("part of a turn no bound")
    explained = page.find_element(By.ID, "v-explained").text
    assert "no bound: it holds for whole turns" in explained and "table stopped" in explained
    page.find_element(By.ID, "v-close").click()
    clear()
    copies = [r.text for r in page.find_elements(By.CSS_SELECTOR, "#rows tr") if "\ncopy\n" in r.text]
    assert len(copies) == 1 and "empty.tagid.h5" in copies[0]

    # Open an image by keyboard; the rings of the layout lie on the reflectors that were found.
    listed = files(page)
    after = listed[(listed.index("helmet-120.tagid.h5") + 1) % len(listed)]
    row = next(r for r in page.find_elements(By.CSS_SELECTOR, "#rows tr") if "helmet-120" in r.text)
    thumb = row.find_element(By.CSS_SELECTOR, "button.thumb")
    thumb.send_keys(Keys.ENTER)
    viewer = page.find_element(By.ID, "viewer")
    wait(page, viewer.is_displayed)
    assert page.find_element(By.ID, "v-answer").text.startswith("helmet-120, score")
    sizes = page.execute_async_script(
        "const done = arguments[0]; Promise.all([...document.querySelectorAll('figure image')].map((i) =>"
        "{ const p = new Image(); p.src = i.getAttribute('href'); return p.decode().then(() =>"
        " [p.naturalWidth, p.naturalHeight]); })).then(done);"
    )
    assert sizes == [[48, 48], [128, 16]]
    rings = page.find_elements(By.CSS_SELECTOR, "#v-image circle.layout")
    assert len(rings) == 3
    centre = np.array([[float(ring.get_attribute(name)) for name in ("cx", "cy")] for ring in rings])
    records = [json.loads(line) for line in (report / "items.jsonl").read_text().splitlines()]
    (record,) = (r for r in records if "helmet-120" in r["file"])
    # Axes: 0.5 m over 320 px, x to the right, y upwards, the axis of rotation in the middle.
    for reflector in record["reflectors"]:
        px = np.array([58 + 160 + 640 * reflector["x_m"], 12 + 160 - 640 * reflector["y_m"]])
        assert np.linalg.norm(centre - px, axis=1).min() < 10
    text = page.find_element(By.ID, "v-image").text
    assert "x, m" in text and "y, m" in text and "dB" in text and "0.2" in text
    facts = page.find_element(By.ID, "v-facts").text
    for name in ("capture_uuid", "content_sha256", "tool_version", "time_utc"):
        assert record[name] in facts
    page.switch_to.active_element.send_keys(Keys.ARROW_RIGHT)
    wait(page, lambda: after in page.find_element(By.ID, "v-title").text)
    page.switch_to.active_element.send_keys(Keys.ESCAPE)
    wait(page, lambda: not viewer.is_displayed())
    assert page.switch_to.active_element == thumb, "the focus goes back to where it came from"


def test_it_is_not_blank_and_the_image_is_in_it(show, report: Path) -> None:
    page = show(report)
    blank = picture_of(page)
    assert blank.std() > 10, "the page is blank"
    page.find_elements(By.CSS_SELECTOR, "button.thumb")[2].click()
    wait(page, page.find_element(By.ID, "viewer").is_displayed)
    box = page.find_element(By.CSS_SELECTOR, "#v-image image").rect
    inside = picture_of(page)[
        int(box["y"]) : int(box["y"] + box["height"]), int(box["x"]) : int(box["x"] + box["width"])
    ]
    colours = np.unique(inside.reshape(-1, 3) // 16, axis=0)
    assert len(colours) > 20, "the image is not drawn"


def picture_of(page: Any) -> np.ndarray:
    with Image.open(io.BytesIO(page.get_screenshot_as_png())) as picture:
        return np.asarray(picture.convert("RGB"), dtype=np.float64)


# WCAG 2.2, 1.4.3: relative luminance and contrast of every text on the first background behind it.
CONTRAST = """
const channel = (v) => (v /= 255) <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4;
const numbers = (c) => c.match(/[\\d.]+/g).map(Number);
const light = (c) => [0.2126, 0.7152, 0.0722].reduce((sum, w, i) => sum + w * channel(numbers(c)[i]), 0);
const behind = (node) => {
  for (let n = node; n; n = n.parentElement) {
    const c = getComputedStyle(n).backgroundColor;
    if (numbers(c)[3] !== 0) return c;
  }
  return 'rgb(255, 255, 255)';
};
const bad = [];
const texts = 'h1,h2,p,li,b,th,td,button,label,dt,dd,summary,caption,strong,input,select,figcaption';
for (const node of document.querySelectorAll(texts)) {
  if (!node.checkVisibility() || !(node.textContent.trim() || node.value)) continue;
  const [a, b] = [light(getComputedStyle(node).color), light(behind(node))].sort((x, y) => y - x);
  const contrast = (a + 0.05) / (b + 0.05);
  if (contrast < 4.5) bad.push(node.outerHTML.slice(0, 80) + ' ' + contrast.toFixed(2));
}
return bad;
"""
UNNAMED = """
return [...document.querySelectorAll('button,input,select,img,svg[role=img],dialog,table')].filter((n) =>
  !(n.labels && n.labels.length) && !n.getAttribute('aria-label') && !n.getAttribute('aria-labelledby')
  && !n.hasAttribute('alt') && !n.textContent.trim()).map((n) => n.outerHTML.slice(0, 80));
"""


@pytest.mark.parametrize("name", ["light", "dark"])
def test_contrast_and_names(show, report: Path, name: str) -> None:
    page = show(report)
    theme(page, name)
    assert page.execute_script(CONTRAST) == []
    page.find_elements(By.CSS_SELECTOR, "button.thumb")[0].click()
    wait(page, page.find_element(By.ID, "viewer").is_displayed)
    assert page.execute_script(CONTRAST) == []
    assert page.execute_script(UNNAMED) == []
    assert (picture_of(page).mean() < 100) == (name == "dark")


def test_on_a_phone_and_on_paper(show, report: Path) -> None:
    page = show(report, 360, 740, mobile=True)
    assert page.execute_script("return document.documentElement.scrollWidth") <= 360
    thumb = page.find_elements(By.CSS_SELECTOR, "button.thumb")[0]
    assert thumb.size["width"] >= 44 and thumb.size["height"] >= 44, "a finger hits it"
    Select(page.find_element(By.ID, "sorting")).select_by_value("5-")
    assert files(page)[0] != "bad.tagid.h5"
    page.find_elements(By.CSS_SELECTOR, "button.thumb")[0].click()
    wait(page, page.find_element(By.ID, "viewer").is_displayed)
    viewer = "document.getElementById('viewer')"
    assert page.execute_script(f"return {viewer}.scrollWidth <= {viewer}.clientWidth")
    page.find_element(By.ID, "v-close").click()
    page = show(report)
    paper = page.execute_cdp_cmd("Page.printToPDF", {"printBackground": True})
    assert len(paper["data"]) > 20_000


def test_thousands_of_items_stay_responsive(show, tmp_path: Path, report: Path) -> None:
    """5000 objects: a page of bounded size, few elements in the table, and work in well under a second."""
    with (report / "items.jsonl").open() as file:
        models = [{**json.loads(line), "expected": None, "correct": None} for line in file]
    drawing = {"method": "bp", "extent_m": 0.5, "centre_m": [0, 0], "image_db": 30.0, "layout_m": []}
    drawing |= {"range_m": [0, 1], "angle_deg": None, "views": 12, "sinogram_db": 30.0}
    raster = io.BytesIO()
    noise = np.random.default_rng(0).integers(0, 32, (96, 96), dtype=np.uint8)
    Image.fromarray(noise).convert("P").save(raster, "PNG")
    count = 5000

    def many() -> Iterator[StoredItem]:
        for number in range(count):
            model = models[number % len(models)]
            record = ItemRecord({**model, "file": f"object {number}", "score": number / count})
            yield StoredItem(number, record, drawing, 2 * len(raster.getvalue()))

    def pictures(position: int) -> tuple[bytes, bytes]:
        return raster.getvalue(), raster.getvalue()

    summary = {**json.loads((report / "summary.json").read_text()), "expected": None}
    out = tmp_path / "many"
    out.mkdir()
    write_page(out / "report.html", many, pictures, summary, PageSettings(megabytes=4.0))
    assert (out / "report.html").stat().st_size < 4e6 + count * 3000
    page = show(out)
    assert page.find_element(By.ID, "count").text == "5000 files"
    assert len(files(page)) == 50
    milliseconds = page.execute_script(
        "const t = performance.now(); document.querySelector('#heads th[data-key=\"5\"] button').click();"
        "document.querySelector('#heads th[data-key=\"5\"] button').click(); return performance.now() - t;"
    )
    assert files(page)[0] == "object 4999"
    assert milliseconds < 5000, "generous: it takes some 30 ms on an idle machine"
    page.find_element(By.ID, "p-last").click()
    assert files(page)[-1] == "object 0"
    assert page.find_element(By.ID, "p-where").text == "page 100 of 100"
