"""Bearer tokens (RFC 6750): who calls, and what they may do.

The coordinator keeps hashes of tokens and compares digests in constant time. The embedded default has one
token with every scope, in the file `token` of the data folder, readable by its owner only.
"""

import hashlib
import hmac
import os
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from kiln_schemas.errors import AuthError, Forbidden
from kiln_service.config import Scope, TokenEntry

TOKEN_FILE: Final = "token"
OWNER: Final = "owner"


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

    def authenticate(self, header: str | None) -> Principal:
        """The caller with this Authorization header; AuthError where there is none or the token is unknown."""
        if not header:
            raise AuthError(
                "no token was sent",
                where="Authorization",
                remedy="Send `Authorization: Bearer TOKEN` (by default it is in the data folder's file `token`).",
            )
        scheme, _, token = header.partition(" ")
        digest = hashlib.sha256(token.strip().encode()).hexdigest()
        found: TokenEntry | None = None
        for entry in self._entries:  # all of them, so that the time tells nothing
            if hmac.compare_digest(entry.sha256, digest):
                found = entry
        if scheme.lower() != "bearer" or found is None:
            raise AuthError(
                "the token is not known here",
                where="Authorization",
                remedy="Check the token and the coordinator's URL.",
            )
        return Principal(found.name, frozenset(found.scopes))


def own_token(data: Path) -> TokenEntry:
    """The token of the data folder, made at the first start (mode 0600), with every scope."""
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
    digest = hashlib.sha256(path.read_text().strip().encode()).hexdigest()
    return TokenEntry(name=OWNER, sha256=digest, scopes=(Scope.ADMIN,))
