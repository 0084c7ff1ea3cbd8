"""The equation of a positioning test as tables for controls."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dtwin.errors import InputError
from dtwin.kinds.linear._bundle import ROOM_MM, deployed_bundle, held, printed_pair, remembering_bundle
from dtwin.lifecycle.export import Request, Source, export
from dtwin.machines.printed_network import read_network
from dtwin.serve.builder import Expression, GraphBuilder

LOW, HIGH = 25.0, 425.0


def error_um(x: Any, play_um: float, sine: Callable[[Any], Any]) -> Any:
    """40 um over a metre, a wave of 100 mm, and half of the play."""
    return x * 40e-3 + sine(x * (2 * np.pi / 100.0)) * 3.0 + play_um


def source(wave_mm: float = 100.0) -> Source:
    builder = GraphBuilder()

    def limit(half_um: float) -> Callable[[Expression], Expression]:
        def sine(angle: Expression) -> Expression:
            return builder.apply("sin", angle * (100.0 / wave_mm))

        return lambda position: error_um(held(builder, position, (LOW, HIGH)), half_um, sine)

    travel = (LOW - ROOM_MM, HIGH + ROOM_MM)
    bundle = remembering_bundle(builder, [limit(-4.0), limit(4.0)], "screw", "lathe", travel)
    return Source(bundle, "champion", None, "3")


def rows(text: str) -> np.ndarray:
    return np.array([[float(v) for v in line.split()] for line in text.splitlines() if line[0] != "#"])


@pytest.mark.parametrize("origin", [0.0, -500.0])
def test_a_compensation_file_takes_the_error_away_in_both_directions(origin: float) -> None:
    made = export(source(), Request("comp", axis="Z", origin_mm=(0.0, 0.0, origin)))
    table = rows(made.text)
    assert (table[0, 0], table[-1, 0]) == pytest.approx((LOW + origin, HIGH + origin))
    rng = np.random.default_rng(4)
    command, way = rng.uniform(LOW, HIGH, 1000), rng.choice([-1.0, 1.0], 1000)
    forward, reverse = (np.interp(command + origin, table[:, 0], table[:, n]) for n in (1, 2))
    motor = command + np.where(way > 0, forward, reverse)

    def off_um(x: np.ndarray) -> np.ndarray:
        return np.asarray(error_um(x, 0.0, np.sin) - 4.0 * way)

    left = 1000.0 * (motor - command) + off_um(motor)
    assert np.abs(off_um(command)).max() > 10.0
    assert np.abs(left).max() < 0.06
    assert "version 3, state champion" in made.text


@pytest.mark.parametrize("form", ["siemens", "siemens-cec", "heidenhain", "fanuc", "fanuc30i", "beckhoff"])
def test_every_form_of_one_axis_is_written(form: str) -> None:
    made = export(source(), Request(form, axis="Z"))
    assert "Z" in made.text.upper()
    assert made.figures["axes"]["Z"]["largest_um"] > 10.0
    if form == "siemens":
        assert "MD32450 $MA_BACKLASH[0,Z1] = 0.008000" in made.text


def test_csv_has_the_one_axis() -> None:
    lines = export(source(), Request("csv")).text.splitlines()
    assert {line.split(",")[0] for line in lines[1:]} == {"Z"}


def test_a_network_with_a_flag_for_the_direction_is_tabulated_too() -> None:
    trained = Source(deployed_bundle(printed_pair(read_network()), "net", "lathe"), "champion", None, "3")
    assert len(export(trained, Request("comp", axis="Z", points=200)).text.splitlines()) > 200


def test_mistakes_are_told() -> None:
    for request, said in (
        (Request("comp", axis="X"), "for one axis"),
        (Request("comp", axis="Z", travel_mm=(-100.0, -50.0)), "nothing of this travel"),
        (Request("klipper"), "error of single axes"),
        (Request("reprap"), "error of single axes"),
        (Request("gcode"), "error of single axes"),
    ):
        with pytest.raises(InputError, match=said):
            export(source(), request)
    beyond = export(source(), Request("comp", axis="Z", travel_mm=(0.0, 425.0)))
    assert "axis Z: measured from 25 to 425 mm; beyond, the table keeps the values of its ends" in beyond.notes


def test_a_table_that_would_add_to_the_error_is_refused() -> None:
    builder = GraphBuilder()
    wave = [lambda x: builder.apply("cos", x * (2 * np.pi / 10.0)) * 3.0] * 2
    bundle = remembering_bundle(builder, wave, "screw", "lathe", (-ROOM_MM, 400.0 + ROOM_MM))
    fine = Source(bundle, "champion", None, "3")
    # Rows of 20 mm meet every crest of a wave of 10 mm; those of 9 mm make another wave of it.
    for points in (21, 45):
        with pytest.raises(InputError, match="takes nothing of the error away"):
            export(fine, Request("comp", axis="Z", points=points))
    assert export(fine, Request("comp", axis="Z", points=250)).figures
