"""`tagid scan`: record one turn with the radar, image it, name the object."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid.cli import options
from tagid.cli.consent import Yes, agree_to
from tagid.cli.frame import Terminal, command
from tagid.config import Config, load_config
from tagid.errors import ConfigError, StorageError, TagidError
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.radar.settings import RadarConfig
    from tagid.recorder import RecordingPlan


MAX_REPEAT = 100


def register(app: typer.Typer) -> None:
    """Add the command."""

    @command(app, "scan")
    def scan(
        terminal: Terminal,
        radar: options.RadarUrl = None,
        motion: options.MotionUrl = None,
        axis_distance: options.AxisDistance = None,
        antenna_height: options.AntennaHeight = None,
        cable_delay: options.CableDelay = None,
        scans: Annotated[int | None, typer.Option("--scans", help="Stop after so many scans.")] = None,
        max_seconds: Annotated[float, typer.Option("--max-seconds", help="Stop after so long.")] = 180.0,
        save_dir: Annotated[Path | None, typer.Option("--save-dir", help="Folder for the files.")] = None,
        method: options.Method = None,
        demo: Annotated[bool, typer.Option("--demo", help="Use an emulated radar and helmet.")] = False,
        demo_scene: Annotated[str, typer.Option("--demo-scene", help="What the demo turns.")] = "helmet-120",
        preview: options.Preview = False,
        note: Annotated[str, typer.Option("--note", help="Kept in the capture, e.g. a name.")] = "",
        repeat: Annotated[
            int, typer.Option("--repeat", help="Record so many turns and answer from all of them.")
        ] = 1,
        yes: Yes = False,
    ) -> Result:
        """Record one turn of the object, image it and name it.

        Example: tagid scan --radar udp://192.168.1.100 --axis-distance 1.0
        """
        overrides: dict[str, Any] = {
            "radar.url": radar,
            "motion.url": motion,
            "motion.axis_distance_m": axis_distance,
            "motion.antenna_height_m": antenna_height,
            "radar.cable_delay_ps": cable_delay,
            "imaging.method": method,
            "storage.folder": None if save_dir is None else str(save_dir),
        }
        about = {"note": note} if note else {}
        limits = (scans, max_seconds)
        if not 1 <= repeat <= MAX_REPEAT:
            raise ConfigError(f"--repeat is {repeat}", f"Give 1 to {MAX_REPEAT}.")
        if not demo:
            config = load_config(overrides)
            agree_to(config["motion.url"], yes)
            return _scans(terminal, config, limits, about, preview, repeat)
        from tagid.cli.demo import emulated_radar

        with emulated_radar(demo_scene) as there:
            demo_config = load_config({**overrides, **there})
            return _scans(terminal, demo_config, limits, {**about, "demo": True}, preview, repeat)


def _scans(
    terminal: Terminal,
    config: Config,
    limits: tuple[int | None, float],
    about: dict[str, Any],
    preview: bool,
    repeat: int,
) -> Result:
    """One turn, or several and one answer from all of them; what was recorded before a failure is kept."""
    from tagid.cli.identify import vote_on

    turns = [_scan(terminal, config, limits, about, preview) for _ in range(repeat)]
    if repeat == 1 or any(turn.errors for turn in turns):
        return next((turn for turn in turns if turn.errors), turns[-1])
    files = [Path(turn.data["files"]["capture"]) for turn in turns]
    joint = vote_on(files, config, "mean", "scan")
    facts = [{key: value for key, value in turn.data.items() if key != "items"} for turn in turns]
    messages = tuple(dict.fromkeys(m for turn in turns for m in turn.messages)) + joint.messages
    return replace(joint, data={"items": joint.data["items"], "turns": facts}, messages=messages)


def _scan(
    terminal: Terminal,
    config: Config,
    limits: tuple[int | None, float],
    about: dict[str, Any],
    preview: bool,
) -> Result:
    from rich.console import Group, RenderableType
    from rich.text import Text

    from tagid.cli import imaging
    from tagid.intake import notes
    from tagid.motion.resolve import turn_line
    from tagid.motion.urls import open_motion
    from tagid.pipeline import identify, prepare
    from tagid.radar.devices import open_radar
    from tagid.recorder import Watch, capture_path, record
    from tagid.sources import Sources
    from tagid.storage.image import write_image
    from tagid.turn import resolve_turn

    url = config["radar.url"]
    if not url:
        raise ConfigError(
            "no radar is configured",
            "Give --radar udp://192.168.1.100, or keep it with `tagid config set radar.url udp://...`; "
            "`tagid scan --demo` shows a scan without a radar.",
        )
    folder = Path(config["storage.folder"] or ".")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot make the folder {folder}: {error.strerror}", "Choose another.") from None
    plan = plan_of(config, url, limits, about)
    layouts_registry = imaging.open_registry()
    layouts, version = layouts_registry.layouts(), layouts_registry.version
    motion = open_motion(config["motion.url"])
    paths: list[Path] = []
    with terminal.progress("record", motion.needed_seconds()) as advance:
        capture = record(
            open_radar(url, Sources(), config["radar.timeout_s"]),
            motion,
            replace(plan, renumber=True),
            capture_path(folder),
            Watch(
                lambda count, seconds: advance(seconds, f"{count} scans, {seconds:.1f} s"),
                resolve_turn,
                named=paths.append,
            ),
        )
    path = paths[-1]
    stem = path.name.removesuffix(".tagid.h5")
    png = path.with_name(f"{stem}.png")
    npz = path.with_name(f"{stem}.image.npz")
    drawn: list[RenderableType] = []
    settings = imaging.settings_from(config)
    files: dict[str, str | None] = {"capture": str(path), "png": None, "image": None}
    result_errors: tuple[dict[str, str], ...] = ()
    learned: dict[str, Any] = {}
    try:
        prepared = prepare(capture, None if capture.angles_rad is not None else config["motion.url"])
        answer = identify(prepared, layouts, settings, version)
        result = imaging.image_with_progress(terminal, prepared, settings)
        imaging.draw(result, answer, png)
        write_image(npz, result.image)
        files |= {"png": str(png), "image": str(npz)}
        learned = imaging.learned(result)
        drawn += [Text(line) for line in imaging.learned_words(result)]
        if preview:
            drawn.append(imaging.in_terminal(result))
        code = imaging.exit_code_of([answer])
    except TagidError as error:
        # The recording is safe; only what was to be read from it failed.
        answer = imaging.failed(capture.uuid, error)
        remedy = f"{error.remedy} The capture is kept in {path}; `tagid show` looks into it.".strip()
        result_errors = ({"code": error.code, "message": error.message, "remedy": remedy},)
        code = error.exit_code
    else:
        drawn.append(imaging.describe(answer, ""))
    if turn := turn_line(capture.motion.get("resolved", {})):
        drawn.append(Text(f"turn     {turn}"))
    drawn += [Text(f"{name:<8} {where}") for name, where in files.items() if where]
    lost, dropped = (capture.radar.get(f"scans_{how}") or 0 for how in ("lost", "dropped"))
    facts = {
        "views": capture.views,
        "bins": capture.bins,
        "scans_lost": lost,
        "scans_dropped": dropped,
        "gaps": capture.radar.get("gaps") or [],
        "files": files,
        "motion": capture.motion.get("resolved", {}),
        "learned": learned,
    }
    items = [{"file": str(path), **answer.to_dict()}]
    kept = imaging.remember("scan", items, {"radar": url, "motion": config["motion.url"]})
    messages = (*notes(capture.radar), *kept)
    data = {"items": items, **facts}
    status = "error" if result_errors else "success"
    return Result("scan", data, Group(*drawn), status, code, messages, result_errors)  # type: ignore[arg-type]


def plan_of(
    config: Config, url: str, limits: tuple[int | None, float], about: dict[str, Any]
) -> RecordingPlan:
    """What to record: limits are the number of scans and the longest time. Raises ConfigError."""
    from tagid.motion.urls import public_url
    from tagid.recorder import RecordingPlan

    scans, max_seconds = limits
    if scans is not None and not 1 <= scans <= 65534:
        raise ConfigError(f"--scans is {scans}", "Give 1 to 65534.")
    if not 0 < max_seconds <= 86400:
        raise ConfigError(f"--max-seconds is {max_seconds}", "Give a positive number of seconds.")
    return RecordingPlan(
        _window(config, url),
        config["motion.axis_distance_m"],
        config["motion.antenna_height_m"],
        config["radar.cable_delay_ps"],
        scans,
        max_seconds,
        public_url(config["motion.url"]),
        about,
        config["radar.resume_s"],
    )


def _window(config: Config, url: str) -> RadarConfig | None:
    """The radar settings to ask for; None leaves a replayed recording its own."""
    from tagid.radar.settings import RadarConfig
    from tagid.recorder import plan_window

    distance = config["motion.axis_distance_m"]
    if url.startswith("replay://"):
        return None
    base = RadarConfig(
        base_integration_index=config["radar.integration"],
        transmit_gain=config["radar.gain"],
        antenna_mode=config["radar.antenna_mode"],
    )
    if distance is None:
        raise ConfigError(
            "the distance from the radar to the rotation axis is not known",
            "Measure it to a centimetre or two and give --axis-distance METRES, or keep it with "
            "`tagid config set motion.axis_distance_m METRES`.",
        )
    return plan_window(distance, config["imaging.extent_m"], config["radar.cable_delay_ps"], base)
