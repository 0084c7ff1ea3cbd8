"""``dtwin record`` and ``dtwin serve --sensors`` with the real clients against our own peers."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_here import command_here
from virtual_daq import VirtualDaq, virtual_daq
from virtual_robot import VirtualRobot, virtual_robot

from dtwin.acquire.signal_files import read_signals
from dtwin.config import home as dtwin_home
from dtwin.features.windows import WindowContract
from dtwin.lake.store import Lake
from dtwin.serve._machine_file import write_machine
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle_file import create_bundle, save_bundle
from dtwin.serve.interface import Input, Output, SafetyLimits
from dtwin.serve.pointer import machine_folder, write_pointer
from studies.machines._daq_sensors import Sensors

pytestmark = pytest.mark.system
PHYSICAL = tuple(f"cDAQ1Mod{m}/ai{n}" for m in (1, 2) for n in range(4))
RATE_HZ = 5120.0


@pytest.fixture
def daq() -> Iterator[VirtualDaq]:
    with virtual_daq() as running:
        yield running


@pytest.fixture
def robot() -> Iterator[VirtualRobot]:
    with virtual_robot("--feed-mm-min=3000") as running:
        yield running


@pytest.fixture
def sensors(daq: VirtualDaq, tmp_path: Path) -> Path:
    return channel_file(tmp_path / "sensors.toml", daq)


def channel_file(path: Path, daq: VirtualDaq) -> Path:
    lines = ["[sensors]", f"rate_hz = {RATE_HZ}", f'grpc_target = "{daq.target}"']
    for n, axis in enumerate("xyz"):
        lines += ["[[channel]]", f'name = "wrist_{axis}_g"', f'input = "cDAQ1Mod1/ai{n}"']
        lines += ["sensitivity_mv_g = 1000.0", "iepe_ma = 2.0"]
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def started(*arguments: str | Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "dtwin", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def dtwin(*arguments: str | Path, code: int = 0) -> Any:
    """What a command printed: its JSON, or the complaint that came with an exit code."""
    process = started(*arguments, *(["--json"] if code == 0 else []))
    out, err = process.communicate(timeout=600)
    assert process.returncode == code, out + err
    assert "Traceback" not in err
    return json.loads(out) if code == 0 else err


def said(*arguments: str | Path, code: int = 0) -> Any:
    """As ``dtwin``, in this process: for commands that talk to no instrument."""
    ended, out, err = command_here(*map(str, arguments), *(["--json"] if code == 0 else []))
    assert ended == code, out + err
    return json.loads(out) if code == 0 else err


def wait_for_samples(stream: Path, n_bytes: int) -> None:
    until = time.monotonic() + 300.0
    while not stream.exists() or stream.stat().st_size < n_bytes:
        assert time.monotonic() < until, "nothing is recorded"
        time.sleep(0.02)


def is_the_truth(stretch: np.ndarray) -> bool:
    truth = Sensors(PHYSICAL).felt_g("cDAQ1Mod1/ai0", 0, len(stretch), RATE_HZ)
    return bool(np.abs(truth - stretch).max() < 1e-6)


def test_a_recorded_run_goes_into_the_lake_with_the_ball_bar_s_file(
    sensors: Path, robot: VirtualRobot, real_recording: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "campaign"
    found = dtwin(
        "record",
        "--sensors",
        sensors,
        "--robot",
        robot.host,
        "--duration",
        "2",
        "--out",
        folder,
        "--reference",
        real_recording,
        "--machine",
        "cobot-a",
        "--set",
        "setup=s7",
    )
    assert (found["run"], found["reference_there"]) == ("r001", True)
    assert [Path(s["file"]).name for s in found["signals"]] == [
        "r001.accelerometers.parquet",
        "r001.controller.parquet",
    ]
    assert all(s["complete"] for s in found["signals"])

    added = said("ingest", folder)["campaigns"][0]["added"]
    assert added == ["r001-ccw", "r001-cw"]
    lake = Lake(dtwin_home().lake)
    row = next(row for row in lake.runs("campaign") if row["run_id"] == "r001-cw")
    assert (row["machine"], row["setup"], row["correction"]) == ("cobot-a", "s7", "")
    # The controller that answered is a virtual one, whatever the machine is called.
    assert lake.campaign("campaign").machine_geometry == {"virtual": True}
    groups = {group.name: group for group in lake.load(row).signals}
    felt, controller = groups["accelerometers"], groups["controller"]
    assert (felt.rate_hz, controller.rate_hz) == (RATE_HZ, 125.0)
    assert felt.n_samples >= 2 * RATE_HZ
    assert is_the_truth(felt.columns["wrist_x_g"])
    seen = np.isfinite(controller.columns["timestamp_s"])
    # A busy computer skips states.
    assert np.count_nonzero(seen) > 50

    refused = said("record", "--sensors", sensors, "--run", "r001", "--out", folder, code=1)
    assert "record.exists" in refused
    toml = folder / "campaign.toml"
    toml.write_text(toml.read_text("utf-8").replace("virtual = true", "virtual = false"), "utf-8")
    refused = dtwin("record", "--robot", robot.host, "--duration", "1", "--out", folder, code=1)
    assert "record.virtual" in refused


def test_what_a_killed_recording_had_is_recovered_by_the_next_one(
    sensors: Path, real_recording: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "campaign"
    killed = started("record", "--sensors", sensors, "--out", folder, "--set", "plane=XY")
    stream = folder / "r001.accelerometers.arrows"
    wait_for_samples(stream, 40_000)
    os.kill(killed.pid, signal.SIGKILL)
    killed.communicate(timeout=300)
    assert stream.exists()

    options = ["--duration", "0.5", "--out", folder]
    # The server keeps the dead client's task, and with it the module, until it is restarted.
    assert "restart the NI gRPC device server" in dtwin("record", "--sensors", sensors, *options, code=4)
    assert not list(folder.glob("*.arrows"))
    with virtual_daq() as restarted:
        other = channel_file(tmp_path / "restarted.toml", restarted)
        found = dtwin("record", "--sensors", other, *options)
    assert found["run"] == "r002"
    assert not list(folder.glob("*.arrows"))
    assert not list(folder.glob("*.intent.json"))
    (group,) = read_signals(folder / "r001.accelerometers.parquet")
    assert group.n_samples >= 1024
    assert is_the_truth(group.columns["wrist_x_g"])

    for run in ("r001", "r002"):
        shutil.copyfile(real_recording, folder / f"{run}.b5r")
    report = said("ingest", folder)["campaigns"][0]
    assert len(report["added"]) == 4
    broken = {f["run"] for f in report["findings"] if f["code"] == "recording.incomplete"}
    assert broken == {"r001-ccw", "r001-cw"}


def test_repair_recovers_a_folder_but_not_from_under_a_recording(sensors: Path, tmp_path: Path) -> None:
    folder = tmp_path / "campaign"
    recording = started("record", "--sensors", sensors, "--duration", "600", "--out", folder)
    wait_for_samples(folder / "r001.accelerometers.arrows", 20_000)
    assert "record.busy" in said("repair", folder, code=1)
    recording.send_signal(signal.SIGINT)
    out, err = recording.communicate(timeout=600)
    assert recording.returncode == 130, err
    assert "dtwin ingest" in out
    assert said("repair", folder)["recovered"] == []

    killed = started("record", "--sensors", sensors, "--out", folder)
    wait_for_samples(folder / "r002.accelerometers.arrows", 20_000)
    os.kill(killed.pid, signal.SIGKILL)
    killed.communicate(timeout=300)
    assert said("repair", folder)["recovered"] == ["r002"]
    assert (folder / "campaign.toml").read_text().count("[[run]]") == 2


def test_a_module_that_goes_ends_the_recording_and_keeps_what_came(
    daq: VirtualDaq, sensors: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "campaign"
    recording = started("record", "--sensors", sensors, "--out", folder)
    wait_for_samples(folder / "r001.accelerometers.arrows", 20_000)
    daq.do("remove", device="cDAQ1Mod1")
    _, err = recording.communicate(timeout=600)
    assert recording.returncode == 4
    assert "daq.removed" in err
    assert f"what came before is kept in {folder}, run r001" in err
    (group,) = read_signals(folder / "r001.accelerometers.parquet")
    assert is_the_truth(group.columns["wrist_x_g"])
    assert 'id = "r001"' in (folder / "campaign.toml").read_text()


@pytest.mark.parametrize(
    ("options", "code"),
    [
        ([], "record.nothing"),
        (["--robot", "127.0.0.1", "--set", "colour=red"], "record.setting"),
        (["--robot", "127.0.0.1", "--set", "radius_mm=wide"], "record.setting"),
        (["--sensors", "missing.toml"], "sensors.unreadable"),
    ],
)
def test_mistakes_are_said_before_anything_is_connected(tmp_path: Path, options: list[str], code: str) -> None:
    assert code in said("record", "--out", tmp_path / "campaign", *options, code=1)
    assert not (tmp_path / "campaign").exists()


def promote_level_model() -> None:
    """A model that answers the level of one accelerometer, for the virtual cobot."""
    g = GraphBuilder()
    made = create_bundle(
        name="level",
        machine="cobot-a",
        model_version=1,
        inputs=[Input("wrist_y_rms_g", "g", "sensor", 80.0, "feature", 0.0, 10.0)],
        outputs=[Output("radial_error_um", "path_radial")],
        window=WindowContract(RATE_HZ, 600, 64, ("wrist_x_g", "wrist_y_g"), ("rms",)),
        tick_graph=g.graph({"radial_error_um": 100.0 * g.input("wrist_y_rms_g")}),
        # A busy host is late now and then, which is not what is tested with this model.
        safety=SafetyLimits(clamp_um=40.0, slew_um_s=5000.0, stale_s=1.0, window_stale_s=2.0),
    )
    home = dtwin_home()
    path = machine_folder("cobot-a", home) / "v1.json"
    save_bundle(made, path)
    write_pointer("cobot-a", home, path, 1, "champion")
    write_machine("cobot-a", home, {"type": "ur10e", "tcp_mm": [0.0, 0.0, 158.3]})


def test_a_model_on_accelerometers_is_served_from_a_channel_file(sensors: Path, robot: VirtualRobot) -> None:
    promote_level_model()
    options = ["serve", "--host", robot.host, "--priority", "0", "--duration", "3"]
    assert "--sensors FILE" in said(*options, code=1)
    for _ in range(5):
        # On a busy host the guard may trip for lateness, as it should; then it is served again.
        out, err = started(*options, "--sensors", sensors, "--json").communicate(timeout=600)
        assert "Traceback" not in err
        found = json.loads(out)
        if found["ended"] != "latched":
            break
    assert found["ended"] == "duration", found
    truth = Sensors(PHYSICAL).felt_g("cDAQ1Mod1/ai1", 0, int(2 * RATE_HZ), RATE_HZ)
    level = 100.0 * np.sqrt(np.mean(truth**2))
    assert found["largest_um"] == pytest.approx(level, rel=0.5)
    assert found["timing"]["window_age_ms"]["max"] > 1000.0 * 40 / RATE_HZ
