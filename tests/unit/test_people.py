"""Roles, a second person, and a record that shows when it was changed."""

from __future__ import annotations

import dataclasses
import json
import resource
import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from closed_loop import MACHINE, registered, small_bundle
from entered_workbench import enter
from starlette.testclient import TestClient
from typer.testing import CliRunner

from dtwin.cli import app
from dtwin.config import Home, home
from dtwin.errors import GateRefusal, InputError, StoreError
from dtwin.machine_record import keep_record
from dtwin.people import (
    AUDIT,
    act_as,
    acting,
    add_person,
    audit,
    damaged_in,
    note,
    read_people,
    remove_person,
    require_second_person,
)
from dtwin.serve.bundle_file import load_bundle
from dtwin.serve.pointer import resolve
from dtwin.train import promotion
from dtwin.train.registry import Registry
from dtwin.workbench._access import Access, _role_for
from dtwin.workbench._bench import Bench
from dtwin.workbench.server import application

BASE = "http://127.0.0.1:8765"


def outside(state: Home) -> TestClient:
    access = Access("127.0.0.1", 8765, True, home=state)
    return TestClient(application(Bench(state, access, None)), base_url=BASE, headers={"origin": BASE})


def entered(state: Home, token: str) -> TestClient:
    client = outside(state)
    enter(client, token)
    return client


def test_a_person_may_what_the_role_says_and_stands_in_the_record() -> None:
    state = home()
    looks, measures = add_person(state, "lena", ["look"]), add_person(state, "max", ["measure"])
    keep_record(state, "mill-1", {})
    event = {"what": "repair", "on": "2026-05-04", "note": "new spindle"}
    lena, maxim = entered(state, looks), entered(state, measures)
    assert lena.get("/machines").status_code == 200
    refused = lena.post("/api/machines/mill-1/event", json=event)
    assert (refused.status_code, "lena may not measure" in refused.text) == (403, True)
    taken = maxim.post("/api/machines/mill-1/event", json=event)
    assert taken.status_code < 300, taken.text
    assert maxim.post("/api/live/mill-1/stop").status_code == 403
    first, second, line = audit(state)
    assert (first["what"], second["what"]) == ("a token for lena: look", "a token for max: measure")
    assert (line["who"], line["what"], line["why"]) == ("max", "POST /api/machines/mill-1/event", "new spindle")
    assert line["came"] == str(taken.status_code)
    assert measures not in (state.root / "people.toml").read_text()
    assert outside(state).get("/", params={"token": "wrong"}).status_code == 403
    # A token that was taken away, or replaced, holds no more; nor does the page that was open.
    remove_person(state, "max")
    assert audit(state)[-1]["what"] == "no token for max any more"
    add_person(state, "lena", ["measure"])
    assert [client.get("/machines").status_code for client in (lena, maxim)] == [403, 403]


def test_every_change_at_the_workbench_needs_a_role_that_was_thought_of() -> None:
    bench = Bench(home(), Access("127.0.0.1", 8765), None)
    routes = application(bench).app.routes  # type: ignore[attr-defined]
    paths = [
        r.path
        for part in routes
        for r in getattr(getattr(part, "original_router", None), "routes", [part])
        if {"POST", "PUT", "DELETE", "PATCH"} & set(getattr(r, "methods", None) or ())
    ]
    assert len(paths) > 20
    assert [path for path in paths if _role_for(path.replace("{", "").replace("}", "")) is None] == []


def test_a_record_that_was_changed_says_so(tmp_path: Path) -> None:
    state = Home(tmp_path / "home")
    for k in range(4):
        note(state, f"did {k}", "because", "done")
    path = state.root / AUDIT
    assert [line["what"] for line in audit(state)] == [f"did {k}" for k in range(4)]
    lines = path.read_text().splitlines(keepends=True)
    for spoilt in (
        [lines[0].replace("did 0", "did 9"), *lines[1:]],
        [lines[0], *lines[2:]],
        [lines[1], lines[0], *lines[2:]],
        [*lines[:3], lines[3][:20]],
        [lines[0], lines[0], *lines[1:]],
    ):
        path.write_text("".join(spoilt))
        damaged = damaged_in(audit(state))
        assert damaged
        note(state, "went on", "", "done")
        assert damaged_in(audit(state)) == damaged
        shown = CliRunner().invoke(app, ["people", "record"])
        assert (shown.exit_code, "went on" in shown.stdout) == (1, True)
        assert f"{AUDIT} line {damaged[0]}" in shown.stderr
    path.write_text("".join(lines))
    note(state, "more", "", "done")
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 20, limit[1]))
        with pytest.raises(StoreError, match="cannot be written"):
            note(state, "cut short", "", "done")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        signal.signal(signal.SIGXFSZ, handler)
    assert len(audit(state)) == 5


def test_no_text_makes_the_record_look_changed_or_a_line_that_nobody_wrote(tmp_path: Path) -> None:
    state = Home(tmp_path / "home")
    longest = "\U0001f600" * 600
    note(state, longest, longest, longest, longest)
    note(state, "GET x\n2026-01-01T00:00:00+00:00  boss  promote", "a\u2028b", "200")
    assert len(audit(state)) == 2
    shown = CliRunner().invoke(app, ["people", "record"], env={"DTWIN_HOME": str(state.root)}).output
    assert len(shown.splitlines()) == 4


def test_a_list_of_people_that_is_not_usable_is_said_to_who_comes_with_a_token() -> None:
    state = home()
    token = add_person(state, "lena", ["measure"])
    lena = entered(state, token)
    (state.root / "people.toml").write_text("people = 5\n", encoding="utf-8")
    answer = lena.get("/machines")
    assert (answer.status_code, "the list of people is not usable" in answer.text) == (403, True)


def test_a_champion_may_need_two_people(monkeypatch: pytest.MonkeyPatch) -> None:
    state = home()
    registry = Registry(state)
    [version] = registered(state, small_bundle())
    require_second_person(state, True)
    monkeypatch.setattr(promotion, "evidence_gate", lambda *args, **settings: [])
    monkeypatch.setattr(promotion, "records", lambda *args: [])
    evidence = dataclasses.make_dataclass("Told", ["kind", "runs"])("virtual", ())

    def by(name: str) -> None:
        act_as(name)
        promotion.promote(registry, state, version, geometry={"type": "mill"}, evidence=evidence, comment="good")

    try:
        for _ in range(2):
            with pytest.raises(GateRefusal, match="waits for a second person"):
                by("lena")
        assert registry.champion(MACHINE) is None
        by("max")
    finally:
        act_as("")
    champion = registry.champion(MACHINE)
    assert champion is not None
    assert champion.version == "1"
    said = [(line["action"], line["who"]) for line in promotion.history(state, MACHINE)]
    assert said == [("proposed", "lena"), ("champion", "max")]
    stated, *promoted = audit(state)
    assert stated["what"] == "a champion needs two people"
    assert [line["who"] for line in promoted] == ["lena", "max"]


def test_a_trial_of_the_champion_or_of_the_one_before_takes_nothing_away(monkeypatch: pytest.MonkeyPatch) -> None:
    state = home()
    registry = Registry(state)
    registered(state, small_bundle(), r2=(0.9, 0.8))
    monkeypatch.setattr(promotion, "evidence_gate", lambda *args, **settings: [])
    monkeypatch.setattr(promotion, "records", lambda *args: [])
    evidence = dataclasses.make_dataclass("Told", ["kind", "runs"])("virtual", ())
    for number in ("1", "2"):
        promotion.promote(registry, state, registry.version(MACHINE, number), geometry={}, evidence=evidence)
    champion = resolve("latest", MACHINE, state)
    for number in ("2", "1"):
        promotion.trial(registry, state, registry.version(MACHINE, number), geometry={})
        assert resolve("trial", MACHINE, state).version == int(number)
        assert resolve("latest", MACHINE, state) == champion
        assert promotion.state_of(registry.version(MACHINE, "2"), state) == "champion"
    promotion.rollback(registry, state, MACHINE)
    back = resolve("latest", MACHINE, state)
    assert (back.version, load_bundle(back.path, MACHINE).bundle.provenance.evidence) == (1, "virtual")


def test_people_who_are_stated_at_one_moment_are_all_kept() -> None:
    state = home()
    names = [f"p{number}" for number in range(8)]
    with ThreadPoolExecutor(9) as pool:
        made = [pool.submit(add_person, state, name, ["look"]) for name in names]
        made.append(pool.submit(require_second_person, state, True))
    assert all(one.exception() is None for one in made)
    known = read_people(state)
    assert sorted(person.name for person in known.people) == names
    assert known.second_person


def test_the_environment_does_not_say_who_acts(monkeypatch: pytest.MonkeyPatch) -> None:
    before = acting()
    for name in ("LOGNAME", "USER", "LNAME", "USERNAME"):
        monkeypatch.setenv(name, "somebody-else")
    assert acting() == before != "somebody-else"


def test_the_commands_make_list_and_take_away() -> None:
    shell = CliRunner()
    made = json.loads(shell.invoke(app, ["people", "add", "lena", "--role", "promote", "--json"]).stdout)
    assert read_people(home()).of_token(made["token"])
    listed = json.loads(shell.invoke(app, ["people", "list", "--json"]).stdout)
    assert listed == {"people": [{"name": "lena", "roles": ["promote"]}], "second_person": False}
    assert "two people" in shell.invoke(app, ["people", "second", "--required"]).stdout
    for wrong in (["add", "x", "--role", "rule"], ["remove", "nobody"], ["add", "../x", "--role", "look"]):
        assert isinstance(shell.invoke(app, ["people", *wrong]).exception, InputError)
    assert shell.invoke(app, ["people", "record"]).exit_code == 0
    (home().root / "people.toml").write_text('second_person = "yes"\n')
    with pytest.raises(InputError, match="not usable"):
        read_people(home())
    assert acting()
