-- Metrics count the attempts that ended without a result at every scrape.

CREATE INDEX events_by_kind ON events (kind);
