-- Workers of another version, which may not register: what jobs wait for may be one of them.

CREATE TABLE refused_workers (
    owner text NOT NULL,                -- the token's name
    name text NOT NULL,
    version text NOT NULL,
    at timestamptz NOT NULL DEFAULT now(),
    PRIMARY KEY (owner, name)
);
