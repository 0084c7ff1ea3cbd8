"""What serving must know of a machine, and where its files lie."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinematics import UR10E
from dtwin.schema import Floats, require_name
from dtwin.serve import _state_limits as state_limits
from dtwin.serve._fields import number, one_of, only_fields
from dtwin.serve.sealed import MACHINE, read_sealed, write_sealed

_CHAINS = {"ur10e": UR10E}
_MACHINE_TYPES = tuple(_CHAINS)


@dataclass(frozen=True)
class MachineGeometry:
    """What serving must know of a machine.

    ``type``: one of ``_MACHINE_TYPES``; it fixes the kinematic chain.
    ``tcp_mm``: tool centre point in the flange frame.
    """

    type: str
    tcp_mm: tuple[float, float, float]

    @property
    def tcp(self) -> Floats:
        """Tool centre point as an array (3,), in mm."""
        return np.array(self.tcp_mm)

    @property
    def largest(self) -> Floats:
        """Largest magnitudes (N,) in a state of this machine."""
        return state_limits.robot(_CHAINS[self.type], self.tcp)


def machine_folder(machine: str, home: Home) -> Path:
    """Return the folder of a machine's bundles.

    Raises ``InputError`` when the machine's name could leave the folder.
    """
    return home.bundles / require_name(machine, "the machine")


def write_machine(machine: str, home: Home, geometry: Mapping[str, Any]) -> Path:
    """Write what serving must know of a machine, and return the file's path.

    ``geometry``: ``type`` and ``tcp_mm`` as in a campaign's ``machine_geometry``; the rest is left out.
    Raises ``InputError`` when type or tool centre point are missing or unusable.
    Raises ``StoreError`` when the file cannot be written.
    """
    known = {name: geometry[name] for name in ("type", "tcp_mm") if name in geometry}
    if isinstance(known.get("tcp_mm"), np.ndarray | tuple):
        known["tcp_mm"] = [float(value) for value in known["tcp_mm"]]
    read = _geometry(known, f"the geometry of {machine}")
    content = {"type": read.type, "tcp_mm": list(read.tcp_mm)}
    return write_sealed(machine_folder(machine, home), MACHINE, content)


def read_machine(machine: str, home: Home) -> MachineGeometry:
    """Return what serving must know of a machine.

    Raises ``InputError`` when the file is missing or malformed.
    Raises ``GateRefusal`` when it is not the one that was written.
    """
    folder = machine_folder(machine, home)
    path = folder / MACHINE
    if not path.is_file():
        raise InputError(
            f"nothing is known of the tool of {machine}",
            code="serve.geometry",
            where=str(path),
            allowed='{"type": "ur10e", "tcp_mm": [0.0, 0.0, 158.3]}',
            hint="dtwin promote writes it from the campaign's machine_geometry",
        )
    return _geometry(read_sealed(folder, MACHINE), str(path))


def _geometry(data: object, where: str) -> MachineGeometry:
    fields = only_fields(data, ("type", "tcp_mm"), where)
    listed = fields["tcp_mm"]
    if not isinstance(listed, list) or len(listed) != 3:
        raise InputError(
            "the tool centre point is not three numbers",
            code="serve.geometry",
            where=where,
            got=repr(listed)[:80],
            allowed="[x, y, z] in mm, in the flange frame",
        )
    x, y, z = (number(value, "tcp_mm") for value in listed)
    return MachineGeometry(one_of(fields["type"], _MACHINE_TYPES, "type"), (x, y, z))
