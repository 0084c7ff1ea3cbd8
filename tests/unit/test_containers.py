"""The files of deploy/ against the schemas of Kubernetes, against each other, and against dtwin itself; no daemon is asked."""

from __future__ import annotations

import fnmatch
import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dask.config
import kubernetes_validate
import pytest
import typer
import yaml
from distributed.cli import dask_scheduler, dask_worker
from distributed.security import Security

from dtwin import __version__
from dtwin.cli import app
from dtwin.config import SETTINGS, Home
from dtwin.fleet.run import _require_engine

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
PAGE = (ROOT / "docs" / "how-to" / "containers.md").read_text(encoding="utf-8")
# The oldest and the newest version that the page names.
VERSIONS = ("1.31", "1.37")


def _read(name: str) -> list[dict[str, Any]]:
    return list(yaml.safe_load_all((DEPLOY / "kubernetes" / name).read_text(encoding="utf-8")))


KUSTOMIZATION = _read("kustomization.yaml")[0]
OBJECTS = [found for name in KUSTOMIZATION["resources"] for found in _read(name)]
DOCKERFILE = (DEPLOY / "Dockerfile").read_text(encoding="utf-8").splitlines()


def _of_kind(kind: str) -> dict[str, dict[str, Any]]:
    return {found["metadata"]["name"]: found for found in OBJECTS if found["kind"] == kind}


DEPLOYMENTS, SERVICES, MAPS = _of_kind("Deployment"), _of_kind("Service"), _of_kind("ConfigMap")


def _pod(deployment: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = deployment["spec"]["template"]["spec"]
    return found


def _containers() -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    for deployment in DEPLOYMENTS.values():
        pod = _pod(deployment)
        for container in [*pod.get("initContainers", []), *pod["containers"]]:
            yield pod, container


CONTAINERS = {container["name"]: (pod, container) for pod, container in _containers()}
each_container = pytest.mark.parametrize(("pod", "container"), CONTAINERS.values(), ids=CONTAINERS)


def _environment(container: dict[str, Any]) -> dict[str, str]:
    """Return what a container is told, without secrets."""
    told: dict[str, str] = {}
    for source in container.get("envFrom", []):
        told |= MAPS[source["configMapRef"]["name"]]["data"] if "configMapRef" in source else {}
    return told | {item["name"]: item["value"] for item in container.get("env", [])}


def _secrets(pod: dict[str, Any], container: dict[str, Any]) -> set[str]:
    read = {source["secretRef"]["name"] for source in container.get("envFrom", []) if "secretRef" in source}
    return read | {volume["secret"]["secretName"] for volume in pod["volumes"] if "secret" in volume}


def _parse(words: list[str]) -> None:
    """Read a command line as the program itself does, without running it."""
    if words[:2] in (["dask", "scheduler"], ["dask", "worker"]):
        {"scheduler": dask_scheduler, "worker": dask_worker}[words[1]].main.make_context(words[1], words[2:])
        return
    assert words[0] == "dtwin"
    command: Any = typer.main.get_command(app)
    context, rest = command.make_context("dtwin", words[1:]), words[1:]
    while hasattr(command, "resolve_command"):
        name, command, rest = command.resolve_command(context, rest)
        context = command.make_context(name, list(rest), parent=context)


def _dockerfile(word: str) -> list[str]:
    return [line.removeprefix(f"{word} ") for line in DOCKERFILE if line.startswith(f"{word} ")]


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("found", OBJECTS, ids=lambda o: f"{o['kind']} {o['metadata']['name']}")
def test_every_object_is_what_kubernetes_takes(found: dict[str, Any], version: str) -> None:
    assert kubernetes_validate.validate(found, version, strict=True) == version


def test_a_wrong_word_in_an_object_is_not_taken() -> None:
    wrong = SERVICES["workbench"] | {"spec": {"selectr": {"app": "dtwin"}}}
    with pytest.raises(kubernetes_validate.ValidationError, match="selectr"):
        kubernetes_validate.validate(wrong, VERSIONS[0], strict=True)


def test_every_object_is_of_the_one_namespace_and_every_file_is_listed() -> None:
    assert {found["metadata"].get("namespace") for found in OBJECTS if found["kind"] != "Namespace"} == {"dtwin"}
    assert list(_of_kind("Namespace")) == [KUSTOMIZATION["namespace"]] == ["dtwin"]
    listed = {*KUSTOMIZATION["resources"], "kustomization.yaml"}
    assert {file.name for file in (DEPLOY / "kubernetes").iterdir()} == listed


def test_selectors_find_the_pods_that_they_are_for() -> None:
    labels = {name: found["spec"]["template"]["metadata"]["labels"] for name, found in DEPLOYMENTS.items()}
    for name, found in DEPLOYMENTS.items():
        assert found["spec"]["selector"]["matchLabels"] == labels[name] == {"app": name}
    selectors = [found["spec"]["selector"] for found in SERVICES.values()]
    for policy in _of_kind("NetworkPolicy").values():
        peers = [peer["podSelector"] for rule in policy["spec"].get("ingress", []) for peer in rule["from"]]
        selectors += [s["matchLabels"] for s in [policy["spec"]["podSelector"], *peers] if s]
    assert all(selector in labels.values() for selector in selectors)


def test_ports_of_services_policies_probes_and_commands_agree() -> None:
    ports = {
        name: {port["name"]: port["containerPort"] for c in _pod(found)["containers"] for port in c.get("ports", [])}
        for name, found in DEPLOYMENTS.items()
    }
    for service in SERVICES.values():
        for port in service["spec"]["ports"]:
            assert ports[service["spec"]["selector"]["app"]][port["targetPort"]] == port["port"]
    for policy in _of_kind("NetworkPolicy").values():
        for rule in policy["spec"].get("ingress", []):
            app_name = policy["spec"]["podSelector"]["matchLabels"]["app"]
            assert {port["port"] for port in rule["ports"]} <= set(ports[app_name].values())
    for _, container in CONTAINERS.values():
        own = {port["name"]: port["containerPort"] for port in container.get("ports", [])}
        words = " ".join(container["command"])
        assert all(re.search(rf"(port |:){port}\b", words) for port in own.values())
        probes = [container[key] for key in container if key.endswith("Probe")]
        assert {probe["httpGet"]["port"] for probe in probes if "httpGet" in probe} <= set(own)
        asked = {
            port
            for probe in probes
            for port in re.findall(r"'(\d{4})", " ".join(probe.get("exec", {}).get("command", [])))
        }
        assert asked <= set(re.findall(r"\d{4}", words))
    # What Dask and dtwin are told of the scheduler is the address of its service.
    told = {
        host
        for _, c in CONTAINERS.values()
        for host in re.findall(r"tls://([a-z-]+:\d+)", f"{c['command']} {c.get('env')}")
    }
    assert told == {f"{name}:{SERVICES[name]['spec']['ports'][0]['port']}" for name in ("dask-scheduler",)}


@each_container
def test_what_a_container_reads_is_there(pod: dict[str, Any], container: dict[str, Any]) -> None:
    volumes = {volume["name"]: volume for volume in pod["volumes"]}
    mounts = {mount["name"]: mount for mount in container["volumeMounts"]}
    assert set(mounts) <= set(volumes)
    for volume in volumes.values():
        if "configMap" in volume:
            file = mounts[volume["name"]]["subPath"] if volume["name"] in mounts else "home.toml"
            assert file in MAPS[volume["configMap"]["name"]]["data"]
        if "persistentVolumeClaim" in volume:
            assert volume["persistentVolumeClaim"]["claimName"] in _of_kind("PersistentVolumeClaim")
    # No secret lies here; the page makes each that is named.
    assert not _of_kind("Secret")
    made = set(re.findall(r"create secret generic (\S+)", PAGE))
    assert _secrets(pod, container) <= made
    known = {name for name in _environment(container) if name in SETTINGS or name.startswith("DASK_")}
    assert known == set(_environment(container))


@each_container
def test_a_container_may_do_no_more_than_it_must(pod: dict[str, Any], container: dict[str, Any]) -> None:
    [user] = _dockerfile("USER")
    security = pod["securityContext"]
    assert f"{security['runAsUser']}:{security['runAsGroup']}" == user
    assert security["runAsNonRoot"] is True
    assert security["seccompProfile"] == {"type": "RuntimeDefault"}
    assert pod["automountServiceAccountToken"] is False
    # Else DASK_SCHEDULER_PORT and the like would be settings of Dask.
    assert pod["enableServiceLinks"] is False
    assert container["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }
    assert set(container["resources"]["requests"]) == {"cpu", "memory"}
    assert "memory" in container["resources"]["limits"]
    writable = {mount["mountPath"] for mount in container["volumeMounts"] if not mount.get("readOnly")}
    assert "/tmp" in writable


@each_container
def test_commands_are_commands_that_are_there(pod: dict[str, Any], container: dict[str, Any]) -> None:
    _parse(container["command"])


def test_a_command_or_an_option_that_is_not_there_is_noticed() -> None:
    for wrong in (
        "dtwin up --prefect-prt 4200",
        "dtwin fleet nightli",
        "dask worker tls://a:1 --no-nany",
        "dtwin ui --port x",
    ):
        with pytest.raises(Exception, match=r"(?i)no such|valid integer"):
            _parse(shlex.split(wrong))


def test_commands_of_the_page_are_commands_that_are_there() -> None:
    shown = re.findall(r"(?:-- |dtwin:\S+ )(dtwin .*)", PAGE)
    assert len(shown) >= 3
    for line in shown:
        _parse(shlex.split(line, comments=True))


def test_the_home_of_the_settings_is_read_by_dtwin(tmp_path: Path) -> None:
    [(name, text)] = MAPS["dtwin-home"]["data"].items()
    (tmp_path / name).write_text(text, encoding="utf-8")
    file = Home(tmp_path).file
    assert file.bucket is not None
    assert file.registry.startswith("postgresql://")
    assert file.flows.startswith("postgresql://")
    for _, container in CONTAINERS.values():
        mounted = [mount["mountPath"] for mount in container["volumeMounts"] if mount["name"] == "settings"]
        assert mounted in ([], ["/home/dtwin/.dtwin/home.toml"])
        assert bool(mounted) == (container["name"] != "scheduler")


def test_dask_takes_the_certificates_from_the_settings_and_no_connection_without_them() -> None:
    told = dask.config.collect_env(MAPS["dask-settings"]["data"])
    with dask.config.set(dask.config.merge(dask.config.config, told)):
        security = Security()
        files = {role: security.get_tls_config_for_role(role) for role in ("scheduler", "worker", "client")}
    expected = {"ca_file": "/certificates/ca.crt", "cert": "/certificates/tls.crt", "key": "/certificates/tls.key"}
    assert security.require_encryption is True
    for found in files.values():
        assert expected.items() <= found.items()
    made = PAGE.partition("create secret generic dask-tls")[2].partition("\n")[0]
    assert all(Path(file).name in made for file in expected.values())
    for _, container in CONTAINERS.values():
        assert {m["mountPath"] for m in container["volumeMounts"] if m["name"] == "certificates"} == {"/certificates"}
        if engine := _environment(container).get("DTWIN_ENGINE"):
            assert _require_engine(engine, None).startswith("tls://")


def test_the_image_is_the_one_that_the_dockerfile_builds() -> None:
    [image] = {container["image"] for _, container in CONTAINERS.values()}
    assert image == f"dtwin:{__version__}"
    [renamed] = KUSTOMIZATION["images"]
    assert (renamed["name"], str(renamed["newTag"])) == ("dtwin", __version__)
    assert f"docker build -f deploy/Dockerfile -t {image} ." in PAGE
    assert f"docker build -f deploy/Dockerfile -t {image} ." in DOCKERFILE[0]


def test_what_the_dockerfile_copies_is_there_and_gets_into_the_build() -> None:
    rules = (DEPLOY / "Dockerfile.dockerignore").read_text(encoding="utf-8").split("\n")
    let_in = {rule[1:] for rule in rules if rule.startswith("!")}
    copied = {name for line in _dockerfile("COPY") if "--from" not in line for name in line.split()[:-1]}
    assert "*" in rules
    assert copied == let_in
    assert all((ROOT / name).exists() for name in copied)
    # What the wheel is made of: its packages, what it includes, and what its metadata names.
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    needed = {
        *wheel["packages"],
        *wheel["force-include"],
        project["project"]["readme"],
        *project["project"]["license-files"],
    }
    assert all(any(fnmatch.fnmatch(name, one) or name.startswith(f"{one}/") for one in copied) for name in needed)
    [extra] = re.findall(r"--extra (\w+)", "\n".join(DOCKERFILE))
    assert extra in project["project"]["optional-dependencies"]


def test_the_image_has_no_secret_and_the_home_of_the_manifests() -> None:
    [told] = _dockerfile("ENV")
    names = dict(word.partition("=")[::2] for word in told.split())
    assert {"DTWIN_HOME", "NUMBA_CACHE_DIR"} <= set(names)
    assert not _dockerfile("ARG")
    assert not [name for name in names if re.search("KEY|SECRET|PASSWORD|TOKEN", name)]
    homes = {m["mountPath"] for _, c in CONTAINERS.values() for m in c["volumeMounts"] if m["name"] == "home"}
    assert homes == {names["DTWIN_HOME"]}
