from __future__ import annotations

from pathlib import Path

import pytest

from dtwin.acquire.sensor_file import read_sensors
from dtwin.errors import InputError
from dtwin.features.windows import WindowContract

GOOD = """
[sensors]
rate_hz = 5120.0
grpc_target = "127.0.0.1:31763"
[[channel]]
name = "wrist_x_g"
input = "cDAQ1Mod1/ai0"
sensitivity_mv_g = 1000.0
iepe_ma = 2.0
[[channel]]
name = "base_x_g"
input = "cDAQ1Mod1/ai1"
sensitivity_mv_g = 100.0
iepe_ma = 0
range_g = 10.0
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "sensors.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_channel_file_says_everything_about_the_sensors(tmp_path: Path) -> None:
    setup = read_sensors(written(tmp_path, GOOD))
    assert (setup.rate_hz, setup.grpc_target) == (5120.0, "127.0.0.1:31763")
    wrist, base = setup.channels
    assert (wrist.name, wrist.physical, wrist.sensitivity_mv_g) == ("wrist_x_g", "cDAQ1Mod1/ai0", 1000.0)
    assert (wrist.excitation_a, wrist.range_g, wrist.full_scale_g) == (0.002, None, 5.0)
    assert (base.excitation_a, base.range_g, base.full_scale_g) == (0.0, 10.0, 50.0)


@pytest.mark.parametrize(
    ("old", "new", "code", "said"),
    [
        ("[sensors]", "[sensors", "sensors.unreadable", "Expected"),
        ("rate_hz = 5120.0\n", "", "sensors.setting", "no rate_hz"),
        ("5120.0", "400.0", "sensors.setup", "1651.6 to 51200"),
        ("5120.0", "nan", "sensors.value", "rate_hz"),
        ("5120.0", "true", "sensors.value", "rate_hz"),
        ("iepe_ma = 2.0", "iepe_ma = 2000.0", "sensors.value", "iepe_ma"),
        ("iepe_ma = 2.0\n", "", "sensors.setting", "no iepe_ma"),
        ("sensitivity_mv_g = 1000.0", "sensitivity = 1.0", "sensors.setting", "sensitivity"),
        ("= 1000.0", "= -1", "sensors.value", "sensitivity_mv_g"),
        ("range_g = 10.0", "range_g = 60.0", "sensors.value", "50"),
        ("base_x_g", "wrist_x_g", "sensors.setup", "a name twice"),
        ("base_x_g", "base_x", "sensors.setup", "_g"),
        ("base_x_g", "../base_g", "name.invalid", "../base_g"),
        ("Mod1/ai1", "Mod1/ai0", "sensors.setup", "one input twice"),
        ('"cDAQ1Mod1/ai1"', "7", "sensors.input", "cDAQ1Mod1/ai0"),
        ("127.0.0.1:31763", "31763", "sensors.value", "host:port"),
    ],
)
def test_what_is_wrong_is_said_with_its_place(tmp_path: Path, old: str, new: str, code: str, said: str) -> None:
    assert old in GOOD
    path = written(tmp_path, GOOD.replace(old, new))
    with pytest.raises(InputError) as caught:
        read_sensors(path)
    assert caught.value.code == code
    shown = caught.value.render()
    assert said in shown
    assert code == "name.invalid" or str(path) in shown


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read") as caught:
        read_sensors(tmp_path / "none.toml")
    assert "none.toml" in caught.value.render()


def test_another_rate_or_a_missing_channel_of_the_model_is_refused(tmp_path: Path) -> None:
    setup = read_sensors(written(tmp_path, GOOD))
    with pytest.raises(InputError) as rate:
        setup.windows(WindowContract(1652.0, 150, 15, ("wrist_x_g",), ("rms",)))
    assert rate.value.code == "sensors.rate"
    with pytest.raises(InputError) as channel:
        setup.windows(WindowContract(5120.0, 150, 15, ("wrist_x_g", "wrist_y_g"), ("rms",)))
    assert channel.value.code == "sensors.channels"
    assert "wrist_y_g" in channel.value.render()
