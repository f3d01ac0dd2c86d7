"""docker/, read as text since no engine runs here: small, non-root, closed to the network, in step with the tree."""

from __future__ import annotations

import os
import re
import shlex
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pytest
import yaml

from server.settings import Settings
from worker.settings import WorkerSettings

ROOT = Path(__file__).parents[1]
DOCKERFILE = ROOT / "docker/Dockerfile"
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "docker/compose.yml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]


def instructions() -> list[tuple[str, str]]:
    """(INSTRUCTION, arguments) of every line of the Dockerfile, continuation lines joined."""
    lines = [line for line in DOCKERFILE.read_text().splitlines() if not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n", " ", "\n".join(lines))
    pairs = (line.split(None, 1) for line in joined.splitlines() if line.strip())
    return [(name.upper(), rest.strip()) for name, rest in pairs]


def stages() -> list[list[tuple[str, str]]]:
    found: list[list[tuple[str, str]]] = []
    for name, rest in instructions():
        if name == "FROM":
            found.append([])
        if found:
            found[-1].append((name, rest))
    return found


def context_copies() -> list[str]:
    """What is copied out of the build context, not out of another stage."""
    sources = []
    for name, rest in instructions():
        assert name != "ADD", "COPY says what it does"
        if name == "COPY" and "--from=" not in rest:
            sources += shlex.split(rest)[:-1]
    return sources


def test_only_known_instructions() -> None:
    known = {"FROM", "ARG", "RUN", "COPY", "ENV", "WORKDIR", "USER", "ENTRYPOINT", "CMD"}
    assert {name for name, _ in instructions()} <= known


def test_the_image_that_runs_is_the_last_of_two_and_has_no_compiler() -> None:
    build, final = stages()
    assert any("g++" in rest for _, rest in build)
    assert not any(word in rest for name, rest in final if name == "RUN" for word in ("g++", "pip", "curl", "-dev"))


def test_it_runs_as_a_numbered_user_and_never_goes_back_to_root() -> None:
    users = [rest for name, rest in stages()[-1] if name == "USER"]
    assert users == ["10001:10001"]
    assert all(service["user"].split(":")[0] not in ("0", "root") for service in SERVICES.values())


def test_packages_are_installed_without_leftovers() -> None:
    for name, rest in instructions():
        if name == "RUN" and "apt-get install" in rest:
            assert "apt-get update" in rest and "--no-install-recommends" in rest
            assert "rm -rf /var/lib/apt/lists/*" in rest


def test_images_are_pinned() -> None:
    defaults = dict(rest.split("=", 1) for name, rest in instructions() if name == "ARG")
    images = [rest.split()[0] for name, rest in instructions() if name == "FROM"]
    images = [defaults[match[1]] if (match := re.fullmatch(r"\$\{(\w+)\}", image)) else image for image in images]
    for image in [*images, *(service["image"] for service in SERVICES.values())]:
        tag = image.rpartition(":")[2] if ":" in image else ""
        assert re.match(r"\d+\.\d+", tag), image


def test_every_pip_call_is_constrained_and_names_no_index() -> None:
    for name, rest in instructions():
        for call in re.findall(r"pip (?:--python \S+ )?install[^&]*", rest) if name == "RUN" else []:
            assert "-c constraints.txt" in call
    assert "://" not in DOCKERFILE.read_text()


def test_what_is_copied_exists_and_reaches_the_context() -> None:
    ignored, allowed = [], []
    for line in (ROOT / "docker/Dockerfile.dockerignore").read_text().splitlines():
        if line and not line.startswith("#"):
            (allowed if line.startswith("!") else ignored).append(line.lstrip("!"))
    assert ignored[0] == "*"
    for source in context_copies():
        assert (ROOT / source).exists(), source
        assert source in allowed
    assert sorted(allowed) == sorted(context_copies()), "nothing more than the image needs"
    assert any(fnmatch("server/__pycache__", pattern.replace("**/", "*/")) for pattern in ignored)


def test_every_package_of_the_wheel_is_copied() -> None:
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    copied = context_copies()
    for needed in [*project["tool"]["scikit-build"]["wheel"]["packages"], "csrc", "client", "README.md", "LICENSE"]:
        assert needed in copied


def test_the_python_path_is_safe() -> None:
    environment = " ".join(rest for name, rest in stages()[-1] if name == "ENV")
    assert "PYTHONSAFEPATH=1" in environment


@pytest.mark.parametrize("name", sorted(SERVICES))
def test_every_service_is_hardened(name: str) -> None:
    service = SERVICES[name]
    assert service["read_only"] is True and service["init"] is True
    assert service["cap_drop"] == ["ALL"] and "cap_add" not in service and "privileged" not in service
    assert "no-new-privileges:true" in service["security_opt"]
    assert service["pids_limit"] > 0 and service["tmpfs"] and service["healthcheck"]["test"][0] == "CMD"
    assert not any(source.startswith(("/", ".", "~")) for source in service["volumes"]), "named volumes only"
    assert {volume.split(":")[0] for volume in service["volumes"]} <= set(COMPOSE["volumes"])
    assert set(service["networks"]) <= set(COMPOSE["networks"])


def test_only_the_server_is_published_and_on_loopback_only() -> None:
    published = {name: service["ports"] for name, service in SERVICES.items() if "ports" in service}
    assert list(published) == ["server"]
    assert all(port.startswith("127.0.0.1:") for port in published["server"])
    assert COMPOSE["networks"]["queue"] == {"internal": True}
    for name in ("redis", "worker"):
        assert SERVICES[name]["networks"] == ["queue"]


def test_the_environment_is_what_the_programs_read(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith("SPLATCT_")]:
        monkeypatch.delenv(name)
    for service, kind in (("server", Settings), ("worker", WorkerSettings)):
        given = SERVICES[service]["environment"]
        assert {name.removeprefix("SPLATCT_").lower() for name in given} <= set(kind.model_fields)
    for name, value in SERVICES["server"]["environment"].items():
        monkeypatch.setenv(name, value)
    settings = Settings()
    settings.require_door(keys_exist=False)
    assert settings.redis_url.startswith("redis://redis:") and "redis" in SERVICES


def test_server_and_worker_share_their_data() -> None:
    assert SERVICES["server"]["volumes"] == SERVICES["worker"]["volumes"] == ["data:/data"]
    assert SERVICES["server"]["image"] == SERVICES["worker"]["image"] == "splatct:0.1.0"
    assert ("RUN", True) in [(name, "-o 10001 -g 10001 -m 0700 /data" in rest) for name, rest in stages()[-1]]
