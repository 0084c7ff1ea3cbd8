"""What several tests of a machine find, each by itself, as one list of causes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from dtwin.physics._one_size import of_other_sizes
from dtwin.physics.diagnosis import Suspect
from dtwin.physics.effect import Effect
from dtwin.physics.joint import Joint, MachineTest, Shared
from dtwin.physics.machine_terms import cause_of, machine_terms
from dtwin.physics.problem import Term
from dtwin.physics.state import AXES_OF

Group = tuple[tuple[Suspect, ...], str]


def merged(
    known: Sequence[Term], tests: Sequence[MachineTest], settled: Joint, library: Mapping[str, Effect]
) -> tuple[list[Group], tuple[str, ...]]:
    """Return what is missing, each cause once, the largest first, with the campaign that shows it.

    Beside it the labels that would need another size in another test of the kind.
    """
    left = {(s.campaign, s.group): s.left for s in settled.settled}
    refuted = _refuted_keys(settled)
    every: list[Group] = []
    for test in tests:
        if test.found.verdict == "need_repeats":
            continue
        for group in test.found.found:
            names = left.get((test.campaign, tuple(s.label for s in group)))
            kept = group if names is None else tuple(s for s in group if s.label in names)
            # What only the difference of other tests rules out is a contradiction, and no name.
            kept = tuple(s for s in kept if (test.campaign, *key_of_suspect(s, library)) not in refuted)
            if kept:
                every.append((graded(kept), test.campaign))
    every.sort(key=lambda found: -(found[0][0].size_um or 0.0))
    causes = [[key_of_suspect(s, library) for s in group] for group, _ in every]
    every, ruled_out = _of_one_size(known, every, tests, library)
    asked = zip(every, causes, strict=True)
    every = [(group, where) for (group, where), own in asked if not _is_asked_later(group, where, own, every, library)]
    alone = {key_of_suspect(group[0], library) for group, _ in every if len(group) == 1}
    out: list[Group] = []
    told: set[tuple[str, str]] = set()
    for group, where in every:
        cause, axis = key_of_suspect(group[0], library)
        if len(group) == 1 and axis in AXES_OF and any((cause, a) in alone for a in AXES_OF[axis]):
            continue
        if (cause, axis) in told or _is_another_of(group, out):
            continue
        out.append((group, where))
        told.add((cause, axis))
    return out, ruled_out


def _of_one_size(
    terms: Sequence[Term], groups: Sequence[Group], tests: Sequence[MachineTest], library: Mapping[str, Effect]
) -> tuple[list[Group], tuple[str, ...]]:
    """Leave out the names that would need another size in another test of the kind; return the groups, and those names."""
    campaigns = [test.obs for test in tests]
    kind_of = {test.campaign: test.obs.grid.kind for test in tests}
    alone = dict.fromkeys(f"{g[0].effect}:{g[0].axis}" for g, _ in groups if len(g) == 1)
    known = [*terms, *machine_terms(list(alone), library, campaigns)]
    differ: dict[str, bool] = {}
    out = []
    for group, where in groups:
        asked = [s.label for s in group if len(group) > 1 and s.label not in differ]
        of_others = of_other_sizes(asked, known, campaigns, kind_of[where], library)
        differ |= {label: label in of_others for label in asked}
        kept = tuple(s for s in group if not differ.get(s.label))
        # Where no name has one size there is more than one cause, or the machine has changed.
        out.append((graded(kept or group), where))
    names = {s.label for group, _ in out for s in group}
    return out, tuple(label for label, other in differ.items() if other and label not in names)


def _is_asked_later(
    group: tuple[Suspect, ...],
    where: str,
    names: Sequence[tuple[str, str]],
    groups: Sequence[Group],
    library: Mapping[str, Effect],
) -> bool:
    """Tell whether one of the other names of a group is what another campaign shows first: what is left beside that is not known.

    Growth that lasers show on each axis is one of the names of what circles show best as a drift. Where that campaign does not
    tell it from the first name of the group either, both show one cause.

    ``names``: causes and axes of the group, those ruled out for their sizes, too: growth that differs between axes is growth.
    """
    own, _ = key_of_suspect(group[0], library)
    others = [o for o, there in groups if there != where and own not in {key_of_suspect(s, library)[0] for s in o}]
    tops = {key_of_suspect(other[0], library) for other in others}
    return any(
        cause != own and ((cause, axis) in tops or (not axis and any(cause == top for top, _ in tops)))
        for cause, axis in names
    )


def _is_another_of(group: tuple[Suspect, ...], groups: list[Group]) -> bool:
    """Tell whether a test shows what another shows, which is then narrowed, in place, to the names that both have.

    Neither tells its own first name from that of the other.
    """
    names = {suspect.label for suspect in group}
    for number, (other, where) in enumerate(groups):
        common = tuple(suspect for suspect in other if suspect.label in names)
        if other[0] in common and group[0].label in {suspect.label for suspect in common}:
            groups[number] = graded(common), where
            return True
    return False


def key_of_suspect(suspect: Suspect, library: Mapping[str, Effect]) -> tuple[str, str]:
    return cause_of(library[suspect.effect]), suspect.axis


def refuted_names(tests: Sequence[MachineTest], settled: Joint, library: Mapping[str, Effect]) -> list[str]:
    """Return the names that one test finds alone and the others say are not there."""
    refuted = _refuted_keys(settled)
    alone = [(t.campaign, group[0]) for t in tests for group in t.found.found if len(group) == 1]
    return [s.label for campaign, s in alone if (campaign, *key_of_suspect(s, library)) in refuted]


def _refuted_keys(settled: Joint) -> set[tuple[str, str, str]]:
    return {key for shared in settled.shared if (key := _refuted(shared)) is not None}


def _refuted(shared: Shared) -> tuple[str, str, str] | None:
    """Return campaign and cause where one test finds what the others say is not there."""
    if not shared.apart:
        return None
    there = [s for s in shared.sizes if abs(s.value) > 1.5 * s.uncertainty]
    return (there[0].campaign, shared.cause, shared.axis) if len(there) == 1 else None


def graded(group: tuple[Suspect, ...]) -> tuple[Suspect, ...]:
    labels = {s.label for s in group}
    return tuple(
        replace(s, confounded_with=tuple(label for label in s.confounded_with if label in labels)) for s in group
    )
