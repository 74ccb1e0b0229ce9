-- What operators do: access tokens that come and go, orders to workers, and a record of who did it.

CREATE TABLE tokens (
    name text PRIMARY KEY,
    sha256 text NOT NULL UNIQUE,        -- of the token; itself it is nowhere
    scopes text[] NOT NULL,
    created timestamptz NOT NULL DEFAULT now(),
    created_by text NOT NULL,
    used timestamptz                    -- to the minute
);

-- What was done to the coordinator and not to a job (those have `events`).
CREATE TABLE audit (
    id bigint PRIMARY KEY GENERATED ALWAYS AS IDENTITY,
    at timestamptz NOT NULL DEFAULT clock_timestamp(),
    actor text NOT NULL,
    action text NOT NULL,
    target text NOT NULL,
    detail jsonb NOT NULL DEFAULT '{}'
);

CREATE TRIGGER audit_is_append_only BEFORE UPDATE OR DELETE ON audit
    FOR EACH ROW EXECUTE FUNCTION events_are_append_only();

ALTER TABLE workers
    ADD COLUMN orders text NOT NULL DEFAULT 'work' CHECK (orders IN ('work', 'sleep', 'drain'));
