"""A log of drift as a correction: served tick by tick to a machine that warms, whatever the rate of its states."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from axis_control import AxisControl
from command_here import said
from typer.testing import CliRunner

from dtwin.cli import app
from dtwin.config import home as home_of
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named
from dtwin.lake.store import Lake
from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.serve.runtime import CompiledBundle
from dtwin.serve.serve_request import ServeRequest
from dtwin.serve.session import serve
from dtwin.train.registry import Registry

pytestmark = pytest.mark.system

TAU_S, UM_PER_K = 400.0, -20.0
PERIOD_S = 0.05
Log = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def machine(seed: int, hours: float = 6.0) -> Log:
    """Return time, skin, bed and displacement: the column follows its skin late, stepped in seconds, the bed at once."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, 3600.0 * hours)
    skin = 22.0 + 8.0 * (1.0 - np.exp(-t_s / 5000.0)) + 2.0 * np.sin(t_s / (900.0 + 100.0 * seed) + seed)
    bed = 25.0 + 30.0 * np.clip((t_s - 3000.0) / 2000.0, 0.0, 1.0) + 3.0 * np.sin(t_s / 700.0)
    core = np.empty_like(skin)
    core[0] = skin[0]
    for n in range(1, t_s.size):
        core[n] = core[n - 1] + (skin[n - 1] - core[n - 1]) / TAU_S
    moved = UM_PER_K * (core - 22.0) + 2.0 * (bed - 25.0)
    return t_s, skin + 0.01 * rng.standard_normal(t_s.size), bed, moved


def write(folder: Path, logs: dict[str, Log], condition: str = 'condition = { axis = "Z" }') -> Path:
    folder.mkdir(parents=True)
    text = '[campaign]\nname = "warm"\nmachine = "mill-d"\nkind = "drift"\n'
    for name, (t_s, skin, bed, moved) in logs.items():
        rows = ["t_s,sample,displacement_um,temperature_skin_c,temperature_bed_c"]
        rng = np.random.default_rng(9)
        for n in range(0, t_s.size, 60):
            for again in range(2):
                value = moved[n] + 0.5 * rng.standard_normal()
                rows.append(f"{t_s[n] + again},{n // 60},{value:.4f},{skin[n]:.3f},{bed[n]:.3f}")
        (folder / f"{name}.csv").write_text("\n".join(rows), encoding="utf-8")
        text += f'[[run]]\nid = "{name}"\nfile = "{name}.csv"\n{condition}\n'
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    return folder


class Column:
    """A control whose column was as warm as its skin, until the skin became warmer at once."""

    name, period_s, axes = "mill-d", PERIOD_S, ("z",)
    provides, channels_hz = ("temperature_skin_c", "temperature_bed_c"), 0.0
    ticks, warmer_at, warmer_c = 6000, 1000, 3.0

    def __init__(self) -> None:
        self.offset_um = np.zeros((self.ticks, 3))

    def state(self, tick: int) -> Mapping[str, float]:
        skin = 22.0 + self.warmer_c * (tick >= self.warmer_at)
        return {"temperature_skin_c": skin, "temperature_bed_c": 25.0} if tick % 20 == 0 else {}

    def advance(self, tick: int, offset_um: Floats) -> None:
        self.offset_um[tick] = offset_um

    def moved_um(self) -> Floats:
        since_s = np.maximum(0.0, (np.arange(self.ticks) - self.warmer_at) * PERIOD_S)
        return np.asarray(UM_PER_K * self.warmer_c * (1.0 - np.exp(-since_s / TAU_S)))


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    return tmp_path


def left_um(bundle: Bundle, log: Log, every: int, zero_um: float) -> tuple[float, float]:
    """Return RMS without and with the correction, of a machine whose states come every so many seconds."""
    t_s, skin, bed, moved = (values[::every] for values in log)
    moved = moved - zero_um
    compiled = CompiledBundle(bundle)
    read = {"timestamp_s": 1.79e9 + t_s, "temperature_skin_c": skin, "temperature_bed_c": bed}
    told = [float(compiled.tick(np.array([read[n][k] for n in bundle.tick_inputs]))[0]) for k in range(t_s.size)]
    return float(np.sqrt((moved**2).mean())), float(np.sqrt(((moved - np.array(told)) ** 2).mean()))


def test_a_log_is_trained_tried_and_takes_the_drift_of_another_day(home: Path) -> None:
    monday = machine(1)
    folder = write(home / "warm", {"monday": monday, "tuesday": machine(2, 4.0)})
    said("ingest", str(folder))
    made = said("train", "warm")
    assert made["proposed"] == "temperatures late"
    told = " ".join(made["told"])
    assert "fitted to monday" in told
    assert "of log tuesday-log, which was not fitted" in told
    registry = Registry(home_of())
    version = registry.version("mill-d", "candidate")
    bundle = Bundle.from_dict(registry.bundle(version))
    assert (bundle.corrects, [o.frame for o in bundle.outputs]) == ("drift", ["base_z"])
    assert bundle.band is not None
    # A day that was not measured, and states at rates that training never saw.
    for every in (1, 7, 30):
        before, after = left_um(bundle, machine(5, 3.0), every, monday[3][0])
        assert before > 30.0
        assert after < 0.06 * before
    tried = said("promote", version.version, "--machine", "mill-d", "--trial")
    assert tried["state"] == "trial"
    column = Column()
    with AxisControl(column, home_of()) as control:
        request = ServeRequest(axes=control.address, priority=0, model="trial", fade=False)
        done = serve(request, home_of(), lambda line: None)
    assert done.status.ended == "finished"
    wanted = -(column.moved_um() - monday[3][0])
    assert np.ptp(wanted) > 20.0
    np.testing.assert_allclose(column.offset_um[200:, 2], wanted[200:], atol=4.0)
    assert not column.offset_um[:, :2].any()
    refused = CliRunner().invoke(app, ["promote", tried["version"], "--machine", "mill-d"])
    assert (refused.exit_code, refused.exception.code) == (1, "evidence.real")


def test_a_twin_of_a_log_is_a_correction_once_nothing_is_missing_and_nothing_idle(home: Path) -> None:
    said("ingest", str(write(home / "warm", {"monday": machine(1), "tuesday": machine(2, 4.0)})))
    said("twin", "fit", "warm", "--effects", "follows@skin,follows@bed", "--name", "column")
    refused = CliRunner().invoke(app, ["twin", "correct", "column"])
    assert (refused.exit_code, refused.exception.code) == (1, "correct.not_confirmed")
    assert "lag@skin" in refused.exception.got
    said("twin", "add", "column", "lag@skin")
    made = said("twin", "correct", "column")
    assert (made["objections"], made["verdict"], made["trial_only"]) == ([], "nothing_missing", False)
    assert {g["label"]: g["confirmed"] for g in made["grades"]} == {"lag@skin": True, "follows@bed": True}
    told = {one["condition"]: one["rms_predicted_um"] / one["rms_before_um"] for one in made["predicted"]}
    assert set(told) == {"log monday-log", "log tuesday-log"}
    assert max(told.values()) < 0.06
    registry = Registry(home_of())
    bundle = Bundle.from_dict(registry.bundle(registry.version("mill-d", made["version"])))
    before, after = left_um(bundle, machine(5, 3.0), 7, machine(1)[3][0])
    assert after < 0.06 * before


def test_logs_that_name_no_axis_cannot_correct_one(home: Path) -> None:
    folder = write(home / "warm", {"monday": machine(1, 3.0)}, condition="")
    said("ingest", str(folder))
    lake = Lake(home_of().lake)
    kind = kind_named("drift")
    assert "which axis moved" in kind.training_obstacle(lake.runs("warm"))
    with pytest.raises(InputError, match="which axis moved"):
        kind.training()(lake, "warm")
    said("twin", "fit", "warm", "--effects", "follows", "--name", "column")
    refused = CliRunner().invoke(app, ["twin", "correct", "column", "--trial"])
    assert refused.exception.code == "correct.axis"


def test_warm_ups_by_turns_make_a_correction_champion(home: Path) -> None:
    said("simulate", "--machine", "column", "--quick", "--out", str(home / "column"))
    said("ingest", str(home / "column"))
    assert said("train", "warm-column-surface")["proposed"] == "temperatures late"
    made = said("promote", "candidate", "--machine", "virtual-warm-column", "--comment", "first")
    assert made["champion"]
    (condition,) = made["evidence"]["conditions"]
    assert (condition["n_without"], condition["n_with"]) == (3, 3)
    assert condition["better"]
    assert condition["after_um"] < 0.25 * condition["before_um"]
    assert condition["after_um"] > 0.9 * condition["oracle_um"]
