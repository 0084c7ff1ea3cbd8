"""A fresh candidate and the champion on the same runs, for the reviewer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.lake.store import Lake
from dtwin.lifecycle.drift import champion_error, trained_rows
from dtwin.lifecycle.train import Registered
from dtwin.report.html import Section, Table, page
from dtwin.train.champion_error import um_text
from dtwin.train.promotion import verdict_lines
from dtwin.train.registry import RegisteredVersion, Registry


@dataclass(frozen=True)
class Comparison:
    """Candidate and champion on the same runs.

    ``candidate_um``, ``champion_um``, ``before_um``: set-up-corrected RMS: of the candidate with each group (feed, run,
    hours ...) left out of its fit in turn, of the champion as it would have been served, and without a model.
    ``noise_floor_um``: what repeats disagree by.
    ``n_runs``, ``seen_by_champion``: number of runs, and how many of them the champion was trained on.
    """

    candidate: str
    champion: str
    candidate_um: float
    champion_um: float
    before_um: float
    noise_floor_um: float
    n_runs: int
    seen_by_champion: int

    @property
    def verdict(self) -> str:
        """One sentence for the reviewer."""
        change = 1.0 - self.candidate_um / self.champion_um
        what = f"{abs(100 * change):z.0f} % {'less' if change > 0 else 'more'} error"
        known = (
            f"; the champion was trained on {self.seen_by_champion} of these runs, which flatters it"
            if self.seen_by_champion
            else ", none of which the champion ever saw"
        )
        return (
            f"candidate {self.candidate} leaves {what} than champion {self.champion} "
            f"({um_text(self.candidate_um)} against {um_text(self.champion_um)} µm) on {self.n_runs} runs" + known
        )

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Return head and rows for pages."""
        return ["", "µm RMS, held out"], [
            ["no correction", um_text(self.before_um)],
            [f"champion {self.champion}", um_text(self.champion_um)],
            [f"candidate {self.candidate}", um_text(self.candidate_um)],
            ["noise floor", um_text(self.noise_floor_um)],
        ]


def compare_with_champion(home: Home, registered: Registered, rows: Sequence[dict[str, Any]]) -> Comparison | None:
    """Compare a fresh candidate with the champion, and leave the result for the reviewer.

    ``rows``: rows of ``runs`` that it was trained on.
    None when there is no champion, or none that recorded runs can judge; the reason is then the version's tag
    ``against_champion``.
    """
    registry = Registry(home)
    report = registered.training.report
    champion = registry.champion(report.machine)
    tags = {"trained_by": "schedule"}
    if champion is None:
        registry.mark(registered.version, tags | {"against_champion": "there is no champion"})
        return None
    lake = Lake(home.lake)
    try:
        error = champion_error(registry, champion, lake, rows)
    except InputError as refused:
        registry.mark(registered.version, tags | {"against_champion": refused.message})
        return None
    seen = {row["content_sha256"] for row in trained_rows(registry, lake, champion)}
    comparison = Comparison(
        candidate=registered.version.version,
        champion=champion.version,
        candidate_um=report.candidate(report.proposed).held_out.rms_um,
        champion_um=error.rms_um,
        before_um=error.before_um,
        noise_floor_um=report.noise_floor_um,
        n_runs=error.n_runs,
        seen_by_champion=sum(row["content_sha256"] in seen for row in rows),
    )
    _leave_for_reviewer(registry, registered, champion, comparison)
    registry.mark(registered.version, tags | {"against_champion": comparison.verdict})
    return comparison


def _leave_for_reviewer(
    registry: Registry, registered: Registered, champion: RegisteredVersion, comparison: Comparison
) -> None:
    section = Section(
        "Against the champion",
        [
            comparison.verdict + ".",
            "Both errors are on the same runs, what belongs to a set-up taken out. The candidate is scored with "
            f"every {registered.training.report.candidate(registered.training.report.proposed).held_out.group} left "
            "out of its search and fit in turn; the champion is its frozen bundle, as limited by its validity box "
            "when served.",
            "Nothing was promoted: dtwin promote does that, after trial and evidence.",
            *verdict_lines(registered.verdicts),
        ],
        tables=[Table(*comparison.table())],
    )
    title = f"Version {comparison.candidate} against champion {champion.version}"
    registry.attach(
        registered.version, {"against-champion.html": page(title, f"machine {champion.machine}", [section])}
    )
    before = registry.description(registered.version)
    registry.mark(registered.version, {}, description=f"{before}\n\nScheduled training: {comparison.verdict}.")
