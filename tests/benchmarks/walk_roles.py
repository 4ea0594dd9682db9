"""The four roles of the walk: operator, engineer, researcher and batch clerk, at the terminal."""

from __future__ import annotations

import importlib.util
import json
import shutil
import tomllib
from pathlib import Path

from tests.benchmarks.walk_steps import Walk

HAT = """
name = "hat-9"
kind = "helmet"
positions_m = [[0.11, 0.0], [-0.02, 0.09], [-0.05, -0.07], [0.03, -0.09]]
"""
"""A tag of four reflectors that nobody enrolled."""
MINE = "--kind container --point 0.045,0 --point 0.0225,0.039 --point -0.0225,0.039"
"""Three of six places around a mug, which look the same after no part of a turn."""
BARE = "--reflector octahedron:40mm --body none --views 72"
DAMAGED = b"\x89HDF\r\n\x1a\n" + bytes(200)


def first(folder: Path, pattern: str) -> str:
    """The newest file of a pattern."""
    found = sorted(folder.glob(pattern), key=lambda path: path.stat().st_mtime)
    return found[-1].name if found else f"no-{pattern.strip('*.')}"


def operator(walk: Walk) -> None:
    """Scans, refusals and what is said of a radar that does not answer."""
    here = walk.folder
    (here / "hat.toml").write_text(HAT)
    walk.tagid("alone", "")
    walk.tagid("doctor", "doctor")
    walk.tagid("doctor-port", "doctor --radar udp://127.0.0.1:21999")
    walk.tagid("wrong-port", "scan --radar udp://127.0.0.1:21999 --axis-distance 1.0 --motion 'free?rpm=6'")
    walk.tagid("demo", "scan --demo")
    walk.tagid("identify", f"identify {first(here, '*.tagid.h5')}")
    walk.tagid("verbose", f"identify -v {first(here, '*.tagid.h5')}")
    walk.tagid("json", f"identify {first(here, '*.tagid.h5')} --output json")
    walk.tagid("explain", f"identify --explain {first(here, '*.tagid.h5')} --png explain.png")
    walk.tagid("image", f"identify {first(here, '*.image.npz')}")
    walk.tagid("mistyped", "identfy x.tagid.h5")
    with walk.emulator("p440 --bind 127.0.0.1:0 --scene helmet-120 --rpm 6 --truth truth.json") as url:
        place = f"--radar {url} --axis-distance 1.0 --motion 'free?rpm=6'"
        walk.tagid("truth", f"scan {place} --truth truth.json")
        walk.tagid("half", f"scan -q {place} --max-seconds 5")
        walk.tagid("live", f"scan --live {place}", screen=True)
    walk.tagid("enroll-mine", f"enroll mine-01 {MINE} -y --force")
    with walk.emulator("p440 --bind 127.0.0.1:0 --scene mine-01 --rpm 6") as url:
        walk.tagid("rpm-12", f"scan -q --radar {url} --axis-distance 1.0 --motion 'free?rpm=12'")
        walk.tagid("axis-10cm", f"scan -q --radar {url} --axis-distance 1.1 --motion 'free?rpm=6'")
        walk.tagid("axis-again", f"identify {first(here, '*.tagid.h5')} --axis-distance 1.0")
        walk.tagid(
            "axis-sure", f"scan -v --until-sure --radar {url} --axis-distance 1.0 --motion 'free?rpm=6'"
        )
    walk.tagid("hat", f"simulate hat-9 --file hat.toml {BARE} --out hat.tagid.h5")
    walk.tagid("unenrolled", "identify hat.tagid.h5")
    off = "simulate helmet-120 --body helmet --centre 0.02,0 --views 72 --out off-helmet.tagid.h5"
    walk.tagid("off-helmet-made", off)
    walk.tagid("off-helmet", "identify off-helmet.tagid.h5")
    can = "--body can:35mm --reflector octahedron:40mm --centre 0.03,0 --views 72"
    walk.tagid("off-can-made", f"simulate container-90 {can} --out off-can.tagid.h5")
    walk.tagid("off-can", "identify off-can.tagid.h5")
    walk.tagid("empty-made", "simulate empty --noise 0.01 --views 72 --out empty.tagid.h5")
    walk.tagid("empty", "identify empty.tagid.h5")
    walk.tagid("snr-made", "simulate helmet-120 --views 72 --seed 3 --out snr.tagid.h5 --output json")
    walk.tagid("snr-show", "show snr.tagid.h5 --output json")
    walk.tagid("history", "history")
    busy(walk)


def busy(walk: Walk) -> None:
    """A scan with a robot, halted for 0.3 s in the middle, as on a busy computer."""
    with walk.background("emulate roomba --output json") as robot:
        assert robot.stdout is not None
        data = json.loads(robot.stdout.readline())["data"]
        turned = str(data.get("truth") or data.get("truth_url") or "").removeprefix("udp://")
        by = f"--turned-by {turned}" if turned else "--rpm 2"
        with walk.emulator(f"p440 --bind 127.0.0.1:0 --scene helmet-120 {by}") as url:
            line = f"scan --radar {url} --axis-distance 1.0 --motion {data['url']} -y"
            walk.tagid("held", line, hold_s=0.3)


def engineer(walk: Walk) -> None:
    """Layouts designed, printed, enrolled and taken back; a delay measured; slips of the pen."""
    here = walk.folder
    (here / "hat.toml").write_text(HAT)
    walk.tagid("design-8", "layouts design --object helmet --count 8 --prefix site --out site.toml")
    walk.tagid("design-2", "layouts design --object mug --count 2 --prefix mug")
    walk.tagid("design-500", "layouts design --object helmet --count 500")
    walk.tagid("template", "layouts show helmet-120 --template helmet.pdf")
    pdf = (here / "helmet.pdf").read_bytes() if (here / "helmet.pdf").exists() else b""
    walk.note(
        "template-file",
        "look into helmet.pdf",
        f"{len(pdf)} bytes, {'fonts' if b'/Font' in pdf else 'no text'}",
    )
    walk.tagid("sheet", "layouts sheet tags.pdf")
    for number, pose in enumerate(("0.006,-0.002", "-0.004,0.005", "0.001,0.008"), 1):
        pose = f"--centre {pose} --rotation {120 * number} --seed {number}"
        walk.tagid(f"pose-{number}", f"simulate hat-9 --file hat.toml {BARE} {pose} --out {number}.tagid.h5")
    walk.tagid("enroll", "enroll hat-9 1.tagid.h5 2.tagid.h5 3.tagid.h5 --label hat -y")
    walk.tagid("enrolled", "identify 1.tagid.h5")
    walk.tagid("undo", "layouts undo")
    walk.tagid("layouts", "layouts")
    with walk.emulator("p440 --bind 127.0.0.1:0 --scene empty --cable-delay 8000") as url:
        walk.tagid("calibrate-empty", f"radar calibrate --step empty --radar {url}")
    with walk.emulator("p440 --bind 127.0.0.1:0 --scene points-1 --rpm 0 --cable-delay 8000") as url:
        walk.tagid("calibrate-1", f"radar calibrate --step target --distance 1.00 --radar {url}")
        walk.tagid("calibrate-dry", f"radar calibrate --step target --distance 1.00 --dry-run --radar {url}")
        walk.tagid("calibrate-2", f"radar calibrate --step target --distance 2.00 --radar {url}")
    walk.tagid("delay", "config")
    slips = {
        "simulate-scene": "simulate --scene helmet-120 --views 36 --out s.tagid.h5",
        "remove": "layouts remove helmet-linear -y",
        "undo-y": "layouts undo -y",
        "show": "config show",
        "unit": "config set motion.axis_distance_m 100cm",
        "negative": "config set motion.axis_distance_m -1",
        "layout-name": "layouts show helmet120",
        "setting-name": "config set motion.axis_distance 1",
    }
    for key, line in slips.items():
        walk.tagid(key, line)
    walk.read("first-tag", "docs/first-tag.md")


def researcher(walk: Walk) -> None:
    """Images, a volume, a network trained on a few scenes, and the way to the paper's tables."""
    walk.tagid("bare-90", "simulate helmet-120 --views 90 --seed 1 --out bare.tagid.h5")
    walk.tagid("bp", "reconstruct bare.tagid.h5 --method bp --png bp.png --out bp.npz")
    walk.tagid("ats", "reconstruct bare.tagid.h5 --png ats.png --out ats.npz")
    for height in ("0", "0.15", "0.30"):
        walk.tagid(
            f"height-{height}",
            f"simulate helmet-120 --views 36 --antenna-height {height} --out h{height}.tagid.h5",
        )
    walk.tagid("join", "join h0.tagid.h5 h0.15.tagid.h5 h0.30.tagid.h5 --out joined.tagid.h5")
    walk.tagid(
        "volume", "reconstruct joined.tagid.h5 --volume --method bp --heights -0.3,0.3 --out volume.npz"
    )
    walk.read("paper", "docs/paper.md")
    for page in ("README.md", "docs/results.md", "docs/refusals.md", "mkdocs.yml"):
        walk.read(page, page)
    walk.note(
        "api-page", "look for docs/api.md", "there" if (walk.tree / "docs" / "api.md").exists() else "none"
    )
    benchmarks(walk)
    if importlib.util.find_spec("torch"):
        trained(walk)


def benchmarks(walk: Walk) -> None:
    """A quick benchmark without torch, and what it says within a minute."""
    hidden = "import sys; sys.modules['torch'] = None; "
    script = walk.tree / "tests" / "benchmarks" / "bench_imaging.py"
    if script.exists():
        words, name = (
            [str(script), "points", "--quick"],
            "python tests/benchmarks/bench_imaging.py points --quick",
        )
        start = f"import runpy; sys.argv = {words!r}; runpy.run_path(sys.argv[0], run_name='__main__')"
    else:
        words = ["-m", "tests.benchmarks", "imaging-points", "--quick"]
        name = f"python {' '.join(words)}"
        start = f"sys.argv = {words[1:]!r}\nfrom tests.benchmarks.__main__ import main; sys.exit(main())"
    walk.run("no-torch", f"{name} (without torch)", ["-c", hidden + start], limit_s=60)
    walk.run("progress", f"{name} (a minute)", words, limit_s=60)


def trained(walk: Walk) -> None:
    """A data set of a few scenes, one pass, and the export of what it learned."""
    shipped = {path: path.read_bytes() for path in (walk.tree / "models").iterdir() if path.is_file()}
    words = {
        "dataset": ["dataset", "--work", "W", "--scenes", "8", "--jobs", "1", "--ats-every", "0"],
        "fit": ["fit", "--work", "W", "--epochs", "1"],
        "fit-told": ["fit", "--work", "W", "--scenes", "8", "--ats-every", "0", "--epochs", "1"],
        "export": ["export", "--work", "W", "--scenes", "8", "--ats-every", "0", "--epochs", "1"],
    }
    for key, line in words.items():
        walk.run(key, f"python -m train {' '.join(line)}", ["-m", "train", *line])
    changed = [path.name for path, held in shipped.items() if path.read_bytes() != held]
    for path, held in shipped.items():
        if path.name in changed:
            path.write_bytes(held)
    walk.note("models", "look into models/", f"changed: {', '.join(sorted(changed)) or 'nothing'}")


def clerk(walk: Walk) -> None:
    """Reports over a folder with a part of a turn, a copy, a stranger, a damaged file and a dangling link."""
    here = walk.folder
    (here / "hat.toml").write_text(HAT)
    caps = here / "caps"
    caps.mkdir()
    walk.tagid("capture-1", "simulate helmet-120 --views 36 --seed 1 --out caps/helmet.tagid.h5")
    walk.tagid("capture-2", "simulate container-90 --views 36 --seed 2 --out caps/container.tagid.h5")
    walk.tagid(
        "capture-3", f"simulate hat-9 --file hat.toml {BARE.replace('72', '36')} --out caps/hat.tagid.h5"
    )
    walk.tagid("capture-4", "simulate helmet-120 --views 72 --turns 0.425 --seed 4 --out caps/part.tagid.h5")
    shutil.copy(caps / "helmet.tagid.h5", caps / "copy.tagid.h5")
    (caps / "damaged.tagid.h5").write_bytes(DAMAGED)
    (caps / "gone.tagid.h5").symlink_to("nowhere.tagid.h5")
    walk.tagid("part", "identify caps/part.tagid.h5")
    walk.tagid("report", "report caps --out report")
    walk.note("page", "open report/report.html", read(here / "report" / "report.html"))
    walk.note("items", "open report/items.csv", read(here / "report" / "items.csv"))
    walk.note("junit", "open report/junit.xml", read(here / "report" / "junit.xml"))
    walk.tagid("resume", "report caps --out report --resume")
    other = here / "other"
    other.mkdir()
    shutil.copy(caps / "container.tagid.h5", other / "container.tagid.h5")
    walk.tagid("other", "report other --out report")
    walk.tagid("other-resume", "report other --out report --resume")
    arriving = here / "arriving"
    arriving.mkdir()
    shutil.copy(caps / "helmet.tagid.h5", arriving / "first.tagid.h5")
    walk.tagid("watch", "report --watch arriving --out watched --idle-stop 15")


def read(path: Path) -> str:
    """The text of a file, empty where there is none."""
    return path.read_text(encoding="utf-8") if path.exists() else ""


def base_needs(tree: Path) -> list[str]:
    """What an installation without extras brings."""
    return list(tomllib.loads((tree / "pyproject.toml").read_text())["project"]["dependencies"])


ROLES = {"operator": operator, "engineer": engineer, "researcher": researcher, "batch clerk": clerk}
"""In the order of a day."""
