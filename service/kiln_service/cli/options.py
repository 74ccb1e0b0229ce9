"""Options that several commands share, and where the coordinator's address and token come from."""

import os
from pathlib import Path
from typing import Annotated, Final

import typer

from kiln_schemas.client import Client
from kiln_schemas.errors import AuthError
from kiln_schemas.files import read_small
from kiln_schemas.logs import LogFormat

DEFAULT_URL: Final = "http://127.0.0.1:8321"
TOKEN_FILE: Final = "token"

Json = Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")]
LogLines = Annotated[LogFormat, typer.Option("--log-format", help="The log on standard error: text, or JSON lines.")]
Url = Annotated[str, typer.Option("--url", envvar="LIGHTKILN_URL", help="The coordinator.")]
Token = Annotated[
    str | None,
    typer.Option(
        "--token", envvar="LIGHTKILN_TOKEN", help="Access token; else it is read from --data.", show_envvar=True
    ),
]
Data = Annotated[
    Path | None,
    typer.Option("--data", envvar="LIGHTKILN_DATA", help="Data folder of a coordinator here: its token file is used."),
]
JobId = Annotated[str, typer.Argument(metavar="JOB", help="The job's id.")]
Preset = Annotated[str, typer.Option("--preset", help="draft, preview or production.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change one setting, e.g. render.samples=64; may be repeated."),
]
Gate = Annotated[
    list[str] | None,
    typer.Option(
        "--gate",
        metavar="NAME=VALUE",
        help="Largest log_mse_rel, visibility_log_mse_rel or flip.CAMERA; may be repeated. Exit code 8 where missed.",
    ),
]
Cameras = Annotated[
    list[str] | None,
    typer.Option(
        "--camera",
        metavar="NAME=CAMERA",
        help="A camera for flip gates: NAME=px,py,pz:tx,ty,tz:fov or NAME=FILE.json; may be repeated.",
    ),
]
Junit = Annotated[
    Path | None, typer.Option("--junit", metavar="FILE", help="Write the gates' results as JUnit XML when it is over.")
]
JobPriority = Annotated[
    int, typer.Option("--priority", min=0, max=100, help="Of two jobs that wait the greater goes first.")
]
Label = Annotated[
    list[str] | None, typer.Option("--label", metavar="KEY=VALUE", help="To find jobs by; may be repeated.")
]
Tag = Annotated[
    list[str] | None,
    typer.Option("--tag", metavar="TAG", help="Only workers with this tag do its tasks; may be repeated."),
]
Environment = Annotated[
    Path | None, typer.Option("--env", metavar="FILE", help="Distant light: an equirectangular HDR or EXR.")
]
EnvironmentScale = Annotated[float, typer.Option("--env-scale", help="Factor on the environment's radiance.")]
EnvironmentRotation = Annotated[
    float,
    typer.Option("--env-rotation", metavar="DEGREES", help="About +Y, counter-clockwise seen from above."),
]


def connect(url: str, token: str | None, data: Path | None, *, patience_s: float = 5.0) -> Client:
    """A client with the token given, or the one in the coordinator's data folder."""
    return Client(url, token or read_token(data), patience_s=patience_s)


def read_token(data: Path | None) -> str:
    """The token of a local coordinator's data folder; AuthError where there is none."""
    remedy = "Pass --token, set LIGHTKILN_TOKEN, or name the coordinator's folder with --data."
    if data is None:
        raise AuthError("no token is given", where="--token", remedy=remedy)
    try:
        return read_small(data / TOKEN_FILE).decode("ascii", "replace").strip()
    except OSError as error:
        where = os.fspath(data / TOKEN_FILE)
        raise AuthError(f"the token cannot be read: {error.strerror}", where=where, remedy=remedy) from None
