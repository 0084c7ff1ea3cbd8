"""The table of the paper on ball-bar dynamics, computed again."""

from __future__ import annotations

from typing import Any

from prefect import flow

from dtwin.pipeline.dynamics_paper import FULL, QUICK
from flows import _artifacts, _tasks


@flow(name="ballbar-dynamics", flow_run_name="ballbar-dynamics seed {seed}")
def dynamics_flow(seed: int = 0, quick: bool = False) -> dict[str, Any]:
    """Compute the published figures again and publish theirs beside ours.

    Parameters
    ----------
    seed : int
        Of vibration, swarm and virtual hexapod.
    quick : bool
        Fewer machines, feeds and particles.
    """
    found = _tasks.dynamics_paper(QUICK if quick else FULL, seed)
    judged = {True: "yes", False: "no", None: "not judged"}
    rows = [
        [line["target"], line["what"], line["paper"], line["ours"], judged[line["follows"]]]
        for line in found["lines"]
    ]
    _artifacts.publish_table(
        "ballbar-dynamics",
        ("target", "figure", "the paper", "ours", "follows"),
        rows,
        "Xing, Bonev, Champliaud, Liu (2024): what it reports, and what is found here",
    )
    return found
