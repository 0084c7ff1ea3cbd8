"""Figures of published systems beside ours: the table of each, and the summary of all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dtwin.report.text import table

_HEADS = {
    "follows": "follow",
    "does not": "do not",
    "easier here": "easier here",
    "calibrated": "calibrated",
    "not judged": "not judged",
}
WHAT_IT_MEANS = (
    "easier here: better than the source by more than the tolerance, so not the same. calibrated: "
    "constants were set so that it comes out. not judged: not the same quantity, or too little computed."
)


def paper_table(lines: Sequence[Mapping[str, Any]], source: str = "the paper") -> str:
    """Return what, theirs, ours and the answer, with target numbers where there are some.

    ``lines``: fields of :class:`studies.paper_line.Line`.
    ``source``: head of the column of theirs.
    """
    numbered = any(line["target"] for line in lines)
    rows = [[line["target"]] * numbered + [line[key] for key in ("what", "paper", "ours", "answer")] for line in lines]
    head = ([""] * numbered) + ["figure", source, "ours", "answer"]
    return "\n".join([table(head, rows), counted(lines)])


def counted(lines: Sequence[Mapping[str, Any]]) -> str:
    """Return how many figures have each answer, as one line."""
    return ", ".join(f"{sum(line['answer'] == a for line in lines)} {a}" for a in _HEADS)


def summary_text(found: Mapping[str, Mapping[str, Any]]) -> str:
    """Return for each source how many figures have which answer, and what does not follow.

    ``found``: ``source`` and ``lines`` by name; lines as for :func:`paper_table`.
    """
    rows = [
        [name, paper["source"], *(sum(x["answer"] == a for x in paper["lines"]) for a in _HEADS)]
        for name, paper in found.items()
    ]
    parts = [table(("", "source", *_HEADS.values()), rows), WHAT_IT_MEANS]
    for answer, title in (("does not", "what does not follow:"), ("easier here", "easier here:")):
        parts += ["", title]
        parts += [
            f"  {name}: {line['what']}: {line['paper']}; here {line['ours']}"
            for name, paper in found.items()
            for line in paper["lines"]
            if line["answer"] == answer
        ]
    return "\n".join(parts)


def lathe_paper_text(found: Mapping[str, Any]) -> str:
    """Return the comparison with the thesis, and what tables of different steps leave."""
    steps = [[t["model"], *(f"{t[k]:z.1f}" for k in list(t) if k != "model")] for t in found["tables"]]
    return "\n".join(
        [
            paper_table(found["lines"], "the thesis"),
            "",
            "what tables leave of the printed error, without drift or noise, at every 0.013 in (µm):",
            table(("", "max average", "max reversal", "rms"), steps),
        ]
    )


def turning_paper_text(found: Mapping[str, Any]) -> str:
    """Return the comparison with the published slide."""
    return "\n".join([paper_table(found["lines"]), "", *found["told"]])


def dynamics_paper_text(found: Mapping[str, Any]) -> str:
    """Return the comparison with the paper, the machines and the feed sweep."""
    sweep = found["sweep"]
    return "\n".join(
        [
            paper_table(found["lines"]),
            "",
            "simulated machines, both directions, µm: CD after by vibration, minus CD after without;",
            "what is taken out of a still machine; DC3 beside the RMS of the vibration put in:",
            table(*_machines(found["cases"])),
            "",
            "virtual hexapod, low-pass, mean of both directions (µm; accelerometer Y in g RMS):",
            table(list(sweep[0]), [list(row.values()) for row in sweep]),
        ]
    )


def _machines(cases: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[object]]]:
    heights = sorted({c["vibration_um"] for c in cases} - {0.0})
    head = ["machine", "way", *(f"off at {h:g}" for h in heights), "DC3 still"]
    head += [f"DC3 at {h:g} ({h / np.sqrt(12.0):z.2f})" for h in heights]
    rows: list[list[object]] = []
    for machine, how in dict.fromkeys((c["machine"], c["how"]) for c in cases):
        mine = [c for c in cases if (c["machine"], c["how"]) == (machine, how)]
        by = {h: [c for c in mine if c["vibration_um"] == h] for h in (0.0, *heights)}
        rows.append(
            [
                machine,
                how,
                *(max((c["off_um"] for c in by[h]), key=abs) for h in heights),
                *(float(np.mean([c["dc3_um"] for c in by[h]])) for h in (0.0, *heights)),
            ]
        )
    return head, [[round(v, 2) if isinstance(v, float) else v for v in row] for row in rows]


TEXTS = {"lathe": lathe_paper_text, "turning": turning_paper_text, "dynamics": dynamics_paper_text}
