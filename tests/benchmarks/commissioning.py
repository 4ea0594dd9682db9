"""Emulated rigs commissioned: random ones with scripted answers, with planted faults, and one on the page.

Every random rig goes through room, target and turning, as `tagid commission` does them; link, test card and
result are left to `tagid commission` on the emulator.

On the station's page a rig is commissioned step by step, with an emulated radar and a real browser. A
decision is a length that is typed, a thing that is put on the table or switched on, a step that is started.
Something is put on the table by starting the emulator with another scene. The seconds are those of the step
in real time; taping and gluing are not in them.
"""

from __future__ import annotations

import contextlib
import math
import os
import socket
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from PIL import Image

from tagid.capture import Pulse
from tagid.commissioning.bench import Bench
from tagid.commissioning.pulse import received_from
from tagid.commissioning.steps import run_step, step_named
from tagid.commissioning.turning import CARD_REFLECTOR
from tagid.config import load_config
from tagid.constants import SAMPLE_STEP_S
from tagid.pipeline.identify import identify
from tagid.pipeline.prepared import PreparedCapture
from tagid.simulate.capture import simulate_capture
from tagid.simulate.rig import NOMINAL_DISTANCE_M, parse_rig
from tagid.simulate.spec import SceneSpec
from tagid.tags.layouts.layout import builtin_layouts
from tests.benchmarks.measure import started, timed
from tests.benchmarks.provenance import ROOT, imported
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table, grouped

TAPE_M = 0.001
SCANS, INTEGRATION = 64, 15
WANTED = {"path_delay_ps": 15.0, "axis_distance_m": 2e-3, "antenna_height_m": 20e-3, "period_s": 1e-3}
"""Largest errors that are wanted; that of the period is relative."""
_SELF_NAMED = "cable loose-antenna polarisation gain other-radar microwave person axis slip missing-reflector"
FAULTS = {
    **{name: name for name in _SELF_NAMED.split()},
    "mirrored-card": "mirrored",
    "direction": "mirrored",
    "near": "near",
}
"""Planted faults, and the code of the row that names each: a card that is mirrored and a table that turns the
other way give the same scans."""
STEPS = (("room", "empty"), ("target", "target"), ("turning", "test-card"))
CARD = ("card", "test-card")
HARD = (
    ("container-90", "can:35mm,handle", 36, 5.0),
    ("container-180", "can:35mm", 18, 5.0),
    ("helmet-120", None, 12, 0.0),
    ("helmet-linear", None, 18, 0.0),
)
"""Layout, body, views and SNR, dB, of scenes that are not always named."""
TURNING_FAULTS = ("axis", "slip", "missing-reflector", "mirrored-card", "direction")


def _through(steps: Sequence[tuple[str, str]], text: str) -> tuple[dict[str, Any], list[str], list[float]]:
    """Values that steps measure on the rig `text`, codes of the faults that they name, and the pulse."""
    rig = parse_rig(text)
    rng = np.random.default_rng([rig.seed, 7])
    tape = {
        "target_distance_m": math.hypot(rig.axis_distance_m, rig.antenna_height_m)
        + TAPE_M * rng.standard_normal(),
        "axis_distance_m": NOMINAL_DISTANCE_M,
        "antenna_height_m": rig.antenna_height_m + TAPE_M * rng.standard_normal(),
        "error_m": TAPE_M,
    }
    values, codes, pulse = {}, [], []
    with tempfile.TemporaryDirectory() as folder:
        os.environ |= {"TAGID_DATA": folder, "TAGID_CONFIG": str(Path(folder) / "config.toml")}
        for step, scene in steps:
            config = load_config(
                {
                    "radar.integration": INTEGRATION,
                    "radar.url": f"emulator://{scene}?rig={quote(text, safe='')}&seed={rng.integers(1000)}",
                    "motion.url": f"free?rpm={60 / rig.period_s:.2g}",
                }
            )
            report = run_step(step_named(step), Bench(config, tape, scans=SCANS))
            values |= report.values
            codes += report.faults
            pulse = pulse or list(report.pulse)
    return values, codes, pulse


def commissioned(job: tuple[int, str]) -> dict[str, Any]:
    """Errors and standard errors of a rig's values, and the codes of the faults that the steps name.

    Args:
        job: seed of the rig and planted fault, empty for none.
    """
    seed, fault = job
    text = f"realistic?seed={seed}" + (f"&fault={fault}" if fault else "")
    rig = parse_rig(text)
    steps = STEPS if fault in TURNING_FAULTS else STEPS[:2]
    values, codes, _ = _through(steps if fault else (*STEPS, CARD), text)
    truth = {
        "path_delay_ps": rig.cable_delay_ps,
        "axis_distance_m": rig.axis_distance_m,
        "antenna_height_m": rig.antenna_height_m,
        "period_s": rig.period_s,
        "system_gain_db": rig.gain_db,
        "speed_variation": rig.speed_variation,
    }
    measured = {
        name: [values[name].value - true, values[name].sigma, true]
        for name, true in truth.items()
        if name in values
    }
    return {"measured": measured, "codes": codes}


def read_on_rig(seed: int) -> dict[str, Any]:
    """Readings of a tag on a rig: with what a tape gives, and with what commissioning measured."""
    layout, body, views, snr_db = HARD[seed % len(HARD)]
    rng = np.random.default_rng([seed, 8])
    centre = tuple(rng.uniform(-0.006, 0.006, 2))
    text, rotation = f"realistic?seed={seed}", rng.uniform(0, 360)
    spec = SceneSpec(layout, rig=text, body=body, centre=centre, rotation=rotation)
    scene, acquisition = spec.build(views=views)
    recorded, _ = simulate_capture(scene, replace(acquisition, snr_db=snr_db, noise_std=None), seed)
    values, _, samples = _through(STEPS, text)
    pulse = Pulse(np.array(samples), SAMPLE_STEP_S)
    states = {
        "tape": replace(recorded, axis_distance_m=NOMINAL_DISTANCE_M, antenna_height_m=0.0, pulse=None),
        "profile": replace(
            recorded,
            axis_distance_m=values["axis_distance_m"].value,
            antenna_height_m=values["antenna_height_m"].value,
            pulse=received_from(pulse, CARD_REFLECTOR)[0],
        ),
    }
    results = {}
    for state, capture in states.items():
        prepared, layouts = PreparedCapture(capture), list(builtin_layouts().values())
        answer, _, seconds = timed(partial(identify, prepared, layouts))
        reading = answer.reading
        name = reading.layout if reading.status == "identified" else None
        bound = math.nan if reading.bound is None else reading.bound.p_value
        results[state] = [name, reading.lead, seconds, bound]
    return results


def hard(run: Run) -> Iterator[Table]:
    results = run.each(read_on_rig, list(run.drawn(48, 2, 1100)))
    rows = []
    for number, some in sorted(grouped(results, lambda seed: seed % len(HARD)).items()):
        layout, body, views, snr_db = HARD[number]
        cells: list[object] = [f"{layout}, {body or 'bare'}, {views} views, {snr_db:g} dB"]
        for state in ("tape", "profile"):
            names, leads, seconds, bounds = zip(*(entry[state] for entry in some), strict=True)
            right, wrong = names.count(layout), sum(name not in (layout, None) for name in names)
            known = [value for value in bounds if math.isfinite(value)]
            bound = f"1 in {1 / np.median(known):.0f}" if known else "-"
            times = (f"{np.median(leads):.1f}", bound, f"{np.median(seconds):.1f}")
            cells += [f"{right} of {len(some)}", wrong, *times]
        rows.append(tuple(cells))
    heads = "named | wrongly | lead | bound | s"
    yield Table(
        f"scene | {heads} | {', profile | '.join(heads.split(' | '))}, profile",
        rows,
        note="Tape: the axis at its nominal metre, up to 10 mm off, height and pulse unknown. Profile: as "
        "`tagid commission` measured them. Leads in nats, bounds of the names (the "
        "share of objects without a tag that are named as convincingly) and seconds of processor time are "
        "medians.",
    )


def rigs(run: Run) -> Iterator[Table]:
    count, faulty = run.number(60, 2), 1 if run.quick else 20
    run.seeds = f"1000 to {1000 + count - 1}; with a planted fault 1000 to {1000 + faulty - 1}"
    jobs = [(1000 + i, fault) for fault in FAULTS for i in range(faulty)]
    jobs += [(1000 + i, "") for i in range(count)]
    results = run.each(commissioned, jobs)
    by_fault = grouped(results, lambda job: job[1])
    errors: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for result in by_fault[""]:
        for name, (error, sigma, true) in result["measured"].items():
            errors[name].append((error / (true if name == "period_s" else 1), error / sigma))
    rows = []
    for name, pairs in errors.items():
        error, ratio = np.abs(np.array(pairs).T)
        sure, wanted = f"{np.sum(ratio <= 2)} of {len(ratio)}", WANTED.get(name)
        within = "" if wanted is None else f"{np.sum(error <= wanted)} of {len(error)} within {wanted:g}"
        rows.append((name, sure, f"{error.max():.2g}", within))
    alarms = sum(bool(result["codes"]) for result in by_fault[""])
    yield Table(
        "value | within two standard errors | largest error | wanted",
        rows,
        note=f"Tape with a standard error of {1e3 * TAPE_M:g} mm, {SCANS} scans a step; the error of the "
        "period is relative. The emulated height is that of the tape. Rigs without a fault "
        "read the test card, too.",
        name="values",
        below=f"False alarms: {alarms} of {count} rigs without a fault.",
    )
    rows = []
    for fault, code in FAULTS.items():
        codes = [result["codes"] for result in by_fault[fault]]
        others = Counter(other for some in codes for other in dict.fromkeys(some) if other != code)
        named = f"{sum(code in some for some in codes)} of {faulty}"
        rows.append((fault, code, named, ", ".join(f"{other} {n}" for other, n in others.most_common())))
    yield Table("planted fault | code | named | other codes", rows, name="faults")


RIG, PICTURE = "realistic?seed=7", ROOT / "docs" / "pictures" / "commissioning.png"
ON_PAGE = (
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
    rig, port = parse_rig(RIG), _free_port()
    script = imported(ROOT / "docs" / "make_station_pictures.py")  # its browser and sizes
    run.seeds = RIG
    rows, shots, began = [], [], 0.0
    typed = {
        "c-axis": "1.0",
        "c-height": f"{rig.antenna_height_m:.3f}",
        "c-target": f"{rig.axis_distance_m:.3f}",
    }
    Path(os.environ["TAGID_CONFIG"]).write_text(
        f'[radar]\nurl = "udp://127.0.0.1:{port}"\nintegration = 15\n'
        f'[motion]\nurl = "free?rpm={60 / rig.period_s:.2g}"\naxis_distance_m = 1.0\n'
    )
    with (
        started(["station", "--bind", "127.0.0.1:0"]) as station,
        script.browser(f"{run.folder}/profile") as page,
        contextlib.ExitStack() as table,
    ):
        script.size(page, "tablet", "light")
        page.get(f"{station['url']}#view-commission")
        for number, (step, scene, acts) in enumerate(ON_PAGE):
            if acts:
                table.close()
                words = f"emulate p440 --bind 127.0.0.1:{port} --rig {RIG} --scene {scene}"
                table.enter_context(started(words.split()))
                _until(page, step, ())
                began = time.monotonic()
                for field, value in typed.items() if step == "link" else ():
                    page.execute_script(TYPE, field, value)
                page.execute_script(f"{BUTTON}.click()", step)
            state, text = _until(page, step, ("passed", "failed"))
            seconds, began = time.monotonic() - began, time.monotonic()
            page.execute_script(f"{BUTTON}.closest('li').scrollIntoView({{block: 'center'}})", step)
            shots.append(run.folder / f"{number}.png")
            script.take(page, shots[-1])
            first = text.splitlines()[-1] if state == "failed" else ""
            rows.append((step, "; ".join(acts) or "-", f"{seconds:.0f}", f"{state} {first}".strip()))
            run.say(f"{step}: {state} in {seconds:.0f} s")
    _sheet(shots)
    minutes = sum(float(row[2]) for row in rows) / 60
    decisions = sum(len(acts) for _, _, acts in ON_PAGE)
    yield Table(
        ("step", "what a person does", "s", "state"),
        rows,
        note=f"{decisions} decisions, {minutes:.1f} minutes of measuring.",
        below=f"![The page after each step](../pictures/{PICTURE.name})",
    )
