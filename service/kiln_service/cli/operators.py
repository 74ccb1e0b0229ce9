"""`lightkiln workers ...` and `lightkiln token ...`: what operators do."""

from typing import Annotated, Any

import typer
from pydantic import ValidationError
from rich.markup import escape
from rich.table import Table

from kiln_schemas.client import Client
from kiln_schemas.errors import InputError
from kiln_schemas.operators import GcRequest, JobEvent, Order, Scope, TokenRequest, WebhookRequest, WorkerView
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
        report = api.collect_garbage(GcRequest(days=days, dry_run=dry_run))
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
    table = Table("worker", "name", "state", "task", "kinds", "threads", "device", "seen", box=None)
    for view in views:
        kinds = ",".join(view.kinds)
        cells = (view.id, view.name, view.state.value, view.task or "", kinds, str(view.threads), view.device)
        table.add_row(*map(escape, cells), f"{view.seen:%Y-%m-%d %H:%M:%S}")
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
    with options.connect(url, token, data) as api:
        made = api.create_token(TokenRequest(name=name, scopes=tuple(scope)))
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
