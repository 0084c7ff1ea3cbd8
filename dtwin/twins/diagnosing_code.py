"""Which code made a diagnosis: what was kept of another version may say what today's rules do not."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import dtwin

MADE_BY = "made_by"
"""Where a stored diagnosis says which code made it."""
_PACKAGE = Path(str(dtwin.__file__)).parent
_DIAGNOSING = ("physics/**/*.py", "kinds/**/*.py", "features/**/*.py", "twins/*.py", "statistics.py", "kinematics.py")


@cache
def diagnosing_code() -> str:
    """Return a check sum of the code that diagnoses, and of the versions of what it computes with."""
    digest = hashlib.sha256(f"{version('numpy')} {version('scipy')}".encode())
    for file in sorted(file for part in _DIAGNOSING for file in _PACKAGE.glob(part)):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def is_of_other_code(diagnosis: Mapping[str, Any] | None) -> bool:
    """Tell whether a stored diagnosis was made by another version of dtwin than this one."""
    # A page has none, or an empty one, where nothing was diagnosed.
    if not diagnosis:
        return False
    return diagnosis.get(MADE_BY) != diagnosing_code()
