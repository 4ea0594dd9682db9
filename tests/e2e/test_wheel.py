"""What the source distribution makes, in an empty environment: it names an object, models included."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from importlib.metadata import distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tagid.simulate.acquisition import Acquisition
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import scene_from_name
from tagid.storage.hdf5 import write_capture

ROOT = Path(__file__).resolve().parents[2]


def run(*command: str | Path, cwd: Path | None = None, **more: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        capture_output=True,
        text=True,
        env={**os.environ, **more},
        timeout=600,
    )


def required(texts: Iterable[str], extra: str = "") -> set[str]:
    """Names of the installed distributions that requirements name, and those that they require."""
    result: set[str] = set()
    for text in texts:
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate({"extra": extra}):
            name = canonicalize_name(requirement.name)
            if name not in result:
                more = distribution(name).requires or ()
                result |= {name}.union(*(required(more, item) for item in (*requirement.extras, "")))
    return result


BUILD = """
import os, sys, tarfile
from setuptools import build_meta

folder = sys.argv[1]  # setuptools has words of its own there
source = os.path.join(folder, build_meta.build_sdist(folder))
with tarfile.open(source) as archive:
    archive.extractall(folder, filter="data")
os.chdir(source.removesuffix(".tar.gz"))
print(os.path.join(folder, build_meta.build_wheel(folder)))
"""


@pytest.fixture
def wheel(tmp_path: Path) -> Path:
    """The wheel that is made of the source distribution of this checkout alone."""
    folder = tmp_path / "dist"
    folder.mkdir()
    # From a copy, so that nothing of the build stays in the checkout, or comes from an older one.
    unwanted = shutil.ignore_patterns(
        ".*", "build", "dist", "demo", "*.egg-info", "__pycache__", "node_modules", "*.so"
    )
    shutil.copytree(ROOT, folder / "source", symlinks=True, ignore=unwanted)
    # What is compiled is only imported here, and the optimiser would take most of the time.
    quick = folder / "cc"
    quick.write_text('#!/bin/sh\nexec cc "$@" -O1\n')
    quick.chmod(0o755)
    built = run(sys.executable, "-c", BUILD, folder, cwd=folder / "source", CC=str(quick))
    assert built.returncode == 0, built.stderr
    return Path(built.stdout.splitlines()[-1])


@pytest.fixture
def empty_environment(wheel: Path, tmp_path: Path) -> Path:
    """Python of a new environment that holds only what was built and what it requires.

    The requirements are links to what is installed here, which takes a tenth of the time of installing them.
    """
    here = tmp_path / "venv"
    assert "-cp311-abi3-" in wheel.name  # one wheel for every Python from 3.11 on
    assert run(sys.executable, "-m", "venv", "--without-pip", here).returncode == 0
    (packages,) = here.glob("lib/*/site-packages")
    # Of this checkout, not of the metadata that were installed at some time.
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for name in required(project["dependencies"]):
        files = distribution(name).files or ()
        for top in {file.parts[0] for file in files if file.parts[0] not in ("..", "__pycache__")}:
            if not (packages / top).exists():
                (packages / top).symlink_to(str(distribution(name).locate_file(top)))
    shutil.unpack_archive(wheel, packages, "zip")
    complete = run(sys.executable, "-m", "pip", "--python", here, "check")
    assert complete.returncode == 0, complete.stdout
    return here / "bin" / "python"


def test_what_was_built_names_an_object_alone(empty_environment: Path, tmp_path: Path) -> None:
    acquisition = Acquisition(views=12, snr_db=20)
    capture, _ = simulate_capture(scene_from_name("helmet-120", 3), acquisition, seed=3)
    path = tmp_path / "helmet.tagid.h5"
    write_capture(path, capture)
    environment = {"TAGID_CONFIG": str(tmp_path / "config.toml"), "TAGID_DATA": str(tmp_path / "data")}
    environment |= {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": str(tmp_path / "bytecode")}
    done = run(empty_environment, "-m", "tagid", "identify", path, "--output", "json", **environment)
    assert done.returncode == 0, done.stderr
    (item,) = json.loads(done.stdout)["data"]["items"]
    assert item["layout"] == "helmet-120"
    for absent in ("torch", "scipy", "firmware_tools", "train"):
        assert "ModuleNotFoundError" in run(empty_environment, "-P", "-c", f"import {absent}").stderr
    compiled = run(empty_environment, "-c", "from tagid.loops import unusable; print(unusable())")
    assert compiled.stdout.strip() == "()", compiled
    # What needs scipy says how to get it.
    done = run(empty_environment, "-m", "tagid", "export", path, "--out", tmp_path / "a.mat", **environment)
    assert done.returncode == 2, done.stderr
    assert "scipy, which is not installed" in " ".join(done.stderr.split())
    assert "pip install 'tagid[science]'" in " ".join(done.stderr.split())
    # Bodies, whose echoes need Bessel functions, and the cross-section of a reflector do without it.
    for words in (
        ("simulate", "container-90", "--body", "cup:40mm", "--views", "12", "--out", tmp_path / "cup.h5"),
        ("layouts", "reflector", "--size", "40", "--rcs", tmp_path / "r.csv"),
    ):
        done = run(empty_environment, "-m", "tagid", *words, **environment)
        assert done.returncode == 0, done.stderr
