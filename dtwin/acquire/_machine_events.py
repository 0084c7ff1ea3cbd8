"""What a machine said while it was recorded, as intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from dtwin.schema import Finding

_MOST_TOLD = 20
_MOST_IN_A_LINE = 6


@dataclass(frozen=True)
class _Interval:
    """``from_s``, ``to_s``: since the first sample; the end of the recording where it had not ended."""

    name: str
    text: str
    from_s: float
    to_s: float
    alarm: bool

    def __str__(self) -> str:
        return f"{self.text} {self.from_s:z.1f} to {self.to_s:z.1f} s"


def _intervals(events: Sequence[Sequence[Any]], length_s: float) -> list[_Interval]:
    """Return intervals by their beginning; a text of one name ends the one before.

    An empty one ends its name, and all whose names begin with it and a space.
    """
    intervals: list[_Interval] = []
    held: dict[str, tuple[float, str, bool]] = {}
    for at_s, name, text, alarm in sorted(events, key=lambda e: float(e[0])):
        if text and name in held and held[name][1] == text:
            continue
        for other in [n for n in held if n == name or (not text and n.startswith(f"{name} "))]:
            from_s, said, was_alarm = held.pop(other)
            intervals.append(_Interval(other, said, from_s, float(at_s), was_alarm))
        if text:
            held[str(name)] = (float(at_s), str(text), bool(alarm))
    for name, (from_s, text, alarm) in held.items():
        intervals.append(_Interval(name, text, from_s, max(length_s, from_s), alarm))
    return sorted(intervals, key=lambda i: (i.from_s, i.name))


def event_findings(events: Sequence[Sequence[Any]], length_s: float) -> tuple[Finding, ...]:
    """Return alarms one by one, and what else a machine said by name.

    ``events``: time since the first sample, name, text (empty: it is over), whether it is an alarm.
    ``length_s``: of the recording.
    """
    findings = []
    intervals = _intervals(events, length_s)
    alarms = [i for i in intervals if i.alarm]
    for one in alarms[:_MOST_TOLD]:
        numbers = {"from_s": one.from_s, "to_s": one.to_s}
        findings.append(Finding("machine.alarm", "warning", f"the machine reported {one.name}: {one}", numbers))
    if len(alarms) > _MOST_TOLD:
        text = f"the machine reported {len(alarms) - _MOST_TOLD} alarms more"
        findings.append(Finding("machine.alarm", "warning", text))
    for name in dict.fromkeys(i.name for i in intervals if not i.alarm):
        here = [str(i) for i in intervals if i.name == name and not i.alarm]
        more = f", and {len(here) - _MOST_IN_A_LINE} more" if len(here) > _MOST_IN_A_LINE else ""
        findings.append(Finding("machine.state", "info", f"{name}: {', '.join(here[:_MOST_IN_A_LINE])}{more}"))
    return tuple(findings)
