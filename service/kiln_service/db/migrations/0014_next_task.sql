-- What a claim needs under its job's lock, in as few statements and bytes as can be.

-- What the prepare task made, for the payloads of the tasks after it; its whole result may list thousands of tiles.
ALTER TABLE jobs ADD COLUMN prepared jsonb;

UPDATE jobs SET prepared = tasks.result - 'tiles'
FROM tasks WHERE tasks.job_id = jobs.id AND tasks.kind = 'prepare' AND tasks.state = 'completed';

-- The task that a worker gets next, of all jobs or of one: of those that are queued, of its kinds, of jobs that go on
-- and whose tags it has. Not of a job that it is blocked for, nor one that it has failed while another worker is there
-- that has not. Job by job: taken together, the planner would sort all their tasks for every claim.
CREATE FUNCTION next_task(asking text, its_tags text[], wanted text[], of_job text, stale_s double precision)
RETURNS SETOF tasks LANGUAGE sql STABLE AS $$
    SELECT best.* FROM jobs CROSS JOIN LATERAL (
        SELECT tasks.* FROM tasks
        WHERE tasks.job_id = jobs.id AND tasks.state IN ('queued', 'soft-failed') AND tasks.kind = ANY(wanted)
          AND NOT EXISTS (
              SELECT FROM blocks
              WHERE worker = asking AND blocks.job_id = tasks.job_id AND blocks.kind = tasks.kind AND until > now()
          )
          AND (
              tasks.state = 'queued'
              OR NOT EXISTS (SELECT FROM failures WHERE task_id = tasks.id AND worker = asking)
              OR NOT EXISTS (
                  SELECT FROM takers(tasks.job_id, tasks.kind, stale_s) AS name
                  WHERE name <> asking
                    AND NOT EXISTS (SELECT FROM failures WHERE task_id = tasks.id AND worker = name)
              )
          )
        ORDER BY tasks.rank DESC, tasks.ordinal
        LIMIT 1
    ) AS best
    WHERE jobs.state IN ('queued', 'active') AND jobs.tags <@ its_tags AND jobs.id = COALESCE(of_job, jobs.id)
    ORDER BY best.rank DESC, best.job_id, best.ordinal
    LIMIT 1
$$;
