"""Comparison models behind one interface, judged by conditions that were left out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import ExtraTreesRegressor, GradientBoostingRegressor
from sklearn.linear_model import HuberRegressor, RidgeCV
from sklearn.model_selection import GroupKFold
from sklearn.neighbors import KNeighborsRegressor
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import MinMaxScaler, StandardScaler
from sklearn.tree import DecisionTreeRegressor

from dtwin.schema import Floats
from dtwin.statistics import rms
from dtwin.train.campaign_rows import Rows
from dtwin.train.inputs import GenericInputs
from dtwin.train.latency import onnx_of
from dtwin.train.results import Candidate, Scores

_FIT_ROWS = 6000
# Share of an input's size below which its spread is that of rounding and of numerical derivatives.
_ROUNDING = 1e-4
_HELD_OUT = ("feed_mm_min", "radius_mm")
_PENALTIES = np.logspace(0.0, 5.0, 6)
_SPLITS = 4
_Splits = list[tuple[NDArray[Any], NDArray[Any]]]
_Family = Literal["baseline", "linear", "neighbours", "tree", "neural", "symbolic"]


@dataclass(frozen=True)
class Recipe:
    """How to make one comparison model.

    ``make``: given a seed and splits of the rows by which a penalty can be chosen, returns an unfitted scikit-learn
    regressor.
    ``columns``: inputs that it may use.
    """

    name: str
    family: _Family
    make: Callable[[int, _Splits], Any]
    columns: Literal["all", "sensor"] = "all"


# The slowest first: they are fitted side by side, and none should be left alone at the end.
RECIPES: tuple[Recipe, ...] = (
    Recipe(
        "neural-net",
        "neural",
        lambda s, splits: MLPRegressor(hidden_layer_sizes=(32, 32), max_iter=60, early_stopping=True, random_state=s),
    ),
    Recipe(
        "boosting",
        "tree",
        lambda s, splits: GradientBoostingRegressor(
            n_estimators=50, max_depth=4, subsample=0.5, max_features=0.2, random_state=s
        ),
    ),
    # As good as a random forest here, at a third of its time: thresholds are drawn, not searched for.
    Recipe(
        "extra-trees",
        "tree",
        lambda s, splits: ExtraTreesRegressor(20, max_depth=14, max_features=0.7, min_samples_leaf=3, random_state=s),
    ),
    Recipe("robust", "linear", lambda s, splits: HuberRegressor(alpha=1.0, max_iter=1000, tol=1e-3)),
    Recipe("k-nearest", "neighbours", lambda s, splits: KNeighborsRegressor(5)),
    Recipe("tree", "tree", lambda s, splits: DecisionTreeRegressor(max_depth=12, min_samples_leaf=5, random_state=s)),
    Recipe("linear", "linear", lambda s, splits: RidgeCV(_PENALTIES, cv=splits)),
    Recipe("accelerometers-only", "linear", lambda s, splits: RidgeCV(_PENALTIES, cv=splits), "sensor"),
)


@dataclass(frozen=True)
class _Regressor:
    """A fitted comparison model with what is done to its inputs.

    ``model``: clips inputs to the range that it was fitted on, scales them, predicts.
    ``used``, (k,): inputs that varied beyond rounding where it was fitted; the others are left out.
    """

    model: Pipeline
    used: NDArray[np.bool_]

    def predict(self, x: Floats) -> Floats:
        """Return the prediction for rows of inputs (n, k), shape (n,)."""
        return np.asarray(self.model.predict(x[:, self.used].astype(np.float32)), dtype=float)


def fitted(recipe: Recipe, seed: int, x: Floats, target: Floats, size: Floats, group: NDArray[np.int64]) -> _Regressor:
    """Fit a comparison model.

    ``x``, ``target``, shapes (n, k) and (n,): rows to fit to.
    ``size``, shape (k,): largest size of each input: spreads below a ten-thousandth of it are rounding.
    ``group``, shape (n,): what a row belongs to, such as its condition: the penalty is chosen by groups left out.
    """
    used = np.std(x, axis=0) > _ROUNDING * size
    parts = min(_SPLITS, np.unique(group).size)
    splits = list(GroupKFold(parts).split(x, groups=group))
    model = make_pipeline(MinMaxScaler(clip=True), StandardScaler(), recipe.make(seed, splits))
    return _Regressor(model.fit(x[:, used].astype(np.float32), target), used)


def held_out_groups(rows: Rows) -> list[str]:
    """Return the fields of ``_HELD_OUT`` that have at least two values: one cannot be left out."""
    return [group for group in _HELD_OUT if np.unique(rows.label(group)).size > 1]


def score(rows: Rows, predicted: Floats, group: str) -> Scores:
    """Judge predictions of every row, shape (n,), by models that did not see its group.

    Centre and radius of every set-up are taken out of the remaining error, as they are out of
    the target: no model gains or loses by moving the centre.
    """
    rest = rows.without_setups(rows.target_um - predicted)
    keep = rows.scored
    variance = float(np.mean(rows.target_um[keep] ** 2))
    worst, where = 0.0, ""
    conditions = rows.condition()
    for condition in np.unique(conditions):
        inside = (conditions == condition) & keep
        ratio = rms(rest[inside]) / rms(rows.target_um[inside])
        if ratio > worst:
            meta = rows.runs[int(rows.of_run[inside][0])].meta
            worst = ratio
            where = f"{meta.plane} R{meta.radius_mm:g} F{meta.feed_mm_min:g} {meta.direction}"
    return Scores(
        group=group,
        r2=1.0 - float(np.mean(rest[keep] ** 2)) / variance,
        rms_um=rows.rms_um(rest),
        mae_um=float(np.mean(np.abs(rest[keep]))),
        worst_slice_ratio=worst,
        worst_slice=where,
        n_groups=len(np.unique(rows.label(group))),
        n_runs=len(rows.runs),
    )


def train_recipe(rows: Rows, inputs: GenericInputs, recipe: Recipe, seed: int) -> Candidate:
    """Fit a comparison model with every group left out in turn, then on everything; it is not timed.

    ``seed``: seed of the model and of the rows that it is fitted to.
    """
    x = inputs.values if recipe.columns == "all" else inputs.values[:, inputs.sensor]
    scores = {}
    for group in held_out_groups(rows):
        predicted = np.zeros(rows.n)
        for inside, outside in rows.folds(group):
            predicted[outside] = _fit(recipe, x, rows.blind(inside), inside, seed).predict(x[outside])
        scores[group] = score(rows, predicted, group)
    final = _fit(recipe, x, rows, np.ones(rows.n, dtype=bool), seed)
    rest = rows.without_setups(rows.target_um - final.predict(x))
    return Candidate(
        name=recipe.name,
        family=recipe.family,
        promotable=False,
        complexity=_size(final.model[-1]),
        scores=scores,
        train_rms_um=rows.rms_um(rest),
        onnx=onnx_of(final.model, int(np.count_nonzero(final.used))),
        findings=("not an expression: cannot be promoted",),
    )


def baselines(rows: Rows) -> list[Candidate]:
    """Return zero, constant, first harmonic and look-up on the path position.

    The set-up's centre and radius are taken out of every error, so constant and first
    harmonic can only show what differs between conditions of one set-up.
    """
    angle = rows.angle_rad
    one = np.ones_like(angle)
    harmonic = np.column_stack([one, np.cos(angle), np.sin(angle)])
    makers: Mapping[str, tuple[Callable[[Rows, NDArray[np.bool_]], Floats], int]] = {
        "zero": (lambda r, i: np.zeros(r.n), 0),
        "constant": (lambda r, i: one * r.target_um[i].mean(), 1),
        "first-harmonic": (lambda r, i: _linear(harmonic, r.target_um, i), 3),
        "look-up": (_lookup, 72),
    }
    candidates = []
    for name, (make, size) in makers.items():
        scores = {}
        for group in held_out_groups(rows):
            predicted = np.zeros(rows.n)
            for inside, outside in rows.folds(group):
                predicted[outside] = make(rows.blind(inside), inside)[outside]
            scores[group] = score(rows, predicted, group)
        everything = np.ones(rows.n, dtype=bool)
        rest = rows.without_setups(rows.target_um - make(rows, everything))
        candidates.append(Candidate(name, "baseline", False, size, scores, rows.rms_um(rest)))
    return candidates


def _fit(recipe: Recipe, x: Floats, rows: Rows, inside: NDArray[np.bool_], seed: int) -> _Regressor:
    rng = np.random.default_rng(seed)
    usable = np.flatnonzero(inside & rows.scored)
    chosen = rng.choice(usable, min(_FIT_ROWS, usable.size), replace=False)
    size = np.abs(x[inside]).max(axis=0)
    # Its repeats would foretell a run that is left out, and the penalty would come out too small.
    group = rows.condition()[chosen]
    if np.unique(group).size == 1:
        group = rows.of_run[chosen]
    return fitted(recipe, seed, x[chosen], rows.target_um[chosen], size, group)


def _linear(design: Floats, target: Floats, inside: NDArray[np.bool_]) -> Floats:
    return np.asarray(design @ np.linalg.lstsq(design[inside], target[inside], rcond=None)[0])


def _lookup(rows: Rows, inside: NDArray[np.bool_]) -> Floats:
    """Return the mean error by plane, direction and five-degree bin of the path angle."""
    planes, directions = rows.label("plane"), rows.label("direction")
    bins = (np.degrees(rows.angle_rad) % 360.0 // 5.0).astype(int)
    predicted = np.zeros(rows.n)
    for plane in np.unique(planes):
        for direction in np.unique(directions):
            here = (planes == plane) & (directions == direction)
            train = here & inside
            count = np.bincount(bins[train], minlength=72)
            sums = np.bincount(bins[train], weights=rows.target_um[train], minlength=72)
            predicted[here] = (sums / np.maximum(count, 1))[bins[here]]
    return predicted


def _size(model: Any) -> int:
    """Return the number of fitted numbers or nodes of a model."""
    if hasattr(model, "estimators_"):
        return int(sum(tree.tree_.node_count for tree in np.ravel(model.estimators_)))
    if hasattr(model, "tree_"):
        return int(model.tree_.node_count)
    if hasattr(model, "coefs_"):
        return int(sum(c.size for c in model.coefs_) + sum(i.size for i in model.intercepts_))
    if hasattr(model, "coef_"):
        return int(model.coef_.size + 1)
    return int(getattr(model, "n_samples_fit_", 0))
