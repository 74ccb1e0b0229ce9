-- Queries of kiln_service.sessions.

-- name: insert_session
-- Someone signed in; sessions that are over go.
WITH over AS (
    DELETE FROM sessions WHERE expires < now()
)
INSERT INTO sessions (sha256, token_sha256, expires)
VALUES (%(sha256)s, %(token_sha256)s, now() + make_interval(secs => %(seconds)s));

-- name: find_sessions
-- The tokens that sessions stand for.
SELECT sha256, token_sha256 FROM sessions WHERE sha256 = ANY(%(hashes)s) AND expires > now();

-- name: delete_session
-- Someone signed out.
DELETE FROM sessions WHERE sha256 = %(sha256)s;
