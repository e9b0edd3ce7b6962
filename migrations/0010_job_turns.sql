-- Turns between tokens and rigs, and deaths of the service under a job.

ALTER TABLE jobs ADD COLUMN owner TEXT NOT NULL DEFAULT '';            -- id of the token that asked for it, empty without tokens
ALTER TABLE jobs ADD COLUMN urgency INTEGER NOT NULL DEFAULT 1;        -- 0: awaited, 1: requested, 2: in the background
ALTER TABLE jobs ADD COLUMN charged_us INTEGER;                        -- up to when worker_time has the time of the running job
ALTER TABLE jobs ADD COLUMN goes_on INTEGER NOT NULL DEFAULT 0;        -- 0 or 1: interrupted with the service, resumes before others start
ALTER TABLE jobs ADD COLUMN furthest REAL NOT NULL DEFAULT 0;          -- greatest progress of all attempts, 0..1
ALTER TABLE jobs ADD COLUMN service_deaths INTEGER NOT NULL DEFAULT 0; -- deaths of the service under the job since it last made progress

UPDATE jobs SET urgency = CASE WHEN origin = 'policy' OR kind = 'study' THEN 2
                               WHEN kind IN ('diagnosis', 'evaluation') THEN 0
                               ELSE 1 END
WHERE state IN ('queued', 'running');

-- All that is read of the queue when a job is claimed, so that the requests of waiting jobs are not read then.
CREATE INDEX jobs_waiting ON jobs (owner, rig, urgency, goes_on, state, id, created_us) WHERE state = 'queued';

-- Time of workers that the jobs of each token and rig have used of late; half of it counts after an hour.
CREATE TABLE worker_time (
    owner  TEXT    NOT NULL, -- id of the token, empty without tokens
    rig    TEXT    NOT NULL, -- may be gone: a deleted rig does not give its time back
    used_s REAL    NOT NULL, -- seconds, as they count at at_us
    at_us  INTEGER NOT NULL,
    PRIMARY KEY (owner, rig)
) STRICT;
