"""The summary of published systems counts what follows and names what does not."""

from __future__ import annotations

import numpy as np

from dtwin.report.papers import summary_text


def line(what: str, follows: object) -> dict[str, object]:
    return {"what": what, "paper": "12 um", "ours": "30 um", "follows": follows}


def test_what_does_not_follow_is_named_with_both_figures() -> None:
    found = {
        "lathe": {
            "source": "a thesis",
            "lines": [line("table", True), line("networks", np.False_)],
        },
        "mill": {"source": "a paper", "lines": [line("heat", None), line("balls", True)]},
    }
    said = summary_text(found).splitlines()
    assert [row.split()[-3:] for row in said[2:4]] == [["1", "1", "0"], ["1", "0", "1"]]
    assert said[-1] == "  lathe: networks: 12 um; here 30 um"
    assert not any("balls" in row or "heat" in row for row in said)
