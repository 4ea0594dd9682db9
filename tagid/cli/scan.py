"""`tagid scan`: record one revolution with the radar, image it, name the object."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid import interrupts
from tagid.cli import options
from tagid.cli.consent import Yes, agree_to
from tagid.cli.frame import Terminal, command
from tagid.cli.options import SECONDS
from tagid.config import load_config
from tagid.errors import ConfigError, TagidError, UsageError
from tagid.result import Problem, Result
from tagid.workers import Worker

if TYPE_CHECKING:
    from rich.live import Live

    from tagid.cli.imaging import Screen
    from tagid.live.engine import LiveSettings, LiveView
    from tagid.metadata import ObjectInfo
    from tagid.operate.turn import Answer, Recorded
    from tagid.operate.workplace import Workplace
    from tagid.recording.plan import RecordingPlan
    from tagid.result import Drawn

MAX_REPEAT = 100


@dataclass(frozen=True)
class _ViewOptions:
    """What a scan shows and how long it lasts, and a note on it."""

    preview: options.Preview = False
    live: Annotated[bool, typer.Option("--live", help="Show image and evidence during the scan.")] = False
    until_sure: Annotated[
        bool,
        typer.Option(
            "--until-sure", help="End scan and motion once a bare tag of three reflectors or more is certain."
        ),
    ] = False
    note: Annotated[str, typer.Option(help="Text stored in the capture, e.g. a name.")] = ""
    subtract_body: Annotated[
        bool,
        typer.Option(
            "--subtract-body/--keep-body", help="Draw the picture without the echo of a detected body."
        ),
    ] = True


@command("scan")
def scan(
    terminal: Terminal,
    radar: options.RadarUrl = None,
    setup: options.SetupOptions = options.SetupOptions(),
    cable_delay: options.CableDelay = None,
    scans: Annotated[int | None, typer.Option(help="Stop after this number of scans.")] = None,
    max_seconds: Annotated[
        float, typer.Option(parser=SECONDS, help="Stop after this time, seconds.")
    ] = 180.0,
    save_dir: Annotated[Path | None, typer.Option(help="Folder for the files.")] = None,
    method: options.Method = None,
    demo: Annotated[bool, typer.Option("--demo", help="Use an emulated radar and helmet.")] = False,
    demo_scene: Annotated[str, typer.Option(help="Scene of the demo.")] = "helmet-120",
    view: _ViewOptions = _ViewOptions(),
    repeat: Annotated[int, typer.Option(help="Number of revolutions to record for one joint answer.")] = 1,
    truth: Annotated[
        Path | None, typer.Option(help="File of emulate --truth, stored in the capture.")
    ] = None,
    heights: Annotated[
        str | None,
        typer.Option(
            metavar="H,H,...", help="Record one revolution from each antenna height, metres, and join them."
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
        **setup.settings(),
        "radar.cable_delay_ps": cable_delay,
        "imaging.method": method,
        "storage.folder": None if save_dir is None else str(save_dir),
    }
    from tagid.metadata import ObjectInfo
    from tagid.operate.workplace import Workplace

    about = ObjectInfo(note=view.note or None, demo=demo or None)
    if not 1 <= repeat <= MAX_REPEAT:
        raise ConfigError(f"--repeat is {repeat}", f"Give 1 to {MAX_REPEAT}.")
    levels = None
    if heights is not None:
        from tagid.cli.scan_heights import Lift, parse_heights, scan_heights

        if repeat > 1 or view.live or view.until_sure or view.preview or setup.antenna_height is not None:
            raise UsageError(
                "--heights cannot be combined with --repeat, --live, --until-sure, --preview or "
                "--antenna-height",
                "Omit them.",
            )
        levels = parse_heights(heights)
    if view.until_sure and repeat > 1:
        raise ConfigError(
            "--until-sure cannot be combined with --repeat: a joint answer needs whole turns",
            "Omit one of the two.",
        )
    config = load_config(overrides | (options.demo_settings(demo_scene, overrides) if demo else {}))
    agree_to(config["motion.url"], yes)
    about = _with_truth(about, _truth_of(config["radar.url"] or "", truth))
    place = Workplace(config)
    plan = partial(place.plan, scans, max_seconds, about)
    if levels is not None:
        return scan_heights(terminal, place, plan, levels, Lift.of(place, yes))
    turns: list[Result] = []
    with interrupts.naming(lambda: _all_kept(turns)):
        for _ in range(repeat):
            turns.append(_scan(terminal, place, plan, view))
    if repeat > 1 and not any(turn.errors for turn in turns):
        return _joint(terminal, place, turns)
    return next((turn for turn in turns if turn.errors), turns[-1])


def _joint(terminal: Terminal, place: Workplace, turns: list[Result]) -> Result:
    """The joint answer of several revolutions."""
    from tagid.cli.identify import vote_on

    files = [Path(turn.data["files"]["capture"]) for turn in turns]
    joint = vote_on(terminal, place, files, "scan")
    facts = [{key: value for key, value in turn.data.items() if key != "items"} for turn in turns]
    messages = tuple(dict.fromkeys(m for turn in turns for m in turn.messages)) + joint.messages
    return replace(joint, data={"items": joint.data["items"], "turns": facts}, messages=messages)


def _scan(
    terminal: Terminal, place: Workplace, planned: Callable[[], RecordingPlan], view: _ViewOptions
) -> Result:
    """Record one revolution, name the object, draw it, and store the answer."""
    from tagid.cli import imaging
    from tagid.operate.turn import draw, failed, picture_of
    from tagid.operate.words import SUBTRACTED, ending_words, learned_words, turn_line
    from tagid.report.arrays import write_image

    url = place.radar_url()
    plan = planned()
    recorded, answer, live, messages = _record_and_read(terminal, place, plan, view)
    capture, path = recorded.capture, recorded.path
    resolved, ended = capture.motion.resolved, capture.radar.ended
    png = picture_of(path)
    npz = png.with_suffix(".image.npz")
    drawn: list[Drawn] = []
    details: list[str] = []
    files: dict[str, str | None] = {"capture": str(path), "png": None, "image": None}
    errors: tuple[Problem, ...] = ()
    learned: dict[str, Any] = {}
    try:
        with terminal.progress("image", total=1.0) as advance:
            picture = draw(answer, png, view.subtract_body, imaging.share_of(advance))
        result = picture.result
        write_image(npz, result.image)
        files |= {"png": str(png), "image": str(npz)}
        learned = imaging.learned(result)
        details += learned_words(result)
        if picture.body_subtracted:
            details.append(SUBTRACTED[True])
        if view.preview:
            drawn.append(imaging.in_terminal(result))
    except KeyboardInterrupt as stop:
        raise interrupts.stopped_by_user(stop, _kept(path)) from stop
    except TagidError as error:
        # The recording is stored; only the reading failed.
        answer = answer if answer.error else failed(error, str(path), uuid=capture.uuid)
        stored = f"The capture is stored in {path}; inspect it with `tagid show`."
        errors = (Problem.of(error.with_remedy(stored)),)
        code = error.exit_code
    else:
        code = imaging.exit_code_of([answer.identification])
        drawn.insert(0, imaging.describe(answer, "", terminal.verbose > 0))
    drawn.append(f"  saved {imaging.saved(files)}")
    if line := turn_line(resolved):
        details.append(f"turn: {line}")
    if ended is not None:
        details.append(f"ended: {ending_words(ended)}")
    drawn += [f"  {line}" for line in details if terminal.verbose]
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
        **({} if live is None else {"live": live}),
    }
    items = [answer.to_dict()]
    kept = place.remember("scan", items, {"radar": url, "motion": plan.motion})
    return Result(
        "scan",
        {"items": items, **facts},
        drawn,
        exit_code=code,
        messages=(*answer.remarks, *messages, *place.without_profile(answer), *kept),
        errors=errors,
    )


def _record_and_read(
    terminal: Terminal, place: Workplace, plan: RecordingPlan, view: _ViewOptions
) -> tuple[Recorded, Answer, dict[str, Any] | None, tuple[str, ...]]:
    """Record one revolution and name the object, under a progress line or the live view.

    Returns the recording, its answer, figures of the live view, and remarks of an early ending.
    """
    from tagid.live.engine import LiveSettings
    from tagid.live.sure import EarlyEnding, check_angle_known
    from tagid.motion.urls import open_motion
    from tagid.operate.turn import read, record_turn
    from tagid.operate.words import ending_words
    from tagid.pipeline.turn import resolve_turn
    from tagid.reading.looks import SPENT
    from tagid.recording.recorder import Watch

    setup = place.setup(as_recorded=True)
    enrolled = setup.enrolled
    motion = open_motion(place.config["motion.url"])
    if view.until_sure:
        check_angle_known(motion, plan.motion)
        plan = replace(plan, spent=SPENT)
    live: LiveView | None = None
    figures: dict[str, Any] | None = None
    early: EarlyEnding | None = None
    with ExitStack() as showing:
        watch = Watch(resolve=resolve_turn)
        needs = LiveSettings(motion, enrolled.layouts, enrolled.signatures, enrolled.version, setup.imaging)
        if view.live:
            title = f"tagid scan --live   {place.radar_url()}"
            live, screen = showing.enter_context(_live_scan(terminal, needs, title))
            watch = replace(watch, began=live.began, resolve=live.resolving(resolve_turn))
        else:
            advance = showing.enter_context(terminal.progress("record", motion.needed_seconds()))
            watch = replace(watch, progress=lambda count, s: advance(s, f"{count} scans, {s:.1f} s"))
        if view.until_sure:
            early = showing.enter_context(EarlyEnding(needs))
            watch = early.watching(watch)
        recorded = record_turn(place, plan, motion, watch)
        if live is not None and view.until_sure:
            live.note(f"ended {ending_words(recorded.capture.radar.ended)}")
        try:
            answer = read(setup, recorded.capture, recorded.path, live)
        except KeyboardInterrupt as stop:
            raise interrupts.stopped_by_user(stop, _kept(recorded.path)) from stop
    messages = () if early is None or not early.remark else (early.remark,)
    if live is not None:
        figures = screen.facts() | {"answer_after_last_scan_s": live.state.answer_after_s}
    return recorded, answer, figures, messages


def _kept(path: Path | str) -> str:
    return f"The capture is stored in {path}; read it with `tagid identify {path}`."


def _all_kept(turns: list[Result]) -> str:
    """The revolutions before an error, and how to go on with them; "" if there are none."""
    files = [turn.data["files"]["capture"] for turn in turns]
    if len(files) < 2:
        return "".join(map(_kept, files))
    names = " ".join(files)
    return f"{len(files)} captures are stored; `tagid identify --vote {names}` gives their joint answer."


_FRAME_S = 0.1
"""Shortest time between two frames, s; the target is 5 frames per second."""
_JOIN_S = 5.0


@contextmanager
def _live_scan(terminal: Terminal, settings: LiveSettings, title: str) -> Iterator[tuple[LiveView, Screen]]:
    """A live view that is drawn while the block runs, where stderr is a terminal, and its screen."""
    from rich.console import Console, ConsoleDimensions
    from rich.live import Live

    from tagid.cli.imaging import Screen
    from tagid.live.engine import LiveView
    from tagid.report.live_screen import bounded, draw

    class BoundedConsole(Console):
        """A terminal may state any size, and every cell of the screen is drawn in every frame."""

        @property  # type: ignore[misc]
        def size(self) -> ConsoleDimensions:
            return ConsoleDimensions(*bounded(super().size))

    console = BoundedConsole(stderr=True, highlight=False)
    with ExitStack() as stack:
        view = stack.enter_context(LiveView(settings))
        screen = Screen(console, title, lambda: view.state, draw)
        if console.is_terminal and not terminal.quiet:
            # The last frame stays in view below the other output; the live screen is erased.
            stack.callback(lambda: console.print(screen.frame()))
            live = Live(
                console=console,
                screen=True,
                auto_refresh=False,
                get_renderable=screen.counted_frame,
                redirect_stdout=False,
                redirect_stderr=False,
            )
            stack.enter_context(_Refreshing(view, stack.enter_context(live)))
        yield view, screen


class _Refreshing:
    """Draws each new state in a separate thread, so that a blocked terminal blocks nothing else."""

    def __init__(self, view: LiveView, live: Live) -> None:
        self._view, self._live = view, live
        self._ended = threading.Event()
        self._worker = Worker(self._work, "live-screen", lambda error: view.note("the live screen stopped"))

    def __enter__(self) -> _Refreshing:
        with suppress(RuntimeError):
            self._worker.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._worker.join(_JOIN_S)

    def _work(self) -> None:
        drawn = -1
        while not self._ended.wait(_FRAME_S):
            if (frame := self._view.state.frame) != drawn:
                drawn = frame
                self._live.refresh()


def _truth_of(url: str, file: Path | None) -> ObjectInfo | None:
    """The object of an emulated radar, from its file or its emulator:// URL; None for a real radar."""
    from tagid.recording.radars import emulated_object

    if file is not None:
        from tagid.cli.emulate import read_truth

        return read_truth(file)
    return emulated_object(url) if url else None


def _with_truth(about: ObjectInfo, truth: ObjectInfo | None) -> ObjectInfo:
    """The operator's remarks, and the truth of the emulated object."""
    if truth is None:
        return about
    stated = {field.name: getattr(about, field.name) for field in fields(about) if field.name != "extra"}
    return replace(truth, **{name: value for name, value in stated.items() if value not in (None, ())})
