-- Diagnoses, and models that an adopted effect was added to.

CREATE TABLE diagnoses (
    id           TEXT    NOT NULL PRIMARY KEY,    -- UUID v7
    rig          TEXT    NOT NULL REFERENCES rigs (id) ON DELETE CASCADE,
    job          TEXT    NOT NULL,                -- job that made it; may be gone
    version      INTEGER,                         -- model that was diagnosed, may be gone; none: simulated outside
    model_sha256 TEXT,                            -- digest of its weight file
    mode         TEXT    NOT NULL CHECK (mode IN ('external', 'in_situ')),
    request      TEXT    NOT NULL,                -- JSON: what was asked for, runs and model resolved
    verdict      TEXT    NOT NULL,                -- JSON: {kind, effect, family, axis, channel, probability}
    findings     TEXT    NOT NULL,                -- digest of the object with {report, views, augmented}
    elapsed_s    REAL    NOT NULL,                -- seconds that it took
    created_us   INTEGER NOT NULL,
    CHECK ((version IS NULL) = (model_sha256 IS NULL))
) STRICT;

CREATE INDEX diagnoses_by_rig ON diagnoses (rig, id);
CREATE INDEX diagnoses_by_object ON diagnoses (findings);

-- A CHECK cannot be changed in place: the table of models is made anew with the origin 'diagnosis'.
-- Rigs that point at a model would not let it go: their pointers are put aside meanwhile.
CREATE TABLE pointers AS SELECT id, active_version FROM rigs WHERE active_version IS NOT NULL;
UPDATE rigs SET active_version = NULL WHERE active_version IS NOT NULL;

CREATE TABLE new_models (
    rig             TEXT    NOT NULL REFERENCES rigs (id) ON DELETE CASCADE,
    version         INTEGER NOT NULL,             -- from 1, per rig
    kind            TEXT    NOT NULL CHECK (kind IN ('frf', 'lstm', 'hybrid1', 'hybrid2')),
    inputs          TEXT    NOT NULL,             -- JSON: [channel], in order
    outputs         TEXT    NOT NULL,             -- JSON: [channel], in order
    sample_rate_hz  REAL    NOT NULL,             -- samples per second
    sha256          TEXT    NOT NULL,             -- digest, and name, of the weight file
    size_bytes      INTEGER NOT NULL,             -- of the weight file
    origin          TEXT    NOT NULL CHECK (origin IN ('fit', 'import', 'diagnosis')),
    job             TEXT,                         -- job that fitted it, or found its effect; may be gone
    request         TEXT,                         -- JSON: the fit, runs and channels resolved
    report          TEXT,                         -- JSON: settings used, errors on validation data
    lineage         TEXT    NOT NULL,             -- JSON: {training, frf, validation: [{run, sha256, from_sample, to_sample}], diagnoses}
    code_version    TEXT    NOT NULL,             -- program that made it
    instruction_set TEXT    NOT NULL,             -- that it was computed with
    created_us      INTEGER NOT NULL,
    PRIMARY KEY (rig, version)
) STRICT;

INSERT INTO new_models (rig, version, kind, inputs, outputs, sample_rate_hz, sha256, size_bytes, origin, job,
                        request, report, lineage, code_version, instruction_set, created_us)
SELECT rig, version, kind, inputs, outputs, sample_rate_hz, sha256, size_bytes, origin, job,
       request, report, lineage, code_version, instruction_set, created_us
FROM models;

DROP TABLE models;
ALTER TABLE new_models RENAME TO models;
CREATE INDEX models_by_digest ON models (sha256);

UPDATE rigs SET active_version = (SELECT pointers.active_version FROM pointers WHERE pointers.id = rigs.id)
WHERE id IN (SELECT id FROM pointers);
DROP TABLE pointers;
