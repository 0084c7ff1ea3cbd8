"""What a published source says stands in ``studies``; the product names one only where it says what a thing is from."""

from __future__ import annotations

import re
from pathlib import Path

import dtwin

# "on paper" is an idiom, ``"paper"`` a coordinate system of plots.
_A_SOURCE = re.compile(r"\bthes[ie]s\b|\bdissertation\b|(?<!on )(?<!\")\bpapers?\b", re.IGNORECASE)


def test_the_product_names_no_thesis_and_no_paper() -> None:
    root = Path(dtwin.__file__).parent
    # Commands and their list name the verbs that start a study.
    files = [p for p in sorted(root.rglob("*.py")) if p.parent.name != "commands" and p != root / "cli.py"]
    named = [
        f"{path.relative_to(root)}:{number}: {line.strip()}"
        for path in files
        for number, line in enumerate(path.read_text("utf-8").splitlines(), 1)
        if _A_SOURCE.search(line) and not re.search(r"Source: |reference=", line)
    ]
    assert len(files) > 400
    assert named == []
