"""The public index: cheap to import, complete, and what it lists can be used as documented."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import tagid
from tagid.errors import ConfigError, UsageError


@pytest.fixture(scope="module")
def page() -> ModuleType:
    """The script that makes the API page of the site."""
    path = Path(__file__).parents[2] / "docs" / "make_api.py"
    spec = importlib.util.spec_from_file_location("make_api", path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_type_checker_and_a_program_get_each_name_from_the_same_module() -> None:
    (block,) = (node for node in ast.parse(Path(tagid.__file__).read_text()).body if isinstance(node, ast.If))
    checked = {
        alias.asname: node.module
        for node in block.body
        if isinstance(node, ast.ImportFrom) and node.module != "typing"
        for alias in node.names
    }
    assert checked == tagid._HOMES
    assert set(checked) < set(tagid.__all__) <= set(dir(tagid))
    assert 35 <= len(checked) <= 45


def test_a_name_that_moved_is_given_with_a_warning_that_names_its_module() -> None:
    moved = [name for names in tagid._MOVED.values() for name in names.split()]
    assert {"Pulse", "RadarInfo", "Reading", "Placement"} <= set(moved)
    assert not set(moved) & {*tagid.__all__, *dir(tagid)}
    for name in moved:
        with pytest.warns(DeprecationWarning) as warned:
            value = getattr(tagid, name)
        (warning,) = warned
        assert warning.filename == __file__
        line = re.search(r"`from (tagid\S*) import (\w+)`", str(warning.message))
        assert line and getattr(importlib.import_module(line[1]), line[2]) is value


def test_every_public_name_and_each_type_that_one_takes_or_gives_is_on_the_page(page: ModuleType) -> None:
    """With words; nested and private types, and those of private modules, could not be imported."""
    text, types = page.render(), page.types_by_module()
    sections = dict(re.findall(r"^### (\w+)\n(.*?)(?=^##|\Z)", text, re.M | re.S))
    names = {item.__name__ for members in types.values() for item in members}
    assert sorted(sections) == sorted([*tagid.__all__, *names])
    for name, words in sections.items():
        if name != "__version__":
            assert f"```python\n{name}(" in words, f"{name} has no signature"
            assert len(words.split("```")[2].split()) > 3, f"{name} has no docstring"
    for module, members in types.items():
        section = text.partition(f"\n## {module}\n")[2].partition("\n## ")[0]
        home = importlib.import_module(module)
        assert not re.search(r"\b_", module)
        for item in members:
            assert getattr(home, item.__qualname__, None) is item and not item.__name__.startswith("_")
            assert f"\n### {item.__name__}\n" in section
    assert {"Aperture", "Code", "Comparison", "DiskFullError", "Image", "RadarInfo", "Reflector"} <= names
    assert page.annotations_of(tagid.Workplace)[".registry: return"] is tagid.Registry


def test_the_script_turns_sections_into_lists_and_leaves_equations_readable(page: ModuleType) -> None:
    def example(a_b: int, *, c: str = "x") -> None:
        """y = <A x_0, y> * 2.

        Args:
            a_b: first,
                and more.
            c: second.

        Raises:
            KeyError and its kinds: never.
        """

    assert page.signature("example", example) == "example(a_b: int, *, c: str = 'x') -> None"
    text = page.prose(example)
    assert text.startswith("y = &lt;A x\\_0, y&gt; \\* 2.")
    assert "- `a_b`: first,\n  and more.\n- `c`: second." in text
    assert "**Raises**\n\n- KeyError and its kinds: never." in text


def test_importing_tagid_imports_nothing_else() -> None:
    """Not even `typing`, the most expensive one; -S because the site of an editable install loads it."""
    code = (
        f"import sys; sys.path.insert(0, {str(Path(tagid.__file__).parents[1])!r}); import tagid; "
        "print(sorted(m for m in sys.modules if m.split('.')[0] in ('numpy', 'h5py', 'typing') or "
        "m.startswith('tagid.')))"
    )
    done = subprocess.run([sys.executable, "-S", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "['tagid._version']"


def test_a_workplace_refuses_what_it_does_not_know(
    home: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("TAGID_CONFIG", "TAGID_DATA"):
        monkeypatch.setenv(name, home[name])
    with pytest.raises(ConfigError, match=r"radar\.ulr"):
        tagid.Workplace({"radar.ulr": "emulator://empty"})
    with pytest.raises(UsageError, match="zero"):
        tagid.Workplace(background="zero")
    with pytest.raises(UsageError, match="no recording"):
        tagid.Workplace().identify_together([])
