-- Queries of kiln_service.webhooks.

-- name: insert_webhook
-- Tell this URL of these events from now on.
INSERT INTO webhooks (id, url, events, secret, created_by)
VALUES (%(id)s, %(url)s, %(events)s, %(secret)s, %(actor)s) RETURNING *;

-- name: list_webhooks
-- All of them.
SELECT * FROM webhooks ORDER BY id;

-- name: delete_webhook
-- Tell this one nothing more; what was told is forgotten too.
DELETE FROM webhooks WHERE id = %(id)s RETURNING url;

-- name: list_deliveries
-- What became of each telling, newest first.
SELECT deliveries.*, events.kind AS event, events.job_id FROM deliveries JOIN events ON events.id = deliveries.event_id
WHERE webhook_id = %(webhook_id)s ORDER BY deliveries.id DESC LIMIT %(limit)s;

-- name: take_due_deliveries
-- Due tellings, taken by one coordinator: no other tries them before the lease is over. None of webhooks that are busy,
-- and at most `of_one` of each of the others.
UPDATE deliveries SET attempts = attempts + 1, due = now() + make_interval(secs => %(lease_s)s)
FROM webhooks, events
WHERE deliveries.id IN (
        SELECT next.id FROM webhooks CROSS JOIN LATERAL (
            SELECT id, due FROM deliveries
            WHERE webhook_id = webhooks.id AND outcome = 'pending' AND due <= now()
            ORDER BY due LIMIT %(of_one)s FOR UPDATE SKIP LOCKED
        ) AS next
        WHERE webhooks.id <> ALL(%(busy)s::text[])
        ORDER BY next.due LIMIT %(limit)s
    )
  AND webhooks.id = deliveries.webhook_id AND events.id = deliveries.event_id
RETURNING deliveries.id, deliveries.webhook_id, deliveries.attempts, webhooks.url, webhooks.secret,
          events.id AS event_id, events.at, events.job_id, events.kind, events.actor, events.detail;

-- name: end_delivery
-- It was told, or is told again after a pause, or never.
UPDATE deliveries
SET outcome = %(outcome)s, status = %(status)s, error = %(error)s, due = now() + make_interval(secs => %(pause_s)s),
    ended = CASE WHEN %(outcome)s::text = 'pending' THEN NULL ELSE now() END
WHERE id = %(id)s;
