"""A twin of campaigns of several kinds of one machine: what its fits agree on, and the twin of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from dtwin.documents import finite
from dtwin.features.encoder_split import Cutoff
from dtwin.physics.agreed import Groups, Quantity, Sizes
from dtwin.physics.contradictions import Contradiction
from dtwin.physics.fit import Estimate
from dtwin.physics.several_twin import pooled_figures
from dtwin.statistics import k2_factor
from dtwin.twins.encoder_comparison import DEFAULT_CUTOFF
from dtwin.twins.members import Member, Told

FORMAT = "dtwin-machine-twin-1"
MACHINE = "machine"
"""What such a twin is of, in place of a kind."""
REPLICATION = "unit of each campaign"
# The worst verdict is that of all.
_VERDICTS = ("missing_effect", "ambiguous", "unknown_effect", "variance_effect", "need_repeats", "nothing_missing")


@dataclass(frozen=True)
class MachineTwin:
    """A version.

    ``members``: a twin for each fit, in the form of its kind: tests of a path together, other campaigns one by one.
    ``labels``: effects as a user writes them, each cause once.
    ``contradictions``: what campaigns do not agree on; the side that differs has a size of its own.
    ``document``: what is stored.
    """

    name: str
    version: int
    machine: str
    campaign: str
    action: str
    members: tuple[Any, ...]
    labels: tuple[str, ...]
    figures: Mapping[str, Any]
    contradictions: tuple[Contradiction, ...]
    document: Mapping[str, Any]

    @property
    def campaigns(self) -> tuple[str, ...]:
        """Campaigns that it was fitted to."""
        return tuple(one["campaign"] for one in self.document["campaigns"])

    @property
    def begun(self) -> dict[str, str]:
        """When each was begun."""
        return {one["campaign"]: one["started"] for one in self.document["campaigns"]}

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {**self.document, "contradictions": [one.as_dict() for one in self.contradictions]}


def effects_of(members: Sequence[Member], terms: Sequence[Sequence[Any]]) -> list[dict[str, Any]]:
    """Return each cause once, JSON-ready, with the campaigns that show it, and the name that it has in each fit."""
    out: dict[Any, dict[str, Any]] = {}
    for number, (member, mine) in enumerate(zip(members, terms, strict=True)):
        for term in mine:
            label, cause = member.label(term), member.cause(term)
            effect, _, axis = label.replace("@", ":").partition(":")
            blank = {"effect": effect, "axis": axis, "label": label, "campaigns": [], "names": []}
            entry = out.setdefault(cause or (number, label), blank)
            entry["campaigns"] += member.campaigns
            entry["names"] += [label] if label not in entry["names"] else []
    return list(out.values())


def shared_of(
    members: Sequence[Member], alone: Sequence[Sizes], agreed: Sequence[Sizes], groups: Groups
) -> list[dict[str, Any]]:
    """Return every quantity that several fits tell, JSON-ready: of all together, and of each alone, with k = 2."""
    out = []
    for quantity in dict.fromkeys(q for sizes in agreed for q in sizes.of if q is not None):
        seen = [n for n, sizes in enumerate(agreed) if quantity in sizes.of]
        if len(seen) < 2:
            continue
        first = next((n for n in seen if not groups.get((n, quantity), 0)), seen[0])
        out.append(
            {
                "effect": quantity.effect,
                "axis": quantity.axis,
                "parameter": quantity.parameter,
                "unit": quantity.unit,
                **_told(agreed[first], quantity),
                "alone": [
                    {
                        "campaigns": list(members[n].campaigns),
                        **_told(alone[n], quantity),
                        "contradicts": bool(groups.get((n, quantity), 0)),
                    }
                    for n in seen
                ],
            }
        )
    return out


def size_of(sizes: Sizes, quantity: Quantity) -> Estimate:
    """Return a quantity with its expanded uncertainty, k = 2; not identifiable where these campaigns do not tell it."""
    at = sizes.of.index(quantity)
    k2 = float(sizes.standard[at]) * k2_factor(float(sizes.dof[at]))
    value, told = float(sizes.value[at]), k2 < quantity.largest
    return Estimate(quantity.effect, quantity.axis, quantity.parameter, quantity.unit, value, k2, told)


def _told(sizes: Sizes, quantity: Quantity) -> dict[str, Any]:
    """Return value and expanded uncertainty; null where these campaigns do not tell it alone."""
    one = size_of(sizes, quantity)
    told = one.identifiable
    return finite({"value": one.value if told else None, "uncertainty": one.uncertainty if told else None})


def figures_of(entries: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the RMS figures over all readings of all campaigns, um."""
    nan = float("nan")
    told = [
        {
            "rms_before_um": one["rms_before_um"],
            "rms_after_um": one["residual_rms_um"],
            "systematic_rms_um": one.get("systematic_rms_um", nan),
            "noise_floor_um": one["noise_floor_um"],
        }
        for one in entries
    ]
    known = [{name: nan if value is None else value for name, value in one.items()} for one in told]
    return finite(pooled_figures(known, [float(one["readings"]) for one in entries]))


@dataclass(frozen=True)
class MachineComparison:
    """A twin of several kinds against all its campaigns; ``parts``: a comparison for each fit."""

    twin: MachineTwin
    parts: tuple[Any, ...]

    def as_dict(self, cutoff: Cutoff = DEFAULT_CUTOFF) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        parts = [part.as_dict(cutoff) for part in self.parts]
        figures = self.twin.figures
        return {
            "kind": MACHINE,
            "twin": self.twin.name,
            "version": self.twin.version,
            "campaign": self.twin.campaign,
            "runs": sum(part["runs"] for part in parts),
            "rms_before_um": figures["rms_before_um"],
            "residual_rms_um": figures["rms_after_um"],
            "noise_floor_um": figures["noise_floor_um"],
            "where": [],
            "encoder_split": next((part["encoder_split"] for part in parts if part.get("encoder_split")), None),
            "warnings": [line for part in parts for line in part["warnings"]],
            "members": parts,
            "contradictions": [one.as_dict() for one in self.twin.contradictions],
        }


@dataclass(frozen=True)
class MachineDiagnosis:
    """What a twin of several kinds lacks; ``told``: by each fit; ``denied``: what one would name, and all together do not."""

    twin: MachineTwin
    members: tuple[Member, ...]
    told: tuple[Told, ...]
    denied: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        every = [
            (", ".join(member.campaigns), told.result) for member, told in zip(self.members, self.told, strict=True)
        ]
        verdicts = {result["verdict"] for _, result in every}
        figures = self.twin.figures
        p_values = [p for _, result in every if (p := result["lack_of_fit_p"]) is not None and p == p]
        return {
            "kind": MACHINE,
            "verdict": next(verdict for verdict in _VERDICTS if verdict in verdicts),
            "headline": "; ".join([*(f"{name}: {result['headline']}" for name, result in every), *self._besides()]),
            "residual_rms_um": figures["rms_after_um"],
            "systematic_rms_um": figures.get("systematic_rms_um"),
            "noise_floor_um": figures["noise_floor_um"],
            "replication": REPLICATION,
            "lack_of_fit_p": min(1.0, len(p_values) * min(p_values)) if p_values else None,
            "candidates": [self._candidate(name, c) for name, result in every for c in result["candidates"]],
            "found": [one for told in self.told for one in self._found(told)],
            "invisible": [label for _, result in every for label in result["invisible"]],
            "idle": [label for told in self.told for label in told.idle],
            "where": [],
            "next_experiment": next((r["next_experiment"] for _, r in every if r["next_experiment"]), None),
            "members": [
                {**result, "of": list(m.campaigns)} for m, (_, result) in zip(self.members, every, strict=True)
            ],
            "contradictions": [one.as_dict() for one in self.twin.contradictions],
        }

    def _besides(self) -> list[str]:
        """Return what fits say of each other."""
        names = ", ".join(self.denied)
        denial = [f"one campaign alone would name {names}, all that see it together do not"] if names else []
        within = [one for part in self.twin.members for one in getattr(part, "contradictions", ())]
        across = self.twin.contradictions[len(within) :]
        return denial + [
            f"{', '.join(c.campaigns)} contradicts {', '.join(c.others)} on {c.effect} {c.axis}".rstrip()
            for c in across
        ]

    def _found(self, told: Told) -> list[list[dict[str, Any]]]:
        """Return the groups that a fit found, as it tells them, else by their labels."""
        groups = told.result.get("found") or [
            [{"effect": label, "axis": "", "label": label} for label in group] for group in told.found
        ]
        kept = (labels[0] not in {*self.denied, *self._doubles} for labels in told.found)
        return [group for group, keep in zip(groups, kept, strict=True) if keep]

    def _candidate(self, campaigns: str, candidate: Mapping[str, Any]) -> dict[str, Any]:
        label = str(candidate.get("label") or f"{candidate['effect']}:{candidate['axis']}".rstrip(":"))
        named = candidate["in_group"] and label not in self._doubles
        return {**candidate, "label": label, "campaign": campaigns, "in_group": named}

    @cached_property
    def _doubles(self) -> frozenset[str]:
        """Names of causes that campaigns before found already, by another name."""
        seen: set[Any] = set()
        out: set[str] = set()
        for member, told in zip(self.members, self.told, strict=True):
            for group in told.found:
                causes = {member.cause(term) for term in member.named(group[0])}
                out |= set(group) if None not in causes and causes <= seen else set()
                seen |= causes
        return frozenset(out)
