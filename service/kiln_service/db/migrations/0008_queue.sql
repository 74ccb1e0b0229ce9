-- The tasks are the queue: what procrastinate kept beside them goes. Failures by worker, blocks, tags, sleep schedules.

DO $$
DECLARE
    item record;
BEGIN
    DROP TABLE IF EXISTS procrastinate_periodic_defers, procrastinate_events, procrastinate_jobs, procrastinate_workers
        CASCADE;
    FOR item IN
        SELECT oid::regprocedure AS signature FROM pg_proc
        WHERE proname LIKE 'procrastinate\_%' AND pronamespace = current_schema()::regnamespace
    LOOP
        EXECUTE format('DROP FUNCTION %s CASCADE', item.signature);
    END LOOP;
    DROP TYPE IF EXISTS procrastinate_job_to_defer_v1, procrastinate_job_event_type, procrastinate_job_status CASCADE;
END;
$$;

DROP INDEX tasks_queued;

ALTER TABLE tasks
    DROP COLUMN queue_job,
    ADD COLUMN rank integer NOT NULL DEFAULT 0,     -- greater first: the job's priority, then the stage
    DROP CONSTRAINT tasks_state_check,
    ADD CONSTRAINT tasks_state_check CHECK (
        state IN ('waiting', 'queued', 'soft-failed', 'active', 'failed', 'canceled', 'completed')
    );

UPDATE tasks
SET rank = jobs.priority * 8 + array_position(ARRAY['prepare', 'render', 'fit', 'refine', 'package'], tasks.kind) - 1
FROM jobs
WHERE jobs.id = tasks.job_id;

CREATE INDEX tasks_claimable ON tasks (rank DESC, job_id, ordinal) WHERE state IN ('queued', 'soft-failed');
CREATE INDEX tasks_unfinished ON tasks (job_id, kind) WHERE state <> 'completed';

ALTER TABLE jobs ADD COLUMN tags text[] NOT NULL DEFAULT '{}';      -- only workers that have all of them

ALTER TABLE workers
    DROP COLUMN queue_worker,
    ADD COLUMN tags text[] NOT NULL DEFAULT '{}',
    ADD COLUMN strikes integer NOT NULL DEFAULT 0;  -- attempts that ended badly since its last commit

-- Attempts that ended badly since the task's last checkpoint. Workers are known by name: one that restarts has a new id.
CREATE TABLE failures (
    task_id text NOT NULL REFERENCES tasks,
    attempt integer NOT NULL,
    worker text NOT NULL,
    PRIMARY KEY (task_id, attempt)
);

CREATE INDEX failures_by_worker ON failures (worker);

-- Workers that get no more tasks of a kind of a job for a while.
CREATE TABLE blocks (
    worker text NOT NULL,
    job_id text NOT NULL REFERENCES jobs,
    kind text NOT NULL,
    until timestamptz NOT NULL,
    PRIMARY KEY (worker, job_id, kind)
);

-- When workers take no tasks: from `begins` to `ends` (on the next day where that is earlier) on days 0 (Monday) to 6.
CREATE TABLE schedules (
    worker text PRIMARY KEY,
    days integer[] NOT NULL,
    begins time NOT NULL,
    ends time NOT NULL,
    timezone text NOT NULL
);
