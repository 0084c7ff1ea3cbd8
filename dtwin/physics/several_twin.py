"""A twin of several campaigns of a machine: its effects once, and the twin as each campaign sees it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dtwin.physics.contradictions import Contradiction
from dtwin.physics.effect import Effect
from dtwin.physics.fit import Estimate
from dtwin.physics.machine_terms import is_shared, key_of, seen_by
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.several import SeveralFit
from dtwin.physics.twin import Twin, ValidityBox, twin_of
from dtwin.schema import Floats

_SUMMED = ("rms_before_um", "rms_after_um", "systematic_rms_um", "noise_floor_um")


@dataclass(frozen=True)
class SeveralTwin(Twin):
    """A twin of several campaigns; what a :class:`Twin` has is of all of them together.

    ``parts``: as each campaign sees it: effects by the names that they have there, its set-ups, figures and box.
    ``about``: of each campaign ``kind``, ``started`` and ``weight``, the last in 1/um.
    ``contradictions``: campaigns that have a value of their own, because they contradict the others.
    """

    parts: tuple[Twin, ...] = ()
    about: tuple[Mapping[str, Any], ...] = ()
    contradictions: tuple[Contradiction, ...] = ()

    @property
    def campaigns(self) -> tuple[str, ...]:
        """Campaigns that it was fitted to."""
        return tuple(part.campaign for part in self.parts)

    def on(self, campaign: str) -> Twin:
        """Return the twin as one of its campaigns sees it."""
        return next(part for part in self.parts if part.campaign == campaign)

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        document = super().as_dict()
        document["campaigns"] = [
            {
                "campaign": part.campaign,
                **about,
                "runs": part.data.get("n_runs"),
                "rms_before_um": part.figures["rms_before_um"],
                "residual_rms_um": part.figures["rms_after_um"],
                "systematic_rms_um": part.figures["systematic_rms_um"],
                "noise_floor_um": part.figures["noise_floor_um"],
                "part": part.as_dict(),
            }
            for part, about in zip(self.parts, self.about, strict=True)
        ]
        document["contradictions"] = [c.as_dict() for c in self.contradictions]
        return document


@dataclass(frozen=True)
class SeenTwin(Twin):
    """A twin of several campaigns as one of them sees it.

    ``covariance``, (parameters, parameters): of the parameters of its effects, in their order: by all campaigns, which
    one of them alone does not tell.
    """

    covariance: Floats = field(default_factory=lambda: np.zeros((0, 0)))


def several_twin_of(
    fitted: SeveralFit,
    contradictions: Sequence[Contradiction],
    campaigns: Sequence[Observations],
    *,
    name: str,
    version: int,
    action: str,
    data: Sequence[Mapping[str, Any]],
) -> SeveralTwin:
    """Freeze a fit of several campaigns as a version of a twin."""
    parts = tuple(
        twin_of(one, obs, name=name, version=version, action=action, data=mine)
        for one, obs, mine in zip(fitted.fits, campaigns, data, strict=True)
    )
    counts = [float(obs.mask.sum()) for obs in campaigns]
    figures = pooled_figures([part.figures for part in parts], counts)
    figures |= {"condition_number": fitted.condition, "rank": fitted.rank, "columns": fitted.n_columns}
    about = tuple(
        {"kind": obs.grid.kind, "started": started_of(obs), "weight": weight}
        for obs, weight in zip(campaigns, fitted.weights, strict=True)
    )
    return SeveralTwin(
        name=name,
        version=version,
        machine=campaigns[0].campaign.machine,
        campaign=", ".join(part.campaign for part in parts),
        action=action,
        terms=fitted.terms,
        estimates=fitted.estimates,
        setups=tuple({**setup, "campaign": part.campaign} for part in parts for setup in part.setups),
        box=joined([part.box for part in parts]),
        figures=figures,
        by_condition=tuple({**row, "campaign": part.campaign} for part in parts for row in part.by_condition),
        aliases=tuple(alias.as_dict() for alias in fitted.aliases),
        data=_joined_data(parts),
        effect_sources={k: v for part in parts for k, v in part.effect_sources.items()},
        parts=parts,
        about=about,
        contradictions=tuple(contradictions),
    )


def started_of(obs: Observations) -> str:
    """Return when the first run of a campaign was begun, empty where no run says it."""
    return min((meta.started for meta in obs.runs if meta.started), default="")


def pooled_figures(figures: Sequence[Mapping[str, float]], counts: Sequence[float]) -> dict[str, float]:
    """Return the RMS figures over all that several campaigns measured; unknown ones are left out of the mean.

    ``counts``: number of places that each of them measured.
    """
    out: dict[str, float] = {}
    for name in _SUMMED:
        values, many = np.array([f[name] for f in figures], dtype=float), np.asarray(counts, dtype=float)
        known = np.isfinite(values)
        total = many[known].sum()
        out[name] = float(np.sqrt((values[known] ** 2 * many[known]).sum() / total)) if total else float("nan")
    out["noise_floor_dof"] = int(sum(f.get("noise_floor_dof", 0) for f in figures))
    return out


def seen_in(twin: SeveralTwin, obs: Observations, library: Mapping[str, Effect]) -> tuple[Twin, tuple[str, ...]]:
    """Return a twin as a campaign sees it, of the fit or another one, and the effects whose sizes it has not got there.

    What is not shared, as the phase of a screw, comes from the newest campaign of the same kind.
    """
    if obs.campaign.name in twin.campaigns:
        return twin.on(obs.campaign.name), ()
    alike = [part for part, about in zip(twin.parts, twin.about, strict=True) if about["kind"] == obs.grid.kind]
    terms: list[Term] = []
    values: list[Estimate] = []
    absent: list[str] = []
    for term in twin.terms:
        seen = seen_by(term, obs, library)
        if seen is None:
            continue
        own = _values_of(twin, alike, term, seen)
        if len(own) != len(seen.instance.effect.parameters):
            absent.append(term.label)
            continue
        terms.append(seen)
        values += [
            replace(e, effect=seen.instance.effect.name, axis=seen.instance.axis, name=p.name)
            for e, p in zip(own, seen.instance.effect.parameters, strict=True)
        ]
    box = alike[-1].box if alike else ValidityBox((), (), (0.0, 0.0), (0.0, 0.0))
    base = alike[-1] if alike else twin.parts[0]
    made = replace(base, campaign=obs.campaign.name, terms=tuple(terms), estimates=tuple(values), box=box)
    return made, tuple(absent)


def _values_of(twin: SeveralTwin, alike: Sequence[Twin], term: Term, seen: Term) -> list[Estimate]:
    sources: list[Twin] = [twin] if is_shared(term, twin.terms) else list(reversed(alike))
    for source in sources:
        for own in source.terms:
            if key_of(own) == key_of(seen):
                return source.estimates_of(own)
    return []


def joined(boxes: Sequence[ValidityBox]) -> ValidityBox:
    """Return the box that holds several."""
    return ValidityBox(
        tuple(dict.fromkeys(plane for box in boxes for plane in box.planes)),
        tuple(dict.fromkeys(way for box in boxes for way in box.directions)),
        (min(box.radius_mm[0] for box in boxes), max(box.radius_mm[1] for box in boxes)),
        (min(box.feed_mm_min[0] for box in boxes), max(box.feed_mm_min[1] for box in boxes)),
    )


def _joined_data(parts: Sequence[Twin]) -> dict[str, Any]:
    """Return what was used of all campaigns: table versions once, runs by campaign."""
    return {
        **parts[0].data,
        "runs_sha256": " ".join(str(part.data.get("runs_sha256", "")) for part in parts),
        "n_runs": sum(int(part.data.get("n_runs", 0)) for part in parts),
        "left_out": {f"{p.campaign} {run}": why for p in parts for run, why in p.data.get("left_out", {}).items()},
        "amended": [f"{p.campaign}: {line}" for p in parts for line in p.data.get("amended", [])],
    }
