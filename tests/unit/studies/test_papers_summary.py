"""The summary of published systems counts every answer and names what does not follow."""

from __future__ import annotations

from typing import Any

import pytest

from studies import dynamics_paper, lathe_paper
from studies.paper_line import ANSWERS, Answer, Line, by_what_is_left, left_open, worst
from studies.report.papers import counted, summary_text


def line(what: str, answer: Answer) -> dict[str, str]:
    return {"what": what, "paper": "12 µm", "ours": "30 µm", "answer": answer, "target": ""}


def test_what_does_not_follow_is_named_with_both_figures() -> None:
    found = {
        "lathe": {"source": "a thesis", "lines": [line(a, a) for a in ANSWERS]},
        "mill": {"source": "a paper", "lines": [line("balls", "follows")]},
    }
    said = summary_text(found).splitlines()
    assert [row.split()[-5:] for row in said[2:4]] == [["1"] * 5, ["1", "0", "0", "0", "0"]]
    rest = said[said.index("what does not follow:") :]
    assert rest[1:] == [
        "  lathe: does not: 12 µm; here 30 µm",
        "",
        "easier here:",
        "  lathe: easier here: 12 µm; here 30 µm",
    ]
    assert counted(found["mill"]["lines"]).startswith("1 follows, 0 does not")


@pytest.mark.parametrize(
    ("ours", "answer"),
    [(10.0, "follows"), (14.9, "follows"), (6.7, "follows"), (15.1, "does not"), (6.6, "easier here")],
)
def test_better_than_the_source_is_not_the_same(ours: float, answer: Answer) -> None:
    assert by_what_is_left(ours, 10.0) == answer


def test_a_line_is_as_good_as_its_worst_figure() -> None:
    assert worst(["easier here", "follows"]) == "follows"
    assert worst(["follows", "does not", "easier here"]) == "does not"


def test_what_too_little_was_computed_for_is_not_judged() -> None:
    lines = [Line("networks", "yes", "no", "does not", t) for t in ("A1", "A8")]
    assert [x.answer for x in left_open(lines, ("A8",))] == ["does not", "not judged"]
    assert {x.answer for x in left_open(lines)} == {"not judged"}


@pytest.mark.parametrize("paper", [lathe_paper, dynamics_paper])
def test_quick_does_not_judge_what_may_flip(paper: Any) -> None:
    assert (paper.FULL.judged, paper.QUICK.judged) == (True, False)
