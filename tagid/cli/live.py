"""The live view of a scan in the terminal: connects the recording's callbacks with the screen."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tagid.cli.frame import Terminal
from tagid.workers import Worker

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import Console, RenderableType
    from rich.live import Live

    from tagid.capture import Capture
    from tagid.live.engine import LiveSettings, LiveView
    from tagid.recording.recorder import Watch

_FRAME_S = 0.1
"""Shortest time between two frames, s; the target is 5 frames per second."""
_JOIN_S = 5.0


@dataclass
class LiveScan:
    """A scan with a live view.

    Attributes:
        view: processes the scans.
        frames: frames drawn.
        first_s, last_s: when the first and the last one were drawn, s.
    """

    view: LiveView
    frames: int = 0
    first_s: float = 0.0
    last_s: float = 0.0

    def watching(self, watch: Watch, resolve: Callable[[Capture, str], Capture]) -> Watch:
        """The callbacks of a recording with those of the view added."""
        from dataclasses import replace

        return replace(watch, began=self.view.began, resolve=self.view.resolving(resolve))

    def facts(self) -> dict[str, Any]:
        """Figures of the live view, as JSON values."""
        spent = self.last_s - self.first_s
        return {
            "frames": self.frames,
            "frames_per_second": (self.frames - 1) / spent if spent > 0 else None,
            "answer_after_last_scan_s": self.view.state.answer_after_s,
        }


@contextmanager
def live_scan(terminal: Terminal, settings: LiveSettings, title: str) -> Iterator[LiveScan]:
    """A live view that is drawn while the block runs, where stderr is a terminal.

    Args:
        terminal: of the command.
        settings: see there.
        title: first line of the screen.
    """
    from rich.console import Console, ConsoleDimensions
    from rich.live import Live

    from tagid.live.engine import LiveView
    from tagid.report.live_screen import bounded

    class BoundedConsole(Console):
        """A terminal may state any size, and every cell of the screen is drawn in every frame."""

        @property  # type: ignore[misc]
        def size(self) -> ConsoleDimensions:
            return ConsoleDimensions(*bounded(super().size))

    console = BoundedConsole(stderr=True, highlight=False)
    with ExitStack() as stack:
        shown = LiveScan(stack.enter_context(LiveView(settings)))
        if console.is_terminal and not terminal.quiet:
            # The last frame stays in view below the other output; the live screen is erased.
            stack.callback(lambda: console.print(_frame(shown, title, console)))
            live = Live(
                console=console,
                screen=True,
                auto_refresh=False,
                get_renderable=lambda: _drawn(shown, title, console),
                redirect_stdout=False,
                redirect_stderr=False,
            )
            stack.enter_context(_Screen(shown.view, stack.enter_context(live)))
        yield shown


class _Screen:
    """Draws each new state in a separate thread, so that a blocked terminal blocks nothing else."""

    def __init__(self, view: LiveView, live: Live) -> None:
        self._view, self._live = view, live
        self._ended = threading.Event()
        self._worker = Worker(self._work, "live-screen", lambda error: view.note("the live screen stopped"))

    def __enter__(self) -> _Screen:
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


def _drawn(shown: LiveScan, title: str, console: Console) -> RenderableType:
    shown.last_s = time.monotonic()
    shown.first_s = shown.first_s or shown.last_s
    shown.frames += 1
    return _frame(shown, title, console)


def _frame(shown: LiveScan, title: str, console: Console) -> RenderableType:
    from tagid.report.live_screen import draw
    from tagid.report.preview import colour_wanted

    size = (console.size.width, console.size.height)
    return draw(shown.view.state, title, size, colour_wanted(console))
