-- Jobs, their tasks and what they leave behind. States are written by kiln_service.transitions alone.

CREATE TABLE jobs (
    id text PRIMARY KEY,                -- sorts by time of submission
    name text NOT NULL,
    method text NOT NULL,               -- whose task graph it is (kiln_service.planner)
    state text NOT NULL CHECK (
        state IN ('queued', 'active', 'cancel-requested', 'canceled', 'failed', 'completed')
    ),
    settings jsonb NOT NULL,
    bundle jsonb NOT NULL,
    store_url text NOT NULL,
    notes jsonb NOT NULL DEFAULT '[]',
    error jsonb,
    created timestamptz NOT NULL DEFAULT now(),
    started timestamptz,
    finished timestamptz
);

CREATE INDEX jobs_by_state ON jobs (state, id DESC);

CREATE TABLE workers (
    id text PRIMARY KEY,
    name text NOT NULL,
    kinds text[] NOT NULL,
    memory_bytes bigint NOT NULL,
    threads integer NOT NULL,
    device text NOT NULL,
    version text NOT NULL,
    queue_worker bigint NOT NULL,       -- its row in procrastinate_workers
    registered timestamptz NOT NULL DEFAULT now(),
    seen timestamptz NOT NULL DEFAULT now()
);

CREATE TABLE tasks (
    id text PRIMARY KEY,
    job_id text NOT NULL REFERENCES jobs,
    ordinal integer NOT NULL,           -- order of planning within the job
    kind text NOT NULL CHECK (kind IN ('prepare', 'render', 'fit', 'package')),
    label text NOT NULL,
    state text NOT NULL CHECK (
        state IN ('waiting', 'queued', 'active', 'failed', 'canceled', 'completed')
    ),
    attempt integer NOT NULL DEFAULT 0, -- the fence: grows with every claim
    strikes integer NOT NULL DEFAULT 0, -- attempts that ended badly since the last checkpoint
    spec jsonb NOT NULL,                -- the part of the payload that is the task's own
    result jsonb,
    progress jsonb,
    worker_id text REFERENCES workers,
    checkpoint text,
    error jsonb,
    queue_job bigint,                   -- its row in procrastinate_jobs
    created timestamptz NOT NULL DEFAULT now(),
    started timestamptz,
    finished timestamptz,
    heartbeat timestamptz,
    UNIQUE (job_id, kind, label),
    CHECK ((state = 'completed') = (result IS NOT NULL))
);

CREATE INDEX tasks_by_job ON tasks (job_id, ordinal);
CREATE INDEX tasks_active ON tasks (heartbeat) WHERE state = 'active';
CREATE INDEX tasks_queued ON tasks (queue_job) WHERE state = 'queued';

CREATE TABLE task_logs (
    id bigint PRIMARY KEY GENERATED ALWAYS AS IDENTITY,
    task_id text NOT NULL REFERENCES tasks,
    attempt integer NOT NULL,
    at timestamptz NOT NULL DEFAULT clock_timestamp(),
    lines text NOT NULL
);

CREATE INDEX task_logs_by_task ON task_logs (task_id, id);

-- Written under the job's row lock, so the ids of a job's events grow in the order in which they become visible.
CREATE TABLE events (
    id bigint PRIMARY KEY GENERATED ALWAYS AS IDENTITY,
    at timestamptz NOT NULL DEFAULT clock_timestamp(),
    job_id text NOT NULL REFERENCES jobs,
    task_id text REFERENCES tasks,
    kind text NOT NULL,
    actor text NOT NULL,
    detail jsonb NOT NULL DEFAULT '{}'
);

CREATE INDEX events_by_job ON events (job_id, id);

CREATE FUNCTION events_are_append_only() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    RAISE EXCEPTION 'events are append-only';
END;
$$;

CREATE TRIGGER events_are_append_only BEFORE UPDATE OR DELETE ON events
    FOR EACH ROW EXECUTE FUNCTION events_are_append_only();

-- A row says that the object is whole and durable; an object without a row is nothing.
CREATE TABLE blobs (
    sha256 text PRIMARY KEY,
    size bigint NOT NULL,
    created timestamptz NOT NULL DEFAULT now(),
    touched timestamptz NOT NULL DEFAULT now()
);

-- Who needs a blob; one that nobody needs is collected after a grace period.
CREATE TABLE blob_uses (
    sha256 text NOT NULL REFERENCES blobs,
    owner text NOT NULL,                -- 'job:ID', 'result:TASK', 'checkpoint:TASK'
    PRIMARY KEY (sha256, owner)
);

CREATE INDEX blob_uses_by_owner ON blob_uses (owner);

CREATE TABLE artifacts (
    job_id text NOT NULL REFERENCES jobs,
    name text NOT NULL,
    sha256 text NOT NULL REFERENCES blobs,
    size bigint NOT NULL,
    media_type text NOT NULL,
    PRIMARY KEY (job_id, name)
);
