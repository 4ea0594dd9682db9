"""`tagid scan --live` on a terminal: the image forms in characters, and the answer follows."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import threading
from pathlib import Path


def test_the_image_forms_on_a_terminal_without_colours(home: dict[str, str], tmp_path: Path) -> None:
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 30, 90, 0, 0))
    environment = {k: v for k, v in home.items() if k not in ("COLUMNS", "NO_COLOR")}
    environment |= {"TERM": "xterm-256color", "COLORTERM": "truecolor", "PYTHONUTF8": "1"}
    environment |= {"TAGID_RADAR_INTEGRATION": "15", "NO_COLOR": "1"}
    child = subprocess.Popen(
        [sys.executable, "-m", "tagid", "scan", "--live", "--radar", "emulator://helmet-120?rpm=60&rate=1&seed=2",
         "--motion", "free?rpm=60", "--axis-distance", "1", "--method", "bp",
         "--save-dir", str(tmp_path / "out"), "--output", "json"],
        stdin=slave, stdout=subprocess.PIPE, stderr=slave, env=environment,
    )  # fmt: skip
    os.close(slave)
    sent = bytearray()

    def read() -> None:
        try:
            while data := os.read(master, 65536):
                sent.extend(data)
        except OSError:  # the other end is closed
            return

    reader = threading.Thread(target=read)
    reader.start()
    out, _ = child.communicate(timeout=120)
    reader.join(timeout=30)
    os.close(master)
    text = sent.decode(errors="replace")
    assert child.returncode == 0, text[-2000:]
    document = json.loads(out)
    assert document["data"]["items"][0]["layout"] == "helmet-120"
    live = document["data"]["live"]
    assert live["frames"] >= 2 and live["answer_after_last_scan_s"] is not None
    assert (document["data"]["scans_lost"], document["data"]["scans_dropped"]) == (0, 0)
    assert "▀" not in text and not re.search(r"\x1b\[[\d;]*[34]8;", text), "no colours"
    screen = re.sub(r"\x1b\[[\d;?]*[A-Za-z]", "", text)
    assert "of 360 deg" in screen
    assert re.search(r"helmet-120 +[#.]+\|[#.]+ +\d+% of 45%", screen), screen[-3000:]
    assert re.search(r"[-=+*#%@]{3}", screen), "the image is not drawn"
