"""The station's page in a real browser: keyboard, two browsers, a reload, both themes, phone and tablet."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterator
from importlib import util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import size, start, theme, wait
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from station_harness import ENDLESS, OWN, PLACES, Asks, alone, own_object, poses
from station_harness import wait as until

from tagid.config import config_path, data_folder, read_file
from tagid.doctor import examine
from tagid.enrolling.registry import Registry
from tagid.operate.workplace import Workplace
from tagid.pipeline.answer import Cause, Identification
from tagid.radar.emulation.core import EmulatorCore
from tagid.radar.emulation.emulator import ServeOptions
from tagid.radar.settings import RadarConfig
from tagid.result import Problem
from tagid.simulate.rig import parse_rig
from tagid.simulate.spec import SceneSpec, turning_scene
from tagid.station import live_socket, station, wire
from tagid.station.server import Server
from tagid.storage.history import FILE_NAME, History
from tagid.tags.layouts.layout import Layout
from tests.emulators import UdpEmulator

PIXELS = """
const canvas = document.getElementById(arguments[0]);
const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
return Array.from(data).filter((v, i) => i % 4 === 1);
"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    started = start(tmp_path_factory.mktemp("profile"))
    yield started
    started.quit()


@pytest.fixture(scope="module")
def station_alone(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A station for the tests that need one scan."""
    with alone(tmp_path_factory.mktemp("shown")) as station:
        yield station


@pytest.fixture
def station_with_history(station_alone: Server) -> Server:
    """The same after a scan."""
    asks = Asks(station_alone.url, {"tagid-station": "1"})
    if asks.get("/api/v1/scan").status == 404:
        asks.post("/api/v1/scan")
        until(lambda: not asks.get("/api/v1/scan").json()["running"])
    return station_alone


def text(page: Any, identity: str) -> str:
    return page.find_element(By.ID, identity).text


def logged(page: Any, station: str) -> list[str]:
    """What the browser logged of one station: the page of the test before still asks its own."""
    messages = [entry["message"] for entry in page.get_log("browser")]
    return [message for message in messages if station in message or "://" not in message]


def finished(page: Any, number: int) -> None:
    """Wait until the page shows the end of a scan; Stop may be shown too briefly to be seen."""
    wait(
        page,
        lambda: page.execute_script(
            "return newest && newest.number === arguments[0] && !newest.running", number
        ),
    )


def by_keyboard(page: Any, identity: str, most: int = 40) -> None:
    """Reach an element with the Tab key alone."""
    for _ in range(most):
        if page.switch_to.active_element.get_attribute("id") == identity:
            return
        page.switch_to.active_element.send_keys(Keys.TAB)
    raise AssertionError(f"{identity} is not reached with the Tab key")


def press(page: Any, identity: str) -> None:
    """Reach a button with the Tab key and press it."""
    by_keyboard(page, identity)
    page.switch_to.active_element.send_keys(Keys.ENTER)


def view(page: Any, name: str) -> None:
    """Open a view by its link, with the keyboard."""
    page.find_element(By.CSS_SELECTOR, f"nav a[href='#view-{name}']").send_keys(Keys.ENTER)
    wait(page, lambda: page.execute_script("return document.body.dataset.view") == name)


def problems(page: Any) -> list[Any]:
    """What axe-core finds in the view that is open."""
    spec = util.find_spec("axe_core_python")
    if spec is None or spec.origin is None:
        pytest.skip("no axe-core: pip install axe-core-python")
    if not page.execute_script("return 'axe' in window"):
        page.execute_script((Path(spec.origin).parent / "axe.min.js").read_text("utf-8"))
    return page.execute_async_script(
        "const done = arguments[0]; axe.run({resultTypes: ['violations']}).then((r) =>"
        " done(r.violations.map((v) => [v.id, v.nodes.map((n) => n.html.slice(0, 90))])));"
    )


def test_the_main_road_by_keyboard_alone(browser: Any, station_alone: Server) -> None:
    size(browser, 1180, 820)
    browser.get(station_alone.url)
    wait(browser, lambda: browser.find_element(By.ID, "scan").is_enabled())
    press(browser, "scan")
    wait(browser, lambda: text(browser, "answer") == "helmet-120" and text(browser, "scan") == "Scan")
    letters = browser.execute_script(
        "return parseFloat(getComputedStyle(document.getElementById('answer')).fontSize)"
    )
    assert letters > 100, "to be read from three metres"
    wait(browser, lambda: "360 of 360 degrees" in text(browser, "figures"))
    storing = browser.execute_script(
        "receive({type: 'frame', scan: {...newest, running: true}});"
        "const scan = document.getElementById('scan'); return [scan.textContent, scan.disabled];"
    )
    assert storing == ["Scan", True], "nothing to stop after the name"
    # The answer's picture is finer than the growing image: it has the circles of the reflectors, in white.
    wait(browser, lambda: browser.find_element(By.ID, "image").get_property("width") > 64)
    image = np.array(browser.execute_script(PIXELS, "image"))
    assert len(np.unique(image)) > 20 and 255 in image, "the image or its circles are not drawn"
    assert len(np.unique(browser.execute_script(PIXELS, "sinogram"))) > 20
    bars = browser.find_elements(By.CSS_SELECTOR, "#evidence li")
    assert text(browser, "evidence-head") == "What else it could be"
    assert 1 < len(bars) < 5 and all("enough" in bar.get_attribute("class") for bar in bars)
    assert not any(bar.text.startswith("helmet-120") for bar in bars)
    # What the health check says is text, whatever it says; a problem shows on the view to scan, too.
    assert text(browser, "alert").startswith("No radar.")
    view(browser, "health")
    assert "No radar answers at emulator://" in text(browser, "wiring-found")
    assert "tagid radar find" in text(browser, "wiring-steps")
    wait(browser, lambda: "radar: problem" in text(browser, "health"))
    assert "no answer <b>" in text(browser, "health") and "Check the cable." in text(browser, "health")
    # The picture of the entry in the history opens and closes by keyboard.
    view(browser, "history")
    wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, "#history button"))
    button = browser.find_element(By.CSS_SELECTOR, "#history button")
    button.send_keys(Keys.ENTER)
    picture = browser.find_element(By.ID, "viewer-picture")
    wait(browser, lambda: browser.execute_script("return arguments[0].naturalWidth", picture) == 940)
    (capture,) = Asks(station_alone.url, {}).get("/api/v1/history").json()["items"]
    assert text(browser, "viewer-capture") == Path(capture["file"]).name
    for width, height in ((1180, 820), (1440, 900)):
        size(browser, width, height)
        for part in (picture, *browser.find_elements(By.CSS_SELECTOR, "#viewer a, #viewer button")):
            assert part.rect["y"] > 0 and part.rect["y"] + part.rect["height"] < height
    browser.switch_to.active_element.send_keys(Keys.ESCAPE)
    wait(browser, lambda: not browser.find_element(By.ID, "viewer").is_displayed())
    assert browser.switch_to.active_element == button
    assert logged(browser, station_alone.url) == []


def test_the_answer_is_heard_where_sound_is_on(browser: Any, serve: Callable[..., Server]) -> None:
    size(browser, 1180, 820)
    browser.get(serve().url)
    browser.execute_script(
        "window.tones = 0; const made = AudioContext.prototype.createOscillator;"
        "AudioContext.prototype.createOscillator = function () { window.tones++; return made.call(this); };"
    )

    def tones() -> int:
        return int(browser.execute_script("return window.tones"))

    def scanned() -> int:
        """Tones since the page was opened, after one more scan."""
        wait(browser, lambda: browser.find_element(By.ID, "scan").is_enabled())
        number = browser.execute_script("return newest ? newest.number + 1 : 1")
        press(browser, "scan")
        finished(browser, number)
        assert text(browser, "answer") == "helmet-120"
        return tones()

    assert text(browser, "sound") == "Sound off"
    press(browser, "sound")
    assert text(browser, "sound") == "Sound on" and tones() == 1
    heard = scanned()
    assert heard == 3, "the first answer on a page is heard, too"
    press(browser, "sound")
    assert text(browser, "sound") == "Sound off" and scanned() == heard


def test_the_history_says_why_nothing_was_named(browser: Any, serve: Callable[..., Server]) -> None:
    error = Problem("data", "the scans do not <b>repeat</b>", "Record 1.3 turns.")
    cause = Cause("speed", "the table turns slower", "Give its speed.")
    record = Identification("failed", None, None, None, "Helmet 7", error=error).to_dict()
    known = Identification("failed", None, None, None, error=error, causes=(cause,)).to_dict()
    history = History(data_folder() / FILE_NAME)
    station_url = serve().url
    entries = [
        {"file": "/other/scan.tagid.h5", "recording_note": "gate <b>4</b>", **record},
        {"file": "/other/scan-2.tagid.h5", **known},
    ]
    history.add(history.begin("station", {}), entries)
    size(browser, 390, 844, True)
    browser.get(station_url)
    view(browser, "history")
    wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, "#history li"))
    caused, row = browser.find_elements(By.CSS_SELECTOR, "#history li")
    for words in ("Failed", "Helmet 7", "gate <b>4</b>", "/other/scan.tagid.h5", "do not <b>repeat</b>"):
        assert words in row.text
    assert "Record 1.3 turns." in row.text and "Likely cause" not in row.text
    assert "Likely cause: the table turns slower. Give its speed." in caused.text
    assert not row.find_elements(By.TAG_NAME, "button"), "no picture is offered where there is none"
    for field in browser.find_elements(By.CSS_SELECTOR, "#filter select, #filter input"):
        label = field.find_element(By.XPATH, "..")
        above = label.rect["y"] < field.rect["y"] and label.rect["x"] == field.rect["x"]
        assert above, "its label is above it"
    assert problems(browser) == []
    assert browser.execute_script("return document.documentElement.scrollWidth <= innerWidth")


SCREENS = {
    "phone": ((390, 844, True), "dark"),
    "tablet": ((1180, 820, False), "light"),
    "desktop": ((1440, 900, False), "dark"),
}


@pytest.mark.parametrize(("shape", "name"), SCREENS.values(), ids=SCREENS.keys())
def test_accessibility_and_fit(
    browser: Any, station_with_history: Server, shape: tuple[int, int, bool], name: str
) -> None:
    size(browser, *shape)
    theme(browser, name)
    browser.get(station_with_history.url)
    wait(browser, lambda: text(browser, "answer") == "helmet-120")
    background = browser.execute_script("return getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, background[4:-1].split(","))) < 300) == (name == "dark")
    scan = browser.find_element(By.ID, "scan").rect
    assert scan["height"] >= 80 and scan["width"] >= 250, "a thumb hits it"
    assert scan["y"] + scan["height"] <= shape[1], "without scrolling"
    for shown in ("scan", "health", "history", "enrol", "settings", "commission"):
        view(browser, shown)
        if shown == "settings":
            wait(browser, lambda: browser.find_element(By.ID, "s-axis").get_property("value"))
        if shown == "history":
            wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, "#history button"))
        if shown == "enrol":
            browser.find_element(By.CSS_SELECTOR, "#templates summary").click()
            wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, "#t-layout option"))
        assert browser.execute_script("return document.documentElement.scrollWidth") <= shape[0], shown
        assert problems(browser) == [], shown


def test_a_station_is_set_up_on_its_page(
    browser: Any, serve: Callable[..., Server], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    single = serve(check=lambda config: [])
    single._station.source = station.Source(lambda: Workplace({"storage.folder": str(tmp_path / "out")}))
    size(browser, 820, 1180)
    theme(browser, "light")
    browser.get(f"{single.url}/#view-settings")

    def typed(selector: str, *keys: str) -> None:
        field = browser.find_element(By.CSS_SELECTOR, selector)
        wait(browser, lambda: field.is_displayed() and field.is_enabled())
        if keys[1:]:
            field.clear()
        field.send_keys(*keys)

    typed("#s-axis", "102", Keys.ENTER)
    wait(browser, lambda: "Give metres" in text(browser, "problem"))
    assert not config_path().exists() and problems(browser) == []
    core = EmulatorCore(turning_scene(SceneSpec("helmet-120", rpm=6)), RadarConfig())
    with UdpEmulator(core, ServeOptions(port=0)) as radar:
        monkeypatch.setenv("TAGID_RADAR_ADDRESSES", radar.url.removeprefix("udp://"))
        press(browser, "s-find-radar")
        wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, "#s-radars button"))
        assert radar.url in text(browser, "s-radars") and problems(browser) == []
        typed("#s-radars button", Keys.ENTER)
        typed("#s-rpm", "6")
        typed("#s-axis", "1,0", Keys.ENTER)
        wait(browser, lambda: text(browser, "s-state").startswith("Stored"))
        stored = read_file(config_path())
        assert stored["radar.url"] == radar.url and stored["motion.axis_distance_m"] == 1.0
        assert stored["motion.url"].public == "free?rpm=6" and "station.until_sure" not in stored
        # Before the first scan the page shows where the object is.
        view(browser, "scan")
        assert not browser.find_element(By.ID, "pictures").is_displayed()
        press(browser, "profile-button")
        wait(browser, lambda: text(browser, "profile-text").endswith("where the object is expected."))
        assert len(np.unique(browser.execute_script(PIXELS, "profile-canvas"))) > 10
        assert problems(browser) == []
        typed("#profile-button", Keys.ENTER)
        wait(browser, lambda: text(browser, "profile-button") == "Show it")
    # A file that is no capture is sent, refused with its reason, and not kept.
    wrong = tmp_path / "notes <b>.txt"
    wrong.write_text("no capture")
    browser.find_element(By.ID, "file").send_keys(str(wrong))
    wait(browser, lambda: text(browser, "answer") == "Failed")
    assert "unknown file format" in text(browser, "reason")
    assert list((tmp_path / "out").iterdir()) == []
    # The theme is the browser's.
    background = "return getComputedStyle(document.body).backgroundColor"
    light = browser.execute_script(background)
    view(browser, "settings")
    browser.find_element(By.ID, "s-theme").send_keys("dark")
    wait(browser, lambda: browser.execute_script(background) != light)
    browser.refresh()
    wait(browser, lambda: browser.execute_script(background) != light)
    browser.execute_script("localStorage.clear(); applyTheme()")
    assert browser.execute_script(background) == light
    # Loading the page again closes its socket, which some browsers log.
    (refused,) = [message for message in logged(browser, single.url) if "WebSocket" not in message]
    assert "400 (Bad Request)" in refused


def test_a_rig_is_commissioned_on_its_page(
    browser: Any, serve: Callable[..., Server], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    single = serve(check=lambda config: [])
    shown = ["empty"]

    def place() -> Workplace:
        url = f"emulator://{shown[0]}?rig=realistic%3Fseed%3D3&seed=1"
        return Workplace({"radar.url": url, "radar.integration": 15, "storage.folder": str(tmp_path / "out")})

    single._station.source = station.Source(place)
    size(browser, 820, 1180)
    theme(browser, "light")
    browser.get(f"{single.url}/#view-commission")

    def row(step: str) -> list[Any]:
        """(state, text, whether it can be started) of a step; its row is drawn anew when it ends."""
        return browser.execute_script(
            "const button = document.querySelector(`#c-steps button[data-step=${arguments[0]}]`);"
            "const row = button ? button.closest('li') : null;"
            "return row ? [row.className, row.textContent, !button.disabled] : ['', '', false];",
            step,
        )

    def started(step: str) -> None:
        wait(browser, lambda: row(step)[2])
        browser.find_element(By.CSS_SELECTOR, f"#c-steps button[data-step='{step}']").send_keys(Keys.ENTER)

    def done(step: str, state: str) -> str:
        started(step)
        wait(browser, lambda: row(step)[0] == state and row(step)[2])
        return row(step)[1]

    wait(browser, lambda: row("link")[2])
    for identity, words in (("c-axis", "1,0"), ("c-height", "0.05"), ("c-target", "one")):
        browser.find_element(By.ID, identity).clear()
        browser.find_element(By.ID, identity).send_keys(words)
    started("room")
    wait(browser, lambda: "Target distance, m: that is no number" in text(browser, "problem"))
    true = parse_rig("realistic?seed=3")
    browser.find_element(By.ID, "c-target").clear()
    browser.find_element(By.ID, "c-target").send_keys(f"{true.axis_distance_m:.3f}")
    assert "noise of a sample" in done("room", "passed")
    # The target is not there: the step says so and what to do; with it the same step passes.
    assert "Check both antenna cables" in done("target", "failed")
    assert problems(browser) == []
    shown[0] = "target"
    assert "path delay" in done("target", "passed") and "±" in row("target")[1]
    focused = browser.execute_script("return document.activeElement.dataset.step")
    assert focused == "target", "the keyboard stays where it was"
    written = Asks(single.url, {}).get("/api/v1/commissioning/page.pdf")
    assert written.status == 200 and written.content.startswith(b"%PDF") and b"path delay" in written.content
    drawn = "return [...document.querySelectorAll('#c-steps img')].map((one) => one.naturalWidth)"
    browser.execute_script("for (const one of document.querySelectorAll('#c-steps details')) one.open = true")
    wait(browser, lambda: len(browser.execute_script(drawn)) == 5 and all(browser.execute_script(drawn)))
    # A script may not begin a step while a browser operates.
    refused = Asks(single.url, {"tagid-station": "1"}).post("/api/v1/commissioning", step="room")
    assert refused.status == 403
    browser.refresh()
    wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, "#c-steps li.passed"))
    assert browser.find_element(By.ID, "c-axis").get_property("value") == "1"
    assert len(browser.find_elements(By.CSS_SELECTOR, "#c-steps li.passed")) == 2
    for shape, name in SCREENS.values():
        size(browser, *shape)
        theme(browser, name)
        assert problems(browser) == [], (shape, name)
        assert browser.execute_script("return document.documentElement.scrollWidth") <= shape[0]


def test_two_browsers_a_reload_and_a_restart_of_the_station(
    browser: Any, serve: Callable[..., Server], monkeypatch: pytest.MonkeyPatch
) -> None:
    station = serve(ENDLESS)
    browser.get(station.url)
    wait(browser, lambda: browser.find_element(By.ID, "scan").is_enabled())
    browser.find_element(By.ID, "scan").click()
    wait(browser, lambda: text(browser, "scan") == "Stop" and "operates" in text(browser, "operator"))
    first = browser.current_window_handle
    browser.switch_to.new_window("window")
    second = browser.current_window_handle
    browser.get(station.url)
    wait(browser, lambda: text(browser, "operator").startswith("Another browser"))
    assert text(browser, "scan") == "Stop", "anybody may stop"
    frames = "return Number(document.body.dataset.frames || 0)"
    seen = browser.execute_script(frames)
    wait(browser, lambda: browser.execute_script(frames) > seen + 5)
    browser.switch_to.window(first)
    browser.refresh()
    wait(browser, lambda: text(browser, "operator") == "This browser operates the station.")
    assert Asks(station.url, {}).get("/api/v1/scan").json()["running"]
    browser.switch_to.window(second)
    browser.find_element(By.ID, "scan").click()
    wait(browser, lambda: text(browser, "answer") == "Failed")
    assert "stopped after" in text(browser, "reason") and "are in" in text(browser, "reason")
    assert not browser.find_element(By.ID, "scan").is_enabled()
    browser.find_element(By.ID, "take").click()
    wait(browser, lambda: browser.find_element(By.ID, "scan").is_enabled())
    station.close()
    wait(browser, lambda: text(browser, "link") in ("the station does not respond", "not connected"))
    assert not browser.find_element(By.ID, "scan").is_enabled()
    serve(port=station.port)
    wait(browser, lambda: text(browser, "link") == "connected")
    browser.close()
    browser.switch_to.window(first)
    browser.get("about:blank")


def test_a_device_pairs_on_the_page(browser: Any, serve: Callable[..., Server]) -> None:
    codes: list[str] = []
    announced = threading.Event()

    def announce(code: str) -> None:
        codes.append(code)
        announced.set()

    station = serve(announce=announce)
    browser.delete_all_cookies()
    browser.get(station.url)
    wait(browser, lambda: browser.find_element(By.ID, "pairing").is_displayed())
    field = browser.find_element(By.ID, "code")
    field.send_keys("WRONG-ONE", Keys.ENTER)
    wait(browser, lambda: "not the pairing code" in text(browser, "pair-error"))
    field.clear()
    field.send_keys(codes[-1], Keys.ENTER)
    wait(browser, lambda: text(browser, "link") == "connected")
    assert browser.execute_script("return document.cookie") == "", "no script reads the token"
    browser.get("about:blank")


def test_an_object_is_enrolled_by_keyboard_and_the_enrolment_undone(
    browser: Any, serve: Callable[..., Server], tmp_path: Path
) -> None:
    radars = poses("mine", own_object(tmp_path))
    station = serve(lambda: next(radars))
    size(browser, 820, 1180)
    theme(browser, "light")
    browser.get(f"{station.url}/#view-enrol")
    wait(browser, lambda: browser.find_element(By.ID, "e-begin").is_enabled())
    by_keyboard(browser, "e-name")
    browser.switch_to.active_element.send_keys("Gate 4", Keys.ENTER)
    wait(browser, lambda: "is not valid" in text(browser, "problem"))
    name = browser.find_element(By.ID, "e-name")
    name.clear()
    name.send_keys("gate-4", Keys.ENTER)
    wait(browser, lambda: text(browser, "capture") == "Record 1 of 3")
    wait(browser, lambda: browser.switch_to.active_element.get_attribute("id") == "capture")
    assert text(browser, "problem") == "" and problems(browser) == []
    for number in (1, 2, 3):
        wait(browser, lambda: browser.find_element(By.ID, "capture").is_enabled())
        press(browser, "capture")
        wait(
            browser,
            lambda number=number: len(browser.find_elements(By.CSS_SELECTOR, "#captures li")) == number,
        )
        wait(browser, lambda: text(browser, "measuring") == "")
        if number == 2:
            assert "third of a turn" in text(browser, "instruction")
            browser.refresh()
            wait(browser, lambda: text(browser, "capture") == "Record 3 of 3")
    wait(browser, lambda: browser.find_element(By.ID, "store").is_enabled())
    assert text(browser, "store") == "Enroll gate-4"
    assert "3 reflectors" in text(browser, "measured-text") and "mm apart" in text(browser, "nearest")
    assert len(browser.find_elements(By.CSS_SELECTOR, "#plan circle")) == 3
    assert problems(browser) == []
    assert not browser.find_element(By.ID, "store-anyway").is_displayed()
    # Another program enrolls its twin: the page refuses, and says which button overrides that.
    Registry(data_folder() / "registry.sqlite").add(Layout("twin", PLACES), "another program")
    browser.execute_script("$('subject-form').requestSubmit()")
    wait(browser, lambda: "could be confused with twin" in text(browser, "trouble"))
    assert "override with the button “Enroll it anyway”" in text(browser, "trouble")
    assert not browser.find_element(By.ID, "store").is_enabled() and problems(browser) == []
    press(browser, "store-anyway")
    wait(browser, lambda: text(browser, "done-text").startswith("gate-4 is enrolled"))
    assert browser.find_element(By.ID, "done-template").get_attribute("href").endswith("gate-4/template.pdf")
    assert problems(browser) == []
    press(browser, "undo")
    wait(browser, lambda: text(browser, "done-text") == "gate-4 is no longer enrolled.")
    size(browser, 390, 844, True)
    assert browser.execute_script("return document.documentElement.scrollWidth") <= 390
    # A selection of the history becomes a report; each theme and size of its view was checked above.
    history = History(data_folder() / FILE_NAME)
    gone = Identification("unknown", None, None, None).to_dict()
    history.add(history.begin("station", {}), [{"file": "/other/scan.tagid.h5", **gone}])
    view(browser, "history")
    wait(browser, lambda: len(browser.find_elements(By.CSS_SELECTOR, "#history input")) == 4)
    for number in (0, 2):
        browser.find_elements(By.CSS_SELECTOR, "#history input")[number].send_keys(Keys.SPACE)
    assert text(browser, "selected") == "2 selected, 1 without a capture here"
    assert "entries=4,2" in browser.find_element(By.ID, "export-captures").get_attribute("href")
    browser.find_element(By.ID, "report").send_keys(Keys.ENTER)
    wait(browser, lambda: browser.find_element(By.ID, "report-page").is_displayed())
    assert "1 captures" in text(browser, "report-text") and problems(browser) == []
    assert "1 of 2 left out: their captures are not among the scans in" in text(browser, "report-text")
    browser.get(browser.find_element(By.ID, "report-page").get_attribute("href"))
    wait(browser, lambda: "Captures of the station" in browser.title)
    wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, "table tbody tr"))
    stolen = "try { return String(document.cookie) } catch (error) { return error.name }"
    assert browser.execute_script(stolen) == "SecurityError", "the sandbox gives it no access to the station"
    # The refused name is in the log, and nothing else.
    (refused,) = logged(browser, station.url)
    assert "400 (Bad Request)" in refused


def test_a_radar_that_is_unplugged_shows_on_the_page_and_the_next_scan_works(
    browser: Any, serve: Callable[..., Server]
) -> None:
    def core() -> EmulatorCore:
        return EmulatorCore(turning_scene(SceneSpec("helmet-120", rpm=8)), RadarConfig())

    size(browser, 390, 844, True)
    with UdpEmulator(core(), ServeOptions(port=0)) as radar:
        port = int(radar.url.rpartition(":")[2])
    station = serve(radar.url, check=examine, rpm=8, resume_s=4.0)
    browser.get(station.url)
    # Before anybody scans.
    wait(browser, lambda: text(browser, "answer") == "No radar")
    assert text(browser, "radar") == "no radar" and text(browser, "link") == "connected"
    assert radar.url in text(browser, "reason") and "cable" in text(browser, "advice")
    assert problems(browser) == []
    with UdpEmulator(core(), ServeOptions(port=port)):
        wait(browser, lambda: text(browser, "answer") == "Ready" and text(browser, "radar") == "radar ok")
        assert not browser.find_element(By.ID, "alert").is_displayed()
        browser.find_element(By.ID, "scan").click()
        wait(browser, lambda: re.match(r"[1-9]\d+ scans", text(browser, "figures")))
    wait(browser, lambda: text(browser, "answer") == "No signal")
    assert text(browser, "radar") == "no signal" and "cable and power" in text(browser, "advice")
    wait(browser, lambda: text(browser, "answer") == "Failed")
    assert "are in" in text(browser, "reason"), "where the scans are"
    wait(browser, lambda: browser.find_element(By.ID, "alert").is_displayed())
    browser.find_element(By.CSS_SELECTOR, "#alert a").send_keys(Keys.ENTER)
    wait(browser, lambda: browser.find_element(By.ID, "wiring").is_displayed())
    assert text(browser, "wiring-name") == "network cable"
    assert browser.execute_script("return document.documentElement.scrollWidth") <= 390
    assert problems(browser) == []
    assert text(browser, "radar") == "no radar"
    with UdpEmulator(core(), ServeOptions(port=port)):
        wait(browser, lambda: not browser.find_element(By.ID, "wiring").is_displayed())
        view(browser, "scan")
        assert text(browser, "answer") == "Ready" and text(browser, "radar") == "radar ok"
        assert text(browser, "reason").startswith("The last scan failed: "), "where its scans are"
        browser.find_element(By.ID, "scan").click()
        wait(browser, lambda: re.match(r"[1-9]\d+ scans", text(browser, "figures")))
        scan = Asks(station.url, OWN).get("/api/v1/scan").json()
        assert (scan["number"], scan["running"]) == (2, True)
        assert Asks(station.url, OWN).post("/api/v1/scan/stop").status == 202
        wait(browser, lambda: not Asks(station.url, OWN).get("/api/v1/scan").json()["running"])


def test_a_station_that_is_full_shows_on_the_page(
    browser: Any, serve: Callable[..., Server], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_socket, "MAX_CONNECTIONS", 1)
    monkeypatch.setattr(wire, "MAX_CONNECTIONS", 1)
    single = serve()
    browser.get(single.url)
    wait(browser, lambda: browser.find_element(By.ID, "scan").is_enabled())
    first = browser.current_window_handle
    browser.switch_to.new_window("window")
    browser.get(single.url)
    wait(browser, lambda: "too many pages" in text(browser, "link"))
    assert not browser.find_element(By.ID, "scan").is_enabled()
    browser.close()
    browser.switch_to.window(first)
    browser.get("about:blank")
