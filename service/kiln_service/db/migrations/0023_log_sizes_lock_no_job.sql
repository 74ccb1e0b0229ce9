-- A heartbeat that logs checked that its job exists, and so took the job's lock after its task's: the reverse of the
-- order of every other transaction, so that the two could deadlock. The task's own reference says as much.
ALTER TABLE log_sizes DROP CONSTRAINT log_sizes_job_id_fkey;
