"""What an equation of heat must show before it may move a tool point."""

from __future__ import annotations

from collections.abc import Mapping

from dtwin.serve.bundle import Bundle
from dtwin.train.gates import Verdict, bounded_output, latency_gate, vectors_proved

_LEAST_R2 = 0.5


def volumetric_gates(bundle: Bundle, metrics: Mapping[str, float]) -> list[Verdict]:
    """Judge a bundle for heat by everything that needs no other campaign.

    ``metrics``: what training logged: scores of hours left out, latency.
    """
    r2 = metrics.get("leave_hours_out.r2", float("nan"))
    worst = metrics.get("leave_hours_out.worst_slice_ratio", float("inf"))
    return [
        Verdict("held-out hours", r2 >= _LEAST_R2, f"R² {r2:z.3f}; at least {_LEAST_R2}"),
        Verdict(
            "no slice worse than no correction",
            worst < 1.0,
            f"the worst span of hours keeps {100 * worst:z.0f} % of its error",
        ),
        bounded_output(bundle),
        vectors_proved(bundle),
        latency_gate(metrics),
    ]
