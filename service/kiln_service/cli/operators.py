"""`lightkiln workers ...` and `lightkiln token ...`: what operators do."""

from typing import Annotated, Any

import typer
from pydantic import ValidationError
from rich.markup import escape
from rich.table import Table

from kiln_schemas.client import Client
from kiln_schemas.errors import InputError
from kiln_schemas.operators import (
    DAYS,
    GcRequest,
    JobEvent,
    Order,
    Scope,
    SleepSchedule,
    TokenRequest,
    WebhookRequest,
    WorkerView,
)
from kiln_schemas.options import of_options
from kiln_service.cli import options
from kiln_service.cli.output import notices, print_json, results

workers_app = typer.Typer(help="Workers of a farm.", no_args_is_help=True)
token_app = typer.Typer(help="Access tokens of a coordinator.", no_args_is_help=True)

webhook_app = typer.Typer(help="Programs that are told of jobs.", no_args_is_help=True)

Worker = Annotated[str, typer.Argument(metavar="WORKER", help="A worker's id or name.")]


def add_operator_commands(app: typer.Typer) -> None:
    """Add them to the command line."""
    app.add_typer(workers_app, name="workers")
    app.add_typer(token_app, name="token")
    app.add_typer(webhook_app, name="webhook")
    app.command("gc")(collect_garbage)


def collect_garbage(
    days: Annotated[float, typer.Option("--older-than", min=0, metavar="DAYS", help="Since the job ended.")] = 0.0,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would go.")] = False,
    url: options.Url = options.DEFAULT_URL,
    token: options.Token = None,
    data: options.Data = None,
    json: options.Json = False,
) -> None:
    """Free what archived jobs have besides their packages: light fields and the data between tasks."""
    with options.connect(url, token, data) as api:
        report = api.collect_garbage(of_options(GcRequest, {"days": "--days"}, days=days, dry_run=dry_run))
    if json:
        print_json(report)
        return
    for job in report.jobs:
        blobs = f"{job.blob_bytes / 2**20:.1f} MiB of blobs"
        results.print(f"{job.name} ({job.job_id}): {', '.join((*job.stores, blobs))}", markup=False, soft_wrap=True)
    verb = "would be freed" if dry_run else "freed"
    results.print(f"{len(report.jobs)} archived jobs {verb}.", markup=False)


@workers_app.command("list")
def list_workers(
    url: options.Url = options.DEFAULT_URL,
    token: options.Token = None,
    data: options.Data = None,
    json: options.Json = False,
) -> None:
    """Workers that were seen within a week."""
    with options.connect(url, token, data) as api:
        views = api.workers()
    if json:
        print_json([view.model_dump(mode="json") for view in views])
        return
    table = Table("worker", "name", "state", "task", "kinds", "tags", "threads", "device", "blocked", "seen", box=None)
    for view in views:
        kinds = ",".join(view.kinds)
        blocked = ", ".join(f"{block.kind} of {block.job_id[-8:]}" for block in view.blocks)
        cells = (view.id, view.name, view.state.value, view.task or "", kinds, ",".join(view.tags), str(view.threads))
        table.add_row(*map(escape, (*cells, view.device, blocked)), f"{view.seen:%Y-%m-%d %H:%M:%S}")
    results.print(table)


def _order(order: Order):  # type: ignore[no-untyped-def]  # typer reads the parameters
    def command(
        worker: Worker,
        url: options.Url = options.DEFAULT_URL,
        token: options.Token = None,
        data: options.Data = None,
        json: options.Json = False,
    ) -> None:
        with options.connect(url, token, data) as api:
            found = _named(api, worker)
            for view in found:
                api.order_worker(view.id, order)
        if json:
            print_json({"order": order.value, "workers": [view.id for view in found]})
        else:
            results.print("\n".join(f"{view.name} ({view.id}): {order.value}" for view in found), markup=False)

    return command


workers_app.command("drain", help="Let it finish its task and leave: its process ends.")(_order(Order.DRAIN))
workers_app.command("sleep", help="Let it finish its task and take no other.")(_order(Order.SLEEP))
workers_app.command("wake", help="Let it take tasks again.")(_order(Order.WAKE))


@workers_app.command()
def unblock(
    worker: Worker,
    url: options.Url = options.DEFAULT_URL,
    token: options.Token = None,
    data: options.Data = None,
    json: options.Json = False,
) -> None:
    """Let a worker take tasks of all jobs again, though it failed some."""
    with options.connect(url, token, data) as api:
        found = _named(api, worker)
        for view in found:
            api.unblock_worker(view.id)
    if json:
        print_json({"unblocked": [view.id for view in found]})
    else:
        results.print("\n".join(f"{view.name} ({view.id}): unblocked" for view in found), markup=False)


@workers_app.command()
def schedule(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the workers.")],
    days: Annotated[
        str | None, typer.Option("--days", metavar="DAYS", help="As in mon,tue or mon-fri; all by default.")
    ] = None,
    begins: Annotated[str | None, typer.Option("--from", metavar="HH:MM", help="When they fall asleep.")] = None,
    ends: Annotated[str | None, typer.Option("--to", metavar="HH:MM", help="When they wake up.")] = None,
    timezone: Annotated[str, typer.Option("--timezone", help="As in Europe/Stockholm.")] = "UTC",
    never: Annotated[bool, typer.Option("--never", help="Sleep only when told to.")] = False,
    url: options.Url = options.DEFAULT_URL,
    token: options.Token = None,
    data: options.Data = None,
    json: options.Json = False,
) -> None:
    """Let workers of a name take no tasks at some times of the day."""
    if never == (begins is not None and ends is not None):
        raise InputError("either a span or none is wanted", where="--from", remedy="Give --from and --to, or --never.")
    wanted = None if never else _schedule(days, begins, ends, timezone)
    with options.connect(url, token, data) as api:
        api.set_schedule(name, wanted)
    if json:
        print_json({"worker": name, "schedule": wanted.model_dump(mode="json") if wanted else None})
    elif wanted is None:
        results.print(f"{name}: sleeps only when told to", markup=False)
    else:
        span = f"{wanted.begins:%H:%M} to {wanted.ends:%H:%M} {wanted.timezone}"
        results.print(f"{name}: sleeps {','.join(wanted.days)} from {span}", markup=False)


def _schedule(days: str | None, begins: str | None, ends: str | None, timezone: str) -> SleepSchedule:
    """InputError where it is none."""
    first, dash, last = (days or "mon-sun").lower().partition("-")
    if dash and first in DAYS and last in DAYS:
        start, stop = DAYS.index(first), DAYS.index(last)
        chosen = [DAYS[day % 7] for day in range(start, stop + 1 if stop >= start else stop + 8)]
    else:
        chosen = [day.strip() for day in (days or "").lower().split(",")]
    try:
        return SleepSchedule.model_validate({"days": chosen, "begins": begins, "ends": ends, "timezone": timezone})
    except ValidationError as error:
        first_error = error.errors()[0]
        option = {"days": "--days", "begins": "--from", "ends": "--to"}.get(str(first_error["loc"][0]), "--timezone")
        raise InputError(
            f"'{first_error.get('input')}' is refused: {first_error['msg']}",
            where=option,
            remedy="As in --days mon-fri --from 08:00 --to 18:00 --timezone Europe/Stockholm.",
        ) from None


def _named(api: Client, name: str) -> list[WorkerView]:
    """The worker with this id, or those with this name that are not offline."""
    views = api.workers()
    found = [view for view in views if view.id == name] or [
        view for view in views if view.name == name and view.state != "offline"
    ]
    if not found:
        raise InputError(f"no worker '{name}' is there", where="WORKER", remedy="See `lightkiln workers list`.")
    return found


@token_app.command("create")
def create_token(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Who uses it, as events name it.")],
    scope: Annotated[list[Scope], typer.Option("--scope", help="What it allows; may be repeated.")],
    url: options.Url = options.DEFAULT_URL,
    token: options.Token = None,
    data: options.Data = None,
    json: options.Json = False,
) -> None:
    """Make an access token and print it, this once."""
    request = of_options(TokenRequest, {"name": "NAME", "scopes": "--scope"}, name=name, scopes=tuple(scope))
    with options.connect(url, token, data) as api:
        made = api.create_token(request)
    if json:
        print_json(made)
    else:
        results.print(made.token, markup=False)
        notices.print("Keep it: the coordinator knows its hash only.")


@token_app.command("list")
def list_tokens(
    url: options.Url = options.DEFAULT_URL,
    token: options.Token = None,
    data: options.Data = None,
    json: options.Json = False,
) -> None:
    """Tokens that were made, without themselves."""
    with options.connect(url, token, data) as api:
        views = api.tokens()
    if json:
        print_json([view.model_dump(mode="json") for view in views])
        return
    table = Table("name", "scopes", "made", "by", "last used", box=None)
    for view in views:
        used = f"{view.used:%Y-%m-%d %H:%M}" if view.used else "never"
        table.add_row(
            escape(view.name), ", ".join(view.scopes), f"{view.created:%Y-%m-%d %H:%M}", view.created_by, used
        )
    results.print(table)


@token_app.command("revoke")
def revoke_token(
    name: Annotated[str, typer.Argument(metavar="NAME")],
    url: options.Url = options.DEFAULT_URL,
    token: options.Token = None,
    data: options.Data = None,
    json: options.Json = False,
) -> None:
    """Refuse a token from now on."""
    with options.connect(url, token, data) as api:
        api.revoke_token(name)
    if json:
        print_json({"revoked": name})
    else:
        results.print(f"{name}: revoked", markup=False)


@webhook_app.command("add")
def add_webhook(
    target: Annotated[str, typer.Argument(metavar="TARGET", help="The http:// or https:// URL to tell.")],
    event: Annotated[
        list[JobEvent] | None, typer.Option("--event", help="May be repeated; by default however a job ends.")
    ] = None,
    url: options.Url = options.DEFAULT_URL,
    token: options.Token = None,
    data: options.Data = None,
    json: options.Json = False,
) -> None:
    """Tell a URL of jobs, and print the secret that signs what is sent, this once."""
    wanted: dict[str, Any] = {"url": target} | ({"events": tuple(event)} if event else {})
    try:
        request = WebhookRequest.model_validate(wanted)
    except ValidationError:
        raise InputError(
            f"'{target}' is not a URL to tell", where="TARGET", remedy="Write https://HOST/PATH."
        ) from None
    with options.connect(url, token, data) as api:
        made = api.add_webhook(request)
    if json:
        print_json(made)
    else:
        results.print(f"{made.id}\n{made.secret}", markup=False)
        notices.print("The second line is the secret: keep it, it is not told again.")


@webhook_app.command("list")
def list_webhooks(
    url: options.Url = options.DEFAULT_URL,
    token: options.Token = None,
    data: options.Data = None,
    json: options.Json = False,
) -> None:
    """Who is told of what, and how the last telling went."""
    with options.connect(url, token, data) as api:
        views = api.webhooks()
        last = {view.id: next(iter(api.deliveries(view.id)), None) for view in views}
    if json:
        print_json([view.model_dump(mode="json") for view in views])
        return
    table = Table("webhook", "url", "events", "last", box=None)
    for view in views:
        told = last[view.id]
        words = f"{told.event}: {told.outcome} {told.error or told.status or ''}" if told else ""
        table.add_row(view.id, escape(view.url), ", ".join(view.events), escape(words))
    results.print(table)


@webhook_app.command("remove")
def remove_webhook(
    webhook: Annotated[str, typer.Argument(metavar="WEBHOOK", help="Its id.")],
    url: options.Url = options.DEFAULT_URL,
    token: options.Token = None,
    data: options.Data = None,
    json: options.Json = False,
) -> None:
    """Tell it nothing more."""
    with options.connect(url, token, data) as api:
        api.remove_webhook(webhook)
    if json:
        print_json({"removed": webhook})
    else:
        results.print(f"{webhook}: removed", markup=False)
