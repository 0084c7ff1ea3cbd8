"""What an end of serving that nobody asked for means, and what to do about it."""

from __future__ import annotations

from dtwin.errors import DeviceError, DtwinError, GateRefusal

_DEVICE = {
    "safety_stop": (
        "the machine stopped for safety; the correction was released",
        "clear the stop at the machine, find its cause, then serve again",
    ),
    "latched": (
        "too many faults; the correction was released and stays so",
        "the session's reasons say which, on the Live page of dtwin ui or in its log below DTWIN_HOME/logs; serve again to arm it",
    ),
    "diverged": (
        "the correction did not settle; it was released",
        "dtwin models shows what the gates said of this version",
    ),
}


def fault_of(why: str, where: str, got: str) -> DtwinError | None:
    """Return the fault behind an end, None when it is none.

    ``why``: ``safety_stop``, ``latched``, ``diverged``, ``withdrawn``, or anything else.
    """
    if why == "withdrawn":
        return GateRefusal(
            "the model was withdrawn while it was served; the correction was released",
            code="serve.withdrawn",
            where=where,
            got=got,
            hint="dtwin models shows the history; serve again for the champion of now",
        )
    if why in _DEVICE:
        message, hint = _DEVICE[why]
        return DeviceError(message, code=f"serve.{why}", where=where, got=got, hint=hint)
    return None
