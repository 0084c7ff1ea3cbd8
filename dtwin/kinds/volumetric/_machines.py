"""The virtual mill that heat deforms."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from dtwin.kinds.machine import PLAN, Options, Request, Simulated, VirtualMachine

if TYPE_CHECKING:
    from dtwin.config import Home
    from dtwin.machines.axis_server import ServedMachine
    from dtwin.progress import Progress
    from dtwin.train.closed_loop import Evidence
    from dtwin.train.registry import RegisteredVersion


class _WarmMill(VirtualMachine):
    name = "volumetric"
    type = "volumetric"
    kind = "volumetric"
    options: ClassVar[Options] = {PLAN: (), "truth": ("surface", "pockets"), "schedule": ("training", "validation")}
    clocks = ("machine",)

    def simulate(self, request: Request, progress: Progress) -> Simulated:
        from dtwin.kinds.volumetric._simulate import parameters_of, simulate_volumetric

        out, truth, schedule = request.out, request.options["truth"], request.options["schedule"]
        cycles = simulate_volumetric(
            out,
            progress,
            schedule=schedule,
            seed=request.seed,
            quick=request.quick,
            plan=request.plan,
            parameters=parameters_of(truth),
            test=request.plan.name if request.plan else "",
        )
        payload = {"folder": str(out), "truth": truth, "schedule": schedule, "cycles": cycles}
        return Simulated(payload, [f"{cycles} cycles in {out}", f"next: dtwin ingest {out}"])

    def served(self, request: Request) -> ServedMachine:
        from dtwin.kinds.volumetric._simulate import ServedMill

        truth, schedule = request.options["truth"], request.options["schedule"]
        return ServedMill(request.plan, truth, schedule, request.seed, quick=request.quick)

    def prediction(self, home: Home, version: RegisteredVersion, progress: Progress) -> Evidence:
        from dtwin.kinds.volumetric._evidence import volumetric_evidence

        return volumetric_evidence(home, version, progress=progress)


MACHINES = (_WarmMill(),)
