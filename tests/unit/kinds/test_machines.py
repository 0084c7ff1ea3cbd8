"""Virtual machines: one record each; options and evidence that a machine lacks are refused."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from dtwin.acquire import virtual_mill
from dtwin.cli import app
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.linear import _simulate as virtual_lathe
from dtwin.kinds.machine import PLAN, VirtualMachine
from dtwin.kinds.registry import kind_names, machine_named, machine_of_type, machines
from dtwin.kinds.sinusoidal import _simulate as virtual_turning
from dtwin.kinds.volumetric import _simulate as virtual_volumetric
from dtwin.lifecycle import evidence
from dtwin.machines.thermal_network import SCHEDULES
from dtwin.serve._machine_file import machine_folder
from dtwin.train import promotion

ROOT = Path(__file__).parents[3]
EVERY = list(machines())
OPTIONS = sorted({option for machine in EVERY for option in machine.options})
LINEAR = (
    '[plan]\nkind = "linear"\nname = "p"\nmachine = "m"\naxis = "Z"\nunit = "in"\nstart = 1\nend = 3\n'
    "step = 0.5\nruns = 1\ndwell_s = 6\nfeed_min = 20\novershoot = 0.1\naxis_low = 0\naxis_high = 41\n"
)
CIRCLES = (
    '[plan]\nkind = "circular"\nname = "p"\nmachine = "m"\n[grid]\nplane = "XY"\nradius_mm = 100\nfeed_mm_min = 500\n'
)


def simulate(*words: object) -> None:
    CliRunner().invoke(app, ["simulate", *map(str, words)], catch_exceptions=False)


def test_every_machine_has_a_name_a_type_and_a_kind_of_its_own() -> None:
    assert len({machine.name for machine in EVERY}) == len(EVERY)
    assert len({machine.type for machine in EVERY}) == len(EVERY)
    for machine in EVERY:
        assert machine.kind in kind_names()
        assert machine_named(machine.name) is machine
        assert machine_of_type(machine.type) is machine


@pytest.mark.parametrize(
    ("name", "option", "values"),
    [
        ("mill", "hidden", virtual_mill._HIDDEN),
        ("lathe", "truth", virtual_lathe.TRUTHS),
        ("turning", "truth", virtual_turning.TRUTHS),
        ("volumetric", "truth", tuple(virtual_volumetric.TRUTHS)),
        ("volumetric", "schedule", tuple(SCHEDULES)),
    ],
)
def test_the_records_name_what_the_machines_take(name: str, option: str, values: tuple[str, ...]) -> None:
    assert machine_named(name).options[option] == values


def test_the_table_of_the_docs_is_that_of_the_records() -> None:
    assert _machine_table() in (ROOT / "docs/reference/kinds.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("machine", EVERY, ids=lambda machine: machine.name)
@pytest.mark.parametrize("option", OPTIONS)
def test_an_option_that_a_machine_lacks_is_refused(machine: VirtualMachine, option: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    value = "nothing.toml" if option == PLAN else "strange"
    with pytest.raises(InputError) as refused:
        simulate("--machine", machine.name, "--out", out, f"--{option}", value)
    if option not in machine.options:
        assert refused.value.code == "simulate.option"
        assert machine.name in refused.value.message
        assert refused.value.got == f"--{option} {value}"
    elif option == PLAN:
        assert refused.value.code == "plan.file"
    else:
        assert refused.value.code == f"simulate.{option}"
        assert refused.value.allowed == ", ".join(machine.options[option])
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["--machine", "spindle"], "simulate.machine"),
        (["--machine", "lathe", "--plan", "circles.toml"], "simulate.plan"),
        (["--machine", "cobot", "--plan", "linear.toml"], "simulate.plan"),
        (["--machine", "lathe", "--plan", "linear.toml", "--quick"], "simulate.quick"),
        (["--machine", "lathe", "--quick", "--listen", "0"], "simulate.quick"),
        (["--machine", "hexapod", "--listen", "0"], "simulate.listen"),
        (["--machine", "volumetric", "--schedule", "winter", "--listen", "0"], "simulate.schedule"),
    ],
)
def test_what_would_be_ignored_or_cannot_be_is_refused(
    words: list[str], code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("linear.toml").write_text(LINEAR, encoding="utf-8")
    Path("circles.toml").write_text(CIRCLES, encoding="utf-8")
    with pytest.raises(InputError) as refused:
        simulate("--out", "out", *words)
    assert refused.value.code == code
    assert not Path("out").exists()


def test_a_plan_that_does_not_say_its_kind_is_one_of_the_machine(tmp_path: Path) -> None:
    plan, out = tmp_path / "plan.toml", tmp_path / "out"
    plan.write_text(LINEAR.replace('kind = "linear"\n', ""), encoding="utf-8")
    simulate("--machine", "lathe", "--plan", plan, "--out", out)
    assert 'kind = "linear"' in (out / "campaign.toml").read_text(encoding="utf-8")


class _Registry:
    """A registry that holds one bundle of a machine."""

    def __init__(self, geometry: dict[str, Any]) -> None:
        self.geometry = geometry

    def read_json(self, version: object, name: str) -> dict[str, Any]:
        assert name == "geometry.json"
        return self.geometry

    def bundle(self, version: object) -> dict[str, Any]:
        return {}


@pytest.mark.parametrize(
    ("geometry", "code"),
    [
        ({"type": "hexapod", "virtual": True}, "machine.not_offered"),
        ({"type": "spindle", "virtual": True}, "evidence.machine"),
        ({"virtual": True}, "evidence.machine"),
        ({"type": "ur10e"}, "evidence.real"),
    ],
)
def test_no_machine_gets_its_evidence_from_another(
    geometry: dict[str, Any], code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evidence, "Registry", lambda home: _Registry(geometry))
    monkeypatch.setattr(evidence.Bundle, "from_dict", lambda content: None)
    version: Any = SimpleNamespace(machine="m", version="1")
    with pytest.raises(InputError) as refused:
        evidence.measure(Home(tmp_path), version, seed=1)
    assert refused.value.code == code


@pytest.mark.parametrize("machine", EVERY, ids=lambda machine: machine.name)
def test_the_serving_host_is_told_of_the_chain_of_robots_only(machine: VirtualMachine, tmp_path: Path) -> None:
    geometry = {"type": machine.type, "tcp_mm": [0.0, 0.0, 100.0]}
    if machine.robot and machine.name != "cobot":
        with pytest.raises(InputError):
            promotion._write_machine("m", Home(tmp_path), geometry)
        return
    promotion._write_machine("m", Home(tmp_path), geometry)
    folder = machine_folder("m", Home(tmp_path))
    assert folder.exists() == machine.robot


def test_of_a_machine_of_an_unknown_type_a_tool_is_told_only_when_it_is_stated(tmp_path: Path) -> None:
    promotion._write_machine("m", Home(tmp_path), {"type": "my mill"})
    promotion._write_machine("m", Home(tmp_path), {})
    assert not machine_folder("m", Home(tmp_path)).exists()
    with pytest.raises(InputError):
        promotion._write_machine("m", Home(tmp_path), {"type": "toaster", "tcp_mm": [0.0, 0.0, 1.0]})


def _machine_table() -> str:
    """Return what each virtual machine can be asked, as Markdown."""
    lines = ["| `--machine` | campaigns | options | `--listen` | evidence | recheck |", "|---" * 6 + "|"]
    for machine in machines():
        options = ", ".join(f"`--{name}`" for name in machine.options) or "none"
        evidence, recheck = ("measured", "fresh evidence") if machine.offers("evidence") else ("no", "no")
        if machine.offers("prediction"):
            evidence, recheck = "predicted", "newer campaigns"
        cells = (
            f"`{machine.name}`",
            machine.kind,
            options,
            ", ".join(f"{clock} clock" for clock in machine.clocks) or "no",
            evidence,
            "pairs of runs" if machine.offers("checked") else recheck,
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)
