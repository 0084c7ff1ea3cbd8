"""Recordings in progress: killed, torn, full, with gaps, and sealed."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from dtwin.acquire._recording import Recorder
from dtwin.acquire._recovery import Sealed, recover_folder, seal, signal_findings
from dtwin.acquire.signal_files import read_signals
from dtwin.errors import InputError, StoreError

RATE_HZ = 25_600.0
COLUMNS = {"wrist_x_g": np.float32, "count": np.int32}


def block(first: int, n: int = 256) -> dict[str, np.ndarray]:
    k = np.arange(first, first + n)
    return {"wrist_x_g": np.sin(k * 0.01), "count": k.astype(np.int32)}


def recorder(path: Path) -> Recorder:
    return Recorder(path, "accelerometers", RATE_HZ, COLUMNS, start_s=1.5, notes={"a": 1})


def record(path: Path, blocks: int) -> None:
    with recorder(path) as writing:
        for _ in range(blocks):
            writing.append(block(writing.n_samples))


CHILD = """
    import sys
    from pathlib import Path
    import numpy as np
    sys.path.insert(0, sys.argv[2])
    from test_recording import block, recorder
    writing = recorder(Path(sys.argv[1]))
    while True:
        print(writing.append(block(writing.n_samples)), flush=True)
"""


def assert_true_blocks(sealed: Sealed) -> None:
    found, expected = pq.read_table(sealed.path), block(0, sealed.n_samples)
    np.testing.assert_array_equal(found["count"].to_numpy(), expected["count"])
    np.testing.assert_array_equal(found["wrist_x_g"].to_numpy(), expected["wrist_x_g"].astype(np.float32))


@pytest.mark.parametrize("trial", range(6))
def test_every_acknowledged_block_survives_kill_9(tmp_path: Path, trial: int) -> None:
    stream = tmp_path / "r1.accelerometers.arrows"
    child = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(CHILD), str(stream), str(Path(__file__).parent)],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert child.stdout is not None
    first = child.stdout.readline()
    time.sleep(random.Random(trial).uniform(0.0, 0.12))
    child.send_signal(signal.SIGKILL)
    acknowledged = [int(line) for line in (first + child.stdout.read()).split("\n") if line]
    assert child.wait(300) == -signal.SIGKILL
    (sealed,) = recover_folder(tmp_path)
    assert sealed.n_samples >= acknowledged[-1]
    assert sealed.n_samples % 256 == 0
    assert not sealed.complete
    assert_true_blocks(sealed)
    assert not stream.exists()
    assert [f.code for f in sealed.findings] == ["recording.incomplete"]
    assert signal_findings(sealed.path) == sealed.findings


def test_every_truncation_and_bit_flip_yields_only_true_blocks(tmp_path: Path) -> None:
    whole = tmp_path / "whole.arrows"
    record(whole, 8)
    data = whole.read_bytes()
    rng = random.Random(3)
    damaged = [data[: len(data) * percent // 100] for percent in range(100)]
    for _ in range(300):
        flipped = bytearray(data)
        flipped[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        damaged.append(bytes(flipped))
    fewer, codes = 0, set()
    for content in damaged:
        path = tmp_path / "damaged.arrows"
        path.write_bytes(content)
        try:
            sealed = seal(path, tmp_path / "damaged.parquet")
        except StoreError as error:
            codes.add(error.code)
            continue
        fewer += sealed.n_samples < 8 * 256
        assert_true_blocks(sealed)
    assert fewer > 200
    assert codes == {"recording.empty", "recording.damaged"}


def test_sealed_file_reads_as_signals_with_units(tmp_path: Path) -> None:
    stream, target = tmp_path / "r1.arrows", tmp_path / "r1.parquet"
    record(stream, 4)
    sealed = seal(stream, target)
    assert sealed.complete
    assert sealed.findings == ()
    assert not stream.exists()
    (group,) = read_signals(target)
    assert (group.name, group.rate_hz, group.start_s) == ("accelerometers", RATE_HZ, 1.5)
    assert group.columns["count"].tolist() == list(range(4 * 256))
    assert pq.read_schema(target).field("wrist_x_g").metadata == {b"unit": b"g"}


def test_lost_samples_stay_empty_and_keep_the_clock(tmp_path: Path) -> None:
    stream, target = tmp_path / "r1.arrows", tmp_path / "r1.parquet"
    with recorder(stream) as writing:
        writing.append(block(0))
        writing.gap(100, "overrun")
        writing.append(block(356))
    sealed = seal(stream, target)
    assert [f.code for f in sealed.findings] == ["recording.gap"]
    assert json.loads(pq.read_schema(target).metadata[b"dtwin.signals"])["gaps"] == [[256, 100, "overrun"]]
    (group,) = read_signals(target)
    values = group.columns["wrist_x_g"]
    assert np.flatnonzero(np.isnan(values)).tolist() == list(range(256, 356))
    assert values[356] == np.float32(np.sin(3.56))
    assert pq.read_table(target).column("wrist_x_g").null_count == 100
    assert group.columns["count"].dtype == np.int32
    assert np.flatnonzero(group.columns["count"] < 0).tolist() == list(range(256, 356))
    assert signal_findings(sealed.path)[0].numbers["lost"] == 100


def test_a_live_recording_is_left_alone(tmp_path: Path) -> None:
    stream = tmp_path / "r1.arrows"
    with recorder(stream) as writing:
        writing.append(block(0))
        with pytest.raises(StoreError) as caught:
            seal(stream, tmp_path / "r1.parquet")
        assert caught.value.code == "recording.live"
        assert recover_folder(tmp_path) == []
        with pytest.raises(StoreError) as again:
            recorder(stream)
        assert again.value.code == "recording.create"
    assert seal(stream, tmp_path / "r1.parquet").complete


def test_death_before_the_header_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "r1.arrows").write_bytes(b"")
    assert recover_folder(tmp_path) == []
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_recording_is_kept_and_hinders_no_other(tmp_path: Path) -> None:
    record(tmp_path / "good.arrows", 2)
    (tmp_path / "bad.arrows").write_bytes(b"\xff" * 64)
    with pytest.raises(StoreError) as caught:
        recover_folder(tmp_path)
    assert caught.value.code == "recording.damaged"
    assert {path.name for path in tmp_path.iterdir()} == {"bad.arrows", "good.parquet"}


def test_an_exception_leaves_the_recording_incomplete(tmp_path: Path) -> None:
    stream = tmp_path / "r1.arrows"

    def broken_off() -> None:
        with recorder(stream) as writing:
            writing.append(block(0))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        broken_off()
    sealed = seal(stream, tmp_path / "r1.parquet")
    assert sealed.n_samples == 256
    assert not sealed.complete


FULL = """
    import resource, sys
    from pathlib import Path
    sys.path.insert(0, sys.argv[2])
    from test_recording import block, recorder
    from dtwin.errors import StoreError
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
    with recorder(Path(sys.argv[1])) as writing:
        try:
            while True:
                writing.append(block(writing.n_samples))
        except StoreError as error:
            print(error.code, writing.n_samples)
        try:
            writing.append(block(writing.n_samples))
        except StoreError as error:
            print(error.code)
"""


def test_a_full_disk_is_said_and_loses_nothing(tmp_path: Path) -> None:
    stream = tmp_path / "r1.arrows"
    out = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(FULL), str(stream), str(Path(__file__).parent)],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONWARNINGS": "error"},
    ).stdout.split()
    assert out[0] == "recording.write"
    assert out[2] == "recording.closed"
    sealed = seal(stream, tmp_path / "r1.parquet")
    assert sealed.n_samples == int(out[1]) > 0
    assert not sealed.complete


@pytest.mark.parametrize(
    ("bad", "code"),
    [
        ({"wrist_x_g": np.zeros(3)}, "recording.block"),
        ({"wrist_x_g": np.zeros(3), "count": np.zeros(2, int)}, "recording.block"),
        ({"wrist_x_g": np.zeros((3, 1)), "count": np.zeros((3, 1), int)}, "recording.block"),
        ({"wrist_x_g": np.zeros(3), "count": np.zeros(3)}, "recording.type"),
    ],
)
def test_a_block_that_does_not_fit_is_refused(tmp_path: Path, bad: dict[str, np.ndarray], code: str) -> None:
    with recorder(tmp_path / "r1.arrows") as writing:
        with pytest.raises(InputError) as caught:
            writing.append(bad)
        assert caught.value.code == code
        writing.append(block(0))
    assert seal(tmp_path / "r1.arrows", tmp_path / "r1.parquet").n_samples == 256


@pytest.mark.parametrize("kind", [np.bool_, np.uint16, np.complex64, "U4"])
def test_only_floats_and_signed_integers_are_recorded(tmp_path: Path, kind: object) -> None:
    with pytest.raises(InputError) as caught:
        Recorder(tmp_path / "a.arrows", "daq", 100.0, {"wrist_g": kind})  # type: ignore[dict-item]
    assert caught.value.code == "recording.columns"


def test_columns_without_unit_and_absurd_gaps_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        Recorder(tmp_path / "a.arrows", "daq", 100.0, {"wrist": np.float32})
    assert caught.value.code == "units.unknown"
    with recorder(tmp_path / "b.arrows") as writing, pytest.raises(InputError) as gap:
        writing.gap(10**12, "clock jumped")
    assert gap.value.code == "recording.gap"


def test_a_seal_that_cannot_write_keeps_the_recording(tmp_path: Path) -> None:
    stream = tmp_path / "r1.arrows"
    record(stream, 2)
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError) as caught:
        seal(stream, tmp_path / "file" / "r1.parquet")
    assert caught.value.code == "store.write"
    assert seal(stream, tmp_path / "r1.parquet").n_samples == 512
