-- What the dashboard needs: who is signed in, and losses while they come in.

-- A session stands for a token, so what the token may do is looked up each time.
CREATE TABLE sessions (
    sha256 text PRIMARY KEY,            -- of the cookie's value; itself it is nowhere
    token_sha256 text NOT NULL,
    created timestamptz NOT NULL DEFAULT now(),
    expires timestamptz NOT NULL
);

CREATE INDEX sessions_by_expiry ON sessions (expires);

-- The loss that running attempts told, a point a heartbeat; the whole curve is in the result of a task that has completed.
CREATE TABLE losses (
    task_id text NOT NULL REFERENCES tasks,
    step double precision NOT NULL,
    loss double precision NOT NULL,
    PRIMARY KEY (task_id, step)
);
