"""What a serving loop shows to other processes while it runs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dtwin.config import Home
from dtwin.links import layout
from dtwin.report.live_plots import circle_figure
from dtwin.serve import live_board as boards
from dtwin.serve.live_board import live_board, read_board
from dtwin.serve.safety import CLAMPED, OK, REASONS

READ = """
import sys
from pathlib import Path
from dtwin.config import Home
from dtwin.serve.live_board import read_board
seen = read_board("mill-a", Home(Path(sys.argv[1])))
print(seen.ticks, seen.late, seen.reasons, seen.column("correction_y_um")[-1])
"""


@pytest.fixture
def home(tmp_path: Path) -> Home:
    return Home(tmp_path)


def test_another_process_sees_the_newest_tick(home: Home) -> None:
    state = layout.empty_state()
    with live_board("mill-a", home, clamp_um=9.0, period_s=0.002, corrects=True) as board:
        assert board is not None
        for tick in range(5):
            state[layout.TIMESTAMP] = 0.002 * tick
            reason = CLAMPED if tick == 3 else OK
            board.show(
                state, np.array([0.0, 2.5, 0.0]), reason, (0.002, 0.0003, 0.0), (1, 0), np.array([0.1, 0.2, np.nan])
            )
        done = subprocess.run([sys.executable, "-c", READ, str(home.root)], capture_output=True, text=True, check=True)
        assert done.stdout == "5 1 {'ok': 4, 'clamped': 1} 2.5\n"
        # Of a fast control not every tick is shown, and all are counted.
        counts = np.zeros(len(REASONS), dtype=np.int64)
        counts[[OK, CLAMPED]] = 700, 100
        board.show(state, np.zeros(3), OK, (0.002, 0.0, 0.0), (0, 0), np.zeros(3), counts)
        seen = read_board("mill-a", home)
        assert seen is not None
        assert (seen.ticks, len(seen.rows), seen.reasons) == (800, 6, {"ok": 700, "clamped": 100})
        assert read_board("mill-b", home) is None
        assert read_board("mill-a", Home(home.root / "other")) is None
    assert read_board("mill-a", home) is None


def test_a_full_board_keeps_the_newest_in_order(home: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    state = layout.empty_state()
    with live_board("mill-a", home, clamp_um=9.0, period_s=0.002, corrects=True) as board:
        assert board is not None
        for tick in range(20_000):
            state[layout.TIMESTAMP] = tick
            board.show(state, np.zeros(3), OK, (0.002, 0.0, 0.0), (0, 0), np.full(3, np.nan))
        seen = read_board("mill-a", home)
        assert seen is not None
        assert seen.ticks == 20_000
        stamps = seen.column("stamp_s")
        assert stamps[-1] == 19_999
        assert np.array_equal(np.diff(stamps), np.ones(len(stamps) - 1))
        monkeypatch.setattr(boards, "_FORMAT", 1.0)
        assert read_board("mill-a", home) is None, "another version's board is none"


def test_a_link_in_the_way_is_not_followed(home: Home, tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("kept")
    path = boards._path("mill-a", home)
    path.symlink_to(victim)
    assert read_board("mill-a", home) is None
    with live_board("mill-a", home, clamp_um=9.0, period_s=0.002, corrects=True) as board:
        assert board is not None
        assert not path.is_symlink()
    assert victim.read_text() == "kept"


def test_a_circle_is_drawn_with_and_without_its_correction() -> None:
    angle = np.linspace(0.0, 2.5 * np.pi, 2000)
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    centre = np.array([100.0, 200.0, 300.0])
    error_um, sent_um = 20.0 * np.cos(2.0 * angle), -15.0 * np.cos(2.0 * angle)
    position = centre + outward * (50.0 + 1e-3 * (error_um + sent_um))[:, None]
    sent = sent_um[:, None] * outward
    every = np.ones((len(angle), 1))
    figure = circle_figure(position, centre * every, 50.0 * every[:, 0], sent)
    assert figure is not None
    seen, without = (np.array(trace.y) for trace in figure.data)
    assert np.abs(seen).max() == pytest.approx(5.0, rel=0.02)
    assert np.abs(without).max() == pytest.approx(20.0, rel=0.02)
    # A way out that follows hides the circle before it no more than half a turn replaces it.
    left = np.concatenate([position, position[-1:] + [[0.0, 5.0, 0.0]] * 300])
    more = np.ones((len(left), 1))
    again = circle_figure(left, centre * more, 50.0 * more[:, 0], np.concatenate([sent, sent[:300]]))
    assert again is not None
    assert np.allclose(again.data[0].y, figure.data[0].y)
    half = slice(0, 800)
    assert circle_figure(position[half], centre * every[half], 50.0 * every[half, 0], sent[half]) is None
    assert circle_figure(position, centre * every, 0.0 * every[:, 0], sent) is None
