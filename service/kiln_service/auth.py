"""Bearer tokens (RFC 6750): who calls, and what they may do.

The coordinator keeps hashes of tokens and compares digests in constant time. The embedded default has one
token with every scope, in the file `token` of the data folder, readable by its owner only. Others are in the
configuration, or were made by an operator (`operators.create_token`) and are looked up in the database.
"""

import asyncio
import hashlib
import hmac
import os
import re
import secrets
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from psycopg.rows import DictRow

from kiln_schemas.errors import AuthError, Forbidden, InputError
from kiln_schemas.operators import Scope
from kiln_service.config import OWN_TOKEN, TokenEntry
from kiln_service.db import Database

TOKEN_FILE: Final = "token"
OWNER_VARIABLE: Final = "LIGHTKILN_OWNER_TOKEN"
MEMORY_S: Final = 2.0
"""A token of the database is remembered for so long: a revoked one is refused after that at the latest."""
MEMORY_SIZE: Final = 4096


@dataclass(frozen=True)
class Principal:
    """Who calls."""

    name: str
    scopes: frozenset[Scope]

    @property
    def actor(self) -> str:
        """As events name it."""
        return f"client:{self.name}"

    def require(self, scope: Scope) -> None:
        """Raise Forbidden unless the token has the scope."""
        if not self.scopes & {scope, Scope.ADMIN}:
            raise Forbidden(
                f"the token '{self.name}' has no scope '{scope}'",
                where="Authorization",
                remedy="Use a token with that scope.",
            )


class TokenBook:
    """All tokens that are accepted."""

    def __init__(self, entries: Sequence[TokenEntry]) -> None:
        self._entries = tuple(entries)
        self._remembered: dict[str, tuple[Principal, float]] = {}
        self._lookups = Lookups()

    async def session_token(self, cookie: str, database: Database) -> str | None:
        """The sha256 of the token that a session's cookie stands for; None where there is no such session."""
        row = await self._lookups.find("find_sessions", digest_of(cookie), database)
        return None if row is None else str(row["token_sha256"])

    async def authenticate(self, header: str | None, database: Database) -> Principal:
        """The caller with this Authorization header; AuthError where there is none or the token is unknown."""
        if not header:
            raise AuthError(
                "no token was sent",
                where="Authorization",
                remedy="Send `Authorization: Bearer TOKEN` (by default it is in the data folder's file `token`).",
            )
        scheme, _, token = header.partition(" ")
        known = scheme.lower() == "bearer"
        principal = await self.find(digest_of(token.strip()), database) if known else None
        if principal is None:
            raise AuthError(
                "the token is not known here",
                where="Authorization",
                remedy="Check the token and the coordinator's URL.",
            )
        return principal

    async def find(self, digest: str, database: Database) -> Principal | None:
        """Whose token has this sha256."""
        found: TokenEntry | None = None
        for entry in self._entries:  # all of them, so that the time tells nothing
            if hmac.compare_digest(entry.sha256, digest):
                found = entry
        if found is not None:
            return Principal(found.name, frozenset(found.scopes))
        return await self._stored(digest, database)

    async def _stored(self, digest: str, database: Database) -> Principal | None:
        """Whose token of the database has this hash, as of MEMORY_S ago or later."""
        now = time.monotonic()
        principal, until = self._remembered.get(digest, (None, 0.0))
        if principal is not None and now < until:
            return principal
        self._remembered.pop(digest, None)
        row = await self._lookups.find("find_tokens", digest, database)
        if row is None:
            return None
        principal = Principal(row["name"], frozenset(Scope(scope) for scope in row["scopes"]))
        if len(self._remembered) >= MEMORY_SIZE:
            self._remembered.clear()
        self._remembered[digest] = principal, now + MEMORY_S
        return principal


class Lookups:
    """Finds rows by hash. Whatever is asked for while a query runs is looked up together by the next one.

    So guesses, however many come in, cost one connection and one indexed query at a time, and the holder of a valid
    token waits for two queries at most.
    """

    def __init__(self) -> None:
        self._turns: defaultdict[str, asyncio.Lock] = defaultdict(asyncio.Lock)
        self._waiting: defaultdict[str, dict[str, asyncio.Future[DictRow | None]]] = defaultdict(dict)

    async def find(self, query: str, digest: str, database: Database) -> DictRow | None:
        """The row of this hash, or None. `query` takes `hashes` and gives rows with a column `sha256`."""
        waiting = self._waiting[query]
        answer = waiting.setdefault(digest, asyncio.get_running_loop().create_future())
        async with self._turns[query]:
            if self._waiting[query].get(digest) is answer:  # else an earlier turn has taken it along
                batch, self._waiting[query] = self._waiting[query], {}
                answering = asyncio.create_task(self._answer(query, batch, database), name="look-up")
                await asyncio.shield(answering)  # others wait for it too, should this request be given up
        return await asyncio.shield(answer)

    async def _answer(self, query: str, batch: dict[str, asyncio.Future[DictRow | None]], database: Database) -> None:
        try:
            async with database.transaction() as tx:
                rows = {row["sha256"]: row for row in await tx.all(query, hashes=list(batch))}
        except Exception as error:
            for future in batch.values():
                future.set_exception(error)
                future.exception()  # some of those who asked may have left
            return
        for digest, future in batch.items():
            future.set_result(rows.get(digest))


def digest_of(secret: str) -> str:
    """What is kept of a token or cookie: its sha256."""
    return hashlib.sha256(secret.encode()).hexdigest()


def own_token(data: Path) -> TokenEntry:
    """The owner's token, with every scope: given by OWNER_VARIABLE, else in the data folder, where it is made.

    The file has mode 0600. The variable gives several coordinators the same token.
    """
    if given := os.environ.get(OWNER_VARIABLE, ""):
        if not re.fullmatch(r"[\x21-\x7e]{16,}", given):
            raise InputError(
                "the token is refused", where=OWNER_VARIABLE, remedy="Set 16 characters or more, printable, no blanks."
            )
        return _owner(given)
    path = data / TOKEN_FILE
    if not path.exists():
        draft = path.with_name(f".{TOKEN_FILE}.{os.getpid()}")
        draft.unlink(missing_ok=True)
        handle = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(handle, "w") as file:
            file.write(secrets.token_urlsafe(32) + "\n")
            file.flush()
            os.fsync(file.fileno())
        try:
            path.hardlink_to(draft)  # fails where another coordinator was first
        except FileExistsError:
            pass
        finally:
            draft.unlink()
    return _owner(path.read_text().strip())


def _owner(token: str) -> TokenEntry:
    return TokenEntry(name=OWN_TOKEN, sha256=digest_of(token), scopes=(Scope.ADMIN,))
