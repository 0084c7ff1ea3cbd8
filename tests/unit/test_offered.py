"""Names that packages offer by ``dtwin.offered``, which mypy cannot follow."""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path

ROOT = Path(__file__).parents[2]
OFFERING = {
    ".".join(path.parent.relative_to(ROOT).parts)
    for path in (ROOT / "dtwin").rglob("__init__.py")
    if "offered(__name__" in path.read_text("utf-8")
}


def test_every_name_that_is_imported_from_a_package_is_offered_by_it() -> None:
    taken = {
        (node.module, alias.name)
        for folder in ("dtwin", "flows", "studies")
        for path in (ROOT / folder).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.ImportFrom) and node.module in OFFERING
        for alias in node.names
    }
    assert taken
    assert not [(package, name) for package, name in sorted(taken) if not hasattr(import_module(package), name)]
