"""`dtwin twin compare` on a mill that logs its command and its motor encoders."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from dtwin.acquire.virtual_mill import simulate_mill
from dtwin.cli import app
from dtwin.errors import DtwinError

pytestmark = pytest.mark.system
KEPT = 8


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("encoder") / "mill"
    simulate_mill(made, quick=True, hidden="servo")
    return made


@pytest.fixture
def compare(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))

    def run(*options: str, code: int = 0) -> Any:
        done = CliRunner().invoke(app, ["twin", "compare", "m", *options])
        wrong = done.exception if isinstance(done.exception, DtwinError) else None
        assert (wrong.exit_code if wrong else done.exit_code) == code, done.output
        return wrong or done

    def fit(where: Path) -> None:
        done = CliRunner().invoke(app, ["twin", "fit", str(where), "--effects", "squareness", "--name", "m"])
        assert done.exit_code == 0, done.output

    run.fit = fit  # type: ignore[attr-defined]
    return run


def test_the_controller_sees_its_lag_and_the_rest_is_split_at_the_declared_frequency(
    compare: Any, folder: Path, tmp_path: Path
) -> None:
    compare.fit(folder)
    found = json.loads(compare("--json").stdout)["encoder_split"]
    assert found["cutoff"] == {"cycles_per_rev": 15.0}
    assert (found["runs"], found["runs_without_controller"]) == (36, [])
    by_feed = {(c["feed_mm_min"], c["direction"]): c for c in found["conditions"] if c["radius_mm"] == 50}
    # The error of a lag is in proportion to the feed.
    sizes = [by_feed[feed, "CW"]["controller"]["rms_um"] for feed in (1000.0, 2000.0, 4000.0)]
    np.testing.assert_allclose(np.array(sizes) / sizes[0], [1.0, 2.0, 4.0], rtol=0.02)
    # What rings when Y breaks away grows with the feed; play and squareness do not.
    slow, fast = by_feed[1000.0, "CCW"], by_feed[4000.0, "CCW"]
    assert fast["dynamic"]["rms_um"] > 2.0 * slow["dynamic"]["rms_um"]
    assert fast["quasi_static"]["rms_um"] == pytest.approx(
        slow["quasi_static"]["rms_um"], abs=2.0 * slow["quasi_static"]["floor_um"]
    )
    assert fast["controller"]["floor_um"] < 0.1 * fast["measured"]["floor_um"]

    in_hz = json.loads(compare("--json", "--split-hz", "1").stdout)["encoder_split"]
    one = next(c for c in in_hz["conditions"] if c["feed_mm_min"] == 4000 and c["radius_mm"] == 50)
    assert one["cutoff_cycles_per_rev"] == pytest.approx(2.0 * np.pi * 50.0 / (4000.0 / 60.0))
    page = tmp_path / "c.html"
    text = compare("--html", str(page)).stdout
    assert "dynamic is above 15 cycles per revolution" in text
    assert "What the controller saw" in page.read_text(encoding="utf-8")


def test_runs_without_all_of_the_columns_are_left_out_and_named(compare: Any, folder: Path, tmp_path: Path) -> None:
    def copy(name: str, drop: str, runs: int) -> Path:
        made = tmp_path / name
        made.mkdir()
        toml = (folder / "campaign.toml").read_text("utf-8").replace("mill-servo", name)
        entries = toml.split("[[run]]")[: KEPT + 1]
        (made / "campaign.toml").write_text("[[run]]".join(entries), encoding="utf-8")
        for number, path in enumerate(sorted(folder.glob("r*.csv"))[:KEPT]):
            lines = path.read_text("utf-8").splitlines()
            keep = [i for i, column in enumerate(lines[0].split(",")) if number >= runs or not re.search(drop, column)]
            cells = (line.split(",") for line in lines)
            text = "\n".join(",".join(row[i] for i in keep) for row in cells)
            (made / path.name).write_text(text + "\n", encoding="utf-8")
        return made

    compare.fit(copy("some", "^(cmd|act)_", 2))
    found = json.loads(compare("--json").stdout)["encoder_split"]
    assert found["runs_without_controller"] == ["r001", "r002"]
    assert found["runs"] == KEPT - 2
    compare.fit(copy("none", "^(cmd|act)_", 99))
    assert json.loads(compare("--json").stdout)["encoder_split"] is None
    assert "split" not in compare().stdout
    assert compare("--split-cycles", "10", code=1).code == "split.no_columns"
    assert compare("--split-cycles", "10", "--split-hz", "1", code=1).code == "split.cutoff"
    compare.fit(copy("half", "^act_y", 1))
    found = json.loads(compare("--json").stdout)["encoder_split"]
    assert found["runs_without_controller"] == ["r001"], "half a vector was projected"
