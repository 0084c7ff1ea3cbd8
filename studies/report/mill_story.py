"""The mill of the source thesis, told right, as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dtwin.report.text import table

_LATER_HEAD = (
    "feed, mm/min",
    "runs",
    "before, µm",
    "after, µm",
    "after / before",
    "oracle, µm",
    "repeats, µm",
    "raw before",
    "raw after",
)


def mill_story_text(found: Mapping[str, Any]) -> str:
    """Return the story in four parts, and what the thesis measured.

    ``found``: what ``mill_story`` returned.
    """
    parts = [_learned(found), _refused(found), _told_right(found), _defects(found), _thesis(found)]
    return "\n\n".join(parts)


def _learned(found: Mapping[str, Any]) -> str:
    learned, later = found["learned"], found["later"]
    rows = [
        (f"{r['feed_mm_min']:g}", r["runs"], f"{r['r2']:z.3f}", _um(r["before_um"]), _um(r["after_um"]))
        for r in learned["rows"]
    ]
    served = later["ways"]["map of one session"]
    worse = [c for c in served if c["worse"]]
    says = (
        f"the set-up-corrected error grows in {len(worse)} of {len(served)} feeds"
        if worse
        else "the set-up-corrected error does not grow: the machine was too much like in the session that was learned"
    )
    return "\n".join(
        [
            "1 of 4  as the thesis did: one session, one mounting of the bar; runs 1 to 3 of each "
            "feed learned, run 4 left out",
            table(("feed, mm/min", "runs", "R²", "before, µm RMS", "after, µm RMS"), rows),
            f"served in a later session: bar mounted anew, machine at {_span(later)} instead of "
            f"{_span(learned)}; all ways interleaved in random order, the run as unit",
            "(before, after: RMS with centre and radius of the mounting out, ratio with its 95 % "
            "interval; repeats: what circles without correction disagree by, at their temperatures; raw: "
            "mean absolute reading)",
            table(_LATER_HEAD, _later(served)),
            f"{says}; {_promised(learned, served)}",
        ]
    )


def _promised(learned: Mapping[str, Any], served: Sequence[Mapping[str, Any]]) -> str:
    promised = max(r["after_um"] for r in learned["rows"])
    got = [c["raw_after_um"] for c in served]
    return (
        f"the R² promised a raw error of at most {_um(promised)} µm, measured is {_um(min(got))} to {_um(max(got))} µm"
    )


def _refused(found: Mapping[str, Any]) -> str:
    learned, gates = found["learned"], found["map_gates"]
    share = learned["mounting_share"]
    return "\n".join(
        [
            "2 of 4  what the gates say of that map",
            *_verdicts(gates["offline"]),
            f"promotion without closed-loop evidence: {_first(gates['without_evidence'])}",
            f"promotion with what was measured above: {_first(gates['with_evidence'])}",
            *_blind(gates["offline"]),
            f"audit: {100 * share:z.1f} % of the mean square of what it learned is centre and radius "
            "of that mounting, and all of it is a function of the position only "
            "(dtwin demo position-map looks at the thesis's own equation)",
        ]
    )


def _blind(offline: Sequence[Mapping[str, Any]]) -> list[str]:
    if not all(v["passed"] for v in offline):
        return []
    return ["the offline gates do not see it: all that they hold out is of the session that was learned"]


def _told_right(found: Mapping[str, Any]) -> str:
    twin, later = found["twin"], found["later"]
    rows = later["ways"]["told right"]
    values = [
        (e["effect"], e["name"], f"{e['value']:z.1f} ± {e['uncertainty']:z.1f} {e['unit']}") for e in twin["estimates"]
    ]
    terms = [(t["label"], "yes" if t["included"] else "no", t["how"]) for t in twin["terms"]]
    missed = [f"{c['feed_mm_min']:g}" for c in rows if not c["halved"]]
    verdict = f"NOT halved at {', '.join(missed)} mm/min" if missed else "halved, or better, in every feed"
    gates = found["twin_gates"]
    outcome = "champion" if gates["champion"] else _first(gates["with_evidence"])
    return "\n".join(
        [
            "3 of 4  told right: two radii, every feed, random order, a cool-down in the middle of "
            f"each mounting; the twin knows {', '.join(twin['known'])}",
            f"compare: {_um(twin['residual_um'])} µm RMS are left; repeats disagree by "
            f"{_um(twin['floor_um'])} µm: something changes between them",
            f"diagnose: {twin['headline']}",
            f"add {twin['added'] or 'nothing'}: {_um(twin['rungs'][-1]['rms_after_um'])} µm RMS are "
            f"left, noise floor {_um(twin['rungs'][-1]['noise_floor_um'])} µm; {twin['after']}",
            table(("effect", "parameter", "value, k = 2"), values),
            table(("effect", "corrected", "how, or why not"), terms),
            "the temperature is an input of the correction: read once before each circle",
            "the same later session, which no fit has seen:",
            table(_LATER_HEAD, _later(rows)),
            f"set-up-corrected error {verdict}; the raw reading hardly changes: it is the mounting, "
            "which no correction of the machine should touch",
            f"promotion: {outcome}",
        ]
    )


def _defects(found: Mapping[str, Any]) -> str:
    rows = [
        (
            d["defect"],
            "not moved" if d["ratio"] is None else f"{d['ratio']:z.2f}",
            ", ".join(d["caught"]) or ("-" if d["defect"] == "as it should be" else "NOTHING"),
        )
        for d in found["defects"]
    ]
    return "\n".join(
        [
            "4 of 4  the defects of the thesis's programs, as switches on the right correction",
            table(("defect", "after / before", "caught by"), rows),
            _uncaught(found),
            f"not tried: {found['not_done']}",
        ]
    )


def _uncaught(found: Mapping[str, Any]) -> str:
    missed = [d for d in found["defects"] if d["defect"] in found["nothing_catches"]]
    if not missed:
        return "each is caught"
    worst = max(d["ratio"] for d in missed)
    return (
        f"with what nothing catches, at most {100 * worst:z.0f} % of the error without correction is "
        "left: it costs accuracy, which no gate asks for"
    )


def _thesis(found: Mapping[str, Any]) -> str:
    rows = [
        (
            f"{r['feed_mm_min']:g}",
            r["model"],
            "{:z.2f}, {:z.2f}".format(*r["r2"]),
            f"{r['printed']:+z.1f} %",
            f"{r['follows']:+z.1f} %",
        )
        for r in found["thesis"]
    ]
    head = (
        "feed, mm/min",
        "model",
        "its R² on the fourth data, X, Y",
        "table 6-6 as printed",
        "what its table 6-5 gives",
    )
    return "\n".join(
        [
            "what the thesis measured: change of the error by each of its models (+ is better)",
            table(head, rows),
            "not comparable: another machine, X and Y errors against the scales instead of a radius "
            "against a ball bar, no set-up error taken out, runs not interleaved, spread not given; "
            "why its correction failed cannot be told from what is printed",
        ]
    )


def _later(rows: Sequence[Mapping[str, Any]]) -> list[tuple[object, ...]]:
    return [
        (
            f"{c['feed_mm_min']:g}",
            c["n_with"],
            f"{_um(c['before_um'])} ± {_um(c['before_ci_um'])}",
            f"{_um(c['after_um'])} ± {_um(c['after_ci_um'])}",
            f"{c['ratio']:z.2f} ± {c['ratio_half_width']:z.2f}",
            _um(c["oracle_um"]),
            _um(c["floor_um"]),
            _um(c["raw_before_um"]),
            _um(c["raw_after_um"]),
        )
        for c in rows
    ]


def _verdicts(verdicts: Sequence[Mapping[str, Any]]) -> list[str]:
    return [f"  {'pass' if v['passed'] else 'FAIL'}  {v['gate']}: {v['reason']}" for v in verdicts]


def _first(reason: str) -> str:
    """Return what a refusal got, on one line; what was accepted says nothing."""
    got = [line.strip() for line in reason.splitlines() if line.strip().startswith("got:")]
    return f"REFUSED, {got[0].removeprefix('got: ')}" if got else reason or "accepted"


def _span(part: Mapping[str, Any]) -> str:
    low, high = part["temperature_c"]
    return f"{low:z.1f} to {high:z.1f} °C"


def _um(value: float) -> str:
    return f"{value:z.2f}"
