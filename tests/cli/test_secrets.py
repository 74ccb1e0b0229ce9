"""No secret in what users are asked to send in, nor in what other users of the machine can see."""

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from kiln_schemas.redact import command_of, redacted

TOKEN = "hunter2-correct-horse"

BROKEN = (
    "import sys\n"
    "from kiln_service.cli import main, options\n"
    "from kiln_schemas.client import Client\n"
    "def broken(self, *_, **__):\n"
    "    raise RuntimeError(f'sent {self._http.headers[\"authorization\"]} of {sys.argv} to {self.url}')\n"
    "Client._call = broken\n"
    "main.main()\n"
)
"""The real program with a defect whose message has the worst in it."""


@pytest.mark.parametrize("way", ["option", "option with equals", "variable", "file"])
def test_a_defect_log_holds_no_token(clean_environment: dict[str, str], tmp_path: Path, way: str) -> None:
    arguments, variables = ["status", "--url", f"http://user:{TOKEN}-2@127.0.0.1:9"], {"TMPDIR": str(tmp_path)}
    if way == "option":
        arguments += ["--token", TOKEN]
    elif way == "option with equals":
        arguments += [f"--token={TOKEN}"]
    elif way == "variable":
        variables["LIGHTKILN_TOKEN"] = TOKEN
    else:
        (tmp_path / "token").write_text(TOKEN)
        arguments += ["--data", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, "-c", BROKEN, *arguments], capture_output=True, text=True, env=clean_environment | variables
    )
    assert done.returncode == 1 and "a defect in lightkiln: RuntimeError" in done.stderr
    (log,) = tmp_path.glob("lightkiln-defect-*.log")
    text = log.read_text()
    assert "RuntimeError" in text and "status --url" in text and "in broken" in text
    assert TOKEN not in text + done.stdout + done.stderr
    assert log.stat().st_mode & 0o077 == 0


def test_a_defect_without_a_folder_for_its_log_is_a_sentence(clean_environment: dict[str, str], tmp_path: Path) -> None:
    program = BROKEN.replace("main.main()", "import tempfile; tempfile.tempdir = '/proc/nowhere'; main.main()")
    command = [sys.executable, "-c", program, "status", "--token", TOKEN]
    done = subprocess.run(command, capture_output=True, text=True, env=clean_environment)
    assert done.returncode == 1 and "broken, line" in done.stderr
    assert "Traceback" not in done.stderr and TOKEN not in done.stderr


def test_secrets_are_removed_by_value_and_by_shape() -> None:
    text = (
        "Authorization: Bearer abcdefghij; s3 key AKsecret123; postgresql://me:pa55word@db/kiln; "
        "host=db password=pa55word user=me; password='two words' x; --token here-it-is; proxy http://u:p@proxy:80"
    )
    environment = {"AWS_SECRET_ACCESS_KEY": "AKsecret123", "PATH": "Authorization", "KEYBOARD": "postgresql"}
    shown = redacted(text, environment=environment, arguments=["lightkiln", "status", "--token", "here-it-is"])
    for secret in ("abcdefghij", "AKsecret123", "pa55word", "two words", "here-it-is", "u:p"):
        assert secret not in shown
    for word in ("Authorization", "postgresql://", "@db/kiln", "user=me", "@proxy:80"):
        assert word in shown


def test_a_command_line_is_told_without_values() -> None:
    line = [
        "/x/lightkiln",
        "webhook",
        "add",
        "https://hooks.invalid/SECRET",
        "--token=T",
        "--url",
        "http://u:p@h",
        "-f",
    ]
    assert command_of(line) == "webhook add --token --url -f"


def visible(pid: int) -> str:
    return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()


@pytest.mark.parametrize(
    ("arguments", "module"),
    [
        (["worker", "--token", TOKEN, "--url", "http://127.0.0.1:9", "--kinds", "fit"], "kiln_workers"),
        (["serve", "--data", "d", "--database", f"postgresql://me:{TOKEN}@127.0.0.1:9/kiln"], "kiln_service"),
    ],
)
def test_long_running_commands_show_no_secret_to_ps(
    program: str, clean_environment: dict[str, str], tmp_path: Path, arguments: list[str], module: str
) -> None:
    with subprocess.Popen(
        [program, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=clean_environment, cwd=tmp_path
    ) as running:
        try:
            while f"-m {module}" not in visible(running.pid):
                assert running.poll() is None
                time.sleep(0.02)
            assert TOKEN not in visible(running.pid)
        finally:
            running.kill()


def test_what_a_configuration_holds_is_not_quoted(lightkiln, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(f'{{"tokens": ["{TOKEN}"], "storage_url": "ftp://{TOKEN}"}}')
    ran = lightkiln("serve", "--data", tmp_path / "d", "--config", tmp_path / "config.json")
    assert ran.code == 3 and re.search("tokens|storage_url", ran.err) and TOKEN not in ran.err
    assert not os.path.lexists(tmp_path / "d" / "token")
