-- Queries of kiln_service.dashboard.

-- name: rendered_tiles
-- Those of some tiles of a job that are rendered.
SELECT asked."row", asked."column" FROM unnest(%(rows)s::int[], %(columns)s::int[]) AS asked ("row", "column")
JOIN tasks ON tasks.job_id = %(job_id)s AND tasks.kind = 'render' AND tasks.state = 'completed'
  AND tasks.label = format('tile %%s,%%s', asked."row", asked."column");

-- name: tile_task
-- The render task of a tile.
SELECT id FROM tasks
WHERE job_id = %(job_id)s AND kind = 'render'
  AND (spec -> 'tile' ->> 'row')::int = %(row)s AND (spec -> 'tile' ->> 'column')::int = %(column)s;

-- name: tasks_of_note
-- Tasks of a job that are single, run, or went wrong; of the many others none. (Not their results: the prepare task's may
-- list 65,536 tiles.)
SELECT tasks.id, kind, label, state, attempt, CASE WHEN worker_id IS NOT NULL THEN worker_name END AS worker,
       progress, created, started, finished, error
FROM tasks
WHERE job_id = %(job_id)s
  AND (kind NOT IN ('render', 'refine') OR state NOT IN ('waiting', 'queued', 'completed', 'canceled'))
ORDER BY ordinal LIMIT %(limit)s;

-- name: one_task
-- A task with its worker's name and its job's state.
SELECT tasks.id, job_id, kind, label, tasks.state, attempt,
       CASE WHEN worker_id IS NOT NULL THEN worker_name END AS worker,
       progress, tasks.created, tasks.started, tasks.finished, tasks.error, jobs.state AS job_state
FROM tasks JOIN jobs ON jobs.id = tasks.job_id WHERE tasks.id = %(id)s;

-- name: last_events
-- The newest events of a job.
SELECT id, at, job_id, task_id, kind, actor, detail FROM events
WHERE job_id = %(job_id)s ORDER BY id DESC LIMIT %(limit)s;

-- name: throughput
-- Tasks and busy seconds of each worker within the last hour.
SELECT worker_id, count(*) AS tasks, sum(extract(epoch FROM finished - started))::float8 AS seconds
FROM tasks WHERE state = 'completed' AND worker_id IS NOT NULL AND finished > now() - interval '1 hour'
GROUP BY worker_id;

-- name: stuck_tasks
-- Running tasks that nobody has heard of for a while, or that take far longer than others of their kind and job.
WITH usual AS (
    SELECT job_id, kind, percentile_cont(0.5) WITHIN GROUP (ORDER BY extract(epoch FROM finished - started)) AS seconds
    FROM tasks
    WHERE state = 'completed' AND worker_id IS NOT NULL
      AND job_id IN (SELECT job_id FROM tasks WHERE state = 'active')
    GROUP BY job_id, kind HAVING count(*) >= 3
)
SELECT tasks.id, tasks.job_id, tasks.kind, tasks.label, tasks.attempt, jobs.name AS job, tasks.worker_name AS worker,
       extract(epoch FROM now() - tasks.heartbeat)::float8 AS silent_s,
       extract(epoch FROM now() - tasks.started)::float8 AS running_s, usual.seconds::float8 AS usual_s
FROM tasks
JOIN jobs ON jobs.id = tasks.job_id
LEFT JOIN usual ON usual.job_id = tasks.job_id AND usual.kind = tasks.kind
WHERE tasks.state = 'active'
  AND (tasks.heartbeat < now() - make_interval(secs => %(silent_s)s)
       OR extract(epoch FROM now() - tasks.started) > GREATEST(%(times)s * usual.seconds, %(least_s)s))
ORDER BY tasks.started LIMIT 100;
