"""A home moves to a real S3 server and a real PostgreSQL, and back; a second computer works on it meanwhile."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from closed_loop import GEOMETRY, MACHINE, registered, small_bundle
from fleet_lake import fill
from shared_servers import BUCKET, KEYS, running_postgres, running_store
from typer.testing import CliRunner

from dtwin.atomic import write_toml
from dtwin.bucket import Objects
from dtwin.cli import app
from dtwin.config import Home, home
from dtwin.errors import InputError
from dtwin.home_file import HOME_FILE, Bucket
from dtwin.lake.store import Lake
from dtwin.machine_record import MachineRecord, read_record, write_record
from dtwin.pipeline import home_moving
from dtwin.pipeline.home_check import check_home
from dtwin.serve.pointer import resolve
from dtwin.shared_documents import follow_shared
from dtwin.train.promotion import trial
from dtwin.train.registry import Registry
from dtwin.twins.verbs import Twins

pytestmark = [pytest.mark.system, pytest.mark.timeout(200)]


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    with running_postgres(tmp_path_factory.mktemp("pg") / "server") as database, running_store() as store:
        yield {
            "store": f"s3://{BUCKET}/plant",
            "endpoint": f"http://127.0.0.1:{store}",
            "registry": f"postgresql://dtwin@127.0.0.1:{database}/mlflow",
            "flows": f"postgresql://dtwin@127.0.0.1:{database}/prefect",
        }


def files_of(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in (".lock", ".writing")
    }


def test_a_home_moves_there_and_back_and_is_the_same(
    places: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in KEYS.items():
        monkeypatch.setenv(name, value)
    shell, here = CliRunner(), home()
    fill(here, 2)
    Twins(here).fit("c00", ["squareness"], "mine")
    write_record(here, MachineRecord("mill-0", {"serial": "7"}))
    [version] = registered(here, small_bundle())
    trial(Registry(here), here, version, geometry=GEOMETRY, comment="first")
    rows, lake_before = Lake(here.lake).runs(), files_of(here.root / "lake")
    bundle, metrics = Registry(here).bundle(version), Registry(here).metrics(version)
    named = [part for key, value in places.items() for part in (f"--{key}", value)]

    # It dies just before the pointer changes, and is local still; the same command goes on.
    with monkeypatch.context() as dying:
        dying.setattr(home_moving, "follow_shared", _die)
        with pytest.raises(RuntimeError, match="killed"):
            home_moving.share(here, places)
    assert not here.file.store
    moved = shell.invoke(app, ["home", "move", *named, "--json"])
    assert moved.exit_code == 0, moved.output
    said = json.loads(moved.stdout)
    assert said["lake_files"] == len(lake_before)
    assert files_of(here.root / "lake") == lake_before
    assert isinstance(here.lake, Bucket)
    assert Lake(here.lake).runs() == rows
    shown = json.loads(shell.invoke(app, ["home", "show", "--json"]).stdout)
    assert shown["shared"]["store"] == places["store"]
    assert shown["shared"]["parts"]["lake"]["files"] == len(lake_before)

    # Another computer needs the file alone.
    other = Home(tmp_path / "other")
    write_toml(other.root / HOME_FILE, places, "the settings")
    follow_shared(other)
    assert Lake(other.lake).runs() == rows
    assert Twins(other).newest("mine").labels == ("squareness XY",)
    assert (read_record(other, "mill-0") or MachineRecord("")).facts == {"serial": "7"}
    assert resolve("trial", MACHINE, other).version == 1
    registry = Registry(other)
    there = registry.version(MACHINE, "1")
    assert (registry.bundle(there), registry.metrics(there)) == (bundle, metrics)
    # What it adds is numbered on.
    [two] = registered(other, small_bundle(size_um=30.0))
    assert two.version == "2"
    second = registry.bundle(two)
    assert fill(other, 3)[-1] == "c02"
    Twins(other).add("mine", "backlash", "X")
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

    moved = shell.invoke(app, ["home", "move", "--local"])
    assert moved.exit_code == 0, moved.output
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
        timeout=120,
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
