"""Virtual machines that run circles: a cobot, a mill and a hexapod."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, ClassVar

from dtwin.errors import InputError
from dtwin.kinds.machine import PLAN, EvidenceRequest, Options, Request, Simulated, VirtualMachine

if TYPE_CHECKING:
    from dtwin.acquire.runner import Bench
    from dtwin.plan import EvidencePlan, Plan
    from dtwin.progress import Progress
    from dtwin.train.oracle import MeasuredWays
    from dtwin.train.still_helps import CheckedRun


class _Cobot(VirtualMachine):
    name = "cobot"
    type = "ur10e"
    kind = "circular"
    options: ClassVar[Options] = {PLAN: ()}
    robot = True

    def simulate(self, request: Request, progress: Progress) -> Simulated:
        from dtwin.acquire.virtual import VirtualCobotBench
        from dtwin.plan import quick_training_plan, training_plan

        usual = quick_training_plan() if request.quick else training_plan()
        return _on_bench(VirtualCobotBench(request.seed), request.plan or usual, request, progress)

    def evidence(self, request: EvidenceRequest) -> MeasuredWays:
        import numpy as np

        from dtwin.kinds.circular._evidence import measured_circles

        return measured_circles(
            request.bundle,
            seed=request.seed,
            tcp_mm=np.asarray(request.geometry.get("tcp_mm", [0.0, 0.0, 0.0]), float),
            plan=request.plan or _trained_circles(request),
            progress=request.progress,
        )

    def checked(self, request: EvidenceRequest, blocks: int) -> list[CheckedRun]:
        from dtwin.kinds.circular._evidence import checked_circles
        from dtwin.machines.cobot import VirtualCobot

        return checked_circles(request, blocks, VirtualCobot(seed=request.seed))


class _Mill(VirtualMachine):
    name = "mill"
    type = "mill"
    kind = "circular"
    options: ClassVar[Options] = {PLAN: (), "hidden": ("backlash", "wobble", "servo", "none")}
    seeds_measuring = True

    def simulate(self, request: Request, progress: Progress) -> Simulated:
        from dtwin.acquire.virtual_mill import simulate_mill

        out, hidden, plan = request.out, request.options["hidden"], request.plan
        runs = simulate_mill(out, seed=request.seed, quick=request.quick, hidden=hidden, plan=plan, progress=progress)
        payload = {"folder": str(out), "runs": len(runs), "campaign": f"mill-{hidden}" if plan is None else plan.name}
        return Simulated(payload, [f"{len(runs)} runs in {out}", f"next: dtwin ingest {out}"])

    def evidence(self, request: EvidenceRequest) -> MeasuredWays:
        from dtwin.acquire.virtual_mill import virtual_mill
        from dtwin.kinds.circular._mill_evidence import measured_mill

        geometry = request.geometry
        if "hidden" not in geometry:
            raise InputError(
                "no virtual mill of this machine can be moved from here",
                code="evidence.mill",
                got=f"machine_geometry {', '.join(geometry)}",
                allowed="a campaign of dtwin simulate --machine mill",
                hint="dtwin demo mill measures its own evidence; else: dtwin campaign --with VERSION",
            )
        circles = request.plan or _trained_circles(request)
        return measured_mill(
            request.bundle,
            partial(virtual_mill, str(geometry["hidden"])),
            seed=request.seed,
            plan=replace(circles, repeats=max(circles.repeats, 3)),
            delay_s=float(geometry["correction_delay_s"]),
            progress=request.progress,
        )


class _Hexapod(VirtualMachine):
    name = "hexapod"
    type = "hexapod"
    kind = "circular"
    options: ClassVar[Options] = {PLAN: ()}
    robot = True

    def simulate(self, request: Request, progress: Progress) -> Simulated:
        from dtwin.kinds.circular._simulate_hexapod import VirtualHexapodBench, feed_sweep

        plan = request.plan or feed_sweep(quick=request.quick)
        return _on_bench(VirtualHexapodBench(request.seed), plan, request, progress)


def _on_bench(bench: Bench, plan: Plan, request: Request, progress: Progress) -> Simulated:
    from dtwin.acquire.runner import run_campaign

    done = run_campaign(plan, bench, request.out, progress)
    payload = {
        "folder": str(done.folder),
        "measured": done.measured,
        "kept": done.kept,
        "raw_bytes": done.raw_bytes,
        "campaign": plan.name,
    }
    told = f"{done.measured} tests measured, {done.kept} kept from before, in {done.folder}"
    return Simulated(payload, [told, f"next: dtwin ingest {done.folder}"])


def _trained_circles(request: EvidenceRequest) -> EvidencePlan:
    from dtwin.plan import plan_within
    from dtwin.train.results import CONDITIONS_FILE

    trained = request.registry.read_json(request.version, CONDITIONS_FILE)
    return plan_within([(p, float(r), float(f)) for p, r, f in trained])


MACHINES = (_Cobot(), _Mill(), _Hexapod())
