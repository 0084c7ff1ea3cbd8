"""Twins of several campaigns of a machine: what is fitted together, and how it compares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dtwin.errors import InputError
from dtwin.features.encoder_split import Cutoff
from dtwin.kinds.registry import kinds
from dtwin.physics.contradictions import without_contradictions
from dtwin.physics.effect import Effect
from dtwin.physics.problem import Term
from dtwin.physics.several import fit_several
from dtwin.physics.several_twin import SeveralTwin, pooled_figures, several_twin_of, started_of
from dtwin.twins.encoder_comparison import DEFAULT_CUTOFF
from dtwin.twins.measured import Comparison, Loaded

_PLACES = 5


@dataclass(frozen=True)
class SeveralComparison:
    """A twin of several campaigns against each of them."""

    twin: SeveralTwin
    parts: tuple[Comparison, ...]

    def as_dict(self, cutoff: Cutoff = DEFAULT_CUTOFF) -> dict[str, Any]:
        """Return a JSON-ready mapping: of all of them together, and of each by itself under ``campaigns``."""
        each = [part.as_dict(cutoff) for part in self.parts]
        places = [{**place, "campaign": one["campaign"]} for one in each for place in one["where"]]
        figures = pooled_figures(
            [{**one, "rms_after_um": one["residual_rms_um"]} for one in each],
            [float(part.obs.mask.sum()) for part in self.parts],
        )
        return {
            "twin": self.twin.name,
            "version": self.twin.version,
            "campaign": self.twin.campaign,
            "runs": sum(one["runs"] for one in each),
            "rms_before_um": figures["rms_before_um"],
            "residual_rms_um": figures["rms_after_um"],
            "systematic_rms_um": figures["systematic_rms_um"],
            "noise_floor_um": figures["noise_floor_um"],
            "noise_floor_dof": figures["noise_floor_dof"],
            "conditions": [{**c, "campaign": one["campaign"]} for one in each for c in one["conditions"]],
            "where": sorted(places, key=lambda place: -float(place["residual_rms_um"]))[:_PLACES],
            "headline": "; ".join(f"{one['campaign']}: {one['headline']}" for one in each),
            "encoder_split": next((one["encoder_split"] for one in each if one["encoder_split"]), None),
            "warnings": [f"{one['campaign']}: {line}" for one in each for line in one["warnings"]],
            "campaigns": each,
            "contradictions": [c.as_dict() for c in self.twin.contradictions],
        }


def fitted_together(
    loaded: Sequence[Loaded],
    terms: Sequence[Term],
    library: Mapping[str, Effect],
    *,
    name: str,
    version: int,
    action: str,
    robust: bool,
    refine: bool,
) -> SeveralTwin:
    """Return a twin of several campaigns; one that contradicts the others has values of its own and is named."""
    campaigns = [one.obs for one in loaded]
    together = fit_several(campaigns, terms, library, robust=robust, refine=refine)
    together, apart = without_contradictions(together, [started_of(obs) for obs in campaigns])
    data = [one.data for one in loaded]
    return several_twin_of(together, apart, campaigns, name=name, version=version, action=action, data=data)


def require_together(campaigns: Sequence[tuple[str, str, str]]) -> None:
    """Refuse campaigns that cannot have one twin.

    ``campaigns``: name, machine and kind of each.
    Raises ``InputError`` when one is named twice, they are of several machines, or of a kind that has no twins.
    """
    names = [name for name, _, _ in campaigns]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError("a campaign is named twice", code="twin.campaign_twice", got=twice)
    machines = dict.fromkeys(machine for _, machine, _ in campaigns)
    if len(machines) > 1:
        raise InputError(
            "a twin is of one machine",
            code="twin.machines",
            where=", ".join(names),
            got=", ".join(f"{name} of {machine}" for name, machine, _ in campaigns),
            hint="fit a twin to the campaigns of each",
        )
    with_twins = [kind.name for kind in kinds() if kind.offers("twins")]
    for name, _, kind in campaigns:
        if kind not in with_twins:
            raise InputError(
                "a campaign of this kind has no twin",
                code="twin.not_together",
                where=name,
                got=kind,
                allowed=", ".join(with_twins),
                hint=f"leave out {name}",
            )
