"""Bundle: a model frozen for serving, with units, frames, limits, evidence and test vectors."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from dtwin.errors import InputError
from dtwin.features.windows import WindowContract
from dtwin.schema import Floats, require_name
from dtwin.serve._fields import only_fields, record, text, whole
from dtwin.serve.band import Band, read_band
from dtwin.serve.graph import Graph
from dtwin.serve.interface import (
    Input,
    Output,
    Provenance,
    SafetyLimits,
    State,
    TestVectors,
    mapping,
    read_input,
    read_output,
    read_provenance,
    read_safety,
    read_vectors,
    sequence,
    wrong,
)

_FORMAT = "dtwin-bundle"
_VERSION = 1
_SLOWEST_HZ, _FASTEST_HZ = 1e-4, 1e6


@dataclass(frozen=True)
class Bundle:
    """Everything that serving needs; one JSON file.

    Attributes:
        window: How feature inputs are made.
        window_graph: From feature inputs to intermediate values, evaluated per hop and held.
        tick_graph: From tick inputs, intermediate values and feature inputs to outputs, every tick.
        corrects: Kind of campaign that it was made of; empty in older bundles.
        band: How uncertain the outputs are; None where nobody knows, as in older bundles.
    """

    name: str
    machine: str
    model_version: int
    created: str
    inputs: tuple[Input, ...]
    outputs: tuple[Output, ...]
    states: tuple[State, ...]
    window: WindowContract | None
    window_graph: Graph | None
    tick_graph: Graph
    safety: SafetyLimits
    provenance: Provenance
    vectors: TestVectors
    corrects: str = ""
    band: Band | None = None

    def __post_init__(self) -> None:
        """Refuse an interface that does not fit together."""
        require_name(self.name, "the bundle's name")
        require_name(self.machine, "the bundle's machine")
        if self.corrects:
            require_name(self.corrects, "what the bundle corrects")
        self._check_interface()
        self._check_window()
        if self.band is not None:
            self.band.check([*(i.name for i in self.inputs), *self.intermediates], [o.name for o in self.outputs])

    @property
    def tick_inputs(self) -> tuple[str, ...]:
        """Inputs that are renewed every tick, in the order of the tick's input vector."""
        return tuple(i.name for i in self.inputs if i.source != "feature")

    @property
    def feature_inputs(self) -> tuple[str, ...]:
        """Inputs that come from sensor windows, in the order of the feature vector."""
        return tuple(i.name for i in self.inputs if i.source == "feature")

    @property
    def box(self) -> tuple[Floats, Floats]:
        """Lowest and highest value of each input for which the model holds, in their order, shapes (n,)."""
        return np.array([i.low for i in self.inputs]), np.array([i.high for i in self.inputs])

    @property
    def intermediates(self) -> tuple[str, ...]:
        """Outputs of the window graph, held between hops."""
        return tuple(self.window_graph.outputs) if self.window_graph else ()

    @property
    def initial_state(self) -> dict[str, float]:
        """State before the first tick."""
        return {s.name: s.initial for s in self.states}

    def _check_interface(self) -> None:
        names = [i.name for i in self.inputs] + list(self.intermediates)
        for what, got in (
            ("input", names),
            ("output", [o.name for o in self.outputs]),
            ("state", [s.name for s in self.states]),
            ("output frame", [o.frame for o in self.outputs]),
        ):
            if len(set(got)) != len(got):
                raise wrong(f"an {what} is declared twice", ", ".join(got)[:200])
        if not self.outputs or set(self.tick_graph.outputs) != {o.name for o in self.outputs}:
            raise wrong("the outputs are not those of the graph", str(list(self.tick_graph.outputs)))
        unknown = set(self.tick_graph.inputs) - set(names)
        unknown |= set(self.tick_graph.states) - set(self.initial_state)
        if self.window_graph is not None:
            unknown |= set(self.window_graph.inputs) - set(self.feature_inputs)
            unknown |= set(self.window_graph.states)
        if unknown:
            raise wrong("a graph uses what is not declared", ", ".join(sorted(unknown))[:200])
        for item in self.inputs:
            if not item.low <= item.high:
                raise wrong(f"the validity box of {item.name} is empty", f"{item.low} to {item.high}")
            # A value counts for three periods: at a rate of nearly nothing an old one would count for ever.
            if not _SLOWEST_HZ <= item.rate_hz <= _FASTEST_HZ:
                raise wrong(f"the rate of {item.name} is none that a value comes at", f"{item.rate_hz} Hz")

    def _check_window(self) -> None:
        if self.window is None:
            if self.feature_inputs or self.window_graph is not None:
                raise wrong("feature inputs without a window contract", str(self.feature_inputs)[:200])
            return
        unknown = set(self.feature_inputs) - set(self.window.columns)
        if unknown:
            raise wrong("a feature is not in the window contract", ", ".join(sorted(unknown))[:200])

    def body(self) -> dict[str, Any]:
        """Return the JSON-ready content without the checksum."""
        # Left away where it is not known, so that the checksum of an older bundle still holds.
        told: dict[str, Any] = {"corrects": self.corrects} if self.corrects else {}
        told |= {"band": self.band.as_dict()} if self.band else {}
        return told | {
            "format": _FORMAT,
            "version": _VERSION,
            "name": self.name,
            "machine": self.machine,
            "model_version": self.model_version,
            "created": self.created,
            "inputs": [asdict(i) for i in self.inputs],
            "outputs": [asdict(o) for o in self.outputs],
            "states": [asdict(s) for s in self.states],
            "window": self.window.to_dict() if self.window else None,
            "window_graph": self.window_graph.to_dict() if self.window_graph else None,
            "tick_graph": self.tick_graph.to_dict(),
            "safety": asdict(self.safety),
            "provenance": self.provenance.as_dict(),
            "vectors": _listed(asdict(self.vectors)),
        }

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON-ready content with the checksum over it."""
        body = self.body()
        return body | {"sha256": _checksum(body)}

    @property
    def sha256(self) -> str:
        """Checksum of the content."""
        return _checksum(self.body())

    @property
    def model_sha256(self) -> str:
        """Checksum of what moves the machine: the content without version and provenance.

        It stays the same when a version is put on trial and when it is promoted.
        """
        body = self.body()
        return _checksum({name: body[name] for name in body if name not in _OF_THE_VERSION})

    @classmethod
    def from_dict(cls, data: object) -> Bundle:
        """Return the bundle that ``to_dict`` described, checked field by field.

        Raises ``InputError`` when it is no bundle, was changed, or holds what cannot be served.
        """
        if not isinstance(data, dict) or data.get("format") != _FORMAT:
            raise InputError("not a bundle", code="bundle.format", allowed=f'"format": "{_FORMAT}"')
        if data.get("version") != _VERSION:
            raise InputError(
                "a bundle of another version",
                code="bundle.version",
                where=f"machine {data.get('machine')}, version {data.get('model_version')}"[:200],
                got=repr(data.get("version"))[:40],
                allowed=str(_VERSION),
                hint="install the dtwin that wrote it, or a newer one; or train and promote again with this one",
            )
        told = tuple(name for name in ("corrects", "band") if name in data)
        fields = only_fields(data, (*_BODY_FIELDS, *told, "sha256"), "bundle")
        body = {k: v for k, v in fields.items() if k != "sha256"}
        if fields["sha256"] != _checksum(body):
            raise InputError(
                "the bundle was changed after it was written",
                code="bundle.checksum",
                got=str(fields["sha256"])[:64],
                hint="promote the model again; do not edit a bundle",
            )
        return cls(
            name=text(body["name"], "name"),
            machine=text(body["machine"], "machine"),
            model_version=whole(body["model_version"], "model_version"),
            created=text(body["created"], "created"),
            inputs=tuple(read_input(v, f"inputs[{i}]") for i, v in enumerate(sequence(body["inputs"], "inputs"))),
            outputs=tuple(read_output(v, f"outputs[{i}]") for i, v in enumerate(sequence(body["outputs"], "outputs"))),
            states=tuple(record(State, v, f"states[{i}]") for i, v in enumerate(sequence(body["states"], "states"))),
            window=None if body["window"] is None else WindowContract.from_dict(mapping(body["window"], "window")),
            window_graph=None
            if body["window_graph"] is None
            else Graph.from_dict(body["window_graph"], "window_graph"),
            tick_graph=Graph.from_dict(body["tick_graph"], "tick_graph"),
            safety=read_safety(body["safety"]),
            provenance=read_provenance(body["provenance"]),
            vectors=read_vectors(body["vectors"]),
            corrects=text(body["corrects"], "corrects") if "corrects" in told else "",
            band=read_band(body["band"]) if "band" in told else None,
        )


_BODY_FIELDS = (
    "format",
    "version",
    "name",
    "machine",
    "model_version",
    "created",
    "inputs",
    "outputs",
    "states",
    "window",
    "window_graph",
    "tick_graph",
    "safety",
    "provenance",
    "vectors",
)


_OF_THE_VERSION = ("model_version", "provenance")


def _checksum(body: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the canonical JSON of a bundle's content."""
    try:
        plain = json.dumps(body, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except ValueError as error:
        raise InputError(
            "a bundle must not hold NaN or infinity", code="bundle.finite", got=str(error)[:120]
        ) from error
    return hashlib.sha256(plain.encode()).hexdigest()


def _listed(plain: Any) -> Any:
    """Return nested tuples as lists, as JSON would give them back."""
    if isinstance(plain, dict):
        return {k: _listed(v) for k, v in plain.items()}
    return [_listed(v) for v in plain] if isinstance(plain, list | tuple) else plain
