-- The registry on PostgreSQL. What each column holds is said in the migrations of SQLite; the tables are the same, but
-- for the journal, which PostgreSQL has of its own. Both series of migrations go on with the same numbers.
-- Times are microseconds since 1970-01-01 UTC, truth values are 0 and 1, texts are ordered byte by byte.

-- Which service the database belongs to: its bucket bears the same mark.
CREATE TABLE service (
    id  TEXT    COLLATE "C" NOT NULL,
    one BOOLEAN NOT NULL PRIMARY KEY DEFAULT TRUE CHECK (one)
);
INSERT INTO service (id) VALUES (gen_random_uuid()::text);

CREATE TABLE rigs (
    id              TEXT             COLLATE "C" NOT NULL PRIMARY KEY,
    name            TEXT             COLLATE "C" NOT NULL,
    sample_rate_hz  DOUBLE PRECISION NOT NULL,
    channels        TEXT             COLLATE "C" NOT NULL,
    fit_policy      TEXT             COLLATE "C",
    created_us      BIGINT           NOT NULL,
    updated_us      BIGINT           NOT NULL,
    revision        BIGINT           NOT NULL,
    active_version  BIGINT,
    active_us       BIGINT,
    active_revision BIGINT           NOT NULL,
    next_version    BIGINT           NOT NULL DEFAULT 1
);

CREATE TABLE runs (
    id             TEXT             COLLATE "C" NOT NULL PRIMARY KEY,
    rig            TEXT             COLLATE "C" NOT NULL REFERENCES rigs (id) ON DELETE CASCADE DEFERRABLE,
    name           TEXT             COLLATE "C" NOT NULL,
    kind           TEXT             COLLATE "C" NOT NULL CHECK (kind IN ('noise', 'service', 'sine', 'sweep', 'other')),
    split          TEXT             COLLATE "C" NOT NULL CHECK (split IN ('training', 'validation', 'test')),
    tags           TEXT             COLLATE "C" NOT NULL,
    started_us     BIGINT,
    created_us     BIGINT           NOT NULL,
    channels       TEXT             COLLATE "C" NOT NULL,
    units          TEXT             COLLATE "C" NOT NULL,
    samples        BIGINT           NOT NULL,
    duration_s     DOUBLE PRECISION NOT NULL,
    sample_rate_hz DOUBLE PRECISION NOT NULL,
    sha256         TEXT             COLLATE "C" NOT NULL,
    object         TEXT             COLLATE "C" NOT NULL,
    quality        TEXT             COLLATE "C" NOT NULL,
    duplicate_of   TEXT             COLLATE "C" REFERENCES runs (id) DEFERRABLE
);

CREATE INDEX runs_by_rig ON runs (rig, id);
CREATE INDEX runs_by_digest ON runs (rig, sha256);
CREATE INDEX runs_by_object ON runs (object);
CREATE INDEX runs_by_original ON runs (duplicate_of);

CREATE TABLE models (
    rig             TEXT             COLLATE "C" NOT NULL REFERENCES rigs (id) ON DELETE CASCADE DEFERRABLE,
    version         BIGINT           NOT NULL,
    kind            TEXT             COLLATE "C" NOT NULL CHECK (kind IN ('frf', 'lstm', 'hybrid1', 'hybrid2')),
    inputs          TEXT             COLLATE "C" NOT NULL,
    outputs         TEXT             COLLATE "C" NOT NULL,
    sample_rate_hz  DOUBLE PRECISION NOT NULL,
    sha256          TEXT             COLLATE "C" NOT NULL,
    size_bytes      BIGINT           NOT NULL,
    origin          TEXT             COLLATE "C" NOT NULL CHECK (origin IN ('fit', 'import', 'diagnosis')),
    job             TEXT             COLLATE "C",
    request         TEXT             COLLATE "C",
    report          TEXT             COLLATE "C",
    lineage         TEXT             COLLATE "C" NOT NULL,
    code_version    TEXT             COLLATE "C" NOT NULL,
    instruction_set TEXT             COLLATE "C" NOT NULL,
    created_us      BIGINT           NOT NULL,
    frf             TEXT             COLLATE "C",
    adoption        TEXT             COLLATE "C",
    PRIMARY KEY (rig, version)
);

CREATE INDEX models_by_digest ON models (sha256);
ALTER TABLE rigs ADD FOREIGN KEY (id, active_version) REFERENCES models (rig, version) DEFERRABLE;

CREATE TABLE jobs (
    id               TEXT             COLLATE "C" NOT NULL PRIMARY KEY,
    rig              TEXT             COLLATE "C" NOT NULL REFERENCES rigs (id) ON DELETE CASCADE DEFERRABLE,
    kind             TEXT             COLLATE "C" NOT NULL
                     CHECK (kind IN ('fit', 'evaluation', 'diagnosis', 'iteration', 'study')),
    state            TEXT             COLLATE "C" NOT NULL
                     CHECK (state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')),
    origin           TEXT             COLLATE "C" NOT NULL CHECK (origin IN ('request', 'policy')),
    request          TEXT             COLLATE "C" NOT NULL,
    stage            TEXT             COLLATE "C",
    progress         DOUBLE PRECISION NOT NULL DEFAULT 0,
    eta_s            DOUBLE PRECISION,
    attempt          BIGINT           NOT NULL DEFAULT 0,
    created_us       BIGINT           NOT NULL,
    started_us       BIGINT,
    finished_us      BIGINT,
    result           TEXT             COLLATE "C",
    problem          TEXT             COLLATE "C",
    cancel_requested BIGINT           NOT NULL DEFAULT 0,
    event            BIGINT           NOT NULL DEFAULT 1,
    worker           TEXT             COLLATE "C",
    lease_token      BIGINT           NOT NULL DEFAULT 0,
    lease_until_us   BIGINT,
    owner            TEXT             COLLATE "C" NOT NULL DEFAULT '',
    urgency          BIGINT           NOT NULL DEFAULT 1,
    charged_us       BIGINT,
    goes_on          BIGINT           NOT NULL DEFAULT 0,
    furthest         DOUBLE PRECISION NOT NULL DEFAULT 0,
    service_deaths   BIGINT           NOT NULL DEFAULT 0,
    queued_us        BIGINT
);

CREATE INDEX jobs_by_state ON jobs (state, id);
CREATE INDEX jobs_by_rig ON jobs (rig, id);
CREATE INDEX jobs_waiting ON jobs (owner, rig, urgency, goes_on, id) WHERE state = 'queued';

CREATE FUNCTION refuse() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    RAISE EXCEPTION '%', TG_ARGV[0];
END
$$;

CREATE TRIGGER jobs_keep_their_end BEFORE UPDATE ON jobs FOR EACH ROW
WHEN (OLD.state IN ('succeeded', 'failed', 'cancelled'))
EXECUTE FUNCTION refuse('a finished job never changes');

CREATE TRIGGER jobs_move_legally BEFORE UPDATE OF state ON jobs FOR EACH ROW
WHEN (NOT (
    (OLD.state = 'queued' AND NEW.state IN ('running', 'cancelled', 'failed'))
    OR (OLD.state = 'running' AND NEW.state IN ('queued', 'succeeded', 'failed', 'cancelled'))
))
EXECUTE FUNCTION refuse('no legal move of a job');

CREATE TABLE worker_time (
    owner  TEXT             COLLATE "C" NOT NULL,
    rig    TEXT             COLLATE "C" NOT NULL,
    used_s DOUBLE PRECISION NOT NULL,
    at_us  BIGINT           NOT NULL,
    PRIMARY KEY (owner, rig)
);

CREATE TABLE job_losses (
    job      TEXT             COLLATE "C" NOT NULL REFERENCES jobs (id) ON DELETE CASCADE DEFERRABLE,
    stopped  BIGINT           NOT NULL,
    seed     BIGINT           NOT NULL,
    epoch    BIGINT           NOT NULL,
    training DOUBLE PRECISION NOT NULL,
    stopping DOUBLE PRECISION,
    PRIMARY KEY (job, stopped, seed, epoch)
);

CREATE TABLE checkpoints (
    job        TEXT   COLLATE "C" NOT NULL REFERENCES jobs (id) ON DELETE CASCADE DEFERRABLE,
    part       TEXT   COLLATE "C" NOT NULL,
    fits       TEXT   COLLATE "C" NOT NULL,
    sha256     TEXT   COLLATE "C" NOT NULL,
    state      BYTEA  NOT NULL,
    written_us BIGINT NOT NULL,
    PRIMARY KEY (job, part)
);

CREATE TABLE studies (
    job        TEXT   COLLATE "C" NOT NULL PRIMARY KEY REFERENCES jobs (id) ON DELETE CASCADE DEFERRABLE,
    version    BIGINT,
    report     TEXT   COLLATE "C" NOT NULL,
    created_us BIGINT NOT NULL
);

CREATE FUNCTION is_json(state BYTEA) RETURNS boolean LANGUAGE plpgsql AS $$
BEGIN
    PERFORM convert_from(state, 'UTF8')::json;
    RETURN TRUE;
EXCEPTION WHEN data_exception THEN
    RETURN FALSE;
END
$$;

CREATE FUNCTION keep_what_a_study_found() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO studies (job, version, report, created_us)
    SELECT job, NULL, convert_from(state, 'UTF8'), written_us FROM checkpoints
    WHERE job = NEW.id AND part = 'study' AND is_json(state)
    ON CONFLICT (job) DO NOTHING;
    RETURN NEW;
END
$$;

CREATE TRIGGER studies_keep_what_they_found BEFORE UPDATE OF state ON jobs FOR EACH ROW
WHEN (OLD.kind = 'study' AND NEW.state IN ('failed', 'cancelled'))
EXECUTE FUNCTION keep_what_a_study_found();

CREATE FUNCTION forget_checkpoints() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    DELETE FROM checkpoints WHERE job = NEW.id;
    RETURN NULL;
END
$$;

CREATE TRIGGER checkpoints_go_with_the_end_of_their_job AFTER UPDATE OF state ON jobs FOR EACH ROW
WHEN (NEW.state IN ('succeeded', 'failed', 'cancelled'))
EXECUTE FUNCTION forget_checkpoints();

-- Every process hears of the jobs that change, whichever process changes them: the state and the id.
CREATE FUNCTION tell_of_a_job() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    PERFORM pg_notify('rigcast_jobs', NEW.state || ' ' || NEW.id);
    RETURN NULL;
END
$$;

CREATE TRIGGER jobs_tell AFTER INSERT OR UPDATE ON jobs FOR EACH ROW EXECUTE FUNCTION tell_of_a_job();

CREATE TABLE diagnoses (
    id           TEXT             COLLATE "C" NOT NULL PRIMARY KEY,
    rig          TEXT             COLLATE "C" NOT NULL REFERENCES rigs (id) ON DELETE CASCADE DEFERRABLE,
    job          TEXT             COLLATE "C" NOT NULL,
    version      BIGINT,
    model_sha256 TEXT             COLLATE "C",
    mode         TEXT             COLLATE "C" NOT NULL CHECK (mode IN ('external', 'in_situ')),
    request      TEXT             COLLATE "C" NOT NULL,
    verdict      TEXT             COLLATE "C" NOT NULL,
    findings     TEXT             COLLATE "C" NOT NULL,
    elapsed_s    DOUBLE PRECISION NOT NULL,
    created_us   BIGINT           NOT NULL,
    CHECK ((version IS NULL) = (model_sha256 IS NULL))
);

CREATE INDEX diagnoses_by_rig ON diagnoses (rig, id);
CREATE INDEX diagnoses_by_object ON diagnoses (findings);

CREATE TABLE tokens (
    id            TEXT   COLLATE "C" NOT NULL PRIMARY KEY,
    name          TEXT   COLLATE "C" NOT NULL,
    role          TEXT   COLLATE "C" NOT NULL CHECK (role IN ('reader', 'operator', 'admin')),
    rigs          TEXT   COLLATE "C",
    secret_sha256 BYTEA  NOT NULL UNIQUE CHECK (length(secret_sha256) = 32),
    created_us    BIGINT NOT NULL,
    expires_us    BIGINT,
    revoked_us    BIGINT
);

CREATE TABLE idempotency_keys (
    owner       TEXT   COLLATE "C" NOT NULL,
    key         TEXT   COLLATE "C" NOT NULL,
    fingerprint TEXT   COLLATE "C" NOT NULL,
    status      BIGINT NOT NULL,
    location    TEXT   COLLATE "C" NOT NULL,
    etag        TEXT   COLLATE "C",
    body        TEXT   COLLATE "C" NOT NULL,
    created_us  BIGINT NOT NULL,
    PRIMARY KEY (owner, key)
);

CREATE INDEX idempotency_keys_by_age ON idempotency_keys (created_us);

CREATE TABLE iterations (
    id           TEXT             COLLATE "C" NOT NULL PRIMARY KEY,
    rig          TEXT             COLLATE "C" NOT NULL REFERENCES rigs (id) ON DELETE CASCADE DEFERRABLE,
    job          TEXT             COLLATE "C" NOT NULL,
    version      BIGINT           NOT NULL,
    model_sha256 TEXT             COLLATE "C" NOT NULL,
    run          TEXT             COLLATE "C" NOT NULL,
    request      TEXT             COLLATE "C" NOT NULL,
    report       TEXT             COLLATE "C" NOT NULL,
    elapsed_s    DOUBLE PRECISION NOT NULL,
    created_us   BIGINT           NOT NULL
);

CREATE INDEX iterations_by_rig ON iterations (rig, id);

CREATE TABLE evaluations (
    id         TEXT             COLLATE "C" NOT NULL PRIMARY KEY,
    rig        TEXT             COLLATE "C" NOT NULL REFERENCES rigs (id) ON DELETE CASCADE DEFERRABLE,
    job        TEXT             COLLATE "C" NOT NULL,
    request    TEXT             COLLATE "C" NOT NULL,
    outline    TEXT             COLLATE "C" NOT NULL,
    report     TEXT             COLLATE "C" NOT NULL,
    elapsed_s  DOUBLE PRECISION NOT NULL,
    created_us BIGINT           NOT NULL
);

CREATE INDEX evaluations_by_rig ON evaluations (rig, id);
CREATE INDEX evaluations_by_object ON evaluations (report);

CREATE TABLE fit_records (
    rig     TEXT   COLLATE "C" NOT NULL,
    version BIGINT NOT NULL,
    record  TEXT   COLLATE "C" NOT NULL,
    PRIMARY KEY (rig, version),
    FOREIGN KEY (rig, version) REFERENCES models (rig, version) ON DELETE CASCADE DEFERRABLE
);

CREATE TABLE drift (
    rig        TEXT             COLLATE "C" NOT NULL,
    version    BIGINT           NOT NULL,
    run        TEXT             COLLATE "C" NOT NULL REFERENCES runs (id) ON DELETE CASCADE DEFERRABLE,
    outcome    TEXT             COLLATE "C" NOT NULL,
    ratio      DOUBLE PRECISION,
    created_us BIGINT           NOT NULL,
    PRIMARY KEY (rig, version, run),
    FOREIGN KEY (rig, version) REFERENCES models (rig, version) ON DELETE CASCADE DEFERRABLE
);

CREATE INDEX drift_by_run ON drift (run);

CREATE FUNCTION forget_drift() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    DELETE FROM drift WHERE run = NEW.id;
    RETURN NULL;
END
$$;

CREATE TRIGGER drift_is_judged_again AFTER UPDATE OF kind, duplicate_of ON runs FOR EACH ROW
WHEN (OLD.kind IS DISTINCT FROM NEW.kind OR OLD.duplicate_of IS DISTINCT FROM NEW.duplicate_of)
EXECUTE FUNCTION forget_drift();

-- SQLite's functions of these names, as far as the program uses them on its texts of JSON.

CREATE FUNCTION json_each(list TEXT) RETURNS TABLE (value TEXT) LANGUAGE sql IMMUTABLE AS $$
    SELECT json_array_elements_text(list::json)
$$;

CREATE FUNCTION json_extract(document TEXT, path TEXT) RETURNS TEXT LANGUAGE sql IMMUTABLE AS $$
    SELECT nullif(jsonb_path_query_first(document::jsonb, path::jsonpath)::text, 'null')
$$;
