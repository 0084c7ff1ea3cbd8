"""Free symbolic regression behind one interface: Operon by default, PySR when Julia is there."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, Protocol

import numpy as np
import scipy

from dtwin.errors import InputError, MissingPart
from dtwin.schema import Floats
from dtwin.statistics import rms
from dtwin.train.formula import Formula, parse_formula

SUBSAMPLE = 1000
_OPERON_SYMBOLS = "add,sub,mul,div,sin,cos,exp,square,constant,variable"


@dataclass(frozen=True)
class Found:
    """One formula of a search's accuracy-complexity front.

    ``text``: as the engine wrote it.
    ``complexity``: the engine's own measure.
    ``loss``: the engine's own loss on its subsample.
    """

    text: str
    complexity: int
    loss: float


class Engine(Protocol):
    """A search for formulas."""

    name: str

    def search(self, inputs: Mapping[str, Floats], target: Floats, seed: int) -> list[Found]:
        """Return a front of formulas for the target (n,), simplest first; inputs are columns (n,) by name."""


class OperonEngine:
    """Operon through pyoperon: fixed generations and seed, so that a run repeats; ``max_length`` counts nodes."""

    name = "operon"

    def __init__(
        self, generations: int = 25, population: int = 300, max_length: int = 40, symbols: str = _OPERON_SYMBOLS
    ) -> None:
        self.generations, self.population, self.max_length = generations, population, max_length
        self.symbols = symbols

    def search(self, inputs: Mapping[str, Floats], target: Floats, seed: int) -> list[Found]:
        """Return the Pareto front over accuracy and length."""
        from pyoperon.sklearn import SymbolicRegressor

        names = list(inputs)
        x = np.column_stack([inputs[name] for name in names])
        search = SymbolicRegressor(
            allowed_symbols=self.symbols,
            objectives=["r2", "length"],
            optimizer_iterations=5,
            max_length=self.max_length,
            max_depth=8,
            population_size=self.population,
            generations=self.generations,
            max_evaluations=10**9,
            n_threads=1,
            random_state=seed,
        )
        search.fit(x, target)
        front = [
            Found(
                search.get_model_string(entry["tree"], 8, names),
                int(entry["complexity"]),
                float(entry.get("mean_squared_error", np.nan)),
            )
            for entry in search.pareto_front_
        ]
        return sorted(front, key=lambda found: found.complexity)


class PySREngine:
    """PySR; needs the package and a Julia on the machine."""

    name = "pysr"

    def __init__(self, iterations: int = 40) -> None:
        self.iterations = iterations

    @staticmethod
    def absent() -> str | None:
        """Return why PySR cannot run here, None when it can.

        The package is not imported for the answer: importing it asks the network for Julia.
        """
        if find_spec("pysr") is None:
            return "the package pysr is not installed: pip install '.[pysr]' in a checkout of dtwin"
        if not (os.environ.get("PYTHON_JULIAPKG_EXE") or shutil.which("julia")):
            return "no Julia on this machine (PYTHON_JULIAPKG_EXE or julia on the PATH)"
        return None

    @classmethod
    def require(cls) -> None:
        """Raise ``MissingPart`` when PySR or Julia is absent."""
        reason = cls.absent()
        if reason is not None:
            raise MissingPart(
                "PySR cannot be used",
                code="pysr.absent",
                got=reason,
                hint="the default engine needs neither: --engine operon",
            )

    def arguments(self, seed: int) -> dict[str, Any]:
        """Return the arguments that PySR is called with."""
        return {
            "niterations": self.iterations,
            "binary_operators": ["+", "-", "*", "/"],
            "unary_operators": ["sin", "cos", "exp", "square"],
            "maxsize": 40,
            "deterministic": True,
            "parallelism": "serial",
            "random_state": seed,
            "progress": False,
            "verbosity": 0,
            "temp_equation_file": True,
        }

    def search(self, inputs: Mapping[str, Floats], target: Floats, seed: int) -> list[Found]:
        """Return PySR's hall of fame. Raises ``MissingPart`` when PySR or Julia is absent."""
        self.require()
        from pysr import PySRRegressor

        model = PySRRegressor(**self.arguments(seed))
        names = list(inputs)
        model.fit(np.column_stack([inputs[n] for n in names]), target, variable_names=names)
        return _read_hall_of_fame(model.equations_)


def _read_hall_of_fame(equations: Any) -> list[Found]:
    """Return the front from PySR's table of equations.

    ``equations``: with the columns ``equation``, ``complexity`` and ``loss``.
    """
    return [Found(str(row["equation"]), int(row["complexity"]), float(row["loss"])) for _, row in equations.iterrows()]


@dataclass(frozen=True)
class FittedFormula:
    """A formula with constants refitted on all rows.

    ``constants``, shape (k,): refitted values.
    ``rms``: error on the rows that it was refitted to.
    """

    formula: Formula
    constants: Floats
    rms: float
    complexity: int


def refit(front: Sequence[Found], inputs: Mapping[str, Floats], target: Floats) -> list[FittedFormula]:
    """Refit the constants of every formula on all rows; drop what is not finite."""
    fitted = []
    for candidate in front:
        try:
            formula, start = parse_formula(candidate.text, list(inputs))
        except InputError:
            continue
        constants = _refitted(formula, start, inputs, target)
        rest = np.broadcast_to(formula.values(inputs, constants), target.shape) - target
        if np.isfinite(rest).all():
            fitted.append(FittedFormula(formula, constants, rms(rest), formula.size))
    return fitted


def _refitted(formula: Formula, start: Floats, inputs: Mapping[str, Floats], target: Floats) -> Floats:
    if not start.size:
        return start

    def residual(constants: Floats) -> Floats:
        rest = np.broadcast_to(formula.values(inputs, constants), target.shape) - target
        # Larger ones would overflow when they are squared and summed.
        return np.clip(np.nan_to_num(rest, nan=1e6), -1e6, 1e6)

    before = float(np.sum(residual(start) ** 2))
    solved = scipy.optimize.least_squares(residual, start, x_scale="jac", max_nfev=30)
    return solved.x if 2.0 * solved.cost <= before else start
