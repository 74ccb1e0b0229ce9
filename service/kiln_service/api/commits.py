"""The body of a commit, read in pieces beside the event loop: that of a prepare task may list 65,536 tiles.

FastAPI would check all of them on the loop, in one call during which no other thread runs either, for a good part of a
second. Here tiles are checked some thousands at a time in a thread.
"""

import asyncio
import json
from collections.abc import Callable, Coroutine
from typing import Any, Final

from fastapi import Request, Response
from fastapi.routing import APIRoute
from pydantic import TypeAdapter, ValidationError

from kiln_schemas.tasks import MOST_TILES, Commit, Tile

PIECE: Final = 4096
"""Tiles that are checked at a time."""
_TILES: Final = TypeAdapter(tuple[Tile, ...])


class CommitRoute(APIRoute):
    """A route whose body is a commit."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """The usual one, given a request that reads its body in pieces."""
        handle = super().get_route_handler()

        async def read_and_handle(request: Request) -> Response:
            return await handle(_CommitRequest(request.scope, request.receive))

        return read_and_handle


class _CommitRequest(Request):
    async def json(self) -> Any:
        return await asyncio.to_thread(read_commit, await self.body())


def read_commit(body: bytes) -> Any:
    """The commit, where it has many tiles and no fault; else the JSON, which FastAPI checks. ValueError: no JSON."""
    tree = json.loads(body)
    try:
        tiles = tree["result"]["tiles"]
        if not isinstance(tiles, list) or not PIECE < len(tiles) <= MOST_TILES:
            return tree
        commit = Commit.model_validate(tree | {"result": tree["result"] | {"tiles": []}})
        pieces = [_TILES.validate_python(tiles[start : start + PIECE]) for start in range(0, len(tiles), PIECE)]
    except (KeyError, TypeError, ValidationError):
        return tree
    result = commit.result.model_copy(update={"tiles": tuple(tile for piece in pieces for tile in piece)})
    return commit.model_copy(update={"result": result})
