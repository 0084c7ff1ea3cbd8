"""One training on tones: from a campaign in the lake to candidates, compared."""

from __future__ import annotations

from typing import Any

import numpy as np

from dtwin.kinds.sinusoidal._candidates import compared_candidates, law_candidates, proposed
from dtwin.kinds.sinusoidal._gates import MOST_RADIUS
from dtwin.kinds.sinusoidal._groups import (
    ToneGroups,
    exponent,
    feature_findings,
    heard_groups,
    load_tone_groups,
    noise_floor_um,
)
from dtwin.lake.store import Lake
from dtwin.progress import StageProgress
from dtwin.statistics import rms
from dtwin.train.results import Training, TrainingReport
from dtwin.train.symbolic import Engine


def train_tones(
    lake: Lake, name: str, *, seed: int = 1, engine: Engine | None = None, progress: StageProgress | None = None
) -> Training:
    """Train every candidate on a campaign of tones.

    Groups with a data-quality error, and groups that the accelerometer does not hear, are left out.

    ``engine``: free symbolic search; Operon by default.
    """
    tell = progress or (lambda *_: None)
    campaign, versions = lake.campaign(name), dict(lake.versions())
    everything = load_tone_groups(lake, lake.runs(name))
    groups = heard_groups(everything)
    tell("features of the first 5 s", 1, 1, f"{groups.n} of {everything.n} groups")
    laws = law_candidates(groups, campaign.machine, engine, seed, versions)
    tell("equations", 1, 1, "")
    others = compared_candidates(groups, seed)
    tell("comparison models", 1, 1, "")
    found = sorted([*laws, *others], key=lambda c: c.held_out.rms_um)
    (floor, freedom), told = noise_floor_um(groups), what_was_seen(everything)
    if not np.isnan(floor):
        told.append(
            "the accelerometer hears part of what makes repeats differ: an equation may leave less than "
            "they disagree by"
        )
    report = TrainingReport(
        machine=campaign.machine,
        campaign=name,
        table_versions=versions,
        noise_floor_um=floor,
        noise_floor_dof=freedom,
        rms_before_um=rms(groups.amplitude_error_um),
        n_runs=groups.n,
        n_rows=groups.n,
        candidates=tuple(found),
        proposed=proposed(found, MOST_RADIUS),
        seed=seed,
        told=tuple(told),
    )
    conditions = [(f"{f:g} Hz", float(f), float(a)) for f, a in _grid(groups)]
    return Training(report, campaign.machine_geometry, tuple(conditions))


def what_was_seen(everything: ToneGroups) -> list[str]:
    """Say what the groups show before any equation: what is heard, constants, exponents."""
    groups = heard_groups(everything)
    acceleration = groups.feature("rms")
    deaf = everything.n - groups.n
    return [
        f"{deaf} of {everything.n} groups are below the accelerometer's noise and left out; the "
        "validity box refuses to correct there",
        *feature_findings(groups),
        f"amplitude error grows with acceleration to the power "
        f"{exponent(acceleration, groups.amplitude_error_um):z.3f}, the error beyond the encoder to "
        f"the power {exponent(acceleration, groups.beyond_encoder_um):z.3f}; 1 is inertia on a spring",
        "an LSTM was not tried: the package has no deep-learning library",
    ]


def _grid(groups: ToneGroups) -> list[tuple[Any, Any]]:
    return sorted(set(zip(groups.frequency_hz.tolist(), groups.amplitude_um.tolist(), strict=True)))
