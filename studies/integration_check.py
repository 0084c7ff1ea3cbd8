"""What double integration of accelerations could see of a measured error, at best."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dtwin.acquire.b5r import read_b5r
from dtwin.config import sample_recording
from dtwin.physics.circular import fit_circle, residual_um
from dtwin.schema import Floats, Run
from studies.integration import Visibility, displacement_visibility, swarm_minimum

# The sensor's coupling, and the usual window: 800 samples at 1651.6 Hz.
_COUPLING_HZ = 0.5
_WINDOW_S = 800 / 1651.6


@dataclass(frozen=True)
class IntegrationCheck:
    """What double integration answers for a known error, with ideal sensors.

    ``run``: which run's error was sent through the chain.
    ``answer_um``: RMS of what the chain answers: every restart begins with an unknown velocity.
    ``filtered_um``, ``filtered_correlation``: the same with the spectral threshold at which a particle swarm found
    least loss, and how that answer correlates with the error.
    """

    run: str
    error_um: float
    answer_um: float
    filtered_um: float
    filtered_correlation: float
    cutoff_g2: float

    def as_dict(self) -> dict[str, float | str]:
        """Return a JSON-ready mapping."""
        return dict(vars(self))

    def __str__(self) -> str:
        return (
            f"double integration of ideal accelerations ({_COUPLING_HZ:g} Hz coupling, restarted "
            f"every {1000 * _WINDOW_S:z.0f} ms) would answer {self.answer_um:z.0f} µm RMS for this "
            f"error of {self.error_um:z.0f} µm; with the spectral threshold that a particle swarm "
            f"finds best, {self.filtered_um:z.1f} µm that correlate {self.filtered_correlation:z.2f} "
            "with it"
        )


def _check_integration(run: Run) -> IntegrationCheck:
    """Send a run's measured error through coupling, threshold and restarted integration.

    ``run``: a circular run; the error is what remains after its centre and radius.
    """
    error_mm = _error_mm(run)
    rate_hz = run.meta.sample_rate_hz
    window = max(2, round(_WINDOW_S * rate_hz))

    def seen(cutoff_g2: float) -> Visibility:
        return displacement_visibility(error_mm, rate_hz, window, corner_hz=_COUPLING_HZ, cutoff_power=cutoff_g2)

    chosen = swarm_minimum(lambda c: seen(c).lost_fraction, 1e-9, 1e3, particles=12, iterations=20)
    plain, filtered = seen(0.0), seen(chosen.position)
    return IntegrationCheck(
        run.meta.run_id,
        1000.0 * plain.true_rms_mm,
        1000.0 * plain.found_rms_mm,
        1000.0 * filtered.found_rms_mm,
        filtered.correlation,
        chosen.position,
    )


def sample_check() -> IntegrationCheck:
    """Return the check for the real recording, counter-clockwise."""
    return _check_integration(read_b5r(sample_recording()).runs[0])


def _error_mm(run: Run) -> Floats:
    radius = float(run.meta.radius_mm or 100.0)
    angle, deviation = run.arc
    rest = residual_um(angle, deviation, radius, fit_circle(angle, deviation, radius))
    return np.asarray(rest / 1000.0)
