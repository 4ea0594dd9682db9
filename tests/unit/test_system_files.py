"""The udev rule and the systemd unit that are shipped, and what `tagid doctor` says of them."""

from __future__ import annotations

import configparser
import re
import shutil
import subprocess
from pathlib import Path

import pytest

import tagid
from tagid import doctor
from tagid.cli.app import COMMANDS
from tagid.motion.discovery import _ADAPTERS
from tagid.radar.discovery import USB_VENDOR

FOLDER = Path(tagid.__file__).parent / "system"
RULE, UNIT = FOLDER / "70-tagid.rules", FOLDER / "tagid-station.service"


def test_the_rule_names_every_device_that_is_looked_for() -> None:
    text = RULE.read_text()
    pairs = re.findall(r'idVendor}=="([0-9a-f]{4})", ATTRS\{idProduct}=="([0-9a-f]{4})"', text)
    named = {(int(vendor, 16), int(product, 16)) for vendor, product in pairs}
    assert named >= set(_ADAPTERS) and {product for vendor, product in named if vendor == USB_VENDOR} == {
        3,
        5,
    }
    for line in text.splitlines():
        if line and not line.startswith("#"):
            assert 'SUBSYSTEM=="tty"' in line and 'TAG+="uaccess"' in line and 'MODE="0660"' in line


def test_the_unit_starts_a_command_that_exists() -> None:
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[assignment, method-assign]
    unit.read_string(UNIT.read_text())
    words = unit["Service"]["ExecStart"].split()
    assert words[:2] == ["/usr/bin/env", "tagid"] and words[2] in COMMANDS
    assert unit["Install"]["WantedBy"] == "default.target"
    # The guardian of a device must outlive the station, however that ends (docs/motion.md).
    assert unit["Service"]["KillMode"] == "process"
    if shutil.which("systemd-analyze"):
        done = subprocess.run(
            ["systemd-analyze", "verify", "--user", str(UNIT)], capture_output=True, text=True
        )
        assert "Unknown" not in done.stderr


def test_doctor_runs_in_the_base_installation(monkeypatch: pytest.MonkeyPatch) -> None:
    known = doctor.importlib.util.find_spec
    monkeypatch.setattr(
        doctor.importlib.util, "find_spec", lambda name: None if name == "scipy" else known(name)
    )
    _, packages = doctor._versions()
    assert packages.level == "ok" and "numpy" in packages.text and "without scipy" in packages.text


@pytest.mark.skipif(doctor.platform.system() != "Linux", reason="udev and systemd are of Linux")
def test_doctor_tells_how_to_install_them(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    access, service = doctor._system()
    assert access.topic == "device access" and str(RULE) in access.remedy and "udevadm" in access.remedy
    assert str(UNIT) in service.remedy and "systemctl --user enable" in service.remedy
    home = tmp_path / "systemd" / "user"
    home.mkdir(parents=True)
    shutil.copy(UNIT, home)
    assert doctor._system()[1].remedy == ""
