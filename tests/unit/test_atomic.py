"""Files that are whole, and logs whose cut lines spoil no other."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from dtwin.atomic import append_line, whole_file, write_text
from dtwin.errors import StoreError


def test_a_line_that_was_cut_short_spoils_no_other(tmp_path: Path) -> None:
    log = tmp_path / "logs" / "serve.jsonl"
    append_line(log, b"first")
    with log.open("ab") as file:
        file.write(b"cut sho")
    append_line(log, b"second")
    append_line(log, b"third")
    assert log.read_bytes() == b"first\ncut sho\nsecond\nthird\n"


def test_a_line_for_which_there_is_no_room_is_an_error() -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no device that is always full")
    with pytest.raises(OSError, match="No space"):
        append_line(Path("/dev/full"), b"first")


def test_threads_that_write_one_file_at_once_take_nothing_from_each_other(tmp_path: Path) -> None:
    path = tmp_path / "bundle.json"
    with ThreadPoolExecutor(1) as other, whole_file(path, "the file") as partial:
        partial.write_text("first")
        other.submit(write_text, path, "second", "the file").result()
        assert path.read_text() == "second"
    assert path.read_text() == "first"
    assert [p.name for p in tmp_path.iterdir()] == ["bundle.json"]


def test_a_device_or_a_pipe_is_not_replaced_by_a_file(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(StoreError, match="cannot be written"):
        write_text(pipe, "text", "it")
    assert pipe.is_fifo()


def test_what_could_not_be_written_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="cannot be written"), whole_file(tmp_path / "twins" / "t" / "v", "it"):
        raise OSError(28, "No space left on device")
    assert not list(tmp_path.iterdir())
