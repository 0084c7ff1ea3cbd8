"""What the guard guarantees whatever it is given."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from dtwin.serve.interface import SafetyLimits
from dtwin.serve.safety import Guard

anything = st.floats(allow_nan=True, allow_infinity=True, width=64)
sizes = st.floats(-500, 500)
wanted = st.tuples(*[st.one_of(sizes, anything)] * 3)
ticks = st.lists(
    st.tuples(
        wanted,
        st.one_of(st.floats(-3, 3), anything),
        st.one_of(st.floats(0, 0.02), anything),
        st.one_of(st.floats(0, 0.05), anything),
        st.booleans(),
        st.booleans(),
    ),
    min_size=1,
    max_size=40,
)
limits = st.builds(
    SafetyLimits,
    clamp_um=st.floats(0.1, 300),
    slew_um_s=st.floats(1, 1e6),
    stale_s=st.just(0.01),
    window_stale_s=st.just(0.2),
    outside=st.sampled_from(["zero", "shrink"]),
    shrink_span=st.floats(0.01, 1),
    trips_to_latch=st.integers(1, 4),
)


@settings(deadline=None, max_examples=200)
@given(limits, ticks)
def test_always_finite_within_clamp_and_slew(limit: SafetyLimits, script: list) -> None:
    guard = Guard(limit, np.array([-1.0]), np.array([1.0]))
    for want, x, age_s, elapsed_s, enabled, device_ok in script:
        before = guard.out_um.copy()
        out = guard.step(
            np.array(want), np.array([x]), age_s=age_s, elapsed_s=elapsed_s, enabled=enabled, device_ok=device_ok
        )
        counted_s = min(elapsed_s, 0.02) if elapsed_s >= 0 else 0.0
        assert np.isfinite(out).all()
        assert np.linalg.norm(out) <= limit.clamp_um * (1 + 1e-12)
        allowed = limit.slew_um_s * counted_s
        assert np.linalg.norm(out - before) <= allowed * (1 + 1e-9) + 1e-9


@settings(deadline=None, max_examples=100)
@given(limits, ticks)
def test_release_reaches_exactly_zero_and_stays(limit: SafetyLimits, script: list) -> None:
    guard = Guard(limit, np.array([-1.0]), np.array([1.0]))
    for want, x, age_s, elapsed_s, enabled, device_ok in script:
        guard.step(
            np.array(want), np.array([x]), age_s=age_s, elapsed_s=elapsed_s, enabled=enabled, device_ok=device_ok
        )
    patience = int(limit.clamp_um / (limit.slew_um_s * 0.002)) + 3
    for _ in range(min(patience, 200_000)):
        guard.step(np.full(3, 100.0), np.zeros(1), age_s=0.0, elapsed_s=0.002, enabled=False)
        if guard.at_rest:
            break
    assert guard.out_um.tolist() == [0.0, 0.0, 0.0]
    guard.step(np.full(3, 100.0), np.zeros(1), age_s=0.0, elapsed_s=0.002, enabled=False)
    assert guard.at_rest
