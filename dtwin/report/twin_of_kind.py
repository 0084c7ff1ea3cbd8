"""How twins are told, whatever their kind."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

from dtwin.kinds.registry import kind_named
from dtwin.report.text import WIDE, listed, micrometres, table
from dtwin.report.twins import history_text
from dtwin.schema import DEFAULT_KIND

if TYPE_CHECKING:
    from dtwin.report.html import Section


class TwinReport(Protocol):
    """How twins of a kind are told; results are what their ``as_dict`` gives."""

    def twin_text(self, twin: Any, /) -> str:
        """Return a twin for the terminal."""

    def comparison_text(self, result: Mapping[str, Any], /) -> str:
        """Return a comparison for the terminal."""

    def diagnosis_text(self, name: str, result: Mapping[str, Any], /) -> str:
        """Return a diagnosis for the terminal."""

    def diagnosis_section(self, name: str, result: Mapping[str, Any], /) -> Section:
        """Return a diagnosis for a report."""

    def twin_section(self, twin: Any, /) -> Section:
        """Return a twin for a report."""

    def history_section(self, rungs: Sequence[Mapping[str, Any]], /) -> Section:
        """Return the versions of a twin for a report."""

    def comparison_sections(self, comparison: Any, result: Mapping[str, Any], /) -> list[Section]:
        """Return a comparison for a report."""


def discovery_text(payload: Mapping[str, Any], least_gain: float) -> str:
    """Return what was found for the terminal: versions, every name with those that the runs cannot tell from it, what is left.

    ``payload``: twin, the actions of its new versions, groups of the effects added, the effect first, history, and the last diagnosis.
    ``least_gain``: on conditions that were left out, below which nothing was added.
    """
    rungs, groups, last = payload["history"], payload["groups"], payload["final"]
    rest = report_of(last).diagnosis_text(payload["twin"], last)
    if not groups:
        return f"{history_text(rungs)}\n\n{rest}"
    lines = _found_lines(groups, payload["effects"])
    before, left = (rungs[n].get("systematic_rms_um") for n in (-1 - len(payload["added"]), -1))
    if before and left is not None:
        share = 100.0 * left / before
        lines.append(
            f"of {micrometres(before)} µm RMS that repeats agree on, {micrometres(left)} µm are left ({share:z.0f} %)"
        )
    small = (
        f"foretells less than {100.0 * least_gain:z.0f} % of what is left on conditions left out, as laws may be off"
    )
    beside = "friction, a spike or a mode of that axis may leave the same, unless radius and feed are changed apart"
    for one, *_ in last.get("found", ()):
        why = small if (one["cv_gain"] or 0.0) < least_gain else beside
        lines.append(f"not added: {one['effect']} {one['axis']}".rstrip() + f": {why}")
    return "\n\n".join([history_text(rungs), "\n".join(lines), f"what is left\n{rest}"])


def _found_lines(groups: Sequence[Sequence[str]], effects: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the groups that were found; of tests of a path with the size of the first of each, k = 2."""
    sized = {f"{effect['effect']} {effect['axis']}".rstrip(): effect for effect in effects}
    if not all(group[0] in sized for group in groups):
        return ["found", *(f"  {listed(group, ' or ')}" for group in groups)]
    head = ("found", "size (k = 2)", "makes, µm RMS")
    rows = [
        (listed(group, " or "), f"{own['size']}{' if alone' * (len(group) > 1)}", micrometres(own.get("makes_um")))
        for group in groups
        for own in [sized[group[0]]]
    ]
    return [table(head, rows, WIDE)]


def with_nan(diagnosis: Mapping[str, Any]) -> dict[str, Any]:
    """Return a stored diagnosis with what JSON calls null as NaN again."""
    names = ("residual_rms_um", "systematic_rms_um", "noise_floor_um", "lack_of_fit_p")
    return {**diagnosis, **{n: float("nan") for n in names if diagnosis.get(n) is None}}


def said_by_runs(findings: Sequence[Mapping[str, Any]]) -> str:
    """Return lines of what the runs of a campaign say against any model: an effect beside them may be but another name of it."""
    return "".join(f"\nthe runs themselves say: {finding['message']}" for finding in findings)


def report_of(document: Mapping[str, Any]) -> TwinReport:
    """Return what tells a twin, a comparison or a diagnosis, by what its ``as_dict`` gives."""
    if "members" in document:
        from dtwin.report import twin_of_machine

        return twin_of_machine
    if "campaigns" in document:
        from dtwin.report import twin_of_campaigns

        return twin_of_campaigns
    # A twin of tests of a path names no kind.
    return kind_named(document.get("kind", DEFAULT_KIND)).twin_report
