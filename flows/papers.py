"""The tables of the published systems, computed again: theirs, ours, the answer."""

from __future__ import annotations

from typing import Any

from prefect import Flow, flow

from flows import _artifacts, _tasks
from studies.papers import PAPERS
from studies.report.papers import counted


def _paper_flow(name: str) -> Flow[..., Any]:
    """Return the flow of a source; its parameters are the seed and whether to compute less."""

    def paper_flow(seed: int = 0, quick: bool = False) -> dict[str, Any]:
        found = _tasks.paper(name, quick, seed)
        keys = ("target", "what", "paper", "ours", "answer")
        _artifacts.publish_table(
            f"{name}-paper",
            ("target", "figure", "the paper", "ours", "answer"),
            [[line[key] for key in keys] for line in found["lines"]],
            f"{PAPERS[name].source}: {counted(found['lines'])}",
        )
        return found

    # What starts it on the Prefect page finds it by its name in this module.
    paper_flow.__name__ = paper_flow.__qualname__ = f"{name}_paper_flow"
    paper_flow.__doc__ = f"Compute the tables of {PAPERS[name].source} again: the paper's figures, ours, the answer."
    return flow(name=f"{name}-paper", flow_run_name=name + "-paper seed {seed}")(paper_flow)


lathe_paper_flow = _paper_flow("lathe")
turning_paper_flow = _paper_flow("turning")
volumetric_paper_flow = _paper_flow("volumetric")
dynamics_paper_flow = _paper_flow("dynamics")
paper_flows = (lathe_paper_flow, turning_paper_flow, volumetric_paper_flow, dynamics_paper_flow)
