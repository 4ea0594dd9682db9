"""The pages are true of the code: links resolve, the API is as in the docstrings, refusals are explained."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from typer.core import TyperGroup
from typer.main import get_command

import tagid
from tagid.cli.app import app
from tagid.pipeline.answer import Identification
from tagid.reading.verdict import ADVICE, Code
from tests.benchmarks.catalogue import BENCHMARKS, NEEDS

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PROVENANCE = ("Command", "Commit", "Machine", "Date", "Seeds")


def rows_with(word: str, page: str) -> list[list[str]]:
    """Cells of the rows of a page's tables whose first one is a word in code."""
    lines = [line for line in (DOCS / page).read_text().splitlines() if line.startswith(f"| `{word}` |")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


@pytest.mark.parametrize("code", [code for code in Code if code])
def test_every_code_of_a_refusal_has_a_row_with_its_remedy(code: Code) -> None:
    # The table of likely causes has some of the same words.
    rows = [row for row in rows_with(code.value, "refusals.md") if len(row) == 4]
    assert [row[1] in ("`no_tag`", "`unknown`", "`ambiguous`") and bool(row[3]) for row in rows] == [True]
    assert ADVICE[code]


def test_every_field_of_an_answer_is_described() -> None:
    text = (DOCS / "formats.md").read_text().split("## Answers")[1]
    fields = set(Identification("no_tag", None, None, None).to_dict())
    assert [name for name in sorted(fields - {"error"}) if f"`{name}`" not in text] == []


def test_every_command_that_a_message_names_exists() -> None:
    """What to do next is a command that can be typed: also the one behind a group's name."""
    named = {
        (words, str(path.relative_to(ROOT)))
        for path in (ROOT / "tagid").rglob("*.py")
        for words in re.findall(r"`tagid ([a-z][a-z0-9 -]*)", path.read_text())
    }
    assert len(named) > 100
    root = get_command(app)

    def exists(words: str) -> bool:
        first, *more = words.split()
        result = root.get_command(None, first)
        if not isinstance(result, TyperGroup) or not more or more[0].startswith("-"):
            return result is not None
        return result.get_command(None, more[0]) is not None

    assert sorted(item for item in named if not exists(item[0])) == []


@pytest.mark.parametrize("page", sorted((DOCS / "results").glob("*.md")), ids=lambda p: p.name)
def test_a_page_of_results_says_where_its_tables_come_from(page: Path) -> None:
    """At the head of the page, or in each section that has a table."""
    head, *sections = re.split(r"^## ", page.read_text(), flags=re.M)
    for section in sections:
        made = head if "Command:" in head else section
        if re.search(r"^\||\.csv\)", section, re.M):
            assert [word for word in PROVENANCE if not re.search(rf"{word}: *\S", made)] == [], section[:60]
            scripts = re.findall(r"tests/(?:benchmarks|property|durability)/\w+\.(?:py|sh)", made)
            named = scripts or "python -m tests.benchmarks " in made
            assert named, f"names no benchmark: {section[:60]}"
            assert [script for script in scripts if not (ROOT / script).exists()] == []


def test_every_table_of_results_belongs_to_a_benchmark_that_can_run() -> None:
    """A block of a page is of a benchmark of that page, a CSV file is linked, and each function exists."""
    linked: set[str] = set()
    for page in (DOCS / "results").glob("*.md"):
        text = page.read_text()
        linked |= set(re.findall(r"\(([a-z-]+\.csv)\)", text))
        for name in re.findall(r"^<!-- ([a-z-]+) -->$", text, re.M):
            assert BENCHMARKS[name].page == page.name, name
    assert linked == {path.name for path in (DOCS / "results").glob("*.csv")}
    for benchmark in BENCHMARKS.values():
        module, _, function = benchmark.work.partition(":")
        tree = ast.parse((ROOT / "tests" / "benchmarks" / f"{module}.py").read_text())
        functions = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        assert function in functions and set(benchmark.needs) <= set(NEEDS), benchmark.name


def test_benchmarks_named_on_the_pages_exist() -> None:
    pages = [*DOCS.rglob("*.md"), ROOT / "CONTRIBUTING.md", ROOT / "README.md"]
    named = {
        name for page in pages for name in re.findall(r"tests\.benchmarks ([a-z][a-z-]*)", page.read_text())
    }
    assert sorted(named - set(BENCHMARKS) - {"list"}) == []


def test_the_results_page_has_ten_figures_each_with_a_table() -> None:
    rows = [line for line in (DOCS / "results.md").read_text().splitlines() if re.match(r"\| \d+ \|", line)]
    assert len(rows) == 10
    assert all(re.search(r"\]\(results/[\w-]+\.md(#[\w-]+)?\) \|$", row) for row in rows)


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md"])
def test_links_of_the_pages_beside_the_site_lead_somewhere(page: str) -> None:
    text = (ROOT / page).read_text()
    targets = [t for t in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", text) if not urlsplit(t).scheme]
    assert [target for target in targets if not (ROOT / target).exists()] == []


def test_the_readme_is_short_and_the_changelog_dated() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) < 120
    dated = rf"^## \[{re.escape(tagid.__version__)}\] - \d{{4}}-\d\d-\d\d$"
    assert re.search(dated, (ROOT / "CHANGELOG.md").read_text(), re.M)


LOADED = re.compile(
    r"""<(?:link(?![^>]*canonical)[^>]* href|(?:script|img|iframe|source)\b[^>]* src)="([^"]+)"""
)
"""What a page makes the browser load without being asked."""


def test_the_site_builds_strictly_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason="the extra `docs` is not installed")
    site = tmp_path / "site"
    strictly = ("build", "--strict", "--quiet", "--site-dir", site)
    command = [sys.executable, "-W", "ignore", "-m", "mkdocs", *strictly]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    # The page for what is not found is written for the root of a server.
    pages = [page for page in site.rglob("*.html") if page.name != "404.html"]
    assert len(pages) > 20
    away = set()
    for page in pages:
        urls = LOADED.findall(page.read_text(encoding="utf-8"))
        away |= {url for url in urls if urlsplit(url).netloc}
        assert urls and [u for u in urls if not (page.parent / urlsplit(u).path).exists()] == [], page.name
    for style in site.rglob("*.css"):
        away |= set(re.findall(r"url\(['\"]?((?:https?:)?//[^)'\"]+)", style.read_text(encoding="utf-8")))
    assert away == set()


@cache
def definitions() -> set[str]:
    """Names of every module, class, function and value of the package."""
    result: set[str] = set()
    for path in [*(ROOT / "tagid").rglob("*.py"), *(ROOT / "train").rglob("*.py")]:
        result.add(path.stem)
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef | ast.FunctionDef):
                result.add(node.name)
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                result.add(node.id)
    return result


def exists(path: str) -> bool:
    return (ROOT / path).exists() or (ROOT / "tagid" / path).exists()


def test_the_architecture_page_describes_the_code_as_it_is() -> None:
    page = (DOCS / "architecture.md").read_text()
    tree, text = page.split("```")[1], page.split("```")[2]
    rows = re.findall(r"^ *([\w/]+/|[a-z_]+(?: [a-z_]+)*|__init__\.py)(?: {2,}|$)", tree, re.M)
    named = {name for row in rows for name in row.removesuffix("/").split()}
    rooms = {p.stem for p in (ROOT / "tagid").iterdir() if p.is_dir() or p.suffix == ".py"}
    missing = rooms - named - {"__init__", "__pycache__", "__main__"}
    assert missing == set(), "parts that the page does not name"
    known = definitions()
    words = re.findall(r"`([\w./]+)`", text)
    assert [w for w in words if not exists(w) and ("/" in w or "." in w or w not in known)] == []
    for room, line in re.findall(r"^  ([\w/]+)/ +(.*(?:\n {15,}.*)*)", tree, re.M):
        for folder in re.findall(r"\b(\w+)/", line):
            assert exists(f"{room}/{folder}"), f"{room}/{folder}"
        for module in re.findall(r": ((?:[a-z_0-9]+ )*[a-z_0-9]+)$", line.split("\n")[-1], re.M):
            if " " in module:
                assert [m for m in module.split() if not exists(f"{room}/{m}.py")] == [], room


@pytest.mark.parametrize("page", sorted(DOCS.rglob("*.md")), ids=lambda p: p.name)
def test_modules_and_files_that_a_page_names_exist(page: Path) -> None:
    text = page.read_text()
    modules = set(re.findall(r"`((?:tagid|train|firmware_tools)(?:\.\w+)+)", text))
    known = definitions()
    gone = []
    for module in modules:
        parts, rest = module.split("."), []
        while parts and not ((ROOT / "/".join(parts)).is_dir() or exists("/".join(parts) + ".py")):
            rest.append(parts.pop())
        if len(rest) > 2 or not set(rest) <= known | set(tagid.__all__):
            gone.append(module)
    assert gone == []
    paths = set(re.findall(r"`((?:tagid|train|tests|firmware_tools|docs|models)/[\w./-]+)`", text))
    assert [path for path in paths if not exists(path)] == []
