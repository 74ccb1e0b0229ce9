-- Queries of kiln_service.operators and kiln_service.metrics.

-- name: insert_token
-- A new token; no row where the name is taken.
INSERT INTO tokens (name, sha256, scopes, created_by)
VALUES (%(name)s, %(sha256)s, %(scopes)s, %(actor)s)
ON CONFLICT (name) DO NOTHING
RETURNING *;

-- name: list_tokens
-- All tokens.
SELECT * FROM tokens ORDER BY name;

-- name: delete_token
-- Revoke a token.
DELETE FROM tokens WHERE name = %(name)s RETURNING name;

-- name: find_tokens
-- Whose tokens have these hashes; that they were used is noted once a minute.
WITH found AS (
    SELECT sha256, name, scopes FROM tokens WHERE sha256 = ANY(%(hashes)s)
), unnoticed AS (
    SELECT name FROM tokens
    WHERE sha256 = ANY(%(hashes)s) AND COALESCE(used < now() - interval '1 minute', true)
    FOR UPDATE SKIP LOCKED
), noticed AS (
    UPDATE tokens SET used = now() FROM unnoticed WHERE tokens.name = unnoticed.name
)
SELECT * FROM found;

-- name: add_audit
-- Record what was done.
INSERT INTO audit (actor, action, target, detail) VALUES (%(actor)s, %(action)s, %(target)s, %(detail)s);

-- name: list_audit
-- The record, newest first.
SELECT * FROM audit WHERE (%(before)s::bigint IS NULL OR id < %(before)s) ORDER BY id DESC LIMIT %(limit)s;

-- name: list_workers
-- Workers that were seen of late, with the task that each has.
SELECT workers.*, workers.seen < now() - make_interval(secs => %(offline_s)s) AS offline,
       asleep_at(workers.name, now()) AS asleep,
       tasks.id AS task_id, tasks.job_id, tasks.kind, tasks.label,
       schedules.days, schedules.begins, schedules.ends, schedules.timezone,
       COALESCE((
           SELECT jsonb_agg(jsonb_build_object('job_id', job_id, 'kind', kind, 'until', until) ORDER BY until DESC)
           FROM blocks WHERE blocks.worker = workers.registrant AND until > now()
       ), '[]') AS blocks
FROM workers
LEFT JOIN schedules ON schedules.worker = workers.name
LEFT JOIN LATERAL (
    SELECT id, job_id, kind, label FROM tasks
    WHERE tasks.worker_id = workers.id AND tasks.state = 'active' ORDER BY started DESC LIMIT 1
) AS tasks ON true
WHERE workers.seen > now() - make_interval(secs => %(forgotten_s)s)
ORDER BY workers.name, workers.registered;

-- name: order_worker
-- Tell a worker what to do from its next claim on.
UPDATE workers SET orders = %(orders)s WHERE id = %(id)s RETURNING id, name;

-- name: delete_blocks
-- A worker may take tasks of all jobs again.
DELETE FROM blocks WHERE worker = %(worker)s;

-- name: put_schedule
-- Let workers of a name sleep by a schedule.
INSERT INTO schedules (worker, days, begins, ends, timezone)
VALUES (%(worker)s, %(days)s, %(begins)s, %(ends)s, %(timezone)s)
ON CONFLICT (worker) DO UPDATE
SET days = EXCLUDED.days, begins = EXCLUDED.begins, ends = EXCLUDED.ends, timezone = EXCLUDED.timezone;

-- name: delete_schedule
-- Workers of a name have no schedule.
DELETE FROM schedules WHERE worker = %(worker)s;

-- name: count_tasks
-- Tasks by kind and state.
SELECT kind, state, count(*) AS tasks FROM tasks GROUP BY kind, state;

-- name: count_jobs
-- Jobs by state.
SELECT state, count(*) AS jobs FROM jobs GROUP BY state;

-- name: sum_work
-- Completed attempts by kind and by how many of the bounds, in seconds, each took longer than; what tiles rendered.
SELECT kind, width_bucket(took.seconds, %(bounds)s::float8[]) AS bucket, count(*) AS tasks, sum(took.seconds) AS seconds,
       COALESCE(sum(figure(result -> 'paths', 1e18)), 0) AS paths,
       COALESCE(sum(figure(spec -> 'tile' -> 'texels', 1e9)), 0) AS texels
FROM tasks CROSS JOIN LATERAL (SELECT COALESCE(figure(result -> 'seconds', 1e9), 0) AS seconds) AS took
WHERE state = 'completed' AND worker_id IS NOT NULL GROUP BY kind, bucket;

-- name: sum_light_fields
-- Bytes of radiance (three halves a pixel) in stores that are not freed, each counted once.
SELECT COALESCE(sum(figure(tasks.spec -> 'tile' -> 'texels', 1e9) * readers.pixels * 6), 0) AS bytes
FROM (
    SELECT DISTINCT ON (store_url) id, figure(settings -> 'render' -> 'image_size', 1e6) ^ 2 AS pixels
    FROM jobs WHERE freed IS NULL ORDER BY store_url, id
) AS readers
JOIN tasks ON tasks.job_id = readers.id AND tasks.kind = 'render' AND tasks.state = 'completed';

-- name: count_events
-- Events of tasks by kind.
SELECT kind, count(*) AS events FROM events WHERE kind = ANY(%(kinds)s) GROUP BY kind;

-- name: sum_blobs
-- Bytes of blobs.
SELECT COALESCE(sum(size), 0)::bigint AS bytes, count(*) AS blobs FROM blobs;

-- name: find_freeable
-- Archived jobs that ended before `days` ago, have none of the labels and whose data is still there, oldest first.
SELECT id FROM jobs
WHERE state = 'archived' AND freed IS NULL AND finished < now() - make_interval(secs => %(days)s * 86400.0)
  AND NOT EXISTS (SELECT FROM jsonb_each_text(%(keep)s) AS kept WHERE jobs.labels ->> kept.key = kept.value)
ORDER BY id;

-- name: find_archivable
-- Jobs in one of the states that ended before `days` ago and have none of the labels, oldest first.
SELECT id FROM jobs
WHERE state = ANY(%(states)s) AND finished < now() - make_interval(secs => %(days)s * 86400.0)
  AND NOT EXISTS (SELECT FROM jsonb_each_text(%(keep)s) AS kept WHERE jobs.labels ->> kept.key = kept.value)
ORDER BY id LIMIT 1000;

-- name: drop_logs
-- What tasks logged of jobs in one of the states that ended before `days` ago and have none of the labels.
WITH gone AS (
    DELETE FROM log_sizes USING jobs
    WHERE jobs.id = log_sizes.job_id
      AND jobs.state = ANY(%(states)s) AND jobs.finished < now() - make_interval(secs => %(days)s * 86400.0)
      AND NOT EXISTS (SELECT FROM jsonb_each_text(%(keep)s) AS kept WHERE jobs.labels ->> kept.key = kept.value)
    RETURNING task_id, attempt
)
DELETE FROM task_logs USING gone WHERE task_logs.task_id = gone.task_id AND task_logs.attempt = gone.attempt;

-- name: stores_needed_by_others
-- Which of these stores jobs read that are not freed; the job itself apart.
SELECT DISTINCT store_url FROM jobs
WHERE store_url = ANY(%(stores)s) AND id <> %(id)s AND freed IS NULL;

-- name: drop_data_uses
-- An archived job needs none of its blobs but those of its package; bytes that nobody else uses.
WITH dropped AS (
    DELETE FROM blob_uses
    WHERE owner = 'job:' || %(id)s::text
       OR owner IN (SELECT 'result:' || id FROM tasks WHERE job_id = %(id)s AND kind <> 'package')
    RETURNING sha256, owner
)
SELECT COALESCE(sum(size), 0)::bigint AS bytes FROM blobs
WHERE sha256 IN (SELECT sha256 FROM dropped)
  AND NOT EXISTS (
      SELECT FROM blob_uses WHERE blob_uses.sha256 = blobs.sha256
        AND blob_uses.owner NOT IN (SELECT owner FROM dropped)
  );

-- name: set_freed
-- The job's data is gone.
UPDATE jobs SET freed = now() WHERE id = %(id)s;
