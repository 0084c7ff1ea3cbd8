"""A probe at the tool that reads with the opposite sign is said; every figure of the tool would be wrong by twice the tone."""

from __future__ import annotations

import numpy as np
import pytest

from dtwin.kinds.sinusoidal._check import judge_sinusoidal_run
from dtwin.schema import Run, RunMeta


@pytest.mark.parametrize(("sign", "said"), [(1.0, set()), (-1.0, {"sinusoidal.sign"})])
def test_a_probe_of_the_opposite_sign_is_an_error(sign: float, said: set[str]) -> None:
    t_s = np.arange(0.0, 7.0, 0.001)
    encoder = 0.0196 * np.sin(2.0 * np.pi * 5.0 * t_s - 0.02)
    samples = {"t_s": t_s, "cmd_z_mm": 0.02 * np.sin(2.0 * np.pi * 5.0 * t_s), "act_z_mm": encoder}
    condition = {"frequency_hz": 5.0, "amplitude_um": 20.0}
    run = Run(RunMeta("f5", kind="sinusoidal", condition=condition), {**samples, "tool_z_mm": sign * 1.02 * encoder})
    assert {f.code for f in judge_sinusoidal_run(run) if f.severity == "error"} == said
