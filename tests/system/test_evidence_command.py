"""Evidence is computed and promoted by; what was typed, forged or contradicted is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from closed_loop import BEGIN, MACHINE, circles, in_lake, registered, served, small_bundle, turns
from typer.testing import CliRunner

from dtwin.cli import app
from dtwin.config import Home
from dtwin.errors import DtwinError
from dtwin.schema import Run
from dtwin.serve._lease import lease
from dtwin.serve.bundle_file import load_bundle
from dtwin.serve.pointer import resolve
from dtwin.train.promotion_books import history
from dtwin.train.registry import RegisteredVersion, Registry

pytestmark = pytest.mark.system
BUNDLE = small_bundle()
SHA = BUNDLE.model_sha256


def run(*command: str) -> tuple[int, dict[str, Any]]:
    """Return exit code and JSON of a command, or of its error, in this process."""
    done = CliRunner().invoke(app, [*command, "--json"])
    if isinstance(done.exception, DtwinError):
        return done.exception.exit_code, done.exception.as_dict()
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done.exit_code, json.loads(done.stdout) if done.stdout.strip() else {}


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Home:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    return Home(tmp_path / "home")


def version_of(home: Home, *, virtual: bool = False) -> RegisteredVersion:
    (version,) = registered(home, BUNDLE, virtual=virtual)
    return version


def kept_file(home: Home, version: RegisteredVersion) -> Path:
    """Return where the registry keeps the only evidence of a version."""
    (name,) = Registry(home).files(version, "evidence")
    (path,) = home.root.rglob(Path(name).name)
    return path


def measured(home: Home, name: str = "turns", **changes: Any) -> list[Run]:
    """Put interleaved circles of a real machine into the lake, and the serving into the journal."""
    runs = circles(turns(BUNDLE), **changes)
    in_lake(home, name, runs)
    served(home, SHA, [r for r in runs if r.meta.correction])
    return runs


def test_runs_of_a_real_machine_make_a_champion_with_real_evidence(home: Home) -> None:
    version = version_of(home)
    code, refused = run("promote", version.version)
    assert (code, refused["code"]) == (1, "evidence.real")
    assert "dtwin campaign --with 1" in refused["hint"]
    runs = measured(home)
    code, found = run("evidence", version.version, "--without", "turns", "--with", "turns")
    assert code == 0, found
    assert (found["kind"], found["switches"], len(found["runs"])) == ("real", 5, len(runs))
    code, promoted = run("promote", version.version, "--comment", "measured")
    assert code == 0, promoted
    assert (promoted["champion"], promoted["served_now"]) == (True, False)
    where = resolve("latest", MACHINE, home).path
    assert load_bundle(where, MACHINE).bundle.provenance.evidence == "real"


def test_a_virtual_machine_never_gives_real_evidence(home: Home) -> None:
    version = version_of(home, virtual=True)
    measured(home)
    code, found = run("evidence", "1", "--without", "turns", "--with", "turns")
    assert (code, found["kind"]) == (0, "virtual")
    with lease("127.9.9.9", MACHINE, home):
        code, promoted = run("promote", "1")
    # It keeps what it began with.
    assert (code, promoted["served_now"]) == (0, True)
    served_bundle = load_bundle(resolve("latest", MACHINE, home).path, MACHINE).bundle
    assert served_bundle.provenance.evidence == "virtual"
    # The same machine, called real: its evidence stays what it was.
    registry = Registry(home)
    geometry = registry.read_json(version, "geometry.json")
    registry.attach(version, {"geometry.json": json.dumps(geometry | {"virtual": False})})
    code, again = run("promote", "1")
    assert code == 3
    assert "the evidence is not what its runs say" in again.get("reason", again["message"])


def test_a_typed_file_is_nothing(home: Home, tmp_path: Path) -> None:
    version = version_of(home)
    condition = {
        "plane": "XY",
        "radius_mm": 50.0,
        "feed_mm_min": 1000.0,
        "n_runs": 1,
        "before_um": 12.0,
        "after_um": 1.0,
        "before_ci_um": 0.1,
        "after_ci_um": 0.1,
        "floor_um": 0.1,
        "worse": False,
        "better": True,
    }
    typed = {
        "kind": "real",
        "clock": "typed by hand",
        "machine": MACHINE,
        "bundle_sha256": BUNDLE.sha256,
        "model_sha256": SHA,
        "conditions": [condition],
        "delays": {},
    }
    file = tmp_path / "typed.json"
    file.write_text(json.dumps(typed), encoding="utf-8")
    done = CliRunner().invoke(app, ["promote", "1", "--evidence", str(file)])
    assert done.exit_code == 2
    registry = Registry(home)
    registry.attach(version, {"evidence.json": json.dumps(typed)})
    assert run("promote", "1")[1]["code"] == "evidence.real"
    registry.attach(version, {"evidence/20260504T080000-0123456789ab.json": json.dumps(typed)})
    code, found = run("promote", "1")
    assert (code, found["code"]) == (3, "evidence.changed")
    with pytest.raises(DtwinError):
        resolve("latest", MACHINE, home)


@pytest.mark.parametrize("what", ["figure", "kind", "run", "hash"])
def test_a_forged_record_is_refused(home: Home, what: str) -> None:
    """Whoever forges also computes the checksum of the file's name anew."""
    import hashlib

    version = version_of(home)
    measured(home, before_um=4.0, after_um=12.0)
    assert run("evidence", "1", "--without", "turns", "--with", "turns")[0] == 0
    path = kept_file(home, version)
    content = json.loads(path.read_text(encoding="utf-8"))
    (condition,) = content["conditions"]
    condition |= {"worse": False, "better": True}
    if what == "figure":
        condition["after_um"] = 1.0
    elif what == "kind":
        content["kind"] = "virtual"
    elif what == "run":
        content["runs"] = content["runs"][2:]
    else:
        content["runs"][0]["content_sha256"] = "0" * 64
    text = json.dumps(content, indent=1)
    digest = hashlib.sha256(text.encode()).hexdigest()[:12]
    path.unlink()
    path.with_name(f"{path.stem.partition('-')[0]}-{digest}.json").write_text(text, "utf-8")
    code, found = run("promote", "1")
    assert (code, found["code"]) == (3, "evidence.differs")


def test_what_the_record_says_is_not_what_decides(home: Home) -> None:
    """With every figure right and only the verdicts turned, the runs still say no."""
    import hashlib

    version = version_of(home)
    measured(home, before_um=4.0, after_um=12.0)
    assert run("evidence", "1", "--without", "turns", "--with", "turns")[0] == 0
    path = kept_file(home, version)
    content = json.loads(path.read_text(encoding="utf-8"))
    content["conditions"][0] |= {"worse": False, "better": True, "reduction": 0.9}
    text = json.dumps(content, indent=1)
    digest = hashlib.sha256(text.encode()).hexdigest()[:12]
    path.unlink()
    path.with_name(f"{path.stem.partition('-')[0]}-{digest}.json").write_text(text, "utf-8")
    code, found = run("promote", "1")
    assert code == 3
    assert "no condition worse" in found["reason"]


def test_contrary_evidence_must_be_named(home: Home) -> None:
    version_of(home)
    measured(home, "first", before_um=4.0, after_um=12.0)
    code, harm = run("evidence", "1", "--without", "first", "--with", "first")
    assert code == 0
    assert run("promote", "1")[0] == 3
    measured(home, "second", begin=BEGIN.replace(day=5), seed=5)
    assert run("evidence", "1", "--without", "second", "--with", "second")[0] == 0
    code, refused = run("promote", "1")
    assert code == 3
    assert f"evidence against it is named: {harm['id']}" in refused["reason"]
    code, unknown = run("promote", "1", "--despite", "0123456789ab")
    assert (code, unknown["code"]) == (1, "promote.despite")
    code, promoted = run("promote", "1", "--despite", harm["id"], "--comment", "a loose bar")
    assert code == 0, promoted
    newest = history(home, MACHINE)[-1]
    assert (newest["action"], newest["despite"]) == ("champion", [harm["id"]])


def test_runs_that_came_later_ask_for_evidence_anew(home: Home) -> None:
    version_of(home)
    measured(home)
    assert run("evidence", "1", "--without", "turns", "--with", "turns")[0] == 0
    more = circles(
        turns(BUNDLE), seed=8, feed_mm_min=3000.0, begin=BEGIN.replace(hour=12), before_um=4.0, after_um=12.0
    )
    in_lake(home, "turns", more)
    served(home, SHA, [r for r in more if r.meta.correction])
    code, found = run("promote", "1")
    assert (code, found["code"]) == (3, "evidence.differs")
    assert "12 other runs, 0 gone" in found["got"]


def test_both_ways_must_be_named(home: Home) -> None:
    version_of(home)
    code, found = run("evidence", "1", "--with", "turns")
    assert (code, found["code"]) == (1, "evidence.campaigns")
    code, found = run("evidence", "1", "--without", "nothing", "--with", "nothing")
    assert (code, found["code"]) == (1, "campaign.unknown")


def test_a_champion_that_harms_is_withdrawn_by_runs_of_the_lake(home: Home) -> None:
    version_of(home)
    measured(home)
    run("evidence", "1", "--without", "turns", "--with", "turns")
    assert run("promote", "1")[0] == 0
    later = BEGIN.replace(day=6)
    measured(home, "later", begin=later, before_um=4.0, after_um=12.0, seed=9)
    code, found = run("recheck", "--without", "later", "--with", "later")
    assert code == 3, found
    assert (found["verdict"], found["withdrawn"]) == ("worse", True)
    assert [c["name"] for c in found["conditions"]] == ["XY R50 F1000", "all"]
