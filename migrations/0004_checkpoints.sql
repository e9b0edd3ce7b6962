-- What long work has put by, so that an interruption costs a minute of it and not all.

CREATE TABLE checkpoints (
    job        TEXT    NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    part       TEXT    NOT NULL,                  -- of the work, such as one seed's training
    fits       TEXT    NOT NULL,                  -- digest of what it was computed from and by: program, settings, data
    sha256     TEXT    NOT NULL,                  -- digest of state
    state      BLOB    NOT NULL,
    written_us INTEGER NOT NULL,
    PRIMARY KEY (job, part)
) STRICT;

CREATE TRIGGER checkpoints_go_with_the_end_of_their_job AFTER UPDATE OF state ON jobs
WHEN NEW.state IN ('succeeded', 'failed', 'cancelled')
BEGIN
    DELETE FROM checkpoints WHERE job = NEW.id;
END;
