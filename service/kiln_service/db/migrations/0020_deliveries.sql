-- Each webhook's due tellings, so that one with a thousand of them keeps no other waiting.

CREATE INDEX deliveries_due_by_webhook ON deliveries (webhook_id, due) WHERE outcome = 'pending';

DROP INDEX deliveries_due;
