"""How large a hidden effect must be to be seen k times above the noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from causes import Cause

from dtwin.machines.mill import Disturbance, Moment, SetupErrors, VirtualMill
from dtwin.machines.mill_parameters import CircularTest, MillParameters, NoiseParameters
from dtwin.schema import Floats

Sized = tuple[Cause, float]
_LARGEST = 1000.0
_NEAR = 0.02
_ROUNDS = 5
_QUIET = NoiseParameters(rms_um=0.0)
_STEADY = SetupErrors(jitter_us=0.0, trigger_samples=0.0)


@dataclass(frozen=True)
class Bench:
    """A session and its seed, measured without noise."""

    tests: Sequence[CircularTest]
    seed: int

    def response(self, mill: MillParameters, extra: Sequence[Disturbance] = ()) -> Floats:
        """Return what the bar would show, by degree: shape (tests, 360)."""
        made = VirtualMill(mill, self.seed, _QUIET, _STEADY, sum_of(extra)).measure(self.tests)
        return np.array([r.samples["deviation_um"].reshape(360, -1).mean(axis=1) for r in made])

    def size_of(self, cause: Cause, mill: MillParameters, hides: Floats, wanted_um: float) -> float:
        """Return the size whose visible part has an RMS of ``wanted_um``.

        Args:
            cause: What is hidden.
            mill: The machine without it.
            hides: Orthonormal columns of set-up and known effects. Shape (tests * 360, k).
            wanted_um: Wanted RMS.
        """
        without = self.response(mill)
        size = cause.start
        for _ in range(_ROUNDS):
            seen = (self.response(cause.change(mill, size), acting(cause, size)) - without).ravel()
            reached = float(np.sqrt(((seen - hides @ (hides.T @ seen)) ** 2).mean()))
            if abs(reached / wanted_um - 1.0) < _NEAR:
                break
            size *= wanted_um / max(reached, 1e-9)
            if size > _LARGEST * cause.start:
                raise ValueError(f"{cause.label} cannot be seen in this design")
        return size

    def hiding(self, base: Sequence[Sized], ideal: MillParameters) -> Floats:
        """Return orthonormal columns of centre and radius by set-up and of the base effects."""
        nothing = self.response(ideal)
        columns = [self._along(c) for c in self._setup_columns()]
        columns += [self.response(c.change(ideal, s)) - nothing for c, s in base]
        return np.linalg.qr(np.stack([c.ravel() for c in columns], axis=1))[0]

    def _setup_columns(self) -> list[Floats]:
        angle = np.radians(np.arange(360) + 0.5)
        shapes = np.stack([np.ones(360), np.cos(angle), np.sin(angle)])
        out = []
        for name in sorted({t.setup for t in self.tests}):
            here = np.array([t.setup == name for t in self.tests], dtype=float)
            out += [np.outer(here, shape) for shape in shapes]
        return out

    def _along(self, values: Floats) -> Floats:
        """Return columns in the order of samples: clockwise ones begin at 360 degrees."""
        ways = [test.direction for test in self.tests]
        return np.array([v if way == "CCW" else v[::-1] for v, way in zip(values, ways, strict=True)])


def acting(cause: Cause, size: float) -> list[Disturbance]:
    """Return what a cause adds to the length besides its mechanism."""
    return [cause.disturbance(size)] if cause.disturbance else []


def sum_of(parts: Sequence[Disturbance]) -> Disturbance | None:
    """Return several disturbances as one."""
    if not parts:
        return None

    def act(moment: Moment) -> Floats:
        return np.sum([part(moment) for part in parts], axis=0)

    return act
