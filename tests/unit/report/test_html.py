from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from dtwin.atomic import write_text
from dtwin.errors import StoreError
from dtwin.report.html import Section, Table, page
from dtwin.report.plots import polar_figure
from dtwin.report.twin_plots import residual_map

EVIL = "<script>alert(1)</script>\"'><img src=x onerror=alert(2)>"


def test_a_page_fetches_nothing_and_escapes_everything() -> None:
    angle = np.linspace(0, 360, 100)
    figure = polar_figure({EVIL: (angle, np.sin(angle))}, 100.0, title="polar")
    section = Section(EVIL, [EVIL], [("error", EVIL)], [Table([EVIL], [[EVIL]])], [figure], [EVIL])
    content = page(EVIL, EVIL, [section])
    (style,) = re.findall(r"<style>(.*?)</style>", content, re.S)
    # Each printed sheet says what it is of, and which of how many it is.
    assert 'content: "\\3c script\\3e alert' in style
    assert 'counter(page) " / " counter(pages)' in style
    assert "<script>alert(1)" not in content
    assert "<img src=x" not in content
    outside = re.sub(r"<script>.*?</script>", "", content, flags=re.S)
    assert not re.findall(r"(?:src|href)\s*=\s*[\"']?(?:https?:)?//", outside)
    assert "default-src 'none'" in content
    (told,) = re.findall(r'<script type="application/vnd.plotly.v1\+json">(.*?)</script>', content, re.S)
    assert [trace.get("name") for trace in json.loads(told)["data"]] == [trace.name for trace in figure.data]
    assert len(content) < 2.5e6, "Plotly is packed"


def test_magnification_is_round_and_drawn() -> None:
    angle = np.linspace(0, 360, 100)
    figure = polar_figure({"a": (angle, 40 * np.cos(np.radians(2 * angle)))}, 100.0, title="x")
    assert "20 µm per division" in figure.layout.title.text
    rings = np.array(figure.layout.polar.radialaxis.tickvals) - 100.0
    assert np.allclose(rings * 1000.0 / 500.0, [float(text) for text in figure.layout.polar.radialaxis.ticktext])
    drawn = np.array(next(trace for trace in figure.data if trace.name == "a").r)
    assert drawn.max() == pytest.approx(100 + 40 * 500 / 1000, rel=1e-3)
    # Start and arrow are drawn over the run, not under it.
    assert [trace.mode for trace in figure.data][-2:] == ["lines", "markers"]


def test_a_page_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    target = tmp_path / "x.html"
    target.mkdir()
    with pytest.raises(StoreError):
        write_text(target, "x", "the page")
    assert [p.name for p in tmp_path.iterdir()] == ["x.html"]


def test_a_map_of_many_conditions_fits_below_its_headline_on_a_page() -> None:
    """It stood on a page of its own, and left the one before nearly empty."""
    made = residual_map(np.ones((100, 360)), [str(n) for n in range(100)], floor_um=0.5, title="Mean residual")
    assert (made.layout.height, made.layout.yaxis.dtick) == (800, 2)


def test_an_error_of_any_size_is_drawn() -> None:
    angle = np.linspace(0.0, 360.0, 100)
    for largest_um in (0.0, 1e-12, 1e60):
        polar_figure({"measured": (angle, largest_um * np.sin(angle))}, 100.0, title="", plane="XY")
