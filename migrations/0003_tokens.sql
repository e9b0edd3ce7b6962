-- Tokens: who may do what with which rigs.

CREATE TABLE tokens (
    id            TEXT    NOT NULL PRIMARY KEY, -- UUID v7, no secret
    name          TEXT    NOT NULL,             -- for people, may be empty
    role          TEXT    NOT NULL CHECK (role IN ('reader', 'operator', 'admin')),
    rigs          TEXT,                         -- JSON: [rig id] that it is limited to; none: all rigs
    secret_sha256 BLOB    NOT NULL UNIQUE,      -- SHA-256 of the secret, 32 bytes; the secret is not kept
    created_us    INTEGER NOT NULL,
    expires_us    INTEGER,                      -- when it ends; none: never
    -- When it was revoked. The row stays: once there was a token, the service is not open any more.
    revoked_us    INTEGER,
    CHECK (length(secret_sha256) = 32)
) STRICT;
