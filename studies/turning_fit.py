"""From a campaign folder of tones to a judged bundle."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dtwin.acquire.ingest import open_source
from dtwin.acquire.quality import judge_run
from dtwin.kinds.sinusoidal._bundle import ACTIONS as ACTIONS
from dtwin.kinds.sinusoidal._bundle import Action
from dtwin.kinds.sinusoidal._candidates import FORMS, form_candidate, searched_candidate, what_was_seen
from dtwin.kinds.sinusoidal._gates import tone_gates
from dtwin.kinds.sinusoidal._groups import ToneGroups, groups_of, heard_groups
from dtwin.progress import Progress, silent
from dtwin.serve.bundle import Bundle
from dtwin.train.results import Candidate, candidate_metrics
from studies.judged_bundle import JudgedBundle

_SEARCHED = "symbolic"
MODELS = (*FORMS, _SEARCHED)


@dataclass(frozen=True)
class FittedTones(JudgedBundle):
    """Equations of a campaign, judged.

    ``candidate``: with held-out scores and figures.
    ``told``: what the campaign shows before any equation.
    """

    candidate: Candidate
    told: list[str]


def folder_groups(folder: Path, progress: Progress = silent) -> tuple[str, ToneGroups]:
    """Return the machine and the groups of a campaign folder, runs with errors left out.

    Raises ``InputError`` when it is of another kind, or no run can be learned from.
    """
    campaign, sources, total = open_source(folder)
    campaign.of_kind("sinusoidal", str(folder))
    usable = []
    for done, (runs, _) in enumerate(sources, start=1):
        usable += [r for r in runs if not any(f.severity == "error" for f in judge_run(r))]
        progress(done, total, runs[0].meta.run_id if runs else "")
    return campaign.machine, groups_of(usable, str(folder))


def fitted_tones(machine: str, everything: ToneGroups, model: str, action: Action, seed: int) -> FittedTones:
    """Fit one form of equation, of ``MODELS``, and judge it."""
    groups = heard_groups(everything)
    if model == _SEARCHED:
        candidate = searched_candidate(groups, machine, None, seed, {}, action)
    else:
        candidate = form_candidate(groups, machine, model, {}, action)
    bundle = Bundle.from_dict(candidate.bundle)
    verdicts = tone_gates(bundle, candidate_metrics(candidate))
    return FittedTones(bundle, verdicts, candidate, what_was_seen(everything))
