"""`lightkiln shade` and `lightkiln reference`: pictures of a package and of a scene, made by the worker's program."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from kiln_service.cli import options
from kiln_service.cli.become import become

Camera = Annotated[
    str,
    typer.Option("--camera", help="px,py,pz:tx,ty,tz:fov or a JSON file; fov is vertical, in degrees."),
]
Out = Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="picture.exr or picture.png.")]
Size = Annotated[str, typer.Option("--size", metavar="WIDTHxHEIGHT", help="Pixels.")]
White = Annotated[
    float | None, typer.Option("--white", help="Luminance that a PNG shows as white; from the picture by default.")
]
Device = Annotated[str, typer.Option("--device", help="auto, cpu or cuda.")]


def add_picture_commands(app: typer.Typer) -> None:
    """Register both commands."""
    app.command()(shade)
    app.command()(reference)


def shade(
    package: Annotated[Path, typer.Argument(metavar="PACKAGE", help="Folder with a manifest.json.")],
    camera: Camera,
    out: Out,
    size: Size = "480x270",
    grid: Annotated[int, typer.Option("--grid", min=1, help="N x N samples a pixel.")] = 2,
    terms: Annotated[
        str | None,
        typer.Option(
            "--terms", help="Some of emission,diffuse,interreflection,environment,unoccluded,background; by commas."
        ),
    ] = None,
    stored: Annotated[
        str | None, typer.Option("--stored", metavar="STORE", help="Take the light from the store, not the lobes.")
    ] = None,
    against: Annotated[
        Path | None, typer.Option("--against", metavar="EXR", help="Print the PSNR against this picture.")
    ] = None,
    white: White = None,
    device: Device = "auto",
    json: options.Json = False,
) -> None:
    """Shade a package as a game would, from its own files."""
    flags = {"--camera": camera, "--out": out, "--size": size, "--grid": grid, "--terms": terms, "--stored": stored}
    flags |= {"--against": against, "--white": white, "--device": device}
    _run("shade", package, flags, json)


def reference(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="glTF, FBX, DAE, OBJ, PLY, STL, OFF or Mitsuba XML.")],
    camera: Camera,
    out: Out,
    env: options.Environment = None,
    env_scale: options.EnvironmentScale = 1.0,
    env_rotation: options.EnvironmentRotation = 0.0,
    size: Size = "480x270",
    samples: Annotated[int, typer.Option("--samples", min=1, help="Paths a pixel, both halves together.")] = 256,
    noise: Annotated[
        float | None,
        typer.Option(
            "--noise",
            min=1e-4,
            max=1.0,
            help="Instead of --samples: paths where they are needed, until the standard error of every 8 x 8 pixels, "
            "as a display shows them (0 black, 1 white), is at most this; 0.02 is clean to the eye.",
        ),
    ] = None,
    max_samples: Annotated[
        int, typer.Option("--max-samples", min=1, help="Paths a pixel at most, with --noise.")
    ] = 16384,
    denoise: Annotated[
        bool,
        typer.Option(
            "--denoise", help="Denoise the picture, for looking. Its file is marked and refused for measuring."
        ),
    ] = False,
    max_depth: Annotated[int, typer.Option("--max-depth", min=1, help="Scattering events of a path.")] = 12,
    seed: Annotated[int, typer.Option("--seed", min=0)] = 0,
    white: White = None,
    device: Device = "auto",
    json: options.Json = False,
) -> None:
    """Path-trace a scene, and state the noise of the picture from two halves."""
    flags = {"--camera": camera, "--out": out, "--size": size, "--samples": samples, "--max-depth": max_depth}
    flags |= {"--noise": noise, "--max-samples": max_samples}
    flags |= {"--env": env, "--env-scale": env_scale, "--env-rotation": env_rotation, "--seed": seed}
    flags |= {"--white": white, "--device": device}
    _run("reference", scene, flags, json, ["--denoise"] if denoise else [])


def _run(command: str, subject: Path, flags: dict[str, object], as_json: bool, switches: Sequence[str] = ()) -> None:
    # One word a flag: a camera's coordinates may begin with a minus sign.
    given = [f"{flag}={value}" for flag, value in flags.items() if value is not None]
    become("kiln_workers", [command, *given, *switches, *(["--json"] if as_json else []), "--", str(subject)])
