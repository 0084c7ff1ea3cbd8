"""The table of a source's figures beside ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dtwin.report.text import table

_HEADS = {
    "follows": "follow", "does not": "do not", "easier here": "easier here",
    "calibrated": "calibrated", "not judged": "not judged",
}  # fmt: skip
WHAT_IT_MEANS = (
    "easier here: better than the source by more than the tolerance, so not the same. calibrated: "
    "constants were set so that it comes out. not judged: not the same quantity, or too little computed."
)


def paper_table(lines: Sequence[Mapping[str, Any]], source: str = "the paper") -> str:
    """Return what, theirs, ours and the answer, with target numbers where there are some.

    Parameters
    ----------
    lines : sequence of dict
        Fields of :class:`dtwin.pipeline.paper_line.Line`.
    source : str
        Head of the column of theirs.
    """
    numbered = any(line["target"] for line in lines)
    rows = [
        [line["target"]] * numbered + [line[key] for key in ("what", "paper", "ours", "answer")]
        for line in lines
    ]
    head = ([""] * numbered) + ["figure", source, "ours", "answer"]
    return "\n".join([table(head, rows), counted(lines)])


def counted(lines: Sequence[Mapping[str, Any]]) -> str:
    """Return how many figures have each answer, as one line."""
    return ", ".join(f"{sum(line['answer'] == a for line in lines)} {a}" for a in _HEADS)


def summary_text(found: Mapping[str, Mapping[str, Any]]) -> str:
    """Return for each source how many figures have which answer, and what does not follow.

    Parameters
    ----------
    found : mapping
        ``source`` and ``lines`` by name; lines as for :func:`paper_table`.
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
