"""A fleet on the scheduler and the worker of deploy/kubernetes, over TLS; and what of a home a worker needs."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import dask.config
import pytest
import yaml
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from distributed import Client
from fleet_lake import fill
from shared_servers import BUCKET, KEYS, running_store

from dtwin.atomic import write_toml
from dtwin.config import Home, home
from dtwin.errors import InputError
from dtwin.fleet.jobs import DIAGNOSE
from dtwin.fleet.run import run_fleet
from dtwin.home_file import HOME_FILE

pytestmark = pytest.mark.system
MANIFESTS = Path(__file__).parents[2] / "deploy" / "kubernetes"


def _objects(name: str, kind: str) -> list[dict[str, Any]]:
    found = yaml.safe_load_all((MANIFESTS / name).read_text(encoding="utf-8"))
    return [one for one in found if one["kind"] == kind]


def _certificates(folder: Path) -> None:
    """Write a certificate that is its own authority."""
    key, now = ec.generate_private_key(ec.SECP256R1()), datetime.now(UTC)
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "fleet")])
    made = x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
    made = made.not_valid_before(now - timedelta(days=1)).not_valid_after(now + timedelta(days=1))
    whole = made.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)
    form = (serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    folder.mkdir()
    for file, content in {"ca.crt": whole, "tls.crt": whole, "tls.key": key.private_bytes(*form)}.items():
        (folder / file).write_bytes(content)


def _free_ports(count: int) -> list[int]:
    probes = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [probe.getsockname()[1] for probe in probes]
    for probe in probes:
        probe.close()
    return ports


@contextmanager
def _started(folder: Path, settings: dict[str, str]) -> Iterator[str]:
    """Start scheduler and worker by the commands of the manifests, on loopback and free ports."""
    ports = dict(zip(("8786", "8787", "8788", "8789"), map(str, _free_ports(4)), strict=True))
    begun: list[subprocess.Popen[bytes]] = []
    pods = [one["spec"]["template"]["spec"]["containers"][0] for one in _objects("dask.yaml", "Deployment")]
    try:
        for container in pods:
            words = " ".join(container["command"]).replace("dask-scheduler:", "127.0.0.1:").replace(" :", " 127.0.0.1:")
            for shown, free in ports.items():
                words = words.replace(shown, free)
            words = words.replace("/tmp", str(folder))
            command = [sys.executable, "-m", *words.split(), "--host", "127.0.0.1"]
            with (folder / f"{container['name']}.log").open("wb") as log:
                begun.append(
                    subprocess.Popen(
                        command, env=os.environ | settings, cwd=folder, stdout=log, stderr=subprocess.STDOUT
                    )
                )
        until = time.monotonic() + 300.0
        while b"Register worker" not in (folder / "scheduler.log").read_bytes():
            assert time.monotonic() < until, (folder / "scheduler.log").read_text() + (
                folder / "worker.log"
            ).read_text()
            time.sleep(0.1)
        yield f"127.0.0.1:{ports['8786']}"
    finally:
        for process in reversed(begun):
            process.terminate()
            process.wait()


def test_the_scheduler_and_worker_of_the_manifests_work_for_who_has_a_certificate(tmp_path: Path) -> None:
    _certificates(tmp_path / "certificates")
    [told] = [
        one["data"] for one in _objects("settings.yaml", "ConfigMap") if one["metadata"]["name"] == "dask-settings"
    ]
    settings = {name: value.replace("/certificates", str(tmp_path / "certificates")) for name, value in told.items()}
    fill(home(), 3)
    with _started(tmp_path, settings) as address:
        with dask.config.set(dask.config.merge(dask.config.config, dask.config.collect_env(settings))):
            run = run_fleet(home(), DIAGNOSE, on=f"dask+tls://{address}")
        assert (len(run.done), run.failed) == (3, {})
        with pytest.raises(OSError, match=r"(?i)tls|timed out|closed"):
            Client(f"tcp://{address}", timeout=3, set_as_default=False)
    other = Home(tmp_path / "other")
    fill(other, 3)
    assert run_fleet(other, DIAGNOSE, workers=1).done == run.done


def test_a_worker_needs_nothing_of_a_shared_home_but_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in KEYS.items():
        monkeypatch.setenv(name, value)
    with running_store() as store:
        at = {"store": f"s3://{BUCKET}/pods", "endpoint": f"http://127.0.0.1:{store}", "registry": "http://127.0.0.1:9"}
        conductor, worker = Home(tmp_path / "conductor"), Home(tmp_path / "worker")
        for one in (conductor, worker):
            write_toml(one.root / HOME_FILE, at, "the settings")
        fill(conductor, 1)
        [unit] = DIAGNOSE.units(conductor, ())[0]
        assert DIAGNOSE.work(str(worker.root), unit, 0) == DIAGNOSE.work(str(conductor.root), unit, 0)
        (worker.root / HOME_FILE).unlink()
        with pytest.raises(InputError, match="no such campaign"):
            DIAGNOSE.work(str(worker.root), unit, 0)
