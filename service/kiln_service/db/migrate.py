"""Bring the database to the schema of this version, once, however many coordinators start together.

The migrations are the files `migrations/NNNN_*.sql`, applied in order in one transaction under an advisory
lock. A database that a newer version migrated is refused.
"""

import hashlib
from importlib import resources
from typing import Final

from kiln_schemas.errors import Conflict
from kiln_service.db.database import Database, execute

MIGRATION_LOCK: Final = 0x6B696C6E_0001
"""Advisory lock number: "kiln", 1."""


def migrations() -> list[tuple[int, str, str]]:
    """Number, name and SQL of every migration, in order."""
    folder = resources.files(__package__) / "migrations"
    files = sorted((f for f in folder.iterdir() if f.name.endswith(".sql")), key=lambda f: f.name)
    return [(int(f.name[:4]), f.name, f.read_text(encoding="utf-8")) for f in files]


async def migrate(database: Database) -> list[str]:
    """Apply what is missing; the names of the migrations applied."""
    # Not a `Tx`: a file of several statements cannot be pipelined.
    async with await database.dedicated(patient=True) as connection, connection.transaction():
        await execute(connection, "lock_migrations", lock=MIGRATION_LOCK)
        await execute(connection, "make_migrations_table")
        done = {row["version"]: row async for row in await execute(connection, "list_migrations")}
        known = migrations()
        if done and max(done) > known[-1][0]:
            raise Conflict(
                f"the database has schema {max(done)}, this lightkiln knows {known[-1][0]}",
                where="database",
                remedy="Run the newer lightkiln that migrated it.",
            )
        applied = []
        for version, name, text in known:
            digest = hashlib.sha256(text.encode()).hexdigest()
            if version not in done:
                await connection.execute(text.encode())
                await execute(connection, "record_migration", version=version, name=name, sha256=digest)
                applied.append(name)
            elif done[version]["sha256"] != digest:
                raise Conflict(
                    f"{name} is not the migration that this database has under that number",
                    where="database",
                    remedy="Use the lightkiln version that made the database, or a new database.",
                )
        return applied
