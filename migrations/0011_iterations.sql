-- Drive-file iterations. The drive that each found is a run.

CREATE TABLE iterations (
    id           TEXT    NOT NULL PRIMARY KEY,    -- UUID v7
    rig          TEXT    NOT NULL REFERENCES rigs (id) ON DELETE CASCADE,
    job          TEXT    NOT NULL,                -- job that made it; may be gone
    version      INTEGER NOT NULL,                -- model that was iterated on, may be gone
    model_sha256 TEXT    NOT NULL,                -- digest of its weight file
    run          TEXT    NOT NULL,                -- run that holds the drive, may be gone
    request      TEXT    NOT NULL,                -- JSON: what was asked for, the model resolved
    report       TEXT    NOT NULL,                -- JSON: why it ended, errors, and every step
    elapsed_s    REAL    NOT NULL,                -- seconds that it took
    created_us   INTEGER NOT NULL
) STRICT;

CREATE INDEX iterations_by_rig ON iterations (rig, id);

CREATE TRIGGER iterations_added AFTER INSERT ON iterations
BEGIN INSERT INTO changes (tbl, key) VALUES ('iterations', json_array(NEW.id)); END;
CREATE TRIGGER iterations_changed AFTER UPDATE ON iterations
BEGIN INSERT INTO changes (tbl, key) VALUES ('iterations', json_array(NEW.id)); END;
CREATE TRIGGER iterations_removed AFTER DELETE ON iterations
BEGIN INSERT INTO changes (tbl, key) VALUES ('iterations', json_array(OLD.id)); END;
