"""What one recording told, for people."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from dtwin.report.html import Section, Table
from dtwin.report.plots import error_figure, styled
from dtwin.report.text import table
from dtwin.schema import Floats
from dtwin.units import shown_number
from studies.recording import Study

_RUNG_HEAD = ("added", "at", "linear parameters", "fit µm", "other pass µm", "grade")
_MODEL_HEAD = ("model", "parameters with shapes", "other pass µm", "path not fitted µm")


def recording_text(result: Mapping[str, Any]) -> str:
    """Return ``Study.result`` as text."""
    parts = [*_alignment(result), "", *_stretches(result), "", *_vendor(result), ""]
    for name, rungs in result["ladders"].items():
        chosen = ", lowest on the other pass" if name == result["best"] else ""
        parts += [f"Model '{name}'{chosen}:", table(_RUNG_HEAD, _rungs(rungs)), ""]
    parts += ["One family alone, added to centre and radius:"]
    parts += [f"  {_alone(one)}" for one in result["alone"]]
    parts += ["", table(_MODEL_HEAD, _models(result)), "", *_conclusion(result)]
    parts += ["", "Runs that would confirm or refute the names, cheapest first:"]
    parts += [f"  {number}. {_step(step)}" for number, step in enumerate(result["plan"], 1)]
    return "\n".join(parts)


def recording_sections(study: Study) -> list[Section]:
    """Return the sections of a page."""
    result = study.result
    steps = [_step(step) for step in result["plan"]]
    return [
        Section("Alignment", [*_alignment(result), *_stretches(result)]),
        Section("The vendor's model", list(_vendor(result))),
        Section(
            "From set-up to floor",
            tables=[Table(_RUNG_HEAD, _rungs(result["ladders"][result["best"]]))],
            figures=[_waterfall(result)],
        ),
        Section(
            "Models side by side",
            [_alone(one) for one in result["alone"]],
            tables=[Table(_MODEL_HEAD, _models(result))],
            figures=[error_figure(_curves(study), title="Second pass, and what the model leaves of it")],
        ),
        Section("What it means", [*_conclusion(result)]),
        Section("What to measure next", steps),
    ]


def _waterfall(result: Mapping[str, Any]) -> go.Figure:
    """Return how the error on the pass not fitted fell, down to the look-up and the floor.

    ``result``: ``Study.result``.
    """
    rungs = result["ladders"][result["best"]]
    names = ["set-up only", *(f"{n}. {r['label']}" for n, r in enumerate(rungs, 1))]
    heights = [result["setup_only_um"], *(r["held_out_um"] for r in rungs)]
    figure = go.Figure(go.Bar(x=names, y=heights, text=[f"{h:z.1f}" for h in heights]))
    lines = (("look-up of the other pass", "look_up_um"), ("within-run floor", "floor_um"))
    for name, key in lines:
        figure.add_hline(y=result[key], line={"dash": "dash"}, annotation_text=f"{name} {result[key]:z.1f} µm")
    figure.update_layout(title="Error on the pass that was not fitted", yaxis_title="RMS, µm")
    return styled(figure)


def _curves(study: Study) -> dict[str, tuple[Floats, Floats]]:
    curves: dict[str, tuple[Floats, Floats]] = {}
    at = 0
    for aligned in study.passes.aligned:
        angle = np.degrees(aligned.state.angle_rad)
        for stretch in aligned.stretches:
            rows = slice(at, at + stretch.end - stretch.first)
            at = rows.stop
            name = f"{stretch.run_id} from {stretch.first}"
            curves[f"{name}, measured"] = (angle[stretch.second], study.passes.y_um[1][rows])
            curves[f"{name}, left"] = (angle[stretch.second], study.residual_um[1][rows])
    return curves


def _alignment(result: Mapping[str, Any]) -> list[str]:
    return [
        f"{run['run_id']}: stops at samples {', '.join(map(str, run['stops']))}; the file's angles "
        f"are off by up to {run['misregistered_deg']:z.1f} deg; mean feed {run['feed_mm_min']:z.0f} mm/min"
        for run in result["runs"]
    ]


def _stretches(result: Mapping[str, Any]) -> list[str]:
    lines = [
        f"{s['run_id']}: samples {s['first']} to {s['end']} are seen again {s['lag_samples']} samples "
        f"later; {s['non_repeatable_um']:z.1f} µm RMS does not repeat"
        for s in result["stretches"]
    ]
    return [
        *lines,
        f"Floor {result['floor_um']:z.1f} µm ({result['floor_kind']}): a lower bound, for nothing "
        "was mounted or started twice.",
    ]


def _vendor(result: Mapping[str, Any]) -> Iterator[str]:
    vendor = result["vendor"]
    stated = vendor["stated_um"]
    yield from [] if stated is None else [f"The vendor states a residual of {stated:z.1f} µm RMS."]
    for key, name in (("file_angles", "the file's angles"), ("aligned_angles", "aligned angles")):
        one = vendor[key]
        yield (
            f"Terms of the same kinds ({one['parameters']} parameters) refitted at {name}: "
            f"{one['marked_window_um']:z.1f} µm in the marked windows; fitted to one pass they leave "
            f"{one['held_out_um']:z.1f} µm of the other."
        )


def _rungs(rungs: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    return [
        [
            r["label"],
            _shape(r["shape"]),
            str(r["parameters"]),
            f"{r['fit_um']:z.1f}",
            f"{r['held_out_um']:z.1f}",
            r["grade"],
        ]
        for r in rungs
    ]


def _shape(shape: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {shown_number(value, 4)}" for name, value in shape.items())


def _alone(one: Mapping[str, Any]) -> str:
    shape = _shape(one["shape"])
    return f"{one['family']}: {one['label']} ({shape}) leaves {one['held_out_um']:z.1f} µm"


def _models(result: Mapping[str, Any]) -> list[list[str]]:
    rows = [
        ["centre and radius", "3", result["setup_only_um"], result["setup_only_unseen_path_um"]],
        [f"effects ({result['best']})", str(result["parameters"]), result["held_out_um"], result["unseen_path_um"]],
    ]
    for name, one in result["harmonics"].items():
        label = f"harmonics, {name.replace('_', ' ')}, best up to {one['at_most']}"
        rows.append([label, str(one["parameters"]), one["held_out_um"], one["unseen_path_um"]])
    shown = [[r[0], r[1], f"{r[2]:z.1f}", f"{r[3]:z.1f}"] for r in rows]
    return [*shown, ["look-up of the other pass", "every sample", f"{result['look_up_um']:z.1f}", "-"]]


def _conclusion(result: Mapping[str, Any]) -> list[str]:
    count = result["rungs_that_carry_over"]
    carried = [r["label"] for r in result["ladders"][result["best"]][:count]]
    best = min([result["setup_only_unseen_path_um"], *result["unseen_path_by_rung_um"]])
    lines = np.array([line["frequency_hz"] for line in result["remaining_lines"]])
    return [
        _against(result),
        f"Verdict: {result['verdict']}. {result['unexplained_um']:z.1f} µm RMS that repeats is not "
        f"explained; strongest lines in it at {', '.join(f'{f:z.1f}' for f in lines)} Hz.",
        "The effects were chosen by the pass they were not fitted to, which lies on the same path: "
        "the figure is for this path only, and choosing by it flatters it.",
        f"On parts of the path left out of the estimates, {best:z.1f} µm is the lowest the effects "
        f"reach, with {', '.join(carried) if carried else 'centre and radius alone'}; what was "
        "added after that describes this recording and explains nothing elsewhere.",
        _waves_elsewhere(result, best),
        "Names are shape-consistent at most: one feed, one radius, one mounting.",
    ]


def _waves_elsewhere(result: Mapping[str, Any], effects_um: float) -> str:
    name, one = min(result["harmonics"].items(), key=lambda item: item[1]["unseen_path_um"])
    left = one["unseen_path_um"]
    better = "better" if left < effects_um else "no better"
    return f"There the best harmonics ({name.replace('_', ' ')}) do {better}: {left:z.1f} µm."


def _against(result: Mapping[str, Any]) -> str:
    held_out = result["held_out_um"]
    rivals = {f"harmonics ({n.replace('_', ' ')})": h["held_out_um"] for n, h in result["harmonics"].items()}
    if result["vendor"]["stated_um"] is not None:
        rivals["what the vendor states"] = result["vendor"]["stated_um"]
    rivals["the look-up"] = result["look_up_um"]
    said = [f"{'below' if held_out < r else 'not below'} {n}, {r:z.1f} µm" for n, r in rivals.items()]
    return f"On the pass not fitted the effects leave {held_out:z.1f} µm: {'; '.join(said)}."


def _step(step: Mapping[str, Any]) -> str:
    shift = f", {step['shift']}" if "shift" in step else ""
    return (
        f"R{step['radius_mm']:g} at {step['feed_mm_min']:g} mm/min, {' and '.join(step['directions'])}, "
        f"{step['repeats']} repeats{shift}: {step['tells']}"
    )
