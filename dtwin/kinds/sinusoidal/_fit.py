"""From a campaign folder of tones to a judged bundle."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from dtwin.acquire.ingest import open_source
from dtwin.acquire.quality import judge_run
from dtwin.errors import InputError
from dtwin.kinds.sinusoidal._bundle import Action
from dtwin.kinds.sinusoidal._candidates import FORMS, form_candidate, searched_candidate
from dtwin.kinds.sinusoidal._gates import tone_gates
from dtwin.kinds.sinusoidal._groups import ToneGroups, groups_of, heard_groups
from dtwin.kinds.sinusoidal._training import what_was_seen
from dtwin.progress import Progress
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import require_new, save_bundle
from dtwin.train.gates import Verdict
from dtwin.train.logged import candidate_metrics
from dtwin.train.results import Candidate

_SEARCHED = "symbolic"
MODELS = (*FORMS, _SEARCHED)


@dataclass(frozen=True)
class FittedTones:
    """Equations of a campaign, judged.

    ``candidate``: with held-out scores and figures.
    ``told``: what the campaign shows before any equation.
    """

    candidate: Candidate
    bundle: Bundle
    verdicts: list[Verdict]
    told: list[str]

    @property
    def passed(self) -> bool:
        """Whether every gate passed."""
        return all(v.passed for v in self.verdicts)


def folder_groups(folder: Path, progress: Progress | None = None) -> tuple[str, ToneGroups]:
    """Return the machine and the groups of a campaign folder, runs with errors left out.

    Raises ``InputError`` when it is of another kind, or no run can be learned from.
    """
    campaign, sources, total = open_source(folder)
    if campaign.kind != "sinusoidal":
        raise InputError(
            "not a campaign of tones", code="turning.kind", where=str(folder), got=campaign.kind, allowed="sinusoidal"
        )
    usable = []
    for done, (runs, _) in enumerate(sources, start=1):
        usable += [r for r in runs if not any(f.severity == "error" for f in judge_run(r))]
        if progress is not None:
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
    provenance = replace(bundle.provenance, gates={v.gate: v.passed for v in verdicts})
    return FittedTones(candidate, replace(bundle, provenance=provenance), verdicts, what_was_seen(everything))


def write_tones(made: FittedTones, out: Path, *, force: bool = False) -> None:
    """Write the bundle. Raises ``InputError`` when the file is there."""
    require_new(out, force=force)
    save_bundle(made.bundle, out)
