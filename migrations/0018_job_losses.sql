-- The errors of a training by epoch, for people who watch its job. They are written as the job goes on, and stay with
-- it. The report of a model has its own, so they are not journaled.

CREATE TABLE job_losses (
    job      TEXT    NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    stopped  INTEGER NOT NULL,                    -- 1: in a training that data stop; 0: in one that nothing stops
    seed     INTEGER NOT NULL,                    -- as a signed number of the same bits
    epoch    INTEGER NOT NULL,                    -- from 1
    training REAL    NOT NULL,                    -- mean squared error on the training data, standardised
    stopping REAL,                                -- on the data that stop the training; NULL where there are none
    PRIMARY KEY (job, stopped, seed, epoch)
) STRICT, WITHOUT ROWID;
