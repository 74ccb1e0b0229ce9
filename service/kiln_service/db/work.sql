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

-- name: job_of_prepare
-- The job of a prepare task that was not prepared before.
SELECT jobs.* FROM jobs JOIN tasks ON tasks.job_id = jobs.id
WHERE tasks.id = %(id)s AND tasks.kind = 'prepare' AND jobs.prepared IS NULL;

-- name: store_of_task
-- Where the light fields of a task's job are, and how often the task has failed.
SELECT jobs.store_url, tasks.strikes FROM jobs JOIN tasks ON tasks.job_id = jobs.id WHERE tasks.id = %(id)s;

-- name: stage_left
-- Whether tasks of a kind have not completed; and where nothing of the job can be worked on any more because tasks
-- failed, the error of the first that did.
SELECT EXISTS (
    SELECT FROM tasks WHERE job_id = %(job_id)s AND kind = %(kind)s AND state <> 'completed'
) AS unfinished, (
    SELECT error FROM tasks
    WHERE job_id = %(job_id)s AND state = 'failed'
      AND NOT EXISTS (
          SELECT FROM tasks AS other
          WHERE other.job_id = %(job_id)s AND other.state IN ('queued', 'soft-failed', 'active')
      )
    ORDER BY finished LIMIT 1
) AS stuck;

-- name: prepare_state
-- How far a job's prepare task is.
SELECT state FROM tasks WHERE job_id = %(job_id)s AND kind = 'prepare';

-- name: rendered_places
-- First rows and columns of the tiles that a job has rendered: two arrays, which are read far faster than rows.
SELECT array_agg((spec -> 'tile' ->> 'row')::int ORDER BY ordinal) AS rows,
       array_agg((spec -> 'tile' ->> 'column')::int ORDER BY ordinal) AS columns
FROM tasks WHERE job_id = %(job_id)s AND kind = 'render' AND state = 'completed';

-- name: failed_share
-- Of a job's tasks of a kind: how many there are, have failed, have completed; how many of the job can still be worked
-- on; and whether another worker than one is there for the kind.
SELECT count(*) FILTER (WHERE kind = %(kind)s) AS total,
       count(*) FILTER (WHERE kind = %(kind)s AND state = 'failed') AS failed,
       count(*) FILTER (WHERE kind = %(kind)s AND state = 'completed') AS completed,
       count(*) FILTER (WHERE state IN ('queued', 'soft-failed', 'active')) AS open,
       EXISTS (
           SELECT FROM takers(%(job_id)s, %(kind)s, %(stale_s)s) AS registrant
           WHERE registrant <> (SELECT workers.registrant FROM workers WHERE workers.id = %(worker_id)s)
       ) AS others
FROM tasks WHERE job_id = %(job_id)s;

-- name: pick_task
-- The task that a worker gets next, of all jobs; nothing is locked.
SELECT job_id FROM next_task(%(worker)s, %(tags)s::text[], %(kinds)s::text[], NULL, %(stale_s)s);

-- name: rank_tasks
-- A job's place in the queue: its priority times %(step)s plus what a task's stage adds.
UPDATE tasks SET rank = %(priority)s * %(step)s + rank %% %(step)s WHERE job_id = %(job_id)s;

-- name: add_failure
-- An attempt of a task ended badly on a worker; how many tasks of this kind of the job that worker has failed, and
-- whether another one is there that could go on.
WITH added AS (
    INSERT INTO failures (task_id, attempt, worker) VALUES (%(task_id)s, %(attempt)s, %(worker)s)
    ON CONFLICT DO NOTHING
), struck AS (
    UPDATE workers SET strikes = strikes + 1 WHERE id = %(worker_id)s
)
SELECT (
    SELECT count(DISTINCT id) FROM (
        SELECT %(task_id)s AS id
        UNION SELECT tasks.id FROM failures JOIN tasks ON tasks.id = failures.task_id
        WHERE failures.worker = %(worker)s AND tasks.job_id = jobs.id AND tasks.kind = %(kind)s
    ) AS failed
) AS tasks, EXISTS (
    SELECT FROM takers(%(job_id)s, %(kind)s, %(stale_s)s) AS registrant WHERE registrant <> %(worker)s
) AS others
FROM jobs WHERE jobs.id = %(job_id)s;

-- name: add_block
-- A worker gets no more tasks of a kind of a job for a while.
INSERT INTO blocks (worker, job_id, kind, until)
VALUES (%(worker)s, %(job_id)s, %(kind)s, now() + make_interval(secs => %(seconds)s))
ON CONFLICT (worker, job_id, kind) DO UPDATE SET until = EXCLUDED.until;

-- name: forget_worker_failures
-- What a worker failed of a kind of a job counts no more.
DELETE FROM failures USING tasks
WHERE tasks.id = failures.task_id AND failures.worker = %(worker)s AND tasks.job_id = %(job_id)s AND tasks.kind = %(kind)s;

-- name: recount_strikes
-- What counts of a job's tasks of a kind after a worker's failures were forgotten.
UPDATE tasks SET strikes = (SELECT count(*) FROM failures WHERE task_id = tasks.id)
WHERE job_id = %(job_id)s AND kind = %(kind)s AND strikes > 0;

-- name: forget_task_failures
-- What was failed of tasks counts no more.
DELETE FROM failures WHERE task_id = ANY(%(ids)s);

-- name: clear_strikes
-- A worker has done something well.
UPDATE workers SET strikes = 0 WHERE id = %(id)s AND strikes > 0;

-- name: delete_artifacts
-- What a job published is no longer its own.
DELETE FROM artifacts WHERE job_id = %(job_id)s;

-- name: count_active
-- Tasks of a job that workers have.
SELECT count(*) AS tasks FROM tasks WHERE job_id = %(job_id)s AND state = 'active';

-- name: results_of_kind
-- Results of a job's tasks of a kind, in the order of planning.
SELECT result FROM tasks WHERE job_id = %(job_id)s AND kind = %(kind)s AND state = 'completed' ORDER BY ordinal;

-- name: results_as_text
-- The same as a JSON array.
SELECT '[' || COALESCE(string_agg(result::text, ',' ORDER BY ordinal), '') || ']' AS results
FROM tasks WHERE job_id = %(job_id)s AND kind = %(kind)s AND state = 'completed';

-- name: tiles_as_text
-- The tiles of a job as its prepare task has found them, as a JSON array.
SELECT (result -> 'tiles')::text AS tiles FROM tasks
WHERE job_id = %(job_id)s AND kind = 'prepare' AND state = 'completed';

-- name: renders_near
-- Results of a job's render tasks whose tiles have texels from `start` to before `stop` in rows and columns.
SELECT result FROM tasks
WHERE job_id = %(job_id)s AND kind = 'render' AND state = 'completed'
  AND (spec -> 'tile' ->> 'row')::int < %(row_stop)s
  AND (spec -> 'tile' ->> 'row')::int + (spec -> 'tile' ->> 'size')::int > %(row_start)s
  AND (spec -> 'tile' ->> 'column')::int < %(column_stop)s
  AND (spec -> 'tile' ->> 'column')::int + (spec -> 'tile' ->> 'size')::int > %(column_start)s
ORDER BY ordinal;

-- name: set_prepared
-- What a job's prepare task made, for the payloads of the tasks after it.
UPDATE jobs SET prepared = %(prepared)s WHERE id = %(id)s;

-- name: analyze_tasks
-- Tell the planner of thousands of new rows: until then it sorts them all for every claim.
ANALYZE tasks;

-- name: notify_queued
-- Wake the claims that wait for any of these: kinds of tasks, or what a worker is told.
SELECT pg_notify('kiln_queued', %(about)s);

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
INSERT INTO workers (id, name, owner, kinds, memory_bytes, threads, device, version, tags)
VALUES (%(id)s, %(name)s, %(owner)s, %(kinds)s, %(memory_bytes)s, %(threads)s, %(device)s, %(version)s, %(tags)s);

-- name: lock_registrations
-- Let one of several registrations with a token in at a time; held until the transaction ends.
SELECT pg_advisory_xact_lock(hashtextextended('workers of ' || %(owner)s::text, 0));

-- name: count_workers
-- Registrations with a token.
SELECT count(*) AS workers FROM workers WHERE owner = %(owner)s;

-- name: replace_workers
-- Forget the registrations with a token that nobody has heard of for longest, at most `count`, to make room.
DELETE FROM workers WHERE id IN (
    SELECT id FROM workers
    WHERE owner = %(owner)s AND seen < now() - make_interval(secs => %(offline_s)s)
      AND NOT EXISTS (SELECT FROM tasks WHERE tasks.worker_id = workers.id AND tasks.state = 'active')
    ORDER BY seen LIMIT %(count)s
);

-- name: forget_workers
-- Forget registrations that nobody has heard of for long; what they did keeps their ids and names.
DELETE FROM workers
WHERE seen < now() - make_interval(secs => %(forgotten_s)s)
  AND NOT EXISTS (SELECT FROM tasks WHERE tasks.worker_id = workers.id AND tasks.state = 'active');

-- name: find_worker
-- A registered worker, and whether it sleeps by its schedule.
SELECT *, asleep_at(name, now()) AS asleep FROM workers WHERE id = %(id)s;

-- name: see_worker
-- A worker was seen now; to the second is enough.
UPDATE workers SET seen = now() WHERE id = %(id)s AND seen < now() - interval '1 second';

-- name: see_worker_lightly
-- The same in a transaction whose loss would harm nothing: its commit does not wait for the disk.
UPDATE workers SET seen = now() WHERE id = %(id)s AND set_config('synchronous_commit', 'off', true) = 'off';

-- name: beat
-- Keep an attempt alive: its log, its progress and loss (an attempt that begins again from a checkpoint tells the same
-- steps anew), when its worker was seen. `job_state` is NULL where the attempt is not the task's current one, or is not
-- this worker's: the lease's hashes differ. Nothing is harmed if this is lost, so the commit does not wait for the disk.
WITH alive AS (
    UPDATE tasks
    SET heartbeat = now(), progress = COALESCE(%(progress)s::jsonb, progress)
    FROM jobs
    WHERE tasks.id = %(task_id)s AND tasks.attempt = %(attempt)s AND tasks.state = 'active' AND jobs.id = tasks.job_id
      AND tasks.worker_id = %(worker_id)s AND tasks.lease_sha256 = %(lease_sha256)s
      AND EXISTS (SELECT FROM workers WHERE id = %(worker_id)s AND owner = %(owner)s)
    RETURNING jobs.state AS job_state
), said AS (
    INSERT INTO task_logs (task_id, attempt, lines)
    SELECT %(task_id)s::text, %(attempt)s::int, %(lines)s::text FROM alive WHERE %(lines)s::text <> ''
), told AS (
    INSERT INTO losses (task_id, step, loss)
    SELECT %(task_id)s::text, %(step)s::double precision, %(loss)s::double precision
    FROM alive WHERE %(loss)s::double precision IS NOT NULL
    ON CONFLICT (task_id, step) DO UPDATE SET loss = excluded.loss
), seen AS (
    UPDATE workers SET seen = now()
    WHERE id = %(worker_id)s AND owner = %(owner)s AND set_config('synchronous_commit', 'off', true) = 'off'
    RETURNING id
)
SELECT (SELECT job_state FROM alive) AS job_state, EXISTS (SELECT FROM seen) AS known;

-- name: drop_losses
-- Forget what attempts of a task told.
DELETE FROM losses WHERE task_id = %(task_id)s;

-- name: add_log
-- Lines that an attempt wrote; nothing where the task is unknown.
INSERT INTO task_logs (task_id, attempt, lines)
SELECT id, %(attempt)s, %(lines)s FROM tasks WHERE id = %(task_id)s;

-- name: set_checkpoint
-- Publish an attempt's checkpoint: progress was made, so earlier failures count no more.
UPDATE tasks SET checkpoint = %(sha256)s, strikes = 0, heartbeat = now() WHERE id = %(id)s;

-- name: unfinished_kinds
-- Kinds of a job's tasks that have not all completed.
SELECT DISTINCT kind FROM tasks WHERE job_id = %(job_id)s AND state <> 'completed';

-- name: change_job
-- Rank or label a job anew; NULL keeps what there is.
UPDATE jobs
SET priority = COALESCE(%(priority)s, priority), labels = COALESCE(%(labels)s, labels),
    tags = COALESCE(%(tags)s::text[], tags)
WHERE id = %(id)s;

-- name: lock_idempotency_key
-- Let one of several identical submissions in at a time; held until the transaction ends.
SELECT pg_advisory_xact_lock(hashtextextended(%(key)s, 0));

-- name: find_submission
-- The job that a submission with this key has made.
SELECT * FROM jobs WHERE submitter = %(submitter)s AND idempotency_key = %(key)s;

-- name: set_render_key
-- What the light fields of a prepared job depend on.
UPDATE jobs SET render_key = %(key)s WHERE id = %(id)s;

-- name: find_sources
-- Other jobs whose light fields are the same and all there, newest first, as far as the database knows.
SELECT jobs.id, jobs.store_url FROM jobs
JOIN tasks AS prepared ON prepared.job_id = jobs.id AND prepared.kind = 'prepare' AND prepared.state = 'completed'
WHERE jobs.render_key = %(key)s AND jobs.id <> %(id)s AND jobs.method = %(method)s AND jobs.state <> 'archived'
  AND (%(between)s::jsonb = '[]' OR COALESCE(prepared.result -> 'between', '[]') = %(between)s)
  AND NOT EXISTS (
      SELECT FROM tasks WHERE tasks.job_id = jobs.id AND tasks.kind = 'render' AND tasks.state <> 'completed'
  )
ORDER BY jobs.id DESC
LIMIT 100;

-- name: find_renders
-- The newest of some jobs whose light fields are the same and all there, and that has what the descent learns from; it
-- is not archived before this transaction ends.
SELECT jobs.id, jobs.store_url FROM jobs
JOIN tasks AS prepared ON prepared.job_id = jobs.id AND prepared.kind = 'prepare' AND prepared.state = 'completed'
WHERE jobs.render_key = %(key)s AND jobs.id <> %(id)s AND jobs.method = %(method)s AND jobs.state <> 'archived'
  AND jobs.id = ANY(%(sources)s::text[])
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

