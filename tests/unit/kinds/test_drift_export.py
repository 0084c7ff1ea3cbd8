"""Drift for Klipper: a frame made here, whose column lies behind its sensor, is read back as the firmware would."""

from __future__ import annotations

import configparser
import re
from pathlib import Path

import numpy as np
import pytest

from dtwin.acquire.amending import amend
from dtwin.acquire.ingest import ingest
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.drift._twins import DriftTwins
from dtwin.lake.store import Lake
from dtwin.lifecycle.export import export_twin

GROWTH_UM_PER_K, LATE_S = 530.0 * 23.4e-3, 900.0


def frame(hours: float = 5.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times, temperature of the skin and rise of the tool in um, each second; the core follows its skin."""
    seconds = np.arange(hours * 3600.0)
    heated = ((seconds > 600) & (seconds < 7000)) | (seconds > 12000)
    skin, core = np.full(len(seconds), 22.0), np.full(len(seconds), 22.0)
    for i in range(1, len(seconds)):
        skin[i] = skin[i - 1] + ((45.0 if heated[i] else 22.0) - skin[i - 1]) / 1800.0
        core[i] = core[i - 1] + (skin[i - 1] - core[i - 1]) / LATE_S
    return seconds, skin, GROWTH_UM_PER_K * (core - 22.0)


class Klipper:
    """The firmware's arithmetic: temperatures come in from 0 degC on, and Z goes where it would go."""

    def __init__(self, text: str) -> None:
        parser = configparser.ConfigParser(inline_comment_prefixes=("#", ";"), strict=False)
        parser.read_string(text)
        section = parser["z_thermal_adjust"]
        self.coefficient = section.getfloat("temp_coeff")
        self.smooth_time = section.getfloat("smooth_time", fallback=2.0)
        self.most_mm = section.getfloat("max_z_adjustment", fallback=99999999.0)
        self.smoothed = self.last_time = 0.0
        self.homed_at = 0.0

    def home(self) -> None:
        self.homed_at = self.smoothed

    def at(self, time_s: float, temperature: float) -> float:
        share = min((time_s - self.last_time) / self.smooth_time, 1.0)
        self.smoothed += (temperature - self.smoothed) * share
        self.last_time = time_s
        adjust = -(self.smoothed - self.homed_at) * self.coefficient
        return float(np.copysign(min(abs(adjust), self.most_mm), adjust))


def twin_of(tmp_path: Path, effects: list[str], condition: str, sense: float = 1.0) -> Home:
    """Fit a twin ``column`` to a log of readings each minute, three at once."""
    seconds, skin, rise = frame()
    rng = np.random.default_rng(4)
    lines = ["sample,t_s,displacement_um,temperature_frame_c,temperature_bed_c"]
    for at in range(0, len(seconds), 60):
        for again in range(3):
            read = sense * rise[at] + rng.normal(0.0, 0.5)
            lines.append(f"{at // 60},{seconds[at] + 4 * again},{read:.4f},{skin[at]:.4f},{22 + at % 7}")
    folder = tmp_path / "log"
    folder.mkdir()
    (folder / "night.csv").write_text("\n".join(lines), encoding="utf-8")
    head = '[campaign]\nname = "night"\nmachine = "printer"\nkind = "drift"\n[[run]]\nid = "a"\nfile = "night.csv"\n'
    (folder / "campaign.toml").write_text(head + condition, encoding="utf-8")
    home = Home(tmp_path / "home")
    ingest(folder, Lake(home.lake))
    DriftTwins(home).fit("night", effects, name="column")
    return home


@pytest.mark.parametrize(
    ("condition", "sense"),
    [('condition = { axis = "Z" }', 1.0), ('condition = { axis = "Z", reads = "position" }', -1.0)],
)
def test_the_tool_stays_where_it_was_whether_the_log_is_of_the_tool_or_of_triggers(
    tmp_path: Path, condition: str, sense: float
) -> None:
    made = export_twin(twin_of(tmp_path, ["lag@frame"], condition, sense), "column", "klipper")
    assert made is not None
    firmware = Klipper(made.text)
    assert firmware.smooth_time == pytest.approx(LATE_S, rel=0.1)
    seconds, skin, rise = frame()
    (wait,) = re.findall(r"no sooner than (\d+) min", made.text)
    for second in range(60 * int(wait)):
        firmware.at(1.0 + second, skin[0])
    firmware.home()
    left = np.array([rise[i] + 1e3 * firmware.at(60.0 * int(wait) + 1.0 + i, skin[i]) for i in range(len(seconds))])
    assert np.abs(rise).max() > 200.0
    assert np.abs(left).max() < 3.0


def test_what_a_log_reads_is_stated_anew_and_the_sign_follows(tmp_path: Path) -> None:
    home = twin_of(tmp_path, ["lag@frame"], 'condition = { axis = "Z" }', -1.0)
    with pytest.raises(InputError, match="what the log reads"):
        amend(Lake(home.lake), "night", ["condition.reads=trigger"], "a mistake")
    amend(Lake(home.lake), "night", ["condition.reads=position"], "it was of triggers")
    DriftTwins(home).fit("night", ["lag@frame"], name="column")
    made = export_twin(home, "column", "klipper")
    assert made is not None
    assert Klipper(made.text).coefficient == pytest.approx(GROWTH_UM_PER_K / 1e3, rel=0.02)


def test_of_several_sensors_that_which_moves_most_is_kept_and_the_others_are_named(tmp_path: Path) -> None:
    made = export_twin(
        twin_of(tmp_path, ["follows@bed", "lag@frame"], 'condition = { axis = "Z" }'), "column", "klipper"
    )
    assert made is not None
    assert list(made.left_out) == ["follows@bed"]
    assert "follows@bed" in made.text
    assert Klipper(made.text).coefficient == pytest.approx(GROWTH_UM_PER_K / 1e3, rel=0.02)


@pytest.mark.parametrize(
    ("effects", "condition", "said"),
    [
        ([], 'condition = { axis = "Z" }', "one sensor"),
        (["second_lag@frame"], 'condition = { axis = "Z" }', "one lag"),
        (["lag@frame"], 'condition = { axis = "X" }', "Z alone"),
        (["lag@frame"], "", "Z alone"),
    ],
)
def test_what_klipper_does_not_do_is_refused(tmp_path: Path, effects: list[str], condition: str, said: str) -> None:
    home = twin_of(tmp_path, effects, condition)
    with pytest.raises(InputError, match=said):
        export_twin(home, "column", "klipper")


def test_a_form_of_another_kind_and_a_reading_that_is_not_known_are_refused(tmp_path: Path) -> None:
    home = twin_of(tmp_path, ["lag@frame"], 'condition = { axis = "Z" }')
    with pytest.raises(InputError, match="not written in this form"):
        export_twin(home, "column", "urdf")
    other = tmp_path / "other"
    other.mkdir()
    with pytest.raises(InputError, match="what the log reads"):
        twin_of(other, ["lag@frame"], 'condition = { axis = "Z", reads = "trigger" }')
