"""Bundles: proved, refused when changed, and compiled without changing a value."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bundles import path_bundle, sensor_bundle

from dtwin.errors import DtwinError, GateRefusal, InputError, StoreError
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle import Bundle, _checksum
from dtwin.serve.bundle_file import load_bundle, save_bundle
from dtwin.serve.graph import Graph, Node
from dtwin.serve.interface import Input
from dtwin.serve.runtime import CompiledBundle
from dtwin.serve.tape import Tape


def saved(tmp_path: Path, bundle: Bundle) -> Path:
    return save_bundle(bundle, tmp_path / "bundle.json")


def resealed(path: Path, change: Any) -> None:
    """Change a bundle's content and give it a fitting checksum again."""
    data = json.loads(path.read_text())
    change(data)
    data["sha256"] = _checksum({k: v for k, v in data.items() if k != "sha256"})
    path.write_text(json.dumps(data))


@pytest.mark.parametrize("make", [path_bundle, sensor_bundle])
def test_survives_the_file(tmp_path: Path, make: Any) -> None:
    bundle = make()
    assert load_bundle(saved(tmp_path, bundle), "cobot-a").bundle == bundle


def test_tick_follows_the_equation_and_its_state() -> None:
    compiled = CompiledBundle(path_bundle())
    kept = 0.0
    for k in range(20):
        angle, speed = 0.3 * k, 50.0 + k
        kept += 0.1 * (speed - kept)
        expected = 20 * math.sin(angle) + 0.05 * kept
        assert compiled.tick(np.array([angle, speed]))[0] == pytest.approx(expected, abs=1e-12)
    compiled.reset()
    assert compiled.tick(np.array([0.0, 0.0]))[0] == 0.0


def test_many_ticks_are_the_ticks_one_by_one() -> None:
    rows = np.random.default_rng(0).uniform(0, 5, (50, 2))
    one, many = CompiledBundle(path_bundle()), CompiledBundle(path_bundle())
    single = np.array([one.tick(row).copy() for row in rows])
    assert np.array_equal(many.run(rows), single)


def test_window_values_are_held_until_the_next_window() -> None:
    compiled = CompiledBundle(sensor_bundle())
    compiled.window(np.array([0.05, 100.0]))
    expected = math.log(1 + 0.05 / 0.01) * math.cos(0.4) + 0.1
    assert compiled.tick(np.array([0.4]))[0] == pytest.approx(expected, abs=1e-12)
    assert compiled.tick(np.array([0.4]))[0] == pytest.approx(expected, abs=1e-12)
    np.testing.assert_allclose(compiled.run(np.full((3, 1), 0.4)), expected, atol=1e-12)


def test_changed_number_is_refused(tmp_path: Path) -> None:
    path = saved(tmp_path, path_bundle())
    path.write_text(path.read_text().replace("20.0", "200.0", 1))
    with pytest.raises(InputError, match="changed"):
        load_bundle(path)


def test_changed_equation_with_a_new_checksum_is_not_proved(tmp_path: Path) -> None:
    path = saved(tmp_path, path_bundle())

    def change(data: dict[str, Any]) -> None:
        node = next(n for n in data["tick_graph"]["nodes"] if n.get("value") == 20.0)
        node["value"] = 20.0 + 1e-6

    resealed(path, change)
    with pytest.raises(GateRefusal, match="not proved"):
        load_bundle(path)


def test_features_that_differ_by_one_bit_are_not_proved(tmp_path: Path) -> None:
    path = saved(tmp_path, sensor_bundle())

    def change(data: dict[str, Any]) -> None:
        values = data["vectors"]["window_features"]
        values[0] = math.nextafter(values[0], 1.0)

    resealed(path, change)
    with pytest.raises(GateRefusal, match="features differ"):
        load_bundle(path)


def test_bundle_without_test_vectors_is_not_proved(tmp_path: Path) -> None:
    path = saved(tmp_path, path_bundle())
    resealed(path, lambda d: d["vectors"].update(inputs=[], features=[], outputs=[]))
    with pytest.raises(GateRefusal, match="test vectors"):
        load_bundle(path)


@pytest.mark.parametrize(
    "change",
    [
        lambda v: v["inputs"].pop(),
        lambda v: v["features"].clear(),
        lambda v: v["outputs"].__setitem__(0, []),
        lambda v: v["outputs"][0].append(1.0),
    ],
)
def test_test_vectors_of_another_shape_are_not_proved(tmp_path: Path, change: Any) -> None:
    path = saved(tmp_path, path_bundle())
    resealed(path, lambda content: change(content["vectors"]))
    with pytest.raises(GateRefusal, match="not proved"):
        load_bundle(path)


def test_a_bundle_of_another_machine_is_refused(tmp_path: Path) -> None:
    path = saved(tmp_path, sensor_bundle())
    with pytest.raises(GateRefusal, match="another machine") as refusal:
        load_bundle(path, "cobot-b")
    assert refusal.value.exit_code == 3


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d["inputs"][0].update(rate_hz=0.0),
        lambda d: d["inputs"][0].update(rate_hz=1e-320),
        lambda d: d["tick_graph"]["nodes"].insert(0, {"op": "__import__", "args": []}),
        lambda d: d["tick_graph"]["nodes"].insert(0, {"op": "exec", "name": "os"}),
        lambda d: d["tick_graph"]["nodes"][-1].update(args=[10**9, 0]),
        lambda d: d["tick_graph"]["nodes"][-1].update(args=[-1, 0]),
        lambda d: d["tick_graph"]["nodes"][-1].update(args=["0", 0]),
        lambda d: d["tick_graph"].update(outputs={"radial_error_um": 10**6}),
        lambda d: d["tick_graph"].update(outputs={}),
        lambda d: d["tick_graph"].update(nodes=[{"op": "const", "value": 1.0}] * 5000),
        lambda d: d["tick_graph"].update(nodes="x" * 10),
        lambda d: d["tick_graph"]["tables"].append({"start": 0, "spacing": 0, "values": [1, 2], "periodic": False}),
        lambda d: d["inputs"][0].update(low="-20"),
        lambda d: d["inputs"][0].update(low=30.0),
        lambda d: d["inputs"][0].update(frame="wrist"),
        lambda d: d["inputs"].append(d["inputs"][0]),
        lambda d: d["inputs"].pop(),
        lambda d: d["outputs"][0].update(unit="mm"),
        lambda d: d["outputs"][0].update(role="maybe"),
        lambda d: d["safety"].update(clamp_um=0.0),
        lambda d: d["safety"].update(trips_to_latch=True),
        lambda d: d.update(machine="../../etc"),
        lambda d: d.update(version=2),
        lambda d: d.update(format="other"),
        lambda d: d.update(extra=1),
        lambda d: d.pop("safety"),
        lambda d: d["vectors"]["inputs"][0].append(1.0),
        lambda d: d["provenance"].update(evidence="excellent"),
        lambda d: d["provenance"].update(gates={"sign": "yes"}),
    ],
)
def test_malformed_content_is_refused(tmp_path: Path, change: Any) -> None:
    path = saved(tmp_path, path_bundle())
    resealed(path, change)
    with pytest.raises(DtwinError):
        load_bundle(path)


@pytest.mark.parametrize(
    "raw", [b"", b"{", b"[]", b"\xff\xfe", b"[" * 100_000, b'{"format": NaN}', b'{"a": 1, "a": 2}']
)
def test_malformed_files_are_refused(tmp_path: Path, raw: bytes) -> None:
    path = tmp_path / "bundle.json"
    path.write_bytes(raw)
    with pytest.raises(InputError):
        load_bundle(path)


def test_missing_and_huge_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        load_bundle(tmp_path / "none.json")
    huge = tmp_path / "huge.json"
    with huge.open("wb") as file:
        file.truncate(9_000_000)
    with pytest.raises(InputError, match="too large"):
        load_bundle(huge)


def test_nan_in_a_file_is_refused(tmp_path: Path) -> None:
    path = saved(tmp_path, path_bundle())
    path.write_text(path.read_text().replace("20.0", "NaN", 1))
    with pytest.raises(InputError, match="JSON"):
        load_bundle(path)


def test_folder_that_cannot_be_written_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError):
        save_bundle(path_bundle(), tmp_path / "file" / "bundle.json")
    path = saved(tmp_path, path_bundle())
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(["file", path.name])


def test_model_that_is_not_finite_in_its_box_is_refused() -> None:
    g = GraphBuilder()
    graph = g.graph({"radial_error_um": 1.0 / g.input("commanded_speed_mm_s")})
    with pytest.raises(InputError, match="not finite"):
        path_bundle(
            tick_graph=graph,
            states=(),
            inputs=[Input("commanded_speed_mm_s", "mm/s", "path", 500.0, "path", 0.0, 120.0)],
        )


def test_constant_that_is_not_finite_is_refused() -> None:
    with pytest.raises(InputError, match="not finite"):
        Graph((Node("const", value=math.nan),), {"y": 0})


def test_deep_graph_is_refused() -> None:
    g = GraphBuilder()
    x = g.input("x")
    for _ in range(300):
        x = g.apply("sin", x)
    with pytest.raises(InputError, match="deep"):
        g.graph({"y": x})


def test_builder_shares_equal_terms_and_drops_unused_ones() -> None:
    g = GraphBuilder()
    x = g.input("x")
    g.apply("exp", x)
    y = g.apply("sin", 2 * x) + g.apply("sin", 2 * x)
    assert [n.op for n in g.graph({"y": y}).nodes] == ["input", "const", "mul", "sin", "add"]
    with pytest.raises(InputError, match="no such operation"):
        g.apply("system", x)
    with pytest.raises(InputError, match="no such operation"):
        g.apply("sin", x, x)


def test_states_update_together() -> None:
    g = GraphBuilder()
    a, b = g.state("a"), g.state("b")
    tape = Tape(g.graph({"y": a - b}, {"a": b, "b": a}), [], {"a": 1.0, "b": 5.0}, ["y"])
    assert [float(tape.run(np.zeros(0))[0]) for _ in range(3)] == [-4.0, 4.0, -4.0]


def test_wrong_count_of_inputs_is_refused() -> None:
    compiled = CompiledBundle(path_bundle())
    for count in (0, 1, 3):
        with pytest.raises(ValueError, match="wanted"):
            compiled.tick(np.zeros(count))
    with pytest.raises(ValueError, match=r"broadcast|inputs"):
        compiled.run(np.zeros((4, 3)))
