"""The programs of docs/examples.md and docs/tags.md run as they stand there, and do what the pages say."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tagid.reading.evidence import log_evidence

PAGE = Path(__file__).resolve().parents[2] / "docs" / "examples.md"
TAGS = PAGE.with_name("tags.md")
Run = Callable[..., dict[str, Any]]


def program(heading: str, page: Path = PAGE) -> str:
    """The Python block under a heading of a page."""
    match = re.search(rf"^## {re.escape(heading)}\n.*?^```python\n(.*?)^```$", page.read_text(), re.M | re.S)
    assert match, f"no program under {heading!r}"
    return match[1]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run the program under a heading in an empty folder; the names that it leaves behind."""
    folder = tmp_path / "empty"
    folder.mkdir()
    monkeypatch.chdir(folder)

    def names_of(heading: str, page: Path = PAGE) -> dict[str, Any]:
        names: dict[str, Any] = {"__name__": "example"}
        exec(compile(program(heading, page), f"{page.name}: {heading}", "exec"), names)
        return names

    return names_of


def test_every_program_of_the_page_is_run_here() -> None:
    assert PAGE.read_text().count("```python") == 4
    assert TAGS.read_text().count("```python") == 1


def test_five_lines_record_name_and_read_again_in_an_empty_folder(
    run: Run, home: dict[str, str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    first = program("Record and name an object")
    readme = (PAGE.parents[1] / "README.md").read_text()
    assert re.findall(r"^```python\n(.*?)^```$", readme, re.M | re.S)[0] == first
    for name in ("TAGID_CONFIG", "TAGID_DATA"):
        monkeypatch.setenv(name, home[name])
    # A shorter test: fewer scans, and an image whose method does not affect the name.
    monkeypatch.setenv("TAGID_RADAR_INTEGRATION", "15")
    monkeypatch.setenv("TAGID_IMAGING_METHOD", "bp")
    answer = run("Record and name an object")["answer"]
    assert capsys.readouterr().out == "identified helmet-120 helmet-120\n"
    assert (answer.notes, answer.causes) == ((), ())
    capture = Path(answer.file)
    assert sorted(Path().iterdir()) == [capture.with_name(capture.name.replace(".tagid.h5", ".png")), capture]
    with closing(sqlite3.connect(Path(home["TAGID_DATA"]) / "history.sqlite")) as history:
        counts = history.execute("SELECT count(*), count(DISTINCT run_id) FROM identification")
        assert counts.fetchone() == (2, 1)


def test_a_capture_becomes_a_picture_with_the_reflectors_where_they_are(run: Run) -> None:
    names = run("Image a capture and plot it")
    with Image.open("helmet.png") as picture:
        assert picture.size == (940, 900)
        assert len(picture.convert("RGB").getcolors(maxcolors=1 << 20) or []) > 100
    magnitude, axis = np.abs(names["result"].image.values), names["result"].image.grid.axis
    for x, y in names["truth"].positions_m[:, :2]:
        near = magnitude[np.ix_(np.abs(axis - y) < 0.012, np.abs(axis - x) < 0.012)]
        assert near.max() > 0.3 * magnitude.max()
    assert magnitude[:, np.abs(axis) > 0.2].max() < 0.1 * magnitude.max()


def test_a_refusal_names_a_reason_of_the_page_on_refusals(
    run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    names = run("Identify, and explain a refusal")
    answer = names["answer"]
    assert (answer.status, answer.reading.layout) == ("unknown", None)
    assert answer.reading.code == "another_arrangement"
    words = "3 reflectors 120, 120 and 120 degrees apart, 110 mm from the centre"
    assert answer.reading.reason.startswith(words)
    assert f"`{answer.reading.code}`" in (PAGE.parent / "refusals.md").read_text()
    everyone = names["answer_with_all"]
    assert (everyone.status, everyone.reading.layout) == ("identified", "helmet-120")
    assert answer.reading.reason in capsys.readouterr().out


def test_the_log_evidence_of_one_reflector_is_that_of_the_reader(
    run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    names = run("Recompute one term", TAGS)
    positions = names["truth"].positions_m[:, :2]
    assert np.abs(positions[:, 0] + 1j * positions[:, 1] - names["best"]).min() < 3e-3
    spectra, at = names["spectra"], int(names["log_evidence"].argmax())
    whitener, data = spectra.whiteners[0], spectra.white[0]
    column = whitener.apply(np.ascontiguousarray(names["x"][:, [at]]))
    alone = log_evidence(column, data, np.ones((1, *data.shape)), names["power"][None])
    none = log_evidence(column[:, :0], data, np.ones((1, *data.shape)), names["power"][None, :, :0])
    assert float((alone - none)[0]) == pytest.approx(float(names["log_evidence"][at]))
    assert "nats over none" in capsys.readouterr().out


def test_methods_are_scored_on_views_that_they_have_not_seen(run: Run) -> None:
    names = run("Score a method of your own")
    scores, unexplained, size = names["scores"], names["unexplained"], names["A"].shape[1]
    assert unexplained(np.zeros(size, np.complex64)) == pytest.approx(1.0)
    assert set(scores) == {"own", "sparse", "omp", "ats"}
    assert all(0 < score < 0.4 for score in scores.values())
    # The score notices a wrong sign and a view that is in the wrong place.
    base = names["brightest_pixels"](names["A"].select(names["seen"]), names["y"][names["seen"]])
    assert unexplained(-base) > 1.5
    assert unexplained(base.reshape(64, 64).T.ravel()) > 0.9
    assert not set(names["seen"]) & set(names["unseen"])
