"""Check that every dependency has a wheel for 64-bit ARM Linux: a Raspberry Pi compiles nothing but tagid.

    python tests/benchmarks/arm_wheels.py [--python 3.11] [--extra station]

It resolves and downloads wheels for the platform with `pip download --only-binary`, about 100 MB, into a
folder that is removed afterwards, and prints their sizes.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PLATFORMS = (
    "manylinux_2_28_aarch64",
    "manylinux_2_27_aarch64",
    "manylinux_2_17_aarch64",
    "manylinux2014_aarch64",
)
"""Newest first: Raspberry Pi OS 12 has glibc 2.36, onnxruntime asks for 2.27."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--python", default="3.11")
    parser.add_argument("--extra", action="append", default=[])
    options = parser.parse_args()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needed = list(project["dependencies"])
    for extra in options.extra:
        needed += project["optional-dependencies"][extra]
    with tempfile.TemporaryDirectory() as folder:
        words = [
            sys.executable,
            "-m",
            "pip",
            "download",
            "--quiet",
            "--dest",
            folder,
            "--only-binary",
            ":all:",
        ]
        words += ["--implementation", "cp", "--python-version", options.python]
        words += [word for platform in PLATFORMS for word in ("--platform", platform)]
        words += ["--constraint", str(ROOT / "constraints.txt"), *needed]
        done = subprocess.run(words, check=False)
        if done.returncode:
            print("a dependency has no wheel for aarch64: see above", file=sys.stderr)
            return 1
        wheels = sorted(Path(folder).glob("*.whl"), key=lambda path: -path.stat().st_size)
        for wheel in wheels:
            print(f"{wheel.stat().st_size / 1e6:6.1f} MB  {wheel.name}")
        total = sum(wheel.stat().st_size for wheel in wheels) / 1e6
        print(f"{total:6.1f} MB  {len(wheels)} wheels, Python {options.python}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
