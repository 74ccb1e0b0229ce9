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
       count(*) FILTER (WHERE state IN ('queued', 'soft-failed')) AS claimable,
       COALESCE(sum(extract(epoch FROM finished - started)) FILTER (WHERE state = 'completed'), 0)::float8 AS seconds,
       array_agg(COALESCE(LEAST(
               GREATEST(figure(progress -> 'done', 1e15), 0) / GREATEST(figure(progress -> 'total', 1e15), 1e-6), 1
           ), 0) ORDER BY ordinal) FILTER (WHERE state = 'active') AS fractions,
       array_agg(extract(epoch FROM now() - started)::float8
           ORDER BY ordinal) FILTER (WHERE state = 'active') AS elapsed
FROM tasks
WHERE job_id = ANY(%(job_ids)s)
GROUP BY job_id, kind;

-- name: page_of_tasks
-- Tasks of a job in the order of planning after a cursor, of a kind and in a state where given.
SELECT tasks.id, kind, label, state, attempt, CASE WHEN worker_id IS NOT NULL THEN worker_name END AS worker,
       progress, created, started, finished, error, ordinal
FROM tasks
WHERE job_id = %(job_id)s AND ordinal > %(cursor)s
  AND (%(kind)s::text IS NULL OR kind = %(kind)s) AND (%(state)s::text IS NULL OR state = %(state)s)
ORDER BY ordinal LIMIT %(limit)s;

-- name: page_of_changed_tasks
-- The same, only of those that events after one are about.
SELECT tasks.id, kind, label, state, attempt, CASE WHEN worker_id IS NOT NULL THEN worker_name END AS worker,
       progress, created, started, finished, error, ordinal
FROM tasks
WHERE job_id = %(job_id)s AND ordinal > %(cursor)s
  AND tasks.id IN (SELECT task_id FROM events WHERE events.job_id = %(job_id)s AND events.id > %(since)s)
  AND (%(kind)s::text IS NULL OR kind = %(kind)s) AND (%(state)s::text IS NULL OR state = %(state)s)
ORDER BY ordinal LIMIT %(limit)s;

-- name: find_task
-- A task's state.
SELECT id, state FROM tasks WHERE id = %(id)s;

-- name: read_events
-- A job's history after an event.
SELECT id, at, job_id, task_id, kind, actor, detail FROM events
WHERE job_id = %(job_id)s AND id > %(after)s
ORDER BY id
LIMIT %(limit)s;

-- name: read_streamed
-- New events of jobs, each after its own last one, in the order of ids; a row without an event where there is none.
SELECT streamed.job_id AS streamed, jobs.state, new.*
FROM unnest(%(job_ids)s::text[], %(afters)s::bigint[]) AS streamed (job_id, after)
JOIN jobs ON jobs.id = streamed.job_id
LEFT JOIN LATERAL (
    SELECT id, at, job_id, task_id, kind, actor, detail FROM events
    WHERE events.job_id = streamed.job_id AND events.id > streamed.after ORDER BY id LIMIT %(limit)s
) AS new ON true
ORDER BY new.id;

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

-- name: tile_map_version
-- How a job's light map is divided (0 texels as long as its size is not chosen), and the job's newest event.
SELECT CASE WHEN settings #>> '{lightmap,resolution}' = 'auto' THEN COALESCE((prepared ->> 'resolution')::int, 0)
            ELSE (settings #>> '{lightmap,resolution}')::int END AS resolution,
       (settings #>> '{lightmap,tile}')::int AS tile,
       COALESCE((SELECT max(id) FROM events WHERE job_id = jobs.id), 0) AS version
FROM jobs WHERE id = %(job_id)s;

-- name: changes_since
-- How many events there are after one, of `most` at most, and whether one of them may be about many tasks.
SELECT count(*) AS changes, COALESCE(bool_or(task_id IS NULL), false) AS of_many FROM (
    SELECT task_id FROM events WHERE job_id = %(job_id)s AND id > %(since)s ORDER BY id LIMIT %(most)s
) AS newer;

-- name: changed_tiles
-- Tiles that events after one are about: their places, row by row, and their states by number.
SELECT (spec #>> '{tile,row}')::int / %(tile)s * %(side)s + (spec #>> '{tile,column}')::int / %(tile)s AS cell,
       array_position(%(states)s::text[], state) AS code
FROM tasks
WHERE id IN (SELECT task_id FROM events WHERE job_id = %(job_id)s AND id > %(since)s) AND kind = %(kind)s;

-- name: all_tiles
-- A byte a tile, row by row: the number of its state, 0 where there is none.
SELECT string_agg(set_byte('\x00'::bytea, 0, COALESCE(code, 0)), ''::bytea ORDER BY cell) AS cells
FROM generate_series(0, %(side)s::int * %(side)s::int - 1) AS places (cell)
LEFT JOIN (
    SELECT (spec #>> '{tile,row}')::int / %(tile)s * %(side)s + (spec #>> '{tile,column}')::int / %(tile)s AS cell,
           array_position(%(states)s::text[], state) AS code
    FROM tasks WHERE job_id = %(job_id)s AND kind = %(kind)s
) AS there USING (cell);
