"""`tagid scan`: record one revolution with the radar, image it, name the object."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid import interrupts
from tagid.cli.common import options
from tagid.cli.common.consent import Yes, agree_to
from tagid.cli.common.frame import Terminal, command
from tagid.cli.common.recording import Limits, capture_folder, plan_of, radar_url
from tagid.cli.common.truth import truth_of, with_truth
from tagid.config import Config, load_config
from tagid.constants import CAPTURE_SUFFIX
from tagid.errors import ConfigError, DataError, TagidError, UsageError
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.capture import Capture
    from tagid.metadata import ObjectInfo
    from tagid.pipeline.answer import Identification
    from tagid.pipeline.prepared import PreparedCapture
    from tagid.pipeline.settings import ImagingSettings
    from tagid.recording.plan import RecordingPlan

MAX_REPEAT = 100


@dataclass(frozen=True)
class View:
    """Display options of a scan.

    Attributes:
        preview: also draw the image in the terminal.
        subtract_body: subtract the body's echo from the image.
        live: show image and evidence during the scan.
        until_sure: end the scan as soon as the answer is certain.
    """

    preview: bool
    subtract_body: bool
    live: bool
    until_sure: bool


@dataclass(frozen=True, eq=False)
class _Turn:
    """A recorded revolution and its reading.

    Attributes:
        capture, path: the recording and its file.
        answer: the identification; status "failed" if `error` is set.
        prepared: the prepared capture; None if reading failed.
        error: the error that prevented reading.
        live: figures of the live view; None without one.
        remarks: problems of the recording, one sentence each.
    """

    capture: Capture
    path: Path
    answer: Identification
    prepared: PreparedCapture | None
    error: TagidError | None
    live: dict[str, Any] | None
    remarks: tuple[str, ...]


def register(app: typer.Typer) -> None:
    """Add the command."""

    @command(app, "scan")
    def scan(
        terminal: Terminal,
        radar: options.RadarUrl = None,
        motion: options.MotionUrl = None,
        axis_distance: options.AxisDistance = None,
        antenna_height: options.AntennaHeight = None,
        antenna_separation: options.AntennaSeparation = None,
        cable_delay: options.CableDelay = None,
        scans: Annotated[int | None, typer.Option("--scans", help="Stop after this number of scans.")] = None,
        max_seconds: Annotated[
            float, typer.Option("--max-seconds", help="Stop after this time, seconds.")
        ] = 180.0,
        save_dir: Annotated[Path | None, typer.Option("--save-dir", help="Folder for the files.")] = None,
        method: options.Method = None,
        demo: Annotated[bool, typer.Option("--demo", help="Use an emulated radar and helmet.")] = False,
        demo_scene: Annotated[str, typer.Option("--demo-scene", help="Scene of the demo.")] = "helmet-120",
        preview: options.Preview = False,
        live: Annotated[
            bool, typer.Option("--live", help="Show image and evidence during the scan.")
        ] = False,
        until_sure: Annotated[
            bool,
            typer.Option("--until-sure", help="End the scan, and the motion, once the answer is certain."),
        ] = False,
        note: Annotated[str, typer.Option("--note", help="Text stored in the capture, e.g. a name.")] = "",
        subtract_body: Annotated[
            bool,
            typer.Option(
                "--subtract-body/--keep-body", help="Draw the picture without the echo of a detected body."
            ),
        ] = True,
        repeat: Annotated[
            int, typer.Option("--repeat", help="Number of revolutions to record for one joint answer.")
        ] = 1,
        truth: Annotated[
            Path | None,
            typer.Option(
                "--truth", help="File of emulate --truth, stored in the capture.", show_default=False
            ),
        ] = None,
        heights: Annotated[
            str | None,
            typer.Option(
                "--heights",
                metavar="H,H,...",
                help="Record one revolution from each antenna height, metres, and join them.",
                show_default=False,
            ),
        ] = None,
        yes: Yes = False,
    ) -> Result:
        """Record one revolution of the object, image it and name it.

        Example: tagid scan --radar udp://192.168.1.100 --axis-distance 1.0
        Example: tagid scan --live --motion 'free?rpm=2'
        Example: tagid scan --until-sure --motion 'free?rpm=2'
        Example: tagid scan --heights 0,0.15,0.30 --motion 'free?rpm=2'
        """
        overrides: dict[str, Any] = {
            "radar.url": radar,
            "motion.url": motion,
            "motion.axis_distance_m": axis_distance,
            "motion.antenna_height_m": antenna_height,
            "motion.antenna_separation_m": antenna_separation,
            "radar.cable_delay_ps": cable_delay,
            "imaging.method": method,
            "storage.folder": None if save_dir is None else str(save_dir),
        }
        from tagid.metadata import ObjectInfo

        about = ObjectInfo(note=note or None)
        limits = Limits(scans, max_seconds)
        if not 1 <= repeat <= MAX_REPEAT:
            raise ConfigError(f"--repeat is {repeat}", f"Give 1 to {MAX_REPEAT}.")
        levels = None
        if heights is not None:
            from tagid.cli.scan_heights import Lift, parse_heights, scan_heights

            if repeat > 1 or live or until_sure or preview or antenna_height is not None:
                raise UsageError(
                    "--heights cannot be combined with --repeat, --live, --until-sure, --preview or "
                    "--antenna-height",
                    "Omit them.",
                )
            levels = parse_heights(heights)
        if until_sure and repeat > 1:
            raise ConfigError(
                "--until-sure cannot be combined with --repeat: a joint answer needs whole turns",
                "Omit one of the two.",
            )
        shown = View(preview, subtract_body, live, until_sure)
        if not demo:
            config = load_config(overrides)
            agree_to(config["motion.url"], yes)
            about = with_truth(about, truth_of(config["radar.url"] or "", truth))
            if levels is not None:
                return scan_heights(terminal, config, limits, about, levels, Lift.of(config, yes))
            return _scans(terminal, config, limits, about, shown, repeat)
        from tagid.cli.common.demo import emulated_radar

        with emulated_radar(demo_scene) as there:
            demo_config = load_config({**overrides, **there.settings})
            about = with_truth(replace(about, demo=True), there.object)
            if levels is not None:
                return scan_heights(terminal, demo_config, limits, about, levels, Lift(there.place))
            return _scans(terminal, demo_config, limits, about, shown, repeat)


def _scans(
    terminal: Terminal,
    config: Config,
    limits: Limits,
    about: ObjectInfo,
    view: View,
    repeat: int,
) -> Result:
    """One revolution, or several with a joint answer; captures recorded before a failure are kept."""
    from tagid.cli.identify import vote_on

    turns = [_scan(terminal, config, limits, about, view) for _ in range(repeat)]
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
    limits: Limits,
    about: ObjectInfo,
    view: View,
) -> Result:
    from rich.console import Group, RenderableType
    from rich.text import Text

    from tagid.cli.common import imaging
    from tagid.pipeline.identify import without_body
    from tagid.pipeline.resolve import turn_line
    from tagid.recording.intake import ending_words, notes
    from tagid.storage.image import write_image

    url = radar_url(config)
    folder = capture_folder(config)
    plan = replace(plan_of(config, url, limits, about), renumber=True)
    settings = imaging.settings_from(config)
    turn = _record_and_read(terminal, config, plan, settings, folder, view)
    capture, path, answer = turn.capture, turn.path, turn.answer
    resolved = capture.motion.resolved
    stem = path.name.removesuffix(CAPTURE_SUFFIX)
    png = path.with_name(f"{stem}.png")
    npz = path.with_name(f"{stem}.image.npz")
    drawn: list[RenderableType] = []
    files: dict[str, str | None] = {"capture": str(path), "png": None, "image": None}
    result_errors: tuple[dict[str, str], ...] = ()
    learned: dict[str, Any] = {}
    try:
        if turn.prepared is None:
            raise turn.error or DataError("the capture could not be read")
        shown = without_body(turn.prepared, answer) if view.subtract_body else turn.prepared
        result = imaging.image_with_progress(terminal, shown)
        imaging.draw(result, answer, png)
        write_image(npz, result.image)
        files |= {"png": str(png), "image": str(npz)}
        learned = imaging.learned(result)
        drawn += [Text(line) for line in imaging.learned_words(result)]
        if shown is not turn.prepared:
            drawn.append(Text(imaging.SUBTRACTED[True]))
        if view.preview:
            drawn.append(imaging.in_terminal(result))
        code = imaging.exit_code_of([answer])
    except KeyboardInterrupt as stop:
        raise interrupts.stopped_by_user(stop, _kept(path)) from stop
    except TagidError as error:
        # The recording is stored; only the reading failed.
        answer = imaging.failed(capture.uuid, error)
        remedy = f"{error.remedy} The capture is stored in {path}; inspect it with `tagid show`.".strip()
        result_errors = ({"code": error.code, "message": error.message, "remedy": remedy},)
        code = error.exit_code
    else:
        drawn.append(imaging.describe(answer, ""))
    if line := turn_line(resolved):
        drawn.append(Text(f"turn     {line}"))
    ended = capture.radar.ended
    if view.until_sure and ended is not None:
        drawn.append(Text(f"ended    {ending_words(ended)}"))
    drawn += [Text(f"{name:<8} {where}") for name, where in files.items() if where]
    facts = {
        "views": capture.views,
        "bins": capture.bins,
        "scans_lost": capture.radar.scans_lost or 0,
        "scans_dropped": capture.radar.scans_dropped or 0,
        "gaps": [gap.to_json() for gap in capture.radar.gaps],
        "files": files,
        "motion": {} if resolved is None else {"nominal_rpm": None, **resolved.to_json()},
        "learned": learned,
        "ended": None if ended is None else ended.to_json(),
        **({} if turn.live is None else {"live": turn.live}),
    }
    items = [{"file": str(path), **answer.to_dict()}]
    kept = imaging.remember("scan", items, {"radar": url, "motion": config["motion.url"].public})
    messages = (*notes(capture.radar), *turn.remarks, *kept)
    data = {"items": items, **facts}
    status = "error" if result_errors else "success"
    return Result("scan", data, Group(*drawn), status, code, messages, result_errors)  # type: ignore[arg-type]


def _record_and_read(
    terminal: Terminal,
    config: Config,
    plan: RecordingPlan,
    settings: ImagingSettings,
    folder: Path,
    view: View,
) -> _Turn:
    """Record one revolution and name the object, under a progress line or the live view."""
    from tagid.cli.common import imaging
    from tagid.cli.common.live import LiveScan, live_scan
    from tagid.live.engine import LiveSettings
    from tagid.live.sure import EarlyEnding, check_angle_known, ended_answer
    from tagid.motion.urls import open_motion
    from tagid.pipeline.coverage import ended_early
    from tagid.pipeline.diagnosis import recording_remarks, with_causes
    from tagid.pipeline.identify import identify
    from tagid.pipeline.load import LoadSettings, load_capture
    from tagid.pipeline.prepared import PreparedCapture
    from tagid.pipeline.turn import resolve_turn
    from tagid.recording.intake import ending_words
    from tagid.recording.plan import capture_path
    from tagid.recording.radars import open_radar
    from tagid.recording.recorder import Watch, record
    from tagid.tags.sequential.looks import SPENT

    url = config["radar.url"]
    known = imaging.open_registry().contents()
    motion = open_motion(config["motion.url"])
    if view.until_sure:
        check_angle_known(motion, plan.motion)
    paths: list[Path] = []
    live: LiveScan | None = None
    with ExitStack() as showing:
        watch = Watch(resolve=resolve_turn, named=paths.append)
        radar = open_radar(url, config["radar.timeout_s"])
        early: EarlyEnding | None = None
        needs = LiveSettings(motion, known.layouts, known.signatures, known.version, settings)
        if view.live:
            live = showing.enter_context(live_scan(terminal, needs, f"tagid scan --live   {url}"))
            watch = live.watching(watch, resolve_turn)
        else:
            advance = showing.enter_context(terminal.progress("record", motion.needed_seconds()))
            watch = replace(watch, progress=lambda count, s: advance(s, f"{count} scans, {s:.1f} s"))
        if view.until_sure:
            early = showing.enter_context(EarlyEnding(needs))
            watch = early.watching(watch)
        capture = record(radar, motion, plan, capture_path(folder), watch)
        ended = capture.radar.ended
        if live is not None and view.until_sure:
            live.view.note(f"ended {ending_words(ended)}")
        prepared, failure = None, None
        remarks: tuple[str, ...] = ()
        try:
            loaded = load_capture(capture, LoadSettings.of(config, as_recorded=True))
            remarks = recording_remarks(loaded)
            if early is not None and early.remark:
                remarks = (*remarks, early.remark)
            prepared = PreparedCapture(loaded, settings)
            answer = identify(
                prepared,
                known.layouts,
                registry_version=known.version,
                signatures=known.signatures,
                spent=SPENT if view.until_sure and not ended_early(loaded) else 0.0,
            )
            answer = ended_answer(answer, ended, settings.false_accept)
            if live is not None:
                live.view.settle(loaded, answer)
            # Looking for causes reads the scans several times more: the answer does not wait for them.
            answer = with_causes(answer, prepared, known.layouts)
            if live is not None:
                live.view.explain(answer)
        except KeyboardInterrupt as stop:
            raise interrupts.stopped_by_user(stop, _kept(paths[-1])) from stop
        except TagidError as error:
            prepared, failure, answer = None, error, imaging.failed(capture.uuid, error)
    return _Turn(
        capture, paths[-1], answer, prepared, failure, None if live is None else live.facts(), remarks
    )


def _kept(path: Path) -> str:
    return f"The capture is stored in {path}; read it with `tagid identify {path}`."
