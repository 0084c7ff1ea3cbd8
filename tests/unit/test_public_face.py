"""What is public: names of ``dtwin``, documented modules of its packages, and how it is called."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

import dtwin
from dtwin.errors import MissingPart

ROOT = Path(__file__).parents[2]
PACKAGES = sorted(".".join(path.parent.relative_to(ROOT).parts) for path in ROOT.glob("dtwin/**/__init__.py"))
DOCUMENTED = {
    module
    for path in (ROOT / "docs" / "reference").rglob("*.md")
    for module in re.findall(r"^::: (\S+)$", path.read_text(encoding="utf-8"), re.M)
}


def test_importing_dtwin_brings_nothing_heavy() -> None:
    told = "import sys, dtwin; print(*{m.partition('.')[0] for m in sys.modules})"
    loaded = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=True).stdout.split()
    assert "dtwin" in loaded
    assert not {"numpy", "pandas", "pyarrow", "plotly", "scipy", "numba", "typer"} & set(loaded)


@pytest.mark.parametrize("name", dtwin.__all__)
def test_every_public_name_is_there(name: str) -> None:
    assert getattr(dtwin, name).__name__ == name
    assert name in dir(dtwin)


def test_a_name_that_is_not_there_is_one_of_no_module() -> None:
    with pytest.raises(AttributeError, match="no attribute 'fit_all'"):
        dtwin.fit_all  # noqa: B018


def test_a_host_without_pandas_is_told_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("dtwin.notebook.open_home", "dtwin.notebook.answers"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingPart) as refused:
        dtwin.open_home  # noqa: B018
    assert (refused.value.code, refused.value.got) == ("package.missing", "pandas")


@pytest.mark.parametrize("package", [p for p in PACKAGES if p != "dtwin"])
def test_a_package_names_its_documented_modules_and_no_others(package: str) -> None:
    module = import_module(package)
    assert (module.__doc__ or "").strip()
    documented = {name.rpartition(".")[2] for name in DOCUMENTED if name.rpartition(".")[0] == package}
    assert documented <= set(module.__all__)
    # What else it offers are no modules, and are there.
    assert not any(isinstance(getattr(module, name), ModuleType) for name in set(module.__all__) - documented)


def test_what_is_installed_is_not_called_like_the_package_of_others() -> None:
    told = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    project = told["project"]
    assert project["name"] == "dtwin-metrology"
    assert project["scripts"] == {"dtwin": "dtwin.cli:main"}
    own = re.compile(r"dtwin\[|pip install '?dtwin\b(?!-)")
    said = [
        f"{path.relative_to(ROOT)}: {line.strip()}"
        for folder in ("dtwin", "flows", "studies", "docs")
        for path in (ROOT / folder).rglob("*.[pm][yd]")
        for line in path.read_text(encoding="utf-8").splitlines()
        if own.search(line)
    ]
    assert said == [], "whoever follows this installs the package of others"


def test_the_hooks_before_a_commit_are_what_the_tests_begin_with() -> None:
    hooks = (ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8")
    run = (ROOT / "tests" / "run.sh").read_text(encoding="utf-8")
    entries = re.findall(r"^ *entry: (.+)$", hooks, re.M)
    assert len(entries) == 4
    assert all(entry in run for entry in entries)


def test_what_contributing_names_is_there() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    named = re.findall(r"\]\(([^)#]+)\)|\b((?:tests|docs|\.ci)/[\w/.-]*\w)", text)
    assert named
    for link, path in named:
        assert (ROOT / (link or path)).exists(), link or path


def test_the_picture_of_the_architecture_is_that_of_the_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "docs" / "pictures")
    drawn = import_module("architecture").picture()
    kept = (ROOT / "docs" / "pictures" / "architecture.svg").read_text(encoding="utf-8")
    assert drawn == kept, "python docs/pictures/architecture.py"
