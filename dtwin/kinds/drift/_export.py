"""A drift of Z that follows one sensor, as settings of Klipper's module ``z_thermal_adjust``.

Read in the firmware's own source (``klippy/extras/z_thermal_adjust.py``): Z goes down by ``temp_coeff`` for each degree that
the sensor has risen since homing, read through one first-order lag of ``smooth_time``, and by no more than
``max_z_adjustment``.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.drift._data import Loaded
from dtwin.kinds.drift._diagnosis import written
from dtwin.kinds.drift._model import Term
from dtwin.kinds.drift._twins import DriftTwin, DriftTwins
from dtwin.lake.store import Lake
from dtwin.lifecycle.export import Export
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM

_HELD = ("steady", "lag")
_NOT_LOADED = "Read back by dtwin's own interpreter of this form; never loaded into a printer."
_CLAMP_SHARE = 1.25
# Time constants until a lag that began at 0 degC has forgotten it: 22 K become 0.15 K.
_SETTLED = 5.0


def export_twin(home: Home, twin: DriftTwin, form: str) -> Export:
    """Write a twin of drift for Klipper.

    Of several sensors that which moved Z most is kept; the others are left out and named.

    Raises ``InputError`` when it does not follow as Klipper does, or is not of Z.
    """
    loaded = DriftTwins(home).against(twin, twin.campaign).loaded
    _require_z(home, twin, loaded)
    ways = [
        _Way(t, v, v * loaded.series.column(t)) for t, v in zip(twin.terms, twin.document["per_kelvin"], strict=True)
    ]
    ways.sort(key=lambda way: -way.span_um)
    if not ways or ways[0].term.kind not in _HELD:
        raise InputError(
            "Klipper follows one sensor, at once or with one lag",
            code="export.effects",
            where=f"twin {twin.name}",
            got=", ".join(written(way.term) for way in ways) or "no effects",
            allowed="follows@SENSOR or lag@SENSOR as the effect that moved Z most",
            hint=f"dtwin twin fit {twin.campaign} --effects lag@SENSOR --name NAME",
        )
    left_out = {
        written(
            way.term
        ): f"Klipper follows one sensor; it moved Z by {way.span_um:z.0f} µm, so let it be steady from homing on"
        for way in ways[1:]
    }
    return Export(_settings(twin, ways, loaded), {}, left_out, (_NOT_LOADED,), twin.version, twin.machine)


@dataclass(frozen=True)
class _Way:
    """What follows one sensor; ``moved_um`` (n,): its part of the log."""

    term: Term
    per_kelvin: float
    moved_um: Floats

    @property
    def span_um(self) -> float:
        """Difference between its highest and its lowest."""
        return float(np.ptp(self.moved_um))


def _require_z(home: Home, twin: DriftTwin, loaded: Loaded) -> None:
    rows = [row for row in Lake(home.lake).runs(twin.campaign) if row["run_id"] == loaded.run_id]
    axis = str(json.loads(str(rows[0]["condition_json"])).get("axis", "")).upper()
    if axis != "Z":
        raise InputError(
            "Klipper corrects the drift of Z alone",
            code="export.axis",
            where=f"campaign {twin.campaign}, log {loaded.run_id}",
            got=f"axis {axis}" if axis else "no axis",
            allowed='condition = { axis = "Z" } in the [[run]]',
        )


def _settings(twin: DriftTwin, ways: Sequence[_Way], loaded: Loaded) -> str:
    kept, *others = ways
    largest_mm = _CLAMP_SHARE * float(np.abs(kept.moved_um - kept.moved_um[0]).max()) / UM_PER_MM
    said = [
        f"dtwin: twin {twin.name} version {twin.version} of machine {twin.machine}, campaign {twin.campaign}, log {loaded.run_id}",
        _NOT_LOADED,
        f"For printer.cfg, beside sensor_type, sensor_pin, min_temp and max_temp of the sensor that the log calls {kept.term.name}.",
        "It replaces what was in force while it was measured: measure with SET_Z_THERMAL_ADJUST ENABLE=0.",
        *(f"Left out, and wrong if it moves after homing: {written(way.term)}." for way in others),
    ]
    lines = ["[z_thermal_adjust]", f"temp_coeff: {kept.per_kelvin / UM_PER_MM:z.7f}"]
    if kept.term.tau_s:
        minutes = _SETTLED * kept.term.tau_s / 60.0
        said.append(
            f"Home Z no sooner than {minutes:z.0f} min after the firmware started: its smoothing begins at 0 degC."
        )
        lines.append(f"smooth_time: {kept.term.tau_s:z.1f}")
    return "\n".join([*(f"# {line}" for line in said), *lines, f"max_z_adjustment: {largest_mm:z.4f}"]) + "\n"
