"""Promotions that a kill cuts off anywhere, or that another one meets."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from bundles import path_bundle

import dtwin.train.promotion as promoting
from dtwin.config import Home
from dtwin.errors import GateRefusal, InputError, StoreError
from dtwin.machine_record import changed_since, with_event
from dtwin.pipeline.machine_history import champion_of
from dtwin.serve.bundle_file import load_bundle
from dtwin.serve.delivery import delivery, install
from dtwin.serve.pointer import machine_folder, resolve
from dtwin.serve.withdrawn import withdrawn_why
from dtwin.train.evidence_record import Record
from dtwin.train.gates import Verdict
from dtwin.train.promotion import promote, rollback, state_of, trial, withdraw
from dtwin.train.promotion_books import history
from dtwin.train.registry import RegisteredVersion, Registry, model_name

GEOMETRY = {"virtual": True}
NEVER = 10**6
STEPS = range(1, 60)


class Killed(BaseException):
    """Nobody catches it, as a kill."""


@pytest.fixture(scope="module")
def registry(tmp_path_factory: pytest.TempPathFactory) -> Registry:
    return Registry(Home(tmp_path_factory.mktemp("home")))


@pytest.fixture(autouse=True)
def _gates_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    def checked(_: Registry, version: RegisteredVersion) -> tuple[Any, list[Verdict]]:
        return path_bundle(machine=version.machine), [Verdict("gate", True, "")]

    monkeypatch.setattr(promoting, "check_version", checked)
    monkeypatch.setattr(promoting, "evidence_gate", lambda *_, **__: [])
    monkeypatch.setattr(promoting, "records", lambda *_: [])


@pytest.fixture
def kill_at(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Kill before a step of what is written: a file that gets its name or goes away, an entry of the registry."""
    left = [NEVER]

    def counted(function: Any) -> Any:
        def write(*given: Any, **named: Any) -> Any:
            left[0] -= 1
            if not left[0]:
                raise Killed
            return function(*given, **named)

        return write

    monkeypatch.setattr(Path, "replace", counted(Path.replace))
    monkeypatch.setattr(Path, "unlink", counted(Path.unlink))
    monkeypatch.setattr(Registry, "mark", counted(Registry.mark))
    return lambda step: left.__setitem__(0, step)


def versions(registry: Registry, machine: str, count: int) -> list[RegisteredVersion]:
    registry.ensure_model(model_name(machine), "a correction", machine=machine, holds="correction")
    with registry.open_run("r", {}) as run:
        pass
    for _ in range(count):
        registry.client.create_model_version(model_name(machine), source="file:nowhere", run_id=run)
    return registry.versions(machine)[::-1]


def champion(registry: Registry, version: RegisteredVersion, valid_days: float = 0.0) -> None:
    version = registry.version(version.machine, version.version)
    evidence: Any = SimpleNamespace(kind="virtual", runs=())
    promote(registry, registry.home, version, geometry=GEOMETRY, evidence=evidence, valid_days=valid_days)


def test_a_champion_that_is_promoted_again_stands_wherever_a_kill_comes(
    registry: Registry, kill_at: Callable[[int], None], tmp_path: Path
) -> None:
    home = registry.home
    for step in STEPS:
        machine, ended = f"again-{step}", True
        (version,) = versions(registry, machine, 1)
        champion(registry, version)
        trial(registry, home, registry.version(machine, "1"), geometry=GEOMETRY)
        kill_at(step)
        try:
            champion(registry, version, valid_days=9.0)
        except Killed:
            ended = False
        kill_at(NEVER)
        found = resolve("latest", machine, home)
        load_bundle(found.path, machine)
        other = Home(tmp_path / f"served-{step}")
        assert install(other, machine, delivery(home, machine))
        assert resolve("latest", machine, other).sha256 == found.sha256
        champion(registry, version, valid_days=8.0)
        assert load_bundle(resolve("latest", machine, home).path).bundle.provenance.valid_days == 8.0
        assert [p.name for p in machine_folder(machine, home).glob("v*")] == ["v0001.json"]
        if ended:
            # The same content once more leaves nothing beside it, either.
            champion(registry, version, valid_days=8.0)
            assert [p.name for p in machine_folder(machine, home).glob("v*")] == ["v0001.json"]
            return
    pytest.fail("it never came to its end")


def test_a_rollback_after_a_promotion_that_was_cut_off_bars_what_was_served(
    registry: Registry, kill_at: Callable[[int], None]
) -> None:
    home = registry.home
    for step in STEPS:
        machine, ended = f"cut-{step}", True
        first, second, third = versions(registry, machine, 3)
        champion(registry, first)
        champion(registry, second)
        kill_at(step)
        try:
            champion(registry, third)
        except Killed:
            ended = False
        kill_at(NEVER)
        served = resolve("latest", machine, home).version
        assert served in (2, 3)
        assert rollback(registry, home, machine, "it hummed").version == str(served - 1)
        assert resolve("latest", machine, home).version == served - 1
        withdrawn = [n for n in (1, 2, 3) if withdrawn_why(machine, home, n)]
        assert withdrawn == [served]
        told = [entry["version"] for entry in history(home, machine) if entry["action"] == "champion"]
        assert told == ["1", "2", "3"][:served]
        if ended:
            return
    pytest.fail("it never came to its end")


def test_what_was_judged_is_withdrawn_and_not_what_became_champion_meanwhile(registry: Registry) -> None:
    home = registry.home
    first, second = versions(registry, "judged", 2)
    champion(registry, first)
    champion(registry, second)
    withdrawn, left = withdraw(registry, home, first, "worse than nothing")
    assert left is not None
    assert (withdrawn.version, left.version) == ("1", "2")
    assert withdrawn_why("judged", home, 1)
    assert resolve("latest", "judged", home).version == 2
    assert withdraw(registry, home, second, "worse, too")[1] is None
    assert withdrawn_why("judged", home, 2) == "worse, too"


def test_the_first_champion_can_be_taken_back(registry: Registry) -> None:
    home = registry.home
    (version,) = versions(registry, "first", 1)
    with pytest.raises(InputError, match="no champion"):
        rollback(registry, home, "first")
    champion(registry, version)
    # As from a flow, whose form has no limit.
    with pytest.raises(InputError, match="comment is too long"):
        rollback(registry, home, "first", "x" * 1001)
    assert champion_of(home, "first")
    assert rollback(registry, home, "first", "it hummed") is None
    assert withdrawn_why("first", home, 1) == "it hummed"
    assert state_of(registry.version("first", "1"), home) == "withdrawn"
    with pytest.raises(InputError, match="no champion"):
        rollback(registry, home, "first")


def test_nothing_is_rolled_back_to_that_was_never_champion_whatever_aliases_say(registry: Registry) -> None:
    home = registry.home
    first, second = versions(registry, "aliases", 2)
    champion(registry, first)
    trial(registry, home, second, geometry=GEOMETRY)
    registry.client.set_registered_model_alias(model_name("aliases"), "champion", "2")
    served = registry.champion("aliases")
    assert served is not None
    assert served.version == registry.version("aliases", "champion").version == "1"
    registry.client.set_registered_model_alias(model_name("aliases"), "previous", "2")
    assert rollback(registry, home, "aliases") is None
    assert withdrawn_why("aliases", home, 1)
    assert not withdrawn_why("aliases", home, 2)


def test_old_evidence_stays_old_and_ends_when_the_machine_is_changed(
    registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = registry.home
    (version,) = versions(registry, "repaired", 1)
    kept = Record("f00d", "2026-03-02T08:00:00.123456+00:00", {})
    monkeypatch.setattr(promoting, "records", lambda *_: [kept])
    for _ in range(2):
        champion(registry, version, valid_days=90.0)
        assert resolve("latest", "repaired", home).proved == "2026-03-02T08:00:00+00:00"
    with_event(home, "repaired", "other", "2026-03-03", "painted")
    champion(registry, version)
    with_event(home, "repaired", "repair", "2026-03-04", "another gear")
    with pytest.raises(GateRefusal) as refused:
        champion(registry, version)
    assert "repair on 2026-03-04 after the evidence of 2026-03-02" in str(refused.value.got)
    assert champion_of(home, "repaired").endswith("proved on 2026-03-02; repair on 2026-03-04: dtwin recheck")


def test_what_happened_on_the_day_of_the_evidence_refuses_nothing_and_is_said(tmp_path: Path) -> None:
    home = Home(tmp_path)
    with_event(home, "m", "repair", "2026-03-02", "another gear")
    for moment in ("2026-03-02", "2026-03-02T08:00:00"):
        assert changed_since(home, "m", moment) == ""
        assert changed_since(home, "m", moment, doubtful=True) == "repair on 2026-03-02, the same day"
    assert changed_since(home, "m", "2026-03-01T23:59:59") == "repair on 2026-03-02"
    assert changed_since(home, "m", "2026-03-03", doubtful=True) == ""


@pytest.mark.parametrize("failing", ["registry", "pointer"])
def test_a_full_disk_is_told_with_what_is_in_force(
    registry: Registry, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    machine = f"full-{failing}"
    first, second = versions(registry, machine, 2)
    champion(registry, first)

    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(*((promoting, "enter") if failing == "registry" else (Path, "replace")), full)
        with pytest.raises(StoreError, match="not all of it") as refused:
            champion(registry, second)
    served = resolve("latest", machine, registry.home).version
    assert served == (2 if failing == "registry" else 1)
    assert str(refused.value.where).endswith(f"in force now: version {served} (champion)")
    champion(registry, second)
    assert [e["version"] for e in history(registry.home, machine)][-1] == "2"


def test_a_line_of_the_history_that_was_cut_short_says_nothing(registry: Registry) -> None:
    (version,) = versions(registry, "line", 1)
    champion(registry, version)
    path = machine_folder("line", registry.home) / "promotions.jsonl"
    path.write_bytes(path.read_bytes() + b'{"time": "2026\xff\n[1]\n{}')
    champion(registry, version)
    assert [entry["action"] for entry in history(registry.home, "line")] == ["champion", "champion"]
