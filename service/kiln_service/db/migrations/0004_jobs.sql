-- What people do with jobs: pause, archive, retry, rank, label; one job for a request that is sent twice; light fields
-- that an earlier job has rendered.

ALTER TABLE jobs
    ADD COLUMN priority integer NOT NULL DEFAULT 50 CHECK (priority BETWEEN 0 AND 100),
    ADD COLUMN labels jsonb NOT NULL DEFAULT '{}',
    ADD COLUMN submitter text,
    ADD COLUMN idempotency_key text,
    ADD COLUMN request_sha256 text,
    ADD COLUMN render_key text,         -- hash of all that its light fields depend on, once it is prepared
    ADD COLUMN renders_of text REFERENCES jobs,
    ADD CONSTRAINT jobs_are_submitted_once UNIQUE (submitter, idempotency_key),
    DROP CONSTRAINT jobs_state_check,
    ADD CONSTRAINT jobs_state_check CHECK (
        state IN (
            'queued', 'active', 'paused', 'cancel-requested', 'canceled', 'failed', 'completed', 'gate-failed', 'archived'
        )
    );

CREATE INDEX jobs_by_render_key ON jobs (render_key) WHERE render_key IS NOT NULL;
CREATE INDEX jobs_by_label ON jobs USING gin (labels jsonb_path_ops);
