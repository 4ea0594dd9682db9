"""A pass-key leaves neither the configuration nor the command line; names that tagid chooses are no links."""

from __future__ import annotations

import ctypes
import errno
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tagid.errors import UsageError
from tagid.motion.urls import open_motion, parse_motion_url
from tagid.radar.urls import parse_radar_url
from tagid.secret import MotionUrl, Secret

KEY = "918273"
URL = f"roomba+ble://R2?passkey={KEY}&wait=1"
FAULTY = (
    f"roomba+ble://R2?passkey={KEY}x",
    f"roomba+ble://R2?passkey={KEY}&passkey={KEY}",
    f"roomba+ble://R2?pass%6bey={KEY}&step=99",
    f"roomba+ble://R2?PassKey={KEY}",
    f"roomba+ble://R2?pass-key={KEY};{KEY}",
    f"roomba+ble://R2?wait=99#passkey={KEY}",
    f"roomba+ble://R2?{KEY}",
    f"free?rpm=2&passkey={KEY}",
    f"passkey={KEY}",
    f"roomba+ble://R2?wait=1,passkey={KEY}",
    f"roomba+ble://R2?step=2 passkey={KEY}",
)
WRONG_PLACES = (
    f"R2&passkey={KEY}",
    f"R2;passkey={KEY}",
    f"passkey={KEY}@R2",
    f"R2:{KEY}",
    f"{KEY}@R2",
    f":passkey={KEY}",
)


@pytest.mark.parametrize("target", WRONG_PLACES)
def test_a_key_in_the_wrong_place_is_hidden(target: str) -> None:
    url = f"roomba+ble://{target}"
    assert KEY not in str(MotionUrl(url)) + MotionUrl(url).public
    with pytest.raises(UsageError) as refused:
        parse_radar_url(f"roomba+ble://R2?passkey={KEY}")
    assert KEY not in refused.value.message
    for plain in ("roomba+ble://AA:BB:CC:11:22:33?hci=hci1", "comxim+serial:///dev/ttyUSB0?baud=115200"):
        assert str(MotionUrl(plain)) == MotionUrl(plain).public == plain


def test_a_secret_cannot_be_printed() -> None:
    secret = Secret(KEY)
    texts = (str(secret), repr(secret), f"{secret}", f"{secret:>9}", repr([secret]))
    assert not any(KEY in text for text in texts) and secret.reveal() == KEY
    options = parse_motion_url(f"roomba+ble://R2?pass%6bey={KEY}&step=3")
    assert KEY not in repr(options) and options.url == "roomba+ble://R2?step=3"
    assert options.passkey == secret
    assert MotionUrl(f"roomba+ble://R2?pass%6bey={KEY}").public == "roomba+ble://R2"
    with pytest.raises(TypeError):
        import pickle

        pickle.dumps(MotionUrl(URL))


@pytest.mark.parametrize("url", FAULTY)
def test_no_error_about_a_url_holds_its_pass_key(url: str) -> None:
    with pytest.raises(UsageError) as refused:
        open_motion(url)
    assert (
        KEY not in refused.value.message + refused.value.remedy + str(MotionUrl(url)) + MotionUrl(url).public
    )


def test_nothing_that_is_written_or_printed_holds_the_pass_key(
    tagid, home: dict[str, str], tmp_path: Path
) -> None:
    printed = []

    def run(*words: str, code: int = 0, **more: str) -> None:
        done = tagid(*words, **more)
        printed.append(done.out + done.err)
        assert done.code == code, (words, done.err)

    run("simulate", "helmet-120", "--views", "24", "--out", "a.tagid.h5")
    run("identify", "a.tagid.h5", "--motion", URL, "--output", "json")
    run("config", "set", "motion.url", URL)
    run("config", "set", "motion.passkey", KEY, "--output", "json")
    config = Path(home["TAGID_CONFIG"])
    assert config.read_text().count(KEY) == 2
    run("config")
    run("config", "--output", "json")
    run("config", TAGID_MOTION_URL=URL)
    run("report", "a.tagid.h5", "--out", "rep", "--jobs", "1", "--verbose")
    run("motion", "info", FAULTY[0], code=2)
    run("config", "set", "motion.url", FAULTY[0], code=2)
    run("config", "set", "motion.passkey", KEY + "x")
    run("motion", "info", "roomba+ble://R2", code=2)
    config.unlink()
    assert not any(KEY in text for text in printed)
    assert "roomba+ble://R2?passkey=***&wait=1" in printed[4]
    written = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert {"report.html", "summary.json", "history.sqlite"} <= {path.name for path in written}
    assert [path for path in written if KEY.encode() in path.read_bytes()] == []


def test_a_key_in_the_url_is_kept_private(tagid, home: dict[str, str]) -> None:
    assert tagid("config", "set", "motion.url", URL).code == 0
    Path(home["TAGID_CONFIG"]).chmod(0o644)
    refused = tagid("motion", "info")
    assert refused.code == 2 and "chmod 600" in refused.err


def test_a_planted_link_is_replaced_and_one_that_the_user_names_is_followed(tagid, tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("precious")
    for name in ("a.show.png", "rep/report.html", "rep/items.jsonl", "rep/.tagid-report.sqlite"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).symlink_to(precious)
    assert tagid("simulate", "empty", "--views", "12", "--out", "a.tagid.h5").code == 0
    assert tagid("show", "a.tagid.h5").code == 0
    assert tagid("report", "a.tagid.h5", "--out", "rep", "--jobs", "1").code == 3
    assert precious.read_text() == "precious"
    assert not any(path.is_symlink() for path in tmp_path.rglob("*"))
    (tmp_path / "latest.png").symlink_to("drawn.png")
    assert tagid("show", "a.tagid.h5", "--png", "latest.png").code == 0
    assert (tmp_path / "latest.png").is_symlink() and (tmp_path / "drawn.png").is_file()


LOCKLESS = r"""
#include <errno.h>
#include <stdlib.h>
int flock(int descriptor, int operation) { errno = atoi(getenv("LOCK_ERROR")); return -1; }
"""


@pytest.fixture(scope="session")
def lockless(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A library whose `flock` fails, as on some network file systems."""
    compiler = shutil.which("gcc")
    if compiler is None:
        pytest.skip("no gcc to compile the library with")
    folder = tmp_path_factory.mktemp("lockless")
    (folder / "lockless.c").write_text(LOCKLESS)
    library = folder / "lockless.so"
    subprocess.run([compiler, "-shared", "-fPIC", folder / "lockless.c", "-o", library], check=True)
    ctypes.CDLL(str(library))
    yield str(library)


@pytest.mark.parametrize("error", [errno.EAGAIN, errno.ENOLCK, errno.EIO])
def test_a_file_is_written_and_read_where_every_lock_is_refused(
    lockless: str, tmp_path: Path, error: int
) -> None:
    code = (
        "import sys\nfrom pathlib import Path\nfrom tagid.files import read_bytes, write_bytes\n"
        "path = Path(sys.argv[1])\nwrite_bytes(path, b'all')\nassert read_bytes(path) == b'all'\n"
    )
    environment = {**os.environ, "LD_PRELOAD": lockless, "LOCK_ERROR": str(error)}
    command = [sys.executable, "-c", code, str(tmp_path / "file")]
    subprocess.run(command, check=True, env=environment, timeout=30)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
