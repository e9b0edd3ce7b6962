-- Evaluations of models on runs.

CREATE TABLE evaluations (
    id         TEXT    NOT NULL PRIMARY KEY,      -- UUID v7
    rig        TEXT    NOT NULL REFERENCES rigs (id) ON DELETE CASCADE,
    job        TEXT    NOT NULL,                  -- job that made it; may be gone
    request    TEXT    NOT NULL,                  -- JSON: what was asked for, models and runs resolved
    outline    TEXT    NOT NULL,                  -- JSON: {models, baseline, classes, runs}
    report     TEXT    NOT NULL,                  -- digest of the object with the report
    elapsed_s  REAL    NOT NULL,                  -- seconds that it took
    created_us INTEGER NOT NULL
) STRICT;

CREATE INDEX evaluations_by_rig ON evaluations (rig, id);
CREATE INDEX evaluations_by_object ON evaluations (report);

CREATE TRIGGER evaluations_added AFTER INSERT ON evaluations
BEGIN INSERT INTO changes (tbl, key) VALUES ('evaluations', json_array(NEW.id)); END;
CREATE TRIGGER evaluations_changed AFTER UPDATE ON evaluations
BEGIN INSERT INTO changes (tbl, key) VALUES ('evaluations', json_array(NEW.id)); END;
CREATE TRIGGER evaluations_removed AFTER DELETE ON evaluations
BEGIN INSERT INTO changes (tbl, key) VALUES ('evaluations', json_array(OLD.id)); END;
