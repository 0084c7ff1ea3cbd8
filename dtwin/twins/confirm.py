"""Whether an effect went away when its cause was mended: the strongest grade that a name can have."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from dtwin.documents import finite, read_document, write_document
from dtwin.errors import InputError
from dtwin.physics.fit import Estimate, fit
from dtwin.twins.measured import load
from dtwin.twins.several import require_alone
from dtwin.twins.shelf import TwinShelf
from dtwin.twins.verbs import Twins

_GRADE = "intervention-confirmed"
# Less than this share of what was there before must be left.
_LEFT = 0.5
_FILE = "interventions.json"


@dataclass(frozen=True)
class _Change:
    """One parameter before and after.

    ``before_uncertainty``, ``after_uncertainty``: expanded, k = 2; unit of replication: the run.
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

    def __str__(self) -> str:
        return (
            f"{self.name.replace('_', ' ')} {self.before:.3g} ± {self.before_uncertainty:.2g} -> "
            f"{self.after:.3g} ± {self.after_uncertainty:.2g} {self.unit}"
        )


@dataclass(frozen=True)
class _Intervention:
    """One effect before and after somebody mended its cause.

    ``confirmed``: whether every parameter that was there went.
    """

    effect: str
    what: str
    before_campaign: str
    after_campaign: str
    changes: tuple[_Change, ...]
    confirmed: bool

    def as_dict(self) -> dict[str, Any]:
        return {**asdict(self), "grade": _GRADE if self.confirmed else None}


def confirm(twins: Twins, name: str, effect: str, after: str, what: str) -> _Intervention:
    """Fit the twin's effects to measurements from after an intervention, and compare one.

    ``name``, ``effect``: the twin, and the label of one of its effects: ``backlash:X``.
    ``after``: campaign on the same machine after the cause was mended.
    What is returned is kept beside the twin, also when it did not confirm anything.
    Raises ``InputError`` when the twin does not have the effect, or the campaign is of another machine, is the one of
    the fit, or has no repeats.
    """
    twin = require_alone(twins.newest(name), "confirming an effect")
    label = effect.replace(":", " ")
    chosen = [term.label for term in twin.terms if term.label == label]
    if not chosen:
        raise InputError(
            "the twin does not have this effect",
            code="twin.no_effect",
            where=f"twin {name} version {twin.version}",
            got=effect,
            allowed=", ".join(t.replace(" ", ":") for t in twin.labels) or "it has none",
        )
    obs = load(twins.home, after).obs
    if obs.campaign.machine != twin.machine or obs.campaign.name == twin.campaign:
        raise InputError(
            "an intervention needs other measurements of the same machine",
            code="twin.not_after",
            where=f"twin {name}, machine {twin.machine}, campaign {twin.campaign}",
            got=f"campaign {obs.campaign.name}, machine {obs.campaign.machine}",
            hint="measure the same plan again after the cause was mended",
        )
    later = {(e.effect, e.axis, e.name): e for e in fit(obs, twin.terms).estimates}
    changes = tuple(
        _change(e, later[e.effect, e.axis, e.name])
        for e in twin.estimates
        if f"{e.effect} {e.axis}".strip() == label and e.identifiable
    )
    if any(not math.isfinite(c.before_uncertainty + c.after_uncertainty) for c in changes):
        raise InputError(
            "without repeats nobody knows whether the effect changed",
            code="twin.need_repeats",
            where=f"campaigns {twin.campaign} and {obs.campaign.name}",
        )
    there = [change for change in changes if change.was_there]
    confirmed = bool(there) and all(change.went for change in there)
    intervention = _Intervention(label, what, twin.campaign, obs.campaign.name, changes, confirmed)
    _keep(twins, name, intervention)
    return intervention


def interventions(twins: TwinShelf, name: str) -> list[dict[str, Any]]:
    """Return the interventions on a twin, oldest first, as :meth:`Intervention.as_dict`."""
    path = twins.root / name / _FILE
    return list(read_document(path)["interventions"]) if path.exists() else []


def _change(before: Estimate, after: Estimate) -> _Change:
    return _Change(before.name, before.unit, before.value, before.uncertainty, after.value, after.uncertainty)


def _keep(twins: Twins, name: str, intervention: _Intervention) -> None:
    document = {"interventions": [*interventions(twins, name), finite(intervention.as_dict())]}
    write_document(twins.root / name / _FILE, document, "the intervention")
