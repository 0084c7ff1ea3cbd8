"""A virtual rotary table: a scale off centre, a worm whose teeth are triangles, noise."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from dtwin.kinds.machine import PLAN, EvidenceRequest, Options, Request, Simulated, VirtualMachine
from sixth_kind.effects import TEETH

if TYPE_CHECKING:
    from dtwin.progress import Progress
    from dtwin.schema import Floats, Run
    from dtwin.train.oracle import MeasuredWays

RIM_MM, OFF_MM, TOOTH_UM, NOISE_UM = 100.0, 0.012, 3.0, 0.2
SPEEDS_DEG_S, REPEATS, STEP_DEG = (6.0, 30.0), 3, 2.5


def error_um(angle_deg: Floats, rng: np.random.Generator) -> Floats:
    """Return where the rim is too far on, shape (n,), in um."""
    seen = np.angle(RIM_MM * np.exp(1j * np.radians(angle_deg)) + OFF_MM * np.exp(0.7j))
    lag = np.angle(np.exp(1j * (seen - np.radians(angle_deg)))) * RIM_MM * 1000.0
    share = (angle_deg / 360.0 * TEETH) % 1.0
    return lag + TOOTH_UM * (4.0 * np.abs(share - 0.5) - 1.0) + rng.normal(0.0, NOISE_UM, len(lag))


class Table(VirtualMachine):
    name, type, kind = "table", "rotary-table", "turntable"
    options: ClassVar[Options] = {PLAN: ()}

    def simulate(self, request: Request, progress: Progress) -> Simulated:
        repeats = REPEATS if request.plan is None else request.plan
        runs = self.turns(repeats, request.seed)
        request.out.mkdir(parents=True, exist_ok=True)
        entries = [_written(request.out, run, number) for number, run in enumerate(runs)]
        head = {"name": "table", "machine": "table-1", "kind": "turntable", "started": runs[0].meta.started}
        lines = [
            "[campaign]",
            *_toml(head),
            "[campaign.machine_geometry]",
            *_toml({"type": self.type, "virtual": True}),
        ]
        (request.out / "campaign.toml").write_text("\n".join([*lines, *entries, ""]))
        return Simulated({"runs": len(runs)}, [f"{len(runs)} turns"])

    def turns(self, repeats: int, seed: int, correct: Any = None, correction: str = "") -> list[Run]:
        from dtwin.schema import Run, RunMeta

        rng, out = np.random.default_rng(seed), []
        for repeat in range(1, repeats + 1):
            for speed in SPEEDS_DEG_S:
                angle = np.arange(0.0, 360.0, STEP_DEG)
                error = error_um(angle, rng) - (correct(angle) if correct else 0.0)
                meta = RunMeta(
                    f"r{len(out) + 1:03d}",
                    kind="turntable",
                    repeat=repeat,
                    correction=correction,
                    condition={"axis": "C", "speed_deg_s": speed},
                    sample_rate_hz=speed / STEP_DEG,
                    started=f"2026-05-04T08:{len(out):02d}:00+00:00",
                )
                out.append(Run(meta, {"t_s": angle / speed, "angle_deg": angle, "error_um": error}))
        return out

    def evidence(self, request: EvidenceRequest) -> MeasuredWays:
        from dtwin.serve.runtime import CompiledBundle
        from dtwin.train.oracle import MeasuredWays, numbered

        compiled = CompiledBundle(request.bundle)
        runs: list[Run] = []
        for turn in range(3):
            runs += self.turns(1, 100 + 2 * turn)
            sha = request.bundle.model_sha256
            runs += self.turns(1, 101 + 2 * turn, lambda a: compiled.run(a[:, None])[:, 0], sha)
        later = [
            replace(r, meta=replace(r.meta, started=f"2026-05-05T08:{n:02d}:00+00:00")) for n, r in enumerate(runs)
        ]
        return MeasuredWays(numbered(later), "machine clock")


def _toml(values: dict[str, Any]) -> list[str]:
    return [f"{name} = {json.dumps(value)}" for name, value in values.items()]


def _written(folder: Path, run: Run, number: int) -> str:
    meta, rows = run.meta, np.column_stack(list(run.samples.values()))
    file = f"{meta.run_id}.csv"
    np.savetxt(folder / file, rows, "%.6f", ",", header=",".join(run.samples), comments="")
    speed = meta.condition["speed_deg_s"]
    return "\n".join(
        [
            "[[run]]",
            *_toml({"id": meta.run_id, "file": file, "repeat": meta.repeat}),
            f'condition = {{ axis = "C", speed_deg_s = {speed} }}',
            f'started = "{meta.started}"',
        ]
    )
