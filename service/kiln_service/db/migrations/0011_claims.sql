-- The next task of a job is the first entry of an index, however many wait.

DROP INDEX tasks_claimable;
CREATE INDEX tasks_claimable ON tasks (job_id, rank DESC, ordinal) WHERE state IN ('queued', 'soft-failed');
