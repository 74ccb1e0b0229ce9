-- Queries of kiln_service.task_logs.

-- name: long_logs
-- Attempts whose logs are longer than `most` bytes.
SELECT task_id, attempt, bytes FROM log_sizes WHERE bytes > %(most)s;

-- name: logs_of_jobs
-- Bytes of the logs of each job.
SELECT job_id, sum(bytes)::bigint AS bytes FROM log_sizes WHERE bytes > 0 GROUP BY job_id;

-- name: oldest_of_attempt
-- The oldest pieces of an attempt's log.
SELECT id, bytes FROM task_logs WHERE task_id = %(task_id)s AND attempt = %(attempt)s ORDER BY id LIMIT %(limit)s;

-- name: oldest_of_job
-- The oldest pieces of the logs of a job.
SELECT task_logs.id, task_logs.bytes FROM log_sizes JOIN task_logs USING (task_id, attempt)
WHERE log_sizes.job_id = %(job_id)s AND log_sizes.bytes > 0 ORDER BY task_logs.id LIMIT %(limit)s;

-- name: oldest_of_all
-- The oldest pieces of all logs.
SELECT id, bytes FROM task_logs ORDER BY id LIMIT %(limit)s;

-- name: drop_log_pieces
-- These pieces go; a trigger notes how much that was.
DELETE FROM task_logs WHERE id = ANY(%(ids)s);

-- name: log_after
-- Pieces of a task's log after one, oldest first: the next, and as many more as are within `most` bytes.
SELECT id, attempt, lines FROM (
    SELECT id, attempt, lines, sum(bytes) OVER (ORDER BY id) - bytes AS earlier FROM task_logs
    WHERE task_id = %(task_id)s AND id > %(after)s ORDER BY id LIMIT %(limit)s
) AS pieces WHERE earlier < %(most)s ORDER BY id;

-- name: log_before
-- The same before a piece, newest first.
SELECT id, attempt, lines FROM (
    SELECT id, attempt, lines, sum(bytes) OVER (ORDER BY id DESC) - bytes AS later FROM task_logs
    WHERE task_id = %(task_id)s AND (%(before)s::bigint IS NULL OR id < %(before)s) ORDER BY id DESC LIMIT %(limit)s
) AS pieces WHERE later < %(most)s ORDER BY id DESC;

-- name: dropped_log
-- How many bytes of the log of each attempt of a task were dropped, where some were.
SELECT attempt, dropped FROM log_sizes WHERE task_id = %(task_id)s AND dropped > 0 ORDER BY attempt;

-- name: last_log
-- The last pieces of a task's log, newest first.
SELECT lines FROM task_logs WHERE task_id = %(task_id)s ORDER BY id DESC LIMIT 20;
