"""What arrives in a folder is ingested once, whole, and only of a machine that is known."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from closed_loop import circles

from dtwin.acquire.arrivals import Arrivals
from dtwin.acquire.b5r import write_b5r
from dtwin.config import Home
from dtwin.errors import InputError, StoreError
from dtwin.lake.store import Lake
from dtwin.machine_record import keep_record
from dtwin.pipeline.watching import FolderWatch, WatchEvent, watch


@pytest.fixture
def home(tmp_path: Path) -> Home:
    return Home(tmp_path / "home")


@pytest.fixture
def inbox(tmp_path: Path) -> Path:
    made = tmp_path / "inbox"
    made.mkdir()
    return made


def ball_bar(path: Path, machine: str = "mill-a", seed: int = 0) -> Path:
    runs = circles(["", ""][:1], seed=seed)
    whole = [r.__class__(r.meta, r.samples, window=(0, 360)) for r in runs]
    write_b5r(path, whole, name=path.stem, machine=machine)
    return path


def looked(folder_watch: FolderWatch) -> list[tuple[str, str]]:
    return [(Path(e.path).name, e.outcome) for e in folder_watch.look()]


def test_a_file_is_ingested_once(home: Home, inbox: Path) -> None:
    seen = FolderWatch(inbox, home, ["mill-a"], settle_s=0.0)
    assert looked(seen) == []
    ball_bar(inbox / "first.b5r")
    assert looked(seen) == [("first.b5r", "ingested")]
    assert looked(seen) == []
    assert [row["campaign"] for row in Lake(home.lake).runs()] == ["first", "first"]


def test_a_name_that_is_no_text_is_left_where_it_is_and_the_watch_goes_on(home: Home, inbox: Path) -> None:
    ball_bar(inbox / "a.b5r").rename(inbox / os.fsdecode(b"Pr\xfcf.b5r"))
    (inbox / "camp").mkdir()
    (inbox / "camp" / "campaign.toml").write_text("")
    (inbox / "camp" / os.fsdecode(b"\xfc.jpg")).write_bytes(b"")
    ball_bar(inbox / "z.b5r", seed=1)
    seen = FolderWatch(inbox, home, ["mill-a"], settle_s=0.0)
    assert [outcome for _, outcome in looked(seen)] == ["not accepted", "not accepted", "ingested"]
    assert looked(FolderWatch(inbox, home, ["mill-a"], settle_s=0.0)) == []


def test_a_pipe_or_a_device_is_never_opened(home: Home, inbox: Path) -> None:
    os.mkfifo(inbox / "pipe.b5r")
    (inbox / "endless.csv").symlink_to("/dev/zero")
    (inbox / "camp").mkdir()
    os.mkfifo(inbox / "camp" / "campaign.toml")
    assert looked(FolderWatch(inbox, home, ["mill-a"], settle_s=0.0)) == []


def test_a_file_that_is_still_written_is_waited_for(home: Home, inbox: Path) -> None:
    """Size and time must stand still, and the reader must accept it."""
    now_s = [0.0]
    arrivals = Arrivals(inbox, 5.0, lambda path: True, clock=lambda: now_s[0])
    whole = ball_bar(inbox.parent / "whole.b5r").read_bytes()
    path = inbox / "slow.b5r"
    for share in (0.2, 0.5, 1.0):
        path.write_bytes(whole[: int(share * len(whole))])
        os.utime(path, ns=(0, 10**9 * int(10 * share)))
        now_s[0] += 3.0
        assert arrivals.look() == []
    now_s[0] += 4.9
    assert arrivals.look() == []
    assert arrivals.moving == 1
    now_s[0] += 0.2
    assert [a.path for a in arrivals.look()] == [path]
    # Whoever pauses in the middle for longer than that is told off by the reader, and read again.
    seen = FolderWatch(inbox, home, ["mill-a"], settle_s=0.0)
    path.write_bytes(whole[: len(whole) // 2])
    assert looked(seen) == [("slow.b5r", "not accepted")]
    assert looked(seen) == []
    path.write_bytes(whole)
    assert looked(seen) == [("slow.b5r", "ingested")]


def test_the_same_content_under_another_name_is_unchanged(home: Home, inbox: Path) -> None:
    seen = FolderWatch(inbox, home, ["mill-a"], settle_s=0.0)
    first = ball_bar(inbox / "first.b5r")
    assert looked(seen) == [("first.b5r", "ingested")]
    shutil.copy(first, inbox / "first (1).b5r")
    (event,) = seen.look()
    assert (event.outcome, event.message) == ("unchanged", f"the same as {first}")
    os.utime(first)
    assert looked(seen) == [("first.b5r", "unchanged")]
    assert Lake(home.lake).campaigns() == ["first"]


def test_a_file_of_an_unknown_machine_stays_where_it_is(home: Home, inbox: Path) -> None:
    seen = FolderWatch(inbox, home, ["mill-a"], settle_s=0.0)
    strange = ball_bar(inbox / "strange.b5r", machine="mill-b")
    content = strange.read_bytes()
    (event,) = seen.look()
    assert event.outcome == "unknown machine"
    assert "--machine mill-b" in event.message
    assert strange.read_bytes() == content
    assert Lake(home.lake).campaigns() == []
    assert looked(seen) == []
    # Named later, recorded, or known to the lake by then, it is taken.
    keep_record(home, "mill-c", {})
    ball_bar(inbox / "recorded.b5r", machine="mill-c")
    again = FolderWatch(inbox, home, ["mill-b"], settle_s=0.0)
    assert sorted(looked(again)) == [("recorded.b5r", "ingested"), ("strange.b5r", "ingested")]


def test_a_restart_takes_nothing_twice(home: Home, inbox: Path) -> None:
    ball_bar(inbox / "first.b5r")
    assert looked(FolderWatch(inbox, home, ["mill-a"], 0.0)) == [("first.b5r", "ingested")]
    assert looked(FolderWatch(inbox, home, ["mill-a"], 0.0)) == []
    (state,) = (home.root / "watch").glob("*.json")
    state.write_text("{damaged")
    # Without its memory it looks again; the lake knows its runs.
    assert looked(FolderWatch(inbox, home, ["mill-a"], 0.0)) == [("first.b5r", "unchanged")]
    assert len(Lake(home.lake).runs()) == 2


def test_a_share_that_goes_is_said_once_and_comes_back(home: Home, inbox: Path) -> None:
    seen = FolderWatch(inbox, home, ["mill-a"], settle_s=0.0)
    ball_bar(inbox / "first.b5r")
    assert looked(seen) == [("first.b5r", "ingested")]
    away = inbox.rename(inbox.with_name("away"))
    assert [outcome for _, outcome in looked(seen)] == ["not reachable"]
    assert looked(seen) == []
    ball_bar(away / "second.b5r", seed=1)
    away.rename(inbox)
    assert looked(seen) == [("second.b5r", "ingested")]


def test_a_campaign_folder_is_one_thing_and_may_grow(home: Home, inbox: Path) -> None:
    folder = inbox / "march"
    folder.mkdir()
    table = "t_s,angle_deg,deviation_um\n" + "".join(
        f"{t:.3f},{6.0 * t:.3f},{np.cos(t):.4f}\n" for t in np.linspace(0.0, 60.0, 400)
    )
    head = '[campaign]\nname = "march"\nmachine = "mill-a"\n'
    run = (
        '[[run]]\nid = "r{0}"\nfile = "r{0}.csv"\nplane = "XY"\nradius_mm = 50.0\n'
        'feed_mm_min = 314.0\ndirection = "CCW"\n'
    )
    (folder / "r1.csv").write_text(table)
    (folder / "r2.csv").write_text(table.replace("0.5403", "0.5404"))
    (folder / "campaign.toml").write_text(head + run.format(1))
    seen = FolderWatch(inbox, home, ["mill-a"], settle_s=0.0)
    assert looked(seen) == [("march", "ingested")]
    # While somebody records into it, it is left alone.
    intent = folder / "r2.intent.json"
    intent.write_text("{}")
    (folder / "campaign.toml").write_text(head + run.format(1) + run.format(2))
    assert looked(seen) == []
    intent.unlink()
    (event,) = seen.look()
    assert "1 runs added, 1 unchanged" in event.message
    (folder / "notes.tmp").write_text("a copy that goes on")
    assert looked(seen) == []


def test_two_watches_of_one_folder_are_one_too_many(home: Home, inbox: Path) -> None:
    told: list[WatchEvent] = []
    ball_bar(inbox / "first.b5r")
    first = FolderWatch(inbox, home, ["mill-a"], settle_s=0.0)
    with first.alone(), pytest.raises(StoreError, match="watched already"):
        watch(FolderWatch(inbox, home), told.append, lambda s: True, every_s=1.0)
    watch(first, told.append, lambda s: False, every_s=0.0, once=True)
    assert [event.outcome for event in told] == ["ingested"]


def test_there_must_be_a_folder(home: Home, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        FolderWatch(tmp_path / "nowhere", home)
