"""A LinuxCNC of its own: in namespaces where nothing listens, nothing is shared, nothing is left."""

from __future__ import annotations

import os
import select
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path

from dtwin.errors import DeviceError, MissingPart
from dtwin.links.opened import OpenAndClose
from dtwin.machines.linuxcnc.configuration import MillFaults, ini_text

_PACKAGES = "linuxcnc-uspace linuxcnc-uspace-dev gcc libc6-dev make iproute2"
_PROGRAMS = {
    "linuxcnc": "linuxcnc-uspace",
    "halcompile": "linuxcnc-uspace-dev",
    "gcc": "gcc libc6-dev",
    "unshare": "util-linux",
    "ip": "iproute2",
}
_COMPONENTS = ("dtwin_plant", "dtwin_correction")
_SYSTEM_PYTHON = "/usr/bin/python3"
_PATH = "/usr/sbin:/usr/bin:/sbin:/bin"
_READY_S = 60.0
# LinuxCNC refuses to be root; inside, its user bears this number, whoever it is outside.
_INSIDE_UID = 1000
_NAMESPACES = (
    "--user",
    f"--map-user={_INSIDE_UID}",
    f"--map-group={_INSIDE_UID}",
    "--keep-caps",
    "--net",
    "--ipc",
    "--mount",
    "--pid",
    "--fork",
    "--kill-child",
    "--mount-proc",
)


def require_linuxcnc() -> None:
    """Check that LinuxCNC and what surrounds it can run here.

    Raises ``MissingPart`` when a program is missing, or the system allows no namespaces.
    """
    for program, package in _PROGRAMS.items():
        if shutil.which(program, path=_PATH) is None:
            raise MissingPart(
                f"{program} is not installed",
                code="linuxcnc.missing",
                where=f"package {package}",
                hint=f"apt-get install --no-install-recommends {_PACKAGES}",
            )
    tried = _quiet(["unshare", *_NAMESPACES, "ip", "link", "set", "lo", "up"])
    if tried.returncode:
        raise MissingPart(
            "this system allows no namespaces, without which LinuxCNC would listen on the network",
            code="linuxcnc.namespaces",
            got=tried.stderr.strip()[:200],
            hint="sysctl kernel.unprivileged_userns_clone=1, or a container that allows unshare",
        )
    modules = _quiet([_SYSTEM_PYTHON, "-s", "-c", "import linuxcnc, hal"])
    if modules.returncode:
        raise MissingPart(
            f"{_SYSTEM_PYTHON} does not load LinuxCNC's modules",
            code="linuxcnc.python",
            got=modules.stderr.strip()[-200:],
            hint="use the distribution's own Python and LinuxCNC packages",
        )


class LinuxcncSession(OpenAndClose):
    """A running LinuxCNC with a simulated machine, and everything that belongs to it.

    ``compensation``: text of a compensation file, by axis.
    ``folder``: its files; gone after ``close``.
    """

    def __init__(
        self, faults: MillFaults | None = None, compensation: Mapping[str, str] | None = None, *, seed: int = 0
    ) -> None:
        self.faults = MillFaults() if faults is None else faults
        self.compensation = dict(compensation or {})
        self.seed = seed
        self.folder = Path()
        self.process: subprocess.Popen[str] | None = None

    @property
    def socket_path(self) -> Path:
        """Where the bridge listens: a file, not a port."""
        return self.folder / "bridge.sock"

    def open(self) -> None:
        """Start it: power on, homed, idle.

        Raises ``MissingPart`` when it is not installed or cannot be contained.
        Raises ``DeviceError`` when it does not come up.
        """
        require_linuxcnc()
        # Sockets have short names: not below DTWIN_HOME.
        self.folder = Path(tempfile.mkdtemp(prefix="dtwin-cnc-"))
        try:
            self._write()
            self._start()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End every process of it at once, and remove its files."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            for stream in (self.process.stdin, self.process.stdout):
                if stream is not None:
                    stream.close()
            self.process = None
        if self.folder.name:
            shutil.rmtree(self.folder, ignore_errors=True)

    def _write(self) -> None:
        package = files("dtwin.machines.linuxcnc")
        components = self.folder / "components"
        components.mkdir()
        for name in ("mill.hal", "prepare.sh", "_bridge.py"):
            (self.folder / name).write_text(package.joinpath(name).read_text(encoding="utf-8"))
        for name in _COMPONENTS:
            source = components / f"{name}.comp"
            source.write_text(package.joinpath(source.name).read_text(encoding="utf-8"))
            built = _quiet(["halcompile", "--compile", source.name], cwd=components)
            if built.returncode:
                raise MissingPart(
                    f"halcompile does not compile {source.name}",
                    code="linuxcnc.halcompile",
                    got=(built.stderr or built.stdout).strip()[-300:],
                    hint=f"apt-get install --no-install-recommends {_PACKAGES}",
                )
        for axis, text in self.compensation.items():
            (self.folder / f"{axis.lower()}.comp").write_text(text)
        named = {axis: f"{axis.lower()}.comp" for axis in self.compensation}
        (self.folder / "mill.ini").write_text(ini_text(named))
        (self.folder / "faults.hal").write_text("\n".join(self.faults.hal_lines(self.seed)) + "\n")
        (self.folder / "mill.tbl").write_text("T1 P1 D6 Z0 ;\n")
        display = self.folder / "no_display.sh"
        display.write_text("#!/bin/sh\nexec sleep infinity\n")
        display.chmod(0o755)

    def _start(self) -> None:
        self.process = subprocess.Popen(
            ["unshare", *_NAMESPACES, "sh", "prepare.sh", _SYSTEM_PYTHON, "-s", "_bridge.py"],
            cwd=self.folder,
            env={"PATH": _PATH, "LANG": "C.UTF-8"},
            text=True,
            start_new_session=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        assert self.process.stdout is not None
        ready, _, _ = select.select([self.process.stdout], [], [], _READY_S)
        line = self.process.stdout.readline() if ready else ""
        if '"ready"' not in line:
            log = self.folder / "linuxcnc.log"
            told = log.read_text(errors="replace")[-600:] if log.exists() else ""
            raise DeviceError(
                "LinuxCNC does not come up", code="linuxcnc.start", got=f"{line.strip() or 'silence'} {told}".strip()
            )


def _quiet(command: list[str], cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command,
        cwd=cwd,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PATH": _PATH, "LANG": "C.UTF-8"},
    )
