-- Answers to requests that came with an Idempotency-Key, given again when the request comes again.

CREATE TABLE idempotency_keys (
    owner       TEXT    NOT NULL,                 -- who chose the key: a token's id, empty without tokens
    key         TEXT    NOT NULL,                 -- chosen by the client
    fingerprint TEXT    NOT NULL,                 -- digest of path, query, media type and body of the request
    status      INTEGER NOT NULL,                 -- of the answer
    location    TEXT    NOT NULL,
    etag        TEXT,
    body        TEXT    NOT NULL,                 -- JSON
    created_us  INTEGER NOT NULL,
    PRIMARY KEY (owner, key)
) STRICT;

CREATE INDEX idempotency_keys_by_age ON idempotency_keys (created_us);
