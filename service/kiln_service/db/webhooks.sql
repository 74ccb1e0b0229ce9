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
-- Due tellings, taken by one coordinator: no other tries them before the lease is over.
UPDATE deliveries SET attempts = attempts + 1, due = now() + make_interval(secs => %(lease_s)s)
FROM webhooks, events
WHERE deliveries.id IN (
        SELECT id FROM deliveries WHERE outcome = 'pending' AND due <= now()
        ORDER BY due LIMIT %(limit)s FOR UPDATE SKIP LOCKED
    )
  AND webhooks.id = deliveries.webhook_id AND events.id = deliveries.event_id
RETURNING deliveries.id, deliveries.attempts, webhooks.url, webhooks.secret,
          events.id AS event_id, events.at, events.job_id, events.kind, events.actor, events.detail;

-- name: end_delivery
-- It was told, or is told again after a pause, or never.
UPDATE deliveries
SET outcome = %(outcome)s, status = %(status)s, error = %(error)s, due = now() + make_interval(secs => %(pause_s)s),
    ended = CASE WHEN %(outcome)s::text = 'pending' THEN NULL ELSE now() END
WHERE id = %(id)s;
