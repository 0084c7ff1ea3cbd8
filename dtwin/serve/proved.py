"""How old the proof is that a model helps: when it was last measured in a closed loop, and how long that holds."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Literal

from dtwin.errors import GateRefusal
from dtwin.serve.bundle import Bundle
from dtwin.serve.pointer import Resolved

WhenExpired = Literal["refuse", "warn"]


def _proof_of(resolved: Resolved, bundle: Bundle, now: datetime) -> tuple[str, bool]:
    """Return when a model was last proved, for people, and whether that still holds.

    Args:
        bundle: It may say for how many days a proof holds.
        now: With its time zone.
    """
    days = bundle.provenance.valid_days
    limit = f"; a proof holds for {days:g} days" if days else ""
    when = _moment(resolved.proved)
    if when is None:
        return f"never proved in a closed loop{limit}", not days
    age = now - when
    holds = not days or timedelta(days=-1) <= age <= timedelta(days=days)
    return f"last proved {when:%Y-%m-%d}, {max(age.days, 0)} days ago{limit}", holds


def require_proof(
    resolved: Resolved, bundle: Bundle, when_expired: WhenExpired, now: datetime | None = None, changed: str = ""
) -> str:
    """Return what is to be told of a champion's proof before it moves a machine.

    Args:
        resolved: As for :func:`_proof_of`.
        bundle: As for :func:`_proof_of`.
        when_expired: What to do when the proof does not hold any more. One of "refuse", "warn".
        now: By default the computer's clock.
        changed: What changed the machine since, where its record notes anything.

    Raises:
        GateRefusal: When it does not hold and this was not to be a warning.
    """
    told, holds = _proof_of(resolved, bundle, now or datetime.now(UTC))
    told += f"; WARNING: {changed}; unless it came before the proof: dtwin recheck" if changed else ""
    if holds:
        return told
    if when_expired == "warn":
        return f"WARNING: the evidence has expired: {told}"
    raise GateRefusal(
        "the evidence for this model has expired",
        code="serve.expired",
        where=str(resolved.path),
        got=told,
        hint="dtwin recheck proves it anew; or look at it with --shadow; --expired warn serves it all the same",
    )


def _moment(text: str) -> datetime | None:
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        return None
    return when if when.tzinfo else when.replace(tzinfo=UTC)
