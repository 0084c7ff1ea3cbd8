"""Commands about slow tool servo turning."""

from __future__ import annotations

from pathlib import Path

from dtwin.commands.output import ProgressLine, emit


def simulate_tones(out: Path, truth: str, *, seed: int, quick: bool, as_json: bool) -> None:
    """Measure tones on the virtual Z slide."""
    from dtwin.acquire.virtual_turning import simulate_turning

    progress = ProgressLine("measure", quiet=as_json)
    groups = simulate_turning(out, truth=truth, seed=seed, quick=quick, progress=progress)
    payload = {"folder": str(out), "groups": groups, "truth": truth}
    emit(
        payload,
        lambda: f"{groups} groups in {out}\nnext: dtwin check {out}",
        as_json=as_json,
    )
