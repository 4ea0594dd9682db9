"""Makes the pictures of docs/station.md: the station's page in a headless Chromium, against an emulated radar.

    python docs/make_station_pictures.py [FOLDER]

Needs `pip install '.[dev]'`, Chromium and chromedriver. Takes one scan in real time.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By

SIZES = {"phone": (390, 844, True), "tablet": (1180, 820, False)}
WAIT_S = 120


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
    """Write a PNG of the screen."""
    shot = page.execute_cdp_cmd("Page.captureScreenshot", {})
    path.write_bytes(base64.b64decode(shot["data"]))


def until(page: Any, script: str) -> None:
    """Wait until a script returns true."""
    end = time.monotonic() + WAIT_S
    while time.monotonic() < end:
        if page.execute_script(f"return {script}"):
            return
        time.sleep(0.1)
    raise SystemExit(f"it did not happen: {script}")


def main() -> None:
    out = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parent / "pictures")
    with tempfile.TemporaryDirectory() as home:
        environment = {**os.environ, "TAGID_CONFIG": f"{home}/c.toml", "TAGID_DATA": f"{home}/data"}
        run = [sys.executable, "-m", "tagid", "station", "--demo", "--bind", "127.0.0.1:0"]
        run += ["--save-dir", f"{home}/out", "--output", "json"]
        station = subprocess.Popen(run, stdout=subprocess.PIPE, text=True, env=environment)
        page = browser(f"{home}/profile")
        try:
            assert station.stdout is not None
            page.get(json.loads(station.stdout.readline())["data"]["url"])
            size(page, "tablet", "light")
            until(page, "!document.getElementById('scan').disabled")
            page.find_element(By.ID, "scan").click()
            until(page, "document.getElementById('turn').value > 0.45")
            take(page, out / "station-turning.png")
            until(page, "document.getElementById('scan').textContent === 'Scan'")
            until(page, "document.querySelectorAll('#health-fine li').length > 3")
            until(page, "document.querySelectorAll('#history li').length > 0")
            take(page, out / "station-answer.png")
            size(page, "phone", "dark")
            take(page, out / "station-phone-dark.png")
        finally:
            page.quit()
            station.terminate()
            station.wait(60)


if __name__ == "__main__":
    main()
