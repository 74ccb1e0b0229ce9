-- Blobs whose bytes are damaged; who uploaded what no job uses.

ALTER TABLE blobs
    ADD COLUMN damaged timestamptz,                 -- when its bytes were found to be damaged or gone
    ADD COLUMN uploader text,                       -- name of the token that uploaded it first
    ADD COLUMN used boolean NOT NULL DEFAULT false; -- whether `blob_uses` has it; kept by the triggers below

UPDATE blobs SET used = true WHERE EXISTS (SELECT FROM blob_uses WHERE blob_uses.sha256 = blobs.sha256);

-- What a token has stored that no job uses is summed up from this index alone.
CREATE INDEX blobs_unused ON blobs (uploader) INCLUDE (size) WHERE NOT used;
CREATE INDEX blobs_damaged ON blobs (sha256) WHERE damaged IS NOT NULL;

CREATE FUNCTION blobs_begin_use() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    PERFORM FROM blobs WHERE sha256 IN (SELECT sha256 FROM changed) AND NOT used ORDER BY sha256 FOR NO KEY UPDATE;
    UPDATE blobs SET used = true WHERE sha256 IN (SELECT sha256 FROM changed) AND NOT used;
    RETURN NULL;
END;
$$;

CREATE FUNCTION blobs_end_use() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    PERFORM FROM blobs WHERE sha256 IN (SELECT sha256 FROM changed) AND used ORDER BY sha256 FOR NO KEY UPDATE;
    UPDATE blobs SET used = false
    WHERE sha256 IN (SELECT sha256 FROM changed) AND used
      AND NOT EXISTS (SELECT FROM blob_uses WHERE blob_uses.sha256 = blobs.sha256);
    RETURN NULL;
END;
$$;

CREATE TRIGGER blobs_begin_use AFTER INSERT ON blob_uses
    REFERENCING NEW TABLE AS changed FOR EACH STATEMENT EXECUTE FUNCTION blobs_begin_use();
CREATE TRIGGER blobs_end_use AFTER DELETE ON blob_uses
    REFERENCING OLD TABLE AS changed FOR EACH STATEMENT EXECUTE FUNCTION blobs_end_use();
