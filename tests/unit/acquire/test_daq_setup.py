"""What is wrong with an acquisition before any module is touched."""

from __future__ import annotations

import subprocess
import sys

import pytest

from dtwin.acquire._daq import AccelerometerChannel, AccelerometerTask
from dtwin.errors import DeviceError, InputError, MissingPart

X = AccelerometerChannel("wrist_x_g", "cDAQ1Mod1/ai0")
Y = AccelerometerChannel("wrist_y_g", "cDAQ1Mod1/ai1")


@pytest.mark.parametrize(
    ("channels", "rate_hz", "block_s"),
    [
        ((), 25_600.0, 0.1),
        ((X, X), 25_600.0, 0.1),
        ((X, AccelerometerChannel("wrist_y_g", "cDAQ1Mod1/ai0")), 25_600.0, 0.1),
        ((AccelerometerChannel("wrist", "cDAQ1Mod1/ai0"),), 25_600.0, 0.1),
        ((AccelerometerChannel("x_g", "cDAQ1Mod1/ai0", sensitivity_mv_g=0.0),), 25_600.0, 0.1),
        ((X, Y), 1000.0, 0.1),
        ((X, Y), 102_400.0, 0.1),
        ((X, Y), float("nan"), 0.1),
        ((X, Y), 25_600.0, 0.0),
    ],
)
def test_senseless_set_ups_are_refused(
    channels: tuple[AccelerometerChannel, ...], rate_hz: float, block_s: float
) -> None:
    with pytest.raises(InputError) as caught:
        AccelerometerTask(channels, rate_hz, block_s=block_s)
    assert caught.value.code == "daq.setup"


def test_a_server_that_is_not_there_is_named() -> None:
    daq = AccelerometerTask((X,), 25_600.0, grpc_target="127.0.0.1:1", timeout_s=0.2)
    with pytest.raises(DeviceError) as caught:
        daq.open()
    assert caught.value.code == "daq.server_absent"
    assert "127.0.0.1:1" in caught.value.render()
    daq.close()


def test_without_the_driver_one_line_says_where_to_get_it() -> None:
    daq = AccelerometerTask((X,), 25_600.0)
    try:
        import nidaqmx

        nidaqmx.system.System.local().driver_version  # noqa: B018
    except nidaqmx.errors.Error:
        with pytest.raises(MissingPart) as caught:
            daq.open()
        assert caught.value.code == "daq.driver"
        assert "ni.com" in (caught.value.hint or "")
    else:
        pytest.skip("the NI-DAQmx driver is installed here")


def test_without_the_package_one_line_says_how_to_install_it() -> None:
    code = (
        "import sys; sys.modules['nidaqmx'] = None\n"
        "from dtwin.acquire._daq import AccelerometerChannel as C, AccelerometerTask as T\n"
        "from dtwin.errors import MissingPart\n"
        "try: T((C('x_g', 'Dev1/ai0'),), 25600.0).open()\n"
        "except MissingPart as error: print(error.code, error.hint)\n"
        "print('pyarrow' in sys.modules)\n"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.split("\n")[:2] == ["daq.package pip install '.[daq]' in a checkout of dtwin", "False"]


def test_reading_before_start_is_refused() -> None:
    with pytest.raises(DeviceError) as caught:
        AccelerometerTask((X,), 25_600.0).read_block()
    assert caught.value.code == "daq.stopped"
