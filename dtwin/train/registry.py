"""The only place that knows MLflow: runs, registered versions, aliases, history."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mlflow.entities import Metric, Param, RunTag
from mlflow.entities.model_registry import ModelVersion, RegisteredModel
from mlflow.exceptions import MlflowException
from sqlalchemy.exc import SQLAlchemyError

from dtwin.config import Home
from dtwin.errors import InputError, StoreError
from dtwin.people import acting
from dtwin.processes import is_gone, process
from dtwin.schema import require_name
from dtwin.serve.bundle import Bundle
from dtwin.serve.pointer import served_version
from dtwin.serve.withdrawn import named_today
from dtwin.train._registry_client import client_of, every
from dtwin.train.results import (
    Candidate,
    TrainingReport,
    candidate_metrics,
    held_out_text,
    report_metrics,
    report_params,
)

_EXPERIMENT = "dtwin"
_PREFIX = "dtwin-"
_OURS = f"name LIKE '{_PREFIX}%'"
_BUNDLE_FOLDER = "bundle"
MODEL = "model_sha256"
"""Tag of a version: checksum of what moves the machine, ``Bundle.model_sha256``."""
FAULTS = (MlflowException, SQLAlchemyError, OSError)
"""What calls of a registry raise when its database was lost, or is full."""
_PROCESS = "dtwin.process"
NOTE = "mlflow.note.content"
"""Tag of a run or an experiment: what stands at the head of its page."""
_ABOUT = (
    "Trainings, twins and their corrections of all machines of a home. A training is a run with its candidates below; a twin "
    "a run with its versions below. What may be served is in the model registry, and decided by `dtwin promote` alone."
)
_ALIASES = ("candidate", "champion", "previous")


@dataclass(frozen=True)
class RegisteredVersion:
    """A version in the model registry.

    ``run_id``: MLflow run that it comes from.
    ``aliases``: ``candidate``, ``champion``, ``previous`` that point at it.
    ``created``: ISO 8601.
    """

    machine: str
    version: str
    run_id: str
    aliases: tuple[str, ...]
    tags: Mapping[str, str]
    created: str


class Registry:
    """Runs and registered models in one MLflow store: the home gives that and the artifact folder; see ``client_of``."""

    def __init__(self, home: Home, *, reads: bool = False) -> None:
        self.home = home
        self.uri = home.mlflow_uri
        self.client = client_of(home, reads=reads)

    @contextmanager
    def open_run(self, name: str, tags: Mapping[str, str]) -> Iterator[str]:
        """Open an MLflow run and yield its id; it is marked failed when the body fails."""
        told = {**tags, _PROCESS: process(), "mlflow.user": acting()}
        run = self.client.create_run(self.experiment(), run_name=name, tags=told)
        try:
            yield run.info.run_id
        except BaseException:
            self.client.set_terminated(run.info.run_id, status="FAILED")
            raise
        self.client.set_terminated(run.info.run_id)

    def close_abandoned(self) -> int:
        """Mark runs as killed whose process of this computer is gone; return how many."""
        running = self.client.search_runs([self.experiment()], "attributes.status = 'RUNNING'", max_results=1000)
        for gone in (dead := [r for r in running if is_gone(r.data.tags.get(_PROCESS, ""))]):
            self.client.set_terminated(gone.info.run_id, status="KILLED")
        return len(dead)

    def log_training(self, report: TrainingReport, artifacts: Mapping[str, str | bytes]) -> dict[str, str]:
        """Log every candidate as a run, below one parent with ``artifacts``: pages and tables, by file name.

        Returns MLflow run id by candidate name, and of the parent under ``""``.
        """
        stamp = time.strftime("%Y%m%d-%H%M%S")
        ids: dict[str, str] = {}
        tags = {"dtwin.machine": report.machine, "dtwin.campaign": report.campaign}
        with self.open_run(f"training {report.campaign} {stamp}", tags) as parent:
            ids[""] = parent
            self.log(parent, report_params(report), report_metrics(report), {})
            self.log_files(parent, artifacts)
            for candidate in report.candidates:
                with self.open_run(candidate.name, tags) as child:
                    ids[candidate.name] = child
                    self._log_candidate(child, parent, report, candidate)
        return ids

    def register(
        self, report: TrainingReport, run_id: str, candidate: Candidate, description: str = ""
    ) -> RegisteredVersion:
        """Register an expression as a new version and point ``candidate`` at it.

        ``description``: what the reviewer reads first, in Markdown.
        """
        name = model_name(report.machine)
        self.ensure_model(
            name,
            f"Correction of the machine {report.machine}. Versions are served only after `dtwin promote`; an alias "
            "moved by hand has no effect.",
            machine=report.machine,
            holds="correction",
        )
        created = self.client.create_model_version(
            name,
            source=f"runs:/{run_id}/{_BUNDLE_FOLDER}",
            run_id=run_id,
            description=description,
            tags={"candidate": candidate.name, "state": "candidate", **_model_tag(candidate)},
        )
        self.client.set_registered_model_alias(name, "candidate", created.version)
        return self.version(report.machine, str(created.version))

    def drop(self, version: RegisteredVersion, instead: RegisteredVersion) -> None:
        """Take back a version that nobody used, for an equal one before it, which becomes the candidate again."""
        self.client.delete_model_version(model_name(version.machine), version.version)
        self.mark(instead, {}, alias="candidate")

    def ensure_model(self, name: str, description: str, *, machine: str, holds: str) -> None:
        """Make a registered model unless it is there.

        ``machine``, ``holds``: tags by which people filter: whose it is, and ``twin`` or ``correction``.
        """
        try:
            self.client.get_registered_model(name)
        except MlflowException:
            self.client.create_registered_model(name, {"machine": machine, "holds": holds}, description)

    def version(self, machine: str, wanted: str) -> RegisteredVersion:
        """Return a version by number or alias.

        ``wanted``: a version number, or ``candidate``, ``champion``, ``previous``; the champion is what is served, whatever
        its alias says.
        Raises ``InputError`` when there is no such version.
        """
        served = served_version(machine, self.home) if wanted == "champion" else None
        return self._version(machine, wanted if served is None else str(served))

    def _version(self, machine: str, wanted: str) -> RegisteredVersion:
        name = model_name(machine)
        try:
            registered = (
                self.client.get_model_version_by_alias(name, wanted)
                if wanted in _ALIASES
                else self.client.get_model_version(name, wanted)
            )
        except MlflowException as error:
            known = [v.version for v in self.versions(machine)]
            raise InputError(
                "no such model version",
                code="model.unknown",
                where=f"machine {machine}",
                got=wanted,
                allowed=", ".join(known) or "none yet",
                hint="dtwin models lists what there is; dtwin train makes one",
            ) from error
        # A search for versions, and an alias query, leave the aliases out.
        return _registered(machine, registered, self.client.get_registered_model(name).aliases)

    def champion(self, machine: str, *, by_alias: bool = False) -> RegisteredVersion | None:
        """Return the machine's champion, None when nothing was promoted; ``by_alias``: what the books say, and not what is served."""
        try:
            return (self._version if by_alias else self.version)(machine, "champion")
        except InputError:
            return None

    def versions(self, machine: str) -> list[RegisteredVersion]:
        """Return all versions of a machine's model, newest first."""
        name = model_name(machine)
        versions = every(self.client.search_model_versions, f"name='{name}'")
        return _newest_first(machine, versions, self.client.get_registered_model(name).aliases) if versions else []

    def every_version(self) -> dict[str, list[RegisteredVersion]]:
        """Return all versions of every machine that has one, newest first."""
        of_model: dict[str, list[ModelVersion]] = {}
        for version in every(self.client.search_model_versions, _OURS):
            of_model.setdefault(version.name, []).append(version)
        return {
            (machine := model.name.removeprefix(_PREFIX)): _newest_first(machine, of_model[model.name], model.aliases)
            for model in self._models()
            if model.name in of_model
        }

    def machines(self) -> list[str]:
        """Return the machines that have a registered model."""
        return [model.name.removeprefix(_PREFIX) for model in self._models()]

    def _models(self) -> list[RegisteredModel]:
        return sorted(every(self.client.search_registered_models, _OURS), key=lambda model: model.name)

    def bundle(self, version: RegisteredVersion) -> dict[str, Any]:
        """Return the bundle of a version, as data."""
        return self.read_json(version, f"{_BUNDLE_FOLDER}/bundle.json")

    def read_json(self, version: RegisteredVersion, name: str) -> Any:
        """Return a JSON artifact of the run behind a version.

        Raises ``InputError`` when there is no such artifact.
        Raises ``StoreError`` when it cannot be read as JSON.
        """
        where = f"machine {version.machine} version {version.version} {name}"
        try:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(self.client.download_artifacts(version.run_id, name, folder))
                content = path.read_text(encoding="utf-8")
        except (MlflowException, OSError) as error:
            raise InputError(
                "the registry holds no such file", code="model.artifact", where=where, got=str(error)[:160]
            ) from error
        try:
            return json.loads(content)
        except (ValueError, RecursionError) as error:
            raise StoreError("a file in the registry is damaged", code="model.artifact", where=where) from error

    def files(self, version: RegisteredVersion, folder: str) -> list[str]:
        """Return the names of the files in a folder of the run behind a version, sorted."""
        try:
            listed = self.client.list_artifacts(version.run_id, folder)
        except (MlflowException, OSError) as error:
            raise StoreError(
                "the registry's files cannot be listed",
                code="model.artifact",
                where=f"machine {version.machine} version {version.version} {folder}",
                got=str(error)[:160],
            ) from error
        return sorted(item.path for item in listed if not item.is_dir)

    def metrics(self, version: RegisteredVersion) -> dict[str, float]:
        """Return the metrics of the run behind a version."""
        return dict(self.client.get_run(version.run_id).data.metrics)

    def mark(
        self,
        version: RegisteredVersion,
        tags: Mapping[str, str],
        *,
        alias: str | None = None,
        description: str | None = None,
    ) -> None:
        """Set tags, and perhaps an alias and a description, on a version."""
        name = model_name(version.machine)
        for key, value in tags.items():
            self.client.set_model_version_tag(name, version.version, key, value)
        if alias is not None:
            self.client.set_registered_model_alias(name, alias, version.version)
        if description is not None:
            self.client.update_model_version(name, version.version, description)

    def description(self, version: RegisteredVersion) -> str:
        """Return the description of a version."""
        version_ = self.client.get_model_version(model_name(version.machine), version.version)
        return version_.description or ""

    def note(self, run_id: str, text: str) -> None:
        """Write what stands at the head of a run's page, in Markdown."""
        self.client.set_tag(run_id, NOTE, text)

    def attach(self, version: RegisteredVersion, artifacts: Mapping[str, str | bytes]) -> None:
        """Add files to the run behind a version, for the reviewer."""
        self.log_files(version.run_id, artifacts)

    def _log_candidate(self, run_id: str, parent: str, report: TrainingReport, candidate: Candidate) -> None:
        params = {
            "family": candidate.family,
            "promotable": candidate.promotable,
            "complexity": candidate.complexity,
            **report_params(report),
        }
        tags = {
            "mlflow.parentRunId": parent,
            "dtwin.candidate": candidate.name,
            "dtwin.held_out": held_out_text(candidate, report.candidates),
        }
        if candidate.equation:
            tags[NOTE] = f"```\n{candidate.equation[:4000]}\n```"
        self.log(run_id, params, candidate_metrics(candidate), tags)
        files: dict[str, str | bytes] = dict(candidate.exports)
        if candidate.findings:
            files["findings.txt"] = "\n".join(candidate.findings)
        if candidate.front:
            files["front.json"] = json.dumps(list(candidate.front), indent=1)
        if candidate.latency is not None:
            files["latency.json"] = json.dumps(vars(candidate.latency), indent=1)
        if candidate.bundle is not None:
            files[f"{_BUNDLE_FOLDER}/bundle.json"] = json.dumps(candidate.bundle)
        if candidate.onnx is not None:
            files["onnx/model.onnx"] = candidate.onnx
        self.log_files(run_id, files)

    def log(
        self,
        run_id: str,
        params: Mapping[str, Any],
        metrics: Mapping[str, float],
        tags: Mapping[str, str],
        step: int = 0,
    ) -> None:
        """Log parameters, metrics and tags of a run; ``step``: place of the metrics on the axis of their chart."""
        now = int(time.time() * 1000)
        self.client.log_batch(
            run_id,
            metrics=[Metric(k, float(v), now, step) for k, v in metrics.items() if v == v],
            params=[Param(k, str(v)[:500]) for k, v in params.items()],
            tags=[RunTag(k, v) for k, v in tags.items()],
        )

    def log_files(self, run_id: str, files: Mapping[str, str | bytes]) -> None:
        """Log artifacts of a run, by name."""
        if not files:
            return
        with tempfile.TemporaryDirectory() as folder:
            for name, content in files.items():
                path = Path(folder) / name
                path.parent.mkdir(parents=True, exist_ok=True)
                if isinstance(content, bytes):
                    path.write_bytes(content)
                else:
                    path.write_text(content, encoding="utf-8")
            self.client.log_artifacts(run_id, folder)

    def experiment(self) -> str:
        """Return the id of dtwin's experiment, which is made when it is not there.

        Raises ``StoreError`` when somebody deleted it in MLflow, which keeps it and its name.
        """
        experiment = self.client.get_experiment_by_name(_EXPERIMENT)
        if experiment is not None and experiment.lifecycle_stage == "deleted":
            raise StoreError(
                f"the experiment {_EXPERIMENT} was deleted in MLflow",
                code="registry.deleted",
                where=self.uri,
                hint=f"MLFLOW_TRACKING_URI={self.uri} mlflow experiments restore --experiment-id {experiment.experiment_id}",
            )
        if experiment is not None:
            return str(experiment.experiment_id)
        own = not self.uri.startswith("http")
        where = str(self.home.mlflow_artifacts) if own else None
        try:
            return str(self.client.create_experiment(_EXPERIMENT, artifact_location=where, tags={NOTE: _ABOUT}))
        except MlflowException:
            # Another process was first.
            experiment = self.client.get_experiment_by_name(_EXPERIMENT)
            if experiment is None:
                raise
            return str(experiment.experiment_id)


def model_name(machine: str) -> str:
    """Return the registered model's name for a machine; it becomes a part of questions to the registry."""
    return f"{_PREFIX}{require_name(machine, 'the machine')}"


def _newest_first(machine: str, stored: Sequence[ModelVersion], aliases: Mapping[str, str]) -> list[RegisteredVersion]:
    ordered = sorted(stored, key=lambda version: int(version.version), reverse=True)
    return [_registered(machine, version, aliases) for version in ordered]


def _registered(machine: str, version: ModelVersion, aliases: Mapping[str, str]) -> RegisteredVersion:
    return RegisteredVersion(
        machine=machine,
        version=str(version.version),
        run_id=version.run_id or "",
        aliases=tuple(sorted(alias for alias, number in aliases.items() if str(number) == str(version.version))),
        tags={key: named_today(value) if key == "state" else value for key, value in version.tags.items()},
        created=time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(version.creation_timestamp / 1e3)),
    )


def _model_tag(candidate: Candidate) -> dict[str, str]:
    """Return the checksum by which export, serve, journal and runs name the same correction."""
    return {} if candidate.bundle is None else {MODEL: Bundle.from_dict(candidate.bundle).model_sha256}
