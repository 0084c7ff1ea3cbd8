"""``dtwin demo placement``: three circles and placements on the virtual cobot, and its data."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_here import said

from dtwin.acquire.ingest import ingest
from dtwin.lake.store import Lake
from dtwin.machines.cobot import VirtualCobot
from dtwin.serve.interface import Output
from studies import placement_campaign as placing

pytestmark = pytest.mark.system
TCP_MM = np.array([0.0, 0.0, 158.3])


@pytest.mark.long
def test_the_demo_reaches_the_oracle_and_its_campaign_is_ingested(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path))
    found = said("demo", "placement", "--quick")
    # A table by place and time comes less near to the best correction at the highest feed, and it says so.
    (feed,) = found["sphere"]["feeds"]
    assert 0.6 < feed["share_of_oracle"] < found["wanted_share"]
    (short,) = found["shortfalls"]
    assert short.startswith("three circles at 6000 mm/min: ")
    assert len(found["placements"]["conditions"]) == 6
    for condition in found["placements"]["conditions"]:
        assert condition["change_um"] + condition["change_half_width_um"] < 0.0
    audit = {row["bookkeeping"]: row["reduction"] for row in found["placements"]["audit"]}
    assert audit["as done here"] > 0.8
    assert abs(audit["centred on the mean of both ways"]) < 0.2
    report = ingest(Path(found["placements"]["folder"]), Lake(tmp_path / "lake"))
    assert len(report.added) == 18
    assert {f.code for _, f in report.findings} <= {"placement.flagged"}


def test_a_correction_of_the_wrong_sign_is_worse_in_every_condition() -> None:
    cobot = VirtualCobot(seed=0)
    bundle, _ = placing.learn(cobot, TCP_MM, repeats=4)
    wrong = replace(bundle, outputs=tuple(Output(o.name, o.frame, "correction") for o in bundle.outputs))
    rows = placing.measure(cobot, wrong, TCP_MM, repeats=4, seed=1)
    found = placing.conditions(rows)
    assert all(condition["worse"] for condition in found)
    assert max(condition["share_of_oracle"] for condition in found) < 0.0
    assert sum(placing.flags(rows).values()) == len(rows)
