-- A database as the first lightkiln left it, and its queue: a job done, one that runs, one canceled. By pg_dump; never edited.

\restrict lEB16Zmdrz9uLG1361TNtTzb7GUG6iHEVRajMsWov8NmBfr8YWXGBQOulb65y1m

SET statement_timeout = 0;
SET lock_timeout = 0;
SET idle_in_transaction_session_timeout = 0;
SET transaction_timeout = 0;
SET client_encoding = 'UTF8';
SET standard_conforming_strings = on;
SELECT pg_catalog.set_config('search_path', '', false);
SET check_function_bodies = false;
SET xmloption = content;
SET client_min_messages = warning;
SET row_security = off;

CREATE TYPE public.procrastinate_job_event_type AS ENUM (
    'deferred',
    'started',
    'deferred_for_retry',
    'failed',
    'succeeded',
    'cancelled',
    'abort_requested',
    'aborted',
    'scheduled',
    'retried'
);

CREATE TYPE public.procrastinate_job_status AS ENUM (
    'todo',
    'doing',
    'succeeded',
    'failed',
    'cancelled',
    'aborting',
    'aborted'
);

CREATE TYPE public.procrastinate_job_to_defer_v1 AS (
	queue_name character varying,
	task_name character varying,
	priority integer,
	lock text,
	queueing_lock text,
	args jsonb,
	scheduled_at timestamp with time zone
);

CREATE FUNCTION public.events_are_append_only() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
BEGIN
    RAISE EXCEPTION 'events are append-only';
END;
$$;

CREATE FUNCTION public.procrastinate_cancel_job_v1(job_id bigint, abort boolean, delete_job boolean) RETURNS bigint
    LANGUAGE plpgsql
    AS $$
DECLARE
    _job_id bigint;
BEGIN
    IF delete_job THEN
        DELETE FROM procrastinate_jobs
        WHERE id = job_id AND status = 'todo'
        RETURNING id INTO _job_id;
    END IF;
    IF _job_id IS NULL THEN
        IF abort THEN
            UPDATE procrastinate_jobs
            SET abort_requested = true,
                status = CASE status
                    WHEN 'todo' THEN 'cancelled'::procrastinate_job_status ELSE status
                END
            WHERE id = job_id AND status IN ('todo', 'doing')
            RETURNING id INTO _job_id;
        ELSE
            UPDATE procrastinate_jobs
            SET status = 'cancelled'::procrastinate_job_status
            WHERE id = job_id AND status = 'todo'
            RETURNING id INTO _job_id;
        END IF;
    END IF;
    RETURN _job_id;
END;
$$;

CREATE FUNCTION public.procrastinate_defer_jobs_v1(jobs public.procrastinate_job_to_defer_v1[]) RETURNS bigint[]
    LANGUAGE plpgsql
    AS $$
DECLARE
    job_ids bigint[];
BEGIN
    WITH inserted_jobs AS (
        INSERT INTO procrastinate_jobs (queue_name, task_name, priority, lock, queueing_lock, args, scheduled_at)
        SELECT (job).queue_name,
               (job).task_name,
               (job).priority,
               (job).lock,
               (job).queueing_lock,
               (job).args,
               (job).scheduled_at
        FROM unnest(jobs) AS job
        RETURNING id
    )
    SELECT array_agg(id) FROM inserted_jobs INTO job_ids;

    RETURN job_ids;
END;
$$;

CREATE FUNCTION public.procrastinate_defer_periodic_job_v2(_queue_name character varying, _lock character varying, _queueing_lock character varying, _task_name character varying, _priority integer, _periodic_id character varying, _defer_timestamp bigint, _args jsonb) RETURNS bigint
    LANGUAGE plpgsql
    AS $$
DECLARE
	_job_id bigint;
	_defer_id bigint;
BEGIN
    INSERT
        INTO procrastinate_periodic_defers (task_name, periodic_id, defer_timestamp)
        VALUES (_task_name, _periodic_id, _defer_timestamp)
        ON CONFLICT DO NOTHING
        RETURNING id into _defer_id;

    IF _defer_id IS NULL THEN
        RETURN NULL;
    END IF;

    UPDATE procrastinate_periodic_defers
        SET job_id = (
            SELECT COALESCE((
                SELECT unnest(procrastinate_defer_jobs_v1(
                    ARRAY[
                        ROW(
                            _queue_name,
                            _task_name,
                            _priority,
                            _lock,
                            _queueing_lock,
                            _args,
                            NULL::timestamptz
                        )
                    ]::procrastinate_job_to_defer_v1[]
                ))
            ), NULL)
        )
        WHERE id = _defer_id
        RETURNING job_id INTO _job_id;

    DELETE
        FROM procrastinate_periodic_defers
        USING (
            SELECT id
            FROM procrastinate_periodic_defers
            WHERE procrastinate_periodic_defers.task_name = _task_name
            AND procrastinate_periodic_defers.periodic_id = _periodic_id
            AND procrastinate_periodic_defers.defer_timestamp < _defer_timestamp
            ORDER BY id
            FOR UPDATE
        ) to_delete
        WHERE procrastinate_periodic_defers.id = to_delete.id;

    RETURN _job_id;
END;
$$;

SET default_tablespace = '';

SET default_table_access_method = heap;

CREATE TABLE public.procrastinate_jobs (
    id bigint NOT NULL,
    queue_name character varying(128) NOT NULL,
    task_name character varying(128) NOT NULL,
    priority integer DEFAULT 0 NOT NULL,
    lock text,
    queueing_lock text,
    args jsonb DEFAULT '{}'::jsonb NOT NULL,
    status public.procrastinate_job_status DEFAULT 'todo'::public.procrastinate_job_status NOT NULL,
    scheduled_at timestamp with time zone,
    attempts integer DEFAULT 0 NOT NULL,
    abort_requested boolean DEFAULT false NOT NULL,
    worker_id bigint,
    CONSTRAINT check_not_todo_abort_requested CHECK ((NOT ((status = 'todo'::public.procrastinate_job_status) AND (abort_requested = true))))
);

CREATE FUNCTION public.procrastinate_fetch_job_v2(target_queue_names character varying[], p_worker_id bigint) RETURNS public.procrastinate_jobs
    LANGUAGE plpgsql
    AS $$
DECLARE
	found_jobs procrastinate_jobs;
BEGIN
    WITH candidate AS (
        SELECT jobs.*
            FROM procrastinate_jobs AS jobs
            WHERE
                -- reject the job if its lock has earlier or higher priority jobs
                NOT EXISTS (
                    SELECT 1
                        FROM procrastinate_jobs AS other_jobs
                        WHERE
                            jobs.lock IS NOT NULL
                            AND other_jobs.lock = jobs.lock
                            AND (
                                -- job with same lock is already running
                                other_jobs.status = 'doing'
                                OR
                                -- job with same lock is waiting and has higher priority (or same priority but was queued first)
                                (
                                    other_jobs.status = 'todo'
                                    AND (
                                        other_jobs.priority > jobs.priority
                                        OR (
                                        other_jobs.priority = jobs.priority
                                        AND other_jobs.id < jobs.id
                                        )
                                    )
                                )
                            )
                )
                AND jobs.status = 'todo'
                AND (target_queue_names IS NULL OR jobs.queue_name = ANY( target_queue_names ))
                AND (jobs.scheduled_at IS NULL OR jobs.scheduled_at <= now())
            ORDER BY jobs.priority DESC, jobs.id ASC LIMIT 1
            FOR UPDATE OF jobs SKIP LOCKED
    )
    UPDATE procrastinate_jobs
        SET status = 'doing', worker_id = p_worker_id
        FROM candidate
        WHERE procrastinate_jobs.id = candidate.id
        RETURNING procrastinate_jobs.* INTO found_jobs;

 RETURN found_jobs;
END;
$$;

CREATE FUNCTION public.procrastinate_finish_job_v1(job_id bigint, end_status public.procrastinate_job_status, delete_job boolean) RETURNS void
    LANGUAGE plpgsql
    AS $$
DECLARE
    _job_id bigint;
BEGIN
    IF end_status NOT IN ('succeeded', 'failed', 'aborted') THEN
        RAISE 'End status should be either "succeeded", "failed" or "aborted" (job id: %)', job_id;
    END IF;
    IF delete_job THEN
        DELETE FROM procrastinate_jobs
        WHERE id = job_id AND status IN ('todo', 'doing')
        RETURNING id INTO _job_id;
    ELSE
        UPDATE procrastinate_jobs
        SET status = end_status,
            abort_requested = false,
            attempts = CASE status
                WHEN 'doing' THEN attempts + 1 ELSE attempts
            END
        WHERE id = job_id AND status IN ('todo', 'doing')
        RETURNING id INTO _job_id;
    END IF;
    IF _job_id IS NULL THEN
        RAISE 'Job was not found or not in "doing" or "todo" status (job id: %)', job_id;
    END IF;
END;
$$;

CREATE FUNCTION public.procrastinate_notify_queue_abort_job_v1() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
DECLARE
    payload TEXT;
BEGIN
    SELECT json_build_object('type', 'abort_job_requested', 'job_id', NEW.id)::text INTO payload;
	PERFORM pg_notify('procrastinate_queue_v1#' || NEW.queue_name, payload);
	PERFORM pg_notify('procrastinate_any_queue_v1', payload);
	RETURN NEW;
END;
$$;

CREATE FUNCTION public.procrastinate_notify_queue_job_inserted_v1() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
DECLARE
    payload TEXT;
BEGIN
    SELECT json_build_object('type', 'job_inserted', 'job_id', NEW.id)::text INTO payload;
	PERFORM pg_notify('procrastinate_queue_v1#' || NEW.queue_name, payload);
	PERFORM pg_notify('procrastinate_any_queue_v1', payload);
	RETURN NEW;
END;
$$;

CREATE FUNCTION public.procrastinate_prune_stalled_workers_v1(seconds_since_heartbeat double precision) RETURNS TABLE(worker_id bigint)
    LANGUAGE plpgsql
    AS $$
BEGIN
    RETURN QUERY
    DELETE FROM procrastinate_workers
    WHERE last_heartbeat < NOW() - (seconds_since_heartbeat || 'SECOND')::INTERVAL
    RETURNING procrastinate_workers.id;
END;
$$;

CREATE FUNCTION public.procrastinate_register_worker_v1() RETURNS TABLE(worker_id bigint)
    LANGUAGE plpgsql
    AS $$
BEGIN
    RETURN QUERY
    INSERT INTO procrastinate_workers DEFAULT VALUES
    RETURNING procrastinate_workers.id;
END;
$$;

CREATE FUNCTION public.procrastinate_retry_job_v1(job_id bigint, retry_at timestamp with time zone, new_priority integer, new_queue_name character varying, new_lock character varying) RETURNS void
    LANGUAGE plpgsql
    AS $$
DECLARE
    _job_id bigint;
    _abort_requested boolean;
BEGIN
    SELECT abort_requested FROM procrastinate_jobs
    WHERE id = job_id AND status = 'doing'
    FOR UPDATE
    INTO _abort_requested;
    IF _abort_requested THEN
        UPDATE procrastinate_jobs
        SET status = 'failed'::procrastinate_job_status
        WHERE id = job_id AND status = 'doing'
        RETURNING id INTO _job_id;
    ELSE
        UPDATE procrastinate_jobs
        SET status = 'todo'::procrastinate_job_status,
            attempts = attempts + 1,
            scheduled_at = retry_at,
            priority = COALESCE(new_priority, priority),
            queue_name = COALESCE(new_queue_name, queue_name),
            lock = COALESCE(new_lock, lock)
        WHERE id = job_id AND status = 'doing'
        RETURNING id INTO _job_id;
    END IF;

    IF _job_id IS NULL THEN
        RAISE 'Job was not found or not in "doing" status (job id: %)', job_id;
    END IF;
END;
$$;

CREATE FUNCTION public.procrastinate_retry_job_v2(job_id bigint, retry_at timestamp with time zone, new_priority integer, new_queue_name character varying, new_lock character varying) RETURNS void
    LANGUAGE plpgsql
    AS $$
DECLARE
    _job_id bigint;
    _abort_requested boolean;
    _current_status procrastinate_job_status;
BEGIN
    SELECT status, abort_requested FROM procrastinate_jobs
    WHERE id = job_id AND status IN ('doing', 'failed')
    FOR UPDATE
    INTO _current_status, _abort_requested;
    IF _current_status = 'doing' AND _abort_requested THEN
        UPDATE procrastinate_jobs
        SET status = 'failed'::procrastinate_job_status
        WHERE id = job_id AND status = 'doing'
        RETURNING id INTO _job_id;
    ELSE
        UPDATE procrastinate_jobs
        SET status = 'todo'::procrastinate_job_status,
            attempts = attempts + 1,
            scheduled_at = retry_at,
            priority = COALESCE(new_priority, priority),
            queue_name = COALESCE(new_queue_name, queue_name),
            lock = COALESCE(new_lock, lock)
        WHERE id = job_id AND status IN ('doing', 'failed')
        RETURNING id INTO _job_id;
    END IF;

    IF _job_id IS NULL THEN
        RAISE 'Job was not found or has an invalid status to retry (job id: %)', job_id;
    END IF;

END;
$$;

CREATE FUNCTION public.procrastinate_trigger_abort_requested_events_procedure_v1() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
BEGIN
    INSERT INTO procrastinate_events(job_id, type)
        VALUES (NEW.id, 'abort_requested'::procrastinate_job_event_type);
    RETURN NEW;
END;
$$;

CREATE FUNCTION public.procrastinate_trigger_function_scheduled_events_v1() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
BEGIN
    INSERT INTO procrastinate_events(job_id, type, at)
        VALUES (NEW.id, 'scheduled'::procrastinate_job_event_type, NEW.scheduled_at);

	RETURN NEW;
END;
$$;

CREATE FUNCTION public.procrastinate_trigger_function_status_events_insert_v1() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
BEGIN
    INSERT INTO procrastinate_events(job_id, type)
        VALUES (NEW.id, 'deferred'::procrastinate_job_event_type);
	RETURN NEW;
END;
$$;

CREATE FUNCTION public.procrastinate_trigger_function_status_events_update_v1() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
BEGIN
    WITH t AS (
        SELECT CASE
            WHEN OLD.status = 'todo'::procrastinate_job_status
                AND NEW.status = 'doing'::procrastinate_job_status
                THEN 'started'::procrastinate_job_event_type
            WHEN OLD.status = 'doing'::procrastinate_job_status
                AND NEW.status = 'todo'::procrastinate_job_status
                THEN 'deferred_for_retry'::procrastinate_job_event_type
            WHEN OLD.status = 'doing'::procrastinate_job_status
                AND NEW.status = 'failed'::procrastinate_job_status
                THEN 'failed'::procrastinate_job_event_type
            WHEN OLD.status = 'doing'::procrastinate_job_status
                AND NEW.status = 'succeeded'::procrastinate_job_status
                THEN 'succeeded'::procrastinate_job_event_type
            WHEN OLD.status = 'todo'::procrastinate_job_status
                AND (
                    NEW.status = 'cancelled'::procrastinate_job_status
                    OR NEW.status = 'failed'::procrastinate_job_status
                    OR NEW.status = 'succeeded'::procrastinate_job_status
                )
                THEN 'cancelled'::procrastinate_job_event_type
            WHEN OLD.status = 'doing'::procrastinate_job_status
                AND NEW.status = 'aborted'::procrastinate_job_status
                THEN 'aborted'::procrastinate_job_event_type
            WHEN OLD.status = 'failed'::procrastinate_job_status
                AND NEW.status = 'todo'::procrastinate_job_status
                THEN 'retried'::procrastinate_job_event_type
            ELSE NULL
        END as event_type
    )
    INSERT INTO procrastinate_events(job_id, type)
        SELECT NEW.id, t.event_type
        FROM t
        WHERE t.event_type IS NOT NULL;
	RETURN NEW;
END;
$$;

CREATE FUNCTION public.procrastinate_unlink_periodic_defers_v1() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
BEGIN
    UPDATE procrastinate_periodic_defers
    SET job_id = NULL
    WHERE job_id = OLD.id;
    RETURN OLD;
END;
$$;

CREATE FUNCTION public.procrastinate_unregister_worker_v1(worker_id bigint) RETURNS void
    LANGUAGE plpgsql
    AS $$
BEGIN
    DELETE FROM procrastinate_workers
    WHERE id = worker_id;
END;
$$;

CREATE FUNCTION public.procrastinate_update_heartbeat_v1(worker_id bigint) RETURNS void
    LANGUAGE plpgsql
    AS $$
BEGIN
    UPDATE procrastinate_workers
    SET last_heartbeat = NOW()
    WHERE id = worker_id;
END;
$$;

CREATE TABLE public.artifacts (
    job_id text NOT NULL,
    name text NOT NULL,
    sha256 text NOT NULL,
    size bigint NOT NULL,
    media_type text NOT NULL
);

CREATE TABLE public.blob_uses (
    sha256 text NOT NULL,
    owner text NOT NULL
);

CREATE TABLE public.blobs (
    sha256 text NOT NULL,
    size bigint NOT NULL,
    created timestamp with time zone DEFAULT now() NOT NULL,
    touched timestamp with time zone DEFAULT now() NOT NULL
);

CREATE TABLE public.events (
    id bigint NOT NULL,
    at timestamp with time zone DEFAULT clock_timestamp() NOT NULL,
    job_id text NOT NULL,
    task_id text,
    kind text NOT NULL,
    actor text NOT NULL,
    detail jsonb DEFAULT '{}'::jsonb NOT NULL
);

ALTER TABLE public.events ALTER COLUMN id ADD GENERATED ALWAYS AS IDENTITY (
    SEQUENCE NAME public.events_id_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1
);

CREATE TABLE public.jobs (
    id text NOT NULL,
    name text NOT NULL,
    method text NOT NULL,
    state text NOT NULL,
    settings jsonb NOT NULL,
    bundle jsonb NOT NULL,
    store_url text NOT NULL,
    notes jsonb DEFAULT '[]'::jsonb NOT NULL,
    error jsonb,
    created timestamp with time zone DEFAULT now() NOT NULL,
    started timestamp with time zone,
    finished timestamp with time zone,
    CONSTRAINT jobs_state_check CHECK ((state = ANY (ARRAY['queued'::text, 'active'::text, 'cancel-requested'::text, 'canceled'::text, 'failed'::text, 'completed'::text])))
);

CREATE TABLE public.kiln_migrations (
    version integer NOT NULL,
    name text NOT NULL,
    sha256 text NOT NULL,
    applied timestamp with time zone DEFAULT now() NOT NULL
);

CREATE TABLE public.procrastinate_events (
    id bigint NOT NULL,
    job_id bigint NOT NULL,
    type public.procrastinate_job_event_type,
    at timestamp with time zone DEFAULT now()
);

CREATE SEQUENCE public.procrastinate_events_id_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;

ALTER SEQUENCE public.procrastinate_events_id_seq OWNED BY public.procrastinate_events.id;

CREATE SEQUENCE public.procrastinate_jobs_id_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;

ALTER SEQUENCE public.procrastinate_jobs_id_seq OWNED BY public.procrastinate_jobs.id;

CREATE TABLE public.procrastinate_periodic_defers (
    id bigint NOT NULL,
    task_name character varying(128) NOT NULL,
    defer_timestamp bigint,
    job_id bigint,
    periodic_id character varying(128) DEFAULT ''::character varying NOT NULL
);

CREATE SEQUENCE public.procrastinate_periodic_defers_id_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;

ALTER SEQUENCE public.procrastinate_periodic_defers_id_seq OWNED BY public.procrastinate_periodic_defers.id;

CREATE TABLE public.procrastinate_workers (
    id bigint NOT NULL,
    last_heartbeat timestamp with time zone DEFAULT now() NOT NULL
);

ALTER TABLE public.procrastinate_workers ALTER COLUMN id ADD GENERATED ALWAYS AS IDENTITY (
    SEQUENCE NAME public.procrastinate_workers_id_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1
);

CREATE TABLE public.task_logs (
    id bigint NOT NULL,
    task_id text NOT NULL,
    attempt integer NOT NULL,
    at timestamp with time zone DEFAULT clock_timestamp() NOT NULL,
    lines text NOT NULL
);

ALTER TABLE public.task_logs ALTER COLUMN id ADD GENERATED ALWAYS AS IDENTITY (
    SEQUENCE NAME public.task_logs_id_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1
);

CREATE TABLE public.tasks (
    id text NOT NULL,
    job_id text NOT NULL,
    ordinal integer NOT NULL,
    kind text NOT NULL,
    label text NOT NULL,
    state text NOT NULL,
    attempt integer DEFAULT 0 NOT NULL,
    strikes integer DEFAULT 0 NOT NULL,
    spec jsonb NOT NULL,
    result jsonb,
    progress jsonb,
    worker_id text,
    checkpoint text,
    error jsonb,
    queue_job bigint,
    created timestamp with time zone DEFAULT now() NOT NULL,
    started timestamp with time zone,
    finished timestamp with time zone,
    heartbeat timestamp with time zone,
    CONSTRAINT tasks_check CHECK (((state = 'completed'::text) = (result IS NOT NULL))),
    CONSTRAINT tasks_kind_check CHECK ((kind = ANY (ARRAY['prepare'::text, 'render'::text, 'fit'::text, 'package'::text]))),
    CONSTRAINT tasks_state_check CHECK ((state = ANY (ARRAY['waiting'::text, 'queued'::text, 'active'::text, 'failed'::text, 'canceled'::text, 'completed'::text])))
);

CREATE TABLE public.workers (
    id text NOT NULL,
    name text NOT NULL,
    kinds text[] NOT NULL,
    memory_bytes bigint NOT NULL,
    threads integer NOT NULL,
    device text NOT NULL,
    version text NOT NULL,
    queue_worker bigint NOT NULL,
    registered timestamp with time zone DEFAULT now() NOT NULL,
    seen timestamp with time zone DEFAULT now() NOT NULL
);

ALTER TABLE ONLY public.procrastinate_events ALTER COLUMN id SET DEFAULT nextval('public.procrastinate_events_id_seq'::regclass);

ALTER TABLE ONLY public.procrastinate_jobs ALTER COLUMN id SET DEFAULT nextval('public.procrastinate_jobs_id_seq'::regclass);

ALTER TABLE ONLY public.procrastinate_periodic_defers ALTER COLUMN id SET DEFAULT nextval('public.procrastinate_periodic_defers_id_seq'::regclass);

COPY public.artifacts (job_id, name, sha256, size, media_type) FROM stdin;
01a212ab928c792ca951909e4270eadd	lightfield.ktx2	ab6c5f3237f551d208fc2ca5225a4cca20b3fd638794a804f0ed5549d5041734	1000	image/ktx2
01a212ab928c792ca951909e4270eadd	shaders/light.glsl	ab6c5f3237f551d208fc2ca5225a4cca20b3fd638794a804f0ed5549d5041734	1000	text/plain
\.

COPY public.blob_uses (sha256, owner) FROM stdin;
d6b00d693f813db59886beb214cc6e1939fe3d29fc1b4349616adf2d36ebdc6a	job:01a212ab928c792ca951909e4270eadd
329af5856767176fcc7e1e8935912f2891c34647886476fe91f2571e15ceffbc	result:01a212ab928e7ba7a1e6874a5e0c522e
be7b3cfb9a16087c51d1714db149d21bbfe9c86a4ebbe230b6e87cf1f54bcad0	result:01a212ab928e7ba7a1e6874a5e0c522e
d2eadc142a76428057f18cb26829f738b2ad5cbe8e6ea945f2ef4be65aeafa3b	result:01a212ab92c1701cb6403ff73bec918c
ab6c5f3237f551d208fc2ca5225a4cca20b3fd638794a804f0ed5549d5041734	result:01a212ab92c17cbbbfab01d2138311d9
d6b00d693f813db59886beb214cc6e1939fe3d29fc1b4349616adf2d36ebdc6a	job:01a212ab93437e2898824c835153df88
329af5856767176fcc7e1e8935912f2891c34647886476fe91f2571e15ceffbc	result:01a212ab93447328a6b20290634863cc
be7b3cfb9a16087c51d1714db149d21bbfe9c86a4ebbe230b6e87cf1f54bcad0	result:01a212ab93447328a6b20290634863cc
d6b00d693f813db59886beb214cc6e1939fe3d29fc1b4349616adf2d36ebdc6a	job:01a212ab93da7763b2330b380219a5d6
\.

COPY public.blobs (sha256, size, created, touched) FROM stdin;
d2eadc142a76428057f18cb26829f738b2ad5cbe8e6ea945f2ef4be65aeafa3b	11	2026-11-25 12:26:03.881845+00	2026-11-25 12:26:03.881845+00
ab6c5f3237f551d208fc2ca5225a4cca20b3fd638794a804f0ed5549d5041734	1000	2026-11-25 12:26:03.906998+00	2026-11-25 12:26:03.932511+00
be7b3cfb9a16087c51d1714db149d21bbfe9c86a4ebbe230b6e87cf1f54bcad0	12	2026-11-25 12:26:03.812636+00	2026-11-25 12:26:03.988458+00
329af5856767176fcc7e1e8935912f2891c34647886476fe91f2571e15ceffbc	9	2026-11-25 12:26:03.823765+00	2026-11-25 12:26:03.998563+00
d6b00d693f813db59886beb214cc6e1939fe3d29fc1b4349616adf2d36ebdc6a	7	2026-11-25 12:26:03.780549+00	2026-11-25 12:26:04.114239+00
\.

COPY public.events (id, at, job_id, task_id, kind, actor, detail) FROM stdin;
1	2026-11-25 12:26:03.789652+00	01a212ab928c792ca951909e4270eadd	\N	job.created	client:owner	{"name": "done"}
2	2026-11-25 12:26:03.794048+00	01a212ab928c792ca951909e4270eadd	\N	tasks.planned	coordinator	{"prepare": 1}
3	2026-11-25 12:26:03.804877+00	01a212ab928c792ca951909e4270eadd	\N	job.active	coordinator	{}
4	2026-11-25 12:26:03.805192+00	01a212ab928c792ca951909e4270eadd	01a212ab928e7ba7a1e6874a5e0c522e	task.claimed	worker:01a212ab926a7e5a8b9c5c6f76081d02	{"kind": "prepare", "label": "scene", "worker": "old", "attempt": 1}
5	2026-11-25 12:26:03.840814+00	01a212ab928c792ca951909e4270eadd	01a212ab928e7ba7a1e6874a5e0c522e	task.completed	worker:01a212ab926a7e5a8b9c5c6f76081d02	{"kind": "prepare", "label": "scene", "attempt": 1, "seconds": 0.5}
6	2026-11-25 12:26:03.844401+00	01a212ab928c792ca951909e4270eadd	\N	tasks.planned	coordinator	{"fit": 1, "render": 2, "package": 1}
7	2026-11-25 12:26:03.84499+00	01a212ab928c792ca951909e4270eadd	\N	stage.completed	coordinator	{"kind": "prepare"}
8	2026-11-25 12:26:03.851199+00	01a212ab928c792ca951909e4270eadd	01a212ab92c17389ac9d6eaed4743030	task.claimed	worker:01a212ab926a7e5a8b9c5c6f76081d02	{"kind": "render", "label": "tile 0,0", "worker": "old", "attempt": 1}
9	2026-11-25 12:26:03.85706+00	01a212ab928c792ca951909e4270eadd	01a212ab92c17389ac9d6eaed4743030	task.completed	worker:01a212ab926a7e5a8b9c5c6f76081d02	{"kind": "render", "label": "tile 0,0", "attempt": 1, "seconds": 0.5}
10	2026-11-25 12:26:03.863197+00	01a212ab928c792ca951909e4270eadd	01a212ab92c17f178374436c8e7a5329	task.claimed	worker:01a212ab926a7e5a8b9c5c6f76081d02	{"kind": "render", "label": "tile 0,8", "worker": "old", "attempt": 1}
11	2026-11-25 12:26:03.868808+00	01a212ab928c792ca951909e4270eadd	01a212ab92c17f178374436c8e7a5329	task.completed	worker:01a212ab926a7e5a8b9c5c6f76081d02	{"kind": "render", "label": "tile 0,8", "attempt": 1, "seconds": 0.5}
12	2026-11-25 12:26:03.86946+00	01a212ab928c792ca951909e4270eadd	\N	stage.completed	coordinator	{"kind": "render"}
13	2026-11-25 12:26:03.871515+00	01a212ab928c792ca951909e4270eadd	01a212ab92c1701cb6403ff73bec918c	task.queued	coordinator	{"kind": "fit", "label": "light_field", "attempt": 0}
14	2026-11-25 12:26:03.876648+00	01a212ab928c792ca951909e4270eadd	01a212ab92c1701cb6403ff73bec918c	task.claimed	worker:01a212ab926a7e5a8b9c5c6f76081d02	{"kind": "fit", "label": "light_field", "worker": "old", "attempt": 1}
15	2026-11-25 12:26:03.892508+00	01a212ab928c792ca951909e4270eadd	01a212ab92c1701cb6403ff73bec918c	task.completed	worker:01a212ab926a7e5a8b9c5c6f76081d02	{"kind": "fit", "label": "light_field", "attempt": 1, "seconds": 0.5}
16	2026-11-25 12:26:03.893097+00	01a212ab928c792ca951909e4270eadd	\N	stage.completed	coordinator	{"kind": "fit"}
17	2026-11-25 12:26:03.895107+00	01a212ab928c792ca951909e4270eadd	01a212ab92c17cbbbfab01d2138311d9	task.queued	coordinator	{"kind": "package", "label": "package", "attempt": 0}
18	2026-11-25 12:26:03.901855+00	01a212ab928c792ca951909e4270eadd	01a212ab92c17cbbbfab01d2138311d9	task.claimed	worker:01a212ab926a7e5a8b9c5c6f76081d02	{"kind": "package", "label": "package", "worker": "old", "attempt": 1}
19	2026-11-25 12:26:03.952069+00	01a212ab928c792ca951909e4270eadd	01a212ab92c17cbbbfab01d2138311d9	task.completed	worker:01a212ab926a7e5a8b9c5c6f76081d02	{"kind": "package", "label": "package", "attempt": 1, "seconds": 0.5}
20	2026-11-25 12:26:03.953586+00	01a212ab928c792ca951909e4270eadd	\N	job.completed	coordinator	{}
21	2026-11-25 12:26:03.972231+00	01a212ab93437e2898824c835153df88	\N	job.created	client:owner	{"name": "running"}
22	2026-11-25 12:26:03.974572+00	01a212ab93437e2898824c835153df88	\N	tasks.planned	coordinator	{"prepare": 1}
23	2026-11-25 12:26:03.984002+00	01a212ab93437e2898824c835153df88	\N	job.active	coordinator	{}
24	2026-11-25 12:26:03.984457+00	01a212ab93437e2898824c835153df88	01a212ab93447328a6b20290634863cc	task.claimed	worker:01a212ab926a7e5a8b9c5c6f76081d02	{"kind": "prepare", "label": "scene", "worker": "old", "attempt": 1}
25	2026-11-25 12:26:04.015139+00	01a212ab93437e2898824c835153df88	01a212ab93447328a6b20290634863cc	task.completed	worker:01a212ab926a7e5a8b9c5c6f76081d02	{"kind": "prepare", "label": "scene", "attempt": 1, "seconds": 0.5}
26	2026-11-25 12:26:04.023317+00	01a212ab93437e2898824c835153df88	\N	tasks.planned	coordinator	{"fit": 1, "render": 3, "package": 1}
27	2026-11-25 12:26:04.023984+00	01a212ab93437e2898824c835153df88	\N	stage.completed	coordinator	{"kind": "prepare"}
28	2026-11-25 12:26:04.038202+00	01a212ab93437e2898824c835153df88	01a212ab93747f56987208298f2e832b	task.claimed	worker:01a212ab926a7e5a8b9c5c6f76081d02	{"kind": "render", "label": "tile 0,0", "worker": "old", "attempt": 1}
29	2026-11-25 12:26:04.058901+00	01a212ab93437e2898824c835153df88	01a212ab93747f56987208298f2e832b	task.completed	worker:01a212ab926a7e5a8b9c5c6f76081d02	{"kind": "render", "label": "tile 0,0", "attempt": 1, "seconds": 0.5}
30	2026-11-25 12:26:04.089399+00	01a212ab93437e2898824c835153df88	01a212ab93747e138a929241abd9b8f9	task.claimed	worker:01a212ab926a7e5a8b9c5c6f76081d02	{"kind": "render", "label": "tile 0,8", "worker": "old", "attempt": 1}
31	2026-11-25 12:26:04.124343+00	01a212ab93da7763b2330b380219a5d6	\N	job.created	client:owner	{"name": "canceled"}
32	2026-11-25 12:26:04.126257+00	01a212ab93da7763b2330b380219a5d6	\N	tasks.planned	coordinator	{"prepare": 1}
33	2026-11-25 12:26:04.140231+00	01a212ab93da7763b2330b380219a5d6	\N	job.cancel-requested	client:owner	{}
34	2026-11-25 12:26:04.148291+00	01a212ab93da7763b2330b380219a5d6	\N	tasks.canceled	client:owner	{"count": 1}
35	2026-11-25 12:26:04.149176+00	01a212ab93da7763b2330b380219a5d6	\N	job.canceled	coordinator	{}
\.

COPY public.jobs (id, name, method, state, settings, bundle, store_url, notes, error, created, started, finished) FROM stdin;
01a212ab93da7763b2330b380219a5d6	canceled	sg_lightfield	canceled	{"fit": {"batch": 32, "lobes": 8, "steps": 1000, "window": 4096, "checkpoint_s": 60.0, "learning_rate": 0.001, "visibility_steps": 500}, "seed": 0, "preset": "draft", "render": {"samples": 32, "max_depth": 6, "image_size": 32, "irradiance_samples": 512}, "package": {"environment_size": 64}, "lightmap": {"uv": "auto", "tile": 8, "padding": 2, "resolution": 32}}	{"entry": "scene.glb", "files": {"scene.glb": "d6b00d693f813db59886beb214cc6e1939fe3d29fc1b4349616adf2d36ebdc6a"}, "environment": null}	file:///srv/lightkiln/store/01a212ab93da7763b2330b380219a5d6.zarr	[]	\N	2026-11-25 12:26:04.121487+00	\N	2026-11-25 12:26:04.136868+00
01a212ab928c792ca951909e4270eadd	done	sg_lightfield	completed	{"fit": {"batch": 32, "lobes": 8, "steps": 1000, "window": 4096, "checkpoint_s": 60.0, "learning_rate": 0.001, "visibility_steps": 500}, "seed": 0, "preset": "draft", "render": {"samples": 32, "max_depth": 6, "image_size": 32, "irradiance_samples": 512}, "package": {"environment_size": 64}, "lightmap": {"uv": "auto", "tile": 8, "padding": 2, "resolution": 32}}	{"entry": "scene.glb", "files": {"scene.glb": "d6b00d693f813db59886beb214cc6e1939fe3d29fc1b4349616adf2d36ebdc6a"}, "environment": null}	file:///srv/lightkiln/store/01a212ab928c792ca951909e4270eadd.zarr	["unwrapped"]	\N	2026-11-25 12:26:03.787599+00	2026-11-25 12:26:03.800284+00	2026-11-25 12:26:03.948749+00
01a212ab93437e2898824c835153df88	running	sg_lightfield	active	{"fit": {"batch": 32, "lobes": 8, "steps": 1000, "window": 4096, "checkpoint_s": 60.0, "learning_rate": 0.001, "visibility_steps": 500}, "seed": 0, "preset": "draft", "render": {"samples": 9, "max_depth": 6, "image_size": 32, "irradiance_samples": 512}, "package": {"environment_size": 64}, "lightmap": {"uv": "auto", "tile": 8, "padding": 2, "resolution": 32}}	{"entry": "scene.glb", "files": {"scene.glb": "d6b00d693f813db59886beb214cc6e1939fe3d29fc1b4349616adf2d36ebdc6a"}, "environment": null}	file:///srv/lightkiln/store/01a212ab93437e2898824c835153df88.zarr	["unwrapped"]	\N	2026-11-25 12:26:03.971184+00	2026-11-25 12:26:03.980164+00	\N
\.

COPY public.kiln_migrations (version, name, sha256, applied) FROM stdin;
1	0001_initial.sql	fcb605fc37af64643ecab317023373eb5c392cbfe41f46326976365ebf231537	2026-11-25 12:26:03.650065+00
\.

COPY public.procrastinate_events (id, job_id, type, at) FROM stdin;
14	8	deferred	2026-11-25 12:26:04.009382+00
15	9	deferred	2026-11-25 12:26:04.009382+00
17	8	started	2026-11-25 12:26:04.070145+00
\.

COPY public.procrastinate_jobs (id, queue_name, task_name, priority, lock, queueing_lock, args, status, scheduled_at, attempts, abort_requested, worker_id) FROM stdin;
9	render	kiln.task	1	\N	01a212ab937479878ab1332a371e3d62	{"task_id": "01a212ab937479878ab1332a371e3d62"}	todo	\N	0	f	\N
8	render	kiln.task	1	\N	01a212ab93747e138a929241abd9b8f9	{"task_id": "01a212ab93747e138a929241abd9b8f9"}	doing	\N	0	f	1
\.

COPY public.procrastinate_periodic_defers (id, task_name, defer_timestamp, job_id, periodic_id) FROM stdin;
\.

COPY public.procrastinate_workers (id, last_heartbeat) FROM stdin;
1	2026-11-25 12:26:04.099686+00
\.

COPY public.task_logs (id, task_id, attempt, at, lines) FROM stdin;
1	01a212ab93747e138a929241abd9b8f9	1	2026-11-25 12:26:04.100785+00	a line\n
\.

COPY public.tasks (id, job_id, ordinal, kind, label, state, attempt, strikes, spec, result, progress, worker_id, checkpoint, error, queue_job, created, started, finished, heartbeat) FROM stdin;
01a212ab928e7ba7a1e6874a5e0c522e	01a212ab928c792ca951909e4270eadd	0	prepare	scene	completed	1	0	{}	{"kind": "prepare", "notes": ["unwrapped"], "scene": "be7b3cfb9a16087c51d1714db149d21bbfe9c86a4ebbe230b6e87cf1f54bcad0", "tiles": [{"row": 0, "size": 8, "column": 0, "texels": 5}, {"row": 0, "size": 8, "column": 8, "texels": 5}], "seconds": 0.5, "has_light": true, "texel_map": "329af5856767176fcc7e1e8935912f2891c34647886476fe91f2571e15ceffbc", "triangles": 12, "scene_hash": "0000000000000000000000000000000000000000000000000000000000000000", "has_environment": false}	\N	01a212ab926a7e5a8b9c5c6f76081d02	\N	\N	1	2026-11-25 12:26:03.787599+00	2026-11-25 12:26:03.800284+00	2026-11-25 12:26:03.835767+00	\N
01a212ab92c17389ac9d6eaed4743030	01a212ab928c792ca951909e4270eadd	1	render	tile 0,0	completed	1	0	{"tile": {"row": 0, "size": 8, "column": 0, "texels": 5}}	{"kind": "render", "tile": {"row": 0, "size": 8, "column": 0, "texels": 5}, "paths": 10, "invalid": 0, "seconds": 0.5, "overflows": 0, "invalid_texels": []}	\N	01a212ab926a7e5a8b9c5c6f76081d02	\N	\N	2	2026-11-25 12:26:03.835767+00	2026-11-25 12:26:03.848138+00	2026-11-25 12:26:03.854189+00	\N
01a212ab92c17f178374436c8e7a5329	01a212ab928c792ca951909e4270eadd	2	render	tile 0,8	completed	1	0	{"tile": {"row": 0, "size": 8, "column": 8, "texels": 5}}	{"kind": "render", "tile": {"row": 0, "size": 8, "column": 8, "texels": 5}, "paths": 10, "invalid": 0, "seconds": 0.5, "overflows": 0, "invalid_texels": []}	\N	01a212ab926a7e5a8b9c5c6f76081d02	\N	\N	3	2026-11-25 12:26:03.835767+00	2026-11-25 12:26:03.859637+00	2026-11-25 12:26:03.866+00	\N
01a212ab92c1701cb6403ff73bec918c	01a212ab928c792ca951909e4270eadd	3	fit	light_field	completed	1	0	{"function": "light_field"}	{"kind": "fit", "curve": [], "steps": 1, "metrics": {"signal": true, "texels": 10, "log_mse": 0.1, "log_mse_rel": 0.1, "log_mse_zero": 1.0}, "seconds": 0.5, "weights": "d2eadc142a76428057f18cb26829f738b2ad5cbe8e6ea945f2ef4be65aeafa3b", "exposure": 1.0, "function": "light_field"}	\N	01a212ab926a7e5a8b9c5c6f76081d02	\N	\N	4	2026-11-25 12:26:03.835767+00	2026-11-25 12:26:03.873793+00	2026-11-25 12:26:03.888856+00	\N
01a212ab92c17cbbbfab01d2138311d9	01a212ab928c792ca951909e4270eadd	4	package	package	completed	1	0	{}	{"kind": "package", "seconds": 0.5, "artifacts": [{"name": "lightfield.ktx2", "size": 1000, "sha256": "ab6c5f3237f551d208fc2ca5225a4cca20b3fd638794a804f0ed5549d5041734", "media_type": "image/ktx2"}, {"name": "shaders/light.glsl", "size": 1000, "sha256": "ab6c5f3237f551d208fc2ca5225a4cca20b3fd638794a804f0ed5549d5041734", "media_type": "text/plain"}]}	\N	01a212ab926a7e5a8b9c5c6f76081d02	\N	\N	5	2026-11-25 12:26:03.835767+00	2026-11-25 12:26:03.897693+00	2026-11-25 12:26:03.948749+00	\N
01a212ab93447328a6b20290634863cc	01a212ab93437e2898824c835153df88	0	prepare	scene	completed	1	0	{}	{"kind": "prepare", "notes": ["unwrapped"], "scene": "be7b3cfb9a16087c51d1714db149d21bbfe9c86a4ebbe230b6e87cf1f54bcad0", "tiles": [{"row": 0, "size": 8, "column": 0, "texels": 5}, {"row": 0, "size": 8, "column": 8, "texels": 5}, {"row": 0, "size": 8, "column": 16, "texels": 5}], "seconds": 0.5, "has_light": true, "texel_map": "329af5856767176fcc7e1e8935912f2891c34647886476fe91f2571e15ceffbc", "triangles": 12, "scene_hash": "0000000000000000000000000000000000000000000000000000000000000000", "has_environment": false}	\N	01a212ab926a7e5a8b9c5c6f76081d02	\N	\N	6	2026-11-25 12:26:03.971184+00	2026-11-25 12:26:03.980164+00	2026-11-25 12:26:04.009382+00	\N
01a212ab937479b8926269a129f0b4a4	01a212ab93437e2898824c835153df88	4	fit	light_field	waiting	0	0	{"function": "light_field"}	\N	\N	\N	\N	\N	\N	2026-11-25 12:26:04.009382+00	\N	\N	\N
01a212ab937479f99eababef9ef85c78	01a212ab93437e2898824c835153df88	5	package	package	waiting	0	0	{}	\N	\N	\N	\N	\N	\N	2026-11-25 12:26:04.009382+00	\N	\N	\N
01a212ab937479878ab1332a371e3d62	01a212ab93437e2898824c835153df88	3	render	tile 0,16	queued	0	0	{"tile": {"row": 0, "size": 8, "column": 16, "texels": 5}}	\N	\N	\N	\N	\N	9	2026-11-25 12:26:04.009382+00	\N	\N	\N
01a212ab93747f56987208298f2e832b	01a212ab93437e2898824c835153df88	1	render	tile 0,0	completed	1	0	{"tile": {"row": 0, "size": 8, "column": 0, "texels": 5}}	{"kind": "render", "tile": {"row": 0, "size": 8, "column": 0, "texels": 5}, "paths": 10, "invalid": 0, "seconds": 0.5, "overflows": 0, "invalid_texels": []}	\N	01a212ab926a7e5a8b9c5c6f76081d02	\N	\N	7	2026-11-25 12:26:04.009382+00	2026-11-25 12:26:04.03149+00	2026-11-25 12:26:04.04668+00	\N
01a212ab93747e138a929241abd9b8f9	01a212ab93437e2898824c835153df88	2	render	tile 0,8	active	1	0	{"tile": {"row": 0, "size": 8, "column": 8, "texels": 5}}	\N	\N	01a212ab926a7e5a8b9c5c6f76081d02	\N	\N	8	2026-11-25 12:26:04.009382+00	2026-11-25 12:26:04.070145+00	\N	2026-11-25 12:26:04.099686+00
01a212ab93dc73ab8e9cfbd72e8043af	01a212ab93da7763b2330b380219a5d6	0	prepare	scene	canceled	0	0	{}	\N	\N	\N	\N	\N	10	2026-11-25 12:26:04.121487+00	\N	2026-11-25 12:26:04.136868+00	\N
\.

COPY public.workers (id, name, kinds, memory_bytes, threads, device, version, queue_worker, registered, seen) FROM stdin;
01a212ab926a7e5a8b9c5c6f76081d02	old	{prepare,render,fit,package}	1073741824	1	none	0	1	2026-11-25 12:26:03.757586+00	2026-11-25 12:26:04.099686+00
\.

SELECT pg_catalog.setval('public.events_id_seq', 35, true);

SELECT pg_catalog.setval('public.procrastinate_events_id_seq', 18, true);

SELECT pg_catalog.setval('public.procrastinate_jobs_id_seq', 10, true);

SELECT pg_catalog.setval('public.procrastinate_periodic_defers_id_seq', 1, false);

SELECT pg_catalog.setval('public.procrastinate_workers_id_seq', 1, true);

SELECT pg_catalog.setval('public.task_logs_id_seq', 1, true);

ALTER TABLE ONLY public.artifacts
    ADD CONSTRAINT artifacts_pkey PRIMARY KEY (job_id, name);

ALTER TABLE ONLY public.blob_uses
    ADD CONSTRAINT blob_uses_pkey PRIMARY KEY (sha256, owner);

ALTER TABLE ONLY public.blobs
    ADD CONSTRAINT blobs_pkey PRIMARY KEY (sha256);

ALTER TABLE ONLY public.events
    ADD CONSTRAINT events_pkey PRIMARY KEY (id);

ALTER TABLE ONLY public.jobs
    ADD CONSTRAINT jobs_pkey PRIMARY KEY (id);

ALTER TABLE ONLY public.kiln_migrations
    ADD CONSTRAINT kiln_migrations_pkey PRIMARY KEY (version);

ALTER TABLE ONLY public.procrastinate_events
    ADD CONSTRAINT procrastinate_events_pkey PRIMARY KEY (id);

ALTER TABLE ONLY public.procrastinate_jobs
    ADD CONSTRAINT procrastinate_jobs_pkey PRIMARY KEY (id);

ALTER TABLE ONLY public.procrastinate_periodic_defers
    ADD CONSTRAINT procrastinate_periodic_defers_pkey PRIMARY KEY (id);

ALTER TABLE ONLY public.procrastinate_periodic_defers
    ADD CONSTRAINT procrastinate_periodic_defers_unique UNIQUE (task_name, periodic_id, defer_timestamp);

ALTER TABLE ONLY public.procrastinate_workers
    ADD CONSTRAINT procrastinate_workers_pkey PRIMARY KEY (id);

ALTER TABLE ONLY public.task_logs
    ADD CONSTRAINT task_logs_pkey PRIMARY KEY (id);

ALTER TABLE ONLY public.tasks
    ADD CONSTRAINT tasks_job_id_kind_label_key UNIQUE (job_id, kind, label);

ALTER TABLE ONLY public.tasks
    ADD CONSTRAINT tasks_pkey PRIMARY KEY (id);

ALTER TABLE ONLY public.workers
    ADD CONSTRAINT workers_pkey PRIMARY KEY (id);

CREATE INDEX blob_uses_by_owner ON public.blob_uses USING btree (owner);

CREATE INDEX events_by_job ON public.events USING btree (job_id, id);

CREATE INDEX idx_procrastinate_jobs_worker_not_null ON public.procrastinate_jobs USING btree (worker_id) WHERE ((worker_id IS NOT NULL) AND (status = 'doing'::public.procrastinate_job_status));

CREATE INDEX idx_procrastinate_workers_last_heartbeat ON public.procrastinate_workers USING btree (last_heartbeat);

CREATE INDEX jobs_by_state ON public.jobs USING btree (state, id DESC);

CREATE INDEX procrastinate_events_job_id_fkey_v1 ON public.procrastinate_events USING btree (job_id);

CREATE INDEX procrastinate_jobs_id_lock_idx_v1 ON public.procrastinate_jobs USING btree (id, lock) WHERE (status = ANY (ARRAY['todo'::public.procrastinate_job_status, 'doing'::public.procrastinate_job_status]));

CREATE UNIQUE INDEX procrastinate_jobs_lock_idx_v1 ON public.procrastinate_jobs USING btree (lock) WHERE (status = 'doing'::public.procrastinate_job_status);

CREATE INDEX procrastinate_jobs_priority_idx_v1 ON public.procrastinate_jobs USING btree (priority DESC, id) WHERE (status = 'todo'::public.procrastinate_job_status);

CREATE INDEX procrastinate_jobs_queue_name_idx_v1 ON public.procrastinate_jobs USING btree (queue_name);

CREATE UNIQUE INDEX procrastinate_jobs_queueing_lock_idx_v1 ON public.procrastinate_jobs USING btree (queueing_lock) WHERE (status = 'todo'::public.procrastinate_job_status);

CREATE INDEX procrastinate_periodic_defers_job_id_fkey_v1 ON public.procrastinate_periodic_defers USING btree (job_id);

CREATE INDEX task_logs_by_task ON public.task_logs USING btree (task_id, id);

CREATE INDEX tasks_active ON public.tasks USING btree (heartbeat) WHERE (state = 'active'::text);

CREATE INDEX tasks_by_job ON public.tasks USING btree (job_id, ordinal);

CREATE INDEX tasks_queued ON public.tasks USING btree (queue_job) WHERE (state = 'queued'::text);

CREATE TRIGGER events_are_append_only BEFORE DELETE OR UPDATE ON public.events FOR EACH ROW EXECUTE FUNCTION public.events_are_append_only();

CREATE TRIGGER procrastinate_jobs_notify_queue_job_aborted_v1 AFTER UPDATE OF abort_requested ON public.procrastinate_jobs FOR EACH ROW WHEN (((old.abort_requested = false) AND (new.abort_requested = true) AND (new.status = 'doing'::public.procrastinate_job_status))) EXECUTE FUNCTION public.procrastinate_notify_queue_abort_job_v1();

CREATE TRIGGER procrastinate_jobs_notify_queue_job_inserted_v1 AFTER INSERT ON public.procrastinate_jobs FOR EACH ROW WHEN ((new.status = 'todo'::public.procrastinate_job_status)) EXECUTE FUNCTION public.procrastinate_notify_queue_job_inserted_v1();

CREATE TRIGGER procrastinate_trigger_abort_requested_events_v1 AFTER UPDATE OF abort_requested ON public.procrastinate_jobs FOR EACH ROW WHEN ((new.abort_requested = true)) EXECUTE FUNCTION public.procrastinate_trigger_abort_requested_events_procedure_v1();

CREATE TRIGGER procrastinate_trigger_delete_jobs_v1 BEFORE DELETE ON public.procrastinate_jobs FOR EACH ROW EXECUTE FUNCTION public.procrastinate_unlink_periodic_defers_v1();

CREATE TRIGGER procrastinate_trigger_scheduled_events_v1 AFTER INSERT OR UPDATE ON public.procrastinate_jobs FOR EACH ROW WHEN (((new.scheduled_at IS NOT NULL) AND (new.status = 'todo'::public.procrastinate_job_status))) EXECUTE FUNCTION public.procrastinate_trigger_function_scheduled_events_v1();

CREATE TRIGGER procrastinate_trigger_status_events_insert_v1 AFTER INSERT ON public.procrastinate_jobs FOR EACH ROW WHEN ((new.status = 'todo'::public.procrastinate_job_status)) EXECUTE FUNCTION public.procrastinate_trigger_function_status_events_insert_v1();

CREATE TRIGGER procrastinate_trigger_status_events_update_v1 AFTER UPDATE OF status ON public.procrastinate_jobs FOR EACH ROW EXECUTE FUNCTION public.procrastinate_trigger_function_status_events_update_v1();

ALTER TABLE ONLY public.artifacts
    ADD CONSTRAINT artifacts_job_id_fkey FOREIGN KEY (job_id) REFERENCES public.jobs(id);

ALTER TABLE ONLY public.artifacts
    ADD CONSTRAINT artifacts_sha256_fkey FOREIGN KEY (sha256) REFERENCES public.blobs(sha256);

ALTER TABLE ONLY public.blob_uses
    ADD CONSTRAINT blob_uses_sha256_fkey FOREIGN KEY (sha256) REFERENCES public.blobs(sha256);

ALTER TABLE ONLY public.events
    ADD CONSTRAINT events_job_id_fkey FOREIGN KEY (job_id) REFERENCES public.jobs(id);

ALTER TABLE ONLY public.events
    ADD CONSTRAINT events_task_id_fkey FOREIGN KEY (task_id) REFERENCES public.tasks(id);

ALTER TABLE ONLY public.procrastinate_events
    ADD CONSTRAINT procrastinate_events_job_id_fkey FOREIGN KEY (job_id) REFERENCES public.procrastinate_jobs(id) ON DELETE CASCADE;

ALTER TABLE ONLY public.procrastinate_jobs
    ADD CONSTRAINT procrastinate_jobs_worker_id_fkey FOREIGN KEY (worker_id) REFERENCES public.procrastinate_workers(id) ON DELETE SET NULL;

ALTER TABLE ONLY public.procrastinate_periodic_defers
    ADD CONSTRAINT procrastinate_periodic_defers_job_id_fkey FOREIGN KEY (job_id) REFERENCES public.procrastinate_jobs(id);

ALTER TABLE ONLY public.task_logs
    ADD CONSTRAINT task_logs_task_id_fkey FOREIGN KEY (task_id) REFERENCES public.tasks(id);

ALTER TABLE ONLY public.tasks
    ADD CONSTRAINT tasks_job_id_fkey FOREIGN KEY (job_id) REFERENCES public.jobs(id);

ALTER TABLE ONLY public.tasks
    ADD CONSTRAINT tasks_worker_id_fkey FOREIGN KEY (worker_id) REFERENCES public.workers(id);

\unrestrict lEB16Zmdrz9uLG1361TNtTzb7GUG6iHEVRajMsWov8NmBfr8YWXGBQOulb65y1m

