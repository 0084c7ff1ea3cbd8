"""Two commands that are the first of a home at the same moment."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.system
ASK = "import sys; from pathlib import Path; from dtwin.config import Home; from dtwin.train.registry import Registry; print(Registry(Home(Path(sys.argv[1]))).machines())"


def test_both_find_the_tables_of_the_registry(tmp_path: Path) -> None:
    command = [sys.executable, "-c", ASK, str(tmp_path / "home")]
    asked = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    for process in asked:
        said, complained = process.communicate(timeout=600)
        assert (process.returncode, said) == (0, "[]\n"), complained
