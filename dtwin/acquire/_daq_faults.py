"""What NI's client, driver, server and devices report, in one line that a user can act on."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from dtwin.errors import DeviceError, MissingPart

_CODES: dict[int, tuple[str, str, str]] = {
    -200220: (
        "daq.device_absent",
        "no acquisition module of this name is there",
        "check the name in NI MAX or with nilsdev, the cable and the power",
    ),
    -200170: ("daq.channel_absent", "the module has no such channel", "an NI-9234 has ai0 to ai3"),
    -200077: (
        "daq.setting",
        "the module does not offer this setting",
        "check rate, sensitivity and excitation current",
    ),
    -201003: ("daq.removed", "the acquisition module does not answer any more", "plug it in again, then start again"),
    -50103: (
        "daq.busy",
        "the module is used by another program",
        "end the other program; after a killed one restart the NI gRPC device server",
    ),
    -200284: ("daq.silent", "the module delivers no samples", "check the chassis, then start again"),
    -200361: (
        "daq.overflow",
        "the module's own buffer overflowed: the bus is too slow",
        "use a faster port, fewer channels or a lower rate",
    ),
}


@contextlib.contextmanager
def daq_faults(where: str) -> Iterator[None]:
    """Turn the errors of NI's client into ours.

    ``where``: driver or server, for the message.
    """
    try:
        import nidaqmx.errors as ni
    except ImportError as error:
        raise _package_missing("nidaqmx") from error
    try:
        yield
    except ImportError as error:
        raise _package_missing(error.name or "nidaqmx") from error
    except (ni.DaqNotFoundError, ni.DaqNotSupportedError) as error:
        raise MissingPart(
            "the NI-DAQmx driver is not installed",
            code="daq.driver",
            hint="get it from https://www.ni.com/downloads, or give a gRPC target",
        ) from error
    except ni.DaqError as error:
        raise _device_error(where, error.error_code, str(error)) from error
    except ni.RpcError as error:
        raise DeviceError(
            "the NI gRPC device server is gone or refuses",
            code="daq.server_lost",
            where=where,
            got=str(error).splitlines()[0][:200],
            hint="check the server and the network, then start again",
        ) from error


def _device_error(where: str, number: int, text: str) -> DeviceError:
    fallback = ("daq.fault", "the acquisition failed", "look up the number at ni.com")
    code, message, hint = _CODES.get(number, fallback)
    got = f"{text.splitlines()[0][:200]} ({number})"
    return DeviceError(message, code=code, where=where, got=got, hint=hint)


def _package_missing(name: str) -> MissingPart:
    return MissingPart(
        f"the package {name} is not installed", code="daq.package", hint="pip install '.[daq]' in a checkout of dtwin"
    )
