"""What double integration of accelerations could see of a measured error, at best."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dtwin.acquire.b5r import read_b5r
from dtwin.config import sample_recording
from dtwin.features.integration import displacement_visibility, swarm_minimum
from dtwin.physics.circular import fit_circle, residual_um
from dtwin.schema import Floats, Run

# The sensor's coupling, and the window of the source thesis: 800 samples at 1651.6 Hz.
COUPLING_HZ = 0.5
WINDOW_S = 800 / 1651.6


@dataclass(frozen=True)
class IntegrationCheck:
    """Share of the error's energy that double integration loses, with ideal sensors.

    Attributes
    ----------
    run : str
        Which run's error was sent through the chain.
    lost_plain, lost_filtered : float
        Without the spectral threshold, and with the threshold that a particle swarm chose to
        lose least: 0 is perfect, 1 no better than answering zero.
    cutoff_g2 : float
        That threshold.
    """

    run: str
    lost_plain: float
    lost_filtered: float
    cutoff_g2: float

    def as_dict(self) -> dict[str, float | str]:
        """Return a JSON-ready mapping."""
        return dict(vars(self))


def check_integration(run: Run) -> IntegrationCheck:
    """Send a run's measured error through coupling, threshold and restarted integration.

    Parameters
    ----------
    run : Run
        A circular run; the error is what remains after its centre and radius.
    """
    error_mm = _error_mm(run)
    rate_hz = run.meta.sample_rate_hz
    window = max(2, round(WINDOW_S * rate_hz))

    def lost(cutoff_g2: float) -> float:
        return displacement_visibility(
            error_mm, rate_hz, window, corner_hz=COUPLING_HZ, cutoff_power=cutoff_g2
        ).lost_fraction

    chosen = swarm_minimum(lost, 1e-9, 1e-1, particles=12, iterations=20)
    return IntegrationCheck(run.meta.run_id, lost(0.0), chosen.value, chosen.position)


def sample_check() -> IntegrationCheck:
    """Return the check for the real recording, counter-clockwise."""
    return check_integration(read_b5r(sample_recording()).runs[0])


def _error_mm(run: Run) -> Floats:
    part = slice(*run.window) if run.window is not None else slice(None)
    radius = float(run.meta.radius_mm or 100.0)
    angle, deviation = run.samples["angle_deg"][part], run.samples["deviation_um"][part]
    rest = residual_um(angle, deviation, radius, fit_circle(angle, deviation, radius))
    return np.asarray(rest / 1000.0)
