"""Comparison models behind one interface, judged by conditions that were left out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import GradientBoostingRegressor, RandomForestRegressor
from sklearn.linear_model import HuberRegressor, Ridge
from sklearn.neighbors import KNeighborsRegressor
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.tree import DecisionTreeRegressor

from dtwin.schema import Floats
from dtwin.train.inputs import GenericInputs
from dtwin.train.latency import onnx_latency
from dtwin.train.results import Candidate, Scores
from dtwin.train.rows import Rows

FIT_ROWS = 6000
HELD_OUT = ("feed_mm_min", "radius_mm")
Family = Literal["baseline", "linear", "neighbours", "tree", "neural", "symbolic"]


@dataclass(frozen=True)
class Recipe:
    """How to make one comparison model.

    Attributes
    ----------
    name, family : str
        Identity.
    make : callable
        Given a seed, returns an unfitted scikit-learn regressor.
    columns : {"all", "sensor"}
        Inputs that it may use.
    """

    name: str
    family: Family
    make: Callable[[int], Any]
    columns: Literal["all", "sensor"] = "all"


RECIPES: tuple[Recipe, ...] = (
    Recipe("linear", "linear", lambda s: make_pipeline(StandardScaler(), Ridge(1.0))),
    Recipe(
        "robust",
        "linear",
        lambda s: make_pipeline(StandardScaler(), HuberRegressor(max_iter=1000, tol=1e-3)),
    ),
    Recipe(
        "accelerometers-only",
        "linear",
        lambda s: make_pipeline(StandardScaler(), Ridge(1.0)),
        "sensor",
    ),
    Recipe(
        "k-nearest", "neighbours", lambda s: make_pipeline(StandardScaler(), KNeighborsRegressor(5))
    ),
    Recipe(
        "tree",
        "tree",
        lambda s: DecisionTreeRegressor(max_depth=12, min_samples_leaf=5, random_state=s),
    ),
    Recipe(
        "forest",
        "tree",
        lambda s: RandomForestRegressor(
            20, max_depth=14, max_features=0.4, min_samples_leaf=3, random_state=s
        ),
    ),
    Recipe(
        "boosting",
        "tree",
        lambda s: GradientBoostingRegressor(
            n_estimators=50, max_depth=4, subsample=0.5, max_features=0.4, random_state=s
        ),
    ),
    Recipe(
        "neural-net",
        "neural",
        lambda s: make_pipeline(
            StandardScaler(),
            MLPRegressor(
                hidden_layer_sizes=(32, 32), max_iter=60, early_stopping=True, random_state=s
            ),
        ),
    ),
)


def folds(rows: Rows, group: str) -> Iterator[tuple[NDArray[Any], NDArray[Any]]]:
    """Yield (training, held-out) row masks, one group value left out in turn.

    Parameters
    ----------
    rows : Rows
        Rows of a campaign.
    group : str
        A field of the condition, such as ``feed_mm_min``.
    """
    label = rows.label(group)
    for value in np.unique(label):
        yield label != value, label == value


def score(rows: Rows, predicted: Floats, group: str) -> Scores:
    """Judge out-of-group predictions.

    Centre and radius of every set-up are taken out of the remaining error, as they are out of
    the target: no model gains or loses by moving the centre.

    Parameters
    ----------
    rows : Rows
        Rows of a campaign.
    predicted : ndarray, shape (n,)
        Prediction of every row by a model that did not see its group.
    group : str
        What was left out.
    """
    rest = rows.without_setups(rows.target_um - predicted)
    keep = rows.scored
    variance = float(np.mean(rows.target_um[keep] ** 2))
    worst, where = 0.0, ""
    conditions = rows.condition()
    for condition in np.unique(conditions):
        inside = (conditions == condition) & keep
        before = float(np.sqrt(np.mean(rows.target_um[inside] ** 2)))
        ratio = float(np.sqrt(np.mean(rest[inside] ** 2))) / before
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
    """Fit a comparison model with every group left out in turn, then on everything.

    Parameters
    ----------
    rows : Rows
        Rows of a campaign.
    inputs : GenericInputs
        Inputs over the same rows.
    recipe : Recipe
        Which model.
    seed : int
        Seed of the model and of the rows that it is fitted to.
    """
    x = inputs.values if recipe.columns == "all" else inputs.values[:, inputs.sensor]
    scores = {}
    for group in HELD_OUT:
        predicted = np.zeros(rows.n)
        for inside, outside in folds(rows, group):
            predicted[outside] = _fit(recipe, x, rows, inside, seed).predict(x[outside])
        scores[group] = score(rows, predicted, group)
    final = _fit(recipe, x, rows, np.ones(rows.n, dtype=bool), seed)
    rest = rows.without_setups(rows.target_um - final.predict(x))
    onnx, latency = onnx_latency(final, x)
    return Candidate(
        name=recipe.name,
        family=recipe.family,
        promotable=False,
        complexity=_size(final),
        scores=scores,
        train_rms_um=rows.rms_um(rest),
        latency=latency,
        onnx=onnx,
        findings=("not an expression: cannot be promoted",),
    )


def baselines(rows: Rows) -> list[Candidate]:
    """Return zero, constant, first harmonic and look-up on the path position.

    The set-up's centre and radius are taken out of every error, so constant and first
    harmonic can only show what differs between conditions of one set-up.

    Parameters
    ----------
    rows : Rows
        Rows of a campaign.
    """
    angle = rows.angle_rad
    one = np.ones_like(angle)
    harmonic = np.column_stack([one, np.cos(angle), np.sin(angle)])
    makers: Mapping[str, tuple[Callable[[Any, Any], Floats], int]] = {
        "zero": (lambda i, o: np.zeros(rows.n), 0),
        "constant": (lambda i, o: one * rows.target_um[i].mean(), 1),
        "first-harmonic": (lambda i, o: _linear(harmonic, rows.target_um, i), 3),
        "look-up": (lambda i, o: _lookup(rows, i), 72),
    }
    found = []
    for name, (make, size) in makers.items():
        scores = {}
        for group in HELD_OUT:
            predicted = np.zeros(rows.n)
            for inside, outside in folds(rows, group):
                predicted[outside] = make(inside, outside)[outside]
            scores[group] = score(rows, predicted, group)
        everything = np.ones(rows.n, dtype=bool)
        rest = rows.without_setups(rows.target_um - make(everything, everything))
        found.append(Candidate(name, "baseline", False, size, scores, rows.rms_um(rest)))
    return found


def _fit(recipe: Recipe, x: Floats, rows: Rows, inside: NDArray[np.bool_], seed: int) -> Any:
    rng = np.random.default_rng(seed)
    usable = np.flatnonzero(inside & rows.scored)
    chosen = rng.choice(usable, min(FIT_ROWS, usable.size), replace=False)
    model = recipe.make(seed)
    model.fit(x[chosen].astype(np.float32), rows.target_um[chosen])
    return model


def _linear(design: Floats, target: Floats, inside: Floats) -> Floats:
    return np.asarray(design @ np.linalg.lstsq(design[inside], target[inside], rcond=None)[0])


def _lookup(rows: Rows, inside: Floats) -> Floats:
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
    last = model[-1] if hasattr(model, "steps") else model
    if hasattr(last, "estimators_"):
        return int(sum(tree.tree_.node_count for tree in np.ravel(last.estimators_)))
    if hasattr(last, "tree_"):
        return int(last.tree_.node_count)
    if hasattr(last, "coefs_"):
        return int(sum(c.size for c in last.coefs_) + sum(i.size for i in last.intercepts_))
    if hasattr(last, "coef_"):
        return int(last.coef_.size + 1)
    return int(getattr(last, "n_samples_fit_", 0))
