"""A rig commissioned on the station's page, step by step, with an emulated radar and a real browser.

A decision is a length that is typed, a thing that is put on the table or switched on, a step that is started.
Something is put on the table by starting the emulator with another scene. The seconds are those of the step
in real time; taping and gluing are not in them.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import socket
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from PIL import Image

from tests.benchmarks.measure import started
from tests.benchmarks.provenance import ROOT
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

RIG, PICTURE = "realistic?seed=7", ROOT / "docs" / "pictures" / "commissioning.png"
STEPS = (
    ("link", "empty", ("connect the radar", "axis distance", "height", "target distance", "start")),
    ("room", "empty", ("clear the table", "start")),
    ("target", "target", ("put the target on the table", "start")),
    ("turning", "test-card", ("put the test card there", "switch the table on", "start")),
    ("card", "test-card", ()),
    ("result", "test-card", ()),
)
"""Name, scene, and decisions of a person; a step without any begins when the one before it has passed."""
MOST_S, COLOURS, SHRUNK = 400.0, 64, 2
BUTTON = "document.querySelector(`#c-steps button[data-step=${arguments[0]}]`)"
TYPE = """
const field = document.getElementById(arguments[0]);
field.value = arguments[1];
field.dispatchEvent(new Event('change'));
"""
ROW = f"""
const button = {BUTTON};
const row = button ? button.closest('li') : null;
return row ? [row.className, row.innerText, !button.disabled] : ['', '', false];
"""


def _pictures() -> Any:
    """The script of the pictures of docs/station.md: its browser and sizes serve here."""
    spec = importlib.util.spec_from_file_location("pictures", ROOT / "docs" / "make_station_pictures.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _until(page: Any, step: str, states: tuple[str, ...]) -> tuple[str, str]:
    """State and text of a step once it has one of some states; without them, once it can be started."""
    end = time.monotonic() + MOST_S
    while time.monotonic() < end:
        state, text, ready = page.execute_script(ROW, step)
        if state in states or (ready and not states):
            return state, text
        time.sleep(0.2)
    raise SystemExit(f"the step {step} did not end")


def _sheet(shots: list[Path]) -> None:
    """The screens side by side, at half their size."""
    screens = [Image.open(path).convert("RGB") for path in shots]
    width, height = (side // SHRUNK for side in screens[0].size)
    sheet = Image.new("RGB", (3 * width, -(-len(screens) // 3) * height), "white")
    for number, screen in enumerate(screens):
        sheet.paste(screen.resize((width, height), Image.Resampling.LANCZOS),
                    (number % 3 * width, number // 3 * height))  # fmt: skip
    sheet.quantize(COLOURS).save(PICTURE, optimize=True)


def walk(run: Run) -> Iterator[Table]:
    """What a person does and sees while a rig is commissioned on the page."""
    from tagid.simulate.rig import parse_rig

    rig, script, port = parse_rig(RIG), _pictures(), _free_port()
    run.seeds = RIG
    rows, shots, began = [], [], 0.0
    typed = {
        "c-axis": "1.0",
        "c-height": f"{rig.antenna_height_m:.3f}",
        "c-target": f"{rig.axis_distance_m:.3f}",
    }
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as table:
        config = Path(folder) / "config.toml"
        config.write_text(
            f'[radar]\nurl = "udp://127.0.0.1:{port}"\nintegration = 15\n'
            f'[motion]\nurl = "free?rpm={60 / rig.period_s:.2g}"\naxis_distance_m = 1.0\n'
        )
        environment = {**os.environ, "TAGID_DATA": folder, "TAGID_CONFIG": str(config)}
        with started(["station", "--bind", "127.0.0.1:0"], environment) as station:
            page = script.browser(f"{folder}/profile")
            try:
                script.size(page, "tablet", "light")
                page.get(f"{station['url']}#view-commission")
                for number, (step, scene, acts) in enumerate(STEPS):
                    if acts:
                        table.close()
                        words = f"emulate p440 --bind 127.0.0.1:{port} --rig {RIG} --scene {scene}"
                        table.enter_context(started(words.split(), environment))
                        _until(page, step, ())
                        began = time.monotonic()
                        for field, value in typed.items() if step == "link" else ():
                            page.execute_script(TYPE, field, value)
                        page.execute_script(f"{BUTTON}.click()", step)
                    state, text = _until(page, step, ("passed", "failed"))
                    seconds, began = time.monotonic() - began, time.monotonic()
                    page.execute_script(f"{BUTTON}.closest('li').scrollIntoView({{block: 'center'}})", step)
                    shots.append(Path(folder) / f"{number}.png")
                    script.take(page, shots[-1])
                    first = text.splitlines()[-1] if state == "failed" else ""
                    rows.append((step, "; ".join(acts) or "-", f"{seconds:.0f}", f"{state} {first}".strip()))
                    run.say(f"{step}: {state} in {seconds:.0f} s")
            finally:
                page.quit()
        _sheet(shots)
    minutes = sum(float(row[2]) for row in rows) / 60
    decisions = sum(len(acts) for _, _, acts in STEPS)
    yield Table(
        ("step", "what a person does", "s", "state"),
        rows,
        note=f"{decisions} decisions, {minutes:.1f} minutes of measuring.",
        below=f"![The page after each step](../pictures/{PICTURE.name})",
    )
