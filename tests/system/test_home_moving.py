"""A home moves to a real S3 server and a real PostgreSQL, and back; a second computer works on it meanwhile."""

from __future__ import annotations

import hashlib
import json
import os
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from closed_loop import GEOMETRY, MACHINE, registered, small_bundle
from fleet_lake import fill
from shared_servers import BUCKET, KEYS, Postgres, running_postgres, running_store
from shown_commands import Block, blocks, page
from starlette.testclient import TestClient
from typer.testing import CliRunner

from dtwin.atomic import write_toml
from dtwin.bucket import Objects
from dtwin.cli import app
from dtwin.config import Home, home
from dtwin.errors import InputError, StoreError
from dtwin.home_file import HOME_FILE, Bucket
from dtwin.lake.store import Lake
from dtwin.machine_record import keep_record, read_record
from dtwin.pipeline import home_moving
from dtwin.pipeline.home_check import check_home
from dtwin.serve.pointer import resolve
from dtwin.train._registry_client import _alone_at
from dtwin.train.promotion import trial
from dtwin.train.registry import Registry
from dtwin.twins.verbs import Twins
from dtwin.workbench._access import Access
from dtwin.workbench._bench import Bench
from dtwin.workbench.server import application

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Postgres]:
    with running_postgres(tmp_path_factory.mktemp("pg") / "server") as running:
        yield running


@pytest.fixture(scope="module")
def shown(database: Postgres) -> Iterator[list[Block]]:
    """The blocks of the page, with the addresses and names of this test."""
    text = page("docs/how-to/share-a-home.md")
    with running_store() as store:
        ours = {
            "s3://plant-store/dtwin": f"s3://{BUCKET}/plant",
            "store.plant:9000": f"127.0.0.1:{store}",
            "db.plant:5432": f"127.0.0.1:{database.port}",
            "mill-backlash": "c00",
            "mill-a": "mine",
        }
        for told, mine in ours.items():
            assert told in text
            text = text.replace(told, mine)
        yield blocks(text)


@pytest.fixture
def places(shown: list[Block]) -> dict[str, str]:
    [file] = [block for block in shown if block.title == HOME_FILE]
    return tomllib.loads("\n".join(file.lines))


def commands(block: Block) -> list[list[str]]:
    return [shlex.split(line, comments=True)[1:] for line in block.lines]


def files_of(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in (".lock", ".writing")
    }


def test_two_computers_on_an_empty_registry_make_its_tables_one_after_the_other(
    database: Postgres, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    uri = f"postgresql+psycopg2://dtwin@127.0.0.1:{database.port}/prefect"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
    monkeypatch.setattr("dtwin.train._registry_client._TABLES_S", 1)
    with _alone_at(uri), pytest.raises(StoreError, match="does not answer") as caught:
        Registry(Home(tmp_path / "second"))
    assert "lock timeout" in str(caught.value.got)
    assert Registry(Home(tmp_path / "second")).machines() == []


def test_a_home_moves_there_and_back_and_is_the_same(
    shown: list[Block], places: dict[str, str], database: Postgres, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in KEYS.items():
        monkeypatch.setenv(name, value)
    shell, here = CliRunner(), home()
    fill(here, 2)
    Twins(here).fit("c00", ["squareness"], "mine")
    keep_record(here, "mill-0", {"serial": "7"})
    [version] = registered(here, small_bundle())
    trial(Registry(here), here, version, geometry=GEOMETRY, comment="first")
    rows, lake_before = Lake(here.lake).runs(), files_of(here.root / "lake")
    bundle, metrics = Registry(here).bundle(version), Registry(here).metrics(version)
    to_move, to_join, to_go_back = (commands(block) for block in shown if block.language == "sh")

    # It dies just before the pointer changes, and is local still; the same command goes on.
    with monkeypatch.context() as dying:
        dying.setattr(home_moving, "follow_shared", _die)
        with pytest.raises(RuntimeError, match="killed"):
            home_moving.share(here, places)
    assert not here.file.store
    [move] = to_move
    moved = shell.invoke(app, [*move, "--json"])
    assert moved.exit_code == 0, moved.output
    said = json.loads(moved.stdout)
    assert said["lake_files"] == len(lake_before)
    assert files_of(here.root / "lake") == lake_before
    assert isinstance(here.lake, Bucket)
    assert here.file.as_dict() == places
    assert Lake(here.lake).runs() == rows
    said = json.loads(shell.invoke(app, ["home", "show", "--json"]).stdout)
    assert said["shared"]["store"] == places["store"]
    assert said["shared"]["parts"]["lake"]["files"] == len(lake_before)

    # Another computer needs the file alone.
    other = Home(tmp_path / "other")
    write_toml(other.root / HOME_FILE, places, "the settings")
    with monkeypatch.context() as elsewhere:
        elsewhere.setenv("DTWIN_HOME", str(other.root))
        for command in to_join:
            answer = shell.invoke(app, command)
            assert answer.exit_code == 0, answer.output
    assert Lake(other.lake).runs() == rows
    assert Twins(other).newest("mine").labels == ("squareness XY", "backlash X")
    assert read_record(other, "mill-0") == read_record(here, "mill-0") is not None
    assert resolve("trial", MACHINE, other).version == 1
    registry = Registry(other)
    there = registry.version(MACHINE, "1")
    assert (registry.bundle(there), registry.metrics(there)) == (bundle, metrics)
    # What it adds is numbered on.
    [two] = registered(other, small_bundle(size_um=30.0))
    assert two.version == "2"
    second = registry.bundle(two)
    assert fill(other, 3)[-1] == "c02"
    pages = TestClient(application(Bench(other, Access("127.0.0.1", 80), None)), base_url="http://127.0.0.1:80")
    for address in (
        "/machines",
        "/machines/mill-0",
        "/campaigns",
        "/campaigns/c02",
        "/twins",
        "/twins/mine",
        "/models",
    ):
        assert pages.get(address).status_code == 200, address

    # While the database is away a command says so; when it is back, who was connected goes on.
    database.does("-m", "immediate", "stop")
    with pytest.raises(StoreError, match="does not answer"):
        Registry(other)
    database.does("start")
    assert registry.bundle(two) == second
    checked = check_home(other)
    assert checked.wrong == {}
    assert (checked.looked_at["runs"], checked.looked_at["models"]) == (18, 2)
    assert checked.looked_at["shared"] >= 7

    with pytest.raises(InputError, match="lies there already"):
        home_moving.share(Home(tmp_path / "third").made(), places)
    with pytest.raises(InputError, match="shared already"):
        home_moving.share(here, places)
    refused = shell.invoke(app, ["home", "backup", str(tmp_path / "x.tar")])
    assert isinstance(refused.exception, InputError)

    for command in to_go_back:
        answer = shell.invoke(app, command)
        assert answer.exit_code == 0, answer.output
    assert here.lake == here.root / "lake"
    assert len(Lake(here.lake).runs()) == 18
    assert Twins(here).newest("mine").version == 2
    # Of this computer alone: nothing of it leads to the store.
    Objects(Bucket(places["store"], places["endpoint"])).delete(
        [stored.name for stored in Objects(Bucket(places["store"], places["endpoint"])).list()]
    )
    assert check_home(here).wrong == {}
    # In a process of its own: MLflow keeps the file open that was there before.
    looked = subprocess.run(
        [sys.executable, "-c", _LOOK, str(here.root)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=True,
        timeout=600,
    )
    assert json.loads(looked.stdout) == {"1": bundle, "2": second, "new": "3"}
    assert not (here.root / "moving").exists()
    assert next(here.root.glob("lake.before-*"))


_LOOK = """
import json, sys
from pathlib import Path
from closed_loop import MACHINE, registered, small_bundle
from dtwin.config import Home
from dtwin.train.registry import Registry
registry = Registry(Home(Path(sys.argv[1])))
found = {v.version: registry.bundle(v) for v in registry.versions(MACHINE)}
[new] = registered(registry.home, small_bundle(size_um=40.0))
print(json.dumps(found | {"new": new.version}))
"""


def _die(*arguments: object) -> None:
    raise RuntimeError("killed")


@pytest.mark.parametrize("given", [[], ["--local", "--store", "s3://bucket"]])
def test_a_move_that_says_no_place_or_two_is_refused(given: list[str]) -> None:
    refused = CliRunner().invoke(app, ["home", "move", *given])
    assert isinstance(refused.exception, InputError)
    assert refused.exception.code == "move.where"
