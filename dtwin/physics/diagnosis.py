"""What a diagnosis says."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from dtwin.physics._law_search import ScalingLaw
from dtwin.physics._laws import LawTest
from dtwin.physics._rivals import AFTER_A_REVERSAL
from dtwin.physics._screen import Channel
from dtwin.physics.fit import Estimate
from dtwin.physics.observations import Observations

Verdict = Literal["missing_effect", "ambiguous", "unknown_effect", "nothing_missing", "need_repeats", "variance_effect"]
Grade = Literal["shape-consistent", "law-confirmed", "intervention-confirmed"]


@dataclass(frozen=True)
class Suspect:
    """An effect that was considered.

    Attributes:
        rms_after_um: Predicted RMS of the residual with the effect added.
        cv_gain: Mean relative gain on conditions that were left out of the fit.
        p_value: After Holm over the library.
        in_group: Member of the reported group.
        confounded_with: Effects that these runs cannot tell from it.
        share: Share of the systematic error that it explains.
        size_um: RMS of what it explains beside all others that were found; None for what was not found.
        sizes: Its parameters, k = 2, fitted with all others that were found; empty for what was not found and for what
            only cannot be told from it.
        tested, untested: Variables of its law that the runs confirmed, and those that they did not test.
        shape: Its shape parameters.
    """

    effect: str
    axis: str
    rms_after_um: float
    cv_gain: float
    p_value: float
    in_group: bool
    grade: Grade | None
    confounded_with: tuple[str, ...]
    laws: tuple[LawTest, ...]
    share: float
    remedy: str
    size_um: float | None = None
    sizes: tuple[Estimate, ...] = ()
    tested: tuple[str, ...] = ()
    untested: tuple[str, ...] = ()
    shape: Mapping[str, float] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Name with axis."""
        return f"{self.effect} {self.axis}".rstrip()

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        out = dict(vars(self))
        for name in ("confounded_with", "tested", "untested"):
            out[name] = list(out[name])
        out["shape"] = dict(self.shape)
        out["laws"] = [law.as_dict() for law in self.laws]
        out["sizes"] = [size.as_dict() for size in self.sizes]
        return out


@dataclass(frozen=True)
class Unresolved:
    """What repeats agree on and nothing found explains.

    Attributes:
        share: Its share of the systematic mean square.
        p_value: Of the hypothesis that repeats agree on nothing more.
        words: Direction, harmonic, feed and radius.
        where: Conditions and angles where it is largest.
    """

    systematic_rms_um: float
    share: float
    p_value: float
    words: str
    where: tuple[Mapping[str, Any], ...]

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {**vars(self), "where": [dict(place) for place in self.where]}


@dataclass(frozen=True)
class Spread:
    """How the spread of repeats depends on the condition.

    Attributes:
        depends_on: ``feed``, or an effect that acts on the spread.
        p_value: Smallest, after Holm.
    """

    depends_on: tuple[str, ...]
    p_value: float

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {"depends_on": list(self.depends_on), "p_value": self.p_value}


# What has a law of its own after a reversal; and what also looks like what those leave.
_INEXACT = AFTER_A_REVERSAL | {"friction"}
_LIKE_IT = _INEXACT | {"backlash"}

LEAST_GAIN = 0.25
"""What a second diagnosis finds may be how far the laws of what the first one found are off.

It must lower what is left on conditions that are left out by this share, as a mean square.
"""


@dataclass(frozen=True)
class Diagnosis:
    """What is missing in a twin, how sure that is, and what it could be instead.

    Attributes:
        verdict: One of the six verdicts.
        residual_rms_um, systematic_rms_um, noise_floor_um: RMS of the residual, of what repeats agree on, and of one run
            about the mean of its condition (unit of replication: the run).
        floor_kind: Where the floor comes from; ``within_run`` is a lower bound. One of "repeats", "within_run", "none".
        lack_of_fit_p: Of the hypothesis that repeats agree on nothing more.
        suspects: Best first.
        found: Every effect that was found, the largest first, each with those that cannot be told from it.
        unresolved: What repeats agree on besides; None when it is not significant.
        where: Conditions and angles where the residual is largest.
        channels: Logged channels that explain the spread between repeats.
        laws: Laws of structure that no effect explains.
        places: Learned effects of an axis, a step or a bump at one place, that are a part of what is not resolved: effect,
            axis and shape.
        closest: The effect whose shape comes closest to unknown structure.
        invisible: Effects that would hide in the set-up or in known effects.
        untestable: Effects that cannot be judged, and why.
        told: Runs that were left out before, and why; what was stated anew of the campaign.
        outlier_runs: Runs that were left out.
        spread: How the spread depends on the condition.
        next_experiment: The cheapest run that separates the leading candidates.
        undecided: Each effect of the twin that these runs cannot tell from others, and those.
    """

    verdict: Verdict
    headline: str
    residual_rms_um: float
    systematic_rms_um: float
    noise_floor_um: float
    floor_kind: Literal["repeats", "within_run", "none"]
    lack_of_fit_p: float
    suspects: tuple[Suspect, ...] = ()
    found: tuple[tuple[Suspect, ...], ...] = ()
    unresolved: Unresolved | None = None
    where: tuple[Mapping[str, Any], ...] = ()
    channels: tuple[Channel, ...] = ()
    laws: tuple[ScalingLaw, ...] = ()
    places: tuple[Mapping[str, Any], ...] = ()
    closest: str | None = None
    invisible: tuple[str, ...] = ()
    untestable: Mapping[str, str] = field(default_factory=dict)
    outlier_runs: tuple[str, ...] = ()
    told: tuple[str, ...] = ()
    spread: Spread | None = None
    next_experiment: Mapping[str, Any] | None = None
    undecided: tuple[tuple[str, ...], ...] = ()

    @property
    def group(self) -> tuple[Suspect, ...]:
        """Members of the reported group, best first."""
        return tuple(suspect for suspect in self.suspects if suspect.in_group)

    def to_add(self, labels: Collection[str], campaigns: Sequence[Observations]) -> tuple[tuple[Suspect, ...], ...]:
        """Return the groups that a later diagnosis may add by itself to a twin with effects of these labels.

        What may be how far the laws of those are off stays in its last word. A group must foretell ``LEAST_GAIN`` of what
        is left where it was not fitted. What follows the reversals of an axis is also what the law of friction, of a spike
        or of a mode of that axis leaves there, unless radius and feed were changed apart from each other; and friction, what
        that of backlash leaves: the two would then take each other away. Of runs that were measured once it is none: what is
        left of them is also noise that no repeat tells from it.
        """
        if self.verdict == "need_repeats":
            return ()
        follows = set() if any(one.crossed for one in campaigns) else _LIKE_IT

        def is_left(top: Suspect) -> bool:
            inexact = _LIKE_IT if top.effect == "friction" else _INEXACT
            return top.effect in follows and any(f"{name} {top.axis}" in labels for name in inexact)

        return tuple(group for group in self.found if group[0].cv_gain >= LEAST_GAIN and not is_left(group[0]))

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {
            "verdict": self.verdict,
            "headline": self.headline,
            "residual_rms_um": self.residual_rms_um,
            "systematic_rms_um": self.systematic_rms_um,
            "noise_floor_um": self.noise_floor_um,
            "floor_kind": self.floor_kind,
            "lack_of_fit_p": self.lack_of_fit_p,
            "candidates": [suspect.as_dict() for suspect in self.suspects],
            "found": [[suspect.as_dict() for suspect in group] for group in self.found],
            "unresolved": self.unresolved.as_dict() if self.unresolved else None,
            "where": [dict(place) for place in self.where],
            "channels": [channel.as_dict() for channel in self.channels],
            "laws": [law.as_dict() for law in self.laws],
            "places": [dict(place) for place in self.places],
            "closest": self.closest,
            "invisible": list(self.invisible),
            "untestable": dict(self.untestable),
            "outlier_runs": list(self.outlier_runs),
            "told": list(self.told),
            "variance": self.spread.as_dict() if self.spread else {},
            "next_experiment": dict(self.next_experiment) if self.next_experiment else None,
            "undecided": [list(group) for group in self.undecided],
        }
