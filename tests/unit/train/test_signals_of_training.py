"""Signals that training may use: channels in g, which every run has; a controller's log with the commanded place."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from dtwin.acquire.ingest import ingest
from dtwin.acquire.signal_files import write_signals
from dtwin.config import home
from dtwin.errors import InputError
from dtwin.lake.store import Lake
from dtwin.pipeline.measuring import compute_features
from dtwin.schema import RunMeta, SignalGroup
from dtwin.train.dataset import _controller_ticks
from dtwin.train.inputs import _contract_of, _window_features


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


PLACE = tuple(f"target_tcp_{axis}_mm" for axis in "xyz")
JOINTS = tuple(f"target_q_{n}_rad" for n in range(1, 7))


@pytest.mark.parametrize(
    ("columns", "lacking"),
    [
        (("segment_time_s", *PLACE), ""),
        (("segment_time_s", *PLACE, *JOINTS), ""),
        (PLACE, "segment_time_s"),
        (("segment_time_s", *PLACE[1:]), "target_tcp_x_mm"),
        (("segment_time_s", *PLACE, *JOINTS[:-1]), "target_q_6_rad"),
    ],
)
def test_a_log_without_the_commanded_place_or_with_some_joints_only_is_refused(
    columns: tuple[str, ...], lacking: str
) -> None:
    group = SignalGroup("controller", 500.0, {name: np.linspace(0.0, 1.0, 50) for name in columns})
    meta = RunMeta("r1", "circular", plane="XY", direction="CCW", radius_mm=100.0, feed_mm_min=1000.0)
    geometry = {"centre_mm": [0.0, 0.0, 0.0]}
    if not lacking:
        assert len(_controller_ticks(group, meta, geometry)) == 50
        return
    with pytest.raises(InputError, match="lacks columns") as refused:
        _controller_ticks(group, meta, geometry)
    assert refused.value.got == lacking


def test_accelerometers_of_less_than_a_window_have_no_features(tmp_path: Path) -> None:
    short = SignalGroup("accelerometers", 1000.0, {"wrist_x_g": np.array([0.0, 1.0])})
    run = SimpleNamespace(accelerometers=short, meta=RunMeta("r1", "circular"))
    contract = _contract_of(SimpleNamespace(runs=[run]))  # type: ignore[arg-type]
    assert contract is not None
    with pytest.raises(InputError, match="less than a window"):
        _window_features(run, contract)  # type: ignore[arg-type]
    write_signals(tmp_path / "r1.accelerometers.parquet", short)
    rows = "\n".join(f"{n / 100},{n / 2},{n % 7}" for n in range(720))
    (tmp_path / "r1.csv").write_text(f"t_s,angle_deg,deviation_um\n{rows}\n", encoding="utf-8")
    (tmp_path / "campaign.toml").write_text(
        '[campaign]\nname = "c"\nmachine = "m"\n[[run]]\nid = "r1"\nfile = "r1.csv"\nplane = "XY"\nradius_mm = 100.0\n'
        'feed_mm_min = 5000.0\ndirection = "CCW"\nsignals = "r1.accelerometers.parquet"\n',
        encoding="utf-8",
    )
    ingest(tmp_path, Lake(home().lake))
    assert compute_features(home(), "c").windows == 0
