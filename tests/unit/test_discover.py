"""Discover ends where what it finds is no larger than laws may be off, and says what it did not add."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from dtwin.config import Home
from dtwin.physics.diagnosis import Diagnosis, Suspect
from dtwin.physics.library import Library
from dtwin.physics.observations import Observations
from dtwin.physics.twin import Twin
from dtwin.report.twin_of_kind import discovery_text
from dtwin.twins.measured import Loaded
from dtwin.twins.verbs import Twins

START_UM = 7.2


def _found(effect: str, axis: str, gain: float) -> tuple[Suspect, ...]:
    return (
        Suspect(
            effect=effect,
            axis=axis,
            rms_after_um=1.0,
            cv_gain=gain,
            p_value=1e-6,
            in_group=True,
            grade=None,
            confounded_with=(),
            laws=(),
            share=0.5,
            remedy="",
        ),
    )


class _Told(Twins):
    """Twins whose diagnoses are told."""

    def __init__(self, home: Home, *rounds: tuple[tuple[Suspect, ...], ...], crossed: bool = True) -> None:
        super().__init__(home, Library())
        self._rounds = list(rounds)
        self._crossed = crossed
        self.added: list[str] = []

    def diagnose(self, name: str, *, seed: int = 0) -> tuple[Twin, Diagnosis]:
        found = self._rounds.pop(0)
        said = Diagnosis(
            verdict="missing_effect" if found else "nothing_missing",
            headline="",
            residual_rms_um=START_UM,
            systematic_rms_um=START_UM if not self.added else 0.2,
            noise_floor_um=0.3,
            floor_kind="repeats",
            lack_of_fit_p=0.001,
            found=found,
        )
        return self._twin(), said

    def _load(self, campaigns: Sequence[str]) -> list[Loaded]:
        return [cast("Loaded", SimpleNamespace(obs=SimpleNamespace(crossed=self._crossed)))]

    def _added(self, twin: Twin, loaded: object, effect: str, axis: str, *_: object, **__: object) -> Twin:
        self.added.append(f"{effect} {axis}".rstrip())
        return self._twin()

    def _twin(self) -> Twin:
        return cast("Twin", SimpleNamespace(campaigns=("c",), labels=tuple(self.added)))


def test_what_a_later_round_finds_must_foretell_conditions_left_out(tmp_path: Path) -> None:
    twins = _Told(
        Home(tmp_path),
        (_found("squareness", "XY", 0.9), _found("backlash", "X", 0.1)),
        (_found("lateral_play", "Y", 0.4), _found("cyclic_error", "X", 0.25), _found("reversal_ringing", "X", 0.1)),
        (_found("lateral_play_taper", "X", 0.24), _found("reversal_ringing", "X", 0.1)),
    )
    made, groups, said = twins.discover("t")
    # The first round is told whole.
    assert twins.added == ["squareness XY", "backlash X", "lateral_play Y", "cyclic_error X"]
    assert len(made) == len(groups) == 4
    assert [group[0].label for group in said.found] == ["lateral_play_taper X", "reversal_ringing X"]


def test_what_follows_a_reversal_may_be_how_far_the_law_of_friction_is_off(tmp_path: Path) -> None:
    rounds = (
        (_found("friction", "X", 0.9), _found("backlash", "Y", 0.9)),
        (_found("reversal_ringing", "X", 0.4), _found("structural_resonance", "Y", 0.4)),
        (_found("reversal_ringing", "X", 0.4),),
    )
    twins = _Told(Home(tmp_path), *rounds, crossed=False)
    _, _, said = twins.discover("t")
    assert twins.added == ["friction X", "backlash Y", "structural_resonance Y"]
    assert [group[0].label for group in said.found] == ["reversal_ringing X"]
    told = _Told(Home(tmp_path), *rounds, ())
    told.discover("t")
    assert told.added[2:] == ["reversal_ringing X", "structural_resonance Y", "reversal_ringing X"]


@pytest.mark.parametrize(
    ("pairs", "crossed"),
    [
        ([(100, 1000), (100, 3000)], False),
        ([(50, 1000), (150, 1000)], False),
        ([(50, 1000), (150, 3000)], False),
        ([(50, 1000), (150, 1000), (150, 3000)], True),
    ],
)
def test_radius_and_feed_are_crossed_where_each_was_changed_apart_from_the_other(
    pairs: list[tuple[float, float]], crossed: bool
) -> None:
    conditions = [SimpleNamespace(radius_mm=radius, feed_mm_min=feed) for radius, feed in pairs]
    assert Observations.crossed.fget(SimpleNamespace(conditions=conditions)) is crossed


def test_every_group_what_is_left_and_what_was_not_added_is_told() -> None:
    said = Diagnosis(
        "missing_effect",
        "",
        0.3,
        0.02,
        0.3,
        "repeats",
        0.001,
        (*_found("friction", "X", 0.05),),
        (_found("friction", "X", 0.05),),
    )
    rungs = [
        {"version": n, "action": "add", "rms_before_um": 4.0, "rms_after_um": um, "noise_floor_um": 0.3}
        | {"systematic_rms_um": um, "verdict": None, "found": [["squareness XY"], ["lateral_play X", "backlash X"]]}
        for n, um in enumerate((4.0, 1.0, 0.02), start=1)
    ]
    groups = [["squareness XY"], ["servo_lag", "scale_mismatch XY"]]
    payload = {"twin": "t", "added": ["squareness XY", "servo_lag"], "groups": groups, "effects": []}
    payload |= {"history": rungs, "final": said.as_dict()}
    lines = [line.strip() for line in discovery_text(payload, 0.25).splitlines()]
    assert lines[2].endswith("squareness XY; lateral_play X or backlash X")
    at = lines.index("found")
    assert lines[at + 1 : at + 3] == ["squareness XY", "servo_lag or scale_mismatch XY"]
    assert lines[at + 3].endswith("µm are left (0 %)")
    assert lines[at + 4].startswith("not added: friction X: foretells less than 25 % of what")
    # One version may add what is in several groups.
    at_once = discovery_text(payload | {"added": ["both"], "history": rungs[1:]}, 0.25)
    assert "of 1.00 µm RMS that repeats agree on" in at_once
    assert "found" not in discovery_text(payload | {"groups": []}, 0.25).split("\n")
    effects = [
        {"effect": "squareness", "axis": "XY", "size": "12.1 ± 0.4 µm/m", "makes_um": 0.42},
        {"effect": "servo_lag", "axis": "", "size": "40 ± 2 ms²"},
    ]
    told = discovery_text(payload | {"effects": effects}, 0.25).splitlines()
    at = next(n for n, line in enumerate(told) if line.startswith("found"))
    rows = [re.split(r"  +", line.strip()) for line in told[at + 2 : at + 4]]
    assert rows[0] == ["squareness XY", "12.1 ± 0.4 µm/m", "0.42"]
    assert rows[1] == ["servo_lag or scale_mismatch XY", "40 ± 2 ms² if alone", "-"]
