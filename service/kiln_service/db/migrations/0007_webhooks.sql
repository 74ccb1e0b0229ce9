-- Who is told of a job's events over HTTP, and what became of each telling.

CREATE TABLE webhooks (
    id text PRIMARY KEY,
    url text NOT NULL,
    events text[] NOT NULL,
    secret text NOT NULL,               -- signs what is sent, so it is kept as it is
    created timestamptz NOT NULL DEFAULT now(),
    created_by text NOT NULL
);

CREATE TABLE deliveries (
    id bigint PRIMARY KEY GENERATED ALWAYS AS IDENTITY,
    webhook_id text NOT NULL REFERENCES webhooks ON DELETE CASCADE,
    event_id bigint NOT NULL REFERENCES events,
    outcome text NOT NULL DEFAULT 'pending' CHECK (outcome IN ('pending', 'delivered', 'failed')),
    attempts integer NOT NULL DEFAULT 0,
    due timestamptz NOT NULL DEFAULT now(),
    status integer,                     -- of the last answer
    error text,
    ended timestamptz,
    UNIQUE (webhook_id, event_id)
);

CREATE INDEX deliveries_due ON deliveries (due) WHERE outcome = 'pending';
