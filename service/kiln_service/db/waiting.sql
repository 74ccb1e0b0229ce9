-- Queries of kiln_service.waiting. Who may take a task is what the functions `takers` and `next_task` say.

-- name: count_takers
-- For tasks of a kind of each job: of the workers that are there, how many are left condition by condition; and those
-- of the job's tags that no worker there of the kind has.
WITH present AS MATERIALIZED (
    SELECT registrant, kinds, tags, orders = 'drain' AS drained,
           orders = 'sleep' OR asleep_at(name, now()) AS asleep,
           EXISTS (SELECT FROM tasks WHERE tasks.worker_id = workers.id AND tasks.state = 'active') AS busy
    FROM workers WHERE seen > now() - make_interval(secs => %(stale_s)s)
)
SELECT jobs.id AS job_id, waiting.kind, jobs.tags,
       count(registrant) AS present,
       count(*) FILTER (WHERE able) AS able,
       count(*) FILTER (WHERE able AND tagged) AS tagged,
       count(*) FILTER (WHERE able AND tagged AND NOT drained) AS staying,
       count(*) FILTER (WHERE able AND tagged AND NOT drained AND NOT asleep) AS awake,
       count(*) FILTER (WHERE able AND tagged AND NOT drained AND NOT asleep AND NOT blocked) AS takers,
       count(*) FILTER (WHERE able AND tagged AND NOT drained AND NOT asleep AND NOT blocked AND NOT busy) AS idle,
       ARRAY(
           SELECT tag FROM unnest(jobs.tags) AS tag
           WHERE NOT EXISTS (SELECT FROM present WHERE waiting.kind = ANY(present.kinds) AND tag = ANY(present.tags))
       ) AS missing
FROM unnest(%(job_ids)s::text[], %(kinds)s::text[]) AS waiting (job_id, kind)
JOIN jobs ON jobs.id = waiting.job_id
LEFT JOIN LATERAL (
    SELECT present.*, waiting.kind = ANY(present.kinds) AS able, jobs.tags <@ present.tags AS tagged,
           EXISTS (
               SELECT FROM blocks
               WHERE blocks.worker = registrant AND blocks.job_id = jobs.id AND blocks.kind = waiting.kind AND until > now()
           ) AS blocked
    FROM present
) AS seen ON true
GROUP BY jobs.id, jobs.tags, waiting.kind;

-- name: newest_refused_worker
-- The worker that was refused last for its version, within so many seconds.
SELECT name, version FROM refused_workers
WHERE at > now() - make_interval(secs => %(seconds)s) ORDER BY at DESC, name LIMIT 1;

-- name: note_refused_worker
-- A worker was refused for its version; at most `most` of a token are kept.
INSERT INTO refused_workers (owner, name, version)
SELECT %(owner)s, %(name)s, %(version)s
WHERE (SELECT count(*) FROM refused_workers WHERE owner = %(owner)s AND name <> %(name)s) < %(most)s
ON CONFLICT (owner, name) DO UPDATE SET version = EXCLUDED.version, at = now();

-- name: forget_refused_workers
-- Those that were refused longer than so many seconds ago.
DELETE FROM refused_workers WHERE at < now() - make_interval(secs => %(seconds)s);
