-- Queries of kiln_service.blobs.

-- name: lock_blob
-- Exclude publication and collection of the same blob; held until the transaction ends.
SELECT pg_advisory_xact_lock(hashtextextended(%(sha256)s, 0));

-- name: touch_blobs
-- Which blobs are here; each is kept for the grace period from now.
WITH here AS (
    SELECT sha256 FROM blobs WHERE sha256 = ANY(%(hashes)s) ORDER BY sha256 FOR NO KEY UPDATE
)
UPDATE blobs SET touched = now() FROM here WHERE blobs.sha256 = here.sha256 RETURNING blobs.sha256;

-- name: hold_blobs
-- Which blobs are here; none is collected before the transaction ends.
SELECT sha256 FROM blobs WHERE sha256 = ANY(%(hashes)s) ORDER BY sha256 FOR KEY SHARE;

-- name: find_blob
-- Size of a blob.
SELECT size FROM blobs WHERE sha256 = %(sha256)s;

-- name: insert_blob
-- Vouch for an object that is durable now.
INSERT INTO blobs (sha256, size) VALUES (%(sha256)s, %(size)s);

-- name: add_blob_uses
-- An owner needs blobs.
INSERT INTO blob_uses (sha256, owner)
SELECT unnest(%(hashes)s::text[]), %(owner)s
ON CONFLICT DO NOTHING;

-- name: drop_blob_uses
-- Some owners need none any more.
DELETE FROM blob_uses WHERE owner = ANY(%(owners)s);

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
