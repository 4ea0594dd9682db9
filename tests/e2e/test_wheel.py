"""The wheel in an empty environment: what is shipped names an object, models included, without torch."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

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


def required(package: str, extra: str = "") -> set[str]:
    """Names of the installed distributions that a package requires, and those that they require."""
    found: set[str] = set()
    for text in distribution(package).requires or ():
        one = Requirement(text)
        if one.marker is None or one.marker.evaluate({"extra": extra}):
            name = canonicalize_name(one.name)
            if name not in found:
                found |= {name}.union(*(required(name, each) for each in (*one.extras, "")))
    return found


@pytest.fixture(scope="module")
def empty_environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Python of a new environment that holds only the wheel and what it requires.

    The requirements are links to what is installed here, which takes a tenth of the time of installing them.
    """
    folder = tmp_path_factory.mktemp("wheel")
    # From a copy, so that nothing of the build stays in the checkout, or comes from an older one.
    unwanted = shutil.ignore_patterns(
        ".*", "build", "dist", "demo", "*.egg-info", "__pycache__", "node_modules"
    )
    shutil.copytree(ROOT, folder / "source", symlinks=True, ignore=unwanted)
    source, here = folder / "source", folder / "venv"
    pip = (sys.executable, "-m", "pip")
    built = run(*pip, "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", folder, source)
    assert built.returncode == 0, built.stderr
    (wheel,) = folder.glob("tagid-*.whl")
    assert "-cp311-abi3-" in wheel.name  # one wheel for every Python from 3.11 on
    assert run(sys.executable, "-m", "venv", "--without-pip", here).returncode == 0
    (packages,) = here.glob("lib/*/site-packages")
    for name in required("tagid"):
        files = distribution(name).files or ()
        for top in {file.parts[0] for file in files if file.parts[0] not in ("..", "__pycache__")}:
            if not (packages / top).exists():
                (packages / top).symlink_to(str(distribution(name).locate_file(top)))
    inside = (*pip, "--python", here)
    installed = run(*inside, "install", "--quiet", "--no-deps", "--no-compile", "--no-index", wheel)
    assert installed.returncode == 0, installed.stderr
    complete = run(*inside, "check")
    assert complete.returncode == 0, complete.stdout
    return here / "bin" / "python"


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
