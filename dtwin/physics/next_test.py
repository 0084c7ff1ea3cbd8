"""Which test of a machine to make next: bits about its faults that a planned test adds to those that were made.

The sizes of causes are unknown numbers that several instruments see. Before any test each is uncertain by its
ordinary size. A test takes from that what its runs show beside their set-ups and its noise, so that two causes
that no test tells apart stay uncertain together. The worth of a planned test is the sum over all sizes of the bits
that it adds. Sizes count to a tenth of the ordinary one: to know a size still better tells nothing about which faults
there are. Bits count in full about what a test found and could not tell apart, once for each such finding, and by
``_SHARE`` about what no test has shown, for most machines do not have it.

Linear Bayesian design: K. Chaloner and I. Verdinelli, Bayesian experimental design: a review, Statistical
Science 10 (1995) 273-304. Shapes of effects (pitch, frequency, travel) are taken at their starting values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.physics.candidates import applicable
from dtwin.physics.effect import Effect, Instance
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Problem, set_up, unweighted, weighted_like
from dtwin.physics.state import AXES_OF
from dtwin.physics.whitening import PureError
from dtwin.schema import Floats

_ENOUGH = 0.1
# Assumed share of machines that have a fault that nobody has looked for.
_SHARE = 0.2
_COVERAGE_FACTOR = 2.0
# A size is told when it is known to half of the ordinary one, with k = 2.
_TOLD = 0.25


@dataclass(frozen=True)
class Unknown:
    """A number that tests have in common.

    ``cause``, ``axis``: what it is the size of: a cause that instruments share, or an effect that one kind of test
    sees.
    ``part``: the parameter, such as ``cosine``; empty where there is only one.
    ``typical``: size on an ordinary machine.
    ``sort``: the only sort of test that sees it; empty for a cause that several kinds see.
    """

    cause: str
    axis: str
    part: str
    unit: str
    typical: float
    sort: str

    @property
    def name(self) -> str:
        """The cause in words."""
        return self.cause.replace("_", " ")

    @property
    def label(self) -> str:
        """Cause in words, with axis and parameter."""
        part = f"({self.part.replace('_', ' ')})" if self.part else ""
        return " ".join(word for word in (self.name, self.axis, part) if word)


@dataclass(frozen=True)
class _Gain:
    """What a planned test would tell of one unknown: its uncertainty before and after, k = 2."""

    unknown: Unknown
    before: float
    after: float

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {"cause": self.unknown.label, "unit": self.unknown.unit, "before": self.before, "after": self.after}


@dataclass(frozen=True)
class _Worth:
    """Bits that a planned test adds, each by how much it counts, and the unknowns that it would tell, most first."""

    bits: float
    told: tuple[_Gain, ...]


@dataclass(frozen=True)
class Made:
    """A test that was made.

    ``unclear``: groups of effects, with their axes, that it found and that leave open what it is, see :func:`unclear`.
    """

    obs: Observations
    unclear: Sequence[Sequence[str]] = ()


class Knowledge:
    """What tests say of the faults of a machine.

    ``measured``: tests that were made.
    ``planned``: tests that could be made, with nothing in them.
    ``library``: effects that may be there.
    ``noise_um``: RMS by which repeats disagree, for each kind of planned test; a kind that was measured tells its own.
    """

    def __init__(
        self,
        measured: Sequence[Made],
        planned: Sequence[Observations],
        library: Mapping[str, Effect],
        noise_um: Mapping[str, float],
    ) -> None:
        self._index: dict[Unknown, int] = {}
        self._library, self._noise_um = library, dict(noise_um)
        self._found = {label for test in measured for group in test.unclear for label in group}
        # How much larger than ordinary a cause must be where a test found it, or what looks alike.
        self._larger: dict[tuple[str, str, str], float] = {}
        # For each unknown the labels, of what a test found and nothing settled, that it may be behind.
        self._behind: dict[Unknown, set[str]] = {}
        noise: dict[str, PureError] = {}
        seen = []
        for test in measured:
            problem = set_up(test.obs, [], [])
            # Without repeats, or with equal ones, the noise is the instrument's usual one.
            if problem.noise is None or not problem.noise.floor_um > 0.0:
                problem = unweighted(test.obs, [])
            else:
                noise[test.obs.grid.kind] = problem.noise
                self._noise_um[test.obs.grid.kind] = problem.noise.floor_um
            seen.append(_Seen(problem, library))
            self._enlarge(seen[-1], test.unclear)
        known = [self._information(one) for one in seen]
        foreseen = []
        for obs in planned:
            own = noise.get(obs.grid.kind)
            alike = own is not None and len(own.weights) == obs.n_bins
            problem = weighted_like(obs, [], own) if own is not None and alike else unweighted(obs, [])
            foreseen.append(self._information(_Seen(problem, library)))
        # In units of the ordinary size every unknown is uncertain by one.
        self._before = np.eye(len(self._index)) + sum(map(self._whole, known), np.zeros(2 * (len(self._index),)))
        self._planned = [self._whole(information) for information in foreseen]

    @property
    def untold(self) -> tuple[Unknown, ...]:
        """What the measured tests do not tell to half of its ordinary size."""
        spread = _spread(self._before)
        return tuple(unknown for unknown, i in self._index.items() if spread[i] > _TOLD)

    def worth(self, number: int) -> _Worth:
        """Return what the planned test with this number adds to those that were made."""
        old, new = (_spread(matrix) for matrix in (self._before, self._before + self._planned[number]))
        bits = 0.5 * np.log2((old**2 + _ENOUGH**2) / (new**2 + _ENOUGH**2))
        counts = np.array([len(self._behind.get(unknown, ())) or _SHARE for unknown in self._index])
        newly = [(old[i] / new[i], u, i) for u, i in self._index.items() if old[i] > _TOLD >= new[i]]
        told = [
            _Gain(u, *(float(_COVERAGE_FACTOR * s[i] * u.typical) for s in (old, new)))
            for _, u, i in sorted(newly, key=lambda entry: -entry[0])
        ]
        return _Worth(float(bits @ counts), tuple(told))

    def _enlarge(self, seen: _Seen, groups: Sequence[Sequence[str]]) -> None:
        """Take the effects of a group as large as the one that shows most: any of them may be all of what was found."""
        for group in groups:
            shown = {label: seen.rms(label) for label in group if label in seen.columns}
            for label, rms in shown.items():
                for key in self._keys(seen, label):
                    if rms > 0.0:
                        self._larger[key] = max(self._larger.get(key, 1.0), max(shown.values()) / rms)

    def _keys(self, seen: _Seen, label: str) -> list[tuple[str, str, str]]:
        """Return cause or effect, axis, and the sort of test that alone sees it, behind the columns of an effect."""
        instance = seen.instances[label]
        if instance.effect.cause:
            axes = AXES_OF.get(instance.axis, (instance.axis,))
            return [(instance.effect.cause, axis, "") for axis in axes]
        obs = seen.problem.obs
        # What a test could not tell apart, another place shows only where both measure the same cause.
        sort = (obs.grid.kind, *(obs.planes if label in self._found else ()))
        return [(instance.effect.name, instance.axis, " ".join(sort))]

    def _information(self, seen: _Seen) -> tuple[list[int], Floats]:
        """Return the unknowns that a test sees, and the information about them, in units of their ordinary sizes."""
        columns: dict[Unknown, Floats] = {}
        for label, own in seen.columns.items():
            parameters = seen.instances[label].effect.parameters
            for (name, axis, sort), sign in zip(self._keys(seen, label), (1.0, -1.0), strict=False):
                larger = self._larger.get((name, axis, sort), 1.0)
                for i in np.flatnonzero(own.any(axis=0)):
                    parameter = parameters[i]
                    part = parameter.name if len(parameters) > 1 else ""
                    unknown = Unknown(name, axis, part, parameter.unit, larger * parameter.typical, sort)
                    columns[unknown] = columns.get(unknown, 0.0) + sign * unknown.typical * own[:, i]
                    if label in self._found:
                        self._behind.setdefault(unknown, set()).add(label)
        at = [self._index.setdefault(unknown, len(self._index)) for unknown in columns]
        matrix = np.stack(list(columns.values()), axis=1)
        noise = seen.problem.noise
        variance = (
            self._noise_um[seen.problem.obs.grid.kind] ** 2 if noise is None else float(np.nanmean(noise.variance))
        )
        return at, matrix.T @ matrix / variance

    def _whole(self, information: tuple[list[int], Floats]) -> Floats:
        at, own = information
        out = np.zeros((len(self._index), len(self._index)))
        out[np.ix_(at, at)] = own
        return out


class _Seen:
    """What the effects of the library show in a test, beside its set-ups.

    ``columns``: by label, whitened, shape (rows * n, parameters), for a size of one.
    """

    def __init__(self, problem: Problem, library: Mapping[str, Effect]) -> None:
        self.problem = problem
        instances, _ = applicable(library, problem.obs, [])
        self.instances = {instance.label: instance for instance in instances}
        self.columns: dict[str, Floats] = {}
        for label, instance in self.instances.items():
            whole = problem.whitened(problem.obs.regressors(instance, instance.effect.start_shape))
            self.columns[label] = whole - problem.basis @ (problem.basis.T @ whole)

    def rms(self, label: str) -> float:
        """Return what an effect of ordinary size shows."""
        sizes = [parameter.typical for parameter in self.instances[label].effect.parameters]
        return float(np.sqrt(((self.columns[label] * sizes) ** 2).sum(axis=1).mean()))


def unclear(
    tests: Sequence[Sequence[Sequence[str]]], measured: Sequence[Observations], library: Mapping[str, Effect]
) -> list[list[Sequence[str]]]:
    """Return, of the groups that each test found, those that leave open what it is.

    Of a group of several effects no test names a member alone that sees as much of it: a bow towards Y is not one towards
    Z. A difference of two axes, as a scale mismatch, leaves open which of them it is, until a test names the cause on one of
    them alone.
    """
    alone = [(g[0], obs) for groups, obs in zip(tests, measured, strict=True) for g in groups if len(g) == 1]
    split = {label: label.partition(" ") for label, _ in alone}
    told = {(library[name].cause, axis) for name, _, axis in split.values()}

    def acting(label: str, obs: Observations) -> set[str]:
        name, _, where = label.partition(" ")
        effect = library[name]
        columns = obs.regressors(Instance(effect, where), effect.start_shape)
        return {p.name for i, p in enumerate(effect.parameters) if columns[:, :, i].any()}

    def is_open(group: Sequence[str], obs: Observations) -> bool:
        if len(group) > 1:
            return not any(label in group and acting(label, obs) <= acting(label, other) for label, other in alone)
        name, _, where = split[group[0]]
        cause = library[name].cause
        return bool(cause) and where in AXES_OF and not any((cause, axis) in told for axis in AXES_OF[where])

    return [[group for group in groups if is_open(group, obs)] for groups, obs in zip(tests, measured, strict=True)]


def _spread(information: Floats) -> Floats:
    """Return the standard uncertainty of each unknown, in units of its ordinary size."""
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(information))))
