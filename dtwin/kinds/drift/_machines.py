"""The virtual column that its spindle warms."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from dtwin.kinds.machine import EvidenceRequest, Options, Request, Simulated, VirtualMachine

if TYPE_CHECKING:
    from dtwin.progress import Progress
    from dtwin.train.oracle import MeasuredWays


class _WarmColumn(VirtualMachine):
    name = "column"
    type = "warm_column"
    kind = "drift"
    options: ClassVar[Options] = {"truth": ("surface", "pockets", "thermistor")}

    def simulate(self, request: Request, progress: Progress) -> Simulated:
        from dtwin.kinds.drift._evidence import simulate_drift

        out, truth = request.out, request.options["truth"]
        logs = simulate_drift(out, progress, truth=truth, seed=request.seed, quick=request.quick)
        payload = {"folder": str(out), "truth": truth, "logs": logs}
        return Simulated(payload, [f"{logs} log{'s' if logs > 1 else ''} in {out}", f"next: dtwin ingest {out}"])

    def evidence(self, request: EvidenceRequest) -> MeasuredWays:
        from dtwin.kinds.drift._evidence import measured_warm_ups

        truth = str(request.geometry.get("truth", ""))
        return measured_warm_ups(request.bundle, truth, request.seed, request.progress)


MACHINES = (_WarmColumn(),)
