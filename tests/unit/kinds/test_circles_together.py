"""What circles say together: spoilt readings, and repeats that disagree by more than a run scatters."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from dtwin.acquire.ingest import ingest
from dtwin.acquire.quality import judge_campaign, without_samples
from dtwin.acquire.virtual_mill import write_runs
from dtwin.config import Home
from dtwin.kinds.circular._sheet import circular_sheet
from dtwin.lake.store import Lake
from dtwin.report.uncertainty import Circumstances
from dtwin.schema import Campaign, Finding, Run, RunMeta
from dtwin.twins.verbs import Twins
from dtwin.workbench._access import Access
from dtwin.workbench._bench import Bench
from dtwin.workbench.server import application

CODES = {"circular.spoilt_readings", "circular.repeats_differ", "circular.scale"}


def circle(rng: np.random.Generator, repeat: int, feed: float, way: Any, n: int, noise_um: float) -> Run:
    """One run with an oval, a play, and at each reversal a spike and a stick-slip that are a little different each time."""
    angle = np.linspace(0.0, 360.0, n, endpoint=False)
    value = 8.0 * np.cos(np.radians(2.0 * angle)) + 2.0 * np.sign(np.sin(np.radians(angle)))
    for quadrant in range(0, 360, 90):
        past = angle - quadrant - feed / 1000.0 * (1.0 + 0.15 * rng.standard_normal())
        value += 6.0 * (1.0 + 0.2 * rng.standard_normal()) * np.exp(-0.5 * (past / (0.3 * feed / 1000.0)) ** 2)
        slips = (angle - quadrant) % 360.0 < 8.0
        value += slips * 1.5 * ((angle / rng.uniform(1.5, 3.5) + rng.uniform()) % 1.0 - 0.5)
    value = np.round(value + noise_um * rng.standard_normal(n), 2)
    meta = RunMeta(
        f"f{feed:g}-{way}-{repeat}", plane="XY", direction=way, radius_mm=100.0, feed_mm_min=feed, repeat=repeat
    )
    return Run(meta, {"angle_deg": angle if way == "CCW" else -angle, "deviation_um": value})


def campaign(seed: int, n: int = 720, noise_um: float = 0.3) -> list[Run]:
    rng = np.random.default_rng(seed)
    wanted = product((1, 2, 3), (1000.0, 2000.0), ("CCW", "CW"))
    return [circle(rng, repeat, feed, way, n, noise_um) for repeat, feed, way in wanted]


def spoilt(run: Run, row: int, off_um: float) -> Run:
    value = run.samples["deviation_um"].copy()
    value[row] += off_um
    return replace(run, samples=dict(run.samples) | {"deviation_um": value})


def told(runs: list[Run]) -> list[Finding]:
    return [f for f in judge_campaign(list(map(without_samples, runs))) if f.code in CODES]


def test_a_direction_in_another_unit_is_told() -> None:
    ccw, cw = (run for run in campaign(1) if run.meta.repeat == 1 and run.meta.feed_mm_min == 1000.0)
    assert not told([ccw, cw])
    inch = replace(cw, samples=cw.samples | {"deviation_um": cw.samples["deviation_um"] / 25.4})
    (finding,) = told([ccw, inch])
    assert finding.code == "circular.scale"
    assert finding.numbers["ratio_1"] == pytest.approx(25.4, rel=0.1)
    # Another shape is another circle.
    other = replace(inch, samples=inch.samples | {"deviation_um": np.roll(inch.samples["deviation_um"], 90)})
    assert not told([ccw, other])


@pytest.mark.parametrize("off_um", [8.0, -14.0])
def test_a_single_spoilt_reading_is_told_with_its_run_and_angle(off_um: float) -> None:
    runs = campaign(1)
    runs[7] = spoilt(runs[7], 300, off_um)
    (found,) = told(runs)
    assert (found.code, found.severity) == ("circular.spoilt_readings", "error")
    name, angle = runs[7].meta.run_id, runs[7].samples["angle_deg"][300] % 360.0
    assert f"{name} at {angle:z.1f}° (sample 301)" in found.message
    assert f"dtwin leave-out CAMPAIGN {name}" in found.message
    assert found.numbers["largest_um"] == pytest.approx(abs(off_um), abs=1.5)


@pytest.mark.parametrize("noise_um", [0.1, 1.0])
@pytest.mark.parametrize("n", [360, 3600])
def test_spikes_of_reversals_and_slips_are_not_spoilt(n: int, noise_um: float) -> None:
    assert [told(campaign(seed, n, noise_um)) for seed in range(3)] == [[]] * 3


def test_what_another_run_has_at_that_angle_is_not_spoilt() -> None:
    """A scratch of the guideway lies at one angle of every run."""
    runs = [spoilt(run, 300 if run.meta.direction == "CCW" else 420, 9.0) for run in campaign(2)]
    assert told(runs) == []
    assert told([spoilt(campaign(2)[0], 300, 9.0)]) != []


def test_at_a_reversal_only_what_no_other_has_is_spoilt() -> None:
    runs = campaign(3)
    assert told([spoilt(runs[0], 184, 30.0)]) == []
    assert told([spoilt(runs[0], 184, 30.0), *runs[1:]]) != []


def test_the_sheet_leaves_the_spoilt_run_out() -> None:
    runs = campaign(4)
    clean = circular_sheet(runs, Circumstances({})).parts[0]
    spoilt_runs = [spoilt(runs[0], 290, -14.0), *runs[1:]]
    sheet = circular_sheet(spoilt_runs, Circumstances({}))
    assert any(note.startswith(f"{runs[0].meta.run_id} is not evaluated: ") for note in sheet.notes)
    figures = {c.symbol: c.value_um for c in sheet.parts[0].characteristics}
    assert figures["G(CCW)"] == pytest.approx({c.symbol: c.value_um for c in clean.characteristics}["G(CCW)"], abs=1.0)


def moved(runs: list[Run], size_um: float) -> list[Run]:
    """The same with a wave of its own in every run, as of a bar that is not seated."""
    rng = np.random.default_rng(9)
    out = []
    for run in runs:
        wave = size_um * np.cos(np.radians(2.0 * run.samples["angle_deg"] + rng.uniform(0.0, 360.0)))
        out.append(replace(run, samples=dict(run.samples) | {"deviation_um": run.samples["deviation_um"] + wave}))
    return out


def test_repeats_that_differ_by_many_times_what_a_run_scatters_are_told() -> None:
    (found,) = told(moved(campaign(5, noise_um=0.2), 3.7))
    assert (found.code, found.severity) == ("circular.repeats_differ", "warning")
    assert found.numbers["repeats_um"] == pytest.approx(2.6, rel=0.3)
    assert found.numbers["within_um"] == pytest.approx(0.2, rel=0.3)
    # Ordinary: less than five times the scatter, or less than half a micrometre.
    assert told(moved(campaign(5, noise_um=1.0), 3.7)) == []
    assert told(moved(campaign(5, noise_um=0.05), 0.4)) == []


def test_workbench_and_certificate_say_what_samples_say_together(tmp_path: Path) -> None:
    """The page of the campaign said that nothing is wrong with the data, above a run that the sheet had left out."""
    one_turn = np.linspace(0.0, 2.0 * np.pi * 100.0 * 60.0, 720, endpoint=False)
    runs = [
        replace(run, samples=dict(run.samples) | {"t_s": one_turn / (run.meta.feed_mm_min or 1.0)})
        for run in campaign(6)
    ]
    runs[3] = spoilt(runs[3], 290, 14.0)
    write_runs(tmp_path / "c", Campaign("c", "m"), runs)
    home = Home(tmp_path / "home")
    ingest(tmp_path / "c", Lake(home.lake))
    browser = TestClient(application(Bench(home, Access("127.0.0.1", 8765))), base_url="http://127.0.0.1:8765")
    Twins(home).fit("c", [], "t")
    assert "each run sound" in browser.get("/campaigns").text
    assert "Nothing is wrong with this run by itself" in browser.get(f"/campaigns/c/runs/{runs[3].meta.run_id}").text
    for page in ("/twins/t/diagnose", "/campaigns/c", "/campaigns/c/certificate.html"):
        text = browser.get(page).text
        assert text.count("1 reading is spoilt") == 1
        assert "Nothing is wrong with the data" not in text


def test_a_run_that_begins_a_hair_before_zero_is_binned_as_others_are() -> None:
    """An arc from -20 to 200 degrees passes 0 at -1e-15, which modulo 360 is 360."""
    runs = campaign(3)[:4]
    hair = runs[0].samples["angle_deg"] - np.where(np.arange(720) == 0, 1e-15, 0.0)
    assert told([replace(runs[0], samples=dict(runs[0].samples) | {"angle_deg": hair}), *runs[1:]]) == told(runs)
