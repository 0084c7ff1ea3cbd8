"""Whatever a campaign file states of a table, it is read or refused with its place: no value ends in anything else."""

from __future__ import annotations

from contextlib import suppress
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dtwin.acquire.ingest import open_source
from dtwin.errors import DtwinError
from dtwin.kinds.registry import kind_named

N = np.arange(400)
WAVE = 3.0 * np.cos(np.radians(7.2 * N))
USUAL = {"circular": 'plane = "XY"\nradius_mm = 150\nfeed_mm_min = 1000', "linear": 'condition = { axis = "X" }'}
HEADS = {
    "circular": ("angle [deg],ccw [µm],cw [µm]", (0.9 * N, WAVE, -WAVE)),
    "linear": ("target,forward 1 [µm],reverse 1 [µm]", (N, WAVE, -WAVE)),
    "drift": ("time [min],z_um,spindle [°C]", (N, WAVE, 20.0 + 0.01 * N)),
    "poses": (
        "joint_1_deg,joint_2_deg,joint_3_deg,joint_4_deg,joint_5_deg,joint_6_deg,measured_x_mm,measured_y_mm,measured_z_mm",
        9 * (WAVE,),
    ),
    "rotation": ("t_s,angle_deg,radial_um", (0.001 * N, (7.2 * N) % 360.0, WAVE)),
}
VALUES = ('"abc"', "-1", "nan", "[1, 2]", "{ x = 1 }", "true", '""', '"../../a"', '"\\u0000"', "2026-01-01", "1e308")
OF_RUN = (
    "plane",
    "radius_mm",
    "feed_mm_min",
    "direction",
    "repeat",
    "setup",
    "started",
    "condition",
    "covariates",
    "signals",
    "id",
    "file",
)
OF_CONDITION = ("speed_rpm", "axis", "step_mm", "features", "angle_log", "joints_log")
OF_INSTRUMENT = ("columns", "step_mm", "sample_rate_hz", "uncertainty_um")


@pytest.mark.parametrize("kind", HEADS)
def test_what_is_stated_is_read_or_refused(tmp_path: Path, kind: str) -> None:
    heads, columns = HEADS[kind]
    rows = [",".join(f"{v:.4f}" for v in row) for row in zip(*columns, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join([heads, *rows]), encoding="utf-8")
    usual = ['id = "r"', 'file = "a.csv"', *USUAL.get(kind, "").splitlines()]
    told = [("", f"{key} = {value}") for key, value in product(OF_RUN, VALUES)]
    told += [("", f"condition = {{ {key} = {value} }}") for key, value in product(OF_CONDITION, VALUES)]
    told += [(f"{key} = {value}", "") for key, value in product(OF_INSTRUMENT, VALUES)]
    told += [(f'columns = {{ "{heads.split(",")[0]}" = {value} }}', "") for value in VALUES]
    outcomes = set()
    for of_instrument, of_run in told:
        kept = [line for line in usual if line.split(" = ")[0] != of_run.split(" = ")[0]]
        text = [f'[campaign]\nname = "c"\nmachine = "m"\nkind = "{kind}"\n[campaign.instrument]', of_instrument]
        text += ['[campaign.machine_geometry]\nchain = "ur5"'] if kind == "poses" else []
        (tmp_path / "campaign.toml").write_text("\n".join([*text, "[[run]]", *kept, of_run]), encoding="utf-8")
        try:
            outcomes.add(bool([run for runs, _ in open_source(tmp_path)[1] for run in runs]))
        except DtwinError as error:
            outcomes.add(error.code)
    assert True in outcomes
    assert "campaign.value" in outcomes


@pytest.mark.parametrize("kind", HEADS)
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    content=st.one_of(st.binary(max_size=400), st.text('0123456789.,;-+eE \n\t"nai#µ', max_size=400).map(str.encode))
)
def test_no_table_ends_in_anything_but_a_refusal(tmp_path: Path, kind: str, content: bytes) -> None:
    text = [f'[campaign]\nname = "c"\nmachine = "m"\nkind = "{kind}"']
    text += ['[campaign.machine_geometry]\nchain = "ur5"'] if kind == "poses" else []
    text += [f'[[run]]\nid = "r"\nfile = "a.csv"\n{USUAL.get(kind, "")}']
    (tmp_path / "campaign.toml").write_text("\n".join(text), encoding="utf-8")
    heads, columns = HEADS[kind]
    rows = [",".join(f"{v:.4f}" for v in row) for row in list(zip(*columns, strict=True))[:40]]
    (tmp_path / "a.csv").write_bytes("\n".join([heads, *rows, ""]).encode() + content)
    with suppress(DtwinError):
        for runs, _ in open_source(tmp_path)[1]:
            for run in runs:
                kind_named(kind).judge_run(run)
