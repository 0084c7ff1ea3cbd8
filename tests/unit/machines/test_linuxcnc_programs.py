"""What LinuxCNC is given and what comes back, without a LinuxCNC."""

from __future__ import annotations

import re
import socket
import sys
import threading
import types
from pathlib import Path

import numpy as np
import pytest

from dtwin.errors import DeviceError, InputError, MissingPart
from dtwin.links.linuxcnc import Bridge
from dtwin.machines.linuxcnc import instance
from dtwin.machines.linuxcnc._bridge import _serve
from dtwin.machines.linuxcnc.circles import Circle, program, read_samples, traces
from dtwin.machines.linuxcnc.configuration import MillFaults, compensation_text, ini_text, read_faults


def test_a_program_runs_each_plane_its_own_way() -> None:
    text = program([Circle("XY", 20, 3000, "CCW"), Circle("ZX", 20, 3000, "CW")])
    first, second = re.findall(r"^G[23] .*$", text, re.M)
    assert first == "G3 X0.000000 Y20.000000 I-20.000000 J0 P2 F3000"
    # The plane's first axis is Z, and its path turns the other way.
    assert second == "G2 Z0.000000 X-20.000000 K-20.000000 I0 P2 F3000"
    assert text.index("G17") < text.index("G18")


@pytest.mark.parametrize(("radius", "feed"), [(1.0, 1000.0), (500.0, 1000.0), (20.0, 2e4), (20.0, 1.0)])
def test_circles_beyond_the_machine_are_refused(radius: float, feed: float) -> None:
    with pytest.raises(InputError) as caught:
        Circle("XY", radius, feed, "CCW")
    assert caught.value.allowed


def sampled(path: Path, lines: list[str]) -> Path:
    path.write_text("\n".join([*lines, ""]), encoding="ascii")
    return path


def row(number: int, circle: int) -> str:
    return " ".join([str(number), f"{circle:.6f}", *["0.000000"] * 11])


def test_missing_samples_are_noticed_in_circles_and_only_there(tmp_path: Path) -> None:
    before = ["overrun", row(7, 0), "overrun", row(20, 0), row(21, 1)]
    assert len(read_samples(sampled(tmp_path / "a", before))) == 2
    for bad in ([row(1, 1), "overrun", row(9, 1)], [row(1, 1), row(3, 1)], [row(1, 1), "2 0.0"], ["overrun"], []):
        with pytest.raises(DeviceError) as caught:
            read_samples(sampled(tmp_path / "b", bad))
        assert caught.value.code == "linuxcnc.samples"


def test_half_a_circle_is_no_run(tmp_path: Path) -> None:
    angle = np.radians(np.linspace(0.0, 200.0, 500))
    rows = np.zeros((500, 13))
    rows[:, 0], rows[:, 1] = np.arange(500), 1.0
    rows[:, 2], rows[:, 3], rows[:, 12] = 20 * np.cos(angle), 20 * np.sin(angle), 50.0
    with pytest.raises(DeviceError, match="as a whole"):
        traces(rows, [Circle("XY", 20.0, 3000.0, "CCW")])


@pytest.mark.parametrize(
    "text",
    [
        "",
        "0 0 0\n",
        "0 0 0\n0 0 0\n",
        "10 0 0\n5 0 0\n",
        "0 0\n1 0\n",
        "0 x 0\n1 0 0\n",
        "0 12.5 0\n1 0 0\n",
        "0 nan 0\n1 0 0\n",
        "".join(f"{i} 0 0\n" for i in range(257)),
    ],
)
def test_a_compensation_file_that_linuxcnc_would_drop_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "x.comp"
    file.write_text(text, encoding="ascii")
    with pytest.raises(InputError) as caught:
        compensation_text(file)
    assert caught.value.code == "linuxcnc.comp"


def test_a_compensated_joint_has_no_other_backlash() -> None:
    text = ini_text({"Y": "y.comp"})
    joint = text.split("[JOINT_1]")[1].split("[AXIS_Z]")[0]
    assert "COMP_FILE = y.comp\nCOMP_FILE_TYPE = 1\nBACKLASH = 0" in joint
    assert text.count("COMP_FILE =") == 1


def test_without_linuxcnc_the_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(instance, "_PATH", "/nowhere")
    with pytest.raises(MissingPart) as caught:
        instance.require_linuxcnc()
    assert "linuxcnc-uspace" in str(caught.value.hint)


def test_faults_are_numbers_that_the_mill_has(tmp_path: Path) -> None:
    file = tmp_path / "truth.toml"
    file.write_text("play_y = 0.01\nnoise = 0\n", encoding="utf-8")
    assert read_faults(file) == MillFaults(play_y=0.01, noise=0.0)
    for text in ("play = 1.0", "play_x = 'a'", "play_x = nan", "position_gain = 1e9", "play_x", "noise = true"):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(InputError) as caught:
            read_faults(file)
        assert caught.value.code == "linuxcnc.faults"


def test_a_pin_that_vanishes_is_told_once_and_no_answer_is_taken_for_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pins = {"correction.cycles": 7}

    def absent(name: str, value: str) -> None:
        raise RuntimeError(f"pin {name} is not there")

    hal = types.SimpleNamespace(set_p=absent, get_value=lambda name: pins[name])
    monkeypatch.setitem(sys.modules, "hal", hal)
    bridge = Bridge(tmp_path / "b")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "b"))
        listener.listen()
        bridge.open()
        server = threading.Thread(target=_serve, args=(listener.accept()[0], None))
        server.start()
        for _ in range(2):
            bridge.tell(do="send", offset_um=[1.0, 2.0, 3.0], sequence=1)
        with pytest.raises(DeviceError, match="did not do") as refused:
            bridge.ask(do="get", pin="correction.cycles")
        assert refused.value.got == "RuntimeError: pin correction.x is not there"
        assert bridge.ask(do="get", pin="correction.cycles") == {"value": 7}
        with pytest.raises(DeviceError, match="did not do"):
            bridge.ask(do="get", pin="correction.latched")
        bridge.close()
        server.join(5)
