"""The placement campaign: two motions, three feeds, with and without correction, ten repeats."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.acquire.campaign_folder import write_campaign_file
from dtwin.atomic import write_text
from dtwin.kinematics import UR10E
from dtwin.machines.cobot import ELBOW_UP_RAD, TOOL_DOWN, VirtualCobot
from dtwin.progress import Progress, silent
from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.serve.runtime import CompiledBundle
from dtwin.serve.targets import Target, TargetCorrection, TargetFrame
from studies.machines import probed_block as b_
from studies.machines.joint_program import MOTIONS
from studies.machines.placing_cell import DATUM_MM, PLACE_MM, PlacingCell, ProbedPlacement
from studies.placement_model import JOINT_MOTION, TrainingPlacement, placement_bundle
from studies.probed_placements import COUNTS, FLAGS, Placed, ProbeSettings, locate
from studies.sphere_evidence import WAYS, difference, half_width, share_of_oracle

FEEDS_MM_MIN = (1000.0, 3000.0, 6000.0)
TRAINED_MM_MIN = (2000.0, 4000.0)
_TRAINING_SESSION, _SESSION = 1, 2
SETTINGS = ProbeSettings(
    b_.HALF_X_MM,
    b_.HALF_Y_MM,
    b_.THICK_MM,
    b_.BALL_MM,
    b_.SEARCH_MM,
    b_.EXPANSION_1_K,
    b_.REFERENCE_C,
    b_.X_AT_Y_MM,
    b_.Y_AT_X_MM,
)


@dataclass(frozen=True)
class Row:
    """One placement of the campaign.

    ``motion``, ``feed_mm_min``, ``way``: condition, and ``uncompensated``, ``compensated`` or ``oracle``.
    ``started_s``: since the start of the session.
    ``probed``: what was written down.
    ``placed``: what follows from it.
    """

    motion: str
    feed_mm_min: float
    way: str
    started_s: float
    probed: ProbedPlacement
    placed: Placed

    @property
    def radial_um(self) -> float:
        """Distance from where it should be, in the plane."""
        return float(np.hypot(*self.placed.error_um[:2]))


def learn(cobot: VirtualCobot, tcp_mm: Floats, *, repeats: int) -> tuple[Bundle, int]:
    """Return the correction from a session of its own at other feeds, and what it left out.

    ``cobot``: the machine.
    ``tcp_mm``, (3,): tool centre point.
    ``repeats``: placements of each motion and feed.
    """
    cell = PlacingCell(cobot, _TRAINING_SESSION)
    found, left_out = [], 0
    for _ in range(repeats):
        for motion in MOTIONS:
            for feed in TRAINED_MM_MIN:
                placed = _located(cell.place(PLACE_MM, motion, feed))
                if placed.flag == COUNTS:
                    found.append(TrainingPlacement(motion, feed, placed.error_um))
                else:
                    left_out += 1
    box = (min(FEEDS_MM_MIN) - 1.0, max(FEEDS_MM_MIN) + 1.0)
    return placement_bundle(found, "virtual-cobot", feeds_mm_min=box), left_out


def measure(
    cobot: VirtualCobot, bundle: Bundle, tcp_mm: Floats, *, repeats: int, seed: int, progress: Progress = silent
) -> list[Row]:
    """Place every condition in every way, in an order that is drawn anew for every repeat.

    ``cobot``, ``bundle``, ``tcp_mm``: machine, correction, tool centre point.
    ``repeats``: placements of each condition and way.
    ``seed``: of the order and of what does not repeat.
    ``progress``: called with (done, total, what).
    """
    cell = PlacingCell(cobot, 100 * _SESSION + seed)
    jobs = [(m, f, way) for m in MOTIONS for f in FEEDS_MM_MIN for way in WAYS]
    targets = {job: _target(cell, bundle, tcp_mm, *job) for job in jobs}
    rng = np.random.default_rng([seed, 61])
    rows: list[Row] = []
    clock_s = 0.0
    for repeat in range(repeats):
        for i in rng.permutation(len(jobs)):
            motion, feed, way = jobs[i]
            probed = cell.place(targets[jobs[i]], motion, feed)
            rows.append(Row(motion, feed, way, clock_s, probed, _located(probed)))
            clock_s += probed.duration_s + 60.0
        progress(repeat + 1, repeats, f"block {repeat + 1}")
    return rows


def conditions(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return before and after of each condition, the placement as unit, flagged ones left out."""
    groups: dict[tuple[str, float, str], list[Row]] = defaultdict(list)
    for row in rows:
        groups[row.motion, row.feed_mm_min, row.way].append(row)
    out = []
    for motion, feed in sorted({(r.motion, r.feed_mm_min) for r in rows}, reverse=True):
        sizes, flagged = {}, {}
        for way in WAYS:
            mine = groups[motion, feed, way]
            sizes[way] = np.array([r.radial_um for r in mine if r.placed.flag == COUNTS])
            flagged[way] = len(mine) - len(sizes[way])
        before, after, oracle = (sizes[way] for way in WAYS)
        change, wide = difference(before, after)
        possible, unsure = difference(before, oracle)
        share = share_of_oracle(before.mean(), after.mean(), oracle.mean())
        out.append(
            {
                "motion": motion,
                "feed_mm_min": feed,
                "flagged": flagged,
                "counted": {way: len(sizes[way]) for way in WAYS},
                "before_um": float(before.mean()),
                "before_half_width_um": half_width(before),
                "after_um": float(after.mean()),
                "after_half_width_um": half_width(after),
                "oracle_um": float(oracle.mean()),
                "change_um": change,
                "change_half_width_um": wide,
                "reduction": 1.0 - float(after.mean() / before.mean()),
                "share_of_oracle": share if -possible > unsure else np.nan,
                "worse": change > wide,
            }
        )
    return out


def audit(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return what other bookkeeping would make of the same placements.

    ``rows``: the campaign.
    """
    plain = [r for r in rows if r.way != "oracle"]
    good = [r for r in plain if r.placed.flag == COUNTS]
    grand = np.mean([r.placed.error_um for r in good], axis=0)
    zeros = [np.zeros(3) if r.placed.flag != COUNTS else r.placed.error_um for r in plain]
    ways = {
        "as done here": ([r.placed.error_um for r in good], good),
        "flagged ones kept": ([r.placed.error_um for r in plain], plain),
        "flagged ones as zeros": (zeros, plain),
        "centred on the mean of both ways": ([r.placed.error_um - grand for r in good], good),
    }
    return [{"bookkeeping": name, **_summary(np.array(e), r)} for name, (e, r) in ways.items()]


def _summary(errors: Floats, rows: Sequence[Row]) -> dict[str, float]:
    way = np.array([r.way for r in rows])
    out = {}
    for short, name in (("before", "uncompensated"), ("after", "compensated")):
        mine = errors[way == name, :2]
        out[f"{short}_um"] = float(np.hypot(mine[:, 0], mine[:, 1]).mean())
        out[f"{short}_sd_um"] = float(np.sqrt(np.mean(np.var(mine, axis=0, ddof=1))))
    out["reduction"] = 1.0 - out["after_um"] / out["before_um"]
    return out


def flags(rows: Sequence[Row]) -> dict[str, int]:
    """Return how many placements each rule left out."""
    return {flag: sum(r.placed.flag == flag for r in rows) for flag in FLAGS}


def write_campaign(folder: Path, rows: Sequence[Row], name: str) -> None:
    """Write the campaign as a folder of kind ``placement``, one run for each condition and way.

    ``folder``: folder; the campaign file comes last.
    ``rows``: all placements, flagged ones too.
    ``name``: name of the campaign.
    """
    groups: dict[tuple[str, float, str], list[Row]] = defaultdict(list)
    for row in rows:
        groups[row.motion, row.feed_mm_min, row.way].append(row)
    runs = []
    for (motion, feed, way), mine in sorted(groups.items()):
        run = f"{motion}-{feed:g}-{way}".lower()
        write_text(folder / f"{run}.csv", _csv(mine), "a run")
        runs.append(
            {
                "id": run,
                "file": f"{run}.csv",
                "feed_mm_min": feed,
                "repeat": 1,
                "setup": "s1",
                "condition": {"motion": motion, "way": way},
            }
        )
    head = {"name": name, "machine": "virtual-cobot", "kind": "placement"}
    write_campaign_file(folder, head, runs)


def _csv(rows: Sequence[Row]) -> str:
    head = [
        "t_s",
        "error_x_um",
        "error_y_um",
        "error_z_um",
        "turned_deg",
        "faces_disagree_deg",
        *(f"probe_{hit}_mm" for hit in b_.HITS),
        "block_temperature_c",
        "jig_moved_um",
        "flag_1",
    ]
    lines = [",".join(head)]
    for r in sorted(rows, key=lambda row: row.started_s):
        values = [
            r.started_s,
            *r.placed.error_um,
            r.placed.turned_deg,
            r.placed.faces_disagree_deg,
            *r.probed.readings_mm,
            r.probed.temperature_c,
            r.probed.jig_moved_um,
            FLAGS.index(r.placed.flag),
        ]
        lines.append(",".join(f"{v:.6g}" if i else f"{v:z.3f}" for i, v in enumerate(values)))
    return "\n".join([*lines, ""])


def _located(probed: ProbedPlacement) -> Placed:
    return locate(probed.readings_mm, probed.temperature_c, probed.jig_moved_um, SETTINGS)


def _target(cell: PlacingCell, bundle: Bundle, tcp_mm: Floats, motion: str, feed: float, way: str) -> Floats:
    """Return what is sent: each target is decided before its move starts."""
    if way == "uncompensated":
        return PLACE_MM
    if way == "oracle":
        error_um = 1e3 * cell.repeatable_mm(PLACE_MM, motion, feed)
        share = min(1.0, bundle.safety.clamp_um / float(np.linalg.norm(error_um)))
        return PLACE_MM - 1e-3 * share * error_um
    joints = UR10E.inverse(PLACE_MM, TOOL_DOWN, tcp_mm, ELBOW_UP_RAD)
    covariates: Mapping[str, float] = {JOINT_MOTION: float(motion == "MoveJ")}
    correction = TargetCorrection(CompiledBundle(bundle), tcp_mm, TargetFrame("XY", DATUM_MM, joints), covariates)
    return correction.correct(Target("Place", PLACE_MM, feed)).position_mm
