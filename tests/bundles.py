"""Small bundles for tests."""

from __future__ import annotations

from typing import Any

from dtwin.features.windows import WindowContract
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.interface import Input, Output, SafetyLimits, State

CONTRACT = WindowContract(1652.0, 150, 15, ("wrist_x_g", "wrist_y_g"), ("rms", "mean_frequency"), None, "none")


def path_bundle(**changes: Any) -> Bundle:
    """First harmonic of the path angle plus a filtered speed term."""
    g = GraphBuilder()
    angle, speed, kept = g.input("path_angle_rad"), g.input("commanded_speed_mm_s"), g.state("kept")
    after = kept + 0.1 * (speed - kept)
    radial = 20.0 * g.apply("sin", angle) + 0.05 * after
    arguments: dict[str, Any] = {
        "name": "first-harmonic",
        "machine": "cobot-a",
        "model_version": 3,
        "inputs": [
            Input("path_angle_rad", "rad", "path", 500.0, "path", -20.0, 20.0),
            Input("commanded_speed_mm_s", "mm/s", "path", 500.0, "path", 0.0, 120.0),
        ],
        "outputs": [Output("radial_error_um", "path_radial")],
        "states": [State("kept", "mm/s", 0.0)],
        "tick_graph": g.graph({"radial_error_um": radial}, {"kept": after}),
        "safety": SafetyLimits(clamp_um=40.0, slew_um_s=5000.0),
    }
    return create_bundle(**(arguments | changes))


def sensor_bundle(**changes: Any) -> Bundle:
    """Window graph and tick graph together."""
    w, g = GraphBuilder(), GraphBuilder()
    level = w.apply("log", 1.0 + w.input("wrist_x_rms_g") / 0.01)
    radial = g.input("level") * g.apply("cos", g.input("path_angle_rad"))
    radial = radial + 0.001 * g.input("wrist_y_mean_frequency_hz")
    arguments: dict[str, Any] = {
        "name": "level",
        "machine": "cobot-a",
        "model_version": 1,
        "inputs": [
            Input("path_angle_rad", "rad", "path", 500.0, "path", -20.0, 20.0),
            Input("wrist_x_rms_g", "g", "sensor", 110.0, "feature", 0.0, 2.0),
            Input("wrist_y_mean_frequency_hz", "Hz", "sensor", 110.0, "feature", 0.0, 826.0),
        ],
        "outputs": [Output("radial_error_um", "path_radial")],
        "window": CONTRACT,
        "window_graph": w.graph({"level": level}),
        "tick_graph": g.graph({"radial_error_um": radial}),
    }
    return create_bundle(**(arguments | changes))
