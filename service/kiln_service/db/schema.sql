-- Queries of kiln_service.db.migrate.

-- name: lock_migrations
-- Let one coordinator migrate at a time; held until the transaction ends.
SELECT pg_advisory_xact_lock(%(lock)s);

-- name: make_migrations_table
-- The record of applied migrations.
CREATE TABLE IF NOT EXISTS kiln_migrations (
    version integer PRIMARY KEY,
    name text NOT NULL,
    sha256 text NOT NULL,
    applied timestamptz NOT NULL DEFAULT now()
);

-- name: list_migrations
-- What was applied before.
SELECT version, sha256 FROM kiln_migrations;

-- name: record_migration
-- Remember an applied migration.
INSERT INTO kiln_migrations (version, name, sha256) VALUES (%(version)s, %(name)s, %(sha256)s);

-- name: be_patient
-- Let the statements of this transaction, and the pauses between them, take as long as they take.
SELECT set_config('statement_timeout', '0', true), set_config('idle_in_transaction_session_timeout', '0', true);

-- name: ping
-- Whether the database answers and is migrated.
SELECT count(*) AS migrations FROM kiln_migrations;

-- name: try_leadership
-- Take a session lock that one coordinator can hold; released when its connection ends.
SELECT pg_try_advisory_lock(%(lock)s) AS leader;
