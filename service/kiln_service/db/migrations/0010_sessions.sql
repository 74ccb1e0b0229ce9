-- Who is signed in to the dashboard. A session stands for a token, so what the token may do is looked up each time.

CREATE TABLE sessions (
    sha256 text PRIMARY KEY,            -- of the cookie's value; itself it is nowhere
    token_sha256 text NOT NULL,
    created timestamptz NOT NULL DEFAULT now(),
    expires timestamptz NOT NULL
);

CREATE INDEX sessions_by_expiry ON sessions (expires);
