"""The published positioning error of a lathe's Z axis: two small networks, as printed.

Lengths are inches, because the printed weights are; direction is 0 forward, 1 reverse.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.config import published_table
from dtwin.errors import InputError
from dtwin.schema import Floats

PITCH_IN = 0.25
MAPPED_IN = (1.0, 40.0)
MAPPED_MM = (25.4 * MAPPED_IN[0], 25.4 * MAPPED_IN[1])


@dataclass(frozen=True)
class Layer:
    """One hidden layer of logistic neurons with a linear output.

    ``position_weight``, ``forward_bias``, ``reverse_bias``, ``output_weight``, shape (neurons,): of position; biases
    for each direction; of the output.
    """

    position_weight: Floats
    forward_bias: Floats
    reverse_bias: Floats
    output_weight: Floats
    output_bias: float

    def evaluate(self, direction: Floats, position: Floats) -> Floats:
        """Return the output for each (direction, position), shape (n,)."""
        reverse = np.asarray(direction, float)[:, None] >= 0.5
        bias = np.where(reverse, self.reverse_bias, self.forward_bias)
        activation = np.outer(position, self.position_weight) + bias
        return self.output_weight @ (1.0 / (1.0 + np.exp(-activation))).T + self.output_bias


@dataclass(frozen=True)
class LatheNetwork:
    """The printed pair.

    ``full``, ``cyclic``: error over the travel, and over one turn of the screw.
    ``golden``: ``dir``, ``pos_in``, ``full_in``, ``cyclic_in``, ``compensation_in``: what the printed program gives;
    compensation is the error with its sign changed.
    """

    full: Layer
    cyclic: Layer
    golden: tuple[Mapping[str, float], ...]
    source: str

    def error_in(self, direction: Floats, position_in: Floats) -> Floats:
        """Return the positioning error in inches, actual minus commanded, shape (n,).

        ``direction`` (n,): 0 forward, 1 reverse.
        ``position_in`` (n,): inches; the printed remainder is that of C, negative for negative positions.
        """
        position = np.asarray(position_in, float)
        turned = np.fmod(position, PITCH_IN)
        error: Floats = self.full.evaluate(direction, position)
        return error + self.cyclic.evaluate(direction, turned)


def read_network() -> LatheNetwork:
    """Read the printed networks, which travel with the package. Raises ``InputError`` when the file lacks weights."""
    file = published_table("lathe_z_network.json")
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
        weights = document["weights"]
        return LatheNetwork(
            full=_layer(weights, "Full"),
            cyclic=_layer(weights, "cyclic"),
            golden=tuple(document["golden"]),
            source=str(document["source"]),
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            "the network cannot be read", code="network.file", where=str(file), got=repr(error)[:120]
        ) from error


def _layer(weights: Mapping[str, Any], name: str) -> Layer:
    position, forward, reverse, out = (
        np.array(weights[f"{name}{part}"], dtype=float) for part in ("IW2", "Bias1", "IW_B1", "LW")
    )
    if len({v.shape for v in (position, forward, reverse, out)}) != 1 or position.ndim != 1:
        raise ValueError(f"the layers of {name} have different lengths")
    return Layer(position, forward, reverse, out, float(weights[f"{name}Bias2"]))
