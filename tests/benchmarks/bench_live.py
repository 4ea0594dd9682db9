"""The live view at a P440's pace on one core: frames per second, scans lost, and how late the answer is.

    python tests/benchmarks/bench_live.py [--rpm 6] [--integration 15] [--repeats 3]

The emulated radar runs in a process of its own and is not counted; recording, live view and reading are
pinned to one core. Prints one JSON line per scan.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def main() -> None:
    words = argparse.ArgumentParser()
    words.add_argument("--rpm", type=float, default=6.0)
    words.add_argument("--integration", type=int, default=15)
    words.add_argument("--repeats", type=int, default=3)
    words.add_argument("--scene", default="helmet-120")
    words.add_argument("--unknown-speed", action="store_true", help="the period is found in the scans")
    asked = words.parse_args()
    home = tempfile.mkdtemp()
    os.environ |= {"TAGID_CONFIG": f"{home}/c.toml", "TAGID_DATA": f"{home}/data"}
    command = [sys.executable, "-m", "tagid", "emulate", "p440", "--bind", "127.0.0.1:0"]
    command += ["--scene", asked.scene, "--rpm", str(asked.rpm), "--output", "json"]
    emulator = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert emulator.stdout is not None
        url = json.loads(emulator.stdout.readline())["data"]["url"]
        motion = "free" if asked.unknown_speed else f"free?rpm={asked.rpm:g}"
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
        for _ in range(asked.repeats):
            print(json.dumps(one(url, motion, asked.integration, Path(home))), flush=True)
    finally:
        emulator.terminate()
        emulator.wait()


def one(url: str, motion_url: str, integration: int, folder: Path) -> dict[str, object]:
    """One scan with a live view, and its figures."""
    from tagid.enrolling.registry import Registry
    from tagid.live.engine import LiveSettings, LiveView
    from tagid.live.state import LiveState
    from tagid.motion.urls import open_motion
    from tagid.pipeline.identify import identify
    from tagid.pipeline.prepared import PreparedCapture, load_capture
    from tagid.pipeline.turn import resolve_turn
    from tagid.radar.settings import RadarConfig
    from tagid.recording.plan import RecordingPlan, capture_path, plan_window
    from tagid.recording.radars import open_radar
    from tagid.recording.recorder import Watch, record

    known = Registry(folder / "registry.sqlite").contents()
    config = plan_window(1.0, 0.5, 0.0, RadarConfig(base_integration_index=integration))
    motion = open_motion(motion_url)
    plan = RecordingPlan(config, 1.0, motion=motion_url, renumber=True)
    frames: list[tuple[float, int]] = []

    def tell(state: LiveState) -> None:
        frames.append((time.monotonic(), state.views))

    with LiveView(LiveSettings(motion, known.layouts), tell) as view:
        watch = Watch(resolve=view.resolving(resolve_turn), began=view.began)
        began = time.process_time()
        capture = record(open_radar(url, 2.0), motion, plan, capture_path(folder), watch)
        spent = time.process_time() - began
        during = [at for at, views in frames if views > 1]
        prepared = PreparedCapture(load_capture(capture))
        answer = identify(prepared, known.layouts)
        view.settle(prepared.given, answer)
    seconds = (
        (capture.radar_time_ms[-1] - capture.radar_time_ms[0]) * 1e-3
        if capture.radar_time_ms is not None
        else 0
    )
    return {
        "scans": capture.views,
        "scans_per_second": round(capture.views / seconds, 1),
        "lost": capture.radar.scans_lost,
        "dropped": capture.radar.scans_dropped,
        "frames_with_image": len(during),
        "frames_per_second": round((len(during) - 1) / (during[-1] - during[0]), 2) if during[1:] else None,
        "cpu_share": round(spent / seconds, 2),
        "answer": view.state.answer.reading.layout if view.state.answer else None,
        "answer_after_last_scan_s": round(view.state.answer_after_s or 0.0, 2),
    }


if __name__ == "__main__":
    main()
