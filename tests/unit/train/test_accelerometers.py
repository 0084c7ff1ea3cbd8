"""Accelerometers that training may use: channels in g, which every run has."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from dtwin.schema import SignalGroup
from dtwin.train.inputs import _contract_of


@pytest.mark.parametrize(
    ("first", "second", "channels"),
    [
        (("wrist_x_g", "base_v"), ("wrist_x_g", "base_z_g"), ("wrist_x_g",)),
        (("wrist_x_g", "base_z_g"), ("wrist_x_g",), None),
        (("wrist_x_v",), ("wrist_x_v",), None),
    ],
)
def test_channels_are_those_in_g_that_every_run_has(
    first: tuple[str, ...], second: tuple[str, ...], channels: tuple[str, ...] | None
) -> None:
    runs = [
        SimpleNamespace(accelerometers=SignalGroup("accelerometers", 1000.0, {name: np.zeros(9) for name in names}))
        for names in (first, second)
    ]
    contract = _contract_of(SimpleNamespace(runs=runs))  # type: ignore[arg-type]
    assert (None if contract is None else contract.channels) == channels
