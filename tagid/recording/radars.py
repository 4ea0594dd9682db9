"""Opens the radar of a URL: a P440 on a link, a recording or a simulated scene.

The caller gets the same client for each. Emulated radars need simulation and storage, so this module is above
the radar package.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from tagid.errors import UsageError
from tagid.metadata import ObjectInfo
from tagid.query import MAX_SEED
from tagid.radar.emulation.core import EmulatorCore
from tagid.radar.emulation.faults import Faults
from tagid.radar.emulation.memory import MemoryLink
from tagid.radar.emulation.sources import RecordingSource
from tagid.radar.p440 import P440
from tagid.radar.settings import RadarConfig
from tagid.radar.urls import RadarOptions, open_link, parse_radar_url

if TYPE_CHECKING:
    from tagid.simulate.rig import EmulatedRig
    from tagid.simulate.spec import SceneSpec

_PROBABILITIES: Final = ("lose", "lose_requests", "duplicate", "reorder", "delay")


def open_radar(url: str, timeout: float = 1.0) -> P440:
    """The client of a radar URL, not yet connected (enter it as a context manager).

    Options of every emulated radar: `rate` (emulated seconds per second; 0, the default, never waits)
    and the fault probabilities `lose`, `lose_requests`, `duplicate`, `reorder`, `delay`, with `delay_s`;
    `replay://` also takes `loop=1`. All others, and `seed`, go to the scene.

    Raises:
        UsageError: unknown scheme, bad address, bad option.
        DeviceError: unknown host, no network; port missing, in use or not permitted.
    """
    parsed = parse_radar_url(url)
    if parsed.scheme in ("udp", "serial"):
        return P440(open_link(url)(), timeout)
    query = RadarOptions(f"radar {url!r}", dict(parsed.options))
    rate = query.number("rate", 0.0, 0.0, 1e6)
    levels: dict[str, float] = {
        name: query.number(name, 0.0, 0.0, 1.0) for name in _PROBABILITIES if name in query.given
    }
    if "delay_s" in query.given:
        levels["delay_s"] = query.number("delay_s", 0.0, 0.0, 1e6)
    scene = dict(query.given)
    seed = query.whole("seed", 0, 0, MAX_SEED)
    if parsed.scheme == "emulator":
        from tagid.simulate.spec import SceneSpec, turning_scene

        spec = SceneSpec.from_url(parsed.target, scene)
        rig = rig_of(spec)
        core = EmulatorCore(turning_scene(spec), RadarConfig(), None if rig is None else rig.identity)
        faults = Faults(**{"lose": 0.0 if rig is None else rig.loss, **levels}, seed=seed)
        return P440(MemoryLink(core, rate, faults, url), timeout)
    loop = query.text("loop", "0") not in ("0", "")
    query.done()
    faults = Faults(**levels, seed=seed)
    recording = emulated_recording(Path(parsed.target), loop)
    return P440(MemoryLink(EmulatorCore(recording), rate, faults, url), timeout)


def rig_of(spec: SceneSpec) -> EmulatedRig | None:
    """The emulated rig of a scene; None without one. Raises UsageError, StorageError, FileFormatError."""
    from tagid.simulate.rig import parse_rig

    return None if spec.rig is None else parse_rig(spec.rig)


def emulated_object(url: str) -> ObjectInfo | None:
    """The scene of an emulator:// URL, with its true pose; None for other radars. Raises UsageError."""
    parsed = parse_radar_url(url)
    if parsed.scheme != "emulator":
        return None
    from tagid.simulate.spec import SceneSpec, turning_scene

    radar_options = ("rate", "delay_s", *_PROBABILITIES)
    options = {key: text for key, text in parsed.options.items() if key not in radar_options}
    return turning_scene(SceneSpec.from_url(parsed.target, options)).about()


def emulated_recording(path: Path, loop: bool) -> RecordingSource:
    """A P440 recording or capture as the radar saw it. Raises the reader's errors."""
    from tagid.storage.importers import read_any

    capture = read_any(path)
    settings = capture.radar.config
    if settings is None:
        raise UsageError(
            f"{path} holds no radar settings, so it cannot be replayed as a radar",
            "Replay a P440 recording (.out, .prd) or a capture made by `tagid scan`.",
        )
    config = RadarConfig.of_stored(settings)
    return RecordingSource(capture.samples, config, capture.radar_time_ms, loop)
