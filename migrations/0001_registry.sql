-- The registry: rigs, their runs, models and jobs.
-- Times are microseconds since 1970-01-01 UTC. Ids of runs and jobs are UUID v7 as text, so that
-- their order is that of their making. Digests are SHA-256 as 64 lower-case hex digits.
-- JSON columns hold what the program only ever reads whole.

CREATE TABLE rigs (
    id              TEXT    NOT NULL PRIMARY KEY, -- slug, chosen by the client
    name            TEXT    NOT NULL,             -- for people
    sample_rate_hz  REAL    NOT NULL,             -- samples per second
    channels        TEXT    NOT NULL,             -- JSON: [{name, unit, role, quantity, axis, group}], in order
    fit_policy      TEXT,                         -- JSON: {kinds, min_total_s, fits}
    created_us      INTEGER NOT NULL,
    updated_us      INTEGER NOT NULL,
    revision        INTEGER NOT NULL,             -- rises with every change; the ETag
    active_version  INTEGER,                      -- model that answers for "active"
    active_us       INTEGER,                      -- when active_version was last set
    active_revision INTEGER NOT NULL,             -- rises with every change of active_version; its ETag
    next_version    INTEGER NOT NULL DEFAULT 1,   -- number of the next model; none is given twice
    -- The pointer names a listed model or nothing.
    FOREIGN KEY (id, active_version) REFERENCES models (rig, version)
) STRICT;

CREATE TABLE runs (
    id             TEXT    NOT NULL PRIMARY KEY,  -- UUID v7
    rig            TEXT    NOT NULL REFERENCES rigs (id) ON DELETE CASCADE,
    name           TEXT    NOT NULL,              -- for people, may be empty
    kind           TEXT    NOT NULL CHECK (kind IN ('noise', 'service', 'sine', 'sweep', 'other')),
    split          TEXT    NOT NULL CHECK (split IN ('training', 'validation', 'test')),
    tags           TEXT    NOT NULL,              -- JSON: [text], without repeats
    started_us     INTEGER,                       -- begin of the measurement, as the client says
    created_us     INTEGER NOT NULL,              -- accepted
    channels       TEXT    NOT NULL,              -- JSON: [name], in the order of the samples
    units          TEXT    NOT NULL,              -- JSON: [unit], one a channel
    samples        INTEGER NOT NULL,              -- per channel
    duration_s     REAL    NOT NULL,              -- seconds
    sample_rate_hz REAL    NOT NULL,              -- samples per second
    sha256         TEXT    NOT NULL,              -- digest of the uploaded file
    object         TEXT    NOT NULL,              -- digest of the object with the samples
    quality        TEXT    NOT NULL,              -- JSON: levels, dead and clipped channels
    duplicate_of   TEXT    REFERENCES runs (id)   -- earliest run of the rig with the same sha256
) STRICT;

CREATE INDEX runs_by_rig ON runs (rig, id);
CREATE INDEX runs_by_digest ON runs (rig, sha256);
CREATE INDEX runs_by_object ON runs (object);
CREATE INDEX runs_by_original ON runs (duplicate_of);

CREATE TABLE models (
    rig             TEXT    NOT NULL REFERENCES rigs (id) ON DELETE CASCADE,
    version         INTEGER NOT NULL,             -- from 1, per rig
    kind            TEXT    NOT NULL CHECK (kind IN ('frf', 'lstm', 'hybrid1', 'hybrid2')),
    inputs          TEXT    NOT NULL,             -- JSON: [channel], in order
    outputs         TEXT    NOT NULL,             -- JSON: [channel], in order
    sample_rate_hz  REAL    NOT NULL,             -- samples per second
    sha256          TEXT    NOT NULL,             -- digest, and name, of the weight file
    size_bytes      INTEGER NOT NULL,             -- of the weight file
    origin          TEXT    NOT NULL CHECK (origin IN ('fit', 'import')),
    job             TEXT,                         -- job that fitted it; may be gone
    request         TEXT,                         -- JSON: the fit, runs and channels resolved
    report          TEXT,                         -- JSON: settings used, errors on validation data
    lineage         TEXT    NOT NULL,             -- JSON: {training, frf, validation: [{run, sha256, from_sample, to_sample}]}
    code_version    TEXT    NOT NULL,             -- program that made it
    instruction_set TEXT    NOT NULL,             -- that it was computed with
    created_us      INTEGER NOT NULL,
    PRIMARY KEY (rig, version)
) STRICT;

CREATE INDEX models_by_digest ON models (sha256);

CREATE TABLE jobs (
    id               TEXT    NOT NULL PRIMARY KEY, -- UUID v7
    rig              TEXT    NOT NULL REFERENCES rigs (id) ON DELETE CASCADE,
    kind             TEXT    NOT NULL CHECK (kind IN ('fit', 'evaluation', 'diagnosis', 'iteration', 'study')),
    state            TEXT    NOT NULL CHECK (state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')),
    origin           TEXT    NOT NULL CHECK (origin IN ('request', 'policy')), -- who asked for it
    request          TEXT    NOT NULL,             -- JSON: what is to be done
    stage            TEXT,                         -- what is being done, in words
    progress         REAL    NOT NULL DEFAULT 0,   -- share that is done, 0..1
    eta_s            REAL,                         -- seconds to go, at the last heartbeat
    attempt          INTEGER NOT NULL DEFAULT 0,   -- how often it was started
    created_us       INTEGER NOT NULL,
    started_us       INTEGER,                      -- last attempt
    finished_us      INTEGER,                      -- terminal state
    result           TEXT,                         -- JSON: {kind, id, href}
    problem          TEXT,                         -- JSON: problem document
    cancel_requested INTEGER NOT NULL DEFAULT 0,   -- 0 or 1
    event            INTEGER NOT NULL DEFAULT 1,   -- rises with every change; id of the event
    worker           TEXT,                         -- who has it, for people
    lease_token      INTEGER NOT NULL DEFAULT 0,   -- rises with every claim: a fence against former workers
    lease_until_us   INTEGER                       -- without a heartbeat until then the job is up for grabs
) STRICT;

CREATE INDEX jobs_by_state ON jobs (state, id);
CREATE INDEX jobs_by_rig ON jobs (rig, id);

-- The moves that the domain allows, held here too: whatever a program does, a finished job stays.
CREATE TRIGGER jobs_keep_their_end BEFORE UPDATE ON jobs
WHEN OLD.state IN ('succeeded', 'failed', 'cancelled')
BEGIN
    SELECT RAISE(ABORT, 'a finished job never changes');
END;

CREATE TRIGGER jobs_move_legally BEFORE UPDATE OF state ON jobs
WHEN NOT (
    (OLD.state = 'queued' AND NEW.state IN ('running', 'cancelled', 'failed'))
    OR (OLD.state = 'running' AND NEW.state IN ('queued', 'succeeded', 'failed', 'cancelled'))
)
BEGIN
    SELECT RAISE(ABORT, 'no legal move of a job');
END;
