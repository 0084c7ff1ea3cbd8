"""Keep every test module with its asserts rewritten, as pytest does: ``python tests/rewritten.py``.

Each worker of pytest would do so for itself, and keeps nothing where Python may not write bytecode.
"""

from __future__ import annotations

import os
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, cast

from _pytest.assertion.rewrite import PYC_TAIL, _read_pyc, _rewrite_test, _write_pyc, get_cache_dir


def rewrite(module: Path) -> None:
    """Write the file that pytest looks for, where there is none of this source."""
    folder = get_cache_dir(module)
    kept = folder / f"{module.stem}{PYC_TAIL}"
    if _read_pyc(module, kept) is None:
        folder.mkdir(parents=True, exist_ok=True)
        # Without its settings pytest rewrites as it does by default; its state is only told of what goes wrong.
        nothing = cast(Any, None)
        source_hash, code = _rewrite_test(module, nothing)
        _write_pyc(nothing, code, source_hash, kept)


if __name__ == "__main__":
    names = ("test_*.py", "conftest.py")
    modules = [path for name in names for path in Path(__file__).parent.rglob(name)]
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(rewrite, modules, chunksize=8))
