"""Whether an effect went away when its cause was mended: the strongest grade that a name can have."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from dtwin.acquire.campaign_name import in_lake
from dtwin.documents import finite, read_document, write_document
from dtwin.errors import InputError
from dtwin.lake.store import Lake
from dtwin.physics.fit import Estimate, fit
from dtwin.physics.machine_terms import cause_of, key_of, seen_by
from dtwin.physics.several import fit_several
from dtwin.physics.several_twin import SeveralTwin
from dtwin.physics.twin import Twin
from dtwin.twins._machine_twins import MachineTwins
from dtwin.twins.measured import load, rises_from_one
from dtwin.twins.members import Cause
from dtwin.twins.of_kind import AnyTwin, AnyTwins
from dtwin.twins.shelf import TwinShelf
from dtwin.twins.verbs import Twins
from dtwin.units import shown_number, shown_parameter, shown_unit

_GRADE = "intervention-confirmed"
# Less than this share of what was there before must be left.
_LEFT = 0.5
_FILE = "interventions.json"


@dataclass(frozen=True)
class _Change:
    """One parameter before and after.

    ``before_uncertainty``, ``after_uncertainty``: expanded, k = 2; unit of replication: that of the twin.
    """

    name: str
    unit: str
    before: float
    before_uncertainty: float
    after: float
    after_uncertainty: float

    @property
    def was_there(self) -> bool:
        """Whether the parameter was different from zero before."""
        return abs(self.before) > self.before_uncertainty

    @property
    def went(self) -> bool:
        """Whether it certainly fell, and by half at least."""
        fell = abs(self.before) - abs(self.after)
        doubt = math.hypot(self.before_uncertainty, self.after_uncertainty)
        return fell > doubt and abs(self.after) <= _LEFT * abs(self.before)

    @property
    def moved(self) -> bool:
        """Whether it certainly changed, and by half of what was there at least."""
        doubt = math.hypot(self.before_uncertainty, self.after_uncertainty)
        return abs(self.after - self.before) > max(doubt, _LEFT * abs(self.before))

    def __str__(self) -> str:
        return (
            f"{shown_parameter(self.name)} {shown_number(self.before)} ± {shown_number(self.before_uncertainty, 2)} -> "
            f"{shown_number(self.after)} ± {shown_number(self.after_uncertainty, 2)} {shown_unit(self.unit)}"
        )


@dataclass(frozen=True)
class _Intervention:
    """One effect before and after somebody mended its cause.

    ``others``: parameters of the twin's other effects that moved as well, by the effect.
    ``confirmed``: whether every parameter that was there went, and no more of the others moved than stayed.
    """

    effect: str
    what: str
    before_campaign: str
    after_campaign: str
    changes: tuple[_Change, ...]
    others: tuple[_Change, ...]
    confirmed: bool

    @property
    def said(self) -> str:
        """Whether it went, in words."""
        if self.confirmed:
            return f"went away: {_GRADE}"
        gone = [change.went for change in self.changes if change.was_there]
        if gone and all(gone):
            return (
                "is smaller, and more of the other effects changed than stayed: not confirmed; were the measurements made on this machine, "
                "and nothing else mended?"
            )
        return "did not certainly go away"

    def as_dict(self) -> dict[str, Any]:
        return {**asdict(self), "grade": _GRADE if self.confirmed else None}


def confirm(twins: AnyTwins, name: str, effect: str, after: Sequence[str], what: str) -> _Intervention:
    """Fit the twin's effects to measurements from after an intervention, and compare one.

    ``name``, ``effect``: the twin, and the label of one of its effects: ``backlash:X``.
    ``after``: campaigns on the same machine after the cause was mended, together. Where the twin was fitted to them, too, it
    is fitted again without them.
    What is returned is kept beside the twin, also when it did not confirm anything.
    Raises ``InputError`` when the twin does not have the effect, the campaigns are of another machine, all of the fit, do not
    tell the effect, or have no repeats.
    """
    twin = twins.newest(name)
    later = [in_lake(twins.home, campaign) for campaign in after]
    before = [campaign for campaign in twin.campaigns if campaign not in later]
    machines = {campaign: Lake(twins.home.lake).campaign(campaign).machine for campaign in later}
    if not before or not later or set(machines.values()) != {twin.machine}:
        raise InputError(
            "an intervention needs other measurements of the same machine",
            code="twin.not_after",
            where=f"twin {name}, machine {twin.machine}, campaigns {', '.join(twin.campaigns)}",
            got=", ".join(f"campaign {campaign}, machine {machine}" for campaign, machine in machines.items())
            or "none",
            hint="measure the same plan again after the cause was mended",
        )
    cause = _cause(twins, twin, effect)
    known, again = (_sizes(twins, twin, campaigns) for campaigns in (before, later))
    changes = tuple(_change(one, again[key]) for key, one in known.items() if key[:2] == cause and key in again)
    if not changes:
        raise InputError(
            "the campaigns before and after do not both tell the effect",
            code="twin.not_told",
            where=f"campaigns {', '.join([*before, *later])}",
            got=effect,
            hint="measure again with what told it before",
        )
    if any(not math.isfinite(c.before_uncertainty + c.after_uncertainty) for c in changes):
        raise InputError(
            "without repeats nobody knows whether the effect changed",
            code="twin.need_repeats",
            where=f"campaigns {', '.join([*before, *later])}",
        )
    there = [change for change in changes if change.was_there]
    beside = [
        replace(_change(one, again[key]), name=f"{one.effect} {one.axis}".rstrip())
        for key, one in known.items()
        if key[:2] != cause and key in again
    ]
    beside = [change for change in beside if change.was_there]
    others = tuple(change for change in beside if change.moved)
    confirmed = bool(there) and all(change.went for change in there) and 2 * len(others) <= len(beside)
    label = effect.replace(":", " ")
    intervention = _Intervention(label, what, ", ".join(before), ", ".join(later), changes, others, confirmed)
    _keep(twins, name, intervention)
    return intervention


def interventions(twins: TwinShelf, name: str) -> list[dict[str, Any]]:
    """Return the interventions on a twin, oldest first, as :meth:`Intervention.as_dict`."""
    path = twins.root / name / _FILE
    return list(read_document(path)["interventions"]) if path.exists() else []


def _cause(twins: AnyTwins, twin: AnyTwin, effect: str) -> Cause:
    """Return the cause of an effect of a twin, by any name that it has there.

    Raises ``InputError`` when the twin lacks it, or its size is that of a campaign and not of the machine.
    """
    if isinstance(twin, Twin):
        effect = effect.strip().replace(" ", ":")
        parts = twin.parts if isinstance(twin, SeveralTwin) else ()
        terms = [term for part in (twin, *parts) for term in part.terms]
        causes: Mapping[str, Iterable[Cause]] = {t.label.replace(" ", ":"): [key_of(t)] for t in terms}
    else:
        names = [*twin.labels, *_names(twin)]
        causes = {effect: _machine(twins).causes(twin.campaigns, effect)} if effect in names else {}
    if effect not in causes:
        raise InputError(
            "the twin does not have this effect",
            code="twin.no_effect",
            where=f"twin {twin.name} version {twin.version}",
            got=effect,
            allowed=", ".join(label.replace(" ", ":") for label in twin.labels) or "it has none",
        )
    for cause in causes[effect]:
        return cause
    raise InputError(
        "the size of this effect is that of its campaign, and another campaign cannot tell whether it went",
        code="twin.not_told",
        where=f"twin {twin.name} version {twin.version}",
        got=effect,
        hint="fit a twin to the campaign after, and compare both",
    )


def _names(twin: AnyTwin) -> list[str]:
    """Return the names of all effects in all campaigns."""
    return [name for e in twin.as_dict()["effects"] for name in e.get("names", (e["label"],))]


def _sizes(twins: AnyTwins, twin: AnyTwin, campaigns: Sequence[str]) -> Mapping[tuple[str, str, int], Estimate]:
    """Return what campaigns tell of a twin's parameters, by cause, axis and number: their names differ from kind to kind."""
    if not isinstance(twins, Twins):
        sizes = _machine(twins).sizes(campaigns, _names(twin))
        return _numbered(((q.cause, q.axis), one) for q, one in sizes.items())
    assert isinstance(twin, Twin)
    estimates: Sequence[Estimate] = twin.estimates
    all_told = False
    if tuple(campaigns) != twin.campaigns:
        tests = [one.obs for one in rises_from_one([load(twins.home, campaign) for campaign in campaigns])]
        seen = {key_of(t): s for t in twin.terms for obs in tests if (s := seen_by(t, obs, twins.library)) is not None}
        terms = list(seen.values())
        made = fit(tests[0], terms) if len(tests) == 1 else fit_several(tests, terms, twins.library)
        estimates = made.estimates
        # The shape of an effect that went is not plausible; its size is told all the same.
        all_told = made.rank == made.n_columns
    told = (replace(e, identifiable=True) if all_told else e for e in estimates)
    return _numbered(((cause_of(twins.library[e.effect]), e.axis), e) for e in told)


def _numbered(told: Iterable[tuple[Cause, Estimate]]) -> dict[tuple[str, str, int], Estimate]:
    count: Counter[Cause] = Counter()
    out = {}
    for cause, one in told:
        if one.identifiable:
            out[(*cause, count[cause])] = one
        count[cause] += 1
    return out


def _machine(twins: AnyTwins) -> MachineTwins:
    return twins if isinstance(twins, MachineTwins) else MachineTwins(twins.home)


def _change(before: Estimate, after: Estimate) -> _Change:
    # That an effect goes is told however little its shape tells of its size.
    widths = before.uncertainty_at_shape, after.uncertainty_at_shape
    return _Change(before.name, before.unit, before.value, widths[0], after.value, widths[1])


def _keep(twins: TwinShelf, name: str, intervention: _Intervention) -> None:
    document = {"interventions": [*interventions(twins, name), finite(intervention.as_dict())]}
    write_document(twins.root / name / _FILE, document, "the intervention")
