from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from dtwin.acquire.b5r import read_b5r
from dtwin.acquire.signal_files import read_signals, write_signals
from dtwin.errors import InputError, StoreError
from dtwin.lake.delta import DeltaFiles
from dtwin.lake.parquet import read_parquet, table_of, write_parquet
from dtwin.lake.store import Lake, RejectedRows
from dtwin.schema import Campaign, Run, RunMeta, SignalGroup

CAMPAIGN = Campaign("c", "mill-a", machine_geometry={"type": "ur10e"}, instrument={"nominal_mm": 100.0})


def make_run(run_id: str, seed: int = 0, n: int = 400) -> Run:
    rng = np.random.default_rng(seed)
    samples = {"t_s": np.arange(n) / 200.0, "angle_deg": np.linspace(0, 360, n), "deviation_um": rng.normal(size=n)}
    signals = SignalGroup("accelerometers", 1651.6, {"wrist_x_g": rng.normal(size=3 * n).astype("f4")}, 0.2)
    meta = RunMeta(
        run_id,
        plane="XY",
        direction="CCW",
        radius_mm=100.0,
        feed_mm_min=2000.0,
        sample_rate_hz=200.0,
        covariates={"temperature_c": 20.5},
        vendor={"centre_a_um": 1.0},
    )
    return Run(meta, samples, (10, 380), (signals,), "somewhere.b5r")


def test_a_run_comes_back_as_it_went_in(tmp_path: Path) -> None:
    lake, run = Lake(tmp_path / "lake"), make_run("r1")
    report = lake.commit(CAMPAIGN, [run])
    assert report.added == ("r1",)
    back = lake.load(lake.runs("c")[0])
    assert back.meta == run.meta
    assert back.window == run.window
    for name, values in run.samples.items():
        np.testing.assert_array_equal(back.samples[name], values)
    np.testing.assert_array_equal(back.signals[0].columns["wrist_x_g"], run.signals[0].columns["wrist_x_g"])
    assert back.signals[0].columns["wrist_x_g"].dtype == np.float32
    assert back.signals[0].start_s == 0.2
    assert lake.campaign("c").machine_geometry == {"type": "ur10e"}


def test_a_repeated_commit_changes_nothing_and_a_changed_run_is_refused(tmp_path: Path) -> None:
    lake = Lake(tmp_path / "lake")
    first = lake.commit(CAMPAIGN, [make_run("r1"), make_run("r2", 1)])
    again = lake.commit(CAMPAIGN, [make_run("r1"), make_run("r2", 1)])
    assert again.added == ()
    assert again.versions == first.versions
    with pytest.raises(InputError, match="other content") as caught:
        lake.commit(CAMPAIGN, [make_run("r1", seed=9), make_run("r3", 2)])
    assert "r1" in (caught.value.got or "")
    assert [row["run_id"] for row in lake.runs("c")] == ["r1", "r2"]


def test_the_same_id_twice_in_one_commit_is_refused(tmp_path: Path) -> None:
    lake = Lake(tmp_path / "lake")
    with pytest.raises(InputError, match="occurs twice"):
        lake.commit(CAMPAIGN, [make_run("r1"), make_run("r1", 1)])
    assert lake.runs() == []


@pytest.mark.parametrize("name", ["../x", "a/b", "", ".hidden", "a\x00b", "x" * 300, "..", "%2e%2e", "a b"])
def test_names_cannot_leave_the_lake(tmp_path: Path, name: str) -> None:
    lake = Lake(tmp_path / "lake")
    with pytest.raises(InputError):
        lake.commit(replace(CAMPAIGN, name=name), [make_run("r1")])
    with pytest.raises(InputError):
        lake.commit(CAMPAIGN, [make_run(name)])
    assert not (tmp_path / "lake").exists() or lake.runs() == []


def test_columns_may_grow_but_not_change_their_type(tmp_path: Path) -> None:
    lake, plain = Lake(tmp_path / "lake"), make_run("r1")
    lake.commit(CAMPAIGN, [plain])
    warm = make_run("r2", 1)
    warm = replace(warm, samples=dict(warm.samples) | {"spindle_c": np.full(400, 21.0)})
    lake.commit(CAMPAIGN, [warm])
    assert "spindle_c" in lake.load(lake.runs("c")[1]).samples
    other = make_run("r3", 2)
    other = replace(other, samples=dict(other.samples) | {"spindle_c": np.full(400, "warm", dtype=object)})
    with pytest.raises(StoreError, match="changed its type"):
        lake.commit(CAMPAIGN, [other])
    assert len(lake.runs("c")) == 2


def test_rejected_rows_are_kept_with_the_reason(tmp_path: Path) -> None:
    lake = Lake(tmp_path / "lake")
    rows = [{"row": 3, "reason": "not finite: deviation_um", "values": {"deviation_um": "nan"}}]
    lake.commit(CAMPAIGN, [make_run("r1")], [RejectedRows("r1", "a.csv", rows)])
    kept = lake.tables["rejects"].read().to_pylist()
    assert [(r["run_id"], r["row"], r["reason"]) for r in kept] == [("r1", 3, "not finite: deviation_um")]


def test_every_flipped_bit_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "x.parquet"
    rng = np.random.default_rng(5)
    columns = {"a_mm": rng.normal(size=5000), "b_g": rng.normal(size=5000).astype("f4")}
    write_parquet(path, table_of(columns))
    clean = path.read_bytes()
    whole = read_parquet(path)
    silent = 0
    for _ in range(60):
        damaged = bytearray(clean)
        damaged[int(rng.integers(8, len(clean) - 2000))] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            silent += not read_parquet(path).equals(whole)
        except StoreError:
            continue
    assert silent == 0


def test_units_travel_in_the_file(tmp_path: Path) -> None:
    write_parquet(tmp_path / "x.parquet", table_of({"a_mm": np.zeros(3)}))
    field = read_parquet(tmp_path / "x.parquet").schema.field("a_mm")
    assert field.metadata[b"unit"] == b"mm"


def test_a_failed_write_leaves_nothing(tmp_path: Path) -> None:
    target = tmp_path / "folder" / "x.parquet"
    target.parent.mkdir()
    target.mkdir()
    with pytest.raises(StoreError):
        write_parquet(target, table_of({"a_mm": np.zeros(3)}))
    assert [p.name for p in target.parent.iterdir()] == ["x.parquet"]


def test_a_read_only_lake_is_named(tmp_path: Path) -> None:
    blocked = tmp_path / "lake"
    blocked.write_text("a file where the lake should be")
    with pytest.raises(StoreError):
        Lake(blocked).commit(CAMPAIGN, [make_run("r1")])
    assert blocked.read_text() == "a file where the lake should be"


def test_a_full_disk_leaves_the_lake_as_it_was(tmp_path: Path) -> None:
    if os.geteuid() != 0 or shutil.which("mount") is None:
        pytest.skip("mounting a small file system needs root")
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "none", str(disk)], check=False)
    if mounted.returncode:
        pytest.skip("this sandbox does not mount file systems")
    try:
        lake = Lake(disk / "lake")
        lake.commit(CAMPAIGN, [make_run("r1")])
        with pytest.raises(StoreError) as full:
            lake.commit(CAMPAIGN, [make_run(f"big{i}", i, 60_000) for i in range(4)])
        assert "dtwin repair frees" in str(full.value.hint)
        assert [row["run_id"] for row in lake.runs()] == ["r1"]
        assert list((disk / "lake").rglob("*.partial")) == []
        np.testing.assert_array_equal(
            lake.load(lake.runs()[0]).samples["deviation_um"], make_run("r1").samples["deviation_um"]
        )
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_a_read_notices_a_missing_file(tmp_path: Path) -> None:
    lake = Lake(tmp_path / "lake")
    lake.commit(CAMPAIGN, [make_run("r1")])
    row = lake.runs()[0]
    (tmp_path / "lake" / "samples" / row["samples_file"]).unlink()
    with pytest.raises(StoreError, match="missing or damaged"):
        lake.load(row)
    # A pipe of that name would be waited for.
    os.mkfifo(tmp_path / "lake" / "samples" / row["samples_file"])
    with pytest.raises(StoreError, match="missing or damaged"):
        lake.load(row)


def test_two_writers_at_once_lose_nothing_and_double_nothing(tmp_path: Path) -> None:
    def write(numbers: list[int]) -> None:
        lake = Lake(tmp_path / "lake")
        for number in numbers:
            lake.commit(CAMPAIGN, [make_run(f"r{number}", number)])

    with ThreadPoolExecutor(3) as pool:
        jobs = [pool.submit(write, n) for n in ([1, 2, 3], [3, 2, 1], [4, 5, 1])]
        for job in jobs:
            job.result()
    assert sorted(row["run_id"] for row in Lake(tmp_path / "lake").runs()) == ["r1", "r2", "r3", "r4", "r5"]


_INGEST = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from test_store import CAMPAIGN, make_run
from dtwin.lake.store import Lake
lake = Lake(Path({root!r}))
print("ready", flush=True)
for i in range(40):
    lake.commit(CAMPAIGN, [make_run(f"r{{i}}", i, 4000)])
"""


@pytest.mark.parametrize("delay_s", [0.02, 0.11, 0.23, 0.4])
def test_a_kill_at_any_moment_leaves_whole_runs_only(tmp_path: Path, delay_s: float) -> None:
    root = tmp_path / "lake"
    code = _INGEST.format(tests=str(Path(__file__).parent), root=str(root))
    child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert child.stdout is not None
    child.stdout.readline()
    try:
        child.wait(delay_s)
    except subprocess.TimeoutExpired:
        child.send_signal(signal.SIGKILL)
    child.wait()
    child.stdout.close()
    lake = Lake(root)
    for row in lake.runs():
        number = int(row["run_id"][1:])
        np.testing.assert_array_equal(
            lake.load(row).samples["deviation_um"], make_run(row["run_id"], number, 4000).samples["deviation_um"]
        )
    lake.repair()
    live = {row["samples_file"] for row in lake.runs()}
    assert set(lake.tables["samples"].files()) == live
    lake.commit(CAMPAIGN, [make_run(f"r{i}", i, 4000) for i in range(40)])
    assert len(lake.runs()) == 40


def test_a_model_can_be_rebuilt_from_its_table_version(tmp_path: Path, real_recording: Path) -> None:
    lake = Lake(tmp_path / "lake")
    versions = lake.commit(CAMPAIGN, read_b5r(real_recording).runs).versions
    before = lake.tables["samples"].files()
    lake.commit(replace(CAMPAIGN, name="later"), [make_run("r1")])
    assert lake.tables["samples"].files(versions["samples"]) == before
    assert pa.types.is_float64(lake.tables["samples"].read_file(before[0]).schema.field("deviation_um").type)


def kept_file(lake: Lake) -> Path:
    (path,) = (lake.root / "signals" / "c").glob("*.parquet")
    return path


def test_a_signal_file_with_checksums_is_kept_as_it_is(tmp_path: Path) -> None:
    run, source = make_run("r1"), tmp_path / "r1.accelerometers.parquet"
    write_signals(source, run.signals[0])
    lake = Lake(tmp_path / "lake")
    lake.commit(CAMPAIGN, [replace(run, signals=tuple(read_signals(source)))])
    assert kept_file(lake).read_bytes() == source.read_bytes()
    (back,) = lake.load(lake.runs("c")[0]).signals
    np.testing.assert_array_equal(back.columns["wrist_x_g"], run.signals[0].columns["wrist_x_g"], strict=True)


def test_changed_columns_are_never_kept_as_the_file_they_came_from(tmp_path: Path) -> None:
    run, source = make_run("r1"), tmp_path / "r1.accelerometers.parquet"
    write_signals(source, run.signals[0])
    (group,) = read_signals(source)
    doubled = {name: 2 * values for name, values in group.columns.items()}
    lake = Lake(tmp_path / "lake")
    lake.commit(CAMPAIGN, [replace(run, signals=(replace(group, columns=doubled),))])
    (back,) = lake.load(lake.runs("c")[0]).signals
    np.testing.assert_array_equal(back.columns["wrist_x_g"], doubled["wrist_x_g"])


def test_a_file_without_page_checksums_gets_them_in_the_lake(tmp_path: Path) -> None:
    run, source = make_run("r1", n=20_000), tmp_path / "r1.accelerometers.parquet"
    columns = {"t_s": np.arange(60_000) / 1651.6, **run.signals[0].columns}
    pq.write_table(pa.table(columns), source)
    lake = Lake(tmp_path / "lake")
    lake.commit(CAMPAIGN, [replace(run, signals=tuple(read_signals(source)))])
    kept = kept_file(lake)
    data = bytearray(kept.read_bytes())
    data[len(data) // 2] ^= 1
    kept.write_bytes(data)
    with pytest.raises(StoreError, match="damaged"):
        lake.load(lake.runs("c")[0])


ESCAPES = ["x/../../../../PWNED", "x/../../../samples/victim/r0", "a/b", "..", "", "a\x00b", "x" * 200]


@pytest.mark.parametrize("name", ESCAPES)
def test_the_name_of_a_signal_group_cannot_leave_the_lake(tmp_path: Path, name: str) -> None:
    run, source = make_run("r1"), tmp_path / "r1.accelerometers.parquet"
    write_signals(source, replace(run.signals[0], name=name))
    with pytest.raises(InputError, match="not a usable name"):
        read_signals(source)
    lake = Lake(tmp_path / "deep" / "lake")
    with pytest.raises(InputError, match="not a usable name"):
        lake.commit(CAMPAIGN, [replace(run, signals=(replace(run.signals[0], name=name),))])
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == [source]


@pytest.mark.parametrize("name", ["../x.0123456789abcdef01234567.parquet", "x.parquet", "..parquet"])
def test_a_name_that_a_row_gives_is_a_file_of_its_table(tmp_path: Path, name: str) -> None:
    lake = Lake(tmp_path / "lake")
    lake.commit(CAMPAIGN, [make_run("r1")])
    with pytest.raises(StoreError, match="no name of a data file"):
        lake.load({**lake.runs()[0], "samples_file": name})


def test_nothing_is_written_before_the_whole_run_is_accepted(tmp_path: Path) -> None:
    lake, run = Lake(tmp_path / "lake"), make_run("r1")
    odd = SignalGroup("odd", 100.0, {"x_g": np.array([1 + 2j, 3 + 4j])})
    with pytest.raises((StoreError, pa.ArrowException)):
        lake.commit(CAMPAIGN, [replace(run, signals=(odd,))])
    strange = SignalGroup("odd", 100.0, {"n_1": np.array([1, 2], dtype="u8")})
    with pytest.raises(StoreError, match="does not keep"):
        lake.commit(CAMPAIGN, [replace(run, signals=(strange,))])
    assert list((tmp_path / "lake").rglob("*.parquet")) == []


def test_a_replaced_data_file_is_refused(tmp_path: Path) -> None:
    lake = Lake(tmp_path / "lake")
    lake.commit(CAMPAIGN, [make_run("r1")])
    row = lake.runs()[0]
    forged = dict(make_run("r1").samples) | {"deviation_um": np.full(400, 42.0)}
    write_parquet(lake.root / "samples" / row["samples_file"], table_of(forged))
    with pytest.raises(StoreError, match="damaged"):
        lake.load(row)


def test_a_commit_is_one_file_and_each_run_a_part_of_it(tmp_path: Path) -> None:
    lake, runs = Lake(tmp_path / "lake"), [make_run(f"r{i}", i, 60 + i) for i in range(12)]
    lake.commit(CAMPAIGN, runs)
    for table in ("runs", "samples", "signals"):
        assert len(lake.tables[table].files()) == 1
    for row, run in zip(lake.runs(), sorted(runs, key=lambda r: r.meta.run_id), strict=True):
        loaded = lake.load(row)
        np.testing.assert_array_equal(loaded.samples["deviation_um"], run.samples["deviation_um"])
        np.testing.assert_array_equal(loaded.signals[0].columns["wrist_x_g"], run.signals[0].columns["wrist_x_g"])
    with pytest.raises(StoreError):
        lake.load({**lake.runs()[0], "samples_file": f"{lake.tables['samples'].files()[0]}#12"})
    (file,) = (lake.root / "samples").rglob("*.parquet")
    whole = file.read_bytes()
    file.write_bytes(whole[:100])
    lake.commit(CAMPAIGN, runs)
    assert file.read_bytes() == whole
    assert lake.repair()["samples"] == 0


def test_runs_of_one_campaign_or_machine_do_not_read_those_of_others(tmp_path: Path) -> None:
    lake = Lake(tmp_path / "lake")
    for name, machine in (("a", "m1"), ("b", "m2"), ("c", "m2"), ("d", "m3")):
        lake.commit(replace(CAMPAIGN, name=name, machine=machine), [make_run("r1"), make_run("r2", 2)])
    lake.amend(
        "d",
        [{"run_id": r, "who": "w", "when": "t", "because": "x", "changes": {"machine": "m2"}} for r in ("r1", "r2")],
    )
    assert lake.campaigns() == ["a", "b", "c", "d"]
    assert {row["campaign"] for row in lake.runs(machine="m2")} == {"b", "c", "d"}
    assert {row["campaign"] for row in lake.runs(machine=("m1", "m3", "m4"))} == {"a"}
    assert {row["campaign"] for row in lake.runs(("a", "b", "e"), machine=["m1", "m2"])} == {"a", "b"}
    assert lake.runs(machine="m3") == []
    (others,) = (file for file in lake.tables["runs"].files() if file.startswith("a/"))
    (lake.root / "runs" / others).unlink()
    assert len(lake.runs("b")) == 2
    assert len(lake.runs(machine="m2")) == 6
    with pytest.raises(StoreError):
        lake.runs()


def test_the_log_is_summed_up_and_goes_on(tmp_path: Path) -> None:
    lake = Lake(tmp_path / "lake")
    for number in range(12):
        lake.commit(replace(CAMPAIGN, name=f"c{number}"), [make_run("r1", number)])
    assert list((lake.root / "runs" / "_delta_log").glob("*.checkpoint.parquet"))
    assert len(lake.campaigns()) == 12


def test_few_summaries_of_the_log_stay_and_every_version_can_be_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dtwin.lake._log._KEPT_EVERY", 40)
    table = DeltaFiles(tmp_path / "table")
    log = tmp_path / "table" / "_delta_log"
    names = []
    for number in range(105):
        rows = pa.table({"a": [f"row {number}"]})
        names.append(table.write(f"f{number:03d}", rows))
        table.commit(names[-1:], rows.schema)
        for entry in log.iterdir():
            # Older than any rule by which readers and writers of Delta expire a log.
            os.utime(entry, (0, 0))
    assert sorted(int(p.name[:20]) for p in log.glob("*.checkpoint.parquet")) == [39, 79, 89, 99]
    assert len(list(log.glob("*.json"))) == 106
    for version in range(106):
        assert table.files(version) == [name.name for name in names[:version]]
    assert table.version() == 105
    for lie in (
        b"",
        b"{}",
        b'{"version": "x"}',
        b'{"version": 9999}',
        b'{"version": 1e999}',
        b"[1]",
        b'{"version": -1}',
    ):
        (log / "_last_checkpoint").write_bytes(lie)
        assert table.version() == 105


def test_a_damaged_or_missing_file_is_written_again_from_its_source(tmp_path: Path) -> None:
    lake, run = Lake(tmp_path / "lake"), make_run("r1")
    lake.commit(CAMPAIGN, [run])
    row = lake.runs()[0]
    (lake.root / "samples" / row["samples_file"]).write_bytes(b"PAR1")
    kept_file(lake).unlink()
    assert lake.commit(CAMPAIGN, [run]).unchanged == ("r1",)
    np.testing.assert_array_equal(lake.load(row).samples["t_s"], run.samples["t_s"])


def test_no_flip_in_any_file_of_a_lake_is_silent(tmp_path: Path) -> None:
    lake = Lake(tmp_path / "lake")
    for name in ("c", "d"):
        lake.commit(replace(CAMPAIGN, name=name), [make_run(f"r{i}", i, 60) for i in range(3)])
    lake.amend("c", [{"run_id": "r1", "who": "a", "when": "b", "because": "c", "changes": {"setup": "s9"}}])

    def everything() -> str:
        rows = lake.runs(left_out=True)
        return repr([(row, lake.load(row)) for row in rows])

    whole, rng = everything(), np.random.default_rng(7)
    files = [p for p in lake.root.rglob("*") if p.is_file() and p.stat().st_size]
    silent = noticed = 0
    for _ in range(160):
        path = files[int(rng.integers(len(files)))]
        clean = path.read_bytes()
        damaged = bytearray(clean)
        damaged[int(rng.integers(len(clean)))] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            silent += everything() != whole
        except StoreError:
            noticed += 1
        path.write_bytes(clean)
    assert silent == 0
    assert noticed > 80


def test_the_content_of_a_run_is_all_that_was_stated(tmp_path: Path) -> None:
    lake, run = Lake(tmp_path / "lake"), make_run("r1")
    lake.commit(CAMPAIGN, [run])
    group = run.signals[0]
    stated = {
        "instrument.nominal_mm: 100.0 -> 100.015": (replace(CAMPAIGN, instrument={"nominal_mm": 100.015}), run),
        "machine: mill-a -> mill-b": (replace(CAMPAIGN, machine="mill-b"), run),
        "geometry.chain: None -> XZY": (replace(CAMPAIGN, machine_geometry={"type": "ur10e", "chain": "XZY"}), run),
        "window_start: 10 -> 20": (CAMPAIGN, replace(run, window=(20, 380))),
        "the signals": (CAMPAIGN, replace(run, signals=(replace(group, rate_hz=25600.0),))),
        "the samples": (CAMPAIGN, make_run("r1", seed=9)),
    }
    for told, (campaign, other) in stated.items():
        with pytest.raises(InputError, match="other content") as caught:
            lake.commit(campaign, [other])
        assert told in str(caught.value.got)
    late = replace(run, signals=(replace(group, start_s=5.0),))
    with pytest.raises(InputError, match="other content"):
        lake.commit(CAMPAIGN, [late])
    with pytest.raises(InputError, match="another machine") as caught:
        lake.commit(replace(CAMPAIGN, machine="mill-b"), [make_run("r2", 1)])
    assert "mill-a -> mill-b" in str(caught.value.got)


def test_two_groups_of_one_name_are_refused(tmp_path: Path) -> None:
    lake, run = Lake(tmp_path / "lake"), make_run("r1")
    twice = (run.signals[0], replace(run.signals[0], rate_hz=500.0))
    with pytest.raises(InputError, match="have one name"):
        lake.commit(CAMPAIGN, [replace(run, signals=twice)])


def test_no_campaign_fixes_the_width_of_a_column_for_the_others(tmp_path: Path) -> None:
    lake, run = Lake(tmp_path / "lake"), make_run("r1")
    for i, kind in enumerate(("f8", "f4", "i4", "i8")):
        values = np.arange(30).astype(kind)
        wide = SignalGroup("accelerometers", 1000.0, {"wrist_x_g": values})
        lake.commit(replace(CAMPAIGN, name=f"c{i}"), [replace(run, signals=(wide,))])
        back = lake.load(lake.runs(f"c{i}")[0]).signals[0].columns["wrist_x_g"]
        np.testing.assert_array_equal(back, values, strict=True)
    from deltalake import DeltaTable

    seen = DeltaTable(lake.root / "signals").to_pyarrow_table()
    assert seen.num_rows == 120
    assert pa.types.is_float64(seen.schema.field("wrist_x_g").type)


def test_a_first_commit_that_a_full_disk_ended_locks_nothing(tmp_path: Path) -> None:
    lake = Lake(tmp_path / "lake")
    lake.commit(CAMPAIGN, [make_run("r0", 0)])
    table = DeltaFiles(lake.root / "rejects")
    table.write("mill", pa.table({"a": ["x"]}))
    (lake.root / "rejects" / "_delta_log").mkdir()
    assert (table.version(), table.files()) == (-1, [])
    assert [row["run_id"] for row in lake.runs()] == ["r0"]
    assert lake.repair()["rejects"] == 1
    written = table.write("mill", rows := pa.table({"a": ["y"]}))
    assert table.commit([written], rows.schema) == 1
    # Entries without the first one are a log that is damaged, not one that has not begun.
    (lake.root / "rejects" / "_delta_log" / f"{0:020d}.json").unlink()
    with pytest.raises(StoreError, match="log of a table is damaged"):
        table.files()


def test_a_cut_log_entry_is_an_error_that_repair_mends(tmp_path: Path) -> None:
    lake = Lake(tmp_path / "lake")
    for i in range(3):
        lake.commit(CAMPAIGN, [make_run(f"r{i}", i)])
    (lake.root / "runs" / "_delta_log" / f"{3:020d}.json").write_text("")
    with pytest.raises(StoreError, match="log of a table is damaged") as caught:
        lake.runs()
    assert "dtwin repair" in str(caught.value.hint)
    assert lake.repair()["log"] == [f"runs/_delta_log/{3:020d}.json"]
    assert [row["run_id"] for row in lake.runs()] == ["r0", "r1"]
    assert lake.commit(CAMPAIGN, [make_run("r2", 2)]).added == ("r2",)


@pytest.mark.parametrize(
    "needs",
    [
        '"minReaderVersion":9,"minWriterVersion":9',
        '"minReaderVersion":3,"minWriterVersion":7,"readerFeatures":["x"],"writerFeatures":["x"]',
        '"minReaderVersion":1,"minWriterVersion":7,"writerFeatures":["x"]',
    ],
)
def test_a_lake_that_needs_a_newer_program_is_not_called_damaged_or_busy(tmp_path: Path, needs: str) -> None:
    Lake(tmp_path / "lake").commit(CAMPAIGN, [make_run("r0")])
    log = tmp_path / "lake" / "runs" / "_delta_log" / f"{0:020d}.json"
    log.write_text(re.sub(r'"protocol":\{[^}]*\}', f'"protocol":{{{needs}}}', log.read_text()))
    with pytest.raises(StoreError) as caught:
        Lake(tmp_path / "lake").commit(CAMPAIGN, [make_run("r1", 1)])
    assert caught.value.code == "store.newer"


def test_what_was_added_is_synced_file_log_and_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: set[Path] = set()
    real = os.fsync
    monkeypatch.setattr(os, "fsync", lambda fd: synced.add(Path(f"/proc/self/fd/{fd}").readlink()) or real(fd))
    lake = Lake(tmp_path / "lake")
    lake.commit(CAMPAIGN, [make_run("r1")])
    files = {p for p in lake.root.rglob("*") if p.is_file() and not p.name.startswith(".")}
    logs = {p for p in files if p.suffix == ".json" and p.stem.endswith("1")}
    folders = {p.parent for p in files}
    assert len(logs) == 3
    assert logs | folders | {lake.root, tmp_path} <= synced
    partials = [p for p in synced if p.name.endswith(".partial")]
    assert len(partials) == len([p for p in files if p.suffix == ".parquet"])


def test_repair_sweeps_every_table(tmp_path: Path) -> None:
    lake = Lake(tmp_path / "lake")
    lake.commit(
        CAMPAIGN,
        [make_run("r1")],
        [RejectedRows("r1", "a.csv", [{"row": 3, "reason": "not finite", "values": {"deviation_um": "nan"}}])],
    )
    lake.write_table("features", "key", table_of({"a_mm": np.zeros(3)}))
    kept = sorted(p for p in lake.root.rglob("*.parquet"))
    for name in ("runs", "samples", "signals", "features", "rejects"):
        (lake.root / name / ".x.1.partial").write_text("half")
        (lake.root / name / f"stray.{'0' * 24}.parquet").write_text("stray")
    assert lake.repair() == dict.fromkeys(lake.tables, 2) | {"amendments": 0, "log": []}
    assert lake.repair() == dict.fromkeys(lake.tables, 0) | {"log": []}
    assert sorted(p for p in lake.root.rglob("*.parquet")) == kept
    assert not list(lake.root.rglob("*.partial"))


def test_a_refusal_of_the_storage_is_one_line_without_colours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError("Generic error\n  \x1b[31m↳\x1b[0m Unable to copy\n  \x1b[31m↳\x1b[0m No space left on device")

    monkeypatch.setattr("dtwin.lake.delta.DeltaTable.create", full)
    with pytest.raises(StoreError) as refused:
        Lake(tmp_path / "lake").commit(CAMPAIGN, [make_run("r1")])
    assert refused.value.got == "Generic error ↳ Unable to copy ↳ No space left on device"
