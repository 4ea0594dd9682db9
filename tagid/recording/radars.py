"""Opens the radar that a URL names: a P440 on a wire, a recording or a simulated scene.

The caller gets the same client for each. Emulated radars need simulation and storage, so this stands above
the radar package.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from tagid.errors import UsageError
from tagid.metadata import ObjectInfo
from tagid.radar.emulation.core import EmulatorCore
from tagid.radar.emulation.faults import Faults
from tagid.radar.emulation.memory import MemoryLink
from tagid.radar.p440 import P440
from tagid.radar.settings import RadarConfig
from tagid.radar.urls import number_option, open_link, parse_radar_url
from tagid.recording.sources import emulated_recording, emulated_scene

_FAULT_OPTIONS: Final = ("lose", "lose_requests", "duplicate", "reorder", "delay", "delay_s")


def open_radar(url: str, timeout: float = 1.0) -> P440:
    """The client of the radar that a URL names, not connected yet (enter it as a context manager).

    Options that every emulated radar takes: `rate` (emulated seconds per second; 0, the default, never waits)
    and the fault probabilities `lose`, `lose_requests`, `duplicate`, `reorder`, `delay`, with `delay_s`;
    `replay://` also takes `loop=1`. All others, and `seed`, go to the scene.

    Raises:
        UsageError: unknown scheme, bad address, bad option.
        DeviceError: unknown host, no network; no such port, taken or forbidden.
    """
    parsed = parse_radar_url(url)
    if parsed.scheme in ("udp", "serial"):
        return P440(open_link(url)(), timeout)
    options = dict(parsed.options)
    rate = number_option(url, "rate", options.pop("rate", "0"))
    if not 0 <= rate <= 1e6:
        raise UsageError(f"radar {url!r}: rate is {rate}", "Give 1 for real time, 0 for no waiting.")
    levels = {name: number_option(url, name, options.pop(name)) for name in _FAULT_OPTIONS if name in options}
    seed = int(number_option(url, "seed", options.get("seed", "0")))
    faults = Faults(**levels, seed=seed)
    if parsed.scheme == "emulator":
        core = EmulatorCore(emulated_scene(parsed.target, options), RadarConfig())
        return P440(MemoryLink(core, rate, faults, url), timeout)
    loop = options.pop("loop", "0") not in ("0", "")
    options.pop("seed", None)
    if options:
        raise UsageError(
            f"radar {url!r}: option {next(iter(options))!r} is unknown", "replay:// takes rate and loop."
        )
    recording = emulated_recording(Path(parsed.target), loop)
    return P440(MemoryLink(EmulatorCore(recording), rate, faults, url), timeout)


def emulated_object(url: str) -> ObjectInfo | None:
    """What an emulator:// URL shows, with its true pose; None for every other radar. Raises UsageError."""
    parsed = parse_radar_url(url)
    if parsed.scheme != "emulator":
        return None
    own = ("rate", *_FAULT_OPTIONS)
    return emulated_scene(parsed.target, {k: v for k, v in parsed.options.items() if k not in own}).about()
