-- How long the log of each attempt is and how much of it was dropped, so that logs can be bounded without reading them.

ALTER TABLE task_logs ADD COLUMN bytes integer GENERATED ALWAYS AS (octet_length(lines)) STORED;

CREATE TABLE log_sizes (
    task_id text NOT NULL REFERENCES tasks,
    attempt integer NOT NULL,
    job_id text NOT NULL REFERENCES jobs,
    bytes bigint NOT NULL,
    dropped bigint NOT NULL DEFAULT 0,
    PRIMARY KEY (task_id, attempt)
);

CREATE INDEX log_sizes_by_job ON log_sizes (job_id);

INSERT INTO log_sizes (task_id, attempt, job_id, bytes)
SELECT task_id, task_logs.attempt, job_id, sum(bytes) FROM task_logs JOIN tasks ON tasks.id = task_id
GROUP BY task_id, task_logs.attempt, job_id;

-- Kept by triggers: whoever writes or drops a piece of a log, its size is right.
CREATE FUNCTION count_added_log() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO log_sizes AS sizes (task_id, attempt, job_id, bytes)
    SELECT added.task_id, added.attempt, tasks.job_id, sum(added.bytes)
    FROM added JOIN tasks ON tasks.id = added.task_id
    GROUP BY added.task_id, added.attempt, tasks.job_id
    ON CONFLICT (task_id, attempt) DO UPDATE SET bytes = sizes.bytes + EXCLUDED.bytes;
    RETURN NULL;
END;
$$;

CREATE TRIGGER count_added_log AFTER INSERT ON task_logs
    REFERENCING NEW TABLE AS added FOR EACH STATEMENT EXECUTE FUNCTION count_added_log();

CREATE FUNCTION count_dropped_log() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    UPDATE log_sizes SET bytes = log_sizes.bytes - gone.bytes, dropped = log_sizes.dropped + gone.bytes
    FROM (SELECT task_id, attempt, sum(bytes) AS bytes FROM dropped GROUP BY task_id, attempt) AS gone
    WHERE log_sizes.task_id = gone.task_id AND log_sizes.attempt = gone.attempt;
    RETURN NULL;
END;
$$;

CREATE TRIGGER count_dropped_log AFTER DELETE ON task_logs
    REFERENCING OLD TABLE AS dropped FOR EACH STATEMENT EXECUTE FUNCTION count_dropped_log();
