"""What to measure next: circles that an arm does not reach are not proposed, nor whole ones where arcs were measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from one_cobot import write_circles

from dtwin.acquire.campaign_folder import open_campaign
from dtwin.physics.diagnosis import Diagnosis, Suspect
from dtwin.physics.experiment import REPEATS, _grown, next_experiment, planned_observations
from dtwin.physics.gridding import Condition
from dtwin.physics.library import Library
from dtwin.physics.observations import observe
from dtwin.plan import training_plan
from dtwin.schema import Campaign, Run, RunMeta


def test_circles_that_the_arm_does_not_reach_are_not_proposed(tmp_path: Path) -> None:
    """Twice the radius at 700 mm is beyond a UR10e; the diagnosis ended in an error."""
    far = write_circles(
        tmp_path / "far", np.array([0.0, 0.3, -0.2, 0.0, 0.0, 0.0]), day="2026-05-01", centre_mm=(700.0, -250.0, 300.0)
    )
    opened = open_campaign(far)
    obs = observe(opened.campaign, [run for runs, _ in opened for run in runs])
    group = tuple(Suspect("joint_offset", joint, 1.0, 0.9, 1e-6, True, None, (), (), 0.5, "") for joint in ("2", "3"))
    said = Diagnosis("ambiguous", "", 5.0, 5.0, 1.0, "repeats", 0.001, group, (group,))
    told = next_experiment(obs, [], said, Library())
    assert told is not None
    assert all(condition["radius_mm"] < 300.0 for condition in told["conditions"])


def test_where_arcs_were_measured_the_next_circles_of_that_plane_are_arcs() -> None:
    """They were taken for whole circles, which a bar under a spindle does not reach, and so were the arcs measured."""
    angle = np.arange(-20.0, 200.0, 0.5) + 0.25
    meta = RunMeta("a", plane="YZ", direction="CCW", radius_mm=100.0, feed_mm_min=1000.0)
    obs = observe(Campaign("arcs", "mill"), [Run(meta, {"angle_deg": angle, "deviation_um": np.cos(angle)})])
    grown = _grown(obs, [Condition("YZ", 100.0, 4000.0, "CCW"), Condition("XY", 100.0, 4000.0, "CCW")])
    counts = [int(mask.sum()) for mask in grown.mask]
    assert counts == [220, *[220] * REPEATS, *[360] * REPEATS]


def test_planned_upright_circles_are_the_arcs_of_their_programs() -> None:
    """A laser was proposed late, and upright planes early: their circles were taken for whole ones."""
    obs = planned_observations(training_plan(radii_mm=[100.0], planes=["XY", "ZX"], repeats=1))
    assert {obs.conditions[i].plane: int(mask.sum()) for i, mask in zip(obs.condition_of, obs.mask, strict=True)} == {
        "XY": 360,
        "ZX": 190,
    }
    grown = _grown(obs, [Condition("YZ", 100.0, 4000.0, "CCW")])
    assert np.flatnonzero(~grown.mask[-1]).tolist() == list(range(185, 355))
