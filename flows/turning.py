"""The slow-tool-servo paper, computed again."""

from __future__ import annotations

from typing import Any

from prefect import flow

from flows import _artifacts, _tasks

_JUDGED = {True: "yes", False: "no", None: "-"}


@flow(name="turning-paper")
def turning_paper_flow(quick: bool = False, seed: int = 0) -> dict[str, Any]:
    """Measure the virtual slide, fit, cut surfaces, and put every figure beside the printed one.

    Parameters
    ----------
    quick : bool
        24 groups instead of 99.
    seed : int
        Of all noise.
    """
    found = _tasks.turning_paper(quick, seed)
    rows = [[i["what"], i["paper"], i["ours"], _JUDGED[i["follows"]]] for i in found["lines"]]
    follows = [line["follows"] for line in found["lines"]]
    _artifacts.publish_table(
        "turning-paper", ("figure", "the paper", "ours", "follows"), rows,
        f"{follows.count(True)} figures follow, {follows.count(False)} do not; virtual slide",
    )  # fmt: skip
    return found
