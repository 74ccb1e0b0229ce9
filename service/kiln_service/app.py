"""The coordinator as an ASGI application.

It keeps nothing in memory that matters: all state is in the database and the blob storage, so any number of
coordinators may serve the same ones, and one that is killed loses nothing that it had answered.
"""

import asyncio
import contextlib
import functools
from collections.abc import AsyncIterator

from fastapi import Depends, FastAPI
from fastapi.openapi.utils import get_openapi
from fastapi.responses import JSONResponse

from kiln_schemas import __version__
from kiln_schemas.errors import InputError
from kiln_schemas.operators import Scope
from kiln_service import dashboard, problems, viewer
from kiln_service.api import blobs as blob_routes
from kiln_service.api import health as health_routes
from kiln_service.api import jobs as job_routes
from kiln_service.api import operators as operator_routes
from kiln_service.api import workers as worker_routes
from kiln_service.api.common import PROBLEM_SCHEMA, Parts, caller, problem_answers
from kiln_service.auth import TokenBook, own_token
from kiln_service.blobs import Blobs
from kiln_service.config import ServiceConfig
from kiln_service.damage import make_again
from kiln_service.db import Database
from kiln_service.db.connection import Timeouts
from kiln_service.db.migrate import migrate
from kiln_service.events import Signals
from kiln_service.maintenance import Maintenance
from kiln_service.metrics import RequestSeconds
from kiln_service.rates import RateLimits
from kiln_service.streams import Streams
from kiln_service.tile_maps import TileMaps
from kiln_service.webhooks import Deliverer
from kiln_service.work import Work


def create_app(config: ServiceConfig) -> FastAPI:
    """The application for a configuration whose `database` is set (`serve.py` starts the embedded one)."""
    config.data.mkdir(parents=True, exist_ok=True, mode=0o700)
    tokens = TokenBook([own_token(config.data), *config.tokens])
    app = FastAPI(
        title="lightkiln",
        version=__version__,
        summary="Distributed bakes of spherical Gaussian light-field textures",
        lifespan=lambda app: _lifespan(app, config, tokens),
        generate_unique_id_function=lambda route: route.name,
        openapi_url=None,
        docs_url=None,
        redoc_url=None,
    )
    for module in (worker_routes, job_routes, blob_routes, operator_routes, health_routes):
        app.include_router(module.router)

    document = functools.cache(lambda: openapi_document(app))

    @app.get("/v1/openapi.json", tags=["health"], dependencies=[Depends(caller(Scope.READ))])
    async def openapi() -> JSONResponse:
        """This interface, as OpenAPI."""
        return JSONResponse(document())

    app.state.request_seconds = RequestSeconds()
    app.state.rates = RateLimits(config.limits.rates)
    app.state.readiness = health_routes.Readiness()
    viewer.install(app)
    dashboard.install(app)
    problems.install(app, tokens, config.limits, dashboard.error_page)
    return app


def openapi_document(app: FastAPI) -> dict[str, object]:
    """The OpenAPI document, with problem documents in place of FastAPI's own validation errors."""
    document = get_openapi(title=app.title, version=app.version, summary=app.summary, routes=app.routes)
    schemas = document["components"]["schemas"]
    for name in ("HTTPValidationError", "ValidationError"):
        schemas.pop(name, None)
    schemas["Problem"] = PROBLEM_SCHEMA
    for path in document["paths"].values():
        for operation in path.values():
            answers = operation["responses"]
            codes = {422} if "422" in answers else set()
            if "requestBody" in operation:
                codes |= {413, 422}
            if "security" in operation:
                codes |= {401, 403, 429, 503}
            documented = {str(code): answer for code, answer in problem_answers(*codes).items()}
            operation["responses"] = dict(sorted((answers | documented).items()))
    return document


@contextlib.asynccontextmanager
async def _lifespan(app: FastAPI, config: ServiceConfig, tokens: TokenBook) -> AsyncIterator[None]:
    """Connect, migrate, run the background work; undo it all at the end."""
    if config.database is None:
        raise InputError("no database is configured", where="database", remedy="Start it with `lightkiln serve`.")
    timing = config.timing
    timeouts = Timeouts(timing.statement_s, timing.lock_s, timing.idle_s, timing.transaction_s)
    async with Database(config.database, config.pool_size, timing.database_s, timeouts) as database:
        await migrate(database)
        signals = Signals(database)
        blobs = Blobs(database, config, functools.partial(make_again, database))
        work = Work(database, config, signals)
        streams = Streams(database, signals, config.timing.poll_s, config.limits.streams)
        app.state.parts = Parts(config, database, blobs, signals, streams, TileMaps(database), work, tokens)
        background = [
            asyncio.create_task(signals.listen(), name="signals"),
            asyncio.create_task(streams.read(), name="streams"),
            asyncio.create_task(Deliverer(database, config.timing).run(), name="webhooks"),
            asyncio.create_task(Maintenance(database, config, work, blobs).run(), name="maintenance"),
        ]
        try:
            yield
        finally:
            signals.stop()
            for task in background:
                task.cancel()
            await asyncio.gather(*background, return_exceptions=True)
