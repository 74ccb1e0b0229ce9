-- Queries of kiln_service.blobs, kiln_service.damage and kiln_service.quota.

-- name: lock_blob
-- Exclude publication and collection of the same blob; held until the transaction ends.
SELECT pg_advisory_xact_lock(hashtextextended(%(sha256)s, 0));

-- name: touch_blobs
-- Which blobs are here and not known to be damaged, with their sizes; each is kept for the grace period from now.
WITH here AS (
    SELECT sha256 FROM blobs WHERE sha256 = ANY(%(hashes)s) AND damaged IS NULL ORDER BY sha256 FOR NO KEY UPDATE
)
UPDATE blobs SET touched = now() FROM here WHERE blobs.sha256 = here.sha256 RETURNING blobs.sha256, blobs.size;

-- name: hold_blobs
-- Which blobs are here and whole, with their sizes; none is collected before the transaction ends.
SELECT sha256, size FROM blobs WHERE sha256 = ANY(%(hashes)s) AND damaged IS NULL ORDER BY sha256 FOR KEY SHARE;

-- name: find_blob
-- Size of a blob, and whether its bytes are known to be damaged.
SELECT size, damaged IS NOT NULL AS damaged FROM blobs WHERE sha256 = %(sha256)s;

-- name: store_blob
-- Vouch for an object that is whole and durable now.
INSERT INTO blobs (sha256, size, uploader) VALUES (%(sha256)s, %(size)s, %(uploader)s)
ON CONFLICT (sha256) DO UPDATE SET damaged = NULL, touched = now();

-- name: mark_damaged
-- The bytes of a blob are not what was uploaded.
UPDATE blobs SET damaged = COALESCE(damaged, now()) WHERE sha256 = %(sha256)s;

-- name: jobs_of_blob
-- Jobs that use a blob, by their bundle, a result or a checkpoint.
SELECT DISTINCT COALESCE(tasks.job_id, substr(owner, 5)) AS job_id
FROM blob_uses LEFT JOIN tasks ON tasks.id = split_part(owner, ':', 2) AND owner NOT LIKE 'job:%%'
WHERE sha256 = %(sha256)s
ORDER BY job_id;

-- name: damaged_tasks
-- Tasks of a job whose result or checkpoint has damaged blobs, in the order of planning.
SELECT tasks.id, tasks.kind, split_part(blob_uses.owner, ':', 1) AS use FROM tasks
JOIN blob_uses ON blob_uses.owner IN ('result:' || tasks.id, 'checkpoint:' || tasks.id)
JOIN blobs ON blobs.sha256 = blob_uses.sha256
WHERE tasks.job_id = %(job_id)s AND blobs.damaged IS NOT NULL
GROUP BY tasks.id, use
ORDER BY tasks.ordinal;

-- name: forget_checkpoints
-- Tasks begin again from their start.
UPDATE tasks SET checkpoint = NULL WHERE id = ANY(%(ids)s);

-- name: add_blob_uses
-- An owner needs blobs.
INSERT INTO blob_uses (sha256, owner)
SELECT unnest(%(hashes)s::text[]), %(owner)s
ON CONFLICT DO NOTHING;

-- name: drop_blob_uses
-- Some owners need none any more.
DELETE FROM blob_uses WHERE owner = ANY(%(owners)s);

-- name: unused_of_token
-- How many blobs a token has uploaded that no job uses, and their bytes.
SELECT count(*) AS blobs, COALESCE(sum(size), 0)::bigint AS bytes FROM blobs WHERE uploader = %(token)s AND NOT used;

-- name: recount_uses
-- Blobs that one transaction began to use while another gave up the last use of it.
UPDATE blobs SET used = true WHERE NOT used AND EXISTS (SELECT FROM blob_uses WHERE blob_uses.sha256 = blobs.sha256);

-- name: unused_blobs
-- Blobs that nobody uses and that were not asked for within the grace period.
SELECT sha256 FROM blobs
WHERE touched < now() - make_interval(secs => %(seconds)s)
  AND NOT EXISTS (SELECT FROM blob_uses WHERE blob_uses.sha256 = blobs.sha256)
ORDER BY touched LIMIT 1000;

-- name: delete_unused_blob
-- The same for one blob, now that it is locked.
DELETE FROM blobs
WHERE sha256 = %(sha256)s AND touched < now() - make_interval(secs => %(seconds)s)
  AND NOT EXISTS (SELECT FROM blob_uses WHERE blob_uses.sha256 = blobs.sha256);
