"""An open home: its verbs return pandas frames, and results that draw themselves.

The verbs are those of the command line, and call the same functions.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd
from threadpoolctl import threadpool_limits

from dtwin.acquire.ingest import ingest as ingest_path
from dtwin.config import Home, home, home_in, quiet_environment
from dtwin.errors import InputError, StoreError
from dtwin.kinds.machine import Request
from dtwin.kinds.registry import kind_named, machine_named
from dtwin.lake.store import Lake
from dtwin.notebook._arguments import path_of, plain, require_flag, require_seed, require_text, texts_of, version_of
from dtwin.notebook.answers import (
    ComparisonResult,
    DiagnosisResult,
    IngestResult,
    TwinResult,
    of_comparison,
    of_diagnosis,
    of_twin,
)
from dtwin.physics import localise
from dtwin.physics.library import Library
from dtwin.schema import Run
from dtwin.shared_documents import follow_shared
from dtwin.twins.measured import load, pure_rms_um
from dtwin.twins.of_kind import fit_twin, twins_with

if TYPE_CHECKING:
    import plotly.graph_objects as go

    from dtwin.twins.of_kind import AnyTwins

_TOLD = (
    *("plane", "radius_mm", "feed_mm_min", "direction", "axis", "screw_pitch_mm", "instrument", "kind"),
    *("setup", "repeat", "machine", "started", "campaign"),
)
_RUN_COLUMNS = (
    "campaign",
    "run_id",
    "machine",
    "kind",
    "plane",
    "direction",
    "radius_mm",
    "feed_mm_min",
    "repeat",
    "setup",
    "started",
    "sample_rate_hz",
    "n_samples",
    "n_errors",
    "status",
    "correction",
    "left_out",
)

# A notebook has loaded numpy before it opens a home, when the environment is too late; many threads in the small
# matrices of a fit make it several times slower.
_in_one_thread = threadpool_limits.wrap(limits=1, user_api="blas")


class OpenHome:
    """A home and the verbs on what it holds; :func:`open_home` makes one."""

    def __init__(self, home: Home, effects: str | Path | Iterable[str | Path] = ()) -> None:
        self.home = home
        self._lake = Lake(home.lake)
        files = [effects] if isinstance(effects, str) else texts_of(effects, "files of effects")
        self._library = Library([path_of(file, "a file of effects") for file in files])

    def __repr__(self) -> str:
        campaigns = self._lake.campaigns()
        return f"home {self.home.root}, campaigns: {', '.join(campaigns) or 'none yet'}"

    def simulate(
        self,
        machine: str,
        out: str | Path,
        *,
        quick: bool = False,
        seed: int = 0,
        hidden: str | None = None,
        truth: str | None = None,
        schedule: str | None = None,
    ) -> Path:
        """Measure the usual campaign of a virtual machine and return its folder.

        Args:
            machine: Such as ``mill``; the page "Kinds of campaign" lists them with their options.
            hidden: Option of some machines.
            truth: Option of some machines.
            schedule: Option of some machines.

        Raises:
            InputError: When there is no such machine, or it has no such option.
        """
        require_text(machine, "a virtual machine")
        require_flag(quick, "quick")
        folder = path_of(out, "the folder of a campaign")
        virtual = machine_named(machine)
        require_seed(seed)
        options = virtual.chosen({"hidden": hidden, "truth": truth, "schedule": schedule})
        virtual.simulate(Request(folder, seed, quick, None, options), _silent)
        return folder

    def ingest(self, path: str | Path, **told: str | float) -> IngestResult:
        """Bring a campaign folder, a ``.b5r`` or a table into the lake; safe to repeat.

        Args:
            **told: Of a table that lies alone: ``plane``, ``radius_mm``, ``feed_mm_min``, ``direction``, ``axis``,
                ``screw_pitch_mm``, ``instrument``, ``kind``, ``setup``, ``repeat``, ``machine``, ``started``,
                ``campaign``.

        Raises:
            InputError: When the files cannot be used, or something is told that nobody asked for.
        """
        unknown = sorted(set(told) - set(_TOLD))
        if unknown:
            raise InputError(
                "this is not told of a table",
                code="ingest.told",
                got=", ".join(unknown)[:120],
                allowed=", ".join(_TOLD),
            )
        ingested = ingest_path(path_of(path, "what is ingested"), self._lake, told=plain(told))
        rows = [{"run_id": run, **finding.as_dict()} for run, finding in ingested.findings]
        columns = ["run_id", "severity", "code", "message"]
        return IngestResult(
            ingested.campaign,
            ingested.added,
            ingested.unchanged,
            ingested.rejected_rows,
            pd.DataFrame(rows, columns=columns),
        )

    def runs(self, campaign: str | None = None) -> pd.DataFrame:
        """Return one row for each run, with its conditions and covariates as columns.

        A covariate that has the name of another column, such as a measured ``feed_mm_min``, is
        ``covariate_feed_mm_min``.

        Args:
            campaign: Only this one.

        Raises:
            InputError: When there is no such campaign.
        """
        if campaign is not None:
            require_text(campaign, "a campaign")
        rows = self._lake.runs(campaign, left_out=True)
        if campaign is not None and not rows:
            self._lake.campaign(campaign)
        kept = []
        for row in rows:
            told = {name: row[name] for name in _RUN_COLUMNS} | json.loads(row["condition_json"])
            measured = json.loads(row["covariates_json"])
            kept.append(told | {f"covariate_{n}" if n in told else n: value for n, value in measured.items()})
        return pd.DataFrame(kept) if kept else pd.DataFrame(columns=list(_RUN_COLUMNS))

    def samples(self, campaign: str, run: str) -> pd.DataFrame:
        """Return the samples of a run's reference instrument.

        Args:
            campaign: As :meth:`runs` names it.
            run: As :meth:`runs` names it.

        Raises:
            InputError: When there is no such run.
        """
        return pd.DataFrame(dict(self._run(campaign, run).samples))

    def signals(self, campaign: str, run: str, group: str | None = None) -> pd.DataFrame:
        """Return the high-rate signals of one device during a run, with its own clock ``t_s``.

        Args:
            campaign: As :meth:`runs` names it.
            run: As :meth:`runs` names it.
            group: The device, such as ``accelerometers``; may be left away when there is one.

        Raises:
            InputError: When the run has no such signals, or several and none was named.
        """
        groups = {signal.name: signal for signal in self._run(campaign, run, signals=True).signals}
        if group is None and len(groups) == 1:
            (group,) = groups
        if group not in groups:
            raise InputError(
                "the run has no such signals",
                code="notebook.signals",
                where=f"{campaign} {run}",
                got=str(group)[:60],
                allowed=", ".join(groups) or "it has none",
            )
        columns = dict(groups[group].columns)
        return pd.DataFrame({"t_s": groups[group].t_s} | columns)

    @_in_one_thread
    def fit(
        self, campaign: str | Sequence[str], effects: str | Sequence[str], name: str, *, robust: bool = False
    ) -> TwinResult:
        """Fit effects to a campaign, or to several of one machine; an existing twin of that name gets a new version.

        Args:
            campaign: Name in the lake, or a path, which is ingested first.
            effects: Names; ``backlash:X`` takes one axis.
            robust: Give runs that are far off less weight.

        Raises:
            InputError: When the campaign, an effect or the name cannot be used.
        """
        names = effects.split(",") if isinstance(effects, str) else texts_of(effects, "effects")
        wanted = [part.strip() for part in names if part.strip()]
        campaigns = texts_of(campaign, "campaigns")
        require_text(name, "a twin")
        require_flag(robust, "robust")
        return of_twin(*fit_twin(self.home, self._library, campaigns, wanted, name, robust=robust))

    def show(self, name: str, version: int | None = None) -> TwinResult:
        """Return a version of a twin, the newest one without a number."""
        twins = self._twins(name)
        return of_twin(twins, twins.newest(name, version_of(version)))

    @_in_one_thread
    def compare(self, name: str, campaign: str | None = None) -> ComparisonResult:
        """Compare a twin with measurements, those of its fit or of another campaign."""
        if campaign is not None:
            require_text(campaign, "a campaign")
        return of_comparison(self._twins(name).compare(name, campaign))

    @_in_one_thread
    def diagnose(self, name: str, *, seed: int = 0) -> DiagnosisResult:
        """Name the effect that a twin lacks, or say why it cannot be named."""
        require_seed(seed)
        twins = self._twins(name)
        result = of_diagnosis(*twins.diagnose(name, seed=seed))
        _warn_unkept(twins)
        return result

    @_in_one_thread
    def add(self, name: str, effect: str, axis: str = "") -> TwinResult:
        """Add an effect, refit, and return the new version."""
        require_text(effect, "an effect")
        require_text(axis, "an axis")
        twins = self._twins(name)
        return of_twin(twins, twins.add(name, effect, axis))

    @_in_one_thread
    def remove(self, name: str, effect: str, axis: str = "") -> TwinResult:
        """Take an effect out, refit, and return the new version."""
        require_text(effect, "an effect")
        require_text(axis, "an axis")
        twins = self._twins(name)
        return of_twin(twins, twins.remove(name, effect, axis))

    @_in_one_thread
    def discover(self, name: str, *, seed: int = 0) -> DiagnosisResult:
        """Add all that these runs can tell, one version each; return the last diagnosis."""
        require_seed(seed)
        twins = self._twins(name)
        _, _, said = twins.discover(name, seed=seed)
        _warn_unkept(twins)
        return of_diagnosis(twins.newest(name), said)

    def history(self, name: str) -> pd.DataFrame:
        """Return one row for each version of a twin: action, error before and after, verdict."""
        return pd.DataFrame(self._twins(name).history(name)).drop(columns="mlflow")

    def plot(self, campaign: str, run: str, drawing: str | None = None) -> go.Figure:
        """Return a figure of a run, as the page of the run shows it.

        Args:
            campaign: As :meth:`runs` names it.
            run: As :meth:`runs` names it.
            drawing: Such as ``polar`` or ``spectrum``; the first of the kind without.

        Raises:
            NotOffered: When nothing is drawn of this kind of campaign.
            InputError: When there is no such drawing.
        """
        loaded = self._run(campaign, run)
        drawings = {known.name: known for known in kind_named(loaded.meta.kind).drawings}
        wanted = next(iter(drawings)) if drawing is None else drawing
        require_text(wanted, "a figure")
        if wanted not in drawings:
            raise InputError(
                "there is no such figure of the run",
                code="notebook.figure",
                got=wanted[:40],
                where=f"{campaign} {run}",
                allowed=", ".join(drawings),
            )
        return drawings[wanted].draw(loaded, lambda: self._floor_um(campaign))

    def _twins(self, name: str) -> AnyTwins:
        require_text(name, "a twin")
        return twins_with(self.home, self._library, name)

    def _run(self, campaign: str, run: str, *, signals: bool = False) -> Run:
        require_text(campaign, "a campaign")
        require_text(run, "a run")
        rows = {row["run_id"]: row for row in self._lake.runs(campaign, left_out=True)}
        if not rows:
            self._lake.campaign(campaign)
        if run not in rows:
            raise InputError(
                "no such run in the campaign",
                code="run.unknown",
                where=f"campaign {campaign}",
                got=run[:100],
                allowed=", ".join(sorted(rows))[:400],
            )
        return self._lake.load(rows[run], signals=signals)

    def _floor_um(self, campaign: str) -> float:
        try:
            obs = load(self.home, campaign).obs
        except InputError:
            return math.nan
        return pure_rms_um(obs, localise.residual_um(obs, []))


def open_home(folder: str | Path | None = None, effects: str | Path | Iterable[str | Path] = ()) -> OpenHome:
    """Open the folder that holds all state; it is made with the first thing that is kept.

    Args:
        folder: ``DTWIN_HOME``, by default ``.dtwin`` in the current folder, without.
        effects: Your own effect files, or folders of them. Their code is run.
    """
    quiet_environment()
    root = home() if folder is None else home_in(path_of(folder, "a home"))
    if root.root.is_file():
        raise InputError(
            "a home is a folder, and this is a file",
            code="home.file",
            got=str(root.root),
            allowed="a folder, or a new name",
        )
    root.require_parts(named=folder is not None)
    follow_shared(root)
    return OpenHome(root.tightened(), effects)


def _silent(done: int, total: int, what: str) -> None:
    """Take progress that nobody watches."""


def _warn_unkept(twins: AnyTwins) -> None:
    """Say that a diagnosis is not kept, which is returned all the same."""
    try:
        twins.require_kept()
    except StoreError as error:
        warnings.warn(error.render(), stacklevel=4)
