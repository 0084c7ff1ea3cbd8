"""The loop at 500 Hz on the wall clock, against the usual Python client, in one run.

The virtual controller runs in a process of its own, with real-time priority as a controller
has, and notes when each correction arrived. Three clients serve it one after the other through
the real ur-rtde client: the usual script (one process, ``time.sleep`` pacing, a scikit-learn
model), this package's loop without real-time priority, and with it. All are judged by the
controller's own notes: a tick counts as answered in time when a correction that was computed
from its state has arrived within two periods of its stamp.

Run: OMP_NUM_THREADS=1 python benchmarks/bench_loop.py [--seconds 60] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.features.path_inputs import PATH_INPUT_UNITS, PATH_INPUTS
from dtwin.features.windows import WindowContract
from dtwin.links import layout
from dtwin.links.ur import UrLink
from dtwin.serve._timing import LoopTiming
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.decision import Decision
from dtwin.serve.interface import Input, Output, SafetyLimits
from dtwin.serve.loop import ServingLoop
from dtwin.serve.runtime import CompiledBundle

PERIOD_S = 0.002
CLIENTS = ("naive", "loop", "loop with priority")
CHANNELS = tuple(f"{place}_{axis}_g" for place in ("wrist", "base") for axis in "xyz")
BLOCK_S, FILTER_SAMPLES = 0.01, 40
CONTRACT = WindowContract(25_600.0, 1500, 256, CHANNELS, ("rms", "kurtosis", "mean_frequency"))


class PacedSensors:
    """Made-up windows at the pace of a module that is read every 10 ms; ages are modelled."""

    contract = CONTRACT

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self._block = 0.1 * rng.standard_normal((len(CHANNELS), CONTRACT.n_samples))
        self._begun_s, self._blocks = time.monotonic(), -1

    def newest_window(self) -> tuple[np.ndarray | None, float]:
        since_s = time.monotonic() - self._begun_s
        blocks = int(since_s / BLOCK_S)
        fresh, self._blocks = blocks != self._blocks, blocks
        age_s = since_s - blocks * BLOCK_S + FILTER_SAMPLES / CONTRACT.rate_hz
        return (self._block if fresh else None), age_s


def model() -> CompiledBundle:
    """Four harmonics, six joint reversals, six features of the newest window."""
    g = GraphBuilder()
    features = [name for name in CONTRACT.columns if name.endswith("rms_g")]
    terms = [3.0 / k * g.apply("sin", g.input("path_angle_rad") * k) for k in range(1, 5)]
    for j in range(1, 7):
        reversal = g.apply("tanh", 40.0 * g.input(f"qd{j}_rad_s"))
        terms.append(0.002 * g.input(f"lever_{j}_mm_rad") * reversal)
    terms += [0.5 * g.input(name) for name in features]
    graph = g.graph({"radial_error_um": g.total(terms)})
    inputs = [
        Input(n, PATH_INPUT_UNITS[n], "path", 500.0, "path", -2000.0, 2000.0) for n in PATH_INPUTS if n in graph.inputs
    ] + [Input(n, "g", "sensor", 100.0, "feature", 0.0, 5.0) for n in features]
    return CompiledBundle(
        create_bundle(
            name="bench",
            machine="bench",
            model_version=1,
            inputs=inputs,
            window=CONTRACT,
            outputs=[Output("radial_error_um", "path_radial")],
            tick_graph=graph,
            safety=SafetyLimits(trips_to_latch=1_000_000),
        )
    )


class NotedLink:
    """A link that notes from which state each correction was computed."""

    def __init__(self, link: UrLink, capacity: int) -> None:
        self._link, self._stamp_s, self.n = link, 0.0, 0
        self.notes = np.zeros((capacity, 2))

    @property
    def received_s(self) -> float:
        return self._link.received_s

    def wait_state(self, timeout_s: float) -> np.ndarray | None:
        state = self._link.wait_state(timeout_s)
        if state is not None:
            self._stamp_s = float(state[layout.TIMESTAMP])
        return state

    def send(self, offset_um: np.ndarray, sequence: int) -> None:
        self.notes[self.n % len(self.notes)] = sequence, self._stamp_s
        self.n += 1
        self._link.send(offset_um, sequence)


def run_loop(host: str, seconds: float, priority: int) -> tuple[np.ndarray, np.ndarray, Any]:
    decision = Decision(model(), np.array([0.0, 0.0, 158.3]), sensors=PacedSensors())
    with UrLink(host, realtime=priority > 0) as link:
        noted = NotedLink(link, int(seconds * 800) + 5000)
        loop = ServingLoop(decision, noted)
        # A server remembers its newest two minutes; every tick is to be compared here.
        loop.timing = LoopTiming(PERIOD_S, int(seconds * 800) + 5000)
        status = loop.run(seconds, priority=priority)
    return noted.notes[: noted.n], loop.timing.late_stamps_s(), status.as_dict()


def run_naive(host: str, seconds: float) -> tuple[np.ndarray, np.ndarray, Any]:
    """What is usually written: everything in one script, sleeping for a period at the end."""
    from rtde_io import RTDEIOInterface
    from rtde_receive import RTDEReceiveInterface
    from sklearn.ensemble import GradientBoostingRegressor

    rng = np.random.default_rng(0)
    rows = rng.standard_normal((2000, 15))
    fitted = GradientBoostingRegressor(random_state=0).fit(rows, np.sin(rows[:, 0]) + rows[:, 1])
    receive, io = RTDEReceiveInterface(host, 500.0), RTDEIOInterface(host)
    notes, sequence, until_s = [], 1, time.monotonic() + seconds
    while time.monotonic() < until_s:
        stamp_s = receive.getTimestamp()
        pose = receive.getTargetTCPPose()
        row = [*receive.getTargetQ(), *receive.getTargetQd(), *pose[:3]]
        offset_um = float(fitted.predict([row])[0])
        for axis in range(3):
            io.setInputDoubleRegister(18 + axis, offset_um if axis < 2 else 0.0)
        io.setInputIntRegister(18, sequence)
        notes.append((sequence, stamp_s))
        sequence += 1
        time.sleep(PERIOD_S)
    for axis in range(3):
        io.setInputDoubleRegister(18 + axis, 0.0)
    io.setInputIntRegister(18, sequence)
    io.disconnect()
    receive.disconnect()
    return np.array(notes), np.zeros(0), None


def client(name: str, host: str, seconds: float, out: Path) -> None:
    if name == "naive":
        notes, late_s, status = run_naive(host, seconds)
    else:
        priority = 60 if name.endswith("priority") else 0
        notes, late_s, status = run_loop(host, seconds, priority)
    np.savez(out, notes=notes, late_s=late_s, status=np.array(json.dumps(status)))


def judge(notes: np.ndarray, late_s: np.ndarray, log: Any) -> dict[str, Any]:
    """Compare what was computed from which state with what arrived when, per controller tick."""
    arrived_s = dict(zip(log["sequence"].tolist(), log["arrived_s"].tolist(), strict=True))
    acts_s = dict(zip(log["sequence"].tolist(), log["latched_s"].tolist(), strict=True))
    answered: dict[int, float] = {}
    acted: dict[int, float] = {}
    for sequence, stamp_s in notes.tolist():
        tick = round(stamp_s / PERIOD_S)
        if sequence in arrived_s and tick not in answered:
            answered[tick] = arrived_s[sequence] - stamp_s
            acted[tick] = acts_s[sequence]
    # The first half second holds connecting and first-time costs of every client.
    first, last = min(answered) + 250, max(answered) - 5
    ticks = range(first, last)
    delays_s = np.array([answered[t] for t in ticks if t in answered])
    late = {t for t in ticks if answered.get(t, 0.0) > 2 * PERIOD_S}
    never = set(ticks) - set(answered)
    # A correction that the next one overtook on its way needs not arrive: the newer one was in force.
    used_in_time = {
        t for t in ticks if min(acted.get(t, np.inf), acted.get(t + 1, np.inf)) - t * PERIOD_S < 2.5 * PERIOD_S
    }
    # A stalled controller hands over two states at once and reads the correction too late.
    stalled = {t - back for t in log["late_ticks"].tolist() for back in range(3)}
    sound = set(ticks) - stalled
    # What the loop itself can know: what it marked late, and states that it never saw.
    seen = {round(stamp_s / PERIOD_S) for stamp_s in notes[:, 1].tolist()}
    marked = {round(stamp_s / PERIOD_S) for stamp_s in late_s.tolist()} | (set(ticks) - seen)
    p50, p99, p999 = np.percentile(delays_s, [50, 99, 99.9]) * 1e3
    return {
        "ticks": len(ticks),
        "answered_late": len(late),
        "never_answered": len(never),
        "late_share": len(late | never) / len(ticks),
        "sound_ticks": len(sound),
        "late_share_sound": len((late | never) & sound) / len(sound),
        "not_noticed_by_the_loop": len((late | never) - marked),
        "not_noticed_but_used_in_time": len(((late | never) - marked) & used_in_time),
        "only_in_the_loop": len((marked & set(ticks)) - late - never),
        "stamp_to_controller_ms": {
            "p50": round(float(p50), 3),
            "p99": round(float(p99), 3),
            "p99.9": round(float(p999), 3),
            "max": round(float(delays_s.max()) * 1e3, 3),
        },
    }


def start_controller(host: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "studies.machines.rtde_server", f"--host={host}"]
    options = ["--repeat-forever", "--control", "--realtime"]
    return subprocess.Popen([*command, *options], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def measure(seconds: float, host: str, folder: Path, clients: Sequence[str]) -> dict[str, Any]:
    found = {name: measure_one(name, seconds, host, folder) for name in clients}
    realtime = all(one.pop("controller_realtime") for one in found.values())
    return {"controller_realtime": realtime, "seconds": seconds, "clients": found}


def measure_one(name: str, seconds: float, host: str, folder: Path) -> dict[str, Any]:
    """Let one client serve a controller of its own: numbers and notes begin anew."""
    controller = start_controller(host)
    assert controller.stdin is not None
    assert controller.stdout is not None
    try:
        ready = json.loads(controller.stdout.readline())
        out, log = folder / "client.npz", folder / "log.npz"
        before = _ask(controller, "status")
        subprocess.run(
            [sys.executable, __file__, "--client", name, "--host", host, "--out", str(out), "--seconds", str(seconds)],
            check=True,
        )
        after = _ask(controller, "status")
        _ask(controller, "latency_log", path=str(log))
        with np.load(out) as client_file, np.load(log) as log_file:
            found = judge(client_file["notes"], client_file["late_s"], log_file)
            found["own_status"] = json.loads(str(client_file["status"]))
    finally:
        controller.stdin.close()
        controller.wait(10)
    found["controller_late_ticks"] = after["late_ticks"] - before["late_ticks"]
    return found | {"controller_realtime": ready["realtime"]}


def _ask(controller: subprocess.Popen[str], action: str, **more: Any) -> dict[str, Any]:
    assert controller.stdin is not None
    assert controller.stdout is not None
    controller.stdin.write(json.dumps({"do": action, **more}) + "\n")
    controller.stdin.flush()
    return dict(json.loads(controller.stdout.readline()))


def show(result: dict[str, Any]) -> None:
    print(
        f"{result['seconds']:g} s per client at 500 Hz; load before {result['load_before']:.2f}; controller with real-time priority: "
        f"{result['controller_realtime']}"
    )
    head = ("client", "ticks", "late", "never", "share %", "p50 ms", "p99 ms", "p99.9", "max")
    print("  ".join(f"{h:>9s}" for h in head))
    for name, one in result["clients"].items():
        delay = one["stamp_to_controller_ms"]
        cells = (
            one["ticks"],
            one["answered_late"],
            one["never_answered"],
            f"{100 * one['late_share']:.3f}",
            *(f"{v:.2f}" for v in delay.values()),
        )
        print(f"{name}\n{'':9s}  " + "  ".join(f"{c!s:>9s}" for c in cells))
        print(
            f"           ticks that the controller itself made late: "
            f"{one['controller_late_ticks']}; share without these and the two before each: "
            f"{100 * one['late_share_sound']:.3f} % of {one['sound_ticks']}"
        )
        own = one["own_status"]
        if own:
            timing, age = own["timing"], own["timing"]["window_age_ms"]
            filter_ms = 1e3 * FILTER_SAMPLES / CONTRACT.rate_hz
            print(
                f"           counted by the loop itself: late {timing['late_ticks']}, missed "
                f"{timing['missed_states']}, share {100 * timing['late_share']:.3f} %; "
                f"real-time: {own['realtime']['priority']}, memory lock: "
                f"{own['realtime']['memory_lock']}"
            )
            print(
                f"           late or unanswered by the controller's notes and not by the loop's: "
                f"{one['not_noticed_by_the_loop']}, of these used in time all the same, or overtaken "
                f"in time by the next one: {one['not_noticed_but_used_in_time']}; the other way round: "
                f"{one['only_in_the_loop']}"
            )
            print(
                f"           sensor age (made windows, modelled): filter {filter_ms:.2f} ms, "
                f"block p50 {age['p50'] - filter_ms:.1f} p99 {age['p99'] - filter_ms:.1f} ms, "
                f"half a window {5e2 * CONTRACT.n_samples / CONTRACT.rate_hz:.1f} ms"
            )
    if "naive" not in result["clients"]:
        return
    naive = result["clients"]["naive"]["late_share"]
    for name in (n for n in CLIENTS[1:] if n in result["clients"]):
        share = max(result["clients"][name]["late_share"], 1e-6)
        print(f"naive / {name}: {naive / share:.0f} times as many (goal: at least 10)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--short", action="store_true", help="the same code with little data")
    parser.add_argument("--host", default="127.0.0.77", help="loopback address with a free 30004")
    parser.add_argument("--only", action="append", choices=CLIENTS, help="one of the clients")
    parser.add_argument("--client", choices=CLIENTS, help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.client:
        client(chosen.client, chosen.host, chosen.seconds, chosen.out)
        return
    load, seconds = os.getloadavg()[0], 3.0 if chosen.short else chosen.seconds
    with tempfile.TemporaryDirectory() as folder:
        result = {"load_before": load} | measure(seconds, chosen.host, Path(folder), chosen.only or CLIENTS)
    if chosen.json:
        print(json.dumps(result))
    else:
        show(result)


if __name__ == "__main__":
    main()
