"""A home on a shared store: several computers write, one is killed, the store is away, and nothing is lost or doubled."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from fleet_lake import fill
from shared_servers import BUCKET, KEYS, StoreProxy, running_store
from shared_writer import campaign

from dtwin.atomic import write_toml
from dtwin.bucket import Objects, store_error
from dtwin.config import Home
from dtwin.documents import read_document, write_document
from dtwin.errors import InputError, StoreError
from dtwin.home_file import HOME_FILE, Bucket
from dtwin.lake.store import Lake
from dtwin.shared_documents import drop_unnamed_content, follow_shared, followed_beside, shared_units

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def store() -> Iterator[int]:
    with running_store() as port:
        yield port


@pytest.fixture
def proxy(store: int) -> Iterator[StoreProxy]:
    proxy = StoreProxy(store)
    yield proxy
    proxy.close()


@pytest.fixture(autouse=True)
def _keys(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in KEYS.items():
        monkeypatch.setenv(name, value)


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dtwin.bucket._RETRIES", 1)


def shared(root: Path, port: int, name: str) -> Home:
    """A computer's home on the store; ``name``: the place there."""
    stated = {
        "store": f"s3://{BUCKET}/{name}",
        "endpoint": f"http://127.0.0.1:{port}",
        # Nobody asks it in these tests.
        "registry": "http://127.0.0.1:9",
    }
    write_toml(root / HOME_FILE, stated, "the settings")
    return Home(root)


def test_two_computers_see_the_same_runs_and_amendments(
    store: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    a, b = (Lake(shared(tmp_path / who, store, "same").lake) for who in "ab")
    fill(Home(tmp_path / "a"), 2)
    assert b.campaigns() == ["c00", "c01"]
    rows = b.runs("c00")
    here = Home(tmp_path / "here")
    fill(here, 2)
    local = Lake(here.lake)
    for row, other in zip(rows, local.runs("c00"), strict=True):
        there, mine = b.load(row), local.load(other)
        assert there.meta == mine.meta
        for column, values in mine.samples.items():
            np.testing.assert_array_equal(there.samples[column], values)
    records = [{"run_id": "r0", "who": "me", "when": "now", "because": "wrong", "changes": {"repeat": 7}}]
    assert (a.amend("c00", records), b.amend("c00", records)) == (1, 2)
    assert [row["repeat"] for row in a.runs("c00") if row["run_id"] == "r0"] == [7]
    # More commits than between two summaries of the log.
    monkeypatch.setattr("dtwin.lake._log._SUMMARY", 3)
    for k in range(4):
        a.commit(*campaign(f"more-{k}"))
    assert len(b.campaigns()) == 6
    before = b.versions()["runs"] - 4
    assert {row["campaign"] for row in b.runs(at={"runs": before, "amendments": -1})} == {"c00", "c01"}


def test_writers_that_are_killed_at_random_lose_nothing_and_double_nothing(store: int, tmp_path: Path) -> None:
    count, rng = 2, np.random.default_rng(4)
    homes = [shared(tmp_path / f"pc{k}", store, "killed") for k in range(3)]

    def started(number: int) -> subprocess.Popen[bytes]:
        writer = Path(__file__).with_name("shared_writer.py")
        command = [sys.executable, str(writer), str(homes[number].root), str(number), str(count)]
        return subprocess.Popen(command, env=os.environ | KEYS, stdout=subprocess.DEVNULL)

    writers = [started(k) for k in range(3)]
    kills = 0
    while kills < 4:
        time.sleep(float(rng.uniform(0.3, 1.0)))
        number = int(rng.integers(3))
        # One that is over begins again, and finds all of it there.
        writers[number].kill()
        writers[number].wait()
        writers[number] = started(number)
        kills += 1
    assert [writer.wait(300) for writer in writers] == [0, 0, 0]
    lake = Lake(homes[0].lake)
    wanted = {*(f"of-{n}-{k}" for n in range(3) for k in range(count)), *(f"of-all-{k}" for k in range(count))}
    rows = lake.runs()
    assert Counter((row["campaign"], row["run_id"]) for row in rows) == Counter(
        (name, run) for name in wanted for run in ("r0", "r1")
    )
    for row in rows:
        run = next(run for run in campaign(row["campaign"])[1] if run.meta.run_id == row["run_id"])
        np.testing.assert_array_equal(lake.load(row).samples["deviation_um"], run.samples["deviation_um"])
    fourth = shared(tmp_path / "fourth", store, "killed")
    follow_shared(fourth)
    for number in range(3):
        for k in range(count):
            assert read_document(fourth.root / "twins" / f"twin-{number}" / f"v{k + 1:03d}.json")["twin"] == number
    lines = (fourth.root / "bundles" / "mill-a" / "promotions.jsonl").read_text().splitlines()
    assert Counter(lines) == Counter(json.dumps({"by": n, "version": k}) for n in range(3) for k in range(count))


def test_a_store_that_drops_conditions_is_refused_before_anything_is_written(
    store: int, proxy: StoreProxy, tmp_path: Path
) -> None:
    proxy.wrong = "no_conditions"
    home = shared(tmp_path / "a", proxy.port, "unsafe")
    with pytest.raises(StoreError, match="ignores the condition") as caught:
        Lake(home.lake).commit(*campaign("c"))
    assert "If-None-Match, If-Match" in (caught.value.got or "")
    assert caught.value.exit_code == 1
    (home.root / "twins" / "t").mkdir(parents=True)
    write_document(home.root / "twins" / "t" / "v001.json", {"a": 1}, "a twin")
    with pytest.raises(StoreError, match="ignores the condition"):
        follow_shared(home)
    assert Objects(shared(tmp_path / "b", store, "unsafe").file.bucket or pytest.fail("no store")).list() == []


@pytest.mark.parametrize(
    ("name", "value"), [("AWS_S3_ALLOW_UNSAFE_RENAME", "true"), ("AWS_CONDITIONAL_PUT", "disabled")]
)
def test_an_environment_that_asks_for_unsafe_commits_is_refused(
    store: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, value: str
) -> None:
    monkeypatch.setenv(name, value)
    with pytest.raises(InputError, match="without a condition") as caught:
        Lake(shared(tmp_path / "a", store, "renames").lake).commit(*campaign("c"))
    assert caught.value.where == name


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize(("wrong", "said"), [("away", "does not answer"), ("expired", "expired")])
def test_a_store_in_trouble_in_the_middle_leaves_nothing_half_and_the_next_try_goes_on(
    store: int, proxy: StoreProxy, tmp_path: Path, wrong: str, said: str
) -> None:
    home = shared(tmp_path / "a", proxy.port, f"trouble-{wrong}")
    lake = Lake(home.lake)
    lake.commit(*campaign("before"))
    reader = Lake(shared(tmp_path / "b", store, f"trouble-{wrong}").lake)
    finished = 0
    # After so many writes, wherever in the commit that is.
    for passed in (0, 2, 4) if wrong == "away" else (1,):
        name = f"c{passed}"
        proxy.wrong, proxy.passes = wrong, passed
        # A commit of fewer writes is over before it goes wrong.
        with contextlib.suppress(StoreError):
            lake.commit(*campaign(name))
            finished += 1
        proxy.wrong = ""
        assert all(Counter(r["campaign"] for r in reader.runs())[c] == 2 for c in reader.campaigns())
        assert lake.commit(*campaign(name)).added in ((), ("r0", "r1"))
        assert Counter(r["campaign"] for r in reader.runs())[name] == 2
    assert finished == 0
    twin = home.root / "twins" / "t" / "v001.json"
    write_document(twin, {"a": 1}, "a twin")
    proxy.wrong, proxy.passes = wrong, 0
    with pytest.raises(StoreError, match=said):
        follow_shared(home)
    assert read_document(twin) == {"a": 1}
    # Who serves a machine begins all the same.
    with followed_beside(home):
        pass
    proxy.wrong = ""
    follow_shared(home)
    other = shared(tmp_path / "c", store, f"trouble-{wrong}")
    follow_shared(other)
    assert read_document(other.root / "twins" / "t" / "v001.json") == {"a": 1}


@pytest.mark.usefixtures("impatient")
def test_a_list_of_a_store_that_never_ends_ends_what_reads_it(
    proxy: StoreProxy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = shared(tmp_path / "a", proxy.port, "endless")
    lake = Lake(home.lake)
    lake.commit(*campaign("before"))
    # One after the other: what the library began goes on until the store is gone.
    proxy.wrong = "again"
    with pytest.raises(StoreError, match="begins its list again") as caught:
        Objects(Bucket(home.file.store, home.file.endpoint)).list("lake/")
    assert caught.value.got == "a name twice"
    monkeypatch.setattr("dtwin.lake.delta._OPEN_S", 0.5)
    with pytest.raises(StoreError) as caught:
        lake.runs()
    assert caught.value.got == "the log was not read within 0.5 s"


@pytest.mark.long
def test_a_storm_of_refusals_and_lost_answers_is_outlived(store: int, proxy: StoreProxy, tmp_path: Path) -> None:
    lake = Lake(shared(tmp_path / "a", proxy.port, "storm").lake)
    lake.commit(*campaign("c0"))
    for number, wrong in enumerate(("busy", "away", "deaf", "slow"), start=1):
        proxy.wrong, proxy.left, proxy.only = wrong, 3, "PUT"
        lake.commit(*campaign(f"c{number}"))
        assert proxy.left == 0
    rows = Lake(shared(tmp_path / "b", store, "storm").lake).runs()
    assert Counter(row["campaign"] for row in rows) == dict.fromkeys([f"c{k}" for k in range(5)], 2)


def test_who_comes_second_with_the_same_version_is_told_and_loses_nothing(store: int, tmp_path: Path) -> None:
    a, b = (shared(tmp_path / who, store, "conflict") for who in "ab")
    for home, said in ((a, "first"), (b, "second")):
        write_document(home.root / "twins" / "t" / "v001.json", {"by": said}, "a twin")
    write_document(b.root / "twins" / "other" / "v001.json", {"by": "b"}, "a twin")
    follow_shared(a)
    with pytest.raises(StoreError, match="was first") as caught:
        follow_shared(b)
    assert "twins/t" in (caught.value.where or "")
    assert read_document(b.root / "twins" / "t" / "v001.json") == {"by": "first"}
    aside = next((b.root / "set-aside").glob("*/twins/t/v001.json"))
    assert read_document(aside) == {"by": "second"}
    follow_shared(b)
    follow_shared(a)
    assert read_document(a.root / "twins" / "other" / "v001.json") == {"by": "b"}
    # What does not contradict comes together: a receipt of one, a new version of the other; and what one took away is gone.
    write_document(a.root / "twins" / "t" / "v001.mlflow.json", {"x": 1}, "a receipt")
    write_document(b.root / "twins" / "t" / "v002.json", {"by": "second"}, "a twin")
    (b.root / "twins" / "other" / "v001.json").unlink()
    follow_shared(b)
    follow_shared(a)
    follow_shared(b)
    names = {"v001.json", "v001.mlflow.json", "v002.json"}
    for home in (a, b):
        assert {path.name for path in (home.root / "twins" / "t").iterdir()} == names
        assert not (home.root / "twins" / "other").exists()


def test_repair_leaves_what_another_computer_may_be_about_to_commit(
    store: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = shared(tmp_path / "a", store, "strays")
    lake = Lake(home.lake)
    lake.commit(*campaign("kept"))
    samples = Objects((home.file.bucket or pytest.fail("no store")) / "lake" / "samples")
    samples.put("killed/r0.0123456789abcdef01234567.parquet", b"half of a commit")
    assert lake.repair()["samples"] == 0
    assert samples.has("killed/r0.0123456789abcdef01234567.parquet")
    # The same a day later.
    monkeypatch.setattr("dtwin.lake._folders._STRAY_FOR", timedelta(seconds=-1))
    assert lake.repair()["samples"] == 1
    assert not samples.has("killed/r0.0123456789abcdef01234567.parquet")
    assert len(list(lake.iterate("kept"))) == 2


def test_repair_drops_content_that_no_list_names_any_more(
    store: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    a = shared(tmp_path / "a", store, "unnamed")
    bucket = a.file.bucket or pytest.fail("no store")
    for said in ("before", "now"):
        write_document(a.root / "twins" / "t" / "v001.json", {"by": said}, "a twin")
        follow_shared(a)
    assert len(Objects(bucket).list("content/")) == 2
    assert drop_unnamed_content(bucket) == 0, "another computer may be about to name it"
    # The same a week later.
    monkeypatch.setattr("dtwin.shared_documents._UNNAMED_FOR", timedelta(seconds=-1))
    assert drop_unnamed_content(bucket) == 1
    b = shared(tmp_path / "b", store, "unnamed")
    follow_shared(b)
    assert read_document(b.root / "twins" / "t" / "v001.json") == {"by": "now"}


def test_a_damaged_object_is_told_and_not_taken_over(store: int, tmp_path: Path) -> None:
    a = shared(tmp_path / "a", store, "damaged")
    write_document(a.root / "twins" / "t" / "v001.json", {"by": "a"}, "a twin")
    follow_shared(a)
    objects = Objects(a.file.bucket or pytest.fail("no store"))
    name = next(stored.name for stored in objects.list("content/"))
    objects.put(name, b"something else")
    b = shared(tmp_path / "b", store, "damaged")
    with pytest.raises(StoreError, match="missing or damaged"):
        follow_shared(b)
    assert not (b.root / "twins" / "t" / "v001.json").exists()
    # Names that no home would write: another's lock, a lone surrogate, one too long, a file that is a folder, too.
    for unit, names in (("t", ["v001.lock"]), ("t", ["\ud800.json"]), ("t", ["", "v001.json"]), ("t", ["../x"])):
        listed = json.dumps({"files": dict.fromkeys(names, "0" * 64)}).encode()
        objects.put(f"documents/twins/{unit}.json", listed)
        with pytest.raises(StoreError) as caught:
            follow_shared(b)
        assert caught.value.code == "shared.list"
        objects.delete([f"documents/twins/{unit}.json"])
    # What another version of dtwin shares stays as it is, and counts as named.
    objects.put(f"documents/fixtures/{'u' * 300}.json", json.dumps({"files": {"x": "0" * 64}}).encode())
    follow_shared(b)
    assert {"x": "0" * 64} in shared_units(b.file.bucket or pytest.fail("no store")).values()
    assert not (b.root / "fixtures").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<Code>RequestTimeTooSkewed</Code>", "clock"),
        ("<Code>AccessDenied</Code>", "does not let"),
        ("<Code>NoSuchBucket</Code>", "no such bucket"),
        ("status code: 503 <Code>SlowDown</Code>", "does not answer"),
        ("error sending request", "does not answer"),
        ("Error performing PUT http://169.254.169.254/latest/api/token: 403 Forbidden", "no credentials"),
    ],
)
def test_what_a_store_says_is_told_in_words(text: str, said: str) -> None:
    assert said in store_error(text, "s3://bucket").message


@pytest.mark.parametrize(
    ("stated", "wrong"),
    [
        ({"store": "s3://b-1/x"}, "registry"),
        ({"store": "a/folder", "registry": "http://h"}, "store"),
        ({"store": "s3://bucket/../x", "registry": "http://h"}, "store"),
        ({"flows": "mysql://h/d"}, "flows"),
        ({"flows": "postgresql://me:hunter2@h/d"}, "flows"),
        ({"registry": "postgresql://h/d"}, "registry"),
        ({"endpoint": "http://h"}, "endpoint"),
        ({"shop": "x"}, "home.toml"),
    ],
)
def test_settings_that_are_not_usable_are_refused(tmp_path: Path, stated: dict[str, str], wrong: str) -> None:
    write_toml(tmp_path / HOME_FILE, stated, "the settings")
    with pytest.raises(InputError) as caught:
        _ = Home(tmp_path).lake
    assert wrong in (caught.value.where or "")
    assert "hunter2" not in caught.value.render()
