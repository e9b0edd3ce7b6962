-- Each run of a rig under the versions that were active: the errors of the version on it, or why it was not predicted.
-- A run of a rig with an active version that has no row waits to be predicted. The rows can be made again from runs
-- and models, so they are not journaled.

CREATE TABLE drift (
    rig        TEXT    NOT NULL,
    version    INTEGER NOT NULL,
    run        TEXT    NOT NULL REFERENCES runs (id) ON DELETE CASCADE,
    outcome    TEXT    NOT NULL,                  -- JSON: {judged: {...}} or {omitted: reason}
    ratio      REAL,                              -- largest error over its limit; NULL where nothing is held against one
    created_us INTEGER NOT NULL,
    PRIMARY KEY (rig, version, run),
    FOREIGN KEY (rig, version) REFERENCES models (rig, version) ON DELETE CASCADE
) STRICT;

CREATE INDEX drift_by_run ON drift (run);

-- The limits of a run depend on its kind; a second upload is a run of its own once the first one is gone.
CREATE TRIGGER drift_is_judged_again AFTER UPDATE OF kind, duplicate_of ON runs
WHEN OLD.kind IS NOT NEW.kind OR OLD.duplicate_of IS NOT NEW.duplicate_of
BEGIN
    DELETE FROM drift WHERE run = NEW.id;
END;
