"""Prefect flows; thin, and the only place that knows Prefect.

``campaign``, ``ingest``, ``train``, ``promote``, ``diagnose``, ``cell`` and ``schedule`` hold one flow each,
``papers`` one for each published system.
Every flow only calls what ``dtwin.pipeline`` or ``studies`` does without Prefect, and publishes what it found.
"""

import contextlib
import os

from dtwin.config import home, quiet_environment

# Prefect reads its settings when it is first imported, which the modules below do, and wants
# to make its folder then, but not the folder around it.
quiet_environment()
with contextlib.suppress(OSError):
    home().root.mkdir(parents=True, exist_ok=True)
os.environ.setdefault("PREFECT_HOME", str(home().prefect))
