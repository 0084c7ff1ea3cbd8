"""What is wrong with the data, said before anyone models it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from dtwin.acquire.linear_quality import judge_linear_campaign, judge_linear_run
from dtwin.acquire.motion_quality import judge_motion
from dtwin.acquire.sinusoidal_runs import judge_sinusoidal_campaign, judge_sinusoidal_run
from dtwin.acquire.volumetric_quality import judge_volumetric_run
from dtwin.schema import Finding, Floats, Run, SignalGroup

# A ball bar measures about a millimetre each way; more is a wrong unit or a lost ball.
MAX_DEVIATION_UM = 2_500.0
# No ball bar, laser or probe resolves less: such readings are in another unit.
MIN_SPREAD_UM = 0.02
_BALL_BAR_MM = (10.0, 5_000.0)
_STUCK_S = 0.1
# More than this share of a recording lost is a link that does not keep up, not a hiccup.
_MOST_LOST = 0.05


def judge_run(run: Run) -> list[Finding]:
    """Return the findings of one run.

    Parameters
    ----------
    run : Run
        A run with its samples.
    """
    return [*_too_small(run), *_of_kind(run)]


def _of_kind(run: Run) -> list[Finding]:
    if run.meta.kind == "placement":
        # Placements are events: minutes between them are no lost samples.
        return [f for f in _clock(run.samples["t_s"]) if f.code != "clock.dropout"] + _flagged(run)
    if run.meta.kind == "volumetric":
        # Between the poses the array is turned: gaps in time are no lost samples.
        return judge_volumetric_run(run)
    if run.meta.kind != "circular":
        clock = _clock(run.samples["t_s"]) if "t_s" in run.samples else []
        judge = {"linear": judge_linear_run, "sinusoidal": judge_sinusoidal_run}.get(run.meta.kind)
        return clock if judge is None else [*clock, *judge(run)]
    clock = _clock(run.samples["t_s"])
    findings = [*clock, *_reading(run), *_angles(run), *_radius(run)]
    told = any(finding.code == "recording.gap" for finding in run.findings)
    for group in run.signals:
        findings += _signals(group, gaps_told=told)
    if not any(finding.severity == "error" for finding in findings):
        findings += judge_motion(run)
    return findings


def judge_campaign(runs: Sequence[Run]) -> list[Finding]:
    """Return what the runs lack as a whole: directions, repeats.

    Parameters
    ----------
    runs : sequence of Run
        Runs of one campaign; only positioning runs need their samples.
    """
    linear = [run for run in runs if run.meta.kind == "linear" and run.samples]
    if linear:
        return judge_linear_campaign(linear)
    tones = [run for run in runs if run.meta.kind == "sinusoidal"]
    if tones:
        return judge_sinusoidal_campaign(tones)
    circular = [run.meta for run in runs if run.meta.kind == "circular"]
    if not circular:
        return []
    findings = []
    conditions = Counter((m.plane, m.radius_mm, m.feed_mm_min, m.direction) for m in circular)
    pairs = Counter(key[:3] for key in conditions)
    lonely = sum(count == 1 for count in pairs.values())
    if lonely:
        findings.append(
            Finding(
                "campaign.one_direction",
                "warning",
                f"{lonely} of {len(pairs)} conditions were run in one direction only",
                {"conditions_1": float(lonely)},
            )
        )
    single = sum(count == 1 for count in conditions.values())
    if single:
        findings.append(
            Finding(
                "campaign.no_repeat",
                "warning",
                f"{single} of {len(conditions)} conditions have no repeat: their noise floor is unknown",
                {"conditions_1": float(single)},
            )
        )
    return findings


def _too_small(run: Run) -> list[Finding]:
    """Return a finding for errors that hardly spread: millimetres in a column of micrometres."""
    found = []
    for name in ("deviation_um", "error_um"):
        spread = float(np.std(run.samples[name])) if name in run.samples else np.inf
        if 0.0 < spread < MIN_SPREAD_UM:
            found.append(
                Finding(
                    "reading.too_small",
                    "error",
                    f"{name} spreads by {spread:.2g} um RMS, less than any instrument resolves: are "
                    "these millimetres?",
                    {"spread_um": spread},
                )
            )
    return found


def _radius(run: Run) -> list[Finding]:
    radius, (low, high) = run.meta.radius_mm, _BALL_BAR_MM
    if radius is None or low <= radius <= high:
        return []
    return [
        Finding(
            "radius.implausible",
            "error",
            f"a radius of {radius:g} mm is none of a ball bar ({low:g} to {high:g} mm): another unit?",
            {"radius_mm": radius},
        )
    ]


def judge_copies(samples_sha256: Mapping[str, str]) -> dict[str, Finding]:
    """Return a finding for every run that holds the samples of another one.

    Parameters
    ----------
    samples_sha256 : mapping of str to str
        Hash of the samples by run id, in the order in which the runs came.
    """
    first: dict[str, str] = {}
    found = {}
    for name, digest in samples_sha256.items():
        other = first.setdefault(digest, name)
        if other != name:
            found[name] = Finding(
                "run.copy",
                "error",
                f"the samples are those of run {other} to the last digit: a copy is no repeat, and "
                "would say that there is no noise",
            )
    return found


def _flagged(run: Run) -> list[Finding]:
    """Say how many placements a rule has flagged; the rows stay, figures leave them out."""
    flags = run.samples.get("flag_1")
    count = int(np.count_nonzero(flags)) if flags is not None else 0
    if not count:
        return []
    return [
        Finding(
            "placement.flagged",
            "info",
            f"{count} of {run.n_samples} placements were flagged by a rule: they are left out of "
            "every figure, not replaced",
            {"placements_1": float(count)},
        )
    ]


def without_samples(run: Run) -> Run:
    """Return what ``judge_campaign`` needs of a run; positioning runs are small and keep all."""
    return replace(run, samples=run.samples if run.meta.kind == "linear" else {}, signals=())


def _clock(t_s: Floats) -> list[Finding]:
    gaps = np.diff(t_s)
    if not gaps.size:
        return []
    typical = float(np.median(gaps))
    back = np.flatnonzero(gaps <= 0)
    if back.size:
        return [
            Finding(
                "clock.backwards",
                "error",
                f"the clock runs backwards or stands still at sample {back[0] + 1}",
                {"sample_1": float(back[0] + 1)},
            )
        ]
    holes = np.flatnonzero(gaps > 1.5 * typical)
    if holes.size:
        lost = float(np.sum(gaps[holes] / typical - 1.0))
        return [
            Finding(
                "clock.dropout",
                "warning",
                f"{holes.size} gap(s) in the clock, about {lost:z.0f} samples lost, "
                f"the first at {t_s[holes[0]]:z.3f} s",
                {"gaps_1": float(holes.size), "lost_1": lost},
            )
        ]
    return []


def _reading(run: Run) -> list[Finding]:
    deviation = run.samples["deviation_um"]
    largest = float(np.max(np.abs(deviation)))
    findings = []
    if largest > MAX_DEVIATION_UM:
        findings.append(
            Finding(
                "reading.out_of_range",
                "error",
                f"a deviation of {largest:z.0f} um is beyond any ball bar: wrong unit, or the ball was lost",
                {"largest_um": largest},
            )
        )
    rate = run.meta.sample_rate_hz
    limit = max(8, int(_STUCK_S * rate)) if np.isfinite(rate) else 20
    length, value = _longest_constant(deviation)
    if length >= limit:
        extreme = bool(value in (deviation.max(), deviation.min())) and np.ptp(deviation) > 0
        code, what = (
            ("reading.clipped", "the travel limit")
            if extreme
            else ("reading.stuck", "a stuck sensor")
        )
        findings.append(
            Finding(
                code,
                "error",
                f"{length} equal readings in a row at {value:z.1f} um look like {what}",
                {"samples_1": float(length), "value_um": float(value)},
            )
        )
    return findings


def _angles(run: Run) -> list[Finding]:
    steps = np.diff(run.samples["angle_deg"])
    if not steps.size:
        return []
    sign = 1.0 if run.meta.direction == "CCW" else -1.0
    findings = []
    if float(np.median(steps)) * sign < 0:
        findings.append(
            Finding(
                "angle.direction",
                "error",
                f"the angle runs against the stated direction {run.meta.direction}",
            )
        )
    typical = float(np.median(np.abs(steps)))
    jumps = np.flatnonzero(np.abs(steps) > max(20.0 * typical, 5.0))
    if jumps.size:
        findings.append(
            Finding(
                "angle.jump",
                "error",
                f"the angle jumps by {steps[jumps[0]]:z.1f} deg at sample {jumps[0] + 1}",
                {"jump_deg": float(steps[jumps[0]]), "jumps_1": float(jumps.size)},
            )
        )
    return findings


def _signals(group: SignalGroup, *, gaps_told: bool) -> list[Finding]:
    """Judge signals; samples without any value are lost ones when the recorder told of gaps."""
    findings = []
    floats = {n: v for n, v in group.columns.items() if v.dtype.kind == "f"}
    lost = np.zeros(group.n_samples, dtype=bool)
    if gaps_told and floats:
        lost = np.logical_and.reduce([np.isnan(values) for values in floats.values()])
        if lost.mean() > _MOST_LOST:
            text = f"{lost.sum()} of {lost.size} samples of {group.name} are lost"
            findings.append(Finding("signal.lost", "error", text, {"share_1": float(lost.mean())}))
    for name, whole in floats.items():
        values = whole[~lost]
        bad = int(np.count_nonzero(~np.isfinite(values)))
        if bad:
            findings.append(
                Finding(
                    "signal.not_finite",
                    "error",
                    f"{bad} values of {group.name} {name} are not finite",
                    {"values_1": float(bad)},
                )
            )
        elif name.endswith("_g"):
            findings += _accelerometer(group.name, name, values)
    return findings


def _accelerometer(group: str, name: str, values: Floats) -> list[Finding]:
    if not values.size:
        return []
    top = float(np.max(np.abs(values)))
    clipped = int(np.count_nonzero(np.abs(values) >= 0.999 * top))
    if top > 0 and clipped > 20 and clipped > 1e-4 * values.size:
        return [
            Finding(
                "signal.clipped",
                "warning",
                f"{clipped} values of {group} {name} sit at its extreme {top:.3g} g",
                {"values_1": float(clipped), "extreme_g": top},
            )
        ]
    if float(np.ptp(values)) == 0.0:
        return [Finding("signal.dead", "error", f"{group} {name} does not move")]
    return []


def _longest_constant(values: Floats) -> tuple[int, float]:
    change = np.flatnonzero(np.diff(values) != 0)
    edges = np.concatenate([[-1], change, [values.size - 1]])
    lengths = np.diff(edges)
    longest = int(np.argmax(lengths))
    return int(lengths[longest]), float(values[edges[longest + 1]])
