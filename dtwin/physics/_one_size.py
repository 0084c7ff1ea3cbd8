"""What circles, axes or tones of several tests tell that none of them tells alone: an effect of the machine has one size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dtwin.errors import InputError
from dtwin.physics.contradictions import without_contradictions
from dtwin.physics.effect import Effect
from dtwin.physics.machine_terms import is_shared, is_wave, key_of, machine_terms, seen_by
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.several import fit_several
from dtwin.physics.several_twin import started_of


def of_other_sizes(
    labels: Sequence[str],
    known: Sequence[Term],
    campaigns: Sequence[Observations],
    kind: str,
    library: Mapping[str, Effect],
    *,
    most: int | None = None,
) -> list[str]:
    """Return the effects, of some that one test cannot tell apart, that would need another size in another test.

    Each is fitted in place of the others to all campaigns of a kind. Nothing is told by tests of the same conditions: where
    their sizes differ the machine has changed.

    ``known``: what is there besides.
    ``most``: the rest is not asked once more than so many would need none.
    """
    same = [obs for obs in campaigns if obs.grid.kind == kind]
    if len({obs.conditions for obs in same}) < 2:
        return []
    beside = [term for term in known if any(seen_by(term, obs, library) is not None for obs in same)]
    out: set[str] = set()
    asked = 0
    for name in dict.fromkeys(label.partition(" ")[0] for label in labels):
        if most is not None and asked - len(out) > most:
            break
        alike = [label for label in labels if label.partition(" ")[0] == name]
        asked += len(alike)
        out.update(label for label in alike if _differ([label], beside, same, library))
        # Some are the cause only together with the same on another axis, such as arcs of both axes that make three lobes.
        if len(alike) > 1 and not out.issuperset(alike) and _differ(alike, beside, same, library):
            out.update(alike)
    return [label for label in labels if label in out]


def _differ(
    labels: Sequence[str], beside: Sequence[Term], campaigns: Sequence[Observations], library: Mapping[str, Effect]
) -> bool:
    """Tell whether campaigns contradict each other on the size of an effect, on one axis or several."""
    every = _compared(labels, beside, campaigns, library)
    if not every:
        return False
    fitted = fit_several(campaigns, every, library)
    _, apart = without_contradictions(fitted, [started_of(obs) for obs in campaigns])
    return any(one.effect == labels[0].partition(" ")[0] for one in apart)


def _compared(
    labels: Sequence[str], beside: Sequence[Term], campaigns: Sequence[Observations], library: Mapping[str, Effect]
) -> list[Term]:
    """Return an effect, on one axis or several, and what is beside it; nothing where no two campaigns see one size of it."""
    name = labels[0].partition(" ")[0]
    try:
        terms = [t for label in labels for t in machine_terms([name], library, campaigns, label.partition(" ")[2])]
    except InputError:  # It cannot act in them.
        return []
    every = list({key_of(term): term for term in (*beside, *terms)}.values())
    sized = [t for t in every if t.instance.effect.name == name and (is_wave(t) or is_shared(t, every))]
    several = any(sum(seen_by(t, obs, library) is not None for obs in campaigns) > 1 for t in sized)
    return every if several else []
