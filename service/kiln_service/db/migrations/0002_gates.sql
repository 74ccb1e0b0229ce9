-- Quality gates: what a job demands of its package, from which cameras it is looked at, and what was measured.

ALTER TABLE jobs
    ADD COLUMN gates jsonb NOT NULL DEFAULT '{}',
    ADD COLUMN cameras jsonb NOT NULL DEFAULT '{}',
    ADD COLUMN gate_results jsonb NOT NULL DEFAULT '[]',
    DROP CONSTRAINT jobs_state_check,
    ADD CONSTRAINT jobs_state_check CHECK (
        state IN ('queued', 'active', 'cancel-requested', 'canceled', 'failed', 'completed', 'gate-failed')
    );
