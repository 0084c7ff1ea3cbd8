"""Commands about positioning tests and their compensation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dtwin.commands.output import emit


def is_linear(file: Path) -> bool:
    """Tell whether a plan file asks for a positioning test; what is wrong with it is said later."""
    import tomllib

    try:
        head = tomllib.loads(file.read_text(encoding="utf-8")).get("plan", {})
    except (OSError, ValueError):
        return False
    return isinstance(head, dict) and head.get("kind") == "linear"


def plan_positioning(file: Path, out: Path | None, control: str, *, as_json: bool) -> None:
    """Check a positioning plan, say what it cannot tell, and write its program."""
    from dtwin.atomic import write_text
    from dtwin.laser_program import laser_program
    from dtwin.linear_plan import duration_s, linear_advice, read_linear_plan

    plan = read_linear_plan(file)
    findings = linear_advice(plan)
    payload: dict[str, Any] = {
        "name": plan.name,
        "machine": plan.machine,
        "kind": "linear",
        "axis": plan.axis,
        "targets": plan.count,
        "runs": plan.runs,
        "readings": plan.readings,
        "total_s": duration_s(plan),
        "findings": [finding.as_dict() for finding in findings],
    }
    if out is not None:
        name = out / f"{plan.name}.nc"
        write_text(name, laser_program(plan, control), "the program")
        payload["programs"] = [str(name)]

    def text() -> str:
        lines = [
            f"{plan.name} on {plan.machine}: axis {plan.axis}, {plan.count} targets from {plan.start:g} "
            f"to {plan.end:g} {plan.unit}, {plan.runs} runs, {plan.readings} readings, about "
            f"{payload['total_s'] / 3600:.1f} h",
            *(f"  {f.severity}: {f.message}" for f in findings),
            *(f"  {name} written; never run on a control" for name in payload.get("programs", ())),
        ]
        return "\n".join(lines)

    emit(payload, text, as_json=as_json)


def simulate_positioning(
    out: Path, plan: Path | None, truth: str, *, seed: int, quick: bool, as_json: bool
) -> None:
    """Measure the virtual lathe."""
    from dtwin.acquire.virtual_lathe import simulate_lathe
    from dtwin.linear_plan import read_linear_plan

    chosen = None if plan is None else read_linear_plan(plan)
    readings, alarms = simulate_lathe(out, plan=chosen, truth=truth, seed=seed, quick=quick)
    payload = {
        "folder": str(out),
        "readings": readings,
        "truth": truth,
        "alarms": [alarm.as_dict() for alarm in alarms],
    }
    lines = [f"{readings} readings in {out}", *(f"  {a.severity}: {a.message}" for a in alarms)]
    emit(payload, lambda: "\n".join([*lines, f"next: dtwin check {out}"]), as_json=as_json)
