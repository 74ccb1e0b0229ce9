-- Queries that show jobs to clients.

-- name: find_job
-- One job.
SELECT * FROM jobs WHERE id = %(id)s;

-- name: job_state
-- A job's state.
SELECT state FROM jobs WHERE id = %(id)s;

-- name: page_of_jobs
-- Jobs, newest first, before a cursor, in one of the states, with all the labels and the text in their name.
SELECT * FROM jobs
WHERE (%(before)s::text IS NULL OR id < %(before)s)
  AND state = ANY(%(states)s)
  AND labels @> %(labels)s
  AND (%(text)s::text IS NULL OR position(lower(%(text)s) IN lower(name)) > 0)
ORDER BY id DESC
LIMIT %(limit)s;

-- name: stages
-- Tasks of jobs by kind: counts, busy seconds, and for the tasks that run their fractions and elapsed seconds.
SELECT job_id, kind,
       count(*) AS total,
       count(*) FILTER (WHERE state = 'completed') AS completed,
       count(*) FILTER (WHERE state = 'active') AS active,
       count(*) FILTER (WHERE state = 'failed') AS failed,
       count(*) FILTER (WHERE state = 'soft-failed') AS soft_failed,
       COALESCE(sum(extract(epoch FROM finished - started)) FILTER (WHERE state = 'completed'), 0)::float8 AS seconds,
       array_agg(COALESCE(LEAST(
               GREATEST(figure(progress -> 'done', 1e15), 0) / GREATEST(figure(progress -> 'total', 1e15), 1e-6), 1
           ), 0) ORDER BY ordinal) FILTER (WHERE state = 'active') AS fractions,
       array_agg(extract(epoch FROM now() - started)::float8
           ORDER BY ordinal) FILTER (WHERE state = 'active') AS elapsed
FROM tasks
WHERE job_id = ANY(%(job_ids)s)
GROUP BY job_id, kind;

-- name: list_tasks
-- Tasks of a job in the order of planning, of a kind and in a state where given.
SELECT tasks.*, CASE WHEN worker_id IS NOT NULL THEN worker_name END AS worker
FROM tasks
WHERE job_id = %(job_id)s
  AND (%(kind)s::text IS NULL OR kind = %(kind)s) AND (%(state)s::text IS NULL OR state = %(state)s)
ORDER BY ordinal;

-- name: find_task
-- A task's state.
SELECT id, state FROM tasks WHERE id = %(id)s;

-- name: read_events
-- A job's history after an event.
SELECT id, at, job_id, task_id, kind, actor, detail FROM events
WHERE job_id = %(job_id)s AND id > %(after)s
ORDER BY id
LIMIT %(limit)s;

-- name: list_artifacts
-- What a job published.
SELECT name, sha256, size, media_type FROM artifacts WHERE job_id = %(job_id)s ORDER BY name;

-- name: find_artifact
-- One artifact of a job.
SELECT name, sha256, size, media_type FROM artifacts WHERE job_id = %(job_id)s AND name = %(name)s;

-- name: list_curves
-- Losses of a job's tasks over their steps: those of the result, or those told so far, at most `points` of these.
SELECT tasks.id AS task_id, tasks.kind, tasks.label, tasks.state,
       COALESCE(figure(progress -> 'total', 1e15), figure(result -> 'steps', 1e15)) AS steps,
       COALESCE(
           (SELECT jsonb_agg(jsonb_build_array(point -> 'step', point -> 'loss') ORDER BY figure(point -> 'step', 1e15))
            FROM jsonb_array_elements(
                CASE WHEN jsonb_typeof(result -> 'curve') = 'array' THEN result -> 'curve' END
            ) AS point),
           (SELECT jsonb_agg(jsonb_build_array(step, loss) ORDER BY step) FROM (
               SELECT step, loss, row_number() OVER (ORDER BY step DESC) AS place, count(*) OVER () AS told FROM losses
               WHERE task_id = tasks.id AND step <= COALESCE(figure(progress -> 'done', 1e15), 'Infinity')
           ) AS numbered WHERE (place - 1) %% (1 + told / %(points)s) = 0),
           '[]'
       ) AS points
FROM tasks WHERE job_id = %(job_id)s AND kind = 'fit' ORDER BY ordinal;
