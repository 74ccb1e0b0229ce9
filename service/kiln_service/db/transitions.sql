-- The only statements that write states; used by kiln_service.transitions and nobody else.

-- name: insert_job
-- A new job.
INSERT INTO jobs (
    id, name, method, state, settings, bundle, gates, cameras, store_url, priority, labels, tags, submitter,
    idempotency_key, request_sha256
) VALUES (
    %(id)s, %(name)s, %(method)s, 'queued', %(settings)s, %(bundle)s, %(gates)s, %(cameras)s, %(store_url)s,
    %(priority)s, %(labels)s, %(tags)s, %(submitter)s, %(idempotency_key)s, %(request_sha256)s
)
RETURNING *;

-- name: insert_tasks
-- New tasks of a job, given as a JSON array; ordinals continue after those that are there.
INSERT INTO tasks (id, job_id, ordinal, kind, label, state, rank, spec)
SELECT planned.id, %(job_id)s, planned.place + (SELECT count(*) FROM tasks WHERE job_id = %(job_id)s),
       planned.kind, planned.label, planned.state, planned.rank, planned.spec
FROM jsonb_to_recordset(%(tasks)s)
    AS planned (id text, place integer, kind text, label text, state text, rank integer, spec jsonb);

-- name: move_job
-- Move a job, with the times and the error that belong to the move.
UPDATE jobs
SET state = %(after)s,
    outcome = CASE WHEN %(after)s::text = 'archived' THEN outcome WHEN %(final)s THEN %(after)s ELSE NULL END,
    error = CASE WHEN %(after)s::text = 'queued' THEN NULL ELSE COALESCE(%(error)s, error) END,
    started = CASE WHEN %(after)s::text = 'active' THEN COALESCE(started, now()) ELSE started END,
    finished = CASE WHEN %(after)s::text = 'queued' THEN NULL WHEN %(final)s THEN COALESCE(finished, now()) ELSE finished END
WHERE id = %(id)s AND state = %(before)s;

-- name: release_tasks
-- waiting > queued: all tasks of a kind of a job.
UPDATE tasks SET state = 'queued' WHERE job_id = %(job_id)s AND kind = %(kind)s AND state = %(before)s
RETURNING id;

-- name: claim_next
-- queued, soft-failed > active: the task of a locked job that a worker gets next; a new attempt begins.
UPDATE tasks
SET state = 'active', attempt = tasks.attempt + 1, worker_id = %(worker_id)s, worker_name = %(worker_name)s,
    lease_sha256 = %(lease_sha256)s, progress = NULL,
    started = now(), heartbeat = now()
FROM next_task(%(worker)s, %(tags)s::text[], %(kinds)s::text[], %(job_id)s, %(stale_s)s) AS next
WHERE tasks.id = next.id
RETURNING tasks.*;

-- name: move_task_requeued
-- active > queued, soft-failed: the attempt ended without a result.
UPDATE tasks
SET state = %(after)s, worker_id = NULL, progress = NULL, started = NULL, heartbeat = NULL,
    strikes = strikes + %(strikes)s
WHERE id = %(id)s AND state = %(before)s;

-- name: move_task_completed
-- active > completed: the attempt's result is the task's.
UPDATE tasks
SET state = 'completed', result = %(result)s, finished = now(), heartbeat = NULL
WHERE id = %(id)s AND state = %(before)s;

-- name: move_task_ended
-- > failed or canceled.
UPDATE tasks
SET state = %(after)s, error = %(error)s, finished = now(), heartbeat = NULL
WHERE id = %(id)s AND state = %(before)s;

-- name: cancel_idle_tasks
-- waiting, queued, soft-failed > canceled: all tasks of a job that no worker has.
UPDATE tasks
SET state = 'canceled', finished = now()
WHERE job_id = %(job_id)s AND state = ANY(%(before)s)
RETURNING id, checkpoint;

-- name: reopen_tasks
-- failed, canceled > queued in the stage that the job has come to, > waiting in later ones; how many.
WITH moved AS (
    UPDATE tasks
    SET state = CASE WHEN kind = %(stage)s THEN 'queued' ELSE 'waiting' END,
        strikes = 0, error = NULL, progress = NULL, worker_id = NULL, checkpoint = NULL,
        started = NULL, finished = NULL, heartbeat = NULL
    WHERE job_id = %(job_id)s AND state = ANY(%(before)s)
    RETURNING id
), forgotten AS (
    DELETE FROM failures USING moved WHERE failures.task_id = moved.id
)
SELECT count(*) AS moved FROM moved;

-- name: redo_tasks
-- > queued, waiting: tasks of some kinds of a job are to be done again, whatever became of them. A choice that is NULL
-- leaves none out; rows and columns choose tasks whose tile or block has texels from a start to before a stop. How many
-- tasks of the kinds there are, how many were chosen, how many of these were in a state to be done again; their kinds.
WITH present AS (
    SELECT id, label, COALESCE(spec -> 'tile', spec -> 'block') AS square FROM tasks
    WHERE job_id = %(job_id)s AND kind = ANY(%(kinds)s)
), chosen AS (
    SELECT id FROM present
    WHERE (%(ids)s::text[] IS NULL OR id = ANY(%(ids)s))
      AND (%(labels)s::text[] IS NULL OR label = ANY(%(labels)s))
      AND (%(row_start)s::int8 IS NULL OR (square ->> 'row')::int8 < %(row_stop)s
           AND (square ->> 'row')::int8 + (square ->> 'size')::int8 > %(row_start)s)
      AND (%(column_start)s::int8 IS NULL OR (square ->> 'column')::int8 < %(column_stop)s
           AND (square ->> 'column')::int8 + (square ->> 'size')::int8 > %(column_start)s)
), moved AS (
    UPDATE tasks
    SET state = %(after)s, result = NULL,
        strikes = 0, error = NULL, progress = NULL, worker_id = NULL, checkpoint = NULL,
        started = NULL, finished = NULL, heartbeat = NULL
    FROM chosen
    WHERE tasks.job_id = %(job_id)s AND tasks.id = chosen.id AND tasks.state = ANY(%(before)s)
    RETURNING tasks.id, tasks.kind
), forgotten AS (
    DELETE FROM failures USING moved WHERE failures.task_id = moved.id
), dropped AS (
    DELETE FROM blob_uses
    WHERE owner IN (SELECT use || ':' || id FROM moved CROSS JOIN unnest(ARRAY['checkpoint', 'result']) AS use)
)
SELECT (SELECT count(*) FROM present) AS total,
       (SELECT count(*) FROM chosen) AS chosen,
       (SELECT count(*) FROM moved) AS moved,
       ARRAY(SELECT DISTINCT kind FROM moved) AS kinds;

-- name: hold_tasks
-- queued, soft-failed, active > waiting: tasks of some kinds of a job, which keep their checkpoints.
UPDATE tasks
SET state = 'waiting', progress = NULL, worker_id = NULL, started = NULL, heartbeat = NULL
WHERE job_id = %(job_id)s AND kind = ANY(%(kinds)s) AND state = ANY(%(before)s);

-- name: forgive_tasks
-- failed, soft-failed > queued where nobody else failed them often enough: a worker's failures count no more.
WITH forgiven AS (
    SELECT task_id, count(*) AS times FROM failures JOIN tasks ON tasks.id = failures.task_id
    WHERE failures.worker = %(worker)s AND tasks.job_id = %(job_id)s AND tasks.kind = %(kind)s
    GROUP BY task_id
), counted AS (
    SELECT task_id, times, (SELECT count(*) FROM failures WHERE failures.task_id = forgiven.task_id) AS of_all
    FROM forgiven
)
UPDATE tasks
SET error = NULL, worker_id = NULL, progress = NULL,
    started = NULL, finished = NULL, heartbeat = NULL,
    state = CASE
        WHEN tasks.state = 'soft-failed' AND counted.of_all > counted.times THEN 'soft-failed' ELSE 'queued'
    END
FROM counted
WHERE tasks.id = counted.task_id
  AND (tasks.state = 'soft-failed' OR (tasks.state = 'failed' AND counted.of_all >= %(max_attempts)s))
RETURNING tasks.id;

-- name: reuse_results
-- waiting > completed: tasks of a kind whose results another job has under the same labels.
UPDATE tasks
SET state = 'completed', result = done.result, started = now(), finished = now()
FROM tasks AS done
WHERE tasks.job_id = %(job_id)s AND tasks.kind = %(kind)s AND tasks.state = %(before)s
  AND done.job_id = %(source)s AND done.kind = tasks.kind AND done.label = tasks.label AND done.state = 'completed';
