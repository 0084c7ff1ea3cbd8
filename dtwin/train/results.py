"""What a trained candidate is, what is known of it, and what the registry keeps."""

from __future__ import annotations

import math
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Literal

from dtwin import __version__
from dtwin.statistics import deviation_interval
from dtwin.units import shown_number

CONDITIONS_FILE = "conditions.json"
"""Artifact of a version: the conditions that it was trained on."""
FRESH_RUN = "fresh_run.rms_um"
"""Metric: RMS error on runs that only the coefficients were fitted without, in um."""
OUTPUT_RMS = "held_out_output_um"
"""Number of a candidate: RMS error of what its bundle tells, held out, where its scores are of something else."""
# Rounding is no harm.
_SAME = 1.0 + 1e-6


@dataclass(frozen=True)
class Scores:
    """Error of a candidate on data that it was not trained on.

    ``group``: what was left out as a whole: ``run``, ``feed_mm_min``, ``radius_mm`` ...
    ``r2``: share of the held-out variance explained, pooled over the held-out groups; finite, and negative where the
    model does harm.
    ``rms_um``, ``mae_um``: held-out error after the set-up's centre and radius are removed.
    ``worst_slice_ratio``: largest ratio of error with the model to error without, over conditions.
    ``n_groups``, ``n_runs``: number of groups that were left out in turn, and of runs in them.
    """

    group: str
    r2: float
    rms_um: float
    mae_um: float
    worst_slice_ratio: float
    worst_slice: str
    n_groups: int
    n_runs: int

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return dict(vars(self))


@dataclass(frozen=True)
class Latency:
    """Time of one evaluation of one row, in the round of three that other work on the computer disturbed least.

    ``what``: what was timed, for example ``bundle tick`` or ``onnxruntime``.
    ``histogram_us``: upper edges and counts.
    """

    p50_us: float
    p99_us: float
    calls: int
    what: str
    histogram_us: tuple[tuple[float, int], ...] = ()


@dataclass(frozen=True)
class Candidate:
    """A trained model with everything that a reviewer needs.

    ``name``, ``family``: for example ``physics-library`` of family ``symbolic``.
    ``promotable``: whether it is an expression that can be frozen into a bundle.
    ``complexity``: nodes of the expression, or parameters of the model.
    ``scores``: by held-out group.
    ``train_rms_um``: error on the rows it was fitted to.
    ``equation``: readable form, empty for what is not an expression.
    ``exports``: file name to content: C, Python, LaTeX ...
    ``onnx``: the model of what is not an expression.
    ``findings``: constant or never-firing terms, bad extrapolation, and the like.
    ``front``: accuracy-complexity front of a symbolic search.
    ``numbers``: further figures.
    """

    name: str
    family: Literal["baseline", "linear", "neighbours", "tree", "neural", "symbolic"]
    promotable: bool
    complexity: int
    scores: Mapping[str, Scores]
    train_rms_um: float
    latency: Latency | None = None
    equation: str = ""
    exports: Mapping[str, str] = field(default_factory=dict)
    bundle: Mapping[str, Any] | None = None
    onnx: bytes | None = None
    findings: tuple[str, ...] = ()
    front: tuple[Mapping[str, Any], ...] = ()
    numbers: Mapping[str, float] = field(default_factory=dict)

    @property
    def held_out(self) -> Scores:
        """Scores by the first group, which candidates are compared by."""
        return next(iter(self.scores.values()))


@dataclass(frozen=True)
class TrainingReport:
    """One training: its data, its candidates, and the one that is proposed.

    ``table_versions``: versions of the lake's tables: the same data can be read again.
    ``noise_floor_um``: RMS that no model's held-out error may go below.
    ``rms_before_um``: RMS of the set-up-corrected error without any model.
    ``candidates``: best first, by held-out error.
    ``proposed``: name of the promotable candidate that the gates should look at.
    ``told``: what the data show before any model, for the reviewer.
    ``floor_is``: what the noise floor is made of.
    ``noise_floor_dof``: degrees of freedom of the noise floor; 0 when nobody counted them.
    """

    machine: str
    campaign: str
    table_versions: Mapping[str, int]
    noise_floor_um: float
    rms_before_um: float
    n_runs: int
    n_rows: int
    candidates: tuple[Candidate, ...]
    proposed: str
    seed: int
    told: tuple[str, ...] = ()
    floor_is: str = "what repeats of the same condition disagree by (unit of replication: the run)"
    noise_floor_dof: int = 0

    @property
    def noise_floor_text(self) -> str:
        """The noise floor with its unit and 95 % interval, or that nobody knows it."""
        if math.isnan(self.noise_floor_um):
            return "unknown without repeats"
        digits = 1 if self.noise_floor_um >= 1.0 else 4
        floor = f"{self.noise_floor_um:z.{digits}f} µm"
        if not self.noise_floor_dof:
            return floor
        low, high = deviation_interval(self.noise_floor_um, self.noise_floor_dof)
        return f"{floor}, {low:z.{digits}f} to {high:z.{digits}f} at 95 %"

    def candidate(self, name: str) -> Candidate:
        """Return a candidate by name."""
        return next(c for c in self.candidates if c.name == name)


def without_correction(candidates: Iterable[Candidate]) -> Candidate | None:
    """Return the candidate that corrects nothing, None when it was not among them."""
    return next((c for c in candidates if c.name == "zero"), None)


def r2_text(r2: float, rms_um: float, zero_um: float | None) -> str:
    """Return R2 to three decimals, or that the model does harm where it was held out.

    ``zero_um``: error without a correction on the same rows.
    """
    worse = zero_um is not None and round(1.0 - (rms_um / zero_um) ** 2, 3) < 0.0
    return "worse than no correction" if worse else f"{r2:z.3f}"


def held_out_text(candidate: Candidate, others: Iterable[Candidate]) -> str:
    """Return R2 by what was left out, or that the candidate does harm there."""
    zero = without_correction(others)
    told = (
        f"{group} out: " + r2_text(s.r2, s.rms_um, zero.scores[group].rms_um if zero else None)
        for group, s in candidate.scores.items()
    )
    return ", ".join(told)


def worse_in_sample(candidates: Sequence[Candidate]) -> list[str]:
    """Say which candidates do harm on the very rows that they were fitted to."""
    zero = without_correction(candidates)
    if zero is None:
        return []
    return [
        f"{c.name} is worse than no correction on the rows that it was fitted to "
        f"({shown_number(c.train_rms_um)} against {shown_number(zero.train_rms_um)} µm): it was not fitted soundly, and "
        "being better than it means nothing"
        for c in candidates
        if not c.train_rms_um <= _SAME * zero.train_rms_um
    ]


def condition_name(condition: Mapping[str, Any]) -> str:
    """Return what a condition of closed-loop evidence is called: a circle, a tone, hours, a log ..."""
    if "frequency_hz" in condition:
        return f"{condition['frequency_hz']:g} Hz {condition['amplitude_um']:g} µm"
    if "from_h" in condition:
        return f"{condition['campaign']} {condition['from_h']:g} to {condition['to_h']:g} h"
    if "test" in condition:
        return f"{condition['axis']} {condition['test']} {condition['hours']:g} h".replace("  ", " ")
    if "approached" in condition:
        return f"{condition['axis']} {condition['approached']}"
    return f"{condition['plane']} R{condition['radius_mm']:g} F{condition['feed_mm_min']:g}"


@dataclass(frozen=True)
class Training:
    """A training and what later steps need of it.

    ``conditions``, of (plane, radius_mm, feed_mm_min): what was trained; of tones (name, frequency_hz, amplitude_um).
    """

    report: TrainingReport
    geometry: Mapping[str, Any]
    conditions: tuple[tuple[str, float, float], ...]


_PACKAGES = ("numpy", "scipy", "scikit-learn", "pyoperon", "numba", "mlflow", "deltalake")


def environment() -> dict[str, str]:
    """Return the versions that a result depends on."""
    versions = {"python": platform.python_version(), "dtwin": __version__}
    for package in _PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "absent"
    return versions


def report_params(report: TrainingReport) -> dict[str, Any]:
    """Return what is logged of a training: what it was made from, and with which versions."""
    return {
        "machine": report.machine,
        "campaign": report.campaign,
        "seed": report.seed,
        "n_runs": report.n_runs,
        "n_rows": report.n_rows,
        **{f"table_version.{k}": v for k, v in report.table_versions.items() if v >= 0},
        **{f"version.{k}": v for k, v in environment().items()},
    }


def report_metrics(report: TrainingReport) -> dict[str, float]:
    """Return the figures of a training that belong to no candidate."""
    return {
        "noise_floor_um": report.noise_floor_um,
        "noise_floor_dof": float(report.noise_floor_dof),
        "rms_before_um": report.rms_before_um,
    }


def candidate_metrics(candidate: Candidate) -> dict[str, float]:
    """Return what is logged of a candidate, by the names that the gates read."""
    metrics = {"train_rms_um": candidate.train_rms_um, "complexity": float(candidate.complexity)}
    for group, scores in candidate.scores.items():
        for name in ("r2", "rms_um", "mae_um", "worst_slice_ratio"):
            metrics[f"leave_{group}_out.{name}"] = float(getattr(scores, name))
    if candidate.latency is not None:
        metrics["latency_p50_us"] = candidate.latency.p50_us
        metrics["latency_p99_us"] = candidate.latency.p99_us
    return metrics | {k: float(v) for k, v in candidate.numbers.items()}
