-- Who could take a task: one answer for claims, for blocks and for whether a job fails with a task.

-- Whether workers of a name sleep by their schedule; a span over midnight belongs to the day it begins.
CREATE FUNCTION asleep_at(worker_name text, at timestamptz) RETURNS boolean LANGUAGE sql STABLE AS $$
    SELECT EXISTS (
        SELECT FROM schedules
        CROSS JOIN LATERAL (SELECT at AT TIME ZONE timezone AS local) AS there
        CROSS JOIN LATERAL (SELECT local::time AS clock, extract(isodow FROM local)::int - 1 AS today) AS said
        WHERE worker = worker_name
          AND ((today = ANY(days) AND begins <= clock AND (ends <= begins OR clock < ends))
               OR ((today + 6) % 7 = ANY(days) AND ends <= begins AND clock < ends))
    )
$$;

-- Names of the workers that are there (seen within `stale_s`) and would be given a job's tasks of a kind.
CREATE FUNCTION takers(job text, task_kind text, stale_s double precision) RETURNS SETOF text LANGUAGE sql STABLE AS $$
    SELECT workers.name FROM workers JOIN jobs ON jobs.id = job
    WHERE workers.seen > now() - make_interval(secs => stale_s) AND workers.orders = 'work'
      AND task_kind = ANY(workers.kinds) AND jobs.tags <@ workers.tags AND NOT asleep_at(workers.name, now())
      AND NOT EXISTS (
          SELECT FROM blocks
          WHERE blocks.worker = workers.name AND blocks.job_id = job AND blocks.kind = task_kind AND until > now()
      )
$$;
