-- Who may speak for an attempt, and for a worker.

-- sha256 of the secret that the claim of the running attempt handed out; itself it is nowhere. `worker_name` outlives
-- the worker's registration, which is forgotten when nobody has heard of it for long.
ALTER TABLE tasks
    ADD COLUMN lease_sha256 text,
    ADD COLUMN worker_name text,
    DROP CONSTRAINT tasks_worker_id_fkey;

UPDATE tasks SET worker_name = workers.name FROM workers WHERE workers.id = tasks.worker_id;

-- `owner` is the name of the token that registered it, and nobody's for a worker of an earlier version: it registers
-- again. Blocks and failures (their column `worker`) go by `registrant`. Neither part holds a line feed.
ALTER TABLE workers ADD COLUMN owner text NOT NULL DEFAULT '';
ALTER TABLE workers ADD COLUMN registrant text NOT NULL GENERATED ALWAYS AS (owner || E'\n' || name) STORED;

CREATE INDEX workers_by_owner ON workers (owner, seen);

-- Registrants that are there (seen within `stale_s`) and would be given a job's tasks of a kind.
CREATE OR REPLACE FUNCTION takers(job text, task_kind text, stale_s double precision)
RETURNS SETOF text LANGUAGE sql STABLE AS $$
    SELECT workers.registrant FROM workers JOIN jobs ON jobs.id = job
    WHERE workers.seen > now() - make_interval(secs => stale_s) AND workers.orders = 'work'
      AND task_kind = ANY(workers.kinds) AND jobs.tags <@ workers.tags AND NOT asleep_at(workers.name, now())
      AND NOT EXISTS (
          SELECT FROM blocks
          WHERE blocks.worker = workers.registrant AND blocks.job_id = job AND blocks.kind = task_kind
            AND until > now()
      )
$$;
