"""What a new user does: one command after the other, each with its time and what it says."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

LIMIT_S = 240.0
COLUMNS = 80
OPEN_S = 30.0


@dataclass(frozen=True)
class Step:
    """One thing that a user does.

    Attributes:
        key: by which a check asks for it.
        shown: the command as it is typed, or what is done on the page.
        seconds, cpu_s: on the wall, and of the user's processor time; None on the page.
        code: exit code; None on the page.
        text: what is printed or shown.
    """

    key: str
    shown: str
    seconds: float
    cpu_s: float | None
    code: int | None
    text: str


class Walk:
    """The steps of one role in one checkout, in a folder, registry and configuration of their own."""

    def __init__(self, tree: Path, folder: Path) -> None:
        self.tree, self.folder = tree, folder / "work"
        self.folder.mkdir(parents=True)
        self.steps: list[Step] = []
        self.environment = {
            **os.environ, "PYTHONPATH": str(tree), "TAGID_DATA": str(folder / "data"), "HOME": str(folder),
            "TAGID_CONFIG": str(folder / "config.toml"), "COLUMNS": str(COLUMNS), "OMP_NUM_THREADS": "1",
        }  # fmt: skip

    def read(self, key: str, page: str) -> None:
        """Keep a page or a file of the checkout, whose text a check asks for."""
        path = self.tree / page
        self.note(key, f"read {page}", path.read_text(encoding="utf-8") if path.exists() else "")

    def note(self, key: str, shown: str, text: str, seconds: float = 0.0) -> None:
        """Keep what is seen without a command."""
        self.steps.append(Step(key, shown, seconds, None, None, self.without_paths(text)))

    def without_paths(self, text: str) -> str:
        """A text without the names of this run's folders."""
        return (
            text.replace(f"{self.folder}/", "")
            .replace(f"{self.folder.parent}/", "")
            .replace(f"{self.tree}/", "")
        )

    def tagid(self, key: str, line: str, **options: Any) -> Step:
        """Run a `tagid` command, as typed."""
        return self.run(key, f"tagid {line}", ["-m", "tagid", *shlex.split(line)], **options)

    def run(
        self,
        key: str,
        shown: str,
        words: list[str],
        *,
        hold_s: float = 0.0,
        screen: bool = False,
        limit_s: float = LIMIT_S,
    ) -> Step:
        """Run Python with these words.

        Args:
            hold_s: halt the process for so long, 6 s after its start, as a busy computer does.
            screen: whether its output is a terminal.
            limit_s: after which it is interrupted, as by Ctrl-C.
        """  # fmt: skip
        began = time.monotonic()
        with tempfile.TemporaryFile() as said, contextlib.ExitStack() as stack:
            out: Any = said
            seen = bytearray()
            if screen:
                mine, theirs = pty.openpty()
                os.set_blocking(mine, False)
                stack.callback(os.close, mine)
                out = stack.enter_context(open(theirs, "wb", buffering=0))  # noqa: PTH123
            child = subprocess.Popen(
                [sys.executable, *words], cwd=self.folder, env=self.environment, stdin=subprocess.DEVNULL,
                stdout=out, stderr=out,
            )  # fmt: skip
            asked = False
            while True:
                number, status, usage = os.wait4(child.pid, os.WNOHANG)
                if screen:
                    with contextlib.suppress(BlockingIOError, OSError):
                        seen += os.read(mine, 1 << 20)
                if number:
                    break
                passed = time.monotonic() - began
                if hold_s and passed > 6:
                    child.send_signal(signal.SIGSTOP)
                    time.sleep(hold_s)
                    child.send_signal(signal.SIGCONT)
                    hold_s = 0.0
                if passed > limit_s:
                    child.send_signal(signal.SIGKILL if asked and passed > limit_s + 20 else signal.SIGINT)
                    asked = True
                time.sleep(0.02 if screen else 0.05)
            child.returncode = os.waitstatus_to_exitcode(status)
            said.seek(0)
            text = self.without_paths((bytes(seen) + said.read()).decode(errors="replace"))
        step = Step(key, shown, time.monotonic() - began, usage.ru_utime, child.returncode, text)
        self.steps.append(step)
        return step

    @contextlib.contextmanager
    def emulator(self, line: str) -> Iterator[str]:
        """An emulated device while the block lasts; its URL."""
        with self.background(f"emulate {line} --output json") as process:
            assert process.stdout is not None
            yield str(json.loads(process.stdout.readline())["data"]["url"])

    @contextlib.contextmanager
    def background(self, line: str) -> Iterator[subprocess.Popen[str]]:
        """A `tagid` command that runs while the block lasts."""
        words = [sys.executable, "-m", "tagid", *shlex.split(line)]
        process = subprocess.Popen(
            words, cwd=self.folder, env=self.environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL, text=True,
        )  # fmt: skip
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(OPEN_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def kept(self) -> dict[str, Any]:
        """The steps as JSON values."""
        return {"steps": [asdict(step) for step in self.steps]}
