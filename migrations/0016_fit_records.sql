-- What a fit keeps about its data besides the report that is shown with the model: the residual on data that the
-- model has not seen, and the coverage of its inputs. Models that were imported, adopted or fitted before have none.
-- It is no column of `models`, whose rows are read for every prediction.

CREATE TABLE fit_records (
    rig     TEXT    NOT NULL,
    version INTEGER NOT NULL,
    record  TEXT    NOT NULL,                     -- JSON: {residual, coverage}
    PRIMARY KEY (rig, version),
    FOREIGN KEY (rig, version) REFERENCES models (rig, version) ON DELETE CASCADE
) STRICT;

CREATE TRIGGER fit_records_added AFTER INSERT ON fit_records
BEGIN INSERT INTO changes (tbl, key) VALUES ('fit_records', json_array(NEW.rig, NEW.version)); END;
CREATE TRIGGER fit_records_changed AFTER UPDATE ON fit_records
BEGIN INSERT INTO changes (tbl, key) VALUES ('fit_records', json_array(NEW.rig, NEW.version)); END;
CREATE TRIGGER fit_records_removed AFTER DELETE ON fit_records
BEGIN INSERT INTO changes (tbl, key) VALUES ('fit_records', json_array(OLD.rig, OLD.version)); END;
