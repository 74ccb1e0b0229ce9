"""A whole comparison, step by step: texels, between targets, solvers, pictures, convergence, and the files.

The files are written after every row, so that what is finished is always there to be looked at; an interruption ends
the steps and writes once more.
"""

import platform
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from kiln_schemas import __version__
from kiln_schemas.camera import Camera
from kiln_schemas.errors import FitFailed
from kiln_workers.compare import page
from kiln_workers.compare.cache import Cache
from kiln_workers.compare.pictures import PictureSettings, Shot, Studio
from kiln_workers.compare.progress import Display
from kiln_workers.compare.resolutions import Rendered, converge, render_resolution
from kiln_workers.compare.result import NAME_CSV, NAME_HTML, NAME_JSON, Comparison, Convergence, ImageScore, as_csv
from kiln_workers.compare.result import Camera as CameraView
from kiln_workers.compare.solve import FOLD_EDGES_DEG, Bench, Solved, kept, solve, texel_to_show
from kiln_workers.compare.subject import Subject
from kiln_workers.compare.targets import BetweenTargets, retraced_difference, trace_targets
from kiln_workers.compare.texels import ChosenTexels, choose_texels
from kiln_workers.compare.warm import warm_start
from kiln_workers.fit.solution import Solver
from kiln_workers.package.files import write_bytes
from kiln_workers.shade.image_files import write_picture

MEMORY_SHARE: Final = 0.5
"""Of the memory, what light fields may take; the rest is for the solvers and for wavefronts."""

SAME_RENDERER: Final = 1e-4
"""log_mse_rel between stored and retraced light fields that is worth a note; one renderer gives 0 on one machine."""


@dataclass(frozen=True)
class Plan:
    """What is asked for."""

    out: Path
    solvers: Mapping[str, Solver]
    network: Solver
    """The solver whose convergence figures 6 and 8 show."""
    lobes: tuple[int, ...]
    resolutions: tuple[int, ...]
    resolution_image_size: int
    warm: str | None
    cameras: Mapping[str, Camera]
    pictures: PictureSettings
    stored: bool
    tiles: int | None
    between: int
    between_factor: float
    memory_bytes: int
    quiet: bool

    def items(self) -> list[tuple[str, int]]:
        """Solver and number of lobes of each row."""
        return [(name, lobes) for name in self.solvers for lobes in self.lobes]


@dataclass
class _Found:
    """What there is so far."""

    subject: Subject
    plan: Plan
    chosen: ChosenTexels
    targets: BetweenTargets
    bench: Bench
    retraced: float
    solved: list[Solved] = field(default_factory=list)
    cameras: list[CameraView] = field(default_factory=list)
    resolutions: list[Convergence] = field(default_factory=list)
    starts: list[Convergence] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    studio: Studio | None = None
    shots: dict[tuple[str, int, str], Shot] = field(default_factory=dict)
    """Shaded pictures by solver, lobes and camera."""

    def result(self, *, complete: bool) -> Comparison:
        subject, field_ = self.subject, self.chosen.field
        return Comparison(
            scene=subject.manifest.job_name,
            scene_hash=subject.manifest.scene_hash,
            store=subject.store.url,
            complete=complete,
            resolution=subject.store.shape,
            image_size=field_.image_size,
            samples=subject.settings.render.samples,
            exposure=field_.exposure,
            texels=len(field_),
            tiles=self.chosen.tiles,
            of_tiles=self.chosen.of_tiles,
            between_points=len(self.targets),
            between_samples=self.targets.samples,
            between_noise=self.targets.noise,
            retraced_log_mse_rel=self.retraced,
            fold_edges_deg=FOLD_EDGES_DEG,
            rows=tuple(one.row for one in self.solved),
            cameras=tuple(self.cameras),
            resolutions=tuple(self.resolutions),
            starts=tuple(self.starts),
            notes=tuple(self.notes),
            versions={
                "lightkiln": __version__,
                "python": platform.python_version(),
                **{name: version(name) for name in ("torch", "numpy", "mitsuba")},
            },
        )

    def write(self, *, complete: bool) -> Comparison:
        """Write JSON, CSV and the page."""
        result = self.result(complete=complete)
        out = self.plan.out
        write_bytes(out / NAME_CSV, as_csv(result.rows).encode())
        views = () if self.studio is None else tuple(self.studio.views)
        texel = page.Texel(self.chosen.field, self.bench.shown)
        shown = page.PageInput(result, texel, tuple(self.solved), views, self.shots)
        write_bytes(out / NAME_HTML, page.render(shown))
        write_bytes(out / NAME_JSON, (result.model_dump_json(indent=2) + "\n").encode())
        return result


def run(subject: Subject, plan: Plan) -> Comparison:
    """Compare; what was found, `complete` or not."""
    cache = Cache(plan.out)
    chosen = choose_texels(subject, plan.tiles, int(MEMORY_SHARE * plan.memory_bytes))
    work = [(name, float(lobes * len(chosen.field))) for name, lobes in plan.items()]
    with Display(work, quiet=plan.quiet) as display:
        found = _begin(subject, plan, chosen, cache, display)
        with _interruptible() as state:
            _pictures_of_cameras(found, cache, display)
            for name, lobes in plan.items():
                _row(found, name, lobes, display)
                found.write(complete=False)
            _convergence(found, cache, display)
    return found.write(complete=not state.interrupted)


@dataclass
class _State:
    interrupted: bool = False


@contextmanager
def _interruptible() -> Iterator[_State]:
    """Ctrl-C ends the block and is remembered."""
    state = _State()
    try:
        yield state
    except KeyboardInterrupt:
        state.interrupted = True


def _begin(subject: Subject, plan: Plan, chosen: ChosenTexels, cache: Cache, display: Display) -> _Found:
    """Texels and targets: what every row needs."""
    display.say(f"{len(chosen.field):,} texels of {chosen.tiles} of {chosen.of_tiles} tiles; tracing between them")
    wavefronts = plan.memory_bytes // 4
    retraced = retraced_difference(subject, chosen, wavefronts)
    targets = trace_targets(
        subject,
        chosen,
        cache,
        count=plan.between,
        factor=plan.between_factor,
        memory_bytes=wavefronts,
        on_progress=_telling(display, "tracing light fields between texels"),
    )
    bench = Bench(subject.manifest.job_name, chosen, targets, texel_to_show(chosen), cache)
    found = _Found(subject, plan, chosen, targets, bench, retraced)
    if retraced > SAME_RENDERER:
        found.notes.append(
            f"Light fields traced again differ from the stored ones by {retraced:.2g} of the error of P = 0: another "
            "version of the renderer, or another kind of machine, baked them. Errors between texels contain that."
        )
    if not chosen.whole:
        found.notes.append(f"Only {chosen.tiles} of {chosen.of_tiles} tiles were taken.")
    return found


def _pictures_of_cameras(found: _Found, cache: Cache, display: Display) -> None:
    """References and what they say of themselves; a note where there can be no pictures."""
    plan = found.plan
    if not plan.cameras:
        return
    if not found.chosen.whole:
        found.notes.append("There are no pictures: they need the lobes of all tiles.")
        return
    found.studio = Studio(found.subject, found.chosen, plan.cameras, plan.pictures, cache, display.say)
    for view in found.studio.views:
        if plan.stored:
            display.say(f"shading camera {view.name} from the stored light fields")
        found.cameras.append(found.studio.described(view, stored=plan.stored))
        write_picture(plan.out / "pictures" / f"{view.name}-reference.png", view.reference.picture, view.white)


def _row(found: _Found, name: str, lobes: int, display: Display) -> None:
    """One solver with one number of lobes, and its pictures."""
    function = found.plan.solvers[name]
    work = float(lobes * len(found.chosen.field))
    display.begin(name, f"{name}, {lobes} lobes")
    solved = kept(found.bench, name, function, lobes)
    fresh = solved is None
    with _failure_noted(found, f"{name}, {lobes} lobes"):
        solved = solved or solve(found.bench, name, function, lobes)
    display.finish(name, work, fresh=fresh)
    if solved is None or any(same.row.solver == name and same.row.lobes == solved.row.lobes for same in found.solved):
        return
    if found.studio is not None and solved.lobes is not None:
        solved = _shade(found, found.studio, solved, display)
    found.solved.append(solved)


def _shade(found: _Found, studio: Studio, solved: Solved, display: Display) -> Solved:
    """The row with its pictures' scores; the pictures are written beside the tables."""
    assert solved.lobes is not None
    row = solved.row
    scores: list[ImageScore] = []
    for view in studio.views:
        display.tell(f"{row.solver}, {row.lobes} lobes: camera {view.name}")
        shot = view.judge(studio.shaded(view, solved.lobes))
        found.shots[row.solver, row.lobes, view.name] = shot
        scores += shot.scores
        name = f"{view.name}-{row.solver}-{row.lobes}.png"
        write_picture(found.plan.out / "pictures" / name, shot.picture, view.white)
    return replace(solved, row=row.model_copy(update={"images": tuple(scores)}))


def _convergence(found: _Found, cache: Cache, display: Display) -> None:
    """Figures 6 and 8, with the first of the numbers of lobes."""
    plan, lobes = found.plan, found.plan.lobes[0]
    for resolution in plan.resolutions:
        display.say(f"light map of {resolution} x {resolution}")
        rendered = render_resolution(
            found.subject,
            resolution,
            plan.resolution_image_size,
            plan.memory_bytes // 4,
            cache,
            _telling(display, f"light map of {resolution} x {resolution}"),
        )
        with _failure_noted(found, f"network, light map of {resolution} x {resolution}"):
            found.resolutions.append(converge(f"{resolution}²", rendered, plan.network, lobes, cache, {}))
        found.write(complete=False)
    if plan.warm is not None:
        shape = found.subject.store.shape
        here = Rendered(shape[0], found.chosen.field, found.subject.settings.render.samples)
        start = warm_start(plan.warm, found.chosen.field.image_size, lobes)
        nothing: Mapping[str, Any] = {}
        for label, options in (("own start", nothing), (f"from {start.label}", start.options)):
            display.say(f"network, {label}")
            with _failure_noted(found, f"network, {label}"):
                found.starts.append(converge(label, here, plan.network, lobes, cache, options))


@contextmanager
def _failure_noted(found: _Found, what: str) -> Iterator[None]:
    """A fit that does not beat P = 0 is a finding and no end of the comparison."""
    try:
        yield
    except FitFailed as error:
        found.notes.append(f"{what}: {error}")


def _telling(display: Display, what: str) -> Callable[[float], None]:
    return lambda done: display.tell(f"{what}, {done:.0%}")
