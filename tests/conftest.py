"""Every command line runs in a process of its own, with its own configuration and registry."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from command_server import CommandServer, Ran
from hypothesis import settings
from remembered import remember, shared

# The same examples in every run; fresh ones are for the long runs that CONTRIBUTING names.
settings.register_profile("fixed", derandomize=True)
settings.load_profile("fixed")

# A shell that runs the tests in the background has all their children ignore Ctrl-C, and `nohup` a hang-up;
# some are about these.
for number, usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, usual)


@pytest.fixture
def home(tmp_path: Path, remembered: Path) -> dict[str, str]:
    environment = {k: v for k, v in os.environ.items() if not k.startswith("TAGID_")}
    return {
        **environment,
        **shared(remembered),
        "TAGID_CONFIG": str(tmp_path / "home" / "config.toml"),
        "TAGID_DATA": str(tmp_path / "home"),
        "TAGID_RADAR_ADDRESSES": "127.0.0.1:9",  # the shipped addresses are asked by no test
        "OMP_NUM_THREADS": "1",
        "COLUMNS": "200",
    }


@pytest.fixture(scope="session", autouse=True)
def remembered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of results that all processes of the session share."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "remembered"
    folder.mkdir(exist_ok=True)
    remember(folder)
    return folder


COMPILE = """
import contextlib, importlib, pkgutil
names = ["distributed.cli.dask_worker", "typer._adapters", "uvicorn.protocols.http.h11_impl"]
for package in ("tagid", "firmware_tools"):
    path = importlib.import_module(package).__path__
    names += [module.name for module in pkgutil.walk_packages(path, package + ".", onerror=lambda name: None)]
for name in names:
    if ".ats" not in name and "__main__" not in name and not name.startswith("firmware_tools.bridge"):
        with contextlib.suppress(Exception):
            importlib.import_module(name)
"""


@pytest.fixture(scope="session", autouse=True)
def bytecode(remembered: Path) -> None:
    """Byte code for the hundreds of interpreters that a whole run starts, where the environment keeps any.

    They read it only: one whose files may not grow would leave half of a module to the others.
    """
    if sys.dont_write_bytecode or "PYTEST_XDIST_WORKER" not in os.environ:
        return
    sys.dont_write_bytecode = True
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    try:
        remembered.with_name("compiled").mkdir()
    except FileExistsError:
        return
    writing = {**os.environ, "PYTHONDONTWRITEBYTECODE": ""}
    subprocess.run([sys.executable, "-c", COMPILE], env=writing, capture_output=True)


@pytest.fixture(scope="session")
def commands(tmp_path_factory: pytest.TempPathFactory, remembered: Path) -> Iterator[CommandServer]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with CommandServer(tmp_path_factory.mktemp("commands"), environment, remembered) as server:
        yield server


@pytest.fixture
def tagid(tmp_path: Path, home: dict[str, str], commands: CommandServer) -> Callable[..., Ran]:
    def run(*words: object, **more: str) -> Ran:
        done = commands.run([str(word) for word in words], tmp_path, {**home, **more})
        assert "Traceback" not in done.err, done.err
        return done

    return run
