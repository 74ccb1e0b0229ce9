-- Queries for a clock that is set while tasks run (kiln_service.clock). They ask for the time of the clock and not for
-- that of the transaction's begin, which may lie before the setting.

-- name: database_clock
-- Seconds since 1970 by the database's clock.
SELECT extract(epoch FROM clock_timestamp())::float8 AS epoch;

-- name: clock_set_forth
-- Signs of life keep their age though the clock was set forth by so many seconds; those that came since are of now.
WITH beats AS (
    UPDATE tasks SET heartbeat = LEAST(heartbeat + make_interval(secs => %(seconds)s), clock_timestamp()) WHERE state = 'active'
)
UPDATE workers SET seen = LEAST(seen + make_interval(secs => %(seconds)s), clock_timestamp());

-- name: clock_set_back
-- The same where it was set back by so many seconds; what waits for a time does not wait longer for it.
WITH beats AS (
    UPDATE tasks SET heartbeat = heartbeat - make_interval(secs => %(seconds)s)
    WHERE state = 'active' AND heartbeat > clock_timestamp()
), sights AS (
    UPDATE workers SET seen = seen - make_interval(secs => %(seconds)s) WHERE seen > clock_timestamp()
), waits AS (
    UPDATE deliveries SET due = due - make_interval(secs => %(seconds)s) WHERE outcome = 'pending'
)
UPDATE blocks SET until = until - make_interval(secs => %(seconds)s);

-- name: forget_the_future
-- No worker was heard of later than now, whatever its row says.
WITH beats AS (
    UPDATE tasks SET heartbeat = clock_timestamp() WHERE state = 'active' AND heartbeat > clock_timestamp()
)
UPDATE workers SET seen = clock_timestamp() WHERE seen > clock_timestamp();
