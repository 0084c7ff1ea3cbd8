"""The virtual lathe, whose axis a laser measures."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from dtwin.errors import InputError
from dtwin.kinds.machine import PLAN, EvidenceRequest, Options, Request, Simulated, VirtualMachine

if TYPE_CHECKING:
    from dtwin.machines.axis_server import ServedMachine
    from dtwin.progress import Progress
    from dtwin.train.oracle import MeasuredWays


class _Lathe(VirtualMachine):
    name = "lathe"
    type = "lathe"
    kind = "linear"
    options: ClassVar[Options] = {PLAN: (), "truth": ("published", "mechanism")}
    clocks = ("machine", "wall")
    seeds_measuring = True

    def simulate(self, request: Request, progress: Progress) -> Simulated:
        from dtwin.kinds.linear._simulate import simulate_lathe

        out, truth = request.out, request.options["truth"]
        readings, alarms = simulate_lathe(out, plan=request.plan, truth=truth, seed=request.seed, quick=request.quick)
        payload = {
            "folder": str(out),
            "readings": readings,
            "truth": truth,
            "alarms": [alarm.as_dict() for alarm in alarms],
        }
        told = [f"  {alarm.severity}: {alarm.message}" for alarm in alarms]
        lines = [f"{readings} readings in {out}", *told, f"next: dtwin check {out}"]
        return Simulated(payload, lines)

    def served(self, request: Request) -> ServedMachine:
        from dtwin.kinds.linear._simulate import ServedLathe

        if request.quick:
            raise InputError(
                "the lathe that is corrected measures one run of its short test already",
                code="simulate.quick",
                got="--quick with --listen",
                hint="leave --quick away",
            )
        return ServedLathe(request.plan, request.options["truth"], request.seed)

    def evidence(self, request: EvidenceRequest) -> MeasuredWays:
        from dtwin.kinds.linear._evidence import measured_days

        logged, truth = request.registry.metrics(request.version), request.geometry.get("truth", "")
        return measured_days(request.bundle, logged, str(truth), request.seed, request.progress)


MACHINES = (_Lathe(),)
