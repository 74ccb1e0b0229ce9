-- Queries around claiming, running and finishing tasks.

-- name: lock_job
-- A job, locked; every transaction that changes a job or its tasks begins here.
SELECT * FROM jobs WHERE id = %(id)s FOR UPDATE;

-- name: lock_task
-- A task, locked after its job.
SELECT * FROM tasks WHERE id = %(id)s FOR UPDATE;

-- name: job_of_task
-- Which job to lock before a task.
SELECT job_id FROM tasks WHERE id = %(id)s;

-- name: tasks_in_state
-- Tasks of a kind in a state, in the order of planning.
SELECT * FROM tasks WHERE job_id = %(job_id)s AND kind = %(kind)s AND state = %(state)s ORDER BY ordinal FOR UPDATE;

-- name: count_unfinished
-- Tasks of a kind that have not completed.
SELECT count(*) AS tasks FROM tasks WHERE job_id = %(job_id)s AND kind = %(kind)s AND state <> 'completed';

-- name: count_active
-- Tasks of a job that workers have.
SELECT count(*) AS tasks FROM tasks WHERE job_id = %(job_id)s AND state = 'active';

-- name: results_of_kind
-- Results of a job's tasks of a kind, in the order of planning.
SELECT result FROM tasks WHERE job_id = %(job_id)s AND kind = %(kind)s AND state = 'completed' ORDER BY ordinal;

-- name: renders_near
-- Results of a job's render tasks whose tiles have texels from `start` to before `stop` in rows and columns.
SELECT result FROM tasks
WHERE job_id = %(job_id)s AND kind = 'render' AND state = 'completed'
  AND (spec -> 'tile' ->> 'row')::int < %(row_stop)s
  AND (spec -> 'tile' ->> 'row')::int + (spec -> 'tile' ->> 'size')::int > %(row_start)s
  AND (spec -> 'tile' ->> 'column')::int < %(column_stop)s
  AND (spec -> 'tile' ->> 'column')::int + (spec -> 'tile' ->> 'size')::int > %(column_start)s
ORDER BY ordinal;

-- name: prepared_blobs
-- The blobs that a job's prepare task made; its whole result may list thousands of tiles.
SELECT result ->> 'scene' AS scene, result ->> 'texel_map' AS texel_map,
       coalesce(result -> 'between', '[]') AS between
FROM tasks WHERE job_id = %(job_id)s AND kind = 'prepare' AND state = 'completed';

-- name: task_deferred
-- Remember the queue jobs that carry tasks.
UPDATE tasks
SET queue_job = queue.id
FROM procrastinate_jobs AS queue
WHERE queue.id = ANY(%(queue_jobs)s) AND tasks.id = queue.args ->> 'task_id';

-- name: notify_queued
-- Wake the claims that wait.
SELECT pg_notify('kiln_queued', %(kinds)s);

-- name: add_event
-- Append to a job's history, wake who watches it and note whom to tell; the job is locked.
WITH added AS (
    INSERT INTO events (job_id, task_id, kind, actor, detail)
    VALUES (%(job_id)s, %(task_id)s, %(kind)s, %(actor)s, %(detail)s)
    RETURNING id, job_id, kind
), told AS (
    INSERT INTO deliveries (webhook_id, event_id)
    SELECT webhooks.id, added.id FROM added JOIN webhooks ON added.kind = ANY(webhooks.events)
)
SELECT pg_notify('kiln_event', job_id) FROM added;

-- name: insert_worker
-- A worker that registered.
INSERT INTO workers (id, name, kinds, memory_bytes, threads, device, version, queue_worker)
VALUES (%(id)s, %(name)s, %(kinds)s, %(memory_bytes)s, %(threads)s, %(device)s, %(version)s, %(queue_worker)s);

-- name: see_worker
-- A registered worker, seen now.
UPDATE workers SET seen = now() WHERE id = %(id)s RETURNING *;

-- name: beat_task
-- Keep an attempt alive; no row where the attempt is not the task's current one.
UPDATE tasks
SET heartbeat = now(), progress = COALESCE(%(progress)s, progress)
FROM jobs
WHERE tasks.id = %(id)s AND tasks.attempt = %(attempt)s AND tasks.state = 'active' AND jobs.id = tasks.job_id
RETURNING jobs.state AS job_state;

-- name: add_loss
-- Remember a running attempt's loss; one that begins again from a checkpoint tells the same steps anew.
INSERT INTO losses (task_id, step, loss) VALUES (%(task_id)s, %(step)s, %(loss)s)
ON CONFLICT (task_id, step) DO UPDATE SET loss = excluded.loss;

-- name: drop_losses
-- Forget what attempts of a task told.
DELETE FROM losses WHERE task_id = %(task_id)s;

-- name: add_log
-- Lines that an attempt wrote; nothing where the task is unknown.
INSERT INTO task_logs (task_id, attempt, lines)
SELECT id, %(attempt)s, %(lines)s FROM tasks WHERE id = %(task_id)s;

-- name: task_log
-- All lines of a task, oldest first.
SELECT attempt, lines FROM task_logs WHERE task_id = %(task_id)s ORDER BY id;

-- name: last_log
-- The last pieces of a task's log, newest first.
SELECT lines FROM task_logs WHERE task_id = %(task_id)s ORDER BY id DESC LIMIT 20;

-- name: set_checkpoint
-- Publish an attempt's checkpoint: progress was made, so earlier failures count no more.
UPDATE tasks SET checkpoint = %(sha256)s, strikes = 0, heartbeat = now() WHERE id = %(id)s;

-- name: queued_queue_jobs
-- The queue jobs of a job's tasks that no worker has.
SELECT queue_job FROM tasks WHERE job_id = %(job_id)s AND state = 'queued' AND queue_job IS NOT NULL;

-- name: queued_outside_of_queue
-- A job's queued tasks that nothing in the queue will bring to a worker.
SELECT tasks.id, tasks.kind FROM tasks
LEFT JOIN procrastinate_jobs AS queue ON queue.id = tasks.queue_job AND queue.status = 'todo'
WHERE tasks.job_id = %(job_id)s AND tasks.state = 'queued' AND queue.id IS NULL
ORDER BY tasks.ordinal;

-- name: unfinished_kinds
-- Kinds of a job's tasks that have not all completed.
SELECT DISTINCT kind FROM tasks WHERE job_id = %(job_id)s AND state <> 'completed';

-- name: change_job
-- Rank or label a job anew; NULL keeps what there is.
UPDATE jobs
SET priority = COALESCE(%(priority)s, priority), labels = COALESCE(%(labels)s, labels)
WHERE id = %(id)s;

-- name: rank_queue_jobs
-- The same in the queue, for tasks that wait there; the queue's priority is the job's times %(step)s plus its kind's.
UPDATE procrastinate_jobs AS queue
SET priority = %(priority)s * %(step)s + queue.priority - (queue.priority / %(step)s) * %(step)s
FROM tasks
WHERE tasks.job_id = %(job_id)s AND queue.id = tasks.queue_job AND queue.status = 'todo';

-- name: lock_idempotency_key
-- Let one of several identical submissions in at a time; held until the transaction ends.
SELECT pg_advisory_xact_lock(hashtextextended(%(key)s, 0));

-- name: find_submission
-- The job that a submission with this key has made.
SELECT * FROM jobs WHERE submitter = %(submitter)s AND idempotency_key = %(key)s;

-- name: set_render_key
-- What the light fields of a prepared job depend on.
UPDATE jobs SET render_key = %(key)s WHERE id = %(id)s;

-- name: find_renders
-- The newest other job whose light fields are the same and all there, and that has what the descent learns from; it is
-- not archived before this transaction ends.
SELECT jobs.id, jobs.store_url FROM jobs
JOIN tasks AS prepared ON prepared.job_id = jobs.id AND prepared.kind = 'prepare' AND prepared.state = 'completed'
WHERE jobs.render_key = %(key)s AND jobs.id <> %(id)s AND jobs.method = %(method)s AND jobs.state <> 'archived'
  AND (%(between)s::jsonb = '[]' OR COALESCE(prepared.result -> 'between', '[]') = %(between)s)
  AND NOT EXISTS (
      SELECT FROM tasks WHERE tasks.job_id = jobs.id AND tasks.kind = 'render' AND tasks.state <> 'completed'
  )
ORDER BY jobs.id DESC
LIMIT 1
FOR SHARE OF jobs SKIP LOCKED;

-- name: share_renders
-- Read the light fields of another job from now on.
UPDATE jobs SET store_url = %(store_url)s, renders_of = %(source)s WHERE id = %(id)s;

-- name: add_notes
-- Append to what a job tells its user.
UPDATE jobs SET notes = notes || %(notes)s WHERE id = %(id)s;

-- name: set_gate_results
-- What a job's package has of what its gates ask for.
UPDATE jobs SET gate_results = %(results)s WHERE id = %(id)s;

-- name: add_artifact
-- Publish an artifact.
INSERT INTO artifacts (job_id, name, sha256, size, media_type)
VALUES (%(job_id)s, %(name)s, %(sha256)s, %(size)s, %(media_type)s);

-- name: stale_tasks
-- Running tasks whose worker was not heard of for a while, and those that run although their job is over.
SELECT id, job_id FROM tasks
WHERE state = 'active' AND heartbeat < now() - make_interval(secs => %(seconds)s)
ORDER BY heartbeat;

-- name: task_is_stale
-- Whether that is still so, now that the task is locked.
SELECT heartbeat < now() - make_interval(secs => %(seconds)s) AS stale FROM tasks WHERE id = %(id)s;

-- name: queued_without_queue_job
-- Queued tasks of jobs that are not paused, which nothing in the queue will bring to a worker.
SELECT tasks.id, tasks.job_id FROM tasks
JOIN jobs ON jobs.id = tasks.job_id AND jobs.state <> 'paused'
LEFT JOIN procrastinate_jobs AS queue ON queue.id = tasks.queue_job AND queue.status = 'todo'
WHERE tasks.state = 'queued' AND queue.id IS NULL;

-- name: has_queue_job
-- Whether a queue job waits for this task, now that the task is locked.
SELECT EXISTS (
    SELECT FROM procrastinate_jobs AS queue
    WHERE queue.id = %(queue_job)s AND queue.status = 'todo'
) AS present;

-- name: queue_jobs_without_task
-- Queue jobs that wait for a task which is not queued.
SELECT queue.id FROM procrastinate_jobs AS queue
LEFT JOIN tasks ON tasks.queue_job = queue.id AND tasks.state = 'queued'
WHERE queue.status = 'todo' AND queue.task_name = %(task_name)s AND tasks.id IS NULL;
