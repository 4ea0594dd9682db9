"""Settings from file, environment and options: their order, their checks, and how they are written."""

from __future__ import annotations

from pathlib import Path

import pytest

from tagid.config import change_settings, load_config
from tagid.errors import ConfigError, StorageError


@pytest.fixture(autouse=True)
def own_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "conf" / "config.toml"
    monkeypatch.setenv("TAGID_CONFIG", str(path))
    monkeypatch.delenv("TAGID_RADAR_URL", raising=False)
    return path


def test_command_line_beats_environment_beats_file_beats_default(monkeypatch: pytest.MonkeyPatch) -> None:
    def gain(**given: int) -> tuple[object, str]:
        value = load_config({f"radar.{name}": number for name, number in given.items()}).values["radar.gain"]
        return value.value, value.source

    assert gain() == (63, "default")
    change_settings({"radar.gain": "40"})
    assert gain() == (40, "file")
    monkeypatch.setenv("TAGID_RADAR_GAIN", "30")
    assert gain() == (30, "environment")
    assert gain(gain=20) == (20, "command line")


def test_unset_gives_the_default_back_and_keeps_the_rest() -> None:
    change_settings({"radar.url": "udp://127.0.0.1"})
    change_settings({"motion.axis_distance_m": "1.25"})
    change_settings({"radar.url": None})
    config = load_config()
    assert config["radar.url"] is None
    assert config["motion.axis_distance_m"] == 1.25


@pytest.mark.parametrize(
    ("name", "value"),
    [("radar.gain", "64"), ("radar.gain", "1.5"), ("radar.gain", "high"), ("motion.axis_distance_m", "nan"),
     ("motion.axis_distance_m", "0"), ("imaging.method", "magic"), ("tags.centre_sigma_m", "0"),
     ("tags.radius_sigma_m", "12"), ("tags.radius_inside_m", "-0.01"), ("tags.radius_outside_m", "27"),
     ("tags.offset_range_m", "nan"), ("no.such", "1")],
)  # fmt: skip
def test_a_bad_value_is_refused_and_the_file_stays(own_file: Path, name: str, value: str) -> None:
    change_settings({"radar.gain": "40"})
    before = own_file.read_bytes()
    with pytest.raises(ConfigError, match=name.replace(".", r"\.")):
        change_settings({name: value})
    assert own_file.read_bytes() == before


@pytest.mark.parametrize("text", ["radar = ", "gain = 3\n", "[radar]\nfoo = 1\n", "\xff"])
def test_a_bad_file_is_one_clear_error(own_file: Path, text: str) -> None:
    own_file.parent.mkdir(parents=True)
    own_file.write_bytes(text.encode("latin-1"))
    with pytest.raises(ConfigError, match=r"config\.toml"):
        load_config()


def test_a_folder_that_cannot_be_made_is_one_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("TAGID_CONFIG", str(tmp_path / "file" / "config.toml"))
    with pytest.raises(StorageError):
        change_settings({"radar.gain": "1"})
