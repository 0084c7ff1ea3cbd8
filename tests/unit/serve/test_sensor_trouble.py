from __future__ import annotations

import numpy as np
import pytest

from dtwin.serve.decision import SATURATED, SOUND, saturated_kernel

NOISE = np.random.default_rng(1).standard_normal(600)


def test_a_signal_that_was_cut_is_found_on_either_side() -> None:
    assert saturated_kernel(np.clip(NOISE, -9.0, 1.2)) == SATURATED
    assert saturated_kernel(np.clip(NOISE, -1.2, 9.0)) == SATURATED


@pytest.mark.parametrize("steps", [100, 1000])
def test_sound_signals_are_not_accused(steps: int) -> None:
    sine = np.round(steps * np.sin(np.linspace(0.0, 60.0, 600)))
    assert saturated_kernel(sine) == SOUND
    assert saturated_kernel(NOISE) == SOUND
    # Stuck is another trouble, which the features name.
    assert saturated_kernel(np.full(600, 0.3)) == SOUND
