-- Changes of acknowledged data, in their order. The program copies each changed row into the journal beside the
-- database before a client is told, and then deletes the change here. The numbers never repeat or skip, so that the
-- journal tells whether the database has lost its last changes.

CREATE TABLE changes (
    seq INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
    tbl TEXT    NOT NULL,                         -- table of the changed row
    key TEXT    NOT NULL                          -- JSON: [primary key]
) STRICT;

CREATE TRIGGER rigs_added AFTER INSERT ON rigs
BEGIN INSERT INTO changes (tbl, key) VALUES ('rigs', json_array(NEW.id)); END;
CREATE TRIGGER rigs_changed AFTER UPDATE ON rigs
BEGIN INSERT INTO changes (tbl, key) VALUES ('rigs', json_array(NEW.id)); END;
CREATE TRIGGER rigs_removed AFTER DELETE ON rigs
BEGIN INSERT INTO changes (tbl, key) VALUES ('rigs', json_array(OLD.id)); END;

CREATE TRIGGER models_added AFTER INSERT ON models
BEGIN INSERT INTO changes (tbl, key) VALUES ('models', json_array(NEW.rig, NEW.version)); END;
CREATE TRIGGER models_changed AFTER UPDATE ON models
BEGIN INSERT INTO changes (tbl, key) VALUES ('models', json_array(NEW.rig, NEW.version)); END;
CREATE TRIGGER models_removed AFTER DELETE ON models
BEGIN INSERT INTO changes (tbl, key) VALUES ('models', json_array(OLD.rig, OLD.version)); END;

CREATE TRIGGER runs_added AFTER INSERT ON runs
BEGIN INSERT INTO changes (tbl, key) VALUES ('runs', json_array(NEW.id)); END;
CREATE TRIGGER runs_changed AFTER UPDATE ON runs
BEGIN INSERT INTO changes (tbl, key) VALUES ('runs', json_array(NEW.id)); END;
CREATE TRIGGER runs_removed AFTER DELETE ON runs
BEGIN INSERT INTO changes (tbl, key) VALUES ('runs', json_array(OLD.id)); END;

CREATE TRIGGER diagnoses_added AFTER INSERT ON diagnoses
BEGIN INSERT INTO changes (tbl, key) VALUES ('diagnoses', json_array(NEW.id)); END;
CREATE TRIGGER diagnoses_changed AFTER UPDATE ON diagnoses
BEGIN INSERT INTO changes (tbl, key) VALUES ('diagnoses', json_array(NEW.id)); END;
CREATE TRIGGER diagnoses_removed AFTER DELETE ON diagnoses
BEGIN INSERT INTO changes (tbl, key) VALUES ('diagnoses', json_array(OLD.id)); END;

CREATE TRIGGER tokens_added AFTER INSERT ON tokens
BEGIN INSERT INTO changes (tbl, key) VALUES ('tokens', json_array(NEW.id)); END;
CREATE TRIGGER tokens_changed AFTER UPDATE ON tokens
BEGIN INSERT INTO changes (tbl, key) VALUES ('tokens', json_array(NEW.id)); END;
CREATE TRIGGER tokens_removed AFTER DELETE ON tokens
BEGIN INSERT INTO changes (tbl, key) VALUES ('tokens', json_array(OLD.id)); END;

CREATE TRIGGER idempotency_keys_added AFTER INSERT ON idempotency_keys
BEGIN INSERT INTO changes (tbl, key) VALUES ('idempotency_keys', json_array(NEW.owner, NEW.key)); END;
CREATE TRIGGER idempotency_keys_changed AFTER UPDATE ON idempotency_keys
BEGIN INSERT INTO changes (tbl, key) VALUES ('idempotency_keys', json_array(NEW.owner, NEW.key)); END;
CREATE TRIGGER idempotency_keys_removed AFTER DELETE ON idempotency_keys
BEGIN INSERT INTO changes (tbl, key) VALUES ('idempotency_keys', json_array(OLD.owner, OLD.key)); END;

-- The progress of a running job is not journaled: it is written every few seconds and comes again with the next start.
CREATE TRIGGER jobs_added AFTER INSERT ON jobs
BEGIN INSERT INTO changes (tbl, key) VALUES ('jobs', json_array(NEW.id)); END;
CREATE TRIGGER jobs_changed AFTER UPDATE OF state, cancel_requested, attempt ON jobs
BEGIN INSERT INTO changes (tbl, key) VALUES ('jobs', json_array(NEW.id)); END;
CREATE TRIGGER jobs_removed AFTER DELETE ON jobs
BEGIN INSERT INTO changes (tbl, key) VALUES ('jobs', json_array(OLD.id)); END;
