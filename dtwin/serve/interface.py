"""Records of a bundle's interface, and their strict reading."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from dtwin.errors import InputError
from dtwin.serve._fields import number, one_of, only_fields, record, text, whole

_SOURCES = ("path", "controller", "covariate", "feature")
_INPUT_FRAMES = ("none", "path", "joint", "base", "sensor")
OUTPUT_FRAMES = ("path_radial", "path_tangential", "path_normal", "base_x", "base_y", "base_z")
_ROLES = ("error", "correction")
_EVIDENCE = ("none", "virtual", "real")
_MAX_LISTED = 512
_LONGEST_DAYS = 36_500.0


@dataclass(frozen=True)
class Input:
    """One named input.

    ``name``, ``unit``: name and unit; the unit is part of the contract.
    ``frame``: one of ``_INPUT_FRAMES``.
    ``source``: ``feature`` inputs come from the window graph's sensors, the others every tick.
    ``low``, ``high``: validity box: what was seen in training.
    """

    name: str
    unit: str
    frame: str
    rate_hz: float
    source: str
    low: float
    high: float


@dataclass(frozen=True)
class Output:
    """One named output, in um.

    ``frame``: one of ``OUTPUT_FRAMES``.
    ``role``: ``error``, a predicted one, which is applied with its sign changed; or ``correction``, applied as it is.
    ``unit``: always ``um``.
    """

    name: str
    frame: str
    role: str = "error"
    unit: str = "um"


@dataclass(frozen=True)
class State:
    """One number that is remembered from tick to tick."""

    name: str
    unit: str
    initial: float


@dataclass(frozen=True)
class SafetyLimits:
    """What the correction may do whatever the equation says.

    Attributes:
        clamp_um: Largest length of the correction vector.
        slew_um_s: Largest rate of change of the correction vector.
        stale_s, window_stale_s: Age of the controller's state, and of the newest window, beyond which it is released.
        outside: Answer outside the validity box: none, or less the further outside. One of "zero", "shrink".
        shrink_span: Share of the box's width beyond which ``shrink`` has reached zero.
        trips_to_latch: Faults (NaN, stale, outside counts not) after which the output stays at zero until it is armed
            again by an edge.
    """

    clamp_um: float = 100.0
    slew_um_s: float = 2000.0
    stale_s: float = 0.010
    window_stale_s: float = 0.2
    outside: Literal["zero", "shrink"] = "zero"
    shrink_span: float = 0.1
    trips_to_latch: int = 3

    def __post_init__(self) -> None:
        """Refuse limits that would switch a guard off."""
        positive = (
            self.clamp_um,
            self.slew_um_s,
            self.stale_s,
            self.window_stale_s,
            self.shrink_span,
            float(self.trips_to_latch),
        )
        if not all(0 < value < 1e9 for value in positive):
            raise InputError(
                "every safety limit must be positive and finite", code="bundle.safety", got=str(asdict(self))[:200]
            )


@dataclass(frozen=True)
class Provenance:
    """Where a model comes from and what was shown of it.

    ``code_version``, ``mlflow_version``: of this package, and of the registered model.
    ``table_versions``: versions of the lake's tables that it was trained on.
    ``evidence``: of the closed loop: ``none``, ``virtual`` or ``real``.
    ``valid_days``: how long closed-loop evidence holds after it was measured; 0 for ever.
    """

    code_version: str = ""
    mlflow_version: str = ""
    table_versions: Mapping[str, int] = field(default_factory=dict)
    evidence: str = "none"
    gates: Mapping[str, bool] = field(default_factory=dict)
    valid_days: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping; evidence that holds for ever has no term in it."""
        document = asdict(self)
        if not self.valid_days:
            del document["valid_days"]
        return document


@dataclass(frozen=True)
class TestVectors:
    """Inputs over several ticks with the outputs that a slow evaluation gives.

    ``inputs``: tick inputs, one row per tick, in the order of ``Bundle.tick_inputs``.
    ``features``: feature inputs, one row per tick, in the order of ``Bundle.feature_inputs``.
    ``outputs``: outputs, one row per tick.
    ``window_seed``: seed of the made-up window whose features must come out bit for bit.
    ``window_features``: those features, channel by channel; empty without a window contract.
    """

    __test__ = False

    inputs: tuple[tuple[float, ...], ...]
    features: tuple[tuple[float, ...], ...]
    outputs: tuple[tuple[float, ...], ...]
    window_seed: int = 1
    window_features: tuple[float, ...] = ()


def read_input(data: object, where: str) -> Input:
    """Return one declared input."""
    return record(Input, data, where, {"frame": _INPUT_FRAMES, "source": _SOURCES})


def read_output(data: object, where: str) -> Output:
    """Return one declared output."""
    return record(Output, data, where, {"frame": OUTPUT_FRAMES, "role": _ROLES, "unit": ("um",)})


def read_safety(data: object) -> SafetyLimits:
    """Return the safety limits."""
    return record(SafetyLimits, data, "safety", {"outside": ("zero", "shrink")})


def read_provenance(data: object) -> Provenance:
    """Return origin and evidence."""
    given = {"valid_days": 0.0} | mapping(data, "provenance")
    f = only_fields(given, tuple(Provenance.__dataclass_fields__), "provenance")
    gates = mapping(f["gates"], "provenance.gates")
    if not all(isinstance(v, bool) for v in gates.values()):
        raise wrong("a gate's verdict is neither true nor false", str(gates)[:200])
    tables = mapping(f["table_versions"], "provenance.table_versions")
    valid_days = number(f["valid_days"], "provenance.valid_days")
    if not 0.0 <= valid_days <= _LONGEST_DAYS:
        raise wrong("evidence cannot hold for so long", f"{valid_days:g} days")
    return Provenance(
        text(f["code_version"], "code_version"),
        text(f["mlflow_version"], "mlflow_version"),
        {k: whole(v, f"table_versions.{k}") for k, v in tables.items()},
        one_of(f["evidence"], _EVIDENCE, "provenance.evidence"),
        dict(gates),
        valid_days,
    )


def read_vectors(data: object) -> TestVectors:
    """Return the test vectors."""
    f = only_fields(data, tuple(TestVectors.__dataclass_fields__), "vectors")
    rows = {
        name: tuple(
            tuple(number(v, f"vectors.{name}") for v in sequence(row, f"vectors.{name}"))
            for row in sequence(f[name], f"vectors.{name}")
        )
        for name in ("inputs", "features", "outputs")
    }
    features = sequence(f["window_features"], "vectors.window_features", 1_000_000)
    return TestVectors(
        rows["inputs"],
        rows["features"],
        rows["outputs"],
        whole(f["window_seed"], "vectors.window_seed"),
        tuple(number(v, "vectors.window_features") for v in features),
    )


def sequence(data: object, where: str, longest: int = _MAX_LISTED) -> Sequence[Any]:
    """Return a list of bounded length."""
    if not isinstance(data, list) or len(data) > longest:
        raise wrong(f"{where} is not a list of at most {longest}", type(data).__name__)
    return data


def mapping(data: object, where: str) -> dict[str, Any]:
    """Return a mapping of bounded size."""
    if not isinstance(data, dict) or len(data) > _MAX_LISTED:
        raise wrong(f"{where} is not a mapping of at most {_MAX_LISTED}", type(data).__name__)
    return data


def wrong(message: str, got: str) -> InputError:
    """Return the error of an interface that does not fit together."""
    return InputError(message, code="bundle.interface", got=got or None)
