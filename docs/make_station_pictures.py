"""Makes the pictures of docs/station.md: the station's page in a headless Chromium, against emulated radars.

    python docs/make_station_pictures.py [FOLDER]

Needs `pip install '.[dev]'`, Chromium and chromedriver. One scan is in real time, three without waiting.
"""

from __future__ import annotations

import base64
import io
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from PIL import Image
from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By

SIZES = {"phone": (390, 844, True), "tablet": (1180, 820, False), "desk": (1440, 900, False)}
WAIT_S = 120
COLOURS = 96


def browser(profile: str) -> Any:
    """A headless Chromium that can reach loopback alone."""
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or shutil.which("chromium-browser") or ""
    for word in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(word)
    options.add_argument("--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1")
    options.add_argument(f"--user-data-dir={profile}")
    return webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))


def size(page: Any, name: str, theme: str) -> None:
    """A screen's size and the theme."""
    width, height, mobile = SIZES[name]
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": mobile}
    page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    features = [{"name": "prefers-color-scheme", "value": theme}]
    page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features, "media": ""})


def take(page: Any, path: Path) -> None:
    """Write a PNG of the screen, in few colours, which makes it a third as large."""
    shot = page.execute_cdp_cmd("Page.captureScreenshot", {})
    with Image.open(io.BytesIO(base64.b64decode(shot["data"]))) as picture:
        picture.convert("RGB").quantize(COLOURS).save(path, optimize=True)


def until(page: Any, script: str) -> None:
    """Wait until a script returns true."""
    end = time.monotonic() + WAIT_S
    while time.monotonic() < end:
        if page.execute_script(f"return {script}"):
            return
        time.sleep(0.1)
    raise SystemExit(f"it did not happen: {script}")


SCANNED = "emulator://helmet-120?rpm=6&seed=2&centre=0.005,-0.003&rate=1"
POSES = ((0.006, -0.002, 10), (-0.004, 0.005, 130), (0.001, 0.008, 250))
"""Centre (m) and rotation (degrees) of the object that is enrolled, in each capture."""
OBJECT = """
name = "helmet-7"
kind = "helmet"
positions_m = [[0.11, 0.0], [-0.02, 0.09], [-0.05, -0.07]]
"""
ABSENT = "udp://127.0.0.1:9"


def radar(home: str, url: str) -> None:
    """Configure the radar; the station reads the configuration before every scan and check."""
    Path(home, "c.toml").write_text(
        f'[radar]\nurl = "{url}"\nintegration = 15\n[motion]\nurl = "free?rpm=6"\naxis_distance_m = 1.0\n'
    )


def view(page: Any, name: str) -> None:
    """Open a view."""
    page.execute_script(f"location.hash = '#view-{name}'")
    until(page, f"document.body.dataset.view === '{name}'")


def enrol(page: Any, home: str, out: Path) -> None:
    """Enroll an object in three captures, and take pictures on the way."""
    Path(home, "helmet-7.toml").write_text(OBJECT)
    view(page, "enrol")
    page.find_element(By.ID, "e-name").send_keys("helmet-7")
    page.find_element(By.ID, "e-begin").click()
    for number, (x, y, turn) in enumerate(POSES, 1):
        options = f"rpm=6&seed={number}&centre={x},{y}&rotation={turn}&reflector=octahedron"
        radar(home, f"emulator://helmet-7?file={home}/helmet-7.toml&{options}")
        until(page, "enrolment.subject && !document.getElementById('capture').disabled && !running")
        page.find_element(By.ID, "capture").click()
        until(page, f"document.querySelectorAll('#captures li').length === {number} && !enrolment.measuring")
        if number == 2:
            size(page, "phone", "dark")
            until(page, "!running")
            take(page, out / "station-enrol-phone-dark.png")
            size(page, "tablet", "light")
    until(page, "enrolment.proposal && enrolment.proposal.ready && !running")
    take(page, out / "station-enrol.png")
    page.find_element(By.ID, "store").click()
    until(page, "enrolment.stored")


def main() -> None:
    out = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parent / "pictures")
    with tempfile.TemporaryDirectory() as home:
        environment = {**os.environ, "TAGID_CONFIG": f"{home}/c.toml", "TAGID_DATA": f"{home}/data"}
        run = [sys.executable, "-m", "tagid", "station", "--bind", "127.0.0.1:0"]
        run += ["--save-dir", f"{home}/out", "--output", "json"]
        radar(home, SCANNED)
        station = subprocess.Popen(run, stdout=subprocess.PIPE, text=True, env=environment)
        page = browser(f"{home}/profile")
        try:
            assert station.stdout is not None
            page.get(json.loads(station.stdout.readline())["data"]["url"])
            size(page, "tablet", "light")
            until(page, "!document.getElementById('scan').disabled")
            page.find_element(By.ID, "profile-button").click()
            until(page, "profile && profile.scans > 60")
            page.find_element(By.ID, "scan").click()
            until(page, "document.getElementById('turn').value > 0.45")
            take(page, out / "station-turning.png")
            until(page, "!running")
            take(page, out / "station-answer.png")
            size(page, "phone", "dark")
            take(page, out / "station-phone-dark.png")
            size(page, "tablet", "light")
            enrol(page, home, out)
            radar(home, ABSENT)
            view(page, "history")
            until(page, "document.querySelectorAll('#history li').length > 3")
            for box in page.find_elements(By.CSS_SELECTOR, "#history input")[:3]:
                box.click()
            page.find_element(By.ID, "report").click()
            until(page, "report && report.complete")
            take(page, out / "station-history.png")
            view(page, "settings")
            until(page, "settings")
            take(page, out / "station-settings.png")
            view(page, "health")
            until(page, "!document.getElementById('wiring').hidden")
            take(page, out / "station-wiring.png")
        finally:
            page.quit()
            station.terminate()
            station.wait(60)


if __name__ == "__main__":
    main()
