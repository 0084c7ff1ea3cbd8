"""What is wrong with a test that commands a tone, said before anyone models it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dtwin.acquire.quality import judge_clock
from dtwin.errors import InputError
from dtwin.features.sine import Tone, ToneErrors, fit_tone, lag_deg, tone_errors
from dtwin.kinds.sinusoidal._plan import FEWEST_PER_PERIOD, FORETOLD_S, LEARNED_S, SAFE_SHARE
from dtwin.schema import Campaign, Finding, Floats, Run, SignalGroup
from dtwin.units import G_MM_S2, UM_PER_MM, is_number, shown_number

# A quantised sine spends about 1 % of its samples at its highest value, a clipped one far more.
_CLIPPED_SHARE = 0.05
# Below this share of the tone in the accelerometer's power its features are noise.
HEARD = 0.5
_SAME_TONE = 0.9
# m/s² under a name of g are 9.8 times as many; a sensor beside the tool feels another share of it, not that much.
_OTHER_UNIT = 5.0
_LEAST_MOVED, _MOST_MOVED = 0.2, 20.0
"""Of the encoder's amplitude: what a tool moves by, beside a resonance, too."""
_AGAINST_DEG = 150.0
"""No slide turns a tone below its bandwidth by as much."""
_AHEAD_DEG = 0.2
"""No slide is as much before its command; one with feed forward has the amplitude of the command, too."""
# Between the halves of a run; of a tone that is told to the last digit it moves by what the command is quantised by.
_STEADY_DEG = 5.0
_FEWEST_PERIODS = 4.0


@dataclass(frozen=True)
class _Commanded:
    """What a run was told to do."""

    frequency_hz: float
    amplitude_um: float


def commanded(run: Run) -> _Commanded:
    """Return frequency and amplitude that a run states."""
    values = [run.meta.condition.get(name) for name in ("frequency_hz", "amplitude_um")]
    numbers = [float(v) for v in values if isinstance(v, int | float) and v > 0.0]
    if len(numbers) < 2:
        raise InputError(
            "a sinusoidal run must state frequency and amplitude",
            code="sinusoidal.condition",
            where=f"run {run.meta.run_id}",
            got=f"frequency_hz, amplitude_um = {values}",
            allowed="positive numbers under [run.condition]",
        )
    return _Commanded(*numbers)


def with_bandwidth(run: Run, campaign: Campaign) -> Run:
    """Return a sinusoidal run with the axis's control bandwidth among its conditions, checked.

    ``run``: a run of kind ``sinusoidal``.
    ``campaign``: ``machine_geometry.z_bandwidth_hz`` is the bandwidth, where it is known.
    """
    commanded(run)
    bandwidth = campaign.machine_geometry.get("z_bandwidth_hz")
    if bandwidth is None:
        return run
    if not isinstance(bandwidth, int | float) or not 0.0 < bandwidth < 1e6:
        raise InputError(
            "the bandwidth is no frequency",
            code="sinusoidal.bandwidth",
            where="campaign.machine_geometry z_bandwidth_hz",
            got=repr(bandwidth)[:40],
            allowed="a positive number",
        )
    condition = dict(run.meta.condition) | {"z_bandwidth_hz": float(bandwidth)}
    return replace(run, meta=replace(run.meta, condition=condition))


def followed(run: Run, last_s: float | None = None) -> ToneErrors | None:
    """Return how encoder and tool follow the command, None without a probe at the tool.

    ``run``: with samples.
    ``last_s``: only this much of the end.
    """
    samples = run.samples
    if "tool_z_mm" not in samples:
        return None
    t = samples["t_s"]
    part = t > t[-1] - last_s if last_s is not None else np.ones(len(t), dtype=bool)
    command, encoder, tool = (samples[name][part] * UM_PER_MM for name in ("cmd_z_mm", "act_z_mm", "tool_z_mm"))
    return tone_errors(t[part], command, encoder, tool, commanded(run).frequency_hz)


def accelerometer(run: Run) -> tuple[SignalGroup, str] | None:
    """Return the group of the accelerometers and its first channel in g, None without one."""
    groups = (group for group in run.signals if group.name == "accelerometers")
    return next(((group, name) for group in groups for name in group.columns if name.endswith("_g")), None)


def heard(run: Run) -> Tone | None:
    """Return the commanded tone as the first accelerometer channel hears it, None without one."""
    signal = accelerometer(run)
    if signal is None:
        return None
    group, name = signal
    return fit_tone(group.t_s, group.columns[name], commanded(run).frequency_hz)


def judge_sinusoidal_run(run: Run) -> Iterator[Finding]:
    """Yield the findings of one run of a tone. ``run``: with samples, and with signals where there are any."""
    told = commanded(run)
    yield from (*judge_clock(run), *_sampling(run, told), *_tone(run, told))
    bandwidth = run.meta.condition.get("z_bandwidth_hz")
    if is_number(bandwidth) and told.frequency_hz > SAFE_SHARE * bandwidth + 1e-9:
        yield Finding(
            "sinusoidal.beyond_safe",
            "error",
            f"{told.frequency_hz:g} Hz is beyond the safe limit of {SAFE_SHARE * bandwidth:g} Hz "
            f"({SAFE_SHARE:g} of the axis's bandwidth of {bandwidth:g} Hz)",
            {"frequency_hz": told.frequency_hz, "limit_hz": SAFE_SHARE * bandwidth},
        )
    for name in ("act_z_mm", "tool_z_mm"):
        if name in run.samples:
            yield from _clipped(run.samples[name], name, "reading.clipped")
    for group in run.signals:
        yield from _sensor(run, group, told)


def judge_sinusoidal_campaign(runs: Sequence[Run]) -> Iterator[Finding]:
    """Yield what the groups of a campaign lack together. ``runs``: samples are not needed."""
    told = [commanded(run) for run in runs]
    count = Counter(told)
    single = sum(n == 1 for n in count.values())
    if single:
        yield Finding(
            "campaign.no_repeat",
            "warning",
            f"{single} of {len(count)} groups have no repeat: their noise floor is unknown",
            {"conditions_1": float(single)},
        )
    grid = len({c.frequency_hz for c in told}) * len({c.amplitude_um for c in told})
    if grid > len(count):
        yield Finding(
            "sinusoidal.grid",
            "warning",
            f"{grid - len(count)} of {grid} combinations of frequency and amplitude are missing",
            {"missing_1": float(grid - len(count))},
        )


def _sampling(run: Run, told: _Commanded) -> Iterator[Finding]:
    t = run.samples["t_s"]
    yield from _rate_finding(run.meta.sample_rate_hz, told.frequency_hz, "the samples")
    if len(t) and t[-1] - t[0] < LEARNED_S - 0.01:
        yield Finding(
            "sinusoidal.short",
            "warning",
            f"{t[-1] - t[0]:z.2f} s are recorded; {LEARNED_S - FORETOLD_S:g} s for the features and "
            f"{FORETOLD_S:g} s for what they foretell are needed",
            {"duration_s": float(t[-1] - t[0])},
        )


def _rate_finding(rate_hz: float, frequency_hz: float, what: str) -> Iterator[Finding]:
    if not np.isfinite(rate_hz) or rate_hz >= FEWEST_PER_PERIOD * frequency_hz:
        return
    folded = rate_hz <= 2.0 * frequency_hz
    alias = abs(frequency_hz - rate_hz * round(frequency_hz / rate_hz))
    why = (
        f"the tone of {frequency_hz:g} Hz appears at {alias:g} Hz"
        if folded
        else f"{rate_hz / frequency_hz:z.1f} samples to a period: peaks are missed"
    )
    yield Finding(
        "sinusoidal.aliasing",
        "error" if folded else "warning",
        f"{what} come at {rate_hz:g} Hz: {why}",
        {"rate_hz": rate_hz, "frequency_hz": frequency_hz},
    )


def _tone(run: Run, told: _Commanded) -> Iterator[Finding]:
    tone = fit_tone(run.samples["t_s"], run.samples["cmd_z_mm"] * UM_PER_MM, told.frequency_hz)
    if tone.share < _SAME_TONE or abs(tone.amplitude - told.amplitude_um) > 0.1 * told.amplitude_um:
        yield Finding(
            "sinusoidal.not_the_tone",
            "error",
            f"the command is not the stated tone of {told.amplitude_um:g} µm at "
            f"{told.frequency_hz:g} Hz: that explains {100 * tone.share:z.0f} % of its power with "
            f"{tone.amplitude:z.2f} µm",
            {"share_1": tone.share, "amplitude_um": tone.amplitude},
        )
    else:
        yield from _frequency(run, told)
    yield from _exchanged(run, told, tone)
    if "tool_z_mm" not in run.samples:
        yield Finding(
            "sinusoidal.no_reference",
            "warning",
            "no column tool_z_mm: what the tool does beyond the encoder is not known",
        )
        return
    encoder, tool = (fit_tone(run.samples["t_s"], run.samples[n], told.frequency_hz) for n in ("act_z_mm", "tool_z_mm"))
    if min(encoder.share, tool.share) > _SAME_TONE:
        behind_deg = float(np.degrees(np.angle(tool.phasor * np.conj(encoder.phasor))))
        if abs(behind_deg) > _AGAINST_DEG:
            said = f"the tool moves against the encoder ({behind_deg:z.0f}°): the probe reads with the opposite sign"
            yield Finding("sinusoidal.sign", "error", said, {"phase_deg": behind_deg})
    # The error of a tool is no tone where noise is most of it.
    ratio = tool.amplitude / encoder.amplitude if encoder.share > _SAME_TONE else 1.0
    if ratio > 0.0 and not _LEAST_MOVED < ratio < _MOST_MOVED:
        said = f"the tool moves {shown_number(ratio)} times as far as the encoder: another unit, or the tool's error in place of its position"
        yield Finding("sinusoidal.tool_scale", "error", said, {"ratio_1": ratio})


def _exchanged(run: Run, told: _Commanded, command: Tone) -> list[Finding]:
    """Tell command and encoder apart: a slide follows its command, which has the stated amplitude."""
    encoder = fit_tone(run.samples["t_s"], run.samples["act_z_mm"] * UM_PER_MM, told.frequency_hz)
    if min(command.share, encoder.share) < _SAME_TONE:
        return []
    ahead_deg = -lag_deg(command, encoder)
    noise = sum((one.rest_rms / one.amplitude) ** 2 for one in (command, encoder))
    surely_deg = max(_AHEAD_DEG, 5.0 * float(np.degrees(np.sqrt(2.0 * noise / len(run.samples["t_s"])))))
    off_um = [abs(one.amplitude - told.amplitude_um) for one in (command, encoder)]
    if not (surely_deg < ahead_deg < _AGAINST_DEG and off_um[1] < off_um[0]):
        return []
    said = (
        f"act_z_mm runs {shown_number(ahead_deg, 2)}° ahead of cmd_z_mm, and its {shown_number(encoder.amplitude, 4)} µm are nearer to the stated {told.amplitude_um:g} µm than "
        f"{shown_number(command.amplitude, 4)} µm: command and encoder are exchanged"
    )
    return [Finding("sinusoidal.exchanged", "error", said, {"phase_deg": ahead_deg})]


def _frequency(run: Run, told: _Commanded) -> list[Finding]:
    """Judge the stated frequency by how the phase of the command moves from the first half of a run to the second."""
    t, command = run.samples["t_s"], run.samples["cmd_z_mm"]
    if (t[-1] - t[0]) * told.frequency_hz < _FEWEST_PERIODS:
        return []
    first = t < 0.5 * (t[0] + t[-1])
    halves = [fit_tone(t[part], command[part], told.frequency_hz) for part in (first, ~first)]
    moved_rad = float(np.angle(halves[1].phasor * np.conj(halves[0].phasor)))
    if abs(moved_rad) < np.radians(_STEADY_DEG):
        return []
    true_hz = told.frequency_hz + moved_rad / (np.pi * float(t[-1] - t[0]))
    said = (
        f"the command is a tone of {true_hz:.6g} Hz, not of {told.frequency_hz:g} Hz: its phase moves by {np.degrees(moved_rad):z.0f}° within the run, and "
        "amplitudes come out too small; state the frequency that was run"
    )
    return [Finding("sinusoidal.frequency", "warning", said, {"frequency_hz": true_hz})]


def _sensor(run: Run, group: SignalGroup, told: _Commanded) -> Iterator[Finding]:
    yield from _rate_finding(group.rate_hz, told.frequency_hz, f"the signals of {group.name}")
    for name, values in group.columns.items():
        yield from _clipped(values, name, "sensor.saturated")
    if group.name != "accelerometers" or not group.columns:
        return
    tone = heard(run)
    if tone is None:
        said = f"no channel of the accelerometers is in g, such as tool_z_g ({', '.join(group.columns)}): none is read"
        yield Finding("sensor.unit", "warning", said)
    elif tone.share < HEARD:
        yield Finding(
            "sensor.below_noise",
            "warning",
            f"the accelerometer does not hear {told.amplitude_um:g} µm at {told.frequency_hz:g} Hz: "
            f"{100 * tone.share:z.0f} % of its power is the tone, its features are noise",
            {"share_1": tone.share},
        )
    else:
        yield from _scale(run, told, tone)


def _scale(run: Run, told: _Commanded, felt: Tone) -> list[Finding]:
    """Compare what the accelerometer reads with the acceleration of the tool, or of the encoder where no probe is at the tool."""
    name = next(
        (name for name in ("tool_z_mm", "act_z_mm") if name in run.samples and np.ptp(run.samples[name]) > 0.0), ""
    )
    if not name:
        return []
    moved_mm = fit_tone(run.samples["t_s"], run.samples[name], told.frequency_hz).amplitude
    ratio = felt.amplitude / (moved_mm * (2.0 * np.pi * told.frequency_hz) ** 2 / G_MM_S2)
    if 1.0 / _OTHER_UNIT < ratio < _OTHER_UNIT:
        return []
    said = f"the accelerometer reads {shown_number(ratio)} times the acceleration of {name}: is it in g (1 g is 9.81 m/s²), and is its axis Z?"
    return [Finding("sensor.scale", "warning", said, {"ratio_1": ratio})]


def _clipped(values: Floats, name: str, code: str) -> list[Finding]:
    spread = float(np.ptp(values))
    ends = [float(np.mean(values == end)) for end in (values.max(), values.min())]
    if spread > 0.0 and max(ends) < _CLIPPED_SHARE:
        return []
    what = f"{100 * max(ends):z.0f} % of {name} lie at its limit" if spread else f"{name} is stuck"
    return [Finding(code, "error", f"{what}: amplitudes are wrong", {"share_1": max(ends)})]
