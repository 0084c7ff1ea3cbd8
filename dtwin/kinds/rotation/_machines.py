"""The virtual rotor."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from dtwin.kinds.machine import Options, Request, Simulated, VirtualMachine

if TYPE_CHECKING:
    from dtwin.progress import Progress


class _Rotor(VirtualMachine):
    name = "rotor"
    type = "rotor"
    kind = "rotation"
    options: ClassVar[Options] = {"truth": ("unbalance", "sound", "resonance", "balls", "warming")}

    def simulate(self, request: Request, progress: Progress) -> Simulated:
        from dtwin.kinds.rotation._simulate import simulate_rotation

        out, truth = request.out, request.options["truth"]
        files = simulate_rotation(out, progress, truth=truth, seed=request.seed, quick=request.quick)
        payload = {"folder": str(out), "truth": truth, "files": files}
        return Simulated(payload, [f"{files} speeds in {out}", f"next: dtwin check {out}"])


MACHINES = (_Rotor(),)
