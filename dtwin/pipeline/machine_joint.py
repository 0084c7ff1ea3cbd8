"""All tests of a machine together: one diagnosis of each, and what they say of each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dtwin.acquire.campaign_name import in_lake
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named
from dtwin.lake.rows import by_campaign, campaign_of, moved_in
from dtwin.lake.store import Lake
from dtwin.machine_record import events_of
from dtwin.physics.diagnose import diagnose
from dtwin.physics.effect import Effect
from dtwin.physics.joint import MachineTest, joint
from dtwin.physics.library import Library
from dtwin.pipeline.kept import kept, kept_already, stamp_of
from dtwin.pipeline.machine_history import require_machine
from dtwin.progress import Progress, silent
from dtwin.report.machine_tests import joint_lines
from dtwin.twins.diagnosing_code import diagnosing_code
from dtwin.twins.measured import load

_Rows = Sequence[Mapping[str, Any]]


def machine_joint(
    home: Home,
    machine: str,
    campaigns: Sequence[str] = (),
    progress: Progress = silent,
    library: Mapping[str, Effect] | None = None,
) -> dict[str, Any]:
    """Return what tests of a machine find, each from nothing and all together, JSON-ready.

    ``campaigns``: which; without them the newest one of each kind with the same planes or axes.
    Raises ``InputError`` when there is no such machine, fewer than two tests can be compared, or one is of another machine.
    """
    lake, names = Lake(home.lake), [in_lake(home, name) for name in campaigns]
    for name in names:
        lake.campaign(name)
    rows = [row for name in names for row in lake.runs(name, left_out=True)]
    chosen = (
        _stated(rows, machine, names) if names else newest_tests(lake.runs(left_out=True, machine=machine), machine)
    )
    _require_two(home, machine, list(chosen))
    made = compared(home, machine, chosen, Library() if library is None else library, progress)
    for name in made["passed_over"] if names else ():
        # It says why.
        load(home, name)
    _require_two(home, machine, [test["campaign"] for test in made["tests"]])
    return made


def _require_two(home: Home, machine: str, campaigns: Sequence[str]) -> None:
    if len(campaigns) < 2:
        require_machine(home, machine)
        raise InputError(
            "there are not two tests to compare",
            code="machine.tests",
            where=machine,
            got=", ".join(campaigns) or "none",
            allowed="campaigns of circles, positions or tones; of the same kind, of other planes, axes or days",
            hint=f"older ones of the same sort by --campaign NAME, once for each: dtwin machine show {machine}",
        )


def compared(
    home: Home, machine: str, chosen: Mapping[str, _Rows], library: Mapping[str, Effect], progress: Progress = silent
) -> dict[str, Any]:
    """Return what campaigns of a machine find, as :func:`machine_joint`; one is enough, and none is needed.

    Those that cannot have a twin are under ``passed_over``, with the reason.

    ``chosen``: their rows of the lake's table of runs, by name.
    """
    made: dict[str, Any] = kept(
        home,
        "joint",
        machine,
        _stamp(chosen, library),
        lambda: _compared(home, machine, list(chosen), library, progress),
    )
    # What happened may be recorded after the tests were compared.
    return {"passed_over": {}, **made, "lines": joint_lines(made, library, events_of(home, machine))}


def is_compared(home: Home, machine: str, library: Mapping[str, Effect]) -> bool:
    """Whether what the newest tests of a machine find is kept, so that it takes no diagnosis to say it."""
    chosen = newest_tests(Lake(home.lake).runs(left_out=True, machine=machine), machine)
    return not chosen or kept_already(home, "joint", machine, _stamp(chosen, library)) is not None


def _stamp(chosen: Mapping[str, _Rows], library: Mapping[str, Effect]) -> str:
    """Return what changes with the tests, with the effects that may be in them, and with the code that finds them."""
    tests = (f"{name} {stamp_of(mine)}" for name, mine in chosen.items())
    return " ".join([*tests, *library, diagnosing_code()])


def _compared(
    home: Home, machine: str, campaigns: Sequence[str], library: Mapping[str, Effect], progress: Progress
) -> dict[str, Any]:
    tests = []
    passed_over: dict[str, str] = {}
    for done, name in enumerate(campaigns, start=1):
        try:
            obs = load(home, name).obs
        except InputError as error:
            passed_over[name] = f"{error.message} ({error.got})" if error.got else error.message
            continue
        started = min((meta.started or "" for meta in obs.runs), default="")
        tests.append(MachineTest(name, started, obs, diagnose(obs, [], library)))
        progress(done, len(campaigns), name)
    together = joint(tests, library)
    told = [
        {
            "campaign": test.campaign,
            "kind": test.obs.campaign.kind,
            "started": test.started,
            "verdict": test.found.verdict,
            "found": [[suspect.label for suspect in group] for group in test.found.found],
        }
        for test in tests
    ]
    return {"machine": machine, "tests": told, "passed_over": passed_over, **together.as_dict()}


def _by_campaign(rows: _Rows) -> dict[str, list[Mapping[str, Any]]]:
    return {name: mine for name, mine in by_campaign(rows).items() if not all(row["left_out"] for row in mine)}


def newest_tests(rows: _Rows, machine: str) -> dict[str, list[Mapping[str, Any]]]:
    """Return the newest campaign of each kind with the same planes or axes that can have a twin and has a sound run."""
    newest: dict[tuple[Any, ...], str] = {}
    mine = _by_campaign([row for row in rows if row["machine"] == machine])
    for name in sorted(mine, key=lambda n: str(mine[n][0]["started"] or "")):
        kind = str(mine[name][0]["kind"])
        kept_in = [row for row in mine[name] if not row["left_out"]]
        if kind_named(kind).offers("rows") and any(not row["n_errors"] for row in kept_in):
            newest[kind, moved_in(kept_in)] = name
    return {name: mine[name] for name in newest.values()}


def _stated(rows: _Rows, machine: str, campaigns: Sequence[str]) -> dict[str, list[Mapping[str, Any]]]:
    every = _by_campaign(rows)
    out = {name: every[name] for name in campaigns if name in every}
    for name, mine in out.items():
        own = campaign_of(mine).machine
        if own != machine:
            raise InputError(
                "the campaign is of another machine", code="machine.campaign", where=name, got=own, allowed=machine
            )
        kind_named(str(mine[0]["kind"])).require("rows")
    return out
