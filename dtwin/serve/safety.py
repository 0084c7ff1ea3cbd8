"""The guard between an equation and a machine."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dtwin.features.compiled import compiled
from dtwin.schema import Floats
from dtwin.serve.interface import SafetyLimits

(
    OK,
    DISABLED,
    NOT_FINITE,
    STALE,
    STALE_WINDOW,
    OUTSIDE,
    SHRUNK,
    CLAMPED,
    SLEWED,
    LATCHED,
    DEVICE,
    STALLED,
    IMPOSSIBLE,
    JUMPED,
    ENGAGING,
) = range(15)
REASONS: tuple[str, ...] = (
    "ok",
    "disabled",
    "not_finite",
    "stale",
    "stale_window",
    "outside_box",
    "shrunk",
    "clamped",
    "slew_limited",
    "latched",
    "device_stopped",
    "stalled",
    "impossible_state",
    "clock_jump",
    "engaging",
)
"""Why the guard acts. ``stalled``: the loop itself was away for too long; ``impossible_state``,
``clock_jump``: what came is no state of a machine, or its stamps do not go on; ``engaging``: nothing of
ours is in force yet, or no more, and zeros are sent until it is."""

_LONGEST_STEP_S = 0.02
_CLAMP, _SLEW, _STALE, _STALE_WINDOW, _TRIPS = range(5)
_ARMED, _LATCH, _COUNT, _FAULT = range(4)


@compiled
def box_factor(inputs: Floats, low: Floats, high: Floats, span: float) -> float:
    """Return how far a model may be trusted at its inputs.

    Args:
        inputs: Inputs. Shape (n,).
        low: Lower limits of their validity box. Shape (n,).
        high: Upper limits. Shape (n,).
        span: 0: nothing outside the box; else the share of the box's width over which trust falls to nothing.

    Returns:
        1 inside, between 0 and 1 near it, 0 far outside, -1 when an input is not finite.
    """
    factor = 1.0
    for i in range(inputs.shape[0]):
        x = inputs[i]
        if not abs(x) < 1e300:
            return -1.0
        beyond = max(low[i] - x, x - high[i])
        if beyond > 0.0:
            width = span * (high[i] - low[i])
            factor = min(factor, 1.0 - beyond / width) if width > 0.0 else 0.0
    return max(factor, 0.0)


@compiled
def _scaled(vector: Floats, longest: float) -> bool:
    """Shorten a vector in place to at most ``longest``; tell whether that was needed."""
    biggest = max(max(abs(vector[0]), abs(vector[1])), abs(vector[2]))
    if biggest == 0.0:
        return False
    square = 0.0
    for i in range(3):
        square += (vector[i] / biggest) ** 2
    length = biggest * np.sqrt(square)
    if length <= longest:
        return False
    # Divided first: the length may exceed what its reciprocal can bear.
    for i in range(3):
        vector[i] = vector[i] / biggest / np.sqrt(square) * longest * (1.0 - 1e-15)
    return True


@compiled
def _guard_kernel(
    wanted_um: Floats,
    factor: float,
    age_s: float,
    window_age_s: float,
    elapsed_s: float,
    enabled: bool,
    found: int,
    limits: Floats,
    memory: Floats,
    out_um: Floats,
) -> int:
    """Turn a wanted correction into one that is safe to send.

    Args:
        wanted_um: What the equation asks for. Shape (3,).
        factor: From ``box_factor``.
        age_s: Age of the controller's state.
        window_age_s: Age of the newest window; 0 when none is used.
        elapsed_s: Time since the last call; counted as at most 20 ms, so that a stall earns no jump.
        enabled: Its rising edge arms and clears a latch; false releases.
        found: What the caller has found: OK, or DEVICE, STALLED, IMPOSSIBLE, JUMPED, ENGAGING.
        limits: Clamp, slew, the two ages, trips to latch. Shape (5,).
        memory: Armed, latched, trips, fault present. Overwritten. Shape (4,).
        out_um: The correction that was sent last; overwritten by the next one. Shape (3,).

    Returns:
        Position in ``REASONS`` of the strongest reason that acted.
    """
    reason = OK
    finite = factor >= 0.0
    for i in range(3):
        finite = finite and abs(wanted_um[i]) < 1e300
    if found != OK and found != ENGAGING:
        reason = found
    elif not (age_s >= 0.0 and age_s <= limits[_STALE]):
        reason = STALE
    elif not (window_age_s >= 0.0 and window_age_s <= limits[_STALE_WINDOW]):
        reason = STALE_WINDOW
    elif not finite:
        reason = NOT_FINITE
    elif found == ENGAGING:
        reason = ENGAGING
    # A machine that stands still, or does not take corrections yet, costs no trip; nor does a stall,
    # which is over when it is seen.
    fault = reason != OK and reason != DEVICE and reason != ENGAGING and reason != STALLED
    if enabled and memory[_ARMED] == 0.0:
        memory[_LATCH] = memory[_COUNT] = memory[_FAULT] = 0.0
    memory[_ARMED] = 1.0 if enabled else 0.0
    if enabled and fault and memory[_FAULT] == 0.0:
        memory[_COUNT] += 1.0
        if memory[_COUNT] >= limits[_TRIPS]:
            memory[_LATCH] = 1.0
    memory[_FAULT] = 1.0 if fault else 0.0
    if memory[_LATCH] != 0.0 and not fault:
        reason = LATCHED
    if not enabled:
        reason = DISABLED
    elif reason == OK and factor == 0.0:
        reason = OUTSIDE
    target = np.zeros(3)
    if reason == OK:
        if factor < 1.0:
            reason = SHRUNK
        for i in range(3):
            target[i] = wanted_um[i] * factor
        if _scaled(target, limits[_CLAMP]):
            reason = CLAMPED
    step_s = elapsed_s if 0.0 <= elapsed_s <= _LONGEST_STEP_S else 0.0
    if elapsed_s > _LONGEST_STEP_S:
        step_s = _LONGEST_STEP_S
    change = target - out_um
    if _scaled(change, limits[_SLEW] * step_s):
        if reason == OK:
            reason = SLEWED
        for i in range(3):
            out_um[i] += change[i]
    else:
        for i in range(3):
            out_um[i] = target[i]
    _scaled(out_um, limits[_CLAMP])
    return reason


@compiled
def _guard_many(
    wanted_um: Floats,
    inputs: Floats,
    low: Floats,
    high: Floats,
    span: float,
    elapsed_s: float,
    limits: Floats,
    memory: Floats,
    out_um: Floats,
    sent_um: Floats,
    counts: NDArray[np.int64],
) -> int:
    """Guard successive ticks into ``sent_um``; return the last reason."""
    reason = DISABLED
    for tick in range(wanted_um.shape[0]):
        factor = box_factor(inputs[tick], low, high, span)
        reason = _guard_kernel(wanted_um[tick], factor, 0.0, 0.0, elapsed_s, True, OK, limits, memory, out_um)
        counts[reason] += 1
        sent_um[tick] = out_um
    return reason


class Guard:
    """Safety of one served model.

    Args:
        limits: Clamp, slew, ages, answer outside the box.
        low: Lower limits of the validity box. Shape (n,).
        high: Upper limits. Shape (n,).
    """

    def __init__(self, limits: SafetyLimits, low: Floats, high: Floats) -> None:
        self.limits = limits
        self._low = np.ascontiguousarray(low, dtype=np.float64)
        self._high = np.ascontiguousarray(high, dtype=np.float64)
        self._span = limits.shrink_span if limits.outside == "shrink" else 0.0
        self._limits = np.array(
            [limits.clamp_um, limits.slew_um_s, limits.stale_s, limits.window_stale_s, limits.trips_to_latch]
        )
        self._memory = np.zeros(4)
        self.out_um = np.zeros(3)
        self.counts: NDArray[np.int64] = np.zeros(len(REASONS), dtype=np.int64)
        self.reason = DISABLED

    @property
    def latched(self) -> bool:
        """Whether only a new rising edge of ``enabled`` can bring a correction back."""
        return bool(self._memory[_LATCH])

    @property
    def trips(self) -> int:
        """Faults since the guard was armed."""
        return int(self._memory[_COUNT])

    @property
    def at_rest(self) -> bool:
        """Whether the correction is exactly zero."""
        return not self.out_um.any()

    def reset(self) -> None:
        """Disarm, and forget output, trips and counts; only while nothing is being sent."""
        self._memory[:] = 0.0
        self.out_um[:] = 0.0
        self.counts[:] = 0
        self.reason = DISABLED

    def trust(self, inputs: Floats) -> float:
        """Return how far the model may be trusted at its inputs, as ``box_factor``."""
        return float(box_factor(inputs, self._low, self._high, self._span))

    def step(
        self,
        wanted_um: Floats,
        inputs: Floats,
        *,
        age_s: float,
        elapsed_s: float,
        window_age_s: float = 0.0,
        enabled: bool = True,
        device_ok: bool = True,
        found: int = OK,
    ) -> Floats:
        """Return the correction (3,) in um that may be sent; the next call overwrites it.

        Args:
            wanted_um: What the equation asks for. Shape (3,).
            inputs: Inputs of the equation, for the validity box. Shape (n,).
            age_s: Age of the controller's state.
            window_age_s: Age of the newest window; 0 when none is used.
            enabled: Whether a correction is wanted.
            device_ok: Whether the machine runs.
            found: As for ``_guard_kernel``; a machine that does not run comes first.
        """
        self.reason = _guard_kernel(
            wanted_um,
            self.trust(inputs),
            age_s,
            window_age_s,
            elapsed_s,
            enabled,
            found if device_ok else DEVICE,
            self._limits,
            self._memory,
            self.out_um,
        )
        self.counts[self.reason] += 1
        return self.out_um

    def run(self, wanted_um: Floats, inputs: Floats, *, elapsed_s: float) -> Floats:
        """Return the corrections of successive ticks of fresh states, shape (n, 3).

        Args:
            wanted_um: What the equation asks for. Shape (n, 3).
            inputs: Inputs of the equation, for the validity box. Shape (n, k).
        """
        sent = np.empty(wanted_um.shape)
        self.reason = _guard_many(
            np.ascontiguousarray(wanted_um),
            np.ascontiguousarray(inputs),
            self._low,
            self._high,
            self._span,
            elapsed_s,
            self._limits,
            self._memory,
            self.out_um,
            sent,
            self.counts,
        )
        return sent

    def counted(self) -> dict[str, int]:
        """Return how often each reason acted."""
        return {name: int(n) for name, n in zip(REASONS, self.counts, strict=True) if n}
