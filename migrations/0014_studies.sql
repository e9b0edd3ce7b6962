-- Studies. A study is a job of kind `study`, whose id it has; this is what it has found.

CREATE TABLE studies (
    job        TEXT    NOT NULL PRIMARY KEY REFERENCES jobs (id) ON DELETE CASCADE,
    version    INTEGER,                           -- model that it published, if any; may be gone
    report     TEXT    NOT NULL,                  -- JSON: the table of its trials
    created_us INTEGER NOT NULL
) STRICT;

CREATE TRIGGER studies_added AFTER INSERT ON studies
BEGIN INSERT INTO changes (tbl, key) VALUES ('studies', json_array(NEW.job)); END;
CREATE TRIGGER studies_changed AFTER UPDATE ON studies
BEGIN INSERT INTO changes (tbl, key) VALUES ('studies', json_array(NEW.job)); END;
CREATE TRIGGER studies_removed AFTER DELETE ON studies
BEGIN INSERT INTO changes (tbl, key) VALUES ('studies', json_array(OLD.job)); END;

-- While a study runs, its checkpoint `study` is the table so far. The end of the job deletes the checkpoints; what a
-- study had found when it was cancelled or failed is kept.
CREATE TRIGGER studies_keep_what_they_found BEFORE UPDATE OF state ON jobs
WHEN OLD.kind = 'study' AND NEW.state IN ('failed', 'cancelled')
BEGIN
    INSERT OR IGNORE INTO studies (job, version, report, created_us)
    SELECT job, NULL, CAST(state AS TEXT), written_us FROM checkpoints
    WHERE job = NEW.id AND part = 'study' AND json_valid(CAST(state AS TEXT));
END;

-- When a job went back into the queue, where it gave its turn to a more urgent one; from then on it waits anew.
ALTER TABLE jobs ADD COLUMN queued_us INTEGER;

DROP INDEX jobs_waiting;
CREATE INDEX jobs_waiting ON jobs (owner, rig, urgency, goes_on, state, id, created_us, queued_us) WHERE state = 'queued';
