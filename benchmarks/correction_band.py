"""How often the band of a correction covers the truth, and what fading by it does: machines whose errors are drawn here.

Each machine has errors of a form that dtwin knows, runs that differ and readings that scatter. A twin is fitted and
frozen as for serving. Covered: the share of ticks at which the corrected error lies within the band (k = 2). Fading: the
RMS of what is left of the true error, and of circles and sweeps that were measured afresh, with and without it, by the
size of the error over the band.

Run: OMP_NUM_THREADS=1 python benchmarks/correction_band.py [--machines N] [--short] [--json]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from typing import Any

import numpy as np

from dtwin.kinds.circular.freeze import twin_bundle
from dtwin.kinds.linear._correction import flanks_twin_bundle
from dtwin.physics.fit import fit
from dtwin.physics.library import Library
from dtwin.physics.observations import observe
from dtwin.physics.twin import chosen_terms, twin_of
from dtwin.report.text import table
from dtwin.schema import Campaign, Floats, Run, RunMeta
from dtwin.serve.bundle import Bundle
from dtwin.serve.runtime import CompiledBundle

RNG = np.random.Generator
Truth = Callable[[Floats, bool], Floats]
ANGLE_DEG = np.arange(0.5, 360.0, 1.0)
TARGETS_MM = np.arange(3.0, 400.0, 19.0)
SETUPS = ((100.0, "a"), (150.0, "b"))
FEEDS = (1000.0, 3000.0)
REPEATS = 3
NOISE_UM, WANDERS_UM = 0.5, 0.3
BINS = ((0.0, 0.5), (0.5, 1.0), (1.0, 2.0), (2.0, 4.0), (4.0, np.inf))
# An axis whose screw has a pitch of 10 mm, which its targets meet at all angles.
GEOMETRY = {"screw_pitch_mm": 10.0}


def circle(rng: RNG, size: float) -> Truth:
    """Return the radial error of a circle of 1 m, in um per m of radius: an oval, a skew and a lost motion of X."""
    oval, skew, lost = size * rng.normal(0.0, (10.0, 10.0, 0.6))

    def error_um(angle_rad: Floats, ccw: bool, radius_m: float = 0.1) -> Floats:
        side = np.sign(np.sin(angle_rad)) * (1.0 if ccw else -1.0)
        waves = oval * np.cos(2.0 * angle_rad) + skew * np.sin(2.0 * angle_rad)
        return radius_m * waves + lost * side * np.cos(angle_rad)

    return error_um


def circles(rng: RNG, truth: Any, repeats: int) -> list[Run]:
    """Return circles of both directions: each is off its centre, wanders, and scatters."""
    runs = []
    for radius, setup in SETUPS:
        off = rng.normal(0.0, 3.0, 3)
        for feed in FEEDS:
            for n in range(repeats):
                for way, sign in (("CCW", 1.0), ("CW", -1.0)):
                    angle = np.radians(sign * ANGLE_DEG)
                    wander = rng.normal(0.0, WANDERS_UM, 4)
                    error = truth(angle, way == "CCW", radius / 1000.0) + rng.normal(0.0, NOISE_UM, angle.size)
                    error = error + off @ [np.ones(angle.size), np.cos(angle), np.sin(angle)]
                    error = error + wander @ [f(k * angle) for k in (2.0, 3.0) for f in (np.cos, np.sin)]
                    meta = RunMeta(
                        f"{way}{radius:g}-{feed:g}-{n}",
                        plane="XY",
                        direction=way,
                        radius_mm=radius,
                        feed_mm_min=feed,
                        repeat=n + 1,
                        setup=setup,
                    )
                    runs.append(Run(meta, {"angle_deg": sign * ANGLE_DEG, "deviation_um": error}))
    return runs


def axis(rng: RNG, size: float) -> Truth:
    """Return the error of an axis at positions, in um: a lead that is off, and half of a lost motion to either side."""
    lead, more = size * rng.normal(0.0, (2.0, 0.4))
    # A play that could be fitted as negative is refused, so there always is one.
    lost = 1.0 + abs(more)

    def error_um(position_mm: Floats, forward: bool) -> Floats:
        return lead * (position_mm - TARGETS_MM.mean()) / 1000.0 + (-0.5 if forward else 0.5) * lost

    return error_um


def sweeps(rng: RNG, truth: Truth, repeats: int) -> list[Run]:
    """Return sweeps there and back about one datum, the lead and the place of each a little another."""
    runs = []
    place = np.concatenate([TARGETS_MM, TARGETS_MM[::-1]])
    ways = np.repeat(["forward", "reverse"], TARGETS_MM.size)
    for n in range(2 * repeats):
        error = np.concatenate([truth(TARGETS_MM, True), truth(TARGETS_MM[::-1], False)])
        for way in ("forward", "reverse"):
            slope, place_um = rng.normal(0.0, WANDERS_UM, 2)
            error = error + (ways == way) * (slope * (place - TARGETS_MM.mean()) / 400.0 + place_um)
        error = error + rng.normal(0.0, NOISE_UM, place.size)
        samples = {"t_s": np.arange(place.size) * 1.0, "position_mm": place, "direction": ways, "error_um": error}
        meta = RunMeta(f"r{n}", kind="linear", condition={"axis": "X"}, repeat=n + 1)
        runs.append(Run(meta, samples))
    return runs


def frozen(kind: str, runs: list[Run], effects: list[str]) -> Bundle:
    """Return the correction as a user gets it, without the questions of promotion."""
    campaign = Campaign("c", "m", kind, machine_geometry=GEOMETRY if kind == "linear" else {})
    obs = observe(campaign, runs)
    found = fit(obs, chosen_terms(effects, Library(), obs))
    twin = twin_of(found, obs, name="t", version=1, action="fit", data={})
    return (twin_bundle if kind == "circular" else flanks_twin_bundle)(twin, obs).bundle


def told(bundle: Bundle, ticks: dict[str, Floats], *, fades: bool) -> tuple[Floats, Floats]:
    """Return what a bundle tells at ticks, and its half width there."""
    compiled = CompiledBundle(bundle, fades=fades)
    rows = np.column_stack([ticks[name] for name in bundle.tick_inputs])
    out, half = [], []
    for row in rows:
        out.append(float(compiled.tick(row)[0]))
        half.append(float(compiled.band_um[0]))
    return np.array(out), np.array(half)


def round_a_circle(ccw: bool) -> dict[str, Floats]:
    """Return the ticks of one circle of R100."""
    angle = np.radians(ANGLE_DEG[::10] + 3.0) * (1.0 if ccw else -1.0)
    one = np.ones(angle.size)
    return {
        "path_angle_rad": angle,
        "direction_sign": one if ccw else -one,
        "commanded_speed_mm_s": 30.0 * one,
        "radius_mm": 100.0 * one,
        "plane_id": 0.0 * one,
    }


def along_the_axis(forward: bool) -> dict[str, Floats]:
    """Return the ticks of a sweep, after a way that brings the slide to rest on its flank."""
    place = np.linspace(TARGETS_MM[0], TARGETS_MM[-1], 36)
    return {"position_mm": place if forward else place[::-1]}


KINDS: dict[str, Any] = {
    "circular": (circle, circles, ["scale_mismatch", "squareness", "backlash:X"], round_a_circle, "path_angle_rad"),
    "linear": (axis, sweeps, ["lead_error", "backlash"], along_the_axis, "position_mm"),
}


def one_machine(kind: str, rng: RNG) -> dict[str, Any]:
    """Measure, fit, freeze and serve one machine; return squares of what is left, and whether the band covered."""
    make, measure, effects, ticks_of, at = KINDS[kind]
    truth = make(rng, float(np.exp(rng.uniform(np.log(0.05), np.log(10.0)))))
    bundle = frozen(kind, measure(rng, truth, REPEATS), effects)
    inside, parts = [], []
    noise = NOISE_UM * rng.standard_normal(1000)
    for way in (True, False):
        ticks = ticks_of(way)
        plain, half = told(bundle, ticks, fades=False)
        faded, _ = told(bundle, ticks, fades=True)
        true = truth(ticks[at], way)
        # The first ticks of an axis are inside its play.
        keep = slice(2, None)
        inside.append((np.abs(plain - true) <= half)[keep])
        fresh = true + noise[: true.size]
        parts.append(np.array([true, half, plain - true, faded - true, plain - fresh, faded - fresh])[:, keep])
    true, half, plain, faded, plain_fresh, faded_fresh = np.concatenate(parts, axis=1)
    return {
        "covered": float(np.concatenate(inside).mean()),
        "size_over_band": float(np.sqrt((true**2).mean()) / np.sqrt((half**2).mean())),
        "half_um": float(half.mean()),
        **{
            name: float((values**2).mean())
            for name, values in (
                ("plain", plain),
                ("faded", faded),
                ("fresh", plain_fresh),
                ("fresh_faded", faded_fresh),
            )
        },
    }


def measured(machines: int, seed: int) -> list[dict[str, Any]]:
    """Return a row for each kind and size of the error over its band."""
    rows = []
    for number, kind in enumerate(KINDS):
        rng = np.random.default_rng([seed, number])
        found = [one_machine(kind, rng) for _ in range(machines)]
        for low, high in ((0.0, np.inf), *BINS):
            here = [f for f in found if low <= f["size_over_band"] < high]
            if not here:
                continue
            mean = {name: float(np.mean([f[name] for f in here])) for name in here[0]}
            rows.append(
                {
                    "kind": kind,
                    "error_over_band": "all" if high - low == np.inf and not low else f"{low:g} to {high:g}",
                    "machines": len(here),
                    "covered": mean["covered"],
                    "half_um": mean["half_um"],
                    "left_um": mean["plain"] ** 0.5,
                    "left_faded_um": mean["faded"] ** 0.5,
                    "held_out_um": mean["fresh"] ** 0.5,
                    "held_out_faded_um": mean["fresh_faded"] ** 0.5,
                }
            )
    return rows


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--short", action="store_true", help="30 machines")
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    rows = measured(30 if chosen.short else chosen.machines, chosen.seed)
    if chosen.json:
        print(json.dumps(rows))
        return
    head = ("kind", "error over band", "machines", "covered", "band, µm", "left, µm", "faded", "held out, µm", "faded")
    print(table(head, [[round(v, 3) if isinstance(v, float) else v for v in row.values()] for row in rows]))


if __name__ == "__main__":
    main()
