"""The certificate of a campaign: who, what, with what, the decision first, and nothing that a file states becomes markup."""

from __future__ import annotations

import ast
import json
import re
import socket
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import pytest
from conftest import require_program
from fastapi.testclient import TestClient
from machine_years import steady, stepping, write_tests
from typer.testing import CliRunner

import dtwin
from dtwin.acquire.ingest import ingest
from dtwin.cli import app
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named
from dtwin.kinds.volumetric._chain import COEFFICIENTS
from dtwin.kinds.volumetric.motions import motion_words
from dtwin.lake.store import Lake
from dtwin.physics import localise
from dtwin.physics._learned_places import PLACES
from dtwin.physics.learned import learned_effect
from dtwin.physics.library import Library
from dtwin.pipeline.campaign_certificate import _one_that_can, certificate, facts_of
from dtwin.report.certificate import certificate_page
from dtwin.report.html import page as page_of
from dtwin.report.html import told_section
from dtwin.report.language import _CLAUSES, _TITLES, Language, _german_of
from dtwin.report.pdf import pdf_of
from dtwin.report.twin_plots import residual_map
from dtwin.report.twins import diagnosis_section, history_table
from dtwin.schema import Run, RunMeta
from dtwin.units import shown_parameter
from dtwin.workbench import _pages
from dtwin.workbench._access import Access
from dtwin.workbench._bench import Bench
from dtwin.workbench.server import application

BASIS = "6.5 µm within 1 h, drift test night; what goes beyond the repeatability"


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Home:
    home = Home(tmp_path_factory.mktemp("home"))
    for folder in write_tests(home.root / "made", 2, steady(2.0), stepping(3.0, 1, 8.0)):
        told = (folder / "campaign.toml").read_text(encoding="utf-8")
        told = told.replace('serial = "B1"', 'serial = "B1"\ncertificate = "C 7"\noperator = "<script>x</script> time"')
        (folder / "campaign.toml").write_text(told, encoding="utf-8")
        ingest(folder, Lake(home.lake))
    home.machines.mkdir()
    (home.machines / "mill-7.toml").write_text('serial = "4711"\n[tolerances]\n"G(b)" = 15.0\n')
    return home


@pytest.mark.parametrize(
    ("begun", "said"),
    [
        (("2026-03-02",), "2026-03-02"),
        (("2026-03-02T08:00:00Z",), "2026-03-02 08:00"),
        (("2026-03-02", "2026-03-04"), "2026-03-02 - 2026-03-04"),
        (("2026-03-02", "2026-03-02T09:00:00Z"), "2026-03-02"),
        (("",), ""),
    ],
)
def test_when_it_was_measured_is_said_as_it_was_told(home: Home, begun: tuple[str, ...], said: str) -> None:
    row = Lake(home.lake).runs("t00")[0]
    assert facts_of(home, [row | {"started": told} for told in begun])["measured"] == said


def test_of_the_instruments_of_a_machine_the_one_that_can_have_made_the_test_is_named() -> None:
    listed = "Ball-bar QC20-W, laser XL-80, laser tracker AT960"
    said = {kind: _one_that_can(listed, kind) for kind in ("circular", "poses", "linear", "rotary")}
    assert said == {"circular": "Ball-bar QC20-W", "poses": "laser tracker AT960", "linear": "", "rotary": ""}


def test_it_says_in_german_what_was_tested_and_what_is_decided(home: Home) -> None:
    page = re.sub(r"<script>.*?</script>", "", certificate(home, "t01", "de"), flags=re.S)
    assert "Entscheidung nach ISO 14253-1: <strong>außerhalb</strong>" in page
    for told in ("Prüfprotokoll: mill-7", "4711", "bar B1", "C 7", "2025-02-05 08:01 - 08:02", "Verglichen mit t00"):
        assert told in page
    assert "&lt;script&gt;x&lt;/script&gt; time<" in page
    # So does what stands in longer sentences; the pictures are in scripts, that were taken out.
    for told in ("Kreisformtest", "Freiheitsgrade", "Wiederholeinheit: der Lauf", "Wurzel aus der Summe der Quadrate"):
        assert told in page
    assert not re.findall(r"circular test|degrees of freedom|unit of replication|Budget of|runs", page)
    value, before, change = map(
        lambda told: float(told.replace(",", ".")),
        re.search(r"G\(b\) .*?<td>([\d,]+)</td>.*?([\d,]+)</td><td>\+([\d,]+)", page, re.S).groups(),  # type: ignore[union-attr]
    )
    assert value - before == pytest.approx(change, abs=0.011)
    assert "inside" in certificate(home, "t00")


def test_a_german_budget_is_german_and_its_numbers_have_commas() -> None:
    """Every phrase of a sheet of each kind; a word that stands for two things had been put in the place of both."""
    budget = {
        "contributions": [
            {"source": "environment", "standard_um": 1.368, "basis": BASIS},
            {"source": "expansion", "standard_um": 1.0, "basis": "2 K from 20 °C, assumed, for none was written"},
        ],
        "standard_um": 1.694,
        "k": 2.0,
    }
    shown = {"value": "11.2", "expanded": "± 3.4", "limit": "-5 to 12.5"}
    figures = [
        {
            "symbol": symbol,
            "name": name,
            "unit": "um",
            "value_um": 11.2,
            "expanded_um": 3.388,
            "shown": shown,
            "decision": "",
        }
        for symbol, name in (("A", "bi-directional accuracy"), ("AD", "distance accuracy, largest"))
    ]
    figures[0]["budget"] = budget
    part = {"title": "axis X, forward only, 0 to 500.5 mm, 11 targets", "runs": ["r-1.5"], "verdict": "inside"}
    sheet = {
        "standard": "ISO 230-2, positioning",
        "headline": "A",
        "verdict": "inside",
        "basis": "",
        "notes": [],
        "unit": "um",
    }
    sheet["parts"] = [{**part, "characteristics": figures}]
    drawn = go.Figure(go.Scatter(x=[0.5], y=[1.5], name="r-1.5"))
    page = certificate_page(
        {"campaign": "v1.5", "machine": "m", "temperature": "20.5 °C"},
        sheet,
        [drawn],
        [("warning", "error: 1.5")],
        language="de",
    )
    for told in (
        'Warnung: <span lang="en">error: 1.5</span>',
        "Achse X, nur vorwärts, 0 bis 500,5 mm, 11 Zielpositionen",
        "bidirektionale Positioniergenauigkeit",
        "Abstandsgenauigkeit, größte",
        "-5 bis 12,5",
        "1,368",
        "6,5 µm innerhalb von 1 h, Driftmessung night; soweit über die Wiederholpräzision hinaus",
        "2 K von 20 °C entfernt, angenommen, da nicht notiert",
        "20,5 °C",
        "v1.5",
        "r-1.5",
    ):
        assert told in page


@pytest.mark.parametrize(
    "text", ["a is not evaluated: " * 60 + "and none of these words", "2 readings " * 90 + "x", "a: " * 3000]
)
def test_a_text_made_to_be_looked_at_for_ever_stays_english(text: str) -> None:
    # Each part of it may be what stands between the words of several clauses.
    assert _german_of(text, str) is None


def test_findings_are_german_as_a_whole_or_not_at_all() -> None:
    def told(text: str) -> str | None:
        return _german_of(text, lambda name: str(name).replace(".", ","))

    assert told("r-1: 3 of 4 conditions have no repeat: their noise floor is unknown.") == (
        "r-1: 3 von 4 Bedingungen sind nicht wiederholt: ihr Rauschen ist unbekannt."
    )
    assert told(
        "the mean feed is 48.5 mm/min, -3.8 % of the programmed 50: a wrong feed, or a radius in another unit"
    ) == (
        "der mittlere Vorschub beträgt 48,5 mm/min, das sind -3,8 % gegenüber programmierten 50: "
        "ein falscher Vorschub oder ein Radius in anderer Einheit"
    )
    assert told("cw is evaluated, though not sound: something that nobody translated.") is None
    assert told("measure 20 or more; something that nobody translated") is None


def test_every_effect_has_german_words() -> None:
    words = Language("de")
    learned = [learned_effect("learned_odd_h3_f1_r0"), *PLACES.values()]
    for effect in [*Library([]).values(), *learned]:
        fault = f"Missing: {effect.title}, XY: 3.1 ± 0.2 µm/m. {effect.looks_like} {effect.remedy}"
        said, language = words.spoken(fault)
        assert (language, said[:9]) == ("de", "Es fehlt:"), fault
        assert "3,1 ± 0,2 µm/m" in said
        assert words.spoken(f"next: {effect.separate_by}")[1] == "de", effect.separate_by
        for size in (*effect.parameters, *effect.shapes):
            assert shown_parameter(size.name.removesuffix(f"_{size.unit.lower().replace('/', '_')}")) in _TITLES
    assert words.cell("Backlash X") == "Umkehrspiel X"
    assert words.cell("about 3.3") == "etwa 3,3"
    # What somebody named so is no size.
    assert words.spoken("twin scale version 1 against campaign lead (2 runs)")[0] == (
        "Zwilling scale Version 1 gegen lead (2 Läufe)"
    )


def test_what_a_diagnosis_tells_is_german_in_a_german_report() -> None:
    play = {"effect": "backlash", "axis": "X", "rms_after_um": 0.5, "cv_gain": 0.4, "p_value": 1e-9, "in_group": True}
    play |= {"grade": "law-confirmed", "remedy": "Preload or renew nut and bearings.", "separate_by": ""}
    size = {"name": "play", "value": 3.1, "uncertainty": 0.2, "unit": "um", "identifiable": True}
    more = {"sizes": [size], "size_um": 1.1, "tested": ["feed", "radius"], "untested": []}
    rest = {"share": 0.3, "systematic_rms_um": 0.5, "p_value": 0.01, "words": "even in direction, harmonic 2 (99 %)"}
    said = {
        "verdict": "missing_effect",
        "headline": "backlash X; friction X or squareness XY: odd in direction, harmonic 2 (70 %)",
        "residual_rms_um": 1.2,
        "systematic_rms_um": 1.1,
        "noise_floor_um": 0.5,
        "lack_of_fit_p": 0.0005,
        "candidates": [play],
        "found": [[play | more], [play | more]],
        "unresolved": rest | {"where": []},
        "laws": [],
        "channels": [{"name": "bed_c", "share": 0.4, "p_value": 0.01}],
        "outlier_runs": ["r001"],
        "invisible": ["gravity_sag X"],
        "untestable": {"angular_error X": "abbe_offset_mm was not logged"},
        "undecided": [["backlash X", "friction X"]],
        "next_experiment": None,
        "closest": "",
    }
    rungs = [
        {"version": 2, "action": "add backlash X", "verdict": "ambiguous", "found": [["backlash X"], ["friction X"]]}
    ]
    sizes = {"rms_before_um": 1.9, "rms_after_um": 0.5, "noise_floor_um": 0.5}
    sections = [
        diagnosis_section("a", said),
        told_section("From version to version", [history_table([rungs[0] | sizes])]),
    ]
    page = page_of("a", "", sections, Language("de")).partition('<script type="application/gzip"')[0]
    assert "<pre" not in page
    assert re.findall('lang="en">([^<]*)', page) == []
    for text in ("Umkehrspiel X dazu", "Gewinn auf Ausgelassenem", "versuchen: dtwin twin add a backlash --axis X"):
        assert text in page


@pytest.mark.parametrize(
    "text",
    [
        "next: measure every condition 3 times, in random order",
        "next: double the highest feed (8000 mm/min), 3 times: tells scale_mismatch X from warming_growth X with a "
        "probability of 98 %, friction X from backlash X + backlash Y with a probability of 88 %, about 2 min",
        "next: another plane (ZX), 3 times: tells friction X from backlash X with a probability of 88 %, about 32 min",
        "next: heat bed_c alone, with ram_c and head_c at rest, then the other way round; a cycle an hour: exx follows "
        "the one that drives it",
        "law: 4.1 µm d cos(3t + p) (F/F0)^2",
        "unknown_effect: no known effect explains it: a step of 4.1 µm at 120 mm, on the way back at 110 mm; a bump of "
        "2 µm at 40 mm, 30 mm wide at half its height",
        "unknown_effect: backlash X may be it, which 12 runs do not tell: odd in direction, harmonic 2 (70 %)",
        "unknown_effect: no known effect explains what is left, 2.1 of 5 µm: even in direction, harmonic 3 (80 %); it "
        "moves with bed_c",
        "In words: mixed in direction, spread over many harmonics, does not change with feed",
        "nothing_missing: residual is at the noise floor; repeats differ by 0.5 µm, neighbouring places of a run by 0.1 "
        "µm: most of it is the centre, which moves between runs",
        "need_repeats: no condition was repeated: the noise floor is not known, it is at least 0.3 µm (harmonics above "
        "90); it looks like backlash X; squareness XY or scale_mismatch XY",
        "contradiction since 2026-03-01: backlash X (backlash) of a is 3.1 ± 0.2 µm above that of b (p = 1e-05): since "
        "the repair of 2026-02-01 (new nut, X), which is recorded between these tests; ± holds 0.12 µm that laws may "
        "miss, and p is of what lies beyond",
        "contradiction: backlash X (backlash) of a, c is 3.1 ± 0.2 µm below that of b (p = 1e-05), or friction X, which "
        "these tests cannot tell from it: the machine changed, or one of them is mistaken, though the crash of "
        "2026-02-01 is recorded before it",
        "settled: bar could not tell scale_mismatch X, lead_error X; it is lead_error X (lead_error X agrees with laser, "
        "scale_mismatch X is ruled out by laser), unless the machine changed between 2026-01-01 and 2026-02-01",
        "not told: thermal_growth X: temperature_c did not change",
        "unknown_effect: 120 µm are left, 3.1 times the scatter of repeats: repeatable, and no effect here surely "
        "explains it; sag of the wrist, J4 to J6, is not looked for; most of it is in rows 4, 9, the others leave 12 "
        "µm: spoilt readings?",
        "missing_effect: joint_offset J2 (Zero offset of a joint) takes 88.1 % of the squares on poses held out, as "
        "well as joint_offset J3",
        "ambiguous: bed_c or time alone: this log does not tell which",
        "contradiction: bar X (second axis bow at 100 mm) of a is 3.1 ± 0.2 µm above that of b (p = 1e-05): the machine "
        "changed, or one of them is mistaken",
        "metadata version 2 (2026-11-30T03:34, root): r001, r002, r3, r4 and 4 more radius_mm stated anew, because wrong",
        "metadata version 2 (2026-11-30T03:34, root): r001 left out, because ein Kabel hing im Weg und zog daran",
        "error in X of axis Z, linear in its travel",
    ],
)
def test_what_a_twin_lacks_and_which_test_tells_is_german(text: str) -> None:
    said, language = Language("de").read(text)
    assert language == "de"
    english = {"from", "with", "the", "and", "or", "of", "to", "mixed", "odd", "even", "harmonic", "times"}
    assert english & {*re.findall("[a-z]+", said.lower())} == set()


def test_every_translated_clause_is_said_somewhere() -> None:
    """A clause that was worded anew would be English again."""
    said = ""
    for file in Path(dtwin.__file__).parent.rglob("*.py"):
        said += "".join(
            node.value + "\n"
            for node in ast.walk(ast.parse(file.read_text("utf-8")))
            if isinstance(node, ast.Constant) and isinstance(node.value, str)
        )
    said = re.sub(r"\{\w+\}", "\n", said)
    # What is put together of words.
    said += "".join(
        f"{localise._trend(slope)} with {over}\n"
        for slope in (-1, 0, 1)
        for over in ("feed", "radius", "frequency", "amplitude")
    )
    said += "\n".join([*(effect.title for effect in PLACES.values()), *map(motion_words, COEFFICIENTS)])
    said += "\nmore left out\nmore taken in again\n"
    said += residual_map(np.ones((1, 360)), ["c"], floor_um=0.5, title="Mean residual").layout.title.text
    pieces = {piece.strip(" ,:;()") for clause in _CLAUSES for piece in clause.split("{}")}
    assert [piece for piece in sorted(pieces) if piece not in said] == []


@pytest.mark.parametrize("kind", ["drift", "linear", "poses", "rotation", "rotary"])
def test_pictures_of_a_german_certificate_have_no_english_words(kind: str) -> None:
    """A title of which only some words were known was half German: "Distance Herkunft the commanded pose"."""
    figure, words = kind_named(kind).sheet_figure([_of_kind(kind)]), set()
    sheet = {"standard": "", "headline": "", "verdict": "", "basis": "", "notes": [], "unit": "um"}
    sheet["parts"] = [{"title": "", "runs": ["r"], "verdict": "", "characteristics": []}] * 2
    page = certificate_page({"campaign": "c", "machine": "m"}, sheet, [figure, figure], [], language="de")
    for text in re.findall(r'"text":"([^"]*)"|"name":"([^"]*)"', page[page.index("<body>") :]):
        words |= set(re.findall(r"[A-Za-z]{4,}", json.loads(f'"{"".join(text)}"').lower()))
    assert (
        words & {"error", "from", "the", "reading", "distance", "turns", "synchronous", "displacement", "speed"}
        == set()
    )
    # Parts of the same runs have one picture.
    assert page.count('application/vnd.plotly.v1+json"') == 1


def _of_kind(kind: str) -> Run:
    n, rng = 30, np.random.default_rng(0)
    places = rng.uniform(-300.0, 300.0, (n, 3))
    samples: dict[str, dict[str, Any]] = {
        "drift": {"displacement_um": np.arange(n), "temperature_room_c": 20.0 + np.zeros(n)},
        "linear": {"position_mm": np.arange(n), "direction": np.repeat("forward", n), "error_um": np.arange(n)},
        "poses": {f"{what}_{a}_mm": places[:, i] for what in ("target", "measured") for i, a in enumerate("xyz")},
        "rotary": {"angle_deg": np.arange(n), "direction": np.repeat("forward", n), "error_arcsec": np.arange(n)},
        "rotation": {"angle_deg": np.linspace(0.0, 1080.0, 600), "displacement_um": rng.normal(size=600)},
    }
    t_s = np.arange(float(len(next(iter(samples[kind].values())))))
    return Run(RunMeta("r", kind=kind, sample_rate_hz=1.0), {"t_s": t_s, **samples[kind]})


def test_what_cannot_be_written_is_refused(home: Home, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such language"):
        certificate(home, "t01", "fr")
    with pytest.raises(InputError, match="no such campaign"):
        certificate(home, "t77")
    monkeypatch.setenv("DTWIN_HOME", str(home.root))
    refused = CliRunner().invoke(app, ["certificate", "t01", "--out", "x.doc"])
    assert isinstance(refused.exception, InputError)
    monkeypatch.setenv("PATH", str(tmp_path))
    lacking = CliRunner().invoke(app, ["certificate", "t01", "--out", str(tmp_path / "x.pdf")])
    assert "needs a browser" in str(lacking.exception)
    # The workbench says so before anybody presses a button, and offers the page.
    page = _workbench(home).get("/campaigns/t01").text
    assert "/certificate.html?language=de" in page
    assert "certificate.pdf" not in page
    assert "Save as PDF" in page


def test_the_workbench_gives_the_pdf(home: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(_pages._ENVIRONMENT.globals, "browser", lambda: "chromium")
    monkeypatch.setattr("dtwin.workbench._campaign_routes.pdf_of", lambda page: page.encode())
    asked = _workbench(home)
    assert "/campaigns/t01/certificate.pdf?language=de" in asked.get("/campaigns/t01").text
    printed = asked.get("/campaigns/t01/certificate.pdf?language=de")
    assert printed.headers["content-disposition"] == 'attachment; filename="t01-de.pdf"'
    assert "Prüfprotokoll: mill-7" in printed.text


def _workbench(home: Home) -> TestClient:
    return TestClient(application(Bench(home, Access("127.0.0.1", 8765))), base_url="http://127.0.0.1:8765")


def test_a_browser_prints_it(home: Home, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    require_program("chromium", "chromium")
    monkeypatch.setenv("DTWIN_HOME", str(home.root))
    done = CliRunner().invoke(app, ["certificate", "t01", "--out", str(tmp_path / "x.pdf")], catch_exceptions=False)
    assert done.exit_code == 0
    assert (tmp_path / "x.pdf").read_bytes().startswith(b"%PDF-")


def test_the_browser_that_prints_asks_nobody() -> None:
    """Its maker's servers are not there in a test; one of ours stands for them."""
    require_program("chromium", "chromium")
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"http://127.0.0.1:{server.getsockname()[1]}/"
        assert pdf_of(f'<img src="{address}">').startswith(b"%PDF-")
        server.settimeout(0.2)
        with pytest.raises(TimeoutError):
            server.accept()
