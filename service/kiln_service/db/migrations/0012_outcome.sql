-- How a job ended, which an archived one no longer tells by its state.

ALTER TABLE jobs ADD COLUMN outcome text CHECK (outcome IN ('completed', 'gate-failed', 'failed', 'canceled'));

UPDATE jobs
SET outcome = CASE
    WHEN state <> 'archived' THEN state
    WHEN error ->> 'code' = 'gate-failed' THEN 'gate-failed'
    WHEN error IS NOT NULL THEN 'failed'
    WHEN EXISTS (SELECT FROM artifacts WHERE artifacts.job_id = jobs.id) THEN 'completed'
    ELSE 'canceled'
END
WHERE state IN ('completed', 'gate-failed', 'failed', 'canceled', 'archived');
