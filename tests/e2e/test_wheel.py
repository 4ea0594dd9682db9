"""The wheel in an empty environment: what is shipped names an object, models included, without torch."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tagid.models_store import manifest
from tagid.simulate.acquisition import Acquisition
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import scene_from_name
from tagid.storage.hdf5 import write_capture
from tagid.tags.network.detector import MODEL

ROOT = Path(__file__).resolve().parents[2]


def run(*command: str | Path, **more: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(part) for part in command],
        capture_output=True,
        text=True,
        env={**os.environ, **more},
        timeout=600,
    )


@pytest.fixture(scope="module")
def empty_environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Python of a new environment into which only the wheel and what it requires are installed."""
    folder = tmp_path_factory.mktemp("wheel")
    # From a copy, so that nothing of the build stays in the checkout, or comes from an older one.
    unwanted = shutil.ignore_patterns(
        ".*", "build", "dist", "demo", "*.egg-info", "__pycache__", "node_modules"
    )
    shutil.copytree(ROOT, folder / "source", symlinks=True, ignore=unwanted)
    source = folder / "source"
    built = run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", folder, source)
    if built.returncode != 0:
        pytest.skip(f"the wheel cannot be built here (no setuptools to be had?): {built.stderr[-300:]}")
    (wheel,) = folder.glob("tagid-*.whl")
    python = folder / "venv" / "bin" / "python"
    assert run(sys.executable, "-m", "venv", folder / "venv").returncode == 0
    installed = run(python, "-m", "pip", "install", "--quiet", "--no-compile", wheel)
    if installed.returncode != 0:
        pytest.skip(f"its requirements cannot be installed here: {installed.stderr[-300:]}")
    return python


def test_the_wheel_alone_names_an_object(empty_environment: Path, tmp_path: Path) -> None:
    acquisition = Acquisition(views=36, snr_db=15)
    capture, _ = simulate_capture(scene_from_name("helmet-120", 3), acquisition, seed=3)
    path = tmp_path / "helmet.tagid.h5"
    write_capture(path, capture)
    done = run(
        empty_environment,
        "-m",
        "tagid",
        "identify",
        path,
        "--output",
        "json",
        TAGID_CONFIG=str(tmp_path / "config.toml"),
        TAGID_DATA=str(tmp_path / "data"),
    )
    assert done.returncode == 0, done.stderr
    (item,) = json.loads(done.stdout)["data"]["items"]
    assert item["layout"] == "helmet-120"
    assert item["model_sha256"] == manifest()[MODEL].sha256
    assert item["reflector_probability"] > 0.9
    torch = run(empty_environment, "-c", "import torch")
    assert "ModuleNotFoundError" in torch.stderr
