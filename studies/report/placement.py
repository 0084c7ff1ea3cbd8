"""Three circles on a sphere, placements, and the thesis's tables computed again, as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dtwin.report.text import table

NOT_COMPARABLE = (
    "The thesis's -55.35 %, -31.6 %, -4 % and its case 49 % worse are not comparable with ours:",
    "  - its deviations of the circles hold the mounting of the bar, which a constant offset of X",
    "    and Y moves; ours have one centre and one length taken out (its kind of figure is the MAE above);",
    "  - its placements are measured from the mean of both ways, so that a bias common to one way",
    "    is shared out between them; ours from a datum that was set before;",
    "  - it compares means of ten, ours is the mean distance of single placements;",
    "  - its machine is a real one, ours is virtual and does not wear, flex or drift beyond what is",
    "    written in its parameters.",
)


def placement_text(found: Mapping[str, Any]) -> str:
    """Return what was measured and what follows from the published tables.

    ``found``: what ``placement_story`` returned.
    """
    parts = [_sphere(found["sphere"]), _placements(found["placements"])]
    parts += [_verdict(found), _published(found["published"]), "\n".join(NOT_COMPARABLE)]
    return "\n\n".join(parts)


def _sphere(sphere: Mapping[str, Any]) -> str:
    rows = [
        [
            f"{r['feed_mm_min']:g}" + ("" if r["trained"] else " *"),
            len(r["rms_um"]["uncompensated"]),
            *_before_after(r),
            *(
                f"{sum(r['raw_mae_um'][way]) / len(r['raw_mae_um'][way]):z.1f}"
                for way in ("uncompensated", "compensated")
            ),
        ]
        for r in sphere["feeds"]
    ]
    head = (
        "feed, mm/min",
        "runs",
        "before, µm",
        "after, µm",
        "oracle, µm",
        "change, µm",
        "reduction",
        "of oracle",
        "MAE before, µm",
        "MAE after, µm",
    )
    return "\n".join(
        [
            "1 of 3  three circles at three heights, R 150 mm, clockwise, a stop every quarter, by a table "
            "of this one path",
            f"({sphere['clock']}; correction and oracle with {1e3 * sphere['delay_s']:z.0f} ms of "
            f"delay and lag, clamp {sphere['clamp_um']:z.0f} µm, slew {sphere['slew_um_s']:z.0f} "
            "um/s; a mounting that the fit has not seen; RMS with one centre and one length for "
            "all runs of a way; 95 % intervals, the run as unit; MAE: as the thesis counts, with "
            "the mounting in it; * feed never fitted)",
            table(head, rows),
        ]
    )


def _placements(found: Mapping[str, Any]) -> str:
    rows = [
        [
            r["motion"],
            f"{r['feed_mm_min']:g}",
            r["counted"]["uncompensated"],
            r["counted"]["compensated"],
            *_before_after(r),
        ]
        for r in found["conditions"]
    ]
    head = (
        "motion",
        "feed, mm/min",
        "n before",
        "n after",
        "before, µm",
        "after, µm",
        "oracle, µm",
        "change, µm",
        "reduction",
        "of oracle",
    )
    flags = ", ".join(f"{name} {count}" for name, count in found["flags"].items())
    low, high = found["temperature_c"]
    audit = [
        [
            a["bookkeeping"],
            *(f"{a[k]:z.1f}" for k in ("before_um", "after_um")),
            f"{100 * a['reduction']:z.1f} %",
            *(f"{a[k]:z.1f}" for k in ("before_sd_um", "after_sd_um")),
        ]
        for a in found["audit"]
    ]
    audit_head = ("bookkeeping", "before, µm", "after, µm", "reduction", "SD before, µm", "SD after, µm")
    return "\n".join(
        [
            "2 of 3  placements by MoveL and MoveJ, by a constant for each, learned and tried at this one "
            "place; the target is rewritten before its move starts",
            "(mean distance from where the block should lie, by a datum that was set before; the "
            "placement as unit, 95 % intervals; order drawn anew for every repeat; feeds "
            f"{', '.join(f'{f:g}' for f in found['trained_mm_min'])} mm/min were trained; clamp "
            f"{found['clamp_um']:z.0f} µm)",
            table(head, rows),
            f"flagged by rule: {flags}; block from {low:z.1f} to {high:z.1f} C, its half length "
            f"grows by up to {found['growth_um']:z.1f} µm, which the evaluation takes off",
            "the same placements under other bookkeeping:",
            table(audit_head, audit),
            f"data: {found['folder']}",
        ]
    )


def _before_after(r: Mapping[str, Any]) -> list[str]:
    return [
        f"{r['before_um']:z.1f} ± {r['before_half_width_um']:z.1f}",
        f"{r['after_um']:z.1f} ± {r['after_half_width_um']:z.1f}",
        f"{r['oracle_um']:z.1f}",
        f"{r['change_um']:+z.1f} ± {r['change_half_width_um']:z.1f}",
        f"{100 * r['reduction']:z.0f} %",
        f"{100 * r['share_of_oracle']:z.0f} %",
    ]


def _verdict(found: Mapping[str, Any]) -> str:
    if found["shortfalls"]:
        return "not reached: " + "; ".join(found["shortfalls"])
    return (
        f"every condition: at least {100 * found['wanted_share']:z.0f} % of the oracle's reduction, "
        "none worse beyond its confidence interval"
    )


def _published(published: Mapping[str, Any]) -> str:
    lines = ["3 of 3  the thesis's tables, computed again from what is printed (mm)", _xyz(published)]
    for motion in ("MoveL", "MoveJ"):
        lines += ["", f"{motion}:", *_motion(published[motion])]
    return "\n".join(lines)


def _xyz(published: Mapping[str, Any]) -> str:
    xyz = published["xyz"]
    rows = [
        [
            f"{r['feed_mm_min']:g}",
            f"{r['before_mm']:z.4f}",
            f"{r['after_mm']:z.4f}",
            f"{r['reduction_pct']:z.2f}",
            f"{r['printed_pct']:z.2f}",
            f"{r['change_mm']:+z.3f} ± {r['half_width_mm']:z.3f}",
            f"{r['mae_over_sd']:z.3f}",
        ]
        for r in xyz["rows"]
    ]
    head = ("feed", "before", "after", "less, %", "printed, %", "change (95 %, 3 runs)", "MAE/SD before")
    return "\n".join(
        [
            table(head, rows),
            f"mean {xyz['mean_reduction_pct']:z.2f} %, printed {xyz['printed_mean_pct']:z.2f} %: it "
            f"follows. MAE/SD of an off-centre bar is {xyz['sinusoid']:z.3f}, of scatter "
            f"{xyz['gaussian']:z.3f}.",
        ]
    )


def _motion(m: Mapping[str, Any]) -> list[str]:
    spread = [[r["condition"], r["printed"], f"{r['spread']:z.3f}", f"{r['mean']:z.3f}"] for r in m["mean_sd"]]
    zeros = [
        [r["condition"], *(f"{r[k]:z.3f}" for k in ("with_all", "printed", "as_zeros", "removed"))] for r in m["zeros"]
    ]
    radial = [
        [f"{r['feed_mm_min']:g}", *(f"{r[k]:z.1f}" for k in ("all_pct", "removed_pct", "stated_offset_pct"))]
        for r in m["radial"]["rows"]
    ]
    average = m["radial"]["average_pct"]
    radial.append(["average", *(f"{average[k]:z.1f}" for k in ("all", "removed", "stated_offset"))])
    offset, centred = m["offset"], m["centring"]
    lines = [
        'the printed "Mean SD" is the spread of the three deviations, not their mean:',
        table(("condition", "printed", "spread of three", "their mean"), spread),
        "deviations after removal count the removed placements as zeros:",
        table(("condition", "with all", "printed", "zeros counted", "removed"), zeros),
        f"offset printed {_pair(offset['printed'])}; the means that are left "
        f"({_pair(offset['mean_left'])}) say {_pair(offset['used'])} was subtracted",
        f"rows All, distance: without {centred['nc']:z.3f}, with {centred['wc']:z.3f}; their sum "
        f"{_pair(centred['sum'])} is zero wherever the offset is the mean of both; after removal "
        f"{centred['nc_removed']:z.3f} and {centred['wc_removed']:z.3f}, "
        f"{-centred['removed_pct']:+z.1f} %, printed {centred['printed_removed_pct']:z.1f} %",
        "reduction of the mean's distance, %: all placements, without anomalies as printed, all with the offset as stated:",
        table(("feed", "all", "without anomalies", "offset as stated"), radial),
        f"average printed without anomalies: {m['radial']['printed_average_pct']:z.1f} %",
    ]
    if m["limit"]["readings_mm"]:
        lines.append(
            f"two readings, {m['limit']['readings_mm']}, are the end of a travel: they differ by "
            f"{1e3 * max(m['limit']['apart_mm']):z.1f} µm"
        )
    return lines


def _pair(values: Any) -> str:
    return ", ".join(f"{v:+z.3f}" for v in values)
