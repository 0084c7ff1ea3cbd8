"""The table of a source's figures beside ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dtwin.report.text import table

_JUDGED = {True: "yes", False: "no", None: "-"}


def paper_table(lines: Sequence[Mapping[str, Any]], source: str = "the paper") -> str:
    """Return what, theirs, ours and whether it follows, with target numbers where there are some.

    Parameters
    ----------
    lines : sequence of dict
        ``what``, ``paper``, ``ours``, ``follows``, perhaps ``target``.
    source : str
        Head of the column of theirs.
    """
    numbered = any("target" in line for line in lines)
    rows = [
        [line.get("target", "")] * numbered
        + [line["what"], line["paper"], line["ours"], _JUDGED[line["follows"]]]
        for line in lines
    ]
    return table(([""] * numbered) + ["figure", source, "ours", "follows"], rows)


def summary_text(found: Mapping[str, Mapping[str, Any]]) -> str:
    """Return for each source how many figures follow, and which do not.

    Parameters
    ----------
    found : mapping
        ``source`` and ``lines`` by name; lines as for :func:`paper_table`.
    """
    rows, absent = [], []
    for name, paper in found.items():
        judged = [_JUDGED[line["follows"]] for line in paper["lines"]]
        rows.append([name, paper["source"], *(judged.count(value) for value in _JUDGED.values())])
        for line, follows in zip(paper["lines"], judged, strict=True):
            if follows == _JUDGED[False]:
                absent.append(f"  {name}: {line['what']}: {line['paper']}; here {line['ours']}")
    head = ("", "source", "figures follow", "do not", "not judged")
    return "\n".join([table(head, rows), "", "what does not follow:", *absent])
