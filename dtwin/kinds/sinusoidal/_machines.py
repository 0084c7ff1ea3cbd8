"""The virtual slide of a slow tool servo."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from dtwin.kinds.machine import PLAN, EvidenceRequest, Options, Request, Simulated, VirtualMachine

if TYPE_CHECKING:
    from dtwin.machines.axis_server import ServedMachine
    from dtwin.progress import Progress
    from dtwin.train.oracle import MeasuredWays


class _Turning(VirtualMachine):
    name = "turning"
    type = "turning"
    kind = "sinusoidal"
    options: ClassVar[Options] = {PLAN: (), "truth": ("linear", "hardening", "friction")}
    clocks = ("machine",)
    seeds_measuring = True

    def simulate(self, request: Request, progress: Progress) -> Simulated:
        from dtwin.kinds.sinusoidal._simulate import simulate_turning

        out, truth = request.out, request.options["truth"]
        groups = simulate_turning(
            out, truth=truth, seed=request.seed, quick=request.quick, plan=request.plan, progress=progress
        )
        payload = {"folder": str(out), "groups": groups, "truth": truth}
        return Simulated(payload, [f"{groups} groups in {out}", f"next: dtwin check {out}"])

    def served(self, request: Request) -> ServedMachine:
        from dtwin.kinds.sinusoidal._served import ServedSlide, tone_check

        tones = request.plan or tone_check(quick=request.quick)
        return ServedSlide(tones, request.options["truth"], request.seed)

    def evidence(self, request: EvidenceRequest) -> MeasuredWays:
        from dtwin.kinds.sinusoidal._evidence import measured_tones

        truth = str(request.geometry.get("truth", ""))
        return measured_tones(request.bundle, truth, seed=request.seed, progress=request.progress)


MACHINES = (_Turning(),)
